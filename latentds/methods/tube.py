"""TubeDS, our own method: an arc-length line, continuation along a homotopy, refinement, a contracting tube."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..arguments import Array, number_in
from ..base import FitReport, LatentDS, Learned
from ..curves import step_lengths
from ..demonstration import Demonstration, goal_apart
from ..dynamics import TubeDynamics
from ..fitting.average import DECIMALS, mean_motion
from ..fitting.search import PLAN, Search, Several, refuse_crossings
from ..time_law import KnottedLaw
from ..translations import Layers, LocallyWeightedTranslations

TUBE_RADIUS = 0.02
"""Of the tube that the report speaks of, in lengths of the latent line."""
WILD_CONDITION = 1000.0
"""cond(J) along the path above which a note tells of it."""
PULL_GROWS_WITHIN = 0.25
"""Distance from the axis, in sizes of the motion, about which the inward pull stops growing: from half of it to one and
a half, as the law's corner there is round."""


@dataclass(frozen=True)
class TubeReport(FitReport):
    """What a fit of :class:`TubeDS` reached and what it costs.

    Attributes:
        homotopy: the one along which the match came about: "linear", "curvature" or, of a part that grows, "zoom".
        rollout_error: mean distance of the rollout from the demonstrated start to the demonstration at equal progress,
            in sizes of the motion.
        condition_path: largest cond(J_ψ) along the path.
        condition_tube: the same within 0.02 latent lengths of it.
        largest_velocity: largest ‖f‖ in that tube, in mean speeds of the demonstration.
        largest_gradient: largest ‖∂f/∂y‖ (spectral) in that tube, per demonstration duration: what a controller must
            follow; it grows with the contraction κ.
        spread: standard deviation of several demonstrations about their mean path, per coordinate; zeros for one.
        contraction: κ, per duration of the demonstration: the one asked for, or read from what was shown.
    """

    homotopy: str = ""
    rollout_error: float = 0.0
    condition_path: float = 1.0
    condition_tube: float = 1.0
    largest_velocity: float = 0.0
    largest_gradient: float = 0.0
    spread: tuple[float, ...] = ()
    contraction: float = 0.0


