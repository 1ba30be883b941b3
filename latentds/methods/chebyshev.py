"""ChebyshevDS, the paper's method: a Laplacian eigenmap as latent space, matched greedily to the demonstration."""

from __future__ import annotations

import numpy as np
import torch

from ..arguments import Array
from ..demonstration import Demonstration
from ..fitting.embedding import chebyshev_columns, map_to_endpoints, neighbour_columns
from ..time_law import ChebyshevLaw, KnottedLaw, TimeLaw
from .greedy import BETA, MU, GreedyDS

EMBEDDINGS = ("path", "neighbours")


class ChebyshevDS(GreedyDS):
    """Stable motion from one demonstration on the Chebyshev embedding (Gupta, Nayak and Billard).

    The latent points are the entries of the eigenvectors of the demonstration graph's Laplacian (paper, eq. 25),
    reversed and laid from the demonstrated start to its goal; ψ maps them onto the demonstration by greedy locally
    weighted translations; the latent point moves by the eigenmap's own law. Unlike the paper's, the attractor is
    exact.

    Args:
        dim: n >= 1.
        embedding: "path" for the paper's graph, a path in which only the order of samples counts; "neighbours" for that
            of Belkin and Niyogi, which sees where they lie (:func:`latentds.fitting.embedding.neighbour_columns`). The
            latent point then moves by the law that brings it to each latent point in time, and a motion that comes near
            itself is refused where a short cut of its graph turns the latent points back.
        n_layers, beta, mu, steps, refined, pinned: as for :class:`~latentds.methods.greedy.GreedyDS`.
    """

    def __init__(
        self,
        dim: int,
        *,
        n_layers: int | None = 150,
        beta: float = BETA,
        mu: float = MU,
        steps: int = 1,
        refined: bool = False,
        pinned: bool = True,
        embedding: str = "path",
    ) -> None:
        if embedding not in EMBEDDINGS:
            raise ValueError(f"embedding: expected one of {', '.join(EMBEDDINGS)}, got {embedding!r:.80}")
        super().__init__(dim, n_layers=n_layers, beta=beta, mu=mu, steps=steps, refined=refined, pinned=pinned)
        self.embedding = embedding
        if embedding == "neighbours":
            self.dynamics.law = KnottedLaw.uniform()

    @staticmethod
    def latent_line(shown: Demonstration) -> Array:
        columns = chebyshev_columns(len(shown), shown.dim)[::-1]
        return map_to_endpoints(columns, shown.start.numpy(), shown.goal.numpy())

    @staticmethod
    def time_law(duration: float) -> ChebyshevLaw:
        return ChebyshevLaw(duration)

    def _embedded(self, motion: Demonstration) -> tuple[Array, TimeLaw]:
        if self.embedding == "path":
            return super()._embedded(motion)
        points = motion.positions.numpy()
        latent = map_to_endpoints(neighbour_columns(points), points[0], points[-1])
        away = np.linalg.norm(latent - latent[-1], axis=1) / np.linalg.norm(latent[0] - latent[-1])
        back = np.flatnonzero(np.diff(away) >= 0)
        if len(back):
            raise ValueError(
                "demonstration: expected a motion whose neighbours embed it on a way to its goal, got one whose latent "
                f"points turn back at {len(back)} of {len(points)} samples, where it comes near itself; "
                "embedding='path' does not see that"
            )
        return latent, KnottedLaw.from_timing(torch.from_numpy(away), motion.times)
