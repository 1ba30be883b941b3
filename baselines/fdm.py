"""FDM: a straight line, uniform in time, matched greedily to the demonstration."""

from __future__ import annotations

from collections.abc import Sequence

from latentds.arguments import number_in, whole_number
from latentds.base import LatentDS
from latentds.demonstration import Demonstration, only_demonstration
from latentds.diffeomorphism import LocallyWeightedTranslations
from latentds.embedding import place, straight_column
from latentds.matching import PINS, settle
from latentds.time_law import PiecewiseLinearLaw, RayDynamics


class FDM(LatentDS):
    """Fast diffeomorphic matching (Perrin and Schlehuber-Caissier 2016): ChebyshevDS with another latent line.

    Args:
        dim: n >= 1.
        n_layers: M >= 1.
        beta: β in (0, 1], the share of the largest error that a layer moves.
        mu: μ in (0, 1), how near to its invertibility bound a layer may come.
        steps: continuation steps of the matching; 1 is the paper's.
        refined: whether all layers are moved together by L-BFGS after the greedy match; the paper's are not.
        pinned: whether two more layers bring the ends of the latent line exactly onto start and goal. The paper's are
            off by about √MSE; without pins x* = ψ⁻¹(y*), which can lie far from the end of the line.
    """

    def __init__(
        self,
        dim: int,
        *,
        n_layers: int = 150,
        beta: float = 0.5,
        mu: float = 0.9,
        steps: int = 1,
        refined: bool = False,
        pinned: bool = True,
    ) -> None:
        self.n_layers = whole_number(n_layers, "n_layers", at_least=1)
        psi = LocallyWeightedTranslations(dim, self.n_layers + PINS * bool(pinned))
        super().__init__(dim, psi, RayDynamics(dim, PiecewiseLinearLaw.uniform()))
        self.beta = number_in(beta, "beta", 0, 1, ends="(]")
        self.mu = number_in(mu, "mu", 0, 1)
        self.steps = whole_number(steps, "steps", at_least=1)
        self.refined = bool(refined)
        self.pinned = bool(pinned)

    def fit(self, demonstration: Demonstration | Sequence[Demonstration], *, progress: bool = False) -> FDM:
        shown = only_demonstration(demonstration, self.dim, "FDM")
        latent = place(straight_column(len(shown)), shown.start.numpy(), shown.goal.numpy())
        law = PiecewiseLinearLaw.uniform(shown.duration)
        settle(self, latent, shown, law, self.beta, self.mu, self.steps, self.refined, self.pinned)
        return self
