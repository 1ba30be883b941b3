"""The sections of the report: how what was measured is told."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pandas as pd
import torch

from baselines import DMP
from baselines.dmp import FADING, STIFFNESS
from experiments import compared
from experiments.compared import RIVALS, greedy
from experiments.paper import figures, latent_space, measurements, tuning, verdicts
from experiments.paper.document import Document
from experiments.paper.study import SDS_EF, Study, paths
from experiments.published import TABLE_ONE, TABLE_THREE, Setting, Size
from experiments.report import mean_and_spread
from latentds import TubeDS, datasets, plotting

EVERY = (*RIVALS, *SDS_EF)
ORBITS, RING = 12, 0.3
"""Starts of DMP's orbits, and how far they are from the demonstrated one, in sizes."""


def framework(_: Study, found: Document) -> None:
    shown = datasets.unstable_spiral(7)
    ds = greedy("Chebyshev", TABLE_ONE["Chebyshev"][shown.name])(3).fit(shown)
    caption = "The paper's framework: from a demonstration to the mapped points"
    found.show("framework", figures.framework(shown, ds), caption)


def table_one(_: Study, found: Document) -> None:
    found.add(
        "Greedy matching at the paper's own hyperparameters, N = 1000 points; MSE is the mean over all N·n entries. "
        "The paper prints ten cells, for the unstable spirals."
    )
    lines = measurements.table_one()
    found.table(
        ["spiral", "method", "β", "μ", "M", "paper", "ours", "ratio", "verdict"],
        (
            [
                *(one["spiral"], one["method"], *(f"{value:g}" for value in one["paper"][:3])),
                *(f"{one['paper'].mse:.2e}", f"{one['ours']:.2e}", f"{one['ratio']:.2f}"),
                verdicts.similar(one["ratio"]),
            ]
            for one in _each(lines)
        ),
    )
    found.find(verdicts.table_one(lines))


def tuned(study: Study, found: Document) -> None:
    grid = study.plan.grid
    found.add(
        f"The grid is {len(grid.betas)} β × {len(grid.mus)} μ × {len(grid.n_layers)} M. The rule, as the paper words "
        "it: the fewest layers with a normalised MSE below 1e-5; among those with the same M the least β *or* the "
        "least MSE (both are shown); if none gets there, the least MSE. *Normalised* we read as: divided by the square "
        'of half the largest extent, so that the spirals, of radius 1, keep the MSE that Table I prints. "Unless '
        'having slightly more diffeomorphisms significantly reduced MSE" names no number and is not applied. '
        f"TPE: {grid.n_more} trials of Optuna's sampler between the grid's values; the last column is the rule's M "
        "over both.",
        "Each cell is β / μ / M: MSE.",
    )
    lines = measurements.tuned(study)
    found.table(
        ["spiral", "method", "paper", "ours, least β", "ours, least MSE", "M with TPE"],
        (
            [one["spiral"], one["method"], _brief(one["paper"]) if one["paper"] else "none printed"]
            + [_brief(tuning.setting(chosen)) for chosen in one["choice"][:2]]
            + [str(one["with TPE"])]
            for one in _each(lines)
        ),
    )
    tried = [one for one in study.tried("Chebyshev", datasets.unstable_spiral(7))[0] if one.n_layers == 75]
    drawn = figures.heat_map(tried, 75, "Chebyshev on unstable c=7, M = 75")
    found.show("heat_map", drawn, "MSE over μ and β at M = 75 (the paper's heat map)")
    found.find(verdicts.tuned(lines), verdicts.heat_map({(one.beta, one.mu): one.mse for one in tried}))


