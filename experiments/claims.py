"""What the paper says of its latent space, measured; and what it leaves open, varied."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray

from baselines import FDM
from experiments.spirals import Setting
from latentds import ChebyshevDS, Demonstration, datasets
from latentds.base import LatentDS
from latentds.benchmark import Cell
from latentds.dynamics import RayDynamics, TubeDynamics
from latentds.fitting.embedding import chebyshev_columns, chebyshev_eigenvalues, map_to_endpoints
from latentds.time_law import PiecewiseLinearLaw

Array = NDArray[np.float64]

DIMS = (2, 3, 4, 5, 6, 7)
COUNTS = (100, 200, 400, 800, 1600, 2000)
PATH = 60
"""Nodes a path of the explicit Laplacian."""
KINDS = {"Chebyshev": ChebyshevDS, "FDM": FDM}


# --- the latent space -------------------------------------------------------------------------------------------------


def embedding(dims: Sequence[int] = DIMS, counts: Sequence[int] = COUNTS) -> pd.DataFrame:
    """One row per n and N: how far the columns lie apart, how bent their curve is, and what the lemmas say of them.

    ``entry``: the largest difference of two columns' entries where both begin with 1; ``norm``: of their vectors;
    ``unit``: of vectors scaled to length 1; ``bend``: the largest distance of the placed points from the straight line,
    in its lengths; ``bound``: the largest λ over Lemma 3's bound; ``limit``: λN² over π²/4.
    """
    rows = []
    for n in dims:
        for count in counts:
            columns, eigenvalues = chebyshev_columns(count, n), chebyshev_eigenvalues(count, n)
            units = columns / np.linalg.norm(columns, axis=0)
            gaps = columns[:, :, None] - columns[:, None, :]
            placed = map_to_endpoints(columns, np.zeros(n), np.ones(n))
            aside = placed - placed.mean(axis=1, keepdims=True)
            steps = np.diff(columns, axis=0)
            rows.append(
                {
                    "n": n,
                    "N": count,
                    "entry": np.abs(gaps).max(),
                    "norm": np.linalg.norm(gaps, axis=0).max(),
                    "unit": np.linalg.norm(units[:, :, None] - units[:, None, :], axis=0).max(),
                    "bend": np.linalg.norm(aside, axis=1).max() / np.sqrt(n),
                    "monotone": bool((steps < 0).all()),
                    "spacing": bool((np.diff(np.abs(steps), axis=0) > 0).all()),
                    "bound": (eigenvalues / (2 * (1 - np.cos(np.pi / count)))).max(),
                    "limit": (eigenvalues * count**2 / (np.pi**2 / 4)).min(),
                }
            )
    return pd.DataFrame(rows)


def slope(frame: pd.DataFrame, n: int, column: str) -> float:
    """k of column ~ N^k in dimension n, fitted on log scales."""
    chosen = frame[frame["n"] == n]
    return float(np.polyfit(np.log(chosen["N"]), np.log(chosen[column]), 1)[0])


def laplacian(count: int, n: int) -> Array:
    """Of K = n+1 copies of a path of ``count`` nodes, their last nodes in a cycle: (NK, NK)."""
    copies = n + 1
    nodes = np.arange(copies * count).reshape(copies, count)
    edges = [*zip(nodes[:, :-1].ravel(), nodes[:, 1:].ravel(), strict=True)]
    edges += [*zip(nodes[:, -1], np.roll(nodes[:, -1], -1), strict=True)]
    found = np.zeros((nodes.size, nodes.size))
    for a, b in edges:
        found[a, b] = found[b, a] = -1
    np.fill_diagonal(found, -found.sum(axis=1))
    return found


def spectrum(dims: Sequence[int] = DIMS, count: int = PATH) -> pd.DataFrame:
    """Repeated eigenvalues of the explicit Laplacian beside Prop. 2; how many of the n smallest above 0 repeat."""
    rows = []
    for n in dims:
        values = np.linalg.eigvalsh(laplacian(count, n))
        times = np.array([(np.abs(values - value) < 1e-9).sum() for value in values])
        copies = n + 1
        rows.append(
            {
                "n": n,
                "K": copies,
                "paper": copies // 2 - 1 if copies % 2 == 0 else (copies - 1) // 2,
                "distinct": int((times == 2).sum() // 2),
                "per node": (times == 2).sum() / 2 / count,
                "of the n smallest": int((times[1 : n + 1] == 2).sum()),
            }
        )
    return pd.DataFrame(rows)


# --- what the paper leaves open ---------------------------------------------------------------------------------------


PINNED, PRINTED = "pinned", "ψ(x_N)"
"""Attractors of a :class:`Variant`: ours and the paper's."""


