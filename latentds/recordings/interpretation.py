"""Which columns of a table are the time and which the positions: said in one line, or asked where it is ambiguous."""

from __future__ import annotations

import difflib
import itertools
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..arguments import Array, positive
from . import vocabulary
from .episodes import split
from .readers import Table, counts_rows
from .vocabulary import POSITION_KINDS, UNITS, has_word, is_step, kind_of, kinds_of

Names = str | int | Sequence[str | int]
"""Of a column, or of an array with all its columns, or a column's number from 0; or several."""
EVERYDAY_STEP = (2e-4, 2.0)
"""Seconds between two rows of a recording that nobody needs to ask about: 5 kHz to one in two seconds."""
EVERYDAY_DURATION = (0.05, 3600.0)
"""Seconds that such a recording takes."""
EVERYDAY_DATE = (9e8, 4e9)
"""Seconds since 1970 of the years 1998 to 2096."""
MOST_REPEATED = 0.05
"""Share of rows with the time of the row before that are left out; more of them are a clock that is too coarse."""
GAP = 10.0
"""A step of so many usual ones is told as a gap in the recording."""
LYING = 10
"""Rows and columns of an array without time: so many times as many columns as rows, and it is transposed."""
ASK_ABOVE_COLUMNS = 200
"""Positions of more columns are asked about."""
EVEN_WITHIN = 0.2
"""Standard deviation of steps that count as even, in mean steps."""
DERIVATIVE_WITHIN = 0.3
"""Distance of columns from the derivative of others, in their own length, up to which they are taken for it."""


@dataclass(frozen=True)
class Motion:
    """(N, n) ``positions`` at (N,) ``times``, seconds from the first row, or ``dt`` seconds apart.

    ``columns``: n names, or none if the recording has none; ``origin``: one line that says what was taken for what;
    ``ours``: whether :meth:`~latentds.Demonstration.save` wrote it.
    """

    positions: Array
    times: Array | None
    dt: float | None
    columns: tuple[str, ...]
    origin: str
    ours: bool


@dataclass(frozen=True, eq=False)
class _Column:
    """(N,) numbers: all of the array ``block``, or one of its columns, whose ``label`` is "" if it is numbered.

    ``unit`` is that of time that its name tells, if any; dates are in seconds from the first one.
    """

    name: str
    block: str
    kind: str
    values: Array
    label: str
    unit: str | None


class _Timing(NamedTuple):
    """When the rows were: ``times`` or ``dt`` as in :class:`Motion`, what to say of it, and the columns it takes."""

    text: str
    columns: tuple[str, ...]
    times: Array | None = None
    dt: float | None = None


class Asked(NamedTuple):
    """The arguments of :meth:`~latentds.Demonstration.load`."""

    columns: Names | None
    time: str | int | None
    unit: str | None
    dt: float | None


def interpret(table: Table, label: str, asked: Asked, episode: str | int | None) -> Motion:
    """Tell time and positions of one motion in a table from names and numbers, or ask.

    ``label`` is what messages call it.

    Raises:
        ValueError: if it is ambiguous, names the argument that settles it and says what was seen.
    """
    how, parts = split(table)
    if episode is None and parts and asked.columns is None:
        raise ValueError(
            f"episode: expected one motion, got {len(parts)} in {label}, by {how}: {_shortened(list(parts))}; "
            "pass episode=, or take all of them: Demonstration.load_all"
        )
    if episode is not None:
        if str(episode) not in parts:
            known = f"one of {_shortened(list(parts))}" if parts else f"none, since {label} holds one motion"
            raise ValueError(f"episode: expected {known}, got {episode!r}")
        table, label = parts[str(episode)], f"{label}[{episode}]"
    return _one(table, label, asked)


def interpret_all(table: Table, label: str, asked: Asked) -> dict[str, Motion]:
    """Each motion in a table by its label, "" if there is but one."""
    _, parts = split(table)
    if not parts:
        return {"": _one(table, label, asked)}
    return {name: _one(part, f"{label}[{name}]", asked) for name, part in parts.items()}


