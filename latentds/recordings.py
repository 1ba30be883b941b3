"""Other people's recordings: which numbers are the time and which the positions, said in one line or asked."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from .arguments import positive
from .readers import Table, counts_rows

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds in each unit of time."""
STEP = (2e-4, 2.0)
"""Seconds between two rows of a recording that nobody needs to ask about: 5 kHz to one in two seconds."""
DURATION = (0.05, 3600.0)
"""Seconds that such a recording takes."""
MAX_DIM = 200
"""Columns of positions that nobody needs to ask about."""
EPOCH = (9e8, 4e9)
"""Seconds since 1970 of the years 1998 to 2096."""


def _vocabulary(words: str) -> frozenset[str]:
    return frozenset(words.split())


# What a name says of its column. A name is split into words at whatever is no letter, and before capitals.
UNIT_WORDS = {
    word: unit
    for unit, words in {
        "s": "s sec secs second seconds",
        "ms": "ms msec msecs millis millisecond milliseconds",
        "us": "us µs μs usec usecs micros microsecond microseconds",
        "ns": "ns nsec nsecs nanos nanosec nanosecs nanosecond nanoseconds",
    }.items()
    for word in words.split()
}
TIME = _vocabulary("time times timestamp timestamps stamp stamps elapsed clock zeit rosbagtimestamp datetime date")
STEPS = {("dt",), ("delta", "t"), ("delta", "time"), ("time", "step"), ("timestep",), ("sample", "time"), ("period",)}
STEPS |= {("sampling", "time"), ("sampling", "period"), ("sample", "period"), ("time", "delta")}
RATES = _vocabulary("fs fps hz rate frequency freq")
KINDS = {
    "other": _vocabulary(
        "error err errors std var variance cov covariance temperature temperatures temp voltage status mode id seq "
        "index idx frame frames row rows sample samples count counter"
    ),
    "acceleration": _vocabulary(
        "acceleration accelerations acc accel qdd ddq qddot qacc ddx ddy ddz xdd ax ay az ddot"
    ),
    "velocity": _vocabulary(
        "velocity velocities vel vels speed speeds qd dq qdot qvel dx dy dz xdot ydot zdot vx vy vz wx wy wz dot v "
        "omega twist dtheta thetadot"
    ),
    "effort": _vocabulary("effort efforts torque torques tau force forces fx fy fz mx my mz current currents wrench"),
    "command": _vocabulary("desired target targets command commands commanded cmd ref reference setpoint"),
    "joint": _vocabulary("q joint joints angle angles theta qpos j encoder"),
    "orientation": _vocabulary("qx qy qz qw w quat quaternion orientation rotation rpy roll pitch yaw rx ry rz euler"),
    "Cartesian": _vocabulary("x y z px py pz xyz pose tcp ee cartesian"),
    "position": _vocabulary("position positions pos"),
}
"""Kinds, the first that fits; the last four are positions."""
POSITIONS = ("joint", "orientation", "Cartesian", "position")
NAMES = {"name", "names", "joints", "columns", "labels"}
"""Words of a list that names the columns of an array beside it."""
MEASURED = {"actual", "measured", "filtered", "raw", "smoothed", "meas", "msr"}
"""Words that tell apart two recordings of the same quantity."""


@dataclass(frozen=True)
class Motion:
    """What was understood of a table.

    Attributes:
        positions: (N, n).
        times: (N,) seconds from the first row; None if ``dt`` is known instead.
        dt: seconds between two rows, or None.
        columns: n names, or none if the recording has none.
        origin: one line that says what was taken for what.
    """

    positions: NDArray[np.float64]
    times: NDArray[np.float64] | None
    dt: float | None
    columns: tuple[str, ...]
    origin: str


@dataclass(frozen=True, eq=False)
class _Column:
    """(N,) numbers: all of the array ``block``, or one of its columns."""

    name: str
    block: str
    kind: str
    values: NDArray[Any]
    label: str
    """Its own name, "" for a numbered column of an array."""


@dataclass(frozen=True, eq=False)
class _Stamps:
    """(N,) times of unknown offset; ``unit`` is None unless the file says it."""

    name: str
    values: NDArray[np.float64]
    unit: str | None


