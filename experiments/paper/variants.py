"""What the paper leaves open, done otherwise: sampling, the latent motion, the attractor."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch

from experiments.compared import greedy, spiral
from experiments.published import Setting
from latentds import Demonstration
from latentds.base import LatentDS, Learned
from latentds.benchmark import Cell
from latentds.demonstration import only_one
from latentds.dynamics import RayDynamics, TubeDynamics
from latentds.methods.greedy import GreedyDS
from latentds.time_law import PiecewiseLinearLaw


class Variant(LatentDS):
    """ChebyshevDS or FDM with another latent motion, or with another attractor.

    Args:
        base: what it is otherwise.
        contraction: κ of the decoupled form ṗ = -κp, per duration; None keeps the ray.
        printed: whether the attractor is the paper's, ψ(x_N), off the goal; its pins would hide that.
    """

    dynamics: RayDynamics | TubeDynamics

    def __init__(self, base: GreedyDS, *, contraction: float | None = None, printed: bool = False) -> None:
        super().__init__(base.dim, base.diffeomorphism, base.dynamics)
        self.base, self.contraction, self.printed = base, contraction, printed

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        motion = only_one(shown, "Variant")
        learned = self.base._learn(shown, progress)
        if self.contraction is not None:
            across = PiecewiseLinearLaw(torch.ones(1), torch.tensor([self.contraction / motion.duration]))
            self.dynamics = TubeDynamics(self.base.dynamics.law, across)
        with torch.no_grad():
            # The latent line runs from the start to the goal themselves, so x_N is the goal.
            self.attractor.copy_(self.decode(motion.goal) if self.printed else motion.goal)
            self.start.copy_(motion.start)
        return learned


class Change(NamedTuple):
    """One thing done otherwise than in the main tables; ``stable_only`` changes nothing for the other spirals."""

    name: str
    n_points: int = 1000
    slowest: float = 1e-2
    contraction: float | None = None
    pinned: bool = True
    printed: bool = False
    stable_only: bool = False


CHANGES = (
    Change("as reported"),
    Change("N = 250", n_points=250),
    Change("N = 500", n_points=500),
    Change("N = 2000", n_points=2000),
    Change("stop at speed 0.1", slowest=1e-1, stable_only=True),
    Change("stop at speed 0.001", slowest=1e-3, stable_only=True),
    Change("decoupled, κ = 5", contraction=5.0),
    Change("decoupled, κ = 20", contraction=20.0),
    Change("not pinned, x* = ψ⁻¹(y*)", pinned=False),
    Change("not pinned, attractor ψ(x_N)", pinned=False, printed=True),
)


def cells(settings: Mapping[str, Mapping[str, Setting]]) -> list[Cell]:
    """A cell per change, spiral and method; ``settings`` is {spiral: {method: its hyperparameters}}."""
    return [
        cell(method, chosen, change, spiral(name, change.n_points, change.slowest))
        for name, of_method in settings.items()
        for change in CHANGES
        if name.startswith("stable") or not change.stable_only
        for method, chosen in of_method.items()
    ]


def cell(method: str, chosen: Setting, change: Change, shown: Demonstration) -> Cell:
    def factory(dim: int) -> Variant:
        base = greedy(method, chosen, pinned=change.pinned)(dim)
        return Variant(base, contraction=change.contraction, printed=change.printed)

    return Cell(f"{method} | {change.name}", factory, shown)
