"""What the measurements say of the paper's figures and claims: a line of the summary each."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from experiments.compared import RIVALS
from experiments.paper import latent_space
from experiments.paper.study import SDS_EF
from experiments.published import TABLE_ONE, TABLE_THREE, TABLE_TWO

SIMILAR = 3.0
"""Factor within which a measured figure counts as reproduced."""
NO_NUMBERS = "not reproducible: no numbers to compare with"
REPRODUCED, IN_PART, CONTRADICTED = "reproduced", "reproduced in part", "contradicted"


class Finding(NamedTuple):
    """One line of the summary."""

    what: str
    paper: str
    ours: str
    verdict: str


def similar(*ratios: float) -> str:
    """Of errors over the paper's: all within the factor, or where they are not."""
    if max(ratios) > SIMILAR:
        return "worse"
    return REPRODUCED if min(ratios) >= 1 / SIMILAR else "better"


def table_one(lines: pd.DataFrame) -> Finding:
    low, high = lines["ratio"].min(), lines["ratio"].max()
    return Finding(
        f"Table I at its own hyperparameters ({len(lines)} cells)",
        f"MSE {_span(one.mse for of in TABLE_ONE.values() for one in of.values())}",
        f"{low:.2f} to {high:.2f} times the paper's",
        similar(low, high),
    )


def tuned(lines: pd.DataFrame) -> Finding:
    known = lines["fewer"].dropna()
    fewer, layers = int(known.sum()), [one.n_layers for of in TABLE_ONE.values() for one in of.values()]
    return Finding(
        "Tuning by the paper's rule",
        f"M from {min(layers)} to {max(layers)}",
        f"as few layers as the paper's or fewer in {fewer} of {len(known)} cells",
        REPRODUCED if fewer == len(known) else IN_PART if fewer else "worse",
    )


def heat_map(errors: Mapping[tuple[float, float], float]) -> Finding:
    """Of {(β, μ): MSE}."""
    beta, mu = min(errors, key=lambda key: errors[key])
    ours = f"MSE {errors[beta, mu]:.1e} (β {beta:g}, μ {mu:g}) to {max(errors.values()):.1e}"
    return Finding("Heat map at M = 75, c = 7", "a figure without numbers", ours, NO_NUMBERS)


def table_two(lines: pd.DataFrame) -> Finding:
    paper = f"test MSE {_span(one.mse for one in TABLE_TWO.values())}"
    ratios = lines["ratio"].dropna()
    if ratios.empty:
        return Finding("Table II, SDS-EF", paper, "—", "not compared: a quick run takes smaller models")
    ours = f"{ratios.min():.2g} to {ratios.max():.2g} times the paper's"
    return Finding("Table II, SDS-EF", paper, ours, similar(*ratios))


def similarity(lines: pd.DataFrame) -> list[Finding]:
    nearer, sure = lines["nearer"].sum(), ((lines["fast"] < 0.05) & (lines["lower"] == "Chebyshev")).sum()
    complexity = lines["spiral"].str.split("=").str[1].astype(float)
    low, high = lines[complexity <= 2]["best"].isin(SDS_EF), lines[complexity >= 7]["best"] == "Chebyshev"
    right, some = low.sum() + high.sum(), len(low) + len(high)
    return [
        Finding(
            "Chebyshev nearer than FDM (FastDTW)",
            "on par or better",
            f"nearer on {nearer} of {len(lines)} spirals, with p < 0.05 on {sure}",
            REPRODUCED if nearer >= 0.7 * len(lines) else CONTRADICTED if nearer <= 0.3 * len(lines) else IN_PART,
        ),
        Finding(
            "SDS-EF best at low complexity, Chebyshev at high",
            "from its bars",
            f"SDS-EF (either recipe) first on {low.sum()} of {len(low)} with c ≤ 2, "
            f"Chebyshev on {high.sum()} of {len(high)} with c ≥ 7",
            REPRODUCED if right == some else CONTRADICTED if right <= 0.3 * some else IN_PART,
        ),
    ]


def parameters(lines: pd.DataFrame) -> Finding:
    fewer, more = (lines["Chebyshev"] < lines["FDM"]).sum(), (lines["Chebyshev"] > lines["FDM"]).sum()
    smaller = (lines["Chebyshev"] * lines["a layer"] < lines[list(SDS_EF)].min(axis=1)).sum()
    return Finding(
        'Chebyshev "requires fewer parameters with similar accuracy"',
        "than FDM and SDS-EF",
        f"at MSE < 1e-5 fewer layers than FDM on {fewer}, as many on {len(lines) - fewer - more}, more on {more} "
        f"spirals; fewer parameters than SDS-EF on {smaller} of {len(lines)}",
        REPRODUCED if more == 0 and fewer else "contradicted for FDM" if fewer <= more else IN_PART,
    )


