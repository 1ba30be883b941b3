"""Velocity fields that keep out of obstacles and inside of limits.

Each wraps a system and is one itself, with less to promise: it cannot enter what it avoids, and rests nowhere else in
the open, but its V may rise on the way around, it may come to rest on a surface, and it no longer follows what was
shown there. So the certificate and the contract of the system inside do not hold for it, and it does not claim them.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from .arguments import Array, number_in, positive, real_array, whole_number
from .base import Learned, MovedDS, StableDS
from .demonstration import Demonstration
from .deploy.controller import Controller
from .deploy.tables import Compiled, FieldTables
from .similarity import check_rotation

STRONGEST = 4.0
"""Most of 1/Γ², which grows without bound toward the centre of a body."""
BOX_EXPONENT = 4
"""Of the body that stands for a box: the larger, the sharper its edges and the less it bulges beyond the faces."""


class Body(NamedTuple):
    """An obstacle's numbers, as tensors or as arrays; see :class:`Obstacle`."""

    center: Any
    half_axes: Any
    rotation: Any
    velocity: Any
    exponent: int


class Obstacle(nn.Module):
    """{y: Γ(y) < 1}, convex, with ``Γ(y) = (Σ |z_i / a_i|^(2p))^(1/(2p))``, z = Rᵀ(y - c): an ellipsoid for p = 1.

    Args:
        center: c, (n,) finite.
        half_axes: a, (n,) > 0, or one number for a sphere.
        rotation: R, (n, n) orthogonal, its columns the directions of the axes; None turns nothing.
        velocity: (n,) of the obstacle, units of y per second; None is at rest.
        exponent: p >= 1; larger ones are nearer to a box.

    Attributes:
        center, velocity: buffers; written in place, the obstacle moves.
    """

    center: Tensor
    half_axes: Tensor
    rotation: Tensor
    velocity: Tensor

    def __init__(
        self, center: Any, half_axes: Any, *, rotation: Any = None, velocity: Any = None, exponent: int = 1
    ) -> None:
        super().__init__()
        middle = _finite(center, "center")
        dim = len(middle)
        axes = np.broadcast_to(_finite(np.atleast_1d(half_axes), "half_axes"), (dim,)).copy()
        if not (axes > 0).all():
            raise ValueError(f"half_axes: expected numbers > 0, got {axes}")
        turn = torch.eye(dim, dtype=torch.float64) if rotation is None else check_rotation(rotation, dim).double()
        moving = np.zeros(dim) if velocity is None else _finite(velocity, "velocity")
        if moving.shape != (dim,):
            raise ValueError(f"velocity: expected ({dim},), got {moving.shape}")
        self.exponent = whole_number(exponent, "exponent", at_least=1)
        for name, value in {"center": middle, "half_axes": axes, "velocity": moving}.items():
            self.register_buffer(name, torch.from_numpy(value.copy()))
        self.register_buffer("rotation", turn)

    def grown(self, margin: float) -> Obstacle:
        """One with ``margin`` >= 0 more in each half-axis.

        Its surface is ``margin`` away from a sphere's, and from others' at the ends of the axes; in between at least
        half of that.
        """
        larger = copy.deepcopy(self)
        larger.half_axes += number_in(margin, "margin", 0, math.inf, ends="[)")
        return larger

    def level(self, y: Tensor) -> Tensor:
        """Γ: (..., n) -> (...), 0 at the centre, 1 on the surface, in proportion to the distance from the centre."""
        level: Tensor = _level_and_normal(torch, y, self.body())[0]
        return level

    def body(self) -> Body:
        return Body(self.center, self.half_axes, self.rotation, self.velocity, self.exponent)

    def numbers(self) -> Body:
        """The same numbers as NumPy arrays, which share memory with buffers that are on the CPU in float64."""
        center, half_axes, rotation, velocity, exponent = self.body()
        return Body(center.numpy(), half_axes.numpy(), rotation.numpy(), velocity.numpy(), exponent)