def latent(_: Study, found: Document) -> None:
    frame, spectrum = latent_space.embedding(), latent_space.spectrum()
    slopes = {n: latent_space.slope(frame, n, "entry") for n in latent_space.DIMS if n > 2}
    caption = "Proposition 5: the columns differ by O(1/N), not O(1/N²)"
    found.show("linearity", figures.linearity(frame, slopes), caption)
    found.add(
        f"N = {min(latent_space.COUNTS)} … {max(latent_space.COUNTS)}; k is the exponent of N^k, fitted on log scales. "
        "The paper claims k = −2. *λ / bound*: the largest eigenvalue over Lemma 3's bound 2(1 − cos(π/N)). *Spacing "
        "grows* from the goal, where the eigenvectors begin, towards the start."
    )
    names = {
        "entry": "entries",
        "norm": "‖u^l − u^m‖₂, u₁ = 1",
        "unit": "‖u^l − u^m‖₂, ‖u‖₂ = 1",
        "bend": "distance from the line",
    }
    lines = []
    for n in latent_space.DIMS:
        of = frame[frame["n"] == n]
        measured = [f"{latent_space.slope(frame, n, key):.3f}" if n > 2 else "equal" for key in names]
        held = ["yes" if of[key].all() else "no" for key in ("monotone", "spacing")]
        limits = f"{of['limit'].min():.3f} … {of['limit'].max():.3f}"
        lines.append([str(n), *measured, *held, f"{of['bound'].max():.3f}", limits])
    measured = [f"k of {name}" for name in names.values()]
    found.table(["n", *measured, "monotone", "spacing grows", "λ / bound", "λN² / (π²/4)"], lines)
    found.add(
        f"Eigenvalues of the explicit Laplacian of {latent_space.PATH} nodes a path, K = n+1. Proposition 2's Λ counts "
        "pairs of equal blocks; each pair repeats one eigenvalue per node."
    )
    found.table(
        [
            *("n", "K", "Λ, paper", "distinct eigenvalues of multiplicity 2", "per node"),
            "repeated among the n smallest > 0",
        ],
        ([f"{value:g}" for value in one.values()] for one in _each(spectrum)),
    )
    found.find(*verdicts.columns(frame), *verdicts.eigenvalues(spectrum))


def planes(study: Study, found: Document) -> None:
    lines, drawn, fitted = measurements.planes(study)
    found.add(
        "The Archimedean spiral and strokes of our own drawing"
        + (", and characters of the LASA handwriting data (not drawn here)" if len(lines) > len(drawn) else "")
        + ", hyperparameters by the paper's rule with the least β. 20 starts within "
        f"{measurements.NEAR:g} sizes of the motion; DTW per point in sizes of the motion. *Attractor off by* is the "
        "distance of ψ(x_N), the paper's attractor, from the goal, in sizes: with ours it is 0."
    )
    columns = [f"{m}{what}" for m in RIVALS for what in (", β / μ / M: MSE", ", exact DTW", ", attractor off by")]
    told = []
    for one in _each(lines):
        cells = ([_brief(one["chosen"][m]), f"{one[m].mean():.4f}", f"{one[f'{m} off']:.1e}"] for m in RIVALS)
        told.append([one["motion"], *(cell for some in cells for cell in some), f"{one['p']:.1e}"])
    found.table(["motion", *columns, "p"], told)
    caption = "Rollouts (thrice the duration) and vector fields, Chebyshev and FDM"
    found.show("planes", figures.planes(drawn, fitted), caption)
    found.find(verdicts.planes(lines))


def joints(study: Study, found: Document) -> None:
    lines, shown, outcomes = measurements.joints(study)
    found.add(
        "The paper's six recordings are not public, so its scores cannot be reproduced; "
        + (
            f"these are {len(shown)} recordings given by `--data`."
            if study.recorded
            else "made-up motions of a 7-joint arm stand in."
        )
        + " Hyperparameters by the paper's rule with the least β; FastDTW (radius 1) of 500 points, raw sums in rad, "
        "from the demonstrated start. The paper names neither the number of points nor the unit."
    )
    printed = [f"{case}: {score}" for case, score in TABLE_THREE.items()] + ["—: nan"] * len(shown)
    told = []
    for one, paper in zip(_each(lines), printed, strict=False):
        ours, fdm = ([f"{one[f'{m} {score}']:.2f}" for score in ("dtw_fast", "dtw")] for m in RIVALS)
        told.append([one["motion"], paper, *ours, _brief(one["chosen"]["Chebyshev"]), *fdm])
    header = ["motion", "paper's case (another motion)", "Chebyshev, FastDTW", "exact", "β / μ / M: MSE"]
    found.table([*header, "FDM, FastDTW", "exact"], told)
    worst = shown[int(lines["Chebyshev dtw_fast"].argmax())]
    for motion in dict.fromkeys((shown[0], worst)):
        drawn = plotting.joints(motion, paths(outcomes, motion.name, RIVALS))
        found.show(f"joints_{motion.name.replace(' ', '_')}", drawn, f"{motion.name}: joints over time")
    found.find(verdicts.joints(lines, bool(study.recorded)))


