"""Orientation beside position: motions of a whole pose, learned by any method in six dimensions.

A pose is a position and a unit quaternion (w, x, y, z), (..., 7); q and -q are one orientation. A twist is a velocity
and an angular velocity, (..., 6), units of the positions and rad per second.

The chart. Of an orientation Q and the goal's Q*, the relative rotation Q*⁻¹ Q has the quaternion (w, v), and its place
in the chart is c = 2 L v / w, its Gibbs vector times a length L per radian, so that one metric serves both: 2 L
tan(θ/2) along the axis, which is L times the rotation vector up to θ³. Half turns from the goal lie at infinity. So the
chart is a diffeomorphism of all other orientations onto R³, and what is globally stable there is globally stable on all
poses but those of half turns, which have measure zero and which no motion reaches. In the chart of the rotation vector
itself a motion may leave the ball of radius π, where the field, and V, jump.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from .arguments import Array, check_points, point_array, positive, real_array, real_tensor
from .base import FitReport, StableDS
from .curves import extent
from .demonstration import Demonstration

NEAREST_HALF_TURN = 0.2
"""rad that a demonstration stays away from half a turn from its goal, where the chart stretches beyond use."""
NOT_UNIT = 1e-2
"""By which a quaternion's norm may be off 1, as rounding in a file leaves it."""
NO_DIVISION = 1e-9
"""Least |w| that is divided by."""
COORDINATES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class PoseDemonstration:
    """One motion of a pose, shown once: ``N`` poses, ``dt`` seconds apart; the last is the goal.

    Args:
        positions: (N, 3) finite.
        quaternions: (N, 4) as w, x, y, z, of length 1; signs may flip from row to row.
        dt: seconds, > 0.
        length: units of the positions per radian, > 0: how far turning by one counts. By default the size of the
            positions over the largest turn from the goal, so that both count alike; 1 if nothing moves, and the size if
            nothing turns.
        name: a label for tables and pictures.

    Attributes:
        orientation: (4,) the goal's quaternion.

    Raises:
        ValueError: naming the argument, and where an orientation is within 0.2 rad of half a turn from the goal's.
    """

    positions: Array
    quaternions: Array
    dt: float
    length: float | None = None
    name: str = ""
    orientation: Array = field(init=False)

    def __post_init__(self) -> None:
        positions, given = real_array(self.positions, "positions"), point_array(self.quaternions, "quaternions")
        if positions.shape != (len(given), 3) or not np.isfinite(positions).all():
            raise ValueError(f"positions: expected finite numbers ({len(given)}, 3), got {positions.shape}")
        if given.shape[1] != 4:
            raise ValueError(f"quaternions: expected shape (N, 4), got {given.shape}")
        norms = np.linalg.norm(given, axis=1)
        if (off := np.abs(norms - 1)).max() > NOT_UNIT:
            row = int(off.argmax())
            raise ValueError(f"quaternions: expected length 1, got {norms[row]:.4g} in row {row}")
        quaternions = given / norms[:, None]
        turns = 2 * np.arccos(np.clip(np.abs(quaternions @ quaternions[-1]), 0, 1))
        if turns.max() > math.pi - NEAREST_HALF_TURN:
            raise ValueError(
                f"quaternions: expected turns of less than {math.pi - NEAREST_HALF_TURN:.2f} rad from the goal's "
                f"orientation, got {turns.max():.2f} in row {int(turns.argmax())}; split the motion there and learn "
                "its parts one after the other"
            )
        size, largest = extent(positions), float(turns.max())
        guessed = 1.0 if size == 0 else size if largest < 1e-3 else size / largest
        for name, value in {
            "positions": positions,
            "quaternions": quaternions,
            "dt": positive(self.dt, "dt"),
            "length": guessed if self.length is None else positive(self.length, "length"),
            "orientation": quaternions[-1],
        }.items():
            object.__setattr__(self, name, value)

    @classmethod
    def of(cls, recording: Demonstration, length: float | None = None) -> PoseDemonstration:
        """A recording, as :meth:`Demonstration.load` reads it, of three positions and a quaternion with columns' names.

        The quaternion's columns are those four beside each other whose names end in x, y, z and w.

        Raises:
            ValueError: if there are other columns, or none so named.
        """
        last = ["".join(filter(str.isalpha, name.lower()))[-1:] for name in recording.columns]
        for first in range(len(last) - 3):
            four = last[first : first + 4]
            if len(last) == 7 and sorted(four) == list("wxyz"):
                columns = [first + four.index(letter) for letter in "wxyz"]
                rows = recording.positions.numpy()
                others = [k for k in range(7) if k not in columns]
                return cls(rows[:, others], rows[:, columns], recording.dt, length, recording.name)
        raise ValueError(
            "recording: expected seven columns, of which four beside each other end in x, y, z, w, got "
            f"{recording.columns}"
        )

    def in_chart(self, orientation: Array, length: float) -> Demonstration:
        """The motion in the chart of a goal's ``orientation`` (4,) with that ``length``: in 6-D."""
        poses = np.concatenate([self.positions, self.quaternions], axis=1)
        return Demonstration(_to_chart(np, poses, orientation, length), self.dt, self.name, columns=COORDINATES)


