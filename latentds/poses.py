"""Motions of a whole pose, position and orientation, learned by any method in six dimensions.

A pose is a position and a unit quaternion w, x, y, z: (..., 7); q and -q are the same orientation. A twist is a
velocity and an angular velocity: (..., 6), units of the positions per second and rad per second.

The chart. The rotation Q*⁻¹ Q from the goal's orientation Q* to Q has a quaternion (w, v); its place is c = 2 L v / w,
the Gibbs (Rodrigues) vector times a length L per radian, so that one metric serves positions and orientations. It is
2 L tan(θ/2) long, which is L times the rotation vector up to third order, and the same for q and -q. The half turns
from the goal lie at infinity; all other orientations are mapped one to one, smoothly both ways, onto R³. So whatever is
globally asymptotically stable on R⁶ is so on all poses but those half a turn from the goal: they have measure zero, and
no motion reaches them. More is not to be had: no continuous field is globally stable on all rotations (Bhat and
Bernstein 2000). The rotation vector itself would be no such chart: its image is the ball of radius π, which a motion of
a system on R⁶ may leave, and there the field and V may jump.

Sources: Shuster, "A survey of attitude representations", J. Astronaut. Sci. 41 (1993), for the Gibbs vector and its
kinematics; Bhat and Bernstein, "A topological obstruction to continuous global stabilization of rotational motion",
Syst. Control Lett. 39 (2000).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor, nn

from .arguments import Array, check_points, number_in, positive, real_array, real_tensor
from .base import FitReport, StableDS
from .curves import extent
from .demonstration import Demonstration

CLEARANCE = 0.2
"""rad that a demonstration must stay short of half a turn from its goal: there the chart is stretched a hundredfold."""
NORM_SLACK = 1e-2
"""How far the norms of recorded quaternions may be off 1: as far as a file with three digits rounds them."""
NO_TURN = 1e-3
"""rad of turning below which nothing is read off it."""
NO_MOTION = 1e-9
"""Extent, in distances from the origin, up to which positions count as one."""
SMALLEST_W = 1e-9
"""|w| up to which an orientation counts as half a turn from the goal."""
COLUMNS = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, eq=False)
class PoseDemonstration:
    """One motion of a pose, shown once: ``N`` poses, ``dt`` seconds apart; the last is the goal.

    Args:
        positions: (N, 3) finite, N >= 3; kept as a float64 CPU tensor.
        quaternions: (N, 4) as w, x, y, z, of norm 1 up to 0.01; normalised, and kept on the sign of the last, so that
            signs that flip from row to row change nothing.
        dt: seconds between two poses, > 0.
        length: L > 0, units of the positions per radian: how far turning by one radian counts. By default the largest
            extent of the positions along an axis over the largest turn from the goal, so that both count alike and
            units do not matter; 1 where the positions do not move, their extent where no turn is above 0.001.
        name: a label for tables and pictures.

    Attributes:
        orientation: (4,) the goal's.
        demonstration: the motion in the chart, 6-D, with columns x, y, z, rx, ry, rz, in units of the positions.

    Raises:
        ValueError: naming the argument, what was expected and what came; also of a motion that comes within 0.2 rad of
            half a turn from its goal.

    Warns:
        UserWarning: if ``length`` is left to be read off a motion that does not move or does not turn; it says which.
    """

    positions: Tensor = field(repr=False)
    quaternions: Tensor = field(repr=False)
    dt: float
    length: float | None = None
    name: str = ""
    orientation: Tensor = field(init=False, repr=False)
    demonstration: Demonstration = field(init=False, repr=False)

    def __post_init__(self) -> None:
        positions = _rows(self.positions, "positions", 3)
        quaternions = _rows(self.quaternions, "quaternions", 4)
        if len(positions) != len(quaternions):
            raise ValueError(f"quaternions: expected {len(positions)} rows, one a position, got {len(quaternions)}")
        norms = np.linalg.norm(quaternions, axis=1)
        if (off := np.abs(norms - 1)).max() > NORM_SLACK:
            row = int(off.argmax())
            raise ValueError(f"quaternions: expected norms of 1 within {NORM_SLACK}, got {norms[row]:.4g} in row {row}")
        quaternions /= norms[:, None]
        # From the goal backward, each on the side of the one after it.
        flips = np.where((quaternions[1:] * quaternions[:-1]).sum(1) < 0, -1.0, 1.0)
        quaternions[:-1] *= np.cumprod(flips[::-1])[::-1, None]
        guess, doubt = _default_length(positions, quaternions) if self.length is None else (self.length, "")
        length = positive(guess, "length")
        if doubt:
            warnings.warn(f"length: {doubt}, so {length:.3g} per radian is taken; pass it", stacklevel=3)
        for name, value in {
            "positions": torch.from_numpy(positions),
            "quaternions": torch.from_numpy(quaternions),
            "dt": positive(self.dt, "dt"),
            "length": length,
            "orientation": torch.from_numpy(quaternions[-1].copy()),
        }.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "demonstration", self.in_chart(self.orientation, length))

    @classmethod
    def of(cls, recording: Demonstration, length: float | None = None) -> PoseDemonstration:
        """A recording, as :meth:`Demonstration.load` reads it, of three positions and a quaternion.

        The quaternion's columns are those four beside each other whose names end in x, y, z and w.

        Raises:
            ValueError: if there are other columns, or none so named.
        """
        last = ["".join(filter(str.isalpha, name.lower()))[-1:] for name in recording.columns]
        for first in range(len(last) - 3):
            four = last[first : first + 4]
            if len(last) == 7 and sorted(four) == list("wxyz"):
                columns = [first + four.index(letter) for letter in "wxyz"]
                others = [k for k in range(7) if k not in columns]
                rows = recording.positions
                return cls(rows[:, others], rows[:, columns], recording.dt, length, recording.name)
        raise ValueError(
            "recording: expected seven columns, of which four beside each other end in x, y, z, w, got "
            f"{recording.columns}"
        )

    def __len__(self) -> int:
        return self.positions.shape[0]

    @property
    def poses(self) -> Tensor:
        """(N, 7)."""
        return torch.cat([self.positions, self.quaternions], 1)

    @property
    def times(self) -> Tensor:
        """(N,) seconds, from 0."""
        return self.demonstration.times

    def in_chart(self, orientation: Any, length: float) -> Demonstration:
        """The motion in another goal's chart: 6-D.

        Args:
            orientation: (4,) unit quaternion of that goal.
            length: L, units of the positions per radian.

        Raises:
            ValueError: if it comes within 0.2 rad of half a turn from there, or passes half a turn between two poses.
        """
        goal, poses = real_array(orientation, "orientation"), self.poses.numpy()
        w = poses[:, 3:] @ goal  # of a sign that changes nowhere but at half a turn
        w *= np.copysign(1.0, w[-1])
        if near := np.flatnonzero(w < math.sin(CLEARANCE / 2)).tolist():
            row = near[-1]
            raise ValueError(
                f"quaternions: expected orientations {CLEARANCE} rad short of half a turn from the goal's, got a turn "
                f"of {2 * math.acos(max(-1.0, w[row])):.2f} rad at row {row}; split the motion after it, or give the "
                "orientations relative to a frame that turns along"
            )
        return Demonstration(_to_chart(np, poses, goal, length), self.dt, self.name, columns=COLUMNS)


def _rows(values: Any, name: str, width: int) -> Array:
    rows: Array = real_array(values, name)
    if rows.ndim != 2 or rows.shape[1] != width or len(rows) < 3:
        raise ValueError(f"{name}: expected shape (N, {width}) with N >= 3, got {rows.shape}")
    if not np.isfinite(rows).all():
        row = int(np.argmin(np.isfinite(rows).all(axis=1)))
        raise ValueError(f"{name}: expected finite numbers, got NaN or inf in row {row}")
    return rows


def _default_length(positions: Array, quaternions: Array) -> tuple[float, str]:
    """L, and what there was to doubt about it."""
    relative = _product(np, _conjugate(np, quaternions[-1]), quaternions)
    turn = float((2 * np.arctan2(np.linalg.norm(relative[:, 1:], axis=1), np.abs(relative[:, 0]))).max())
    size = extent(positions)
    if size <= NO_MOTION * np.abs(positions).max():
        return 1.0, "the positions do not move"
    if turn <= NO_TURN:
        return size, "the orientation does not turn"
    return size / turn, ""


class PoseDS(nn.Module):
    """A field of twists on poses, stable wherever the goal is less than half a turn away, made of any system on R⁶.

    The module's docstring says how, and why no motion reaches the poses half a turn from the goal. In torch these give
    finite values, as if they were a billionth short of it; the controller refuses them. ``latentds.certify(pose.ds)``
    tells what is proven of the system inside, and so of this one.

    As of every system, numbers are computed in the module's dtype and returned in that of the input. Quaternions need
    not have norm 1; they are normalised.

    There is no ``save`` of its own. ``state_dict`` holds everything; or ``pose.ds.save(path)``, and beside it the
    orientation and the length, to be assigned to ``PoseDS(latentds.load(path))``.

    Args:
        ds: of dimension 6, unfitted or not; a submodule.

    Attributes:
        orientation: (4,) buffer, Q*, the origin of the chart.
        length: () buffer, L, units of the positions per radian.
    """

    orientation: Tensor
    length: Tensor

    def __init__(self, ds: StableDS) -> None:
        super().__init__()
        if not isinstance(ds, StableDS) or ds.dim != 6:
            came = f"{type(ds).__name__} of dimension {ds.dim}" if isinstance(ds, StableDS) else type(ds).__name__
            raise ValueError(f"ds: expected a StableDS of dimension 6, got {came}")
        self.ds = ds
        self.register_buffer("orientation", torch.tensor([1.0, 0.0, 0.0, 0.0]).to(ds.attractor))
        self.register_buffer("length", torch.ones(()).to(ds.attractor))

    @property
    def fit_report(self) -> FitReport | None:
        """That of the system inside: in the chart, and in units of the positions."""
        return self.ds.fit_report

    @property
    def attractor(self) -> Tensor:
        """(7,) the goal."""
        return self.from_chart(self.ds.attractor)

    def fit(self, demonstration: PoseDemonstration | Sequence[PoseDemonstration], *, progress: bool = False) -> PoseDS:
        """Learn from a demonstration, or from several where the method can; forgets any fit before.

        Several are learned in one chart: that of the mean of their goals' orientations, with the first one's length.

        Returns:
            self.

        Raises:
            ValueError: if this is no demonstration that the method can learn from, or one that comes within 0.2 rad of
                half a turn from the mean goal.

        Warns:
            FitWarning: as :meth:`StableDS.fit` does.
        """
        every = [demonstration] if isinstance(demonstration, PoseDemonstration) else demonstration
        if not isinstance(every, Sequence) or not every or not all(isinstance(d, PoseDemonstration) for d in every):
            raise ValueError(
                "demonstration: expected a PoseDemonstration or a non-empty list of them, "
                f"got {type(demonstration).__name__}"
            )
        first, length = every[0], positive(every[0].length, "length")
        orientation = first.orientation if len(every) == 1 else _mean([one.orientation for one in every])
        self.ds.fit([one.in_chart(orientation, length) for one in every], progress=progress)
        with torch.no_grad():
            self.orientation.copy_(orientation)
            self.length.fill_(length)
        return self

    def forward(self, pose: Tensor, frame: str = "world") -> Tensor:
        """The twist at ``pose``: (..., 7) -> (..., 6).

        Args:
            pose: of the tool.
            frame: of the angular velocity, rad per second: along the axes of the "world", or of the tool's "body". The
                velocity is in world axes in both.
        """
        if frame not in ("world", "body"):
            raise ValueError(f"frame: expected 'world' or 'body', got {frame!r:.80}")
        points, wanted = self._poses(pose)
        chart = _to_chart(torch, points, self.orientation, self.length)
        twist: Tensor = _twist(torch, points, chart, self.ds(chart), self.length, frame == "world")
        return twist.to(wanted)

    def lyapunov(self, pose: Tensor) -> Tensor:
        """V of the system inside, zero only at the goal, decreasing along every motion: (..., 7) -> (...)."""
        return self.ds.lyapunov(self.to_chart(pose))

    def rollout(self, pose0: Tensor, t: Tensor) -> Tensor:
        """The motion from ``pose0`` at times ``t``: (..., 7), (T,) seconds, not decreasing -> (..., T, 7).

        Quaternions have norm 1 and the sign of the first, so that they have no jumps. The pose at ``t[0]`` is
        ``pose0``, normalised.
        """
        start, wanted = self._poses(pose0, "pose0")
        path = _from_chart(torch, self.ds.rollout(self.to_chart(start), t), self.orientation, self.length)
        quaternions = path[..., 3:]
        other_side = (quaternions[..., :1, :] * start[..., None, 3:]).sum(-1, keepdim=True) < 0
        signed = torch.cat([path[..., :3], torch.where(other_side, -quaternions, quaternions)], -1)
        return torch.cat([start[..., None, :], signed[..., 1:, :]], -2).to(wanted)

    def to_chart(self, pose: Tensor) -> Tensor:
        """Position and c = 2 L v / w of each pose, all in units of the positions: (..., 7) -> (..., 6).

        Half a turn from the goal w is zero, and taken as 1e-9.
        """
        points, wanted = self._poses(pose)
        chart: Tensor = _to_chart(torch, points, self.orientation, self.length)
        return chart.to(wanted)

    def from_chart(self, c: Tensor) -> Tensor:
        """The pose at a place of the chart: (..., 6) -> (..., 7), its quaternion on the side of ``orientation``."""
        places, wanted = self._typed(c, "c", 6)
        pose: Tensor = _from_chart(torch, places, self.orientation, self.length)
        return pose.to(wanted)

    def with_goal(self, pose: Any) -> PoseDS:
        """The same motion to another goal: its positions are shifted, and its orientations turn with the goal's.

        Positions are not turned. The new system shares the parameters of this one.

        Args:
            pose: (7,) finite. A gradient of what the new system computes reaches it.

        Warns:
            UserWarning: as :meth:`StableDS.with_goal` does, where a robot would lunge because of the shift.
        """
        goal, _ = self._poses(pose)
        if goal.shape != (7,) or not bool(torch.isfinite(goal).all()):
            raise ValueError(f"pose: expected 7 finite numbers, a quaternion of norm > 0 among them, got {pose!r:.80}")
        # The goal of several demonstrations is where the method puts it, near the chart's origin but not in it.
        place = self.ds.attractor
        turn = _from_chart(torch, place, torch.eye(1, 4).to(place)[0], self.length)[3:]
        moved = PoseDS(self.ds.with_goal(torch.cat([goal[:3], place[3:]])))
        moved.orientation, moved.length = _product(torch, goal[3:], _conjugate(torch, turn)), self.length.clone()
        return moved

    def controller(self, *, max_speed: float = math.inf) -> PoseController:
        """The field as it is now for a real-time loop, NumPy in and out: see :class:`PoseController`."""
        return PoseController(self, max_speed=max_speed)

    def _poses(self, pose: Any, name: str = "pose") -> tuple[Tensor, torch.dtype]:
        """Poses of norm 1 in the module's dtype, and the dtype in which the caller wants the answer."""
        points, wanted = self._typed(pose, name, 7)
        norms = torch.linalg.vector_norm(points[..., 3:], dim=-1, keepdim=True)
        return torch.cat([points[..., :3], points[..., 3:] / norms], -1), wanted

    def _typed(self, values: Any, name: str, width: int) -> tuple[Tensor, torch.dtype]:
        points, dtype = real_tensor(values, name), self.orientation.dtype
        check_points(width, points, name)
        return points.to(dtype), points.dtype if points.is_floating_point() else dtype


