"""A fitted velocity field as plain arrays: what controllers and exporters read."""

from __future__ import annotations

from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from ..diffeomorphism import Diffeomorphism
from ..dynamics import Frame, LatentDynamics

Array = NDArray[np.float64]
Self = TypeVar("Self", bound="VelocityField")


class FieldTables(NamedTuple):
    """Layers of translations, and latent dynamics that move at one rate along an axis and at another across it."""

    layers: Array
    """(M, 2n+2) a row (c, v, ρ², ρ²‖v‖²) per layer, first to last"""
    goal: Array
    """(3, n) x*, the axis u (zeros: all of the offset counts as across), and the length ℓ in each entry"""
    along: Array
    """(2, m) the time law along the axis, see :meth:`latentds.time_law.TimeLaw.table`"""
    across: Array
    """(2, m) the time law across it"""


class VelocityField(Protocol):
    """What is deployed: any :class:`~latentds.StableDS`."""

    dim: int

    def tables(self) -> FieldTables | None: ...

    def __call__(self, y: Tensor) -> Tensor: ...

    def requires_grad_(self: Self, requires_grad: bool = True) -> Self: ...


def field_tables(psi: Diffeomorphism, dynamics: LatentDynamics, frame: Frame) -> FieldTables | None:
    """The field J_ψ(x) g(x), x = ψ⁻¹(y), as arrays; None where one of the two cannot be written so."""
    layers, moves = psi.layer_table(), dynamics.tables(frame)
    return None if layers is None or moves is None else FieldTables(layers, *moves)