def understand(
    table: Table,
    label: str,
    *,
    columns: str | int | Sequence[str | int] | None = None,
    time: str | int | None = None,
    unit: str | None = None,
    dt: float | None = None,
) -> Motion:
    """Tell time and positions in a table from names and numbers, or ask.

    Args:
        table: what :func:`~latentds.readers.read_table` or :func:`~latentds.readers.as_table` gave.
        label: what to call it in messages.
        columns: the positions: a name (of a column, or of an array with all its columns), a column's number from 0,
            or several.
        time: the column of time stamps.
        unit: of the time stamps: "s", "ms", "us" or "ns".
        dt: seconds between two rows; time stamps are then not looked at.

    Raises:
        ValueError: if it is ambiguous, names the argument that settles it and says what was seen.
    """
    return _Reading(table, label).understand(columns, time, unit, dt)


class _Reading:
    """One table being understood."""

    def __init__(self, table: Table, label: str) -> None:
        self.label = label
        self.remarks: list[str] = []
        self.ours = list(table) == ["t [s]", *(f"y{i}" for i in range(len(table) - 1))]
        self.ours |= set(table) - {"columns"} == {"positions", "dt", "name"}
        arrays = {name: _squeezed(array) for name, array in table.items()}
        arrays = self._wide_form(arrays)
        self.texts = {name: a for name, a in arrays.items() if a.dtype.kind == "U"}
        numbers = {name: a for name, a in arrays.items() if a.dtype.kind in "fiuMm"}
        self.seen = {name: a for name, a in numbers.items() if a.ndim}
        self.scalars = {name: a for name, a in numbers.items() if a.ndim == 0}
        self.arrays = {name: a for name, a in numbers.items() if 1 <= a.ndim <= 2 and a.size}
        lengths = {len(a) for name, a in self.arrays.items() if a.ndim == 1 and _is_time(name, a)}
        for name, array in self.arrays.items():
            if array.ndim == 2 and array.shape[1] in lengths and len(array) not in lengths:
                self.arrays[name] = array.T
                self.remarks.append(f"{name} transposed to (N, n)")
        self.columns = [column for name in self.arrays for column in self._columns_of(name)]

    def understand(
        self, columns: str | int | Sequence[str | int] | None, time: str | int | None, unit: str | None, dt: Any
    ) -> Motion:
        if unit is not None:
            known = UNIT_WORDS.get(unit) if isinstance(unit, str) else None
            if known is None:
                raise ValueError(f"unit: expected one of {', '.join(UNITS)}, got {unit!r}")
            unit = known
        if dt is not None:
            dt = positive(dt, "dt")
            if time is not None or unit is not None:
                raise ValueError("dt: expected either dt or time and unit, got both")
        clock = self._resolve([time], "time") if time is not None else []
        if len(clock) > 1:
            raise ValueError(f"time: expected one column, got {len(clock)}: {_listed(clock)}")
        if columns is not None:
            wanted = [columns] if isinstance(columns, (str, int)) else list(columns)
            chosen = self._resolve(wanted, "columns")
            if not chosen:
                raise ValueError("columns: expected at least one, got none")
        else:
            chosen = self._positions([c for c in self.columns if c not in clock])
        lengths = {len(c.values) for c in chosen}
        if len(lengths) > 1:
            self._ask("columns", f"expected columns of one length, got {_listed(chosen)} of {sorted(lengths)} rows")
        count = lengths.pop()

        times, step, said = self._time(chosen, clock, columns is None, unit, dt, count)
        if columns is None:
            chosen = [c for c in chosen if c.name not in said.columns]
            self._ask_about_shape(chosen, count)
            if all(c.kind == "unknown" for c in chosen):
                self._ask_about_derivatives(chosen, times, step)
        elif any(self.arrays[c.block].ndim == 2 and count < self.arrays[c.block].shape[1] for c in chosen):
            self._ask_about_shape([c for c in self.columns if c.block == chosen[0].block], count)
        positions = np.stack([c.values.astype(np.float64) for c in chosen], axis=1)
        used = {c.name for c in chosen} | set(said.columns)
        left = [c for c in self.columns if c.name not in used]
        parts = [f"{count} rows", said.text, f"positions {_listed(chosen)}"]
        if left:
            parts.append("left out " + ", ".join(_by_kind(left)))
        origin = f"{self.label}: {'; '.join([*parts, *self.remarks])}"
        labels = tuple(c.label for c in chosen)
        if not all(labels) or len(set(labels)) < len(labels) or (self.ours and "columns" not in self.texts):
            labels = ()
        return Motion(positions, times, step, labels, origin)

    # Columns -------------------------------------------------------------------------------------------------------

    def _columns_of(self, name: str) -> list[_Column]:
        array = self.arrays[name]
        kind = "time" if _is_time(name, array) else kind_of(name)
        if array.ndim == 1:
            return [_Column(name, name, kind, array, name)]
        labels = self._labels(array.shape[1])
        names = [label or str(i) for i, label in enumerate(labels)]
        return [
            _Column(f"{name}[{names[i]}]" if name else names[i], name, kind, array[:, i], label)
            for i, label in enumerate(labels)
        ]

    def _labels(self, count: int) -> list[str]:
        """Names of an array's columns, if the file gives them beside it."""
        for other, text in self.texts.items():
            if NAMES & set(_words(other)):
                rows = text if text.ndim == 2 else text[None]
                if rows.shape[-1] == count and len(set(rows[0])) == count:
                    if (rows != rows[0]).any():
                        self._ask("columns", f"expected one order of names, which change in {other!r} from row to row")
                    return [str(label) for label in rows[0]]
        return [""] * count

    def _resolve(self, wanted: Sequence[Any], argument: str) -> list[_Column]:
        found: list[_Column] = []
        for name in wanted:
            if isinstance(name, str):
                match = [c for c in self.columns if c.name == name] or [c for c in self.columns if c.block == name]
            elif isinstance(name, (int, np.integer)) and not isinstance(name, bool):
                match = [self.columns[name]] if 0 <= name < len(self.columns) else []
            else:
                match = []
            if not match:
                self._ask(argument, f"expected names or numbers of columns, got {name!r}")
            found += match
        return found

    def _positions(self, columns: list[_Column]) -> list[_Column]:
        """The columns that are positions by their names, or those whose names say nothing at all."""
        for name, text in self.texts.items():
            if text.ndim == 1 and len(text) > 2 and kind_of(name) in POSITIONS and not NAMES & set(_words(name)):
                raise ValueError(f"path: {self.label} is not a table of numbers ({str(text[0])!r} in column {name!r})")
        found = [c for c in columns if c.kind in POSITIONS]
        by_name = bool(found)
        found = found or [c for c in columns if c.kind == "unknown"]
        if not found:
            self._ask("columns", "expected columns of positions")
        blocks = {c.block: self.arrays[c.block].ndim for c in found}
        kinds = {c.kind for c in found}
        pose = kinds in ({"Cartesian", "orientation"}, {"position", "orientation"})
        one_state = all(n == 1 for n in blocks.values()) and (
            len(kinds) == 1 or pose or kinds == {"Cartesian", "orientation", "position"}
        )
        pose = pose and Counter(kind_of(b) for b in blocks).most_common(1)[0][1] == 1
        if len(blocks) > 1 and not one_state and not (pose and len({len(c.values) for c in found}) == 1):
            self._ask("columns", f"expected one set of positions, got {self._shapes(blocks)}")
        plain = Counter(tuple(w for w in _words(c.name) if w not in MEASURED) for c in found) if by_name else Counter()
        twice = [" ".join(words) for words, times in plain.items() if times > 1]
        twice += [c.name for c in found if re.search(r" \(\d+\)$", c.name)]
        if twice:
            self._ask("columns", f"expected each position once, got several of {twice[0]!r}")
        return found

    def _wide_form(self, arrays: Table) -> Table:
        """One row per stamp, of a table with one row per stamp and joint."""
        for name, text in arrays.items():
            if text.dtype.kind != "U" or text.ndim != 1 or len(text) < 2:
                continue
            each = len(set(text))
            clock = [n for n, a in arrays.items() if len(a.shape) == 1 and len(a) == len(text) and _is_time(n, a)]
            if each < 2 or len(text) % each or not clock or (text.reshape(-1, each) != text[:each]).any():
                continue
            if any((arrays[n].reshape(-1, each) != arrays[n].reshape(-1, each)[:, :1]).any() for n in clock):
                continue
            rows = {n: a.reshape(-1, each) for n, a in arrays.items() if a.shape == text.shape}
            self.remarks.append(f"{each} rows per time, one for each {name!r}, set side by side")
            names = {"names": text[:each]}
            return arrays | rows | {n: rows[n][:, 0] for n in clock} | {name: text[:0]} | names
        return arrays

    # Time ----------------------------------------------------------------------------------------------------------

    def _time(
        self, chosen: list[_Column], clock: list[_Column], free: bool, unit: str | None, dt: float | None, count: int
    ) -> tuple[NDArray[np.float64] | None, float | None, _Said]:
        others = [c for c in self.columns if c not in chosen and len(c.values) == count]
        pool = others if not free else chosen if len(chosen) > 1 else []
        rising = [c for c in pool if c.kind == "unknown" and _is_even(c.values)]
        unnamed = [c for c in rising if free and self.arrays[c.block].ndim == 2]
        if dt is not None:
            return None, dt, _Said(f"dt {dt:g} s as asked", self._not_time(unnamed))
        if clock:
            stamps = _as_stamps(clock[0])
            if len(stamps.values) != count:
                raise ValueError(f"time: expected {count} rows as in the positions, got {len(stamps.values)}")
            return self._in_seconds(stamps, unit, " as asked")
        if named := self._named_stamps(count, {c.name for c in chosen} if not free else set()):
            times, step, said = self._in_seconds(self._one_of(named, unit), unit, "")
            dropped = self._not_time(unnamed)
            self._compare_with_dt(times)
            return times, step, _Said(said.text, said.columns + dropped)
        if (stated := self._stated_dt(count)) is not None:
            step, name = stated
            if isinstance(step, np.ndarray):
                return self._in_seconds(_Stamps(name, step, None), unit, " (steps, added up)")
            seconds = self._plausible_dt(step, name, count)
            return None, seconds, _Said(f"dt {seconds:g} s from {name!r}", (name, *self._not_time(unnamed)))
        if len(rising) == 1:
            return self._in_seconds(_as_stamps(rising[0]), unit, " (it rises evenly)")
        if rising:
            self._ask(
                "time", f"expected one column that rises evenly, got {_listed(rising)}; if none is time, pass dt="
            )
        self._ask("dt", "expected the seconds between two rows, which nothing here tells (or time=, a column)")

    def _not_time(self, rising: list[_Column]) -> tuple[str, ...]:
        """The name of a first column that merely counts rows; asks if it could be the time."""
        if not rising:
            return ()
        if counts_rows(rising[0].values):
            self.remarks.append(f"column {rising[0].name} counts rows")
            return (rising[0].name,)
        self._ask(
            "columns",
            f"expected to know whether column {rising[0].name}, which rises evenly as time does, is a position",
        )

    def _named_stamps(self, count: int, taken: set[str]) -> list[_Stamps]:
        columns = [c for c in self.columns if c.kind == "time" and len(c.values) == count and c.name not in taken]
        found = [_as_stamps(c) for c in columns]
        for coarse in [s for s in found if s.unit == "s"]:
            for fine in [s for s in found if s.unit == "ns"]:
                # Whole seconds with nanoseconds beside them, as ROS writes stamps.
                if _words(coarse.name)[:-1] == _words(fine.name)[:-1] and (fine.values < 1e9).all():
                    values = coarse.values - coarse.values[0] + 1e-9 * fine.values
                    found = [s for s in found if s not in (coarse, fine)]
                    found.append(_Stamps(f"{coarse.name} + {fine.name}", values, "s"))
        return found

    def _one_of(self, named: list[_Stamps], unit: str | None) -> _Stamps:
        named = [s for s in named if (np.diff(s.values) > 0).all()] or named[:1]
        named = [s for s in named if not counts_rows(s.values)] or named
        durations = [(s.values[-1] - s.values[0]) * UNITS[self._unit(s, unit)] for s in named] if named[1:] else [1.0]
        if max(durations) > 1.01 * min(durations):
            self._ask(
                "time", f"expected one column of time, got {', '.join(repr(s.name) for s in named)}, which differ"
            )
        return next((s for s in named if {"stamp", "stamps"} & set(_words(s.name))), named[0])

    def _in_seconds(self, stamps: _Stamps, unit: str | None, how: str) -> tuple[NDArray[np.float64], None, _Said]:
        name = stamps.name
        if not np.isfinite(stamps.values).all():
            row = int(np.argmin(np.isfinite(stamps.values)))
            raise ValueError(f"time: expected finite numbers in column {name!r} of {self.label}, got none in row {row}")
        if not (np.diff(stamps.values) > 0).all():
            row = int(np.argmin(np.diff(stamps.values) > 0))
            raise ValueError(
                f"times: expected strictly increasing, got {stamps.values[row]:.15g} then "
                f"{stamps.values[row + 1]:.15g} at row {row} of {name!r} in {self.label}; pass time= or dt="
            )
        found = self._unit(stamps, unit)
        times = (stamps.values - stamps.values[0]) * UNITS[found]
        told = "as asked" if unit else "as it says" if stamps.unit else "the unit that makes sense"
        text = f"time {name!r}{how} in {found}, {told}: {times[-1]:.4g} s"
        return times, None, _Said(text, tuple(name.split(" + ")))

    def _unit(self, stamps: _Stamps, unit: str | None) -> str:
        if unit is not None:
            return unit
        step, duration = float(np.median(np.diff(stamps.values))), float(stamps.values[-1] - stamps.values[0])
        possible = [u for u, s in UNITS.items() if _within(step * s, STEP) and _within(duration * s, DURATION)]
        if stamps.unit in possible or self.ours:
            return stamps.unit or "s"
        rows = f"steps of {step:.4g}, {duration:.4g} in all, in column {stamps.name!r}"
        if stamps.unit:
            self._ask(
                "unit", f"expected a motion of {DURATION[0]:g} to {DURATION[1]:g} s, got {rows}, in {stamps.unit}"
            )
        if len(possible) > 1:
            dated = [u for u in possible if _within(float(stamps.values[0]) * UNITS[u], EPOCH)]
            possible = dated if len(dated) == 1 else possible
        if counts_rows(stamps.values) and len(stamps.values) > 3:
            self._ask("unit", f"expected a time, got {rows}: a time in some unit, or (then pass dt=) a row number")
        if len(possible) != 1:
            them = " or ".join(possible) if possible else "none of s, ms, us, ns makes sense"
            self._ask("unit", f"expected a unit that makes sense, got {rows}: {them}")
        return possible[0]

    def _stated_dt(self, count: int) -> tuple[float | NDArray[np.float64], str] | None:
        """What a scalar, or a column of steps, tells of the time between rows; a column gives its running sum."""
        for name, text in self.texts.items():
            if _is_step(name) and text.ndim == 0:
                raise ValueError(f"dt: expected a number in {self.label}, got {str(text)!r}")
        for name, array in {**self.scalars, **self.arrays}.items():
            if array.dtype.kind in "Mm":
                continue
            if _is_step(name):
                steps = np.asarray(array, dtype=np.float64)
                if steps.ndim == 0:
                    return float(positive(steps.item(), "dt")), name
                if steps.ndim == 1 and len(steps) == count - 1:
                    return np.concatenate([[0.0], np.cumsum(steps)]), name
                # The step before or after each row: nearly the same if they are even.
                if steps.shape == (count,) and np.ptp(steps) <= 0.5 * abs(steps.mean()):
                    return np.concatenate([[0.0], np.cumsum(steps[1:])]), name
                self._ask("dt", f"expected one number or one step per row, got shape {steps.shape} in {name!r}")
            if array.ndim == 0 and RATES & set(_words(name)):
                return 1 / float(positive(array.item(), name)), name
        return None

    def _plausible_dt(self, dt: float, name: str, count: int) -> float:
        if (_within(dt, STEP) and _within(dt * (count - 1), DURATION)) or self.ours:
            return dt
        self._ask("dt", f"expected {STEP[0]:g} to {STEP[1]:g} s between rows, got {dt:g} from {name!r}: {count} rows")

    def _compare_with_dt(self, times: NDArray[np.float64] | None) -> None:
        for name, scalar in self.scalars.items():
            if times is not None and _is_step(name) and scalar.dtype.kind in "fiu":
                mean = times[-1] / (len(times) - 1)
                if not _within(float(scalar) / mean, (0.95, 1.05)):
                    self._ask(
                        "time",
                        f"expected one answer, got {mean:.4g} s a row by the time, {float(scalar):g} by {name!r}",
                    )

    # Questions -----------------------------------------------------------------------------------------------------

    def _ask_about_shape(self, chosen: list[_Column], count: int) -> None:
        if not chosen:
            self._ask("columns", "expected columns of positions beside the time")
        if len(chosen) > count and any(self.arrays[c.block].ndim == 2 for c in chosen):
            self._ask(
                "columns",
                f"expected (N, n), one row per point, got {count} rows of {len(chosen)} columns; hand over the array "
                "itself, transposed or not: Demonstration(array.T, dt)",
            )
        if len(chosen) > MAX_DIM:
            self._ask("columns", f"expected at most {MAX_DIM} unless they are named, got {len(chosen)} columns")

    def _ask_about_derivatives(
        self, chosen: list[_Column], times: NDArray[np.float64] | None, dt: float | None
    ) -> None:
        """Unnamed columns of which a half or a third is the derivative of the one before are more than positions."""
        values = np.stack([c.values for c in chosen], axis=1).astype(np.float64)
        if len(values) < 5 or not np.isfinite(values).all():
            return
        if dt is None and times is not None and not (np.diff(times) > 0).all():
            return
        for parts in (2, 3):
            if len(chosen) % parts:
                continue
            first = len(chosen) // parts
            spacing: Any = times if dt is None else dt
            slopes = np.gradient(values[:, :first], spacing, axis=0)
            second = values[:, first : 2 * first]
            if np.linalg.norm(second) > 0 and np.linalg.norm(slopes - second) < 0.3 * np.linalg.norm(second):
                a, b = _listed(chosen[first : 2 * first]), _listed(chosen[:first])
                self._ask("columns", f"expected positions, got {a}, the velocities of {b}")

    def _ask(self, argument: str, text: str) -> NoReturn:
        raise ValueError(f"{argument}: {text}; pass {argument}= ({self.label} holds {self._shapes(self.seen)})")

    def _shapes(self, names: Mapping[str, Any]) -> str:
        return _shortened([f"{n or 'an array'} {'×'.join(map(str, self.seen[n].shape))}" for n in names]) or "nothing"