def sphere(center: Any, radius: float, **motion: Any) -> Obstacle:
    """A ball of that ``radius`` > 0; ``velocity=`` lets it move."""
    return Obstacle(center, positive(radius, "radius"), **motion)


def box(center: Any, half_sizes: Any, **motion: Any) -> Obstacle:
    """A body with rounded edges that encloses the box of these ``half_sizes`` (n,) > 0; ``rotation=`` turns it."""
    sizes = _finite(half_sizes, "half_sizes")
    bulge = len(sizes) ** (1 / (2 * BOX_EXPONENT))  # so that the corners lie on the surface
    return Obstacle(center, bulge * sizes, exponent=BOX_EXPONENT, **motion)


class _Modulated(StableDS):
    """A system made of another, in whose place it stands: the motion inside moves along with its attractor."""

    def __init__(self, ds: StableDS) -> None:
        if isinstance(ds, _Modulated):
            raise ValueError(
                f"ds: expected a system that nothing holds back, got {type(ds).__name__}: what keeps out of one place "
                "may lead into another; give all obstacles to one AvoidingDS"
            )
        super().__init__(ds.dim)
        self.ds = ds
        self.to(ds.attractor)
        with torch.no_grad():
            self.attractor.copy_(ds.attractor)

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        raise ValueError("fit: expected the system inside; fit ds.ds, and wrap it again")

    def _moved(self, attractor: Tensor, **change: Any) -> MovedDS:
        raise ValueError(
            f"{type(self).__name__}: expected the system inside, as what stands around does not move with a motion; "
            "move or slow ds.ds, and wrap it again"
        )

    def lyapunov(self, y: Tensor) -> Tensor:
        """V of the system inside, which may rise here."""
        points, wanted = self._points(y)
        return self.ds.lyapunov(self._inside(points)).to(wanted)

    def _inside(self, points: Tensor) -> Tensor:
        return points - (self.attractor - self.ds.attractor)