def replications() -> Finding:
    return Finding("Replications, unstable c = 7 and stable c = 3", "figures", "drawn; judged by DTW", NO_NUMBERS)


def planes(lines: pd.DataFrame) -> Finding:
    missed = {method: lines[f"{method} off"] for method in RIVALS}
    lost = {method: (off > 0.01).sum() for method, off in missed.items()}
    return Finding(
        '"FDM converges at an incorrect attractor" (third case)',
        "FDM only, one motion",
        f"ψ(x_N) is off by up to {missed['FDM'].max():.1e} (FDM) and {missed['Chebyshev'].max():.1e} (Chebyshev) "
        f"sizes; by more than 1 % on {lost['FDM']} and {lost['Chebyshev']} of {len(lines)}; none with the exact "
        "attractor",
        REPRODUCED if lost["FDM"] and not lost["Chebyshev"] else IN_PART if lost["FDM"] else CONTRADICTED,
    )


def joints(lines: pd.DataFrame, recorded: bool) -> Finding:
    scores, paper = lines["Chebyshev dtw_fast"], TABLE_THREE.values()
    return Finding(
        "Table III, 7-D joint space",
        f"FastDTW {min(paper)} … {max(paper)}",
        f"{scores.min():.2f} … {scores.max():.2f} on {'recordings of the user' if recorded else 'made-up motions'}",
        "not reproducible: its recordings are not public",
    )


def columns(frame: pd.DataFrame) -> list[Finding]:
    """Of :func:`latent_space.embedding`."""
    dims = [n for n in latent_space.DIMS if n > 2]
    entry, norm = ([latent_space.slope(frame, n, key) for n in dims] for key in ("entry", "norm"))
    pairs = f"{len(frame)} pairs of n and N"
    return [
        Finding(
            "Prop. 5: columns differ by O(1/N²)",
            "k = −2",
            f"k = {min(entry):.2f} … {max(entry):.2f} (entries), "
            f"{min(norm):.2f} … {max(norm):.2f} (norm, u₁ = 1); equal for n = 2",
            "contradicted: O(1/N)" if max(abs(k + 1) for k in entry) < 0.1 else "see the table",
        ),
        *(
            Finding(what, "all", f"{frame[key].sum()} of {pairs}", _held(frame[key].all()))
            for what, key in (
                ("Lemma 2: columns are monotone", "monotone"),
                ('"Interpoint spacing increases monotonically"', "spacing"),
            )
        ),
        Finding(
            "Lemma 3: λ < 2(1 − cos(π/N))",
            "ratio < 1",
            f"ratio at most {frame['bound'].max():.3f}",
            _held(frame["bound"].max() < 1),
        ),
    ]


def eigenvalues(spectrum: pd.DataFrame) -> list[Finding]:
    """Of :func:`latent_space.spectrum`."""
    even, odd = (spectrum[spectrum["n"] % 2 == parity] for parity in (0, 1))
    repeated, counted = "of the n smallest", bool((spectrum["per node"] == spectrum["paper"]).all())
    return [
        Finding(
            '"n smallest repeating eigenvalues"',
            "for every n",
            f"even n: all n repeat: {(even[repeated] == even['n']).all()}; "
            f"odd n: all but one: {(odd[repeated] == odd['n'] - 1).all()}",
            "contradicted for odd n" if (odd[repeated] < odd["n"]).all() else REPRODUCED,
        ),
        Finding(
            "Prop. 2: Λ eigenvalues of multiplicity 2",
            "K/2 − 1 or (K − 1)/2",
            f"that many per node: {counted}",
            _held(counted) + " as a count of pairs of blocks",
        ),
    ]


def sensitivity(lines: pd.DataFrame) -> Finding:
    turned = [f"{line['change']} on {line['spiral']}" for _, line in lines[lines["turned"]].iterrows()]
    total = len(lines) - lines["spiral"].nunique()
    return Finding(
        "Sensitivity to what the paper leaves open",
        "—",
        f"the nearer method changes in {len(turned)} of {total} variations"
        + (f": {'; '.join(turned)}" if turned else ""),
        "stable" if not turned else "depends on the reading",
    )


def orbits(counts: Mapping[str, int]) -> Finding:
    told = ", ".join(f"{method} {count}" for method, count in counts.items())
    return Finding("DMP's forward orbits", "cross", f"crossings: {told}", _held(counts["DMP"] and not counts["TubeDS"]))


def left_out(missing: Mapping[str, str]) -> list[Finding]:
    return [Finding(what, "figure", "—", f"not reproducible: {why}") for what, why in missing.items()]


def _held(holds: Any) -> str:
    return REPRODUCED if holds else CONTRADICTED


def _span(values: Iterable[float]) -> str:
    """The least and the largest, "2.5e-8 … 1.6e-5"."""
    found = list(values)
    return " … ".join(np.format_float_scientific(end, 1, exp_digits=1) for end in (min(found), max(found)))
