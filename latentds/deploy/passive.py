"""Forces instead of velocities: passive control of a robot that people touch, after Kronander and Billard (2016)."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..arguments import Array, number_in, positive, whole_number

RESERVE = 0.05
"""Share of the tank's capacity below which the drive fades, so that it does not stop with a jump."""


class PassiveController:
    """F = -D(x) (ẋ - f(x)): the field as forces that give in when pushed, and never feed energy without bound.

    D damps ``along`` the field's direction and ``across`` it. Its part -D ẋ only takes energy; its part D f, the drive,
    may give some, as no learned field is the gradient of a potential. Every joule that the force gives comes out of a
    tank, and what it takes fills the tank up to its capacity. Where the tank runs empty the drive fades and the robot
    can be moved, but does not go by itself until somebody pushes energy in.

    What was given is not taken from a model: it is the force that was held over the last cycle times the way that was
    measured in it. So at any time the robot has been given at most ``energy`` and what one cycle may overdraw,
    whatever f is, and however the force is limited. A mechanical system with the force F from outside is then passive
    from F to its velocity: its kinetic energy and the tank never rise by more than what is pushed in.

    Torques of an arm are g(q) + Jᵀ F, with J of the tool; for a field of joint positions they are g(q) + F. One
    controller is one loop: it is not to be shared between threads.

    Args:
        field: (n,) position -> (n,) velocity; it is called as ``field(x, out=velocity)``, as
            :class:`latentds.deploy.controller.Controller` is.
        dim: n.
        along: > 0, damping in the field's direction, force per velocity (N s/m): how stiffly its speed is kept.
        across: > 0, in all other directions: how stiffly the robot stays on its curve. It yields where this is small.
        energy: > 0, in joules, that the tank can hold and holds at first. The motion needs its largest kinetic energy,
            some more where friction takes some, and as much again to overcome what people do.
        max_force: > 0; a larger force is shortened, all coordinates by one factor.

    Attributes:
        tank: joules that are left; :meth:`reset` fills it.

    Source: Kronander and Billard, "Passive interaction control with dynamical systems", RA-L 1 (2016).
    """

    def __init__(
        self,
        field: Callable[..., Any],
        dim: int,
        *,
        along: float,
        across: float,
        energy: float,
        max_force: float = math.inf,
    ) -> None:
        self.field = field
        self.dim = whole_number(dim, "dim", at_least=1)
        self.along, self.across = positive(along, "along"), positive(across, "across")
        self.energy = positive(energy, "energy")
        self.max_force = number_in(max_force, "max_force", 0, math.inf, ends="(]")
        self._wanted, self._force, self._velocity = (np.zeros(self.dim) for _ in range(3))
        self.tank = self.energy

    def reset(self) -> None:
        """Fill the tank, and forget the last cycle: before a motion begins, or once somebody allows more energy."""
        self.tank = self.energy
        self._force[:] = 0

    def __call__(self, x: Array, velocity: Array, dt: float, out: Array | None = None) -> Array:
        """The force to hold until the next call.

        Args:
            x: (n,) position, as the field takes it.
            velocity: (n,) ẋ, measured.
            dt: seconds since the last call, > 0.
            out: (n,) float64 for the answer; returned. Nothing is allocated here if it is given.

        Raises:
            ValueError: for another shape, or velocities or a dt that are no finite numbers; the field says so of x. The
                tank is then what it was.
        """
        if getattr(velocity, "shape", None) != (self.dim,) or not math.isfinite(velocity.dot(velocity)):
            raise ValueError(f"velocity: expected ({self.dim},) finite numbers, got {velocity!r:.80}")
        if not 0 < dt < math.inf:
            raise ValueError(f"dt: expected seconds > 0, got {dt!r:.80}")
        wanted = self.field(x, out=self._wanted)
        speed_squared = wanted.dot(wanted)
        if not math.isfinite(speed_squared):
            raise ValueError(f"field: expected finite velocities, got {wanted!r:.80}")
        force = self._force
        # The trapezoid of the measured velocities is the way of the last cycle; the force was held over it.
        given = 0.5 * dt * (force.dot(self._velocity) + force.dot(velocity))
        self.tank = min(self.energy, self.tank - given)
        self._velocity[:] = velocity
        forward = wanted.dot(velocity) / speed_squared if speed_squared > 0 else 0.0  # share of f that ẋ has
        # Also where the drive would brake: from rest, the cycle after it would give.
        share = min(1.0, max(0.0, self.tank / (RESERVE * self.energy)))
        power = self.along * forward * speed_squared
        if share * power * dt > self.tank:
            share = max(0.0, self.tank) / (power * dt)
        np.multiply(velocity, -self.across, out=force)
        self._wanted *= self.along * share - (self.along - self.across) * forward
        force += self._wanted
        size = math.sqrt(force.dot(force))
        if size > self.max_force:
            force *= self.max_force / size
        if out is None:
            out = np.empty(self.dim)
        np.copyto(out, force)
        return out