class AvoidingDS(_Modulated):
    """A system that goes around convex obstacles, after Khansari-Zadeh and Billard (2012) and Huber et al. (2019).

    At Γ ≥ 1 from an obstacle, with r the direction from its centre, n its normal and w = 1/Γ², the velocity is split
    into a r + t with n·t = 0, and becomes (1 - w) a r + (1 + w) t, shortened where it would be faster than before. On
    the surface it has no part along n: it is impenetrable, also where it moves, as velocities are then relative to it.
    Of several obstacles the results are averaged by nearness, so that on a surface its own counts alone.

    Near an obstacle the field inside is replaced, by the share w, by that of the straight latent motions
    (:meth:`~latentds.StableDS.straight_velocity`). A tube that contracts onto a path that leads into an obstacle would
    hold the robot where the path meets the surface; straight motions part there, at a saddle point.

    What it promises: no motion enters an obstacle; the goal is kept, while they rest; where the system inside has no
    other equilibrium, neither has this one but on surfaces, where the velocity runs along r. For a straight field and
    one obstacle that is a saddle point, which all motions but those of measure zero pass (Huber et al.); for curved
    ones and for several obstacles it is not proven. A motion that begins inside is led out.

    Args:
        ds: any stable system but one that is held back already.
        obstacles: of its dimension, their surfaces and ``margin`` around them not at the goal; they may overlap, but
            then motions may end between them.
        margin: >= 0, added to each half-axis: the robot's own radius and what it may be off.

    Attributes:
        obstacles: with their margin; their ``center`` and ``velocity`` can be written in place. Whether one then
            covers the goal is not checked: motions end on its surface.

    Raises:
        ValueError: for another dimension, if an obstacle covers the goal, or for a ``ds`` that is held back.
    """

    def __init__(self, ds: StableDS, obstacles: Sequence[Obstacle], margin: float = 0.0) -> None:
        super().__init__(ds)
        if not obstacles or not all(isinstance(one, Obstacle) and len(one.center) == ds.dim for one in obstacles):
            raise ValueError(f"obstacles: expected at least one Obstacle in {ds.dim}-D, got {obstacles!r:.80}")
        self.margin = margin
        grown = [one.grown(margin) for one in obstacles]
        for one in grown:
            if not float(one.level(ds.attractor.detach().double().cpu())) > 1:
                raise ValueError(f"obstacles: expected none at the goal, got one around {one.center.tolist()}")
        self.obstacles = nn.ModuleList(grown).to(ds.attractor)

    def forward(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        bodies = [one.body() for one in self.obstacles if isinstance(one, Obstacle)]
        inside = self._inside(points)
        velocity: Tensor = _around(torch, points, self.ds(inside), self.ds.straight_velocity(inside), bodies)
        return velocity.to(wanted)

    def controller(self, *, max_speed: float = math.inf) -> AvoidingController:  # type: ignore[override]
        """For a control loop: see :class:`AvoidingController`."""
        return AvoidingController(self, max_speed=max_speed)


class AvoidingController:
    """The velocity of an :class:`AvoidingDS` for a real-time loop, NumPy in and out: two compiled calls, no torch.

    Attributes:
        field: the controller of the system inside, whose goal and speed can be set.
        obstacles: (center, half_axes, rotation, velocity) as arrays of this controller alone: write into ``center`` and
            ``velocity`` what is seen of an obstacle, each cycle.
    """

    def __init__(self, ds: AvoidingDS, *, max_speed: float = math.inf) -> None:
        own = copy.deepcopy(ds).to("cpu", torch.float64)
        self.dim = ds.dim
        self.max_speed = number_in(max_speed, "max_speed", 0, math.inf, ends="(]")
        self.field, self._straight = own.ds.controller(), Controller(_Straight(own.ds))
        self.field.goal = own.attractor.numpy()
        self.obstacles = [one.numbers() for one in own.obstacles if isinstance(one, Obstacle)]

    def __call__(self, y: Any, out: Array | None = None) -> Array:
        """Velocity at ``y``: (..., n) -> (..., n) float64, into ``out`` if it is given."""
        points = real_array(y, "y")
        self._straight.goal, self._straight.speed = self.field.goal, self.field.speed
        velocity = _around(np, points, self.field(points), self._straight(points), self.obstacles)
        if self.max_speed < math.inf:
            velocity *= self.max_speed / np.maximum(np.linalg.norm(velocity, axis=-1, keepdims=True), self.max_speed)
        if out is None:
            answer: Array = velocity
            return answer
        np.copyto(out, velocity)
        return out


class BoundedDS(_Modulated):
    """A system that stays within limits, such as those of an arm's joints: no motion leaves {lower ≤ y ≤ upper}.

    Toward a wall that is d away a coordinate's velocity is multiplied by min(1, d / margin); other coordinates, and
    velocities away from the wall, stay. So near a wall ḋ ≥ -d f_max / margin, hence d(t) ≥ d(0) exp(-f_max t / margin)
    > 0: a motion comes nearer and never there (Grönwall), whatever the system inside. Where it would have gone through
    a wall it slides along, by the straight latent motions, as around an obstacle (:class:`AvoidingDS`); where all that
    is left of the velocity points into walls it comes to rest, which is not excluded. A motion that begins outside may
    only come back.

    Args:
        ds: any stable system but one that is held back already.
        lower, upper: (n,), lower < upper, the goal between them by more than ``margin``.
        margin: > 0, units of y, from where a wall is felt.
    """

    lower: Tensor
    upper: Tensor

    def __init__(self, ds: StableDS, lower: Any, upper: Any, margin: float) -> None:
        super().__init__(ds)
        self.margin = positive(margin, "margin")
        for name, value in {"lower": lower, "upper": upper}.items():
            limit = _finite(value, name)
            if limit.shape != (ds.dim,):
                raise ValueError(f"{name}: expected ({ds.dim},), got {limit.shape}")
            self.register_buffer(name, torch.from_numpy(limit.copy()))
        goal = ds.attractor.detach().double().cpu()
        if not bool(((goal - self.lower > self.margin) & (self.upper - goal > self.margin)).all()):
            raise ValueError(
                f"lower, upper: expected the goal {goal.tolist()} between them by more than the margin "
                f"{self.margin:g}, got {self.lower.tolist()} and {self.upper.tolist()}"
            )
        self.to(ds.attractor)

    def forward(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        inside = self._inside(points)
        below, above = ((wall / self.margin).clamp(0, 1) for wall in (points - self.lower, self.upper - points))
        own, nearest = self.ds(inside), 1 - torch.minimum(below, above).amin(-1, keepdim=True)
        velocity: Tensor = own + nearest * (self.ds.straight_velocity(inside) - own)
        room = torch.where(velocity < 0, below, above)
        return (velocity * room).to(wanted)


class _Straight(_Modulated):
    """The straight latent motions of a system, as one of their own."""

    def forward(self, y: Tensor) -> Tensor:
        return self.ds.straight_velocity(y)

    def tables(self) -> Compiled | None:
        inside = self.ds.tables()
        return inside.straight() if isinstance(inside, FieldTables) else inside


def _around(xp: Any, y: Any, field: Any, straight: Any, bodies: Sequence[Body]) -> Any:
    """The velocity around the bodies, with ``xp`` numpy or torch, in whose functions the formula is written once."""
    levels, normals = zip(*(_level_and_normal(xp, y, body) for body in bodies), strict=True)
    weights = [xp.clip(level[..., None] ** -2, 0, STRONGEST) for level in levels]
    nearest = weights[0]
    for weight in weights[1:]:
        nearest = xp.maximum(nearest, weight)
    base = field + xp.clip(nearest, 0, 1) * (straight - field)
    total, result = 0.0, 0.0
    for body, level, normal, weight in zip(bodies, levels, normals, weights, strict=True):
        ray = y - body.center
        relative = base - body.velocity
        inward = (normal * relative).sum(-1)[..., None]
        radial = inward / _above_zero(xp, (normal * ray).sum(-1))[..., None] * ray
        # Inside of the body, where 1 - w is below 0, what leads in is turned to lead out.
        straightened = xp.where(weight > 1, -xp.sign(inward), 1.0) * (1 - weight) * radial
        turned = straightened + (1 + weight) * (relative - radial)
        faster = _norm(xp, turned) / _above_zero(xp, _norm(xp, relative))
        near = 1 / _above_zero(xp, xp.abs(level - 1))[..., None]
        result = result + near * (turned / xp.clip(faster, 1, math.inf) + body.velocity)
        total = total + near
    return result / total


def _level_and_normal(xp: Any, y: Any, body: Body) -> tuple[Any, Any]:
    """Γ (...,) and a vector along its gradient (..., n)."""
    power = 2 * body.exponent
    scaled = ((y - body.center)[..., None] * body.rotation).sum(-2) / body.half_axes
    level = _above_zero(xp, (scaled**power).sum(-1)) ** (1 / power)
    slope = scaled ** (power - 1) / body.half_axes
    return level, (slope[..., None, :] * body.rotation).sum(-1)


def _norm(xp: Any, vectors: Any) -> Any:
    return xp.sqrt(_above_zero(xp, (vectors * vectors).sum(-1)))[..., None]


def _above_zero(xp: Any, values: Any) -> Any:
    """Not below the smallest number whose square root is safe to divide by."""
    return xp.clip(values, 1e-24, math.inf)


def _finite(values: Any, name: str) -> Array:
    vector: Array = real_array(values, name)
    if vector.ndim != 1 or not np.isfinite(vector).all():
        raise ValueError(f"{name}: expected finite numbers (n,), got {values!r:.80}")
    return vector
