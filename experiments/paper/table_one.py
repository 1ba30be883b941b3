"""Table I: greedy matching at the paper's hyperparameters, tuning by its rule, and its heat map of the MSE."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from experiments.compared import RIVALS, spiral
from experiments.paper import tuning
from experiments.paper.document import DPI, IN_PART, NO_NUMBERS, REPRODUCED, Document, similar, span
from experiments.paper.study import Study, brief, setting
from experiments.published import TABLE_ONE
from latentds import datasets
from latentds.fitting.tuning import choose

PRINTED = [cell for of in TABLE_ONE.values() for cell in of.values()]


def table_one(_: Study, document: Document) -> None:
    document.add(
        "Greedy matching at the paper's own hyperparameters, N = 1000 points; MSE is the mean over all N·n entries. "
        "The paper prints ten cells, for the unstable spirals."
    )
    lines, ratios = [], []
    for name in TABLE_ONE["Chebyshev"]:
        for method in RIVALS:
            paper = TABLE_ONE[method][name]
            ours = tuning.trace(method, spiral(name), paper.beta, paper.mu, [paper.n_layers])[0]
            ratios.append(ours / paper.mse)
            numbers = [*(f"{value:g}" for value in paper[:3]), f"{paper.mse:.2e}", f"{ours:.2e}", f"{ratios[-1]:.2f}"]
            lines.append([name, method, *numbers, similar(ratios[-1])])
    document.table(["spiral", "method", "β", "μ", "M", "paper", "ours", "ratio", "verdict"], lines)
    document.find(
        f"Table I at its own hyperparameters ({len(lines)} cells)",
        f"MSE {span(cell.mse for cell in PRINTED)}",
        f"{min(ratios):.2f} to {max(ratios):.2f} times the paper's",
        similar(*ratios),
    )


def tuned(study: Study, document: Document) -> None:
    grid = study.plan.grid
    document.add(
        f"The grid is {len(grid.betas)} β × {len(grid.mus)} μ × {len(grid.n_layers)} M. The rule, as the paper words "
        "it: the fewest layers with a normalised MSE below 1e-5; among those with the same M the least β *or* the "
        "least MSE (both are shown); if none gets there, the least MSE. *Normalised* we read as: divided by the square "
        'of half the largest extent, so that the spirals, of radius 1, keep the MSE that Table I prints. "Unless '
        'having slightly more diffeomorphisms significantly reduced MSE" names no number and is not applied. '
        f"TPE: {grid.n_more} trials of Optuna's sampler between the grid's values; the last column is the rule's M "
        "over both.",
        "Each cell is β / μ / M: MSE. For stable spirals the paper prints none.",
    )
    lines, as_few = [], []
    for shown in study.spirals:
        for method in RIVALS:
            on_grid, by_tpe = study.tried(method, shown)
            choice, paper = choose(on_grid), TABLE_ONE[method].get(shown.name)
            if paper:
                as_few.append(choice.good and choice.least_mse.n_layers <= paper.n_layers)
                chosen = [brief(setting(tried)) for tried in choice[:2]]
                more = choose([*on_grid, *by_tpe]).least_mse.n_layers
                lines.append([shown.name, method, brief(paper), *chosen, str(more)])
    document.table(["spiral", "method", "paper", "ours, least β", "ours, least MSE", "M with TPE"], lines)
    at_75 = [tried for tried in study.tried("Chebyshev", datasets.unstable_spiral(7))[0] if tried.n_layers == 75]
    errors = {(tried.beta, tried.mu): tried.mse for tried in at_75}
    drawn = heat_map(errors, "Chebyshev on unstable c=7, M = 75")
    document.show("heat_map", drawn, "MSE over μ and β at M = 75 (the paper's heat map)")
    layers, fewer = [cell.n_layers for cell in PRINTED], sum(as_few)
    (beta, mu), least = min(errors.items(), key=lambda item: item[1])
    document.find(
        "Tuning by the paper's rule",
        f"M from {min(layers)} to {max(layers)}",
        f"as few layers as the paper's or fewer in {fewer} of {len(as_few)} cells",
        REPRODUCED if fewer == len(as_few) else IN_PART if fewer else "worse",
    )
    ours = f"MSE {least:.1e} (β {beta:g}, μ {mu:g}) to {max(errors.values()):.1e}"
    document.find("Heat map at M = 75, c = 7", "a figure without numbers", ours, NO_NUMBERS)


def heat_map(errors: Mapping[tuple[float, float], float], title: str) -> Figure:
    """MSE over (μ, β); of {(β, μ): MSE}."""
    betas, mus = (sorted({key[i] for key in errors}) for i in (0, 1))
    table = np.array([[errors[beta, mu] for mu in mus] for beta in betas])
    figure = Figure(figsize=(2.4 + 0.72 * len(mus), 1.8 + 0.42 * len(betas)), dpi=DPI, layout="constrained")
    axes = figure.add_subplot()
    norm = LogNorm(table.min(), table.max())
    image = axes.imshow(table, origin="lower", aspect="auto", cmap="viridis", norm=norm)
    for (row, column), value in np.ndenumerate(table):
        shade = "white" if norm(value) < 0.6 else "black"
        axes.text(column, row, f"{value:.0e}", ha="center", va="center", fontsize=8, color=shade)
    axes.set_xticks(range(len(mus)), [f"{mu:g}" for mu in mus])
    axes.set_yticks(range(len(betas)), [f"{beta:g}" for beta in betas])
    axes.set(xlabel="μ", ylabel="β", title=title)
    figure.colorbar(image, label="MSE per coordinate")
    return figure
