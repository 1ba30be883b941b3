"""A fitted velocity field as plain arrays: what controllers and exporters read."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from torch import Tensor

from ..arguments import Array
from ..diffeomorphism import Diffeomorphism
from ..dynamics import Frame, LatentDynamics
from ..kernels.velocity import velocity_kernel
from ..tabulated import LawTable
from . import c_text

Self = TypeVar("Self", bound="VelocityField")

Kernel = Callable[..., bool]
"""(*arrays, points (m, n), velocities (m, n), slopes, room) -> whether all points were finite."""


NO_SLOPES: Array = np.empty((1, 0))
"""Where the kernel puts derivatives when none are asked."""


class Compiled(Protocol):
    """A velocity field as numbers that a compiled function reads."""

    def packed(self) -> tuple[Array, ...]:
        """The arrays that the function takes first."""

    def kernel(self, tangents: int) -> Kernel | None:
        """The function, which also gives derivatives by so many coordinates; None if it cannot."""

    def room(self) -> Array:
        """What the function works in; its last row is for the shift (n), the speed and the limit."""

    def in_c(self, name: str, real: str) -> str:
        """The field in C99: ``NAME_velocity`` if ``real`` is "double", ``NAME_velocityf`` if it is "float"."""


class FieldTables(NamedTuple):
    """Layers of translations, and latent dynamics that move at one rate along an axis and at another across it."""

    layers: Array
    """(M, 2n+2) a row (c, v, ρ², ρ²‖v‖²) per layer, first to last"""
    goal: Array
    """(3, n) x*, the axis u (zeros: all of the offset counts as across), and the length ℓ in each entry"""
    along: LawTable
    """the time law along the axis"""
    across: LawTable
    """the time law across it"""

    def packed(self) -> tuple[Array, Array, Array, Array]:
        return self.layers, self.goal, self.along.packed(), self.across.packed()

    def straight(self) -> FieldTables:
        """Those of straight latent motions: all of the offset shrinks as it does along the axis."""
        goal = self.goal.copy()
        goal[1] = 0
        return self._replace(goal=goal, across=self.along)

    def kernel(self, tangents: int) -> Kernel:
        function: Kernel = velocity_kernel(self.goal.shape[1], tangents)
        return function

    def room(self) -> Array:
        dim = self.goal.shape[1]
        return np.empty((len(self.layers) + 2 + dim, dim + 2))

    def in_c(self, name: str, real: str) -> str:
        return c_text.translations(*self, name, real)


class VelocityField(Protocol):
    """What is deployed: any :class:`~latentds.StableDS`."""

    dim: int
    attractor: Tensor

    def tables(self) -> Compiled | None: ...

    def state_dict(self) -> dict[str, Tensor]: ...

    def __call__(self, y: Tensor) -> Tensor: ...

    def requires_grad_(self: Self, requires_grad: bool = True) -> Self: ...


def compiled_of(ds: VelocityField) -> Compiled:
    """The numbers of a system, of whatever kind, for an exporter.

    Raises:
        ValueError: if it has none, naming what cannot be written so, or if one of them is not finite.
    """
    tables = ds.tables()
    if tables is None:
        raise _not_written(ds)
    if not all(np.isfinite(table).all() for table in tables.packed()):
        raise ValueError(f"ds: expected finite parameters, got {type(ds).__name__} with NaN or inf")
    return tables


def tables_of(ds: VelocityField) -> FieldTables:
    """As :func:`compiled_of`, of a system of translations; refuses any other."""
    tables = compiled_of(ds)
    if not isinstance(tables, FieldTables):
        raise _not_written(ds)
    return tables


def _not_written(ds: VelocityField) -> ValueError:
    psi, dynamics, frame = (getattr(ds, name, None) for name in ("diffeomorphism", "dynamics", "frame"))
    if isinstance(psi, Diffeomorphism) and psi.table() is None:
        missing = f"its diffeomorphism {type(psi).__name__} has no table()"
    elif isinstance(dynamics, LatentDynamics) and frame is not None and dynamics.table(frame()) is None:
        missing = f"its dynamics {type(dynamics).__name__}, or a time law of theirs, have no table()"
    else:
        missing = "its velocity is its own, and its tables() do not say how to write it"
    return ValueError(f"ds: expected a system that can be written as tables, got {type(ds).__name__}: {missing}")


def describe(ds: VelocityField) -> dict[str, str]:
    """What an exported file says of the system it was made of, in printable ASCII."""
    learned_from = getattr(getattr(ds, "fit_report", None), "learned_from", ())
    shown = ", ".join(f"{name or 'unnamed'} (SHA-256 {digest})" for name, digest in learned_from)
    entries = {
        "method": type(ds).__name__,
        "dim": str(ds.dim),
        "goal": ", ".join(repr(float(value)) for value in ds.attractor),
        "units": "position as in the demonstration, velocity in those per second",
        "learned from": shown or "nothing: not fitted",
        "written": datetime.date.today().isoformat(),
    }
    return {key: re.sub(r"[^ -~]|[*?/\\]", "_", text) for key, text in entries.items()}  # harmless in a C comment too


def field_tables(psi: Diffeomorphism, dynamics: LatentDynamics, frame: Frame) -> FieldTables | None:
    """The field J_ψ(x) g(x), x = ψ⁻¹(y), as arrays; None where one of the two cannot be written so."""
    layers, moves = psi.table(), dynamics.table(frame)
    return None if layers is None or moves is None else FieldTables(layers, *moves)
