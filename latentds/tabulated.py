"""Formulas as numbers: what compiled code and exporters read of a map, of latent dynamics and of a law."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np

from .arguments import Array


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

    PIECEWISE_LINEAR = 0
    EIGENMAP = 1


class LawTable(NamedTuple):
    """A time law as numbers."""

    kind: LawKind
    knots: Array
    """(m,) progress; of the eigenmap's law 1 alone"""
    speeds: Array
    """(m,) h at the knots, per second; of the eigenmap's law ω"""

    def faster(self, factor: float) -> LawTable:
        """The law of a motion that many times as fast."""
        return self._replace(speeds=self.speeds * factor)

    def pieces(self) -> Array:
        """A piecewise linear law from 0 on, the last piece without end: (3, m+1) starts, speeds there, slopes."""
        starts, speeds = np.insert(np.stack([self.knots, self.speeds]), 0, 0.0, axis=1)
        return np.stack([starts, speeds, np.append(np.diff(speeds) / np.diff(starts), 0.0)])

    def packed(self) -> Array:
        """For the velocity kernel, (3, m): the kind in each entry, the knots, the speeds."""
        return np.stack([np.full(self.knots.shape, float(self.kind)), self.knots, self.speeds])