def _mean(orientations: Sequence[Tensor]) -> Tensor:
    """The mean of rotations (4,), whatever their signs, as SciPy has it."""
    scalar_last = np.stack([one.numpy() for one in orientations])[:, [1, 2, 3, 0]]
    mean = scipy.spatial.transform.Rotation.from_quat(scalar_last).mean().as_quat()
    return torch.from_numpy(mean[[3, 0, 1, 2]])


class PoseController:
    """The twists of a :class:`PoseDS` as it is now for a control loop, without torch where the system inside allows it.

    It keeps its own copy. Any number of threads may call it at once.

    Args:
        pose: the system.
        max_speed: > 0, of ``√(|v|² + L² |ω|²)``, units of the positions per second; a faster twist is shortened to it,
            all of it by one factor, so that the motion stays on its curve.
    """

    def __init__(self, pose: PoseDS, *, max_speed: float = math.inf) -> None:
        self.max_speed = number_in(max_speed, "max_speed", 0, math.inf, ends="(]")
        self._field = pose.ds.controller()
        self._orientation: Array = real_array(pose.orientation, "orientation")
        self._length = float(pose.length)

    def __call__(self, pose: Any) -> Array:
        """Velocity, and angular velocity in world axes, at a pose: (7,) -> (6,) float64.

        Raises:
            ValueError: for another shape, anything but finite real numbers, or an orientation half a turn from the
                goal's, from where no way back is the shorter one.
        """
        point: Array = real_array(pose, "pose")
        if point.shape != (7,) or not math.isfinite(point.sum()):
            raise ValueError(f"pose: expected 7 finite numbers, got {pose!r:.80}")
        norm = math.sqrt(point[3:] @ point[3:])
        if not norm > 0:
            raise ValueError("pose: expected a quaternion of norm > 0, got zeros")
        point[3:] /= norm
        if abs(point[3:] @ self._orientation) < SMALLEST_W:
            raise ValueError(f"pose: expected less than half a turn from the goal's orientation, got {point[3:]}")
        chart = _to_chart(np, point, self._orientation, self._length)
        twist: Array = _twist(np, point, chart, self._field(chart), self._length, True)
        speed = math.sqrt(twist[:3] @ twist[:3] + self._length**2 * (twist[3:] @ twist[3:]))
        return twist if speed <= self.max_speed else twist * (self.max_speed / speed)