class Variant(LatentDS):
    """ChebyshevDS or FDM with another latent motion, or with another attractor.

    Args:
        contraction: κ of the decoupled form ṗ = -κp, per duration; None keeps the ray.
        attractor: "pinned", ours; "ψ⁻¹(y*)", exact too but without pins; or the paper's, "ψ(x_N)", off the goal.
    """

    def __init__(
        self, dim: int, kind: type[ChebyshevDS] | type[FDM], setting: Setting, contraction: float | None, attractor: str
    ) -> None:
        pinned = attractor == PINNED
        greedy = kind(dim, n_layers=setting.n_layers, beta=setting.beta, mu=setting.mu, pinned=pinned)
        pull = PiecewiseLinearLaw(torch.ones(1), torch.ones(1))
        law = PiecewiseLinearLaw.uniform()
        dynamics = greedy.dynamics if contraction is None else TubeDynamics(dim, law, pull)
        super().__init__(dim, greedy.diffeomorphism, dynamics)
        self.greedy, self.contraction, self.printed = greedy, contraction, attractor == PRINTED

    def fit(self, demonstration: Demonstration | Sequence[Demonstration], *, progress: bool = False) -> Variant:
        assert isinstance(demonstration, Demonstration)
        self.greedy.fit(demonstration)
        self.fit_report = self.greedy.fit_report
        dynamics = self.dynamics
        assert isinstance(dynamics, (RayDynamics, TubeDynamics))
        assert isinstance(self.greedy.dynamics, RayDynamics)
        dynamics.law = self.greedy.dynamics.law
        if isinstance(dynamics, TubeDynamics):
            rate = torch.tensor([self.contraction / demonstration.duration])
            dynamics.transverse_law = PiecewiseLinearLaw(torch.ones(1), rate)
        with torch.no_grad():
            # The latent line runs from the start to the goal themselves, so x_N is the goal.
            attractor = demonstration.goal if self.printed else self.encode(demonstration.goal)
            dynamics.set_endpoints(self.encode(demonstration.start), attractor)
            self.attractor.copy_(self.decode(attractor))
        return self


class Change(NamedTuple):
    """One thing done otherwise than in the main tables; ``stable_only`` changes nothing for the other spirals."""

    name: str
    n_points: int = 1000
    slowest: float = 1e-2
    contraction: float | None = None
    attractor: str = PINNED
    stable_only: bool = False


CHANGES = (
    Change("as reported"),
    Change("N = 250", n_points=250),
    Change("N = 500", n_points=500),
    Change("N = 2000", n_points=2000),
    Change("stop at speed .1", slowest=1e-1, stable_only=True),
    Change("stop at speed .001", slowest=1e-3, stable_only=True),
    Change("decoupled, κ = 5", contraction=5.0),
    Change("decoupled, κ = 20", contraction=20.0),
    Change("not pinned, x* = ψ⁻¹(y*)", attractor="ψ⁻¹(y*)"),
    Change("not pinned, attractor ψ(x_N)", attractor=PRINTED),
)


def spiral(name: str, n_points: int = 1000, slowest: float = 1e-2) -> Demonstration:
    """The spiral of that name, "unstable c=7"."""
    family, c = name.split(" c=")
    if family == "unstable":
        return datasets.unstable_spiral(float(c), n_points)
    return datasets.stable_spiral(float(c), n_points, slowest=slowest)


def sensitivity_cells(settings: dict[str, dict[str, Setting]]) -> list[Cell]:
    """A cell per change, spiral and method; ``settings`` is {spiral: {method: its hyperparameters}}."""
    cells = []
    for name, of_method in settings.items():
        for change in CHANGES:
            if change.stable_only and not name.startswith("stable"):
                continue
            shown = spiral(name, change.n_points, change.slowest)
            for method, setting in of_method.items():
                cells.append(variant_cell(method, setting, change, shown))
    return cells


def variant_cell(method: str, setting: Setting, change: Change, shown: Demonstration) -> Cell:
    return Cell(
        f"{method} | {change.name}",
        lambda dim: Variant(dim, KINDS[method], setting, change.contraction, change.attractor),
        shown,
    )
