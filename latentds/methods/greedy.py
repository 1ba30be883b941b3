"""What the paper's method and FDM share: greedy matching of a latent line to the demonstration, and straight rays."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import torch

from ..arguments import Array, number_in, whole_number
from ..base import LatentDS, Learned
from ..demonstration import Demonstration, goal_apart
from ..dynamics import RayDynamics
from ..fitting.average import mean_motion
from ..fitting.homotopy import linear_homotopy
from ..fitting.matching import PINS, match_along, pin_ends
from ..fitting.refinement import refine
from ..fitting.tuning import tuned
from ..time_law import TimeLaw
from ..translations import LocallyWeightedTranslations

BETA, MU = 0.5, 0.9
"""The defaults of β and μ."""


class GreedyDS(LatentDS):
    """ψ maps a latent line onto one demonstration by greedy locally weighted translations (Perrin 2016, Alg. 1).

    The latent point moves straight to the goal. A subclass says where the latent points lie and how fast one moves.
    Given several demonstrations, it learns their mean at equal progress, with the mean of their goals, and notes that.

    Args:
        dim: n >= 1.
        n_layers: M >= 1. The paper's Table I uses 50 to 750. None for the paper's own rule, which chooses β and μ too:
            the fewest of 25 to 750 layers that bring the match's MSE, for a motion of radius 1, below 1e-5 with some
            β and μ of a grid, or the least MSE if none do; in seconds. The report's notes say which.
        beta: β in (0, 1], the share of the largest error that a layer moves.
        mu: μ in (0, 1), how near to its invertibility bound a layer may come.
        steps: continuation steps of the matching; 1 is the paper's.
        refined: whether all layers are moved together by L-BFGS after the greedy match; the paper's are not.
        pinned: whether two more layers bring the ends of the latent line exactly onto start and goal. The paper's are
            off by about √MSE; without pins x* = ψ⁻¹(y*), which can lie far from the end of the line.
    """

    diffeomorphism: LocallyWeightedTranslations
    dynamics: RayDynamics

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
    ) -> None:
        self.n_layers = None if n_layers is None else whole_number(n_layers, "n_layers", at_least=1)
        count = (self.n_layers or 1) + PINS * bool(pinned)
        psi = LocallyWeightedTranslations(dim, count, any_number=n_layers is None)
        super().__init__(dim, psi, RayDynamics(self.time_law(1.0)))
        self.beta = number_in(beta, "beta", 0, 1, ends="(]")
        self.mu = number_in(mu, "mu", 0, 1)
        if n_layers is None and (self.beta, self.mu) != (BETA, MU):
            raise ValueError(
                f"n_layers: expected a number beside beta {self.beta:g} and mu {self.mu:g}, got None: it chooses both"
            )
        self.steps = whole_number(steps, "steps", at_least=1)
        self.refined = bool(refined)
        self.pinned = bool(pinned)

    @staticmethod
    @abstractmethod
    def latent_line(shown: Demonstration) -> Array:
        """Where the latent point of each demonstrated one lies, from start to goal: (N, n)."""

    @staticmethod
    @abstractmethod
    def time_law(duration: float) -> TimeLaw:
        """How fast the latent point moves, for a demonstration of so many seconds."""

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        motion, *_ = mean_motion(shown)
        averaged = (
            (f"learned the mean of {len(shown)} demonstrations, as it learns from one",) if len(shown) > 1 else ()
        )
        goal_apart(motion, motion.goal)
        psi, points = self.diffeomorphism, motion.positions.numpy()
        latent, law = self._embedded(motion)
        n_layers, beta, mu, notes = self._hyperparameters(latent, points)
        layers = match_along(linear_homotopy(latent, points, self.steps), n_layers, beta, mu)
        if self.refined:
            layers = refine(layers, latent, points, mu)
        if self.pinned:
            layers = pin_ends(layers, latent, points, mu)
        psi.assign(*(torch.from_numpy(part) for part in layers))
        self.dynamics.law = law.to(self.attractor)
        with torch.no_grad():
            self.attractor.copy_(motion.goal)
            self.start.copy_(motion.start)
            missed = psi(torch.from_numpy(latent).to(self.attractor)) - motion.positions.to(self.attractor)
        self._refuse_folds(motion)
        return Learned(float(missed.square().mean()), psi.n_layers, notes=(*averaged, *notes))

    def _embedded(self, motion: Demonstration) -> tuple[Array, TimeLaw]:
        """The latent points (N, n) and the law by which one moves through them."""
        return self.latent_line(motion), self.time_law(motion.duration)

    def _hyperparameters(self, latent: Array, points: Array) -> tuple[int, float, float, tuple[str, ...]]:
        """M, β and μ, and a note of those that were not given."""
        if self.n_layers is not None:
            return self.n_layers, self.beta, self.mu, ()
        choice = tuned(latent, points)
        note = f"chose n_layers {choice.n_layers}, beta {choice.beta:g} and mu {choice.mu:g} by the paper's rule"
        return choice.n_layers, choice.beta, choice.mu, (note,)