class TubeDS(LatentDS):
    """Stable motion that keeps to a contracting tube around the demonstration, with nothing to tune.

    Points evenly spaced in arc length are matched to a straight line, so that ψ is near-isometric along the path; the
    timing lives in the time law alone. Matching follows the linear or the curvature homotopy, whichever rolls out
    better and is better conditioned, and is then refined jointly. Across the path the latent point is drawn in at
    rate κ. The attractor is exact.

    Several demonstrations of one motion are fitted by their mean path at equal progress, with a common goal, and by the
    time law under which each, from where it starts, keeps its own times most nearly. What lies beside that path is
    matched too, as far as it leaves room, so that ψ is near-isometric across it, and a few wide layers at the end bring
    velocities nearer to those shown: see :mod:`latentds.fitting.velocities`.

    Args:
        dim: n >= 1.
        n_layers: M >= 1; None for 300, or as many as it takes to follow the path: see
            :class:`latentds.fitting.search.Plan`; and of several, where it is None alone, the wide ones.
        contraction: κ > 0, per duration of the demonstration: a start off the path comes back within about
            3/κ of it. A larger κ costs proportionally larger velocity gradients (see the report). None, the default,
            is 20 for one demonstration, which says nothing about what lies beside it, and for several that one of
            ``Plan.contractions`` under which their own starts lead most nearly along them; ``fit_report.contraction``
            tells it.
        refined: whether L-BFGS refines the match; without it a fit takes a tenth of the time.
        homotopy: the one that matching may follow, "linear" or "curvature" (n >= 2), or "both".
    """

    diffeomorphism: LocallyWeightedTranslations
    dynamics: TubeDynamics
    report_type = TubeReport

    def __init__(
        self,
        dim: int,
        *,
        n_layers: int | None = None,
        contraction: float | None = None,
        refined: bool = True,
        homotopy: str = "both",
    ) -> None:
        along, across = KnottedLaw.uniform(), KnottedLaw(torch.ones(1), torch.ones(1))
        psi = LocallyWeightedTranslations(dim, 1 if n_layers is None else n_layers, any_number=n_layers is None)
        super().__init__(dim, psi, TubeDynamics(along, across))
        self.n_layers = None if n_layers is None else psi.n_layers
        self.contraction = None if contraction is None else number_in(contraction, "contraction", 0, float("inf"))
        self.refined = bool(refined)
        known = ("linear", "curvature", "both") if self.dim > 1 else ("linear", "both")
        if homotopy not in known:
            raise ValueError(f"homotopy: expected one of {known} in {self.dim} dimensions, got {homotopy!r}")
        self.homotopy = homotopy

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        motion, strands, arrivals = mean_motion(shown)
        # L-BFGS runs on to another match from another rounding, so that none may come from the units or the origin.
        origin, unit = motion.goal.numpy(), motion.size
        shape = Demonstration(((motion.positions - motion.goal) / unit).round(decimals=DECIMALS), motion.dt)

        def try_out(layers: Layers, law: KnottedLaw, kappa: float) -> TubeDS:
            trial = TubeDS(self.dim)
            trial._assign(layers, shape, law, kappa)
            return trial

        several = Several(((strands - origin) / unit).round(DECIMALS), arrivals) if len(shown) > 1 else None
        search = Search(shape, several, try_out, self.n_layers, self.homotopy, self.refined, self.contraction, PLAN)
        path = search.path_and_law[0]
        refuse_crossings(path, origin, unit)
        goal_apart(motion, motion.goal)
        match = search.run()
        best, path = match.candidate.placed(origin, unit), origin + unit * path
        self._assign(best.layers, motion, match.law, match.contraction)
        self._refuse_folds(motion)
        conditioning = self._conditioning(path, motion)
        details = conditioning | {
            "homotopy": best.homotopy,
            "spread": tuple(float(value) for value in strands.std(0).mean(0)),
            "contraction": match.contraction,
        }
        notes, condition = match.notes, conditioning["condition_path"]
        if not condition <= WILD_CONDITION:
            words = f"its map stretches space unevenly, cond(J) is up to {condition:.2g} along the path"
            notes += (f"{words}: do not rely on what lies beside",)
        return Learned(best.mse(path), self.diffeomorphism.n_layers, notes=notes, details=details)

    @torch.no_grad()
    def _assign(self, layers: Layers, motion: Demonstration, law: KnottedLaw, kappa: float) -> None:
        """Take a match, and the dynamics for it."""
        self.diffeomorphism.assign(*(torch.from_numpy(part) for part in layers))
        self.attractor.copy_(motion.goal)
        self.start.copy_(motion.start)
        reach = torch.as_tensor(PULL_GROWS_WITHIN * motion.size) / self.frame().length.cpu()
        self.dynamics.law = law.to(self.attractor)
        transverse = KnottedLaw(reach.reshape(1), (reach * kappa / motion.duration).reshape(1))
        self.dynamics.transverse_law = transverse.to(self.attractor)

    def progress(self, y: Tensor) -> Tensor:
        """How much of the way is left, 1 at the demonstrated start and 0 at the goal: (..., n) -> (...)."""
        points, wanted = self._points(y)
        return self.dynamics.phase(self.diffeomorphism.inverse(points), self.frame()).to(wanted)

    def line_condition(self, n_points: int) -> Tensor:
        """cond(J_ψ) at points of the latent line, even from its start to x*: (n_points,)."""
        return self.condition_number(self._line(n_points))

    def _line(self, n_points: int) -> Tensor:
        """Latent points, even from the encoded start to x*, (n_points, n)."""
        share = torch.linspace(1, 0, n_points, dtype=self.attractor.dtype, device=self.attractor.device)
        frame = self.frame()
        return frame.attractor + share.unsqueeze(-1) * frame.length * frame.axis

    @torch.no_grad()
    def _conditioning(self, path: Array, shown: Demonstration) -> dict[str, float]:
        """What the report tells of rollout error, conditioning, velocities and gradients: see :class:`TubeReport`."""
        line, frame = self._line(len(path)), self.frame()
        across = torch.linalg.svd(frame.axis.unsqueeze(-1))[0][:, 1:].T * TUBE_RADIUS * frame.length
        every = line[:: max(4, self.dim**2 // 16)]
        tube = torch.cat([line, *(every + side * offset for offset in across for side in (1, -1))])
        missed = torch.linalg.vector_norm(self.diffeomorphism(line).cpu() - torch.from_numpy(path), dim=-1).mean()
        y = self.diffeomorphism(tube)
        step = 1e-6 * shown.size
        nudges = step * torch.eye(self.dim, dtype=y.dtype, device=y.device)
        slopes = (self(y.unsqueeze(-2) + nudges) - self(y.unsqueeze(-2) - nudges)) / (2 * step)
        length = float(step_lengths(path).sum())
        return {
            "rollout_error": float(missed) / shown.size,
            "condition_path": float(self.condition_number(line).max()),
            "condition_tube": float(self.condition_number(tube).max()),
            "largest_velocity": float(torch.linalg.vector_norm(self(y), dim=-1).max()) * shown.duration / length,
            "largest_gradient": float(torch.linalg.matrix_norm(slopes, 2).max()) * shown.duration,
        }