def _one(table: Table, label: str, asked: Asked) -> Motion:
    columns, time, unit, dt = asked
    if unit is not None and not (isinstance(unit, str) and unit in vocabulary.UNIT_WORDS):
        raise ValueError(f"unit: expected one of {', '.join(UNITS)}, got {unit!r}")
    if dt is not None:
        dt = positive(dt, "dt")
        if time is not None or unit is not None:
            raise ValueError("dt: expected either dt or time and unit, got both")
    return _Interpretation(table, label, unit).motion(columns, time, dt)


class _Interpretation:
    """One table, sorted into scalars, texts and columns, and what is asked and remarked about it."""

    def __init__(self, table: Table, label: str, unit: str | None) -> None:
        self.label = label
        self.unit = unit and vocabulary.UNIT_WORDS[unit]
        self.remarks: list[str] = []
        self.ours = list(table) == ["t [s]", *(f"y{i}" for i in range(len(table) - 1))]
        self.ours |= set(table) - {"columns"} == {"positions", "dt", "name"}
        arrays = self._one_row_per_stamp({name: _squeezed(array) for name, array in table.items()})
        self.texts = {name: a for name, a in arrays.items() if a.dtype.kind == "U"}
        numbers = {name: a for name, a in arrays.items() if a.dtype.kind in "fiuMm"}
        self.seen = {name: a for name, a in numbers.items() if a.ndim}
        self.scalars = {name: a for name, a in numbers.items() if a.ndim == 0}
        self.arrays = {name: a for name, a in numbers.items() if 1 <= a.ndim <= 2 and a.size}
        counts = {len(a) for name, a in self.arrays.items() if a.ndim == 1 and _is_clock(name, a)}
        for name, array in self.arrays.items():
            fits = array.ndim == 2 and (array.shape[1] in counts or (not counts and _lies(array)))
            if fits and len(array) not in counts:
                self.arrays[name] = array.T
                self.remarks.append(f"{name or 'the array'} transposed to (N, n)")
        kinds = zip(self.arrays, kinds_of(list(self.arrays)), strict=True)
        self.columns = [column for name, kind in kinds for column in self._columns_of(name, kind)]

    def motion(self, columns: Names | None, time: str | int | None, dt: float | None) -> Motion:
        clock = [] if time is None else self._named([time], "time")
        if len(clock) > 1:
            raise ValueError(f"time: expected one column, got {len(clock)}: {_listed(clock)}")
        if columns is None:
            chosen = self._positions([c for c in self.columns if c not in clock])
        else:
            chosen = self._named([columns] if isinstance(columns, (str, int)) else columns, "columns")
            if not chosen:
                raise ValueError("columns: expected at least one, got none")
        counts = {len(c.values) for c in chosen}
        if len(counts) > 1:
            self._ask("columns", f"expected columns of one length, got {_listed(chosen)} of {sorted(counts)} rows")
        count = counts.pop()

        timing = self._timing(chosen, clock, columns is None, dt, count)
        if columns is None:
            chosen = [c for c in chosen if c.name not in timing.columns]
            self._ask_about_shape(chosen, count)
        elif any(self.arrays[c.block].ndim == 2 and count < self.arrays[c.block].shape[1] for c in chosen):
            self._ask_about_shape([c for c in self.columns if c.block == chosen[0].block], count)
        positions = np.stack([c.values for c in chosen], axis=1)
        if timing.times is not None:
            positions, timing = self._once_a_stamp(positions, timing)
        if columns is None and all(c.kind == "unknown" for c in chosen):
            self._ask_about_derivatives(chosen, positions, timing)
        used = {c.name for c in chosen} | set(timing.columns)
        parts = [f"{count} rows", timing.text, f"positions {_listed(chosen)}"]
        if unused := [c for c in self.columns if c.name not in used]:
            parts.append("left out " + ", ".join(_by_kind(unused)))
        labels = tuple(c.label for c in chosen)
        if not all(labels) or len(set(labels)) < len(labels) or (self.ours and "columns" not in self.texts):
            labels = ()
        origin = f"{self.label}: {'; '.join([*parts, *self.remarks])}"
        return Motion(positions, timing.times, timing.dt, labels, origin, self.ours)

    # Columns -------------------------------------------------------------------------------------------------------

    def _columns_of(self, block: str, kind: str) -> list[_Column]:
        array, dated = self.arrays[block], None
        if array.dtype.kind in "Mm":
            array, kind, dated = (array - array[0]) / np.timedelta64(1, "ns") * 1e-9, "time", "s"
        labels = names = [block]
        if array.ndim == 2:
            labels = self._labels(array.shape[1])
            names = [label or str(i) for i, label in enumerate(labels)]
            names = [f"{block}[{name}]" for name in names] if block else names
        values = array.astype(np.float64).reshape(len(array), -1).T
        return [
            _Column(name, block, kind, column, label, dated or vocabulary.unit_in(name))
            for name, column, label in zip(names, values, labels, strict=True)
        ]

    def _labels(self, count: int) -> list[str]:
        """Names of an array's columns, if the file gives them beside it."""
        for name, text in self.texts.items():
            rows = text if text.ndim == 2 else text[None]
            if has_word(name, vocabulary.LABEL_WORDS) and rows.shape[-1] == count == len(set(rows[0])):
                if (rows != rows[0]).any():
                    self._ask("columns", f"expected one order of names, which change in {name!r} from row to row")
                return [str(label) for label in rows[0]]
        return [""] * count

    def _named(self, wanted: Iterable[Any], argument: str) -> list[_Column]:
        """The columns of these names and numbers, of all columns of an array if it is the array's name."""
        columns: list[_Column] = []
        for name in wanted:
            match = [c for c in self.columns if c.name == name] or [c for c in self.columns if c.block == name]
            match = match or [c for c in self.columns if c.name.startswith(f"{name}/")]
            if isinstance(name, (int, np.integer)) and not isinstance(name, bool) and name >= 0:
                match = self.columns[name : name + 1]
            if not match:
                near = difflib.get_close_matches(str(name), [*self.arrays, *(c.name for c in self.columns)], 1)
                meant = f", perhaps {near[0]!r}" if near else ""
                self._ask(argument, f"expected names or numbers of columns{meant}, got {name!r}")
            columns += match
        return columns

    def _positions(self, columns: list[_Column]) -> list[_Column]:
        """The columns that are positions by their names, or those whose names say nothing at all."""
        for name, text in self.texts.items():
            kind = "labels" if has_word(name, vocabulary.LABEL_WORDS) else kind_of(name)
            if text.ndim == 1 and len(text) > 2 and kind in POSITION_KINDS:
                raise ValueError(f"path: {self.label} is not a table of numbers ({str(text[0])!r} in column {name!r})")
        named = [c for c in columns if c.kind in POSITION_KINDS]
        unknown = [c for c in columns if c.kind == "unknown"]
        positions = named or unknown
        if not positions:
            self._ask("columns", f"expected columns of positions, got {', '.join(_by_kind(columns)) or 'none'}")
        count = len(positions[0].values)
        left = [c for c in columns if c.kind not in (*POSITION_KINDS, "time", "other") and len(c.values) == count]
        doubtful = [c for c in left if c.kind == "unknown" and _may_move(c.values)] if named else []
        if doubtful and not self.ours:
            self._ask(
                "columns", f"expected to know whether {_listed(doubtful)} belong to the positions {_listed(named)}"
            )
        if named and left and all(c.kind == "orientation" for c in named):
            self._ask("columns", f"expected positions beside the orientation {_listed(named)}")
        self._ask_about_sets(positions)
        quantities = Counter(vocabulary.quantity_of(c.name) for c in named)
        twice = [quantity for quantity, times in quantities.items() if times > 1]
        twice += [c.name for c in positions if re.search(r" \(\d+\)$", c.name)]
        if twice:
            self._ask("columns", f"expected each position once, got several of {twice[0]!r}")
        return positions

    def _one_row_per_stamp(self, arrays: Table) -> Table:
        """Side by side what a table with one row per stamp and joint has below each other."""
        for name, text in arrays.items():
            if text.dtype.kind != "U" or text.ndim != 1 or len(text) < 2:
                continue
            each = len(set(text))
            clock = [n for n, a in arrays.items() if a.shape == text.shape and _is_clock(n, a)]
            if each < 2 or len(text) % each or not clock:
                continue
            rows = {n: a.reshape(-1, each) for n, a in arrays.items() if a.shape == text.shape}
            if (rows[name] != text[:each]).any() or any((rows[n] != rows[n][:, :1]).any() for n in clock):
                continue
            self.remarks.append(f"{each} rows per time, one for each {name!r}, set side by side")
            return arrays | rows | {n: rows[n][:, 0] for n in clock} | {name: text[:0], "names": text[:each]}
        return arrays

    # Time ----------------------------------------------------------------------------------------------------------

    def _timing(self, chosen: list[_Column], clock: list[_Column], free: bool, dt: float | None, count: int) -> _Timing:
        """From the arguments, from names, from a number beside the arrays, or from what rises evenly, in this order.

        ``free``: nobody said that the ``chosen`` columns are the positions, so one of them may be the time.
        """
        taken = {id(c) for c in chosen}
        others = [c for c in self.columns if id(c) not in taken and len(c.values) == count]
        unknown = [c for c in others if c.kind == "unknown" and c.kind != chosen[0].kind]
        pool = others if not free else [*(chosen if len(chosen) > 1 else []), *unknown]
        rising = [c for c in pool if c.kind == "unknown" and _is_even(c.values)]
        unnamed = [c for c in rising if free and self.arrays[c.block].ndim == 2]
        if dt is not None:
            return _Timing(f"dt {dt:g} s as asked", self._row_numbers(unnamed), dt=dt)
        if clock:
            if len(clock[0].values) != count:
                raise ValueError(f"time: expected {count} rows as in the positions, got {len(clock[0].values)}")
            return self._in_seconds(clock[0], " as asked")
        if named := self._named_stamps(count, set() if free else {c.name for c in chosen}):
            timing = self._in_seconds(self._one_of(named), "")
            timing = timing._replace(columns=timing.columns + self._row_numbers(unnamed))
            self._ask_about_two_answers(timing.times)
            return timing
        if (stated := self._stated_dt(count)) is not None:
            name, steps = stated
            if isinstance(steps, np.ndarray):
                return self._in_seconds(_Column(name, name, "time", steps, name, None), " (steps, added up)")
            self._ask_about_dt(steps, name, count)
            return _Timing(f"dt {steps:g} s from {name!r}", (name, *self._row_numbers(unnamed)), dt=steps)
        if len(rising) == 1:
            return self._in_seconds(rising[0], " (it rises evenly)")
        if rising:
            seen = _listed(rising)
            self._ask("time", f"expected one column that rises evenly, got {seen}; if none is time, pass dt=")
        for name, text in self.texts.items():
            if vocabulary.is_time(name) and text.ndim == 1 and len(text):
                self._ask("dt", f"expected numbers or dates as the time, got text such as {str(text[0])!r} in {name!r}")
        self._ask("dt", "expected the seconds between two rows, which nothing here tells (or time=, a column)")

    def _row_numbers(self, rising: list[_Column]) -> tuple[str, ...]:
        """The name of a first column that merely counts rows; asks if it could be the time."""
        if not rising:
            return ()
        name = rising[0].name
        if not counts_rows(rising[0].values):
            self._ask(
                "columns", f"expected to know whether column {name}, which rises evenly as time does, is a position"
            )
        self.remarks.append(f"column {name} counts rows")
        return (name,)

    def _once_a_stamp(self, positions: Array, timing: _Timing) -> tuple[Array, _Timing]:
        """Without rows whose stamp is that of the row before; gaps are told."""
        times: Any = timing.times
        steps = np.diff(times)
        kept = np.append(True, steps > 0)
        again = np.flatnonzero(~kept)
        if len(again):
            rows = f"{len(again)} row{'s' * (len(again) > 1)} with the time of the row before"
            self.remarks.append(f"left out {rows}, such as row {again[0]}")
        usual = float(np.median(steps[steps > 0]))
        for row in np.flatnonzero(steps > GAP * usual)[:3]:
            longer = f"{steps[row] / usual:.0f} times the usual step"
            self.remarks.append(f"a gap of {steps[row]:.3g} s after row {row}, {longer}, is bridged by a straight line")
        return positions[kept], timing._replace(times=times[kept])

    def _named_stamps(self, count: int, taken: set[str]) -> list[_Column]:
        stamps = [c for c in self.columns if c.kind == "time" and len(c.values) == count and c.name not in taken]
        for whole in [s for s in stamps if s.unit == "s"]:
            for rest in [s for s in stamps if s.unit == "ns"]:
                siblings = vocabulary.words_of(whole.name)[:-1] == vocabulary.words_of(rest.name)[:-1]
                if siblings and rest.values.max() < 1e9:  # whole seconds with nanoseconds beside, as ROS writes them
                    values = whole.values - whole.values[0] + 1e-9 * rest.values
                    both = replace(whole, name=f"{whole.name} + {rest.name}", values=values)
                    stamps = [*(s for s in stamps if s not in (whole, rest)), both]
        return stamps

    def _one_of(self, named: list[_Column]) -> _Column:
        named = [s for s in named if (np.diff(s.values) >= 0).all()] or named[:1]
        named = [s for s in named if not counts_rows(s.values)] or named
        if len(named) > 1:
            durations = [(s.values[-1] - s.values[0]) * UNITS[self._unit(s)] for s in named]
            if max(durations) > 1.01 * min(durations):
                names = ", ".join(repr(s.name) for s in named)
                self._ask("time", f"expected one column of time, got {names}, which differ")
        return next((s for s in named if has_word(s.name, {"stamp", "stamps"})), named[0])

    def _in_seconds(self, stamps: _Column, how: str) -> _Timing:
        name, values = stamps.name, stamps.values
        if not np.isfinite(values).all():
            row = int(np.argmin(np.isfinite(values)))
            raise ValueError(f"time: expected finite numbers in column {name!r} of {self.label}, got none in row {row}")
        steps = np.diff(values)
        if (steps < 0).any() or (steps == 0).mean() > MOST_REPEATED:
            row = int(np.argmin(steps))
            raise ValueError(
                f"times: expected strictly increasing, got {values[row]:.15g} then {values[row + 1]:.15g} "
                f"at row {row} of {name!r} in {self.label}; pass time= or dt="
            )
        source = "as asked" if self.unit else "as it says" if stamps.unit else "the unit that makes sense"
        unit = self._unit(stamps)
        times = (values - values[0]) * UNITS[unit]
        text = f"time {name!r}{how} in {unit}, {source}: {times[-1]:.4g} s"
        return _Timing(text, tuple(name.split(" + ")), times)

    def _unit(self, stamps: _Column) -> str:
        if self.unit is not None:
            return self.unit
        values = stamps.values
        steps = np.diff(values)
        step, duration = float(np.median(steps[steps > 0])), float(values[-1] - values[0])
        possible = [u for u, seconds in UNITS.items() if _is_everyday(step * seconds, duration * seconds)]
        if stamps.unit in possible or self.ours:
            return stamps.unit or "s"
        rows = f"steps of {step:.4g}, {duration:.4g} in all, in column {stamps.name!r}"
        if stamps.unit:
            low, high = EVERYDAY_DURATION
            self._ask("unit", f"expected a motion of {low:g} to {high:g} s, got {rows}, in {stamps.unit}")
        if len(possible) > 1:
            dated = [u for u in possible if _within(float(values[0]) * UNITS[u], EVERYDAY_DATE)]
            possible = dated if len(dated) == 1 else possible
        if counts_rows(values) and len(values) > 3:
            self._ask("unit", f"expected a time, got {rows}: a time in some unit, or (then pass dt=) a row number")
        if len(possible) != 1:
            choice = " or ".join(possible) or "none of s, ms, us, ns makes sense"
            self._ask("unit", f"expected a unit that makes sense, got {rows}: {choice}")
        return possible[0]

    def _stated_dt(self, count: int) -> tuple[str, float | Array] | None:
        """The time between rows, or their times as the sum of a column of steps, and what states it."""
        for name, text in self.texts.items():
            if is_step(name) and text.ndim == 0:
                raise ValueError(f"dt: expected a number in {self.label}, got {str(text)!r}")
        for name, array in {**self.scalars, **self.arrays}.items():
            if array.dtype.kind in "Mm":
                continue
            if is_step(name):
                steps = np.asarray(array, dtype=np.float64)
                if steps.ndim == 0:
                    return name, positive(steps.item(), "dt")
                if steps.shape == (count - 1,):
                    return name, np.concatenate([[0.0], np.cumsum(steps)])
                # The step before or after each row: nearly the same if they are even.
                if steps.shape == (count,) and np.ptp(steps) <= 0.5 * abs(steps.mean()):
                    return name, np.concatenate([[0.0], np.cumsum(steps[1:])])
                self._ask("dt", f"expected one number or one step per row, got shape {steps.shape} in {name!r}")
            if array.ndim == 0 and has_word(name, vocabulary.RATE_WORDS):
                return name, 1 / positive(array.item(), name)
        return None

    # Questions -----------------------------------------------------------------------------------------------------

    def _ask_about_dt(self, dt: float, name: str, count: int) -> None:
        if not (_is_everyday(dt, dt * (count - 1)) or self.ours):
            low, high = EVERYDAY_STEP
            self._ask("dt", f"expected {low:g} to {high:g} s between rows, got {dt:g} from {name!r}: {count} rows")

    def _ask_about_two_answers(self, times: Any) -> None:
        """A column of time, and a scalar that says otherwise."""
        mean = float(np.mean(np.diff(times)))
        steps = {name: float(s) for name, s in self.scalars.items() if is_step(name) and s.dtype.kind in "fiu"}
        for name, step in steps.items():
            if not _within(step / mean, (0.95, 1.05)):
                self._ask("time", f"expected one answer, got {mean:.4g} s a row by the time, {step:g} by {name!r}")

    def _ask_about_sets(self, positions: list[_Column]) -> None:
        """Columns and arrays that are more than one joint vector, one position, or one pose."""
        dims = {c.block: self.arrays[c.block].ndim for c in positions}
        kinds = {c.kind for c in positions}
        pose = kinds in ({"Cartesian", "orientation"}, {"position", "orientation"})
        whole = len(kinds) == 1 or pose or kinds == {"Cartesian", "orientation", "position"}
        one_each = len(set(map(kind_of, dims))) == len(dims) and len({len(c.values) for c in positions}) == 1
        if len(dims) > 1 and not (whole and set(dims.values()) == {1}) and not (pose and one_each):
            self._ask("columns", f"expected one set of positions, got {self._shapes(dims)}")

    def _ask_about_shape(self, chosen: list[_Column], count: int) -> None:
        if not chosen:
            self._ask("columns", "expected columns of positions beside the time")
        if len(chosen) > count and any(self.arrays[c.block].ndim == 2 for c in chosen):
            shape = f"{count} rows of {len(chosen)} columns"
            way_out = "hand over the array itself, transposed or not: Demonstration(array.T, dt)"
            self._ask("columns", f"expected (N, n), one row per point, got {shape}; {way_out}")
        if len(chosen) > ASK_ABOVE_COLUMNS:
            most = f"at most {ASK_ABOVE_COLUMNS} unless they are named"
            self._ask("columns", f"expected {most}, got {len(chosen)} columns")

    def _ask_about_derivatives(self, chosen: list[_Column], values: Array, timing: _Timing) -> None:
        """Unnamed columns of which a half or a third is the derivative of the one before are more than positions."""
        if len(values) < 5 or not np.isfinite(values).all():
            return
        spacing: Any = timing.dt if timing.times is None else timing.times
        for parts in (2, 3):
            each = len(chosen) // parts
            slopes = np.gradient(values[:, :each], spacing, axis=0)
            second = values[:, each : 2 * each]
            size = np.linalg.norm(second)
            if len(chosen) == parts * each and size > 0 and np.linalg.norm(slopes - second) < DERIVATIVE_WITHIN * size:
                a, b = _listed(chosen[each : 2 * each]), _listed(chosen[:each])
                self._ask("columns", f"expected positions, got {a}, the velocities of {b}")

    def _ask(self, argument: str, text: str) -> NoReturn:
        raise ValueError(f"{argument}: {text}; pass {argument}= ({self.label} holds {self._shapes(self.seen)})")

    def _shapes(self, names: Mapping[str, Any]) -> str:
        return _shortened([f"{n or 'an array'} {'×'.join(map(str, self.seen[n].shape))}" for n in names]) or "nothing"