def sensitivity(study: Study, found: Document) -> None:
    lines = measurements.sensitivity(study)
    found.add(
        "What the paper leaves open, changed one at a time: mean DTW over the 20 starts, which method is nearer, and p "
        "(Welch). A scale that is the same for all scores of a spiral changes neither, so only other normalisations "
        "and other distances are listed. *Decoupled*: the latent point is drawn to the axis at κ per duration instead "
        "of keeping its direction. With ψ(x_N) the attractor is the paper's, off the goal; with "
        "x* = ψ⁻¹(y*) it is exact, but far from the end of the latent line where ψ is badly conditioned."
    )
    found.table(
        ["spiral", "change", *RIVALS, "nearer", "p"],
        (
            [one["spiral"], one["change"], *(mean_and_spread(one[m]) for m in RIVALS), one["nearer"], f"{one['p']:.1e}"]
            for one in _each(lines)
        ),
    )
    found.find(verdicts.sensitivity(lines))


def similarity(study: Study, found: Document) -> None:
    fast, exact = study.scores("dtw_fast"), study.scores("dtw")
    lines = measurements.similarity(fast, exact)
    found.add(
        "From 20 starts, uniform in a ball of radius 0.1 around the demonstrated one, the same for every method; 500 "
        "points over the demonstration's duration. Chebyshev and FDM have the paper's hyperparameters where it prints "
        "them, else its rule's with the least β. SDS-EF official: its authors' recipe; SDS-EF: our tuned one. "
        '*Normalised* we read as the caption\'s "case-wise": all scores of a spiral divided by the largest of its '
        "means. No such scale changes an order or a p-value."
    )
    drawn = figures.normalised_bars(fast, "FastDTW, mean and standard deviation")
    found.show("dtw", drawn, "The paper's DTW bars; × did not finish")
    found.add("Each cell is mean FastDTW · mean exact DTW, raw sums.")
    found.table(
        ["spiral", *EVERY, "p, FastDTW", "p, exact", "p paired, exact"],
        (
            [name, *(f"{mean_and_spread(fast[name][m])} · {mean_and_spread(exact[name][m])}" for m in EVERY)]
            + [f"{one[key]:.1e}" for key in ("fast", "exact", "paired")]
            for name, one in zip(fast, _each(lines), strict=True)
        ),
    )
    drawn = figures.p_values(lines.rename(columns={"fast": "p"}))
    found.show("p_values", drawn, "p of Welch's t-test, coloured by the nearer method")
    found.find(*verdicts.similarity(lines))
    _by_the_rule(study, found)
    _parameters(study, found)


def _by_the_rule(study: Study, found: Document) -> None:
    near = study.rows[study.rows["start"] > 0]
    means = near.groupby(["demonstration", "method"])["dtw"].agg(lambda scores: scores.mean(skipna=False))
    labels = [f"{method}{which}" for method in RIVALS for which in ("", ", least β", ", least MSE")]
    found.add(
        "### The same with hyperparameters by the paper's rule",
        "Mean exact DTW. The rule looks at MSE alone, which says little of the rollout from a perturbed start.",
    )
    found.table(["spiral", *labels], ([d.name, *(f"{means[d.name, m]:.2f}" for m in labels)] for d in study.spirals))


def _parameters(study: Study, found: Document) -> None:
    lines = measurements.parameters(study)
    found.add(
        "### Parameters at similar accuracy",
        "Chebyshev and FDM: layers · parameters, 2n+1 a layer, that the rule needs for a normalised MSE below 1e-5. "
        "SDS-EF: learned parameters of the models above.",
    )
    told = []
    for one in _each(lines):
        counts = [f"{one[m]} · {one[m] * one['a layer']}{'' if one[f'{m} good'] else ' (above 1e-5)'}" for m in RIVALS]
        told.append([one["spiral"], *counts, *(str(one[method]) for method in SDS_EF)])
    found.table(["spiral", *EVERY], told)
    found.find(verdicts.parameters(lines))


