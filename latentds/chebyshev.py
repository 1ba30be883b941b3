"""ChebyshevDS, the paper's method: a Laplacian eigenmap as latent space, matched greedily to the demonstration."""

from __future__ import annotations

from collections.abc import Sequence

from .arguments import number_in, whole_number
from .base import LatentDS
from .demonstration import Demonstration, only_demonstration
from .diffeomorphism import LocallyWeightedTranslations
from .embedding import chebyshev_columns, place
from .matching import PINS, settle
from .time_law import ChebyshevLaw, RayDynamics


class ChebyshevDS(LatentDS):
    """Stable motion from one demonstration on the Chebyshev embedding (Gupta, Nayak and Billard).

    The latent points are the entries of the eigenvectors of the demonstration graph's Laplacian (paper, eq. 25),
    reversed and laid from the demonstrated start to its goal; ψ maps them onto the demonstration by greedy locally
    weighted translations; the latent point moves by the eigenmap's own law. Unlike the paper's, the attractor is
    exact.

    Args:
        dim: n >= 1.
        n_layers: M >= 1. The paper's Table I uses 50 to 750.
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
        super().__init__(dim, psi, RayDynamics(dim, ChebyshevLaw()))
        self.beta = number_in(beta, "beta", 0, 1, ends="(]")
        self.mu = number_in(mu, "mu", 0, 1)
        self.steps = whole_number(steps, "steps", at_least=1)
        self.refined = bool(refined)
        self.pinned = bool(pinned)

    def fit(self, demonstration: Demonstration | Sequence[Demonstration], *, progress: bool = False) -> ChebyshevDS:
        shown = only_demonstration(demonstration, self.dim, "ChebyshevDS")
        columns = chebyshev_columns(len(shown), self.dim)[::-1]
        latent = place(columns, shown.start.numpy(), shown.goal.numpy())
        law = ChebyshevLaw(shown.duration)
        settle(self, latent, shown, law, self.beta, self.mu, self.steps, self.refined, self.pinned)
        return self