class PoseDS(nn.Module):
    """A globally stable field on poses, made of one on R⁶; see the top of this module for how, and for which poses.

    ``certify(pose.ds)`` says what is proven of the system inside, and so of this one on all poses but half turns from
    the goal; there V is infinite, and rounding decides which way it turns. ``pose.ds.save(path)`` keeps what was
    learned; ``orientation`` and ``length`` are seven numbers to keep beside it, or ``state_dict`` keeps all.

    Args:
        ds: of dimension 6.

    Attributes:
        orientation: (4,) buffer, the goal's.
        length: () buffer, units of position per radian.
    """

    orientation: Tensor
    length: Tensor

    def __init__(self, ds: StableDS) -> None:
        super().__init__()
        if not isinstance(ds, StableDS) or ds.dim != 6:
            raise ValueError(f"ds: expected a system of dimension 6, got {ds!r:.60}")
        self.ds = ds
        self.register_buffer("orientation", torch.tensor([1.0, 0, 0, 0]).to(ds.attractor))
        self.register_buffer("length", torch.ones(()).to(ds.attractor))

    @property
    def fit_report(self) -> FitReport | None:
        """That of the system inside, in the chart."""
        return self.ds.fit_report

    @property
    def attractor(self) -> Tensor:
        """(7,) the goal."""
        return self.from_chart(self.ds.attractor)

    def fit(self, shown: PoseDemonstration | Sequence[PoseDemonstration], *, progress: bool = False) -> PoseDS:
        """Learn from a demonstration, or from several, with the first one's length and the mean of their goals.

        Returns:
            self.

        Raises:
            ValueError: if this is no demonstration that the method can learn from.
        """
        every = list(shown) if isinstance(shown, Sequence) else [shown]
        if not every or not all(isinstance(one, PoseDemonstration) for one in every):
            raise ValueError(f"shown: expected PoseDemonstrations, got {shown!r:.80}")
        goals = Rotation.from_quat([one.orientation for one in every], scalar_first=True)
        orientation = every[0].orientation if len(every) == 1 else goals.mean().as_quat(scalar_first=True)
        assert every[0].length is not None
        motions = [one.in_chart(orientation, every[0].length) for one in every]
        self.ds.fit(motions[0] if len(motions) == 1 else motions, progress=progress)
        with torch.no_grad():
            self.orientation.copy_(torch.from_numpy(np.array(orientation)))
            self.length.fill_(every[0].length)
        return self

    def to_chart(self, pose: Tensor) -> Tensor:
        """(..., 7) -> (..., 6); half turns from the goal to finite places, very far away."""
        points = self._poses(pose)
        chart: Tensor = _to_chart(torch, points, self.orientation, self.length)
        return chart

    def from_chart(self, c: Tensor) -> Tensor:
        """(..., 6) -> (..., 7), in the half of the quaternions that holds the goal's."""
        pose: Tensor = _from_chart(torch, c, self.orientation, self.length)
        return pose

    def forward(self, pose: Tensor, frame: str = "world") -> Tensor:
        """The twist at a pose: (..., 7) -> (..., 6).

        Args:
            pose: position and unit quaternion.
            frame: of the angular velocity: "world", or "body" for the moving axes. Velocities are in world axes.
        """
        if frame not in ("world", "body"):
            raise ValueError(f"frame: expected 'world' or 'body', got {frame!r}")
        points = self._poses(pose)
        chart = _to_chart(torch, points, self.orientation, self.length)
        twist: Tensor = _twist(torch, points, chart, self.ds(chart), self.length, frame == "world")
        return twist

    def lyapunov(self, pose: Tensor) -> Tensor:
        """V of the system inside: (..., 7) -> (...)."""
        return self.ds.lyapunov(self.to_chart(pose))

    def rollout(self, pose0: Tensor, t: Tensor) -> Tensor:
        """The motion from ``pose0`` at times ``t``: (..., 7), (T,) seconds -> (..., T, 7).

        Quaternions have length 1 and do not flip; the first is that of ``pose0``.
        """
        start = self._poses(pose0)
        path = self.from_chart(self.ds.rollout(self.to_chart(start), t))
        side = torch.where((path[..., :1, 3:] * start[..., None, 3:]).sum(-1, keepdim=True) < 0, -1.0, 1.0)
        rest = torch.cat([path[..., :3], side * path[..., 3:]], -1)
        return torch.cat([start.unsqueeze(-2), rest[..., 1:, :]], -2)

    def with_goal(self, pose: Any) -> PoseDS:
        """The same motion to another goal: positions shifted as a whole, orientations turned with the goal's.

        Args:
            pose: (7,) finite.
        """
        goal = self._poses(pose)
        if goal.shape != (7,):
            raise ValueError(f"pose: expected (7,), got {tuple(goal.shape)}")
        moved = PoseDS(self.ds.with_goal(torch.cat([goal[:3], torch.zeros_like(goal[:3])])))
        moved.orientation, moved.length = goal[3:].clone(), self.length.clone()
        return moved

    def controller(self, *, max_speed: float = math.inf) -> PoseController:
        """The field as it is now for a real-time loop: see :class:`PoseController`."""
        return PoseController(self, max_speed=max_speed)

    def _poses(self, pose: Any) -> Tensor:
        points = real_tensor(pose, "pose").to(self.orientation)
        check_points(7, points, "pose")
        lengths = torch.linalg.vector_norm(points[..., 3:], dim=-1, keepdim=True)
        return torch.cat([points[..., :3], points[..., 3:] / lengths], -1)


