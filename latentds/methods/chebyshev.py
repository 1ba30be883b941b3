"""ChebyshevDS, the paper's method: a Laplacian eigenmap as latent space, matched greedily to the demonstration."""

from __future__ import annotations

from ..arguments import Array
from ..demonstration import Demonstration
from ..fitting.embedding import chebyshev_columns, map_to_endpoints
from ..time_law import ChebyshevLaw
from .greedy import GreedyDS


class ChebyshevDS(GreedyDS):
    """Stable motion from one demonstration on the Chebyshev embedding (Gupta, Nayak and Billard).

    The latent points are the entries of the eigenvectors of the demonstration graph's Laplacian (paper, eq. 25),
    reversed and laid from the demonstrated start to its goal; ψ maps them onto the demonstration by greedy locally
    weighted translations; the latent point moves by the eigenmap's own law. Unlike the paper's, the attractor is
    exact. The arguments are those of :class:`~latentds.methods.greedy.GreedyDS`.
    """

    @staticmethod
    def latent_line(shown: Demonstration) -> Array:
        columns = chebyshev_columns(len(shown), shown.dim)[::-1]
        return map_to_endpoints(columns, shown.start.numpy(), shown.goal.numpy())

    @staticmethod
    def time_law(duration: float) -> ChebyshevLaw:
        return ChebyshevLaw(duration)
