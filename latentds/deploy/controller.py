"""Velocities for control loops: NumPy in and out, compiled from end to end where the system allows."""

from __future__ import annotations

import copy
import math
import threading
from typing import Any

import numpy as np
import torch

from ..arguments import Array, number_in, positive, real_array
from .tables import NO_SLOPES, VelocityField


class Controller:
    """The velocity field of a system as it is now, ready for a real-time loop.

    It keeps its own copy: fitting or moving the system afterwards does not change it. Any number of threads may call
    it at once. Systems of locally weighted translations with the dynamics of this package run in one compiled call
    without torch, and so does SDS-EF; they allocate nothing when ``out`` is given. Any other system is asked through
    torch, correct but slower by torch's overhead (see ``compiled``).

    Where the motion ends and how fast it runs can be set while it runs. Both may jump then, and with them the velocity;
    :meth:`approach`, once a cycle, lets them follow smoothly.

    Args:
        ds: a stable system, on any device.
        max_speed: > 0, units of y per second; a faster velocity is shortened to it, all coordinates by one factor. So
            the direction stays, V still decreases, and motions run on the same curves, only later. Limits on single
            coordinates would turn the velocity: V could rise, and the motion leaves its curve and may not arrive.

    Attributes:
        dim: n.
        compiled: whether calls bypass torch.
        max_speed: as given.
    """

    def __init__(self, ds: VelocityField, *, max_speed: float = math.inf) -> None:
        self.dim = ds.dim
        self.max_speed = number_in(max_speed, "max_speed", 0, math.inf, ends="(]")
        if not all(bool(torch.isfinite(tensor).all()) for tensor in ds.state_dict().values()):
            raise ValueError(f"ds: expected finite parameters, got {type(ds).__name__} with NaN or inf")
        self._attractor = ds.attractor.detach().to("cpu", torch.float64, copy=True).numpy()
        self._placed = np.array([*np.zeros(self.dim), 1.0, self.max_speed])  # shift, speed, limit: as the kernel has it
        self._field = ds.tables()
        self._tables = None if self._field is None else self._field.packed()
        by_torch = self._field is None or self._field.kernel(self.dim) is None
        self._ds = copy.deepcopy(ds).requires_grad_(False) if by_torch else None
        self._prepare()
        self(np.zeros(self.dim))

    @property
    def compiled(self) -> bool:
        return self._tables is not None

    @property
    def goal(self) -> Array:
        """Where motions end, (n,), read-only: the attractor until set as a whole. The motion moves with it."""
        goal: Array = self._attractor + self._placed[: self.dim]
        goal.flags.writeable = False  # an entry that is written would move nothing: set the whole
        return goal

    @goal.setter
    def goal(self, goal: Any) -> None:
        np.subtract(self._goal_of(goal), self._attractor, out=self._placed[: self.dim])

    @property
    def speed(self) -> float:
        """How many times as fast as the system, >= 0: 1 until set, 0 holds still."""
        return float(self._placed[self.dim])

    @speed.setter
    def speed(self, speed: float) -> None:
        self._placed[self.dim] = number_in(speed, "speed", 0, math.inf, ends="[)")

    def approach(self, dt: float, time_constant: float, *, goal: Any = None, speed: float | None = None) -> None:
        """Bring goal and speed nearer to new ones, by the share 1 - exp(-dt / time_constant) of what is missing.

        Called once a cycle with what is wanted then, the velocity has no jumps: a goal that jumps is followed within a
        few time constants, one that moves on steadily at the distance that it covers in one of them.

        Args:
            dt: seconds since the last call, > 0.
            time_constant: seconds, > 0.
            goal: (n,) finite; None leaves it.
            speed: >= 0; None leaves it.
        """
        share = -math.expm1(-positive(dt, "dt") / positive(time_constant, "time_constant"))
        if goal is not None:
            self.goal = self.goal + share * (self._goal_of(goal) - self.goal)
        if speed is not None:
            self.speed += share * (number_in(speed, "speed", 0, math.inf, ends="[)") - self.speed)

    def __call__(self, y: Any, out: Array | None = None) -> Array:
        """Velocity at ``y``: (..., n) -> (..., n) float64, units of y per second.

        Args:
            y: finite positions; one point (n,) is the case this is made for.
            out: where to put the answer, a C-contiguous float64 array of y's shape; returned.

        Raises:
            ValueError: for another shape, or anything but finite real numbers.
        """
        y = self._points(y)
        if out is None:
            out = np.empty_like(y)
        elif out.shape != y.shape or out.dtype != np.float64 or not (out.flags.c_contiguous and out.flags.writeable):
            raise ValueError(
                f"out: expected a writeable C-contiguous float64 array {y.shape}, got {out.dtype} {out.shape}"
            )
        if self._tables is None or self._kernel is None:
            with torch.no_grad():
                out[...] = self._ask(torch.from_numpy(_finite(y))).numpy()
            return out
        rows = y.size // self.dim
        if not self._kernel(
            *self._tables, y.reshape(rows, self.dim), out.reshape(rows, self.dim), NO_SLOPES, self._room()
        ):
            _finite(y)
        return out

    def jacobian(self, y: Any) -> Array:
        """∂f/∂y, exact, of the velocity as it is returned: its goal, speed and limit included.

        The acceleration along the motion, for feed-forward, is ``jacobian(y) @ controller(y)`` while the goal rests.
        Where a time law has a kink, as the eigenmap's has, it is that of one side.

        Args:
            y: as for a call.

        Returns:
            (..., n, n) float64, per second: [..., i, j] is the derivative of velocity i by coordinate j.
        """
        y = self._points(y)
        kernel = None if self._field is None else self._field.kernel(self.dim)
        if kernel is None:
            points = torch.from_numpy(_finite(y)).clone().requires_grad_()
            with torch.enable_grad():
                velocity = self._ask(points)
                rows = [torch.autograd.grad(v.sum(), points, retain_graph=True)[0] for v in velocity.unbind(-1)]
            return torch.stack(rows, -2).numpy()
        count, out = y.size // self.dim, np.empty((*y.shape, self.dim))
        own, slopes = y.reshape(count, self.dim), out.reshape(count, self.dim**2)
        assert self._tables is not None
        if not kernel(*self._tables, own, np.empty_like(own), slopes, self._room()):
            _finite(y)
        return out

    def __getstate__(self) -> dict[str, Any]:
        return {name: value for name, value in self.__dict__.items() if name not in ("_kernel", "_local")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._prepare()

    def _prepare(self) -> None:
        """What neither copies nor pickles hold."""
        self._local = threading.local()
        self._kernel = None if self._field is None else self._field.kernel(0)

    def _points(self, y: Any) -> Array:
        points = _real(y)
        if points.ndim == 0 or points.shape[-1] != self.dim:
            raise ValueError(f"y: expected shape (..., {self.dim}), got {points.shape}")
        return points

    def _goal_of(self, goal: Any) -> Array:
        point: Array = real_array(goal, "goal")
        if point.shape != (self.dim,) or not np.isfinite(point).all():
            raise ValueError(f"goal: expected ({self.dim},) finite numbers, got {goal!r:.80}")
        return point

    def _ask(self, y: torch.Tensor) -> torch.Tensor:
        """Through torch."""
        shift, (speed, limit) = torch.from_numpy(self._placed[: self.dim].copy()), self._placed[self.dim :]
        assert self._ds is not None
        velocity: torch.Tensor = speed * self._ds(y - shift)
        if math.isinf(limit):
            return velocity
        shortened: torch.Tensor = velocity * (
            limit / torch.linalg.vector_norm(velocity, dim=-1, keepdim=True).clamp(limit)
        )
        return shortened

    def _room(self) -> Array:
        """The kernel's, one for each thread, with goal, speed and limit as they are now."""
        try:
            room: Array = self._local.room
        except AttributeError:
            assert self._field is not None
            self._local.room = room = self._field.room()
        room[-1] = self._placed
        return room


def _finite(y: Array) -> Array:
    if not np.isfinite(y).all():
        raise ValueError(f"y: expected finite numbers, got {y}")
    return y


def _real(y: Any) -> Array:
    """``y`` itself if it is as the kernel reads it, else a copy that is."""
    try:
        array = np.asarray(y)
        if array.dtype.kind not in "fiu":
            raise TypeError
    except (TypeError, ValueError):
        raise ValueError(f"y: expected real numbers, got {type(y).__name__}") from None
    readable = array is y and array.dtype == np.float64 and array.flags.c_contiguous
    return array if readable else np.ascontiguousarray(array, dtype=np.float64)