def table_two(study: Study, found: Document) -> None:
    plan = study.plan
    found.add(
        "SDS-EF by its authors' recipe: 70 % of the points to train on, the MSE of the velocities at the other 30 %, "
        "drawn at random. The paper names neither units nor recipe; ours are the demonstration's, per coordinate."
        + ("" if plan.printed else " **Quick: a small model instead of the printed sizes.**"),
        f"Each cell is L / n_f: test MSE; the grid is L in {plan.layers}, n_f in {plan.features}, {plan.epochs} epochs "
        f"a trial (the middle column: up to {plan.official_epochs}). The last column is the length of the rollout from "
        "the demonstrated start over the demonstration's: far below 1 the motion takes a shortcut that no MSE shows.",
    )
    lines = measurements.table_two(study)
    found.table(
        ["spiral", "paper", "ours", "verdict", "our grid's best", "path length"],
        (
            [
                *(one["spiral"], _sized(one["paper"]) if one["paper"] else "none printed"),
                _sized(one["ours"]),
                "—" if np.isnan(one["ratio"]) else verdicts.similar(one["ratio"]),
                *(_sized(one["best"]), f"{one['path length']:.2f}"),
            ]
            for one in _each(lines)
        ),
    )
    found.find(verdicts.table_two(lines))


def replications(study: Study, found: Document) -> None:
    for name in ("unstable c=7", "stable c=3"):
        drawn = plotting.replications(compared.spiral(name), paths(study.outcomes, name, EVERY))
        caption = f"{name}: rollouts from the demonstrated and 20 other starts"
        found.show(name.replace(" ", "_").replace("=", ""), drawn, caption)
    found.find(verdicts.replications())


def orbits(_: Study, found: Document) -> None:
    shown, dmp = datasets.drawn("curl"), DMP(2)
    turns = 2 * np.pi * np.arange(ORBITS) / ORBITS
    around = RING * shown.size * np.stack([np.cos(turns), np.sin(turns)], axis=1)
    drawn, counts = figures.orbits(
        shown, {"DMP": dmp.fit(shown), "TubeDS": TubeDS(2).fit(shown)}, shown.start + torch.from_numpy(around)
    )
    found.add(
        "The paper shows orbits of a DMP that cross each other, without its parameters. Ours: the stroke "
        f"{shown.name!r} of our own drawing, {dmp.n_basis} basis functions, α_z = {STIFFNESS:g}, β_z = α_z / 4, "
        f"α_x = {FADING:.3g}; {ORBITS} starts {RING:g} sizes around the demonstrated one. A DMP's force follows a "
        "clock, so that one place has as many velocities as motions come by; orbits of an autonomous system, such "
        "as TubeDS, cannot cross. Crossings at less than 10° are not counted, nor those within 0.05 sizes of the goal."
    )
    found.show("dmp_orbits", drawn, f"{shown.name}: motions of a DMP and of TubeDS from the same {ORBITS} starts")
    found.find(verdicts.orbits(counts))


def left_out(_: Study, found: Document) -> None:
    missing = {
        "Light paintings, robot runs": "needs the robot; the motions are the same systems as above",
        "End-effector paths of the kinesthetic cases": "the recordings are not public",
    }
    found.table(["what", "why"], missing.items())
    found.find(*verdicts.left_out(missing))


STEPS: dict[str, Callable[[Study, Document], None]] = {
    "The framework": framework,
    "Table I: the paper's hyperparameters": table_one,
    "Tuning by the paper's rule": tuned,
    "Claims about the latent space": latent,
    "Two dimensions: Archimedean spiral and drawn characters": planes,
    "Joint space, Table III": joints,
    "Sensitivity": sensitivity,
    "Similarity scores and p-values": similarity,
    "Table II: SDS-EF": table_two,
    "Replications": replications,
    "DMP's forward orbits": orbits,
    "What is left out": left_out,
}


def _each(lines: pd.DataFrame) -> Iterable[dict[str, Any]]:
    return lines.to_dict("records")  # type: ignore[return-value]


def _brief(setting: Setting) -> str:
    return f"{setting.beta:g} / {setting.mu:g} / {setting.n_layers}: {setting.mse:.1e}"


def _sized(size: Size) -> str:
    return f"{size.n_layers} / {size.n_features}: {size.mse:.2e}"