class PoseController:
    """Twists for a control loop, NumPy in and out, without torch where the system inside allows.

    Args:
        pose: the system, as it is now.
        max_speed: > 0, of the velocity in the chart: at the goal's orientation √(|v|² + L² |ω|²), elsewhere above it.

    Attributes:
        field: the controller of the system inside, in the chart.
    """

    def __init__(self, pose: PoseDS, *, max_speed: float = math.inf) -> None:
        self.field = pose.ds.controller(max_speed=max_speed)
        self._orientation = pose.orientation.detach().double().cpu().numpy().copy()
        self._length = float(pose.length)

    def __call__(self, pose: Any, out: Array | None = None) -> Array:
        """The twist (..., 6) at a pose (..., 7), angular velocities in world axes.

        Raises:
            ValueError: for another shape, or half a turn from the goal, where no way back is the shorter.
        """
        points = real_array(pose, "pose")
        if points.shape[-1:] != (7,) or not np.isfinite(points).all():
            raise ValueError(f"pose: expected finite numbers (..., 7), got {points.shape}")
        points[..., 3:] /= np.linalg.norm(points[..., 3:], axis=-1, keepdims=True)
        if (np.abs(points[..., 3:] @ self._orientation) < NO_DIVISION).any():
            raise ValueError("pose: expected less than half a turn from the goal's orientation, got exactly that")
        chart = _to_chart(np, points, self._orientation, self._length)
        twist = _twist(np, points, chart, self.field(chart), self._length, True)
        if out is None:
            answer: Array = twist
            return answer
        np.copyto(out, twist)
        return out


# --- formulas, written once for numpy and torch -----------------------------------------------------------------------


def _to_chart(xp: Any, pose: Any, orientation: Any, length: Any) -> Any:
    relative = _product(xp, _conjugate(xp, orientation), pose[..., 3:])
    w = relative[..., :1]
    w = xp.where(xp.abs(w) < NO_DIVISION, xp.where(w < 0, -NO_DIVISION, NO_DIVISION), w)
    return xp.concatenate([pose[..., :3], 2 * length * relative[..., 1:] / w], -1)


def _from_chart(xp: Any, c: Any, orientation: Any, length: Any) -> Any:
    b = c[..., 3:] / (2 * length)
    w = 1 / xp.sqrt(1 + (b * b).sum(-1))[..., None]
    relative = xp.concatenate([w, w * b], -1)
    return xp.concatenate([c[..., :3], _product(xp, orientation + 0 * relative, relative)], -1)


def _twist(xp: Any, pose: Any, chart: Any, velocity: Any, length: Any, in_world: bool) -> Any:
    """ω = (ċ - b × ċ) / (L (1 + |b|²)) in body axes, with b = c / (2 L), from ḃ = ½ (I + [b]× + b bᵀ) ω."""
    b, turning = chart[..., 3:] / (2 * length), velocity[..., 3:]
    omega = (turning - _cross(xp, b, turning)) / (length * (1 + (b * b).sum(-1)[..., None]))
    if in_world:
        w, axis = pose[..., 3:4], pose[..., 4:]
        around = _cross(xp, axis, omega)
        omega = omega + 2 * (w * around + _cross(xp, axis, around))
    return xp.concatenate([velocity[..., :3], omega], -1)


def _conjugate(xp: Any, q: Any) -> Any:
    return xp.concatenate([q[..., :1], -q[..., 1:]], -1)


def _product(xp: Any, p: Any, q: Any) -> Any:
    w = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(-1)[..., None]
    return xp.concatenate(
        [w, p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + _cross(xp, p[..., 1:], q[..., 1:])], -1
    )


def _cross(xp: Any, a: Any, b: Any) -> Any:
    (x, y, z), (u, v, w) = (tuple(part[..., i] for i in range(3)) for part in (a, b))
    return xp.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)
