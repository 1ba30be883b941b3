"""What the paper claims of its latent space, measured: the embedding's columns and the graph's eigenvalues."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from experiments.paper.document import DPI, REPRODUCED, Document, verdict
from experiments.paper.study import Study
from latentds.arguments import Array
from latentds.fitting.embedding import chebyshev_columns, chebyshev_eigenvalues, map_to_endpoints
from latentds.plotting import SHOWN

DIMS = (2, 3, 4, 5, 6, 7)
COUNTS = (100, 200, 400, 800, 1600, 2000)
PATH_NODES = 60
"""Of each path in the explicit Laplacian."""


def latent_space(_: Study, document: Document) -> None:
    frame, eigenvalues = embedding(), spectrum()
    exponents = {key: {n: slope(frame, n, key) for n in DIMS if n > 2} for key in ("entry", "norm", "unit", "bend")}
    caption = "Proposition 5: the columns differ by O(1/N), not O(1/N²)"
    document.show("linearity", draw_linearity(frame, exponents["entry"]), caption)
    document.add(
        f"N = {min(COUNTS)} … {max(COUNTS)}; k is the exponent of N^k, fitted on log scales. "
        "The paper claims k = −2. *λ / bound*: the largest eigenvalue over Lemma 3's bound 2(1 − cos(π/N)). *Spacing "
        "grows* from the goal, where the eigenvectors begin, towards the start."
    )
    lines = []
    for n in DIMS:
        of = frame[frame["n"] == n]
        measured = [f"{slopes[n]:.3f}" if n in slopes else "equal" for slopes in exponents.values()]
        held = ["yes" if of[key].all() else "no" for key in ("monotone", "spacing")]
        limits = f"{of['limit'].min():.3f} … {of['limit'].max():.3f}"
        lines.append([str(n), *measured, *held, f"{of['bound'].max():.3f}", limits])
    names = ("entries", "‖u^l − u^m‖₂, u₁ = 1", "‖u^l − u^m‖₂, ‖u‖₂ = 1", "distance from the line")
    claims = ("monotone", "spacing grows", "λ / bound", "λN² / (π²/4)")
    document.table(["n", *(f"k of {name}" for name in names), *claims], lines)
    document.add(
        f"The summary's eigenvalues are of the explicit Laplacian of {PATH_NODES} nodes a path, K = n+1 = 3 … 8. "
        "Proposition 2's Λ counts pairs of equal blocks; each pair repeats one eigenvalue per node."
    )
    entry, norm = (exponents[key].values() for key in ("entry", "norm"))
    even, odd = (eigenvalues[eigenvalues["n"] % 2 == parity] for parity in (0, 1))
    repeated, counted = "of the n smallest", bool((eigenvalues["per node"] == eigenvalues["paper"]).all())
    document.find(
        "Prop. 5: columns differ by O(1/N²)",
        "k = −2",
        f"k = {min(entry):.2f} … {max(entry):.2f} (entries), "
        f"{min(norm):.2f} … {max(norm):.2f} (norm, u₁ = 1); equal for n = 2",
        "contradicted: O(1/N)" if max(abs(k + 1) for k in entry) < 0.1 else "see the table",
    )
    for what, key in (
        ("Lemma 2: columns are monotone", "monotone"),
        ('"Interpoint spacing increases monotonically"', "spacing"),
    ):
        document.find(what, "all", f"{frame[key].sum()} of {len(frame)} pairs of n and N", verdict(frame[key].all()))
    largest = frame["bound"].max()
    document.find("Lemma 3: λ < 2(1 − cos(π/N))", "ratio < 1", f"ratio at most {largest:.3f}", verdict(largest < 1))
    document.find(
        '"n smallest repeating eigenvalues"',
        "for every n",
        f"even n: all n repeat: {(even[repeated] == even['n']).all()}; "
        f"odd n: all but one: {(odd[repeated] == odd['n'] - 1).all()}",
        "contradicted for odd n" if (odd[repeated] < odd["n"]).all() else REPRODUCED,
    )
    document.find(
        "Prop. 2: Λ eigenvalues of multiplicity 2",
        "K/2 − 1 or (K − 1)/2",
        f"that many per node: {counted}",
        verdict(counted) + " as a count of pairs of blocks",
    )


def embedding(dims: Sequence[int] = DIMS, counts: Sequence[int] = COUNTS) -> pd.DataFrame:
    """One row per n and N: how far the columns lie apart, how bent their curve is, and what the lemmas say of them.

    ``entry``: the largest difference of two columns' entries where both begin with 1; ``norm``: of their vectors;
    ``unit``: of vectors scaled to length 1; ``bend``: the largest distance of the placed points from the straight line,
    in its lengths; ``bound``: the largest λ over Lemma 3's bound; ``limit``: λN² over π²/4.
    """
    rows = []
    for n, count in product(dims, counts):
        columns, eigenvalues = chebyshev_columns(count, n), chebyshev_eigenvalues(count, n)
        units = columns / np.linalg.norm(columns, axis=0)
        gaps = columns[:, :, None] - columns[:, None, :]
        placed = map_to_endpoints(columns, np.zeros(n), np.ones(n))
        aside = placed - placed.mean(axis=1, keepdims=True)
        steps = np.diff(columns, axis=0)
        row = {"n": n, "N": count, "entry": np.abs(gaps).max(), "norm": np.linalg.norm(gaps, axis=0).max()}
        row["unit"] = np.linalg.norm(units[:, :, None] - units[:, None, :], axis=0).max()
        row["bend"] = np.linalg.norm(aside, axis=1).max() / np.sqrt(n)
        row["monotone"] = bool((steps < 0).all())
        row["spacing"] = bool((np.diff(np.abs(steps), axis=0) > 0).all())
        row["bound"] = (eigenvalues / (2 * (1 - np.cos(np.pi / count)))).max()
        row["limit"] = (eigenvalues * count**2 / (np.pi**2 / 4)).min()
        rows.append(row)
    return pd.DataFrame(rows)


def slope(frame: pd.DataFrame, n: int, column: str) -> float:
    """k of column ~ N^k in dimension n, fitted on log scales."""
    chosen = frame[frame["n"] == n]
    return float(np.polyfit(np.log(chosen["N"]), np.log(chosen[column]), 1)[0])


def laplacian(count: int, n: int) -> Array:
    """Of K = n+1 copies of a path of ``count`` nodes, their last nodes in a cycle: (NK, NK)."""
    nodes = np.arange((n + 1) * count).reshape(n + 1, count)
    first = np.concatenate([nodes[:, :-1].ravel(), nodes[:, -1]])
    second = np.concatenate([nodes[:, 1:].ravel(), np.roll(nodes[:, -1], -1)])
    matrix = np.zeros((nodes.size, nodes.size))
    matrix[first, second] = matrix[second, first] = -1
    np.fill_diagonal(matrix, -matrix.sum(axis=1))
    return matrix


def spectrum(dims: Sequence[int] = DIMS, count: int = PATH_NODES) -> pd.DataFrame:
    """Repeated eigenvalues of the explicit Laplacian beside Prop. 2; how many of the n smallest above 0 repeat."""
    rows = []
    for n in dims:
        values = np.linalg.eigvalsh(laplacian(count, n))
        times = np.array([(np.abs(values - value) < 1e-9).sum() for value in values])
        copies, twice = n + 1, (times == 2).sum()
        counted = copies // 2 - 1 if copies % 2 == 0 else (copies - 1) // 2
        rows.append((n, copies, counted, twice // 2, twice / 2 / count, (times[1 : n + 1] == 2).sum()))
    return pd.DataFrame(rows, columns=["n", "K", "paper", "distinct", "per node", "of the n smallest"])


def draw_linearity(frame: pd.DataFrame, slopes: Mapping[int, float]) -> Figure:
    """The largest difference of two columns' entries over N, with the paper's O(1/N²) beside."""
    figure = Figure(figsize=(6.5, 4.4), dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    for i, (n, k) in enumerate(slopes.items()):
        chosen = frame[frame["n"] == n]
        axes.loglog(chosen["N"], chosen["entry"], "-o", ms=4, color=f"C{i}", label=f"n = {n}: slope {k:.2f}")
    claimed = chosen["entry"].iloc[0] * (chosen["N"].iloc[0] / chosen["N"]) ** 2
    axes.loglog(chosen["N"], claimed, ":", color=SHOWN, label="O(1/N²), the paper's")
    axes.set_xticks([chosen["N"].iloc[0], chosen["N"].iloc[-1]])
    axes.set(xlabel="N", ylabel="largest difference of two columns", title="How far the latent curve is from a line")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.grid(color="#E4E4E4", lw=0.6)
    axes.legend(fontsize=9)
    return figure
