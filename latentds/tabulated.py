"""Formulas as numbers: what compiled code and exporters read of a map, of latent dynamics and of a law."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from .arguments import Array

LINEAR_BELOW = 1e-3
"""Progress below which laws turn linear, ṡ ∝ -s: a law that reaches the goal in finite time is not Lipschitz there."""


class Tabulated:
    """Something that can say its formula in numbers, by :meth:`table`.

    A class says so of itself alone, and likewise what is proven of it (:attr:`OF_THE_CLASS_ALONE`). A subclass may
    compute something else, which readers of its parent's numbers would not notice; so one that does not define these
    has none, whatever its parents say.
    """

    OF_THE_CLASS_ALONE = ("table", "convergence_rate_bound", "invertibility", "inverse_box")
    """Methods that a subclass does not inherit; None is what it has instead."""

    def table(self, *args: Any, **keywords: Any) -> Any:
        """None: compiled code cannot compute this."""
        return None

    def __init_subclass__(cls, **keywords: Any) -> None:
        super().__init_subclass__(**keywords)
        for name in cls.OF_THE_CLASS_ALONE:
            if name not in vars(cls) and hasattr(cls, name):
                setattr(cls, name, Tabulated.table)


class LawKind(IntEnum):
    """Which formula h(s) of :mod:`latentds.time_law` a table's numbers are for."""

    KNOTTED = 0
    EIGENMAP = 1


class LawTable(NamedTuple):
    """A time law as numbers."""

    kind: LawKind
    knots: Array
    """(m,) progress; of the eigenmap's law 1 alone"""
    speeds: Array
    """(m,) of the polygon at the knots, per second; of the eigenmap's law ω"""

    def faster(self, factor: float) -> LawTable:
        """The law of a motion that many times as fast."""
        return self._replace(speeds=self.speeds * factor)

    def pieces(self) -> Array:
        """Of a knotted law, (4, 2m+1): where its pieces start, and there h, h' and h''/2."""
        pieces: Array = rounded_pieces(torch.from_numpy(self.knots), torch.from_numpy(self.speeds))[:4].numpy()
        return pieces

    def packed(self) -> Array:
        """For the velocity kernel: a row of the kind, and below it the pieces, or knots and speeds of the eigenmap."""
        rows = self.pieces() if self.kind is LawKind.KNOTTED else np.stack([self.knots, self.speeds])
        return np.vstack([np.full(rows.shape[1], float(self.kind)), rows])


def rounded_pieces(knots: Tensor, speeds: Tensor) -> Tensor:
    """The quadratic pieces of a law that is linear between its knots but for its corners, which parabolas round.

    A corner is round over half of the smaller gap beside it, to either side; the piece behind the last has no end.

    Args:
        knots: (m,) progress, increasing from above 0.
        speeds: (m,) of the polygon at the knots, per second.

    Returns:
        (5, 2m+1), straight and round pieces in turn: the progress where each starts, and there h, h' and h''/2, and the
        discriminant h'² - 2 h h'', which is the same all over a piece.
    """
    none = torch.zeros_like(knots[:1])
    from_zero = torch.cat([none, knots]).diff()
    slopes = torch.cat([torch.cat([none, speeds]).diff() / from_zero, none])
    half = torch.minimum(from_zero, torch.cat([from_zero[1:], from_zero[-1:]])) / 2
    before, after = speeds - slopes[:-1] * half, speeds + slopes[1:] * half
    # Of the ends and the knot between, as h'² and 2 h h'' would cancel where h falls to a small part of itself.
    discriminant = (speeds.square() - before * after) / half.square()
    begins, speed = (torch.cat([none, part]) for part in (knots + half, after))
    straight = torch.stack([begins, speed, slopes, torch.zeros_like(slopes), slopes.square()])
    curved = torch.stack([knots - half, before, slopes[:-1], slopes.diff() / (4 * half), discriminant])
    return torch.cat([torch.stack([straight[:, :-1], curved], dim=-1).flatten(1), straight[:, -1:]], dim=1)
