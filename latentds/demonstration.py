"""A demonstration: positions sampled at a constant rate, read from and written to plain files."""

from __future__ import annotations

import hashlib
import itertools
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy
import torch
from torch import Tensor

from . import files, recordings
from . import findings as found
from .arguments import Array, point_array, positive, real_array, whole_number
from .curves import extent, interpolated

logger = logging.getLogger(__name__)

SMALLEST, LARGEST = 1e-40, 1e40
"""Sizes that a fit takes: squares and cubes of numbers so small or large are still numbers."""
CLOSED = 1e-6
"""Distance of the goal from the start, in sizes of the motion, up to which it counts as a closed loop."""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One motion, shown once: ``N`` positions in ``n`` dimensions, ``dt`` seconds apart.

    Args:
        positions: (N, n) array or tensor, N >= 3, n >= 1, finite, not all points equal. Any real dtype;
            kept as a float64 CPU tensor. The last point is the goal.
        dt: seconds between two points, > 0.
        name: a label for tables and pictures.
        columns: n names of the coordinates, or none. A fit keeps them in ``fit_report.columns``, pictures show them.
        origin: one line that says what a recording's columns were taken for; empty if it was not read from one.

    Raises:
        ValueError: naming the argument, what was expected and what came.
    """

    positions: Tensor
    dt: float
    name: str = ""
    columns: tuple[str, ...] = field(default=(), kw_only=True, repr=False)
    origin: str = field(default="", kw_only=True, repr=False)
    velocities: Tensor = field(init=False, repr=False)
    """(N, n) units per second: second-order finite differences of the positions."""

    def __post_init__(self) -> None:
        positions = point_array(self.positions, "positions")
        dt = positive(self.dt, "dt")
        if not isinstance(self.name, str):
            raise ValueError(f"name: expected a string, got {type(self.name).__name__}")
        columns = tuple(self.columns) if isinstance(self.columns, (list, tuple)) else (None,)
        if columns and (len(columns) != positions.shape[1] or not all(isinstance(c, str) for c in columns)):
            raise ValueError(f"columns: expected {positions.shape[1]} names, got {self.columns!r}")
        if len(set(columns)) < len(columns):
            raise ValueError(f"columns: expected names that differ, got {columns!r}")
        object.__setattr__(self, "columns", columns)
        object.__setattr__(self, "positions", torch.from_numpy(positions))
        object.__setattr__(self, "dt", dt)
        with np.errstate(over="ignore", invalid="ignore"):
            velocities = np.gradient(positions, dt, axis=0, edge_order=2)
        if not np.isfinite(velocities).all():
            raise ValueError(
                f"positions: expected a motion whose velocities are finite numbers, got steps too far for dt {dt:g}"
            )
        object.__setattr__(self, "velocities", torch.from_numpy(velocities))

    def __repr__(self) -> str:
        label = f"{self.name!r}, " if self.name else ""
        return f"Demonstration({label}{len(self)} points, {self.dim}-D, {self.duration:.4g} s)"

    def __len__(self) -> int:
        return self.positions.shape[0]

    @property
    def dim(self) -> int:
        return self.positions.shape[1]

    @property
    def duration(self) -> float:
        """Seconds from the first point to the last: (N - 1) dt."""
        return (len(self) - 1) * self.dt

    @property
    def times(self) -> Tensor:
        """(N,) seconds, from 0."""
        return torch.arange(len(self), dtype=torch.float64) * self.dt

    @property
    def start(self) -> Tensor:
        return self.positions[0]

    @property
    def goal(self) -> Tensor:
        return self.positions[-1]

    @property
    def size(self) -> float:
        """Largest extent along a coordinate axis, in the units of the positions."""
        return extent(self.positions.numpy())

    def at(self, times: Array) -> Array:
        """Positions at ``times`` (...), seconds, linear between the points and held beyond the ends: (..., n)."""
        return interpolated(times, self.times.numpy(), self.positions.numpy())

    @property
    def fingerprint(self) -> tuple[str, str]:
        """Its name, and a SHA-256 of its positions and dt that tells it from any other."""
        digest = hashlib.sha256(np.array([self.dim, self.dt]).tobytes() + self.positions.numpy().tobytes())
        return self.name, digest.hexdigest()

    @classmethod
    def from_times(cls, times: Any, positions: Any, name: str = "") -> Demonstration:
        """A recording with its own time stamps, resampled linearly to as many evenly spaced points.

        Args:
            times: (N,) seconds, strictly increasing.
            positions: (N, n).
            name: a label.

        Raises:
            ValueError: if ``times`` does not increase or does not fit ``positions``.
        """
        points = point_array(positions, "positions")
        stamps = real_array(times, "times")
        if stamps.shape != (len(points),):
            raise ValueError(f"times: expected shape ({len(points)},), one per position, got {stamps.shape}")
        if not np.isfinite(stamps).all():
            raise ValueError("times: expected finite numbers, got NaN or inf")
        steps = np.diff(stamps)
        if not (steps > 0).all():
            row = int(np.argmin(steps > 0))
            raise ValueError(
                f"times: expected strictly increasing, got {stamps[row]:g} then {stamps[row + 1]:g} at row {row}"
            )
        even = np.linspace(stamps[0], stamps[-1], len(stamps))
        return cls(
            torch.from_numpy(interpolated(even, stamps, points)), float(even[-1] - even[0]) / (len(even) - 1), name
        )

    @classmethod
    def load(
        cls,
        path: str | os.PathLike[str],
        *,
        columns: str | int | Sequence[str | int] | None = None,
        time: str | int | None = None,
        unit: str | None = None,
        dt: float | None = None,
        episode: str | int | None = None,
        name: str | None = None,
    ) -> Demonstration:
        """Read a recording: what :meth:`save` wrote, or a file of your own.

        ``.csv``, ``.tsv``, ``.txt``, ``.dat`` and ``.log`` (any usual delimiter, decimal points or commas, with names
        or without, Motive's exports), ``.npy``, ``.npz`` (no pickles), ``.mat``, ``.json``, and with
        ``latentds[recordings]`` ``.parquet``, ``.h5``, ``.c3d`` and ROS bags. Time and positions are found by their
        names, and the time by its even steps if there are none; velocities and efforts are left out. Angles that wrap
        are unwrapped, and quaternions kept on one sign. What was understood and done is said in ``origin`` and logged.
        Nothing ambiguous is guessed: the error says what was seen and what to pass. :meth:`check` says what else would
        hurt a fit.

        Args:
            path: the file.
            columns: the positions: a name (of a column, of an array with all its columns, or of all that begin with it
                and a slash), a column's number from 0, or several.
            time: the column of time stamps. Uneven ones are resampled as :meth:`from_times` does.
            unit: of the time stamps: "s", "ms", "us" or "ns".
            dt: seconds between two rows; time stamps are then not looked at.
            episode: which motion, by its label or number, if there are several; :meth:`load_all` takes them all.
            name: a label; the one in the file, or the file's name, by default.

        Raises:
            ValueError: if the file is of another kind, damaged, larger than 1 GiB, ambiguous, or holds no motion.
            FileNotFoundError: if there is no such file.
        """
        path = Path(path)
        table = recordings.read_table(path)
        if name is None:
            saved = table.get("name", np.array(0))
            name = str(saved) if saved.ndim == 0 and saved.dtype.kind == "U" else path.stem
            name += "" if episode is None else f"[{episode}]"
        return cls._of(recordings.interpret(table, path.name, recordings.Asked(columns, time, unit, dt), episode), name)

    @classmethod
    def load_all(
        cls,
        path: str | os.PathLike[str],
        *,
        columns: str | int | Sequence[str | int] | None = None,
        time: str | int | None = None,
        unit: str | None = None,
        dt: float | None = None,
    ) -> list[Demonstration]:
        """Every motion of a file, in its order: a single one, or several that are told apart.

        By a column that numbers them (episode_index, say), by numbers in the names of arrays (data/0, data/1, …), by
        the first axis of an array (K, N, n), or by a time that starts over. The arguments are those of :meth:`load`.
        """
        path = Path(path)
        asked = recordings.Asked(columns, time, unit, dt)
        motions = recordings.interpret_all(recordings.read_table(path), path.name, asked)
        return [cls._of(motion, f"{path.stem}[{which}]" if which else path.stem) for which, motion in motions.items()]

    @classmethod
    def from_table(
        cls,
        table: Any,
        *,
        columns: str | int | Sequence[str | int] | None = None,
        time: str | int | None = None,
        unit: str | None = None,
        dt: float | None = None,
        episode: str | int | None = None,
        name: str = "",
    ) -> Demonstration:
        """What :meth:`load` does, for a pandas frame or a mapping from names to arrays that is at hand already."""
        asked = recordings.Asked(columns, time, unit, dt)
        return cls._of(recordings.interpret(recordings.as_table(table), name or "the table", asked, episode), name)

    @classmethod
    def _of(cls, motion: recordings.Motion, name: str) -> Demonstration:
        if motion.dt is not None:
            read = cls(torch.from_numpy(motion.positions), motion.dt, name)
        else:
            read = cls.from_times(motion.times, motion.positions, name)
        read = replace(read, columns=motion.columns, origin=motion.origin)
        read = read if motion.ours else read.unwrapped().continuous()
        logger.info(read.origin)
        return read

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a ``.npz`` (exact) or ``.csv`` (17 digits, no names) file that :meth:`load` reads. Atomic."""
        path = Path(path)
        if path.suffix not in (".npz", ".csv"):
            raise ValueError(f"path: expected a .npz or .csv file, got {path.name!r}")
        with files.atomic_write(path) as file:
            if path.suffix == ".npz":
                named: dict[str, Any] = {"columns": np.array(self.columns)} if self.columns else {}
                np.savez(file, positions=self.positions.numpy(), dt=self.dt, name=self.name, **named)
            else:
                columns = ["t [s]", *(f"y{i}" for i in range(self.dim))]
                table = np.column_stack([self.times.numpy(), self.positions.numpy()])
                np.savetxt(file, table, delimiter=",", header=",".join(columns), comments="", fmt="%.17g")

    def check(self) -> found.Check:
        """What in it would hurt a fit: each place, its size and the remedy; printed, a page to read."""
        return found.Check(found.findings(self))

    def unwrapped(self, columns: str | int | Sequence[str | int] | None = None) -> Demonstration:
        """Without the jumps of angles that wrap by 2π or 360.

        Args:
            columns: names or numbers from 0; those that :meth:`check` finds to wrap, by default.
        """
        given = [columns] if isinstance(columns, (str, int)) else columns
        wraps = found.wraps(self.positions.numpy())
        chosen = list(wraps) if given is None else [self._column(column) for column in given]
        periods = {column: wraps[column][0] if column in wraps else self._period(column) for column in chosen}
        points = found.unwrapped(self.positions.numpy(), {at: found.PERIODS[by] for at, by in periods.items()})
        named = [f"{self.columns[at] if self.columns else f'column {at}'} by {by}" for at, by in periods.items()]
        return self._changed(points, f"unwrapped {', '.join(named)}")

    def continuous(self) -> Demonstration:
        """With every quaternion on one sign, q and -q being the same rotation."""
        flips = found.flips(self.positions.numpy(), self.columns)
        rows = sorted({row for each in flips.values() for row in each})
        told = f"turned the sign of a quaternion at rows {', '.join(map(str, rows))}"
        return self._changed(found.continuous(self.positions.numpy(), self.columns), told)

    def deglitched(self) -> Demonstration:
        """With a straight line in the place of lone glitches and of rows that repeat the one before."""
        points = self.positions.numpy()
        stale = [(first + 1, last) for first, last in found.repeats(points)]
        mended = found.bridged(points, [(first - 1, last) for first, last in stale])
        lone = [(one.first, one.last) for one in found.jumps(mended) if one.back]
        rows = [row for first, last in sorted(stale + lone) for row in range(first, last + 1)]
        mended = found.bridged(points, [(row - 1, row) for row in rows])
        return self._changed(mended, f"interpolated rows {', '.join(map(str, rows))}")

    def smoothed(self, seconds: float | None = None) -> Demonstration:
        """Smoothed by cubics over a moving window (Savitzky-Golay); the first and the last point stay.

        Args:
            seconds: length of the window, at least four steps and at most the duration; a twentieth of it, or four
                steps if that is more, by default.
        """
        least = min(4 * self.dt, self.duration)
        asked = max(least, self.duration / 20) if seconds is None else positive(seconds, "seconds")
        if not least * (1 - 1e-9) <= asked <= self.duration * (1 + 1e-9):
            raise ValueError(f"seconds: expected {least:.3g} to {self.duration:.3g}, got {asked:.3g}")
        half = max(1, min(round(asked / self.dt / 2), (len(self) - 1) // 2))
        points = self.positions.numpy()
        smooth = scipy.signal.savgol_filter(points, 2 * half + 1, min(3, 2 * half), axis=0)
        fade = np.maximum(0, 1 - np.arange(len(points)) / half)[:, None]
        smooth += fade * (points[0] - smooth[0]) + fade[::-1] * (points[-1] - smooth[-1])
        smooth[[0, -1]] = points[[0, -1]]
        return self._changed(smooth, f"smoothed over {asked:.3g} s")

    def trimmed(self) -> Demonstration:
        """Without rests and swaying before and after the reach."""
        first, last = found.reach(self.deglitched().positions.numpy())
        return self._part(first, last + 1, f"trimmed to {first * self.dt:.3g} to {last * self.dt:.3g} s")

    def resampled(self, n: int) -> Demonstration:
        """As ``n`` >= 3 points, even in time."""
        count = whole_number(n, "n", at_least=3)
        even = self.at(np.linspace(0, self.duration, count))
        told = self._changed(even, f"resampled from {len(self)} to {count} points")
        return replace(told, dt=self.duration / (count - 1))

    def split_at(self, rows: int | Sequence[int]) -> list[Demonstration]:
        """In parts, each new one from one of ``rows`` on; at least three rows are in each."""
        given = [rows] if isinstance(rows, (int, np.integer)) else list(rows)
        edges = [0, *(whole_number(row, "rows", at_least=0) for row in given), len(self)]
        if any(later - row < 3 for row, later in itertools.pairwise(edges)):
            raise ValueError(f"rows: expected rising, 3 or more apart, of {len(self)} rows, got {rows!r}")
        return [
            self._part(row, later, f"rows {row} to {later - 1} of {len(self)}")
            for row, later in itertools.pairwise(edges)
        ]

    def _part(self, first: int, behind: int, told: str) -> Demonstration:
        return self._changed(self.positions.numpy()[first:behind], told)

    def _changed(self, points: Array, told: str) -> Demonstration:
        """With other points, and what was changed in ``origin``; itself if nothing was."""
        if np.array_equal(points, self.positions.numpy()):
            return self
        return replace(
            self, positions=torch.from_numpy(points.copy()), origin="; ".join(filter(None, [self.origin, told]))
        )

    def _column(self, column: str | int) -> int:
        known: Sequence[str | int] = self.columns or range(self.dim)
        if isinstance(column, str) and column in self.columns:
            return self.columns.index(column)
        if isinstance(column, (int, np.integer)) and not isinstance(column, bool) and 0 <= column < self.dim:
            return int(column)
        raise ValueError(f"columns: expected names or numbers among {list(known)}, got {column!r}")

    def _period(self, column: int) -> str:
        """What an angle wraps by that does not clearly do so: the period nearest to its largest step."""
        step = float(np.abs(np.diff(self.positions.numpy()[:, column])).max())
        name, value = min(found.PERIODS.items(), key=lambda pair: abs(np.log(max(step, 1e-300) / pair[1])))
        if not value / 2 < step < 2 * value:
            raise ValueError(
                f"columns: expected a column with steps near 2π or 360, got {column}, by {step:.3g} at most"
            )
        return name


def demonstrations_of(demonstration: Any, dim: int) -> list[Demonstration]:
    """The argument of ``fit`` as a list of at least one :class:`Demonstration` of dimension ``dim``."""
    shown = [demonstration] if isinstance(demonstration, Demonstration) else demonstration
    if not isinstance(shown, Sequence) or not shown or not all(isinstance(d, Demonstration) for d in shown):
        raise ValueError(
            "demonstration: expected a Demonstration or a non-empty list of them, "
            f"got {type(demonstration).__name__}" + (" (empty)" if isinstance(shown, Sequence) and not shown else "")
        )
    for item in shown:
        if item.dim != dim:
            raise ValueError(f"demonstration: expected dimension {dim}, got {item.dim} ({item!r})")
        if not SMALLEST <= item.size <= LARGEST:
            raise ValueError(
                f"demonstration: expected a size of {SMALLEST:g} to {LARGEST:g}, got {item.size:g}; use another unit"
            )
    named = list({item.columns: None for item in shown if item.columns})
    if len(named) > 1:
        raise ValueError(f"demonstration: expected the same columns in all, got {named[0]} and {named[1]}")
    return list(shown)


def goal_apart(shown: Demonstration, goal: Tensor) -> float:
    """Distance of ``goal`` (n,) from the start; a ValueError if it vanishes beside the motion's size."""
    gap = float(torch.linalg.vector_norm(goal - shown.start))
    if not gap > CLOSED * shown.size:
        share = f"{gap / shown.size:.1e} of its size"
        raise ValueError(f"demonstration: expected a goal apart from the start, got a closed loop ({share})")
    return gap


def only_one(shown: Sequence[Demonstration], method: str) -> Demonstration:
    """What is shown to a method that learns from exactly one demonstration."""
    if len(shown) != 1:
        raise ValueError(f"demonstration: {method} learns from exactly one, got {len(shown)}")
    return shown[0]