@dataclass(frozen=True)
class _Said:
    """What to say of the time, and which columns it takes."""

    text: str
    columns: tuple[str, ...]


def kind_of(name: str) -> str:
    """What a name says its column is: "time", one of ``KINDS``, or "unknown"."""
    words = _words(name)
    if _is_time(name, np.empty(0)):
        return "time"
    if _is_step(name):
        return "step"
    if words == ["v"]:
        return "unknown"  # beside u, say
    if words[:2] == ["q", "d"]:
        return "command"  # q_d, the desired posture; qd is a velocity
    return next((kind for kind, known in KINDS.items() if known & set(words)), "unknown")


def _words(name: str) -> list[str]:
    return re.findall(r"[^\W\d_]+|\d+", re.sub(r"([a-zà-ÿ])([A-Z])", r"\1 \2", name).lower())


def _is_time(name: str, array: NDArray[Any]) -> bool:
    words = _words(name)
    if array.dtype.kind in "Mm":
        return True
    bare = [w for w in words if w not in UNIT_WORDS]
    if _is_step(name) or array.dtype.kind == "U":
        return False
    units_alone = not bare and len(words) == 1 and len(words[0]) > 1
    return bare == ["t"] or units_alone or bool(TIME & set(bare)) or words == ["rosbag", "timestamp"]


