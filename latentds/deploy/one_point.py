"""The velocity at a single point, for who asks a system itself, one position after the other."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor, nn

from ..arguments import Array
from ..kernels.dispatch import is_plain, no_active_transforms, rows_of
from ..kernels.private import structure_of, tensors_of
from ..memo import Memo
from .tables import NO_SLOPES, Kernel, VelocityField


class OnePoint:
    """What a controller would answer, by tables that are kept until something in the system changes.

    Torch's own overhead is ten times what the answer takes, and that of making the tables as much again.
    """

    def __init__(self) -> None:
        self._memo = Memo[tuple[Kernel, tuple[Array, ...], Array] | None]()

    def velocity(self, ds: VelocityField, point: Tensor) -> Tensor | None:
        """ẏ at a point, (..., n) of one row, in its dtype; None where torch is to compute it.

        That is: for several points, for a derivative or a transform, for a point that is not finite, and where there
        are no tables.
        """
        assert isinstance(ds, nn.Module)
        if not (no_active_transforms() and is_plain(point, ds.attractor.dtype) and point.numel() == ds.dim):
            return None
        tensors = tensors_of(ds)
        if torch.is_grad_enabled() and any(tensor.requires_grad for tensor in (point, *tensors)):
            return None
        structure = structure_of(ds) if all(tensor.is_cpu for tensor in tensors) else None
        if structure is None or object in map(type, structure):
            return None
        known = self._memo.of(structure, tensors, lambda: _compiled(ds))
        if known is None:
            return None
        kernel, packed, room = known
        row = rows_of(point)
        out = np.empty_like(row)
        if not kernel(*packed, row, out, NO_SLOPES, room.copy()):  # several threads may ask at once
            return None
        return torch.from_numpy(out).to(point.dtype).reshape(point.shape)


def _compiled(ds: VelocityField) -> tuple[Kernel, tuple[Array, ...], Array] | None:
    tables = ds.tables()
    kernel = None if tables is None else tables.kernel(0)
    if tables is None or kernel is None or not all(np.isfinite(array).all() for array in tables.packed()):
        return None
    room = tables.room()
    room[-1] = [*np.zeros(ds.dim), 1.0, math.inf]
    return kernel, tables.packed(), room