def _is_clock(name: str, array: NDArray[Any]) -> bool:
    return array.dtype.kind in "Mm" or (array.dtype.kind != "U" and vocabulary.is_time(name))


def _lies(array: NDArray[Any]) -> bool:
    """Whether an array (n, N) lies, as MATLAB's users keep motions: few rows, and far more columns."""
    return bool(array.shape[0] <= LYING and array.shape[1] >= LYING * array.shape[0] and array.shape[1] > 30)


def _may_move(values: Array) -> bool:
    """Whether a column can be a coordinate: it is neither constant nor counts rows, nor rises as time does."""
    return bool((values != values[0]).any()) and not counts_rows(values) and not _is_even(values)


def _squeezed(array: NDArray[Any]) -> NDArray[Any]:
    """(N,) of (N, 1) and of (1, N), which is how MATLAB keeps vectors."""
    return array.reshape(-1) if array.ndim == 2 and 1 in array.shape and array.size > 1 else array


def _is_even(values: Array) -> bool:
    """Whether numbers rise strictly and in nearly equal steps."""
    steps = np.diff(values)
    return len(steps) > 1 and bool((steps > 0).all() and steps.std() <= EVEN_WITHIN * steps.mean())


def _is_everyday(step: float, duration: float) -> bool:
    return _within(step, EVERYDAY_STEP) and _within(duration, EVERYDAY_DURATION)


def _within(value: float, interval: tuple[float, float]) -> bool:
    return interval[0] * (1 - 1e-9) <= value <= interval[1] * (1 + 1e-9)


def _listed(columns: Sequence[_Column]) -> str:
    """Names, those of the numbered columns of an array in one."""
    names: list[str] = []
    for block, run in itertools.groupby(columns, lambda c: c.block):
        same = list(run)
        numbered = len(same) > 1 and block and not same[0].label
        names += [f"{block}[…] ({len(same)})"] if numbered else [c.name for c in same]
    return _shortened(names)


def _shortened(names: Sequence[str], most: int = 8) -> str:
    if len(names) <= most:
        return ", ".join(names)
    return ", ".join([*names[: most - 1], "…", names[-1]]) + f" ({len(names)})"


def _by_kind(columns: Sequence[_Column]) -> list[str]:
    kinds = dict.fromkeys(c.kind for c in columns)
    lists = {kind: _listed([c for c in columns if c.kind == kind]) for kind in kinds}
    return [names if kind == "unknown" else f"{names} ({kind})" for kind, names in lists.items()]