def _is_step(name: str) -> bool:
    return tuple(w for w in _words(name) if w not in UNIT_WORDS) in STEPS


def _as_stamps(column: _Column) -> _Stamps:
    values = column.values
    if values.dtype.kind in "Mm":
        return _Stamps(column.name, (values - values[0]) / np.timedelta64(1, "ns") * 1e-9, "s")
    units = [UNIT_WORDS[w] for w in _words(column.name) if w in UNIT_WORDS]
    return _Stamps(column.name, values.astype(np.float64), units[-1] if units else None)


def _squeezed(array: NDArray[Any]) -> NDArray[Any]:
    """(N,) of (N, 1) and of (1, N), which is how MATLAB keeps vectors."""
    return array.reshape(-1) if array.ndim == 2 and 1 in array.shape and array.size > 1 else array


def _is_even(values: NDArray[Any]) -> bool:
    """Whether numbers rise strictly and in nearly equal steps."""
    steps = np.diff(values.astype(np.float64))
    return len(steps) > 1 and bool((steps > 0).all() and steps.std() <= 0.2 * steps.mean())


def _within(value: float, interval: tuple[float, float]) -> bool:
    return interval[0] * (1 - 1e-9) <= value <= interval[1] * (1 + 1e-9)


def _listed(columns: Sequence[_Column]) -> str:
    """Names, those of the numbered columns of an array in one."""
    names: list[str] = []
    for block, run in itertools.groupby(columns, lambda c: c.block if not c.label else c):
        them = [c.name for c in run]
        names += [f"{block}[…] ({len(them)})"] if block and isinstance(block, str) and them[1:] else them
    return _shortened(names)


def _shortened(names: Sequence[str], most: int = 8) -> str:
    shown = list(names) if len(names) <= most else [*names[: most - 1], "…", names[-1]]
    return ", ".join(shown) + (f" ({len(names)})" if len(names) > most else "")


def _by_kind(columns: Sequence[_Column]) -> list[str]:
    kinds = dict.fromkeys(c.kind for c in columns)
    return [
        _listed([c for c in columns if c.kind == kind]) + ("" if kind == "unknown" else f" ({kind})") for kind in kinds
    ]
