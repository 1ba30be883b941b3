"""ChebyshevDS, the paper's method: a Laplacian eigenmap as latent space, matched greedily to the demonstration."""

from __future__ import annotations

from collections.abc import Sequence

from .arguments import number_in, whole_number
from .base import LatentDS
from .demonstration import Demonstration, only_demonstration
from .diffeomorphism import LocallyWeightedTranslations
from .embedding import chebyshev_columns, place
from .matching import settle
from .time_law import ChebyshevLaw, RayDynamics


class ChebyshevDS(LatentDS):
    """Stable motion from one demonstration on the Chebyshev embedding (Gupta, Nayak and Billard).

    The latent points are the entries of the eigenvectors of the demonstration graph's Laplacian (paper, eq. 25),
    reversed and laid from the demonstrated start to its goal; ψ maps them onto the demonstration by greedy locally
    weighted translations; the latent point moves by the eigenmap's own law. Unlike the paper's, the attractor is
    exact: x* = ψ⁻¹(y*), where ψ(x_N) misses y* by about √MSE.

    Args:
        dim: n >= 1.
        n_layers: M >= 1. The paper's Table I uses 50 to 750.
        beta: β in (0, 1], the share of the largest error that a layer moves.
        mu: μ in (0, 1), how near to its invertibility bound a layer may come.
        steps: continuation steps of the matching; 1 is the paper's.
        refined: whether all layers are moved together by L-BFGS after the greedy match; the paper's are not.
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
    ) -> None:
        super().__init__(dim, LocallyWeightedTranslations(dim, n_layers), RayDynamics(dim, ChebyshevLaw()))
        self.n_layers = self.diffeomorphism.n_layers
        self.beta = number_in(beta, "beta", 0, 1, ends="(]")
        self.mu = number_in(mu, "mu", 0, 1)
        self.steps = whole_number(steps, "steps", at_least=1)
        self.refined = bool(refined)

    def fit(self, demonstration: Demonstration | Sequence[Demonstration], *, progress: bool = False) -> ChebyshevDS:
        shown = only_demonstration(demonstration, self.dim, "ChebyshevDS")
        columns = chebyshev_columns(len(shown), self.dim)[::-1]
        latent = place(columns, shown.start.numpy(), shown.goal.numpy())
        law = ChebyshevLaw(shown.duration)
        settle(self, latent, shown, law, beta=self.beta, mu=self.mu, steps=self.steps, refined=self.refined)
        return self