# Written once, for NumPy and for torch; xp is either.


def _to_chart(xp: Any, pose: Any, orientation: Any, length: Any) -> Any:
    relative = _product(xp, _conjugate(xp, orientation), pose[..., 3:])
    w = relative[..., :1]
    w = xp.where(abs(w) < SMALLEST_W, xp.where(w < 0, -SMALLEST_W, SMALLEST_W), w)
    return xp.concatenate([pose[..., :3], 2 * length * relative[..., 1:] / w], -1)


def _from_chart(xp: Any, c: Any, orientation: Any, length: Any) -> Any:
    b = c[..., 3:] / (2 * length)
    w = 1 / xp.sqrt(1 + (b * b).sum(-1))[..., None]
    unit = orientation / xp.sqrt((orientation * orientation).sum(-1))  # it may have been assigned by hand
    return xp.concatenate([c[..., :3], _product(xp, unit, xp.concatenate([w, w * b], -1))], -1)


def _twist(xp: Any, pose: Any, chart: Any, velocity: Any, length: Any, in_world: bool) -> Any:
    """Of ċ, with b = v / w = c / (2 L): ḃ = ½ (I + [b]× + b bᵀ) ω in body axes, so ω = 2 (ḃ - b × ḃ) / (1 + |b|²)."""
    b, turning = chart[..., 3:] / (2 * length), velocity[..., 3:]
    omega = (turning - _cross(xp, b, turning)) / (length * (1 + (b * b).sum(-1)[..., None]))
    if in_world:
        w, v = pose[..., 3:4], pose[..., 4:]
        around = _cross(xp, v, omega)
        omega = omega + 2 * (w * around + _cross(xp, v, around))
    return xp.concatenate([velocity[..., :3], omega], -1)


def _conjugate(xp: Any, q: Any) -> Any:
    return xp.concatenate([q[..., :1], -q[..., 1:]], -1)


def _product(xp: Any, p: Any, q: Any) -> Any:
    w = p[..., :1] * q[..., :1] - (p[..., 1:] * q[..., 1:]).sum(-1)[..., None]
    v = p[..., :1] * q[..., 1:] + q[..., :1] * p[..., 1:] + _cross(xp, p[..., 1:], q[..., 1:])
    return xp.concatenate([w, v], -1)


def _cross(xp: Any, a: Any, b: Any) -> Any:
    (x, y, z), (u, v, w) = ([part[..., i] for i in range(3)] for part in (a, b))
    return xp.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)
