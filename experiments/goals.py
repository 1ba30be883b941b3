"""What a study asks for, and what it reached."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from experiments import report

Array = NDArray[np.float64]


class Goal(NamedTuple):
    """One line of the table."""

    what: str
    goal: str
    reached: str
    quartiles: str = ""
    """Over the rounds of a measurement."""
    unit: str = ""
    met: bool | None = None
    """None: not measured, or reported without a goal."""
    note: str = ""


def table(goals: Sequence[Goal]) -> str:
    """A line per goal, without the columns that none of them fills."""
    met = {None: "—", True: "yes", False: "**no**"}
    lines = [[met[cell] if name == "met" else cell for name, cell in g._asdict().items()] for g in goals]
    filled = [i for i, column in enumerate(zip(*lines, strict=True)) if any(column)]
    return report.table([Goal._fields[i] for i in filled], [[line[i] for i in filled] for line in lines])


def at_most(what: str, values: pd.Series[float], bound: float, unit: str = "") -> Goal:
    """That none is larger than ``bound``; names those that are."""
    if values.empty:
        return Goal(what, f"≤ {bound:g}{unit}", "not measured")
    over = values[~(values <= bound)]
    reached = f"{values.max():.3g}{unit}"
    if len(over) and len(values) > 1:
        reached += f"; above it: {', '.join(f'{name} {value:.3g}' for name, value in over.items())}"
    return Goal(what, f"≤ {bound:g}{unit}", reached, met=over.empty)


def median(what: str, unit: str, bound: float, rounds: Array, *, at_most: bool = False, note: str = "") -> Goal:
    """That the median over the rounds is at least ``bound``, or at most."""
    low, reached, high = np.quantile(rounds, (0.25, 0.5, 0.75))
    met = bool(reached <= bound if at_most else reached >= bound)
    return Goal(
        what, f"{'≤' if at_most else '≥'} {bound:g}", f"{reached:.3g}", f"{low:.3g} to {high:.3g}", unit, met, note
    )


def ratio(what: str, least: float, slow: Array, fast: Array) -> Goal:
    """That ``slow`` takes ``least`` times longer than ``fast``: of medians, with the quartiles round by round."""
    reached = float(np.median(slow) / np.median(fast))
    note = f"{_time(np.median(slow))} against {_time(np.median(fast))}"
    line = median(what, "times faster", least, slow / fast, note=note)
    return line._replace(reached=f"{reached:.3g}", met=reached >= least)


def _time(seconds: np.floating) -> str:
    scales = (("s", 1), ("ms", 1e3), ("µs", 1e6))
    return next(f"{seconds * scale:.3g} {unit}" for unit, scale in scales if seconds * scale >= 1)
