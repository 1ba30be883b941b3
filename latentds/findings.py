"""What in a recording would hurt a fit, found before it: each place, its size, and the remedy.

Everything is looked at in the order in which it hides the rest: wraps and flips are undone, repeats and glitches
mended and rests left out before what comes after them is looked for.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import scipy
from numpy.typing import NDArray
from torch import Tensor

from .arguments import Array
from .curves import evenly_resampled, extent, jitter, progress_along, segment_distances, step_lengths

PERIODS = {"2π": 2 * math.pi, "360": 360.0}
"""What an angle wraps by, in radians and in degrees."""
WRAP_WITHIN, WRAP_TIMES = 0.25, 4.0
"""A step is a wrap if it is a period but for so much of it, and so many times what its neighbours move."""
FLIP_COSINE, UNIT_WITHIN = -0.5, 1e-3
"""Four columns whose norm is 1 but for the second number are a quaternion; it flips where the cosine between two rows
is below the first."""
LEAST_ROWS = 12
"""Fewer rows say nothing of what a usual step is."""
JUMP_TIMES, JUMP_SIZE, JUMP_RANGE, JUMP_LEAST = 8.0, 0.01, 0.2, 1e-3
"""A step is a jump if it is so many times the usual one, that of its neighbours and of its column, and if it is also so
large in sizes, or in ranges of a column that has another unit; below the last number of sizes a column rests."""
GLITCH_ROWS, GLITCH_BACK = 5, 0.3
"""A jump that goes back within so many rows, but for so much of it, is a glitch."""
BRIDGE_ROWS, BRIDGE_OTHERS = 10, 0.02
"""So many equal steps are a gap that was bridged straight, if no more than such a share of the others are equal."""
REPEAT_SHARE, REPEAT_STEP = 0.1, 0.3
"""Equal rows are repeats, and no rest, if the steps beside them are so much of the usual; a recording of which
more than the first number repeats was made in steps."""
REST_BALL, REST_SHARE = 0.1, 0.05
"""What stays within so many sizes of an end for so much of the duration may be a rest."""
REST_STILL, REST_CONTRAST, SWAY_LENGTH = 1e-3, 30.0, 3.0
"""It is one if the motion goes so many times as far in as long a time beside it (a smooth start: 7 times) or if it
moves so many times its extent; and within so many sizes nothing moves."""
PAUSE_SPEED, PAUSE_SHARE = 0.02, 0.05
"""Slower than so much of the usual speed for so much of the duration, on the way, is a pause."""
HIDDEN = 0.02
"""Noise or steps of so many sizes hide the motion: no fit comes nearer."""
LOOP = 0.05
"""A goal so near the start, in sizes, makes a loop: the system would have to leave where it comes to rest."""
NEAR, CROSSING, AWAY, STRAND_POINTS = 0.005, 1e-6, 0.1, 500
"""Strands nearer than the first, in sizes, nearly cross, and cross below the second; they are two strands if the motion
was farther away than the third in between. Looked at on so many points."""
STARTS_APART, GOALS_APART, TIMES_APART = 0.3, 0.05, 2.0
"""Several demonstrations differ if starts or goals are so many sizes from their mean, or if the longest or slowest is
so many times the shortest or fastest."""
CERTAIN = ("wrap", "flip", "jump", "glitch")
"""Kinds that hurt a robot although a fit may follow them."""


class Motion(Protocol):
    """What is looked at: any :class:`~latentds.Demonstration`."""

    @property
    def positions(self) -> Tensor: ...

    @property
    def dt(self) -> float: ...

    @property
    def columns(self) -> tuple[str, ...]: ...


@dataclass(frozen=True)
class Finding:
    """One thing in a recording that would hurt a fit.

    Attributes:
        kind: "wrap", "flip", "gap", "repeat", "jump", "glitch", "rest", "pause", "noise", "steps", "loop", "crossing",
            "near crossing"; of several demonstrations "starts", "goals", "lengths" or "durations".
        rows: the first and the last that it concerns.
        column: where it is seen most, or None if it concerns all.
        size: how large it is, in ``unit``.
        unit: "sizes" (of the motion), "s", "rows", "times" (the usual or the shortest) or "units" (of the column).
        text: one sentence, with the remedy.
    """

    kind: str
    rows: tuple[int, int]
    column: int | None
    size: float
    unit: str
    text: str

    @property
    def certain(self) -> bool:
        """Whether it hurts although a fit may follow it."""
        return self.kind in CERTAIN

    def places(self, count: int) -> list[tuple[int, int]]:
        """The first and last rows of what it marks among ``count`` rows."""
        first, last = self.rows
        if self.kind == "rest":  # what is left of the reach, and right of it
            return [(0, first), (last, count - 1)]
        apart = self.kind in ("loop", "crossing", "near crossing")
        return [(first, first), (last, last)] if apart else [(first, last)]

    def __str__(self) -> str:
        return self.text


@dataclass(frozen=True)
class Check:
    """The findings of a demonstration, to be read as a page or gone through."""

    found: tuple[Finding, ...]

    def __iter__(self) -> Iterator[Finding]:
        return iter(self.found)

    def __len__(self) -> int:
        return len(self.found)

    def __str__(self) -> str:
        if not self.found:
            return "nothing found that would hurt a fit"
        things = "1 thing" if len(self) == 1 else f"{len(self)} things"
        return "\n".join([f"{things} to look at", *(f"- {one}" for one in self.found)])


class Jump(NamedTuple):
    """A lone jump: the first and the last row off if it is a glitch, the row on either side if it lasts."""

    first: int
    last: int
    back: bool
    column: int
    length: float
    times: float


def every_finding(shown: Sequence[Motion]) -> tuple[Finding, ...]:
    """The findings of each of several demonstrations, told by number, and then those between them."""
    if len(shown) == 1:
        return findings(shown[0])
    each = [
        Finding(one.kind, one.rows, one.column, one.size, one.unit, f"demonstration {index}: {one.text}")
        for index, motion in enumerate(shown)
        for one in findings(motion)
    ]
    return (*each, *findings_between(shown))


def findings(shown: Motion) -> tuple[Finding, ...]:
    """What in a demonstration would hurt a fit, in a hundredth of a second."""
    return tuple(_findings(shown))


def _findings(shown: Motion) -> Iterator[Finding]:
    points, names, dt = shown.positions.numpy(), shown.columns, shown.dt
    for column, (period, rows) in wraps(points).items():
        word, value = _name(names, column), PERIODS[period]
        known = repr(names[column]) if names else column
        said = f"{word} jumps by {period} at {_rows(rows)}: .unwrapped([{known}])"
        yield Finding("wrap", (rows[0], rows[-1]), column, value, "units", said)
    points = unwrapped(points)
    for four, rows in flips(points, names).items():
        said = f"the quaternion from {_name(names, four[0])} on flips its sign at {_rows(rows)}: .continuous()"
        yield Finding("flip", (rows[0], rows[-1]), four[0], 1.0, "units", said)
    points = continuous(points, names)
    size = extent(points)
    yield from _gaps(points, dt)
    runs = repeats(points)
    if runs:
        count = sum(last - first for first, last in runs)
        rows = [first + 1 for first, _ in runs]
        said = f"{count} {'rows repeat' if count > 1 else 'row repeats'} the one before, {_rows(rows)}: .deglitched()"
        yield Finding("repeat", (rows[0], runs[-1][1]), None, float(count), "rows", said)
    points = bridged(points, runs)
    lone = jumps(points)
    for one in lone:
        where = f"at row {one.first}" if one.first == one.last else f"in rows {one.first} to {one.last}"
        much = f"{one.length / size:.2g} of the size, {_times(one.times)} the usual step"
        word = _name(names, one.column)
        if one.back:
            said = f"{word} has a glitch {where} ({much}): .deglitched()"
        else:
            said = f"{word} jumps at row {one.last} ({much}): .split_at([{one.last}])"
        yield Finding("glitch" if one.back else "jump", (one.first, one.last), one.column, one.times, "times", said)
    points = bridged(points, [(one.first - 1, one.last) for one in lone if one.back])
    first, last = reach(points)
    if (first, last) != (0, len(points) - 1):
        until = [f"until {first * dt:.3g} s"] if first else []
        after = [f"after {last * dt:.3g} s"] if last < len(points) - 1 else []
        said = f"rests or sways {' and '.join(until + after)}, while the reach lasts {(last - first) * dt:.3g} s"
        rest = (len(points) - 1 - (last - first)) * dt
        yield Finding("rest", (first, last), None, rest, "s", f"{said}: .trimmed()")
    moving = points[first : last + 1]
    for start, end in _pauses(moving):
        start, end = start + first, end + first
        said = f"waits for {(end - start) * dt:.3g} s at row {start}, which no autonomous system does"
        yield Finding("pause", (start, end), None, (end - start) * dt, "s", f"{said}: .split_at([{end}])")
    if hidden := what_hides(points, HIDDEN):
        said = f"{hidden}: .smoothed({0.05 * dt * (len(points) - 1):.2g}), in seconds"
        yield Finding(hidden.kind, (0, len(points) - 1), None, hidden.share, "sizes", said)
    yield from _meetings(moving, first, size, hidden is not None)


def findings_between(shown: Sequence[Motion]) -> Iterator[Finding]:
    """In what several demonstrations differ more than one system can follow."""
    paths = [one.positions.numpy() for one in shown]
    size = float(np.mean([extent(path) for path in paths]))
    for kind, row, limit, rest in (
        ("starts", 0, STARTS_APART, "what lies between them is shown by none: fit them one at a time, or show more"),
        ("goals", -1, GOALS_APART, "a system has one goal: shift them so that they end in one, or fit one at a time"),
    ):
        ends = np.stack([path[row] for path in paths])
        apart = np.linalg.norm(ends - ends.mean(0), axis=1) / size
        worst = int(apart.argmax())
        if apart[worst] > limit:
            said = f"{kind} are apart: demonstration {worst} by {apart[worst]:.2g} sizes from their mean; {rest}"
            at = row % len(paths[worst])
            yield Finding(kind, (at, at), None, float(apart[worst]), "sizes", said)
    lengths = [float(step_lengths(_calm(path)).sum()) for path in paths]
    durations = [one.dt * (len(path) - 1) for one, path in zip(shown, paths, strict=True)]
    for kind, values, remedy in (
        ("lengths", lengths, "leave out those of another shape"),
        ("durations", durations, ".trimmed() each, or leave out those of another speed"),
    ):
        ratio = max(values) / min(values)
        if ratio > TIMES_APART:
            most, least = int(np.argmax(values)), int(np.argmin(values))
            said = f"{kind} differ: that of demonstration {most} is {ratio:.2g} times that of {least}; {remedy}"
            yield Finding(kind, (0, len(paths[most]) - 1), None, ratio, "times", said)


def _name(names: tuple[str, ...], column: int) -> str:
    return f"column {names[column] if names else column}"


def _rows(rows: Sequence[int]) -> str:
    return f"row {rows[0]}" + (f" and at {len(rows) - 1} more, up to row {rows[-1]}" if len(rows) > 1 else "")


def _times(times: float) -> str:
    return f"{times:.0f} times" if math.isfinite(times) else "beside none of"


def _usual(steps: Array) -> Array:
    """What the neighbours of each step move: the larger median of the five before and after it, but for the nearest."""
    middle = scipy.ndimage.median_filter(steps, (5, *[1] * (steps.ndim - 1)), mode="nearest")
    before, after = np.zeros_like(steps), np.zeros_like(steps)
    before[5:], after[:-5] = middle[:-5], middle[5:]
    usual: Array = np.maximum(before, after)
    return usual


def _calm(points: Array) -> Array:
    """Means over a hundredth of the rows: noise is less, sways remain."""
    calm: Array = scipy.ndimage.uniform_filter1d(points, max(1, len(points) // 100), axis=0, mode="nearest")
    return calm


def wraps(points: Array) -> dict[int, tuple[str, list[int]]]:
    """{column: (period, rows that a wrap leads to)}."""
    found = {}
    steps = np.abs(np.diff(points, axis=0))
    if len(steps) < LEAST_ROWS or not (steps.max(0) > 0.75 * 2 * math.pi).any():
        return {}
    usual = _usual(steps)
    for column in range(points.shape[1]):
        for period, value in PERIODS.items():
            off = np.abs(steps[:, column] - value)
            slack = np.minimum(3 * usual[:, column] + 0.01 * value, WRAP_WITHIN * value)
            rows = np.flatnonzero((off < slack) & (steps[:, column] > WRAP_TIMES * usual[:, column])) + 1
            if len(rows):
                found[column] = (period, rows.tolist())
                break
    return found


def unwrapped(points: Array, periods: dict[int, float] | None = None) -> Array:
    """Columns that wrap without their wraps; by {column: period} if it is given."""
    if periods is None:
        periods = {column: PERIODS[period] for column, (period, _) in wraps(points).items()}
    points = points.copy()
    for column, period in periods.items():
        points[:, column] = np.unwrap(points[:, column], period=period)
    return points


def _quaternions(points: Array, names: tuple[str, ...]) -> Iterator[list[int]]:
    """Four columns each: those of one stem that end in x, y, z and w, or any four beside one another; of norm 1."""
    stems: dict[str, list[int]] = {}
    for column, name in enumerate(names):
        if name[-1:].lower() in tuple("xyzw"):
            stems.setdefault(name[:-1], []).append(column)
    named = [found for found in stems.values() if len({names[i][-1].lower() for i in found}) == len(found) == 4]
    taken: set[int] = set()
    for four in [*named, *(list(range(i, i + 4)) for i in range(points.shape[1] - 3))]:
        norms = np.linalg.norm(points[:, four], axis=1)
        if not taken & set(four) and np.abs(norms - 1).max() < UNIT_WITHIN:
            taken |= set(four)
            yield four


def flips(points: Array, names: tuple[str, ...] = ()) -> dict[tuple[int, ...], list[int]]:
    """{four columns: rows from which a quaternion has the other sign}."""
    found = {}
    for four in _quaternions(points, names):
        cosine = (points[1:, four] * points[:-1, four]).sum(1)
        rows = np.flatnonzero(cosine < FLIP_COSINE) + 1
        if len(rows) and np.median(cosine) > -FLIP_COSINE:
            found[tuple(four)] = rows.tolist()
    return found


def continuous(points: Array, names: tuple[str, ...] = ()) -> Array:
    """Quaternions without flips."""
    points = points.copy()
    for four, rows in flips(points, names).items():
        sign = np.ones(len(points))
        sign[rows] = -1
        points[:, list(four)] *= np.cumprod(sign)[:, None]
    return points


def _runs(true: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Each run of true as (first, behind the last)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]])))
    return [(int(first), int(last)) for first, last in edges.reshape(-1, 2)]


def repeats(points: Array) -> list[tuple[int, int]]:
    """Stale rows on the way: (the row that is repeated, the last that repeats it)."""
    lengths = step_lengths(points)
    if len(lengths) < LEAST_ROWS or lengths.all():
        return []
    usual, found = float(np.median(lengths[lengths > 0])), []
    for first, last in _runs(lengths == 0):
        if first > 0 and last < len(lengths):
            around = np.concatenate([lengths[max(0, first - 6) : first], lengths[last : last + 6]])
            least = REPEAT_STEP * max(usual, float(np.median(around)))
            if min(lengths[first - 1], lengths[last]) > least:
                found.append((first, last))
    return found if sum(last - first for first, last in found) <= REPEAT_SHARE * len(lengths) else []


def bridged(points: Array, spans: Sequence[tuple[int, int]]) -> Array:
    """Rows behind the first and up to the last of each span, linear between the rows that are known."""
    rows = np.arange(len(points))
    known = np.ones(len(points), bool)
    for first, last in spans:
        known[first + 1 : last + 1] = False
    return np.stack([np.interp(rows, rows[known], column[known]) for column in points.T], axis=1)


def jumps(points: Array) -> list[Jump]:
    """Lone jumps, in order."""
    moves = np.diff(points, axis=0)
    steps = np.abs(moves)
    if len(steps) < LEAST_ROWS:
        return []
    moving = steps > 0
    middle = np.array([np.median(step[one]) if one.any() else 0.0 for step, one in zip(steps.T, moving.T, strict=True)])
    usual = np.maximum(_usual(steps), middle)
    ranges = np.ptp(points, axis=0)
    fine = moving.mean(0) > 0.5  # a column that rests but for a tick of its encoder does not jump
    size = extent(points)
    large = (steps > JUMP_SIZE * size) | (fine & (steps > np.maximum(JUMP_RANGE * ranges, JUMP_LEAST * size)))
    lone = large & (steps > JUMP_TIMES * usual)
    rows = np.flatnonzero(lone.any(1)).tolist()
    found, at = [], 0
    while at < len(rows):
        row = rows[at]
        share = np.where(lone[row], steps[row] / np.maximum(ranges, 1e-300), 0)
        column = int(share.argmax())
        length = float(steps[row, column])
        times = length / usual[row, column] if usual[row, column] > 0 else math.inf
        back = next(
            (
                later
                for later in rows[at + 1 :]
                if later - row <= GLITCH_ROWS
                and abs(points[later + 1, column] - points[row, column]) < GLITCH_BACK * length
            ),
            None,
        )
        if back is None:
            found.append(Jump(row, row + 1, False, column, length, times))
        else:
            found.append(Jump(row + 1, back, True, column, length, times))
        at = at + 1 if back is None else rows.index(back) + 1
    return found


def _gaps(points: Array, dt: float) -> Iterator[Finding]:
    """Where rows are missing and a straight line stands for them: by many equal steps where hardly any are."""
    moves = np.diff(points, axis=0)
    equal = (np.abs(np.diff(moves, axis=0)) <= 1e-9 * np.abs(points).max()).all(1) & moves[1:].any(1)
    runs = [run for run in _runs(equal) if run[1] - run[0] >= BRIDGE_ROWS]
    others = np.count_nonzero(equal) - sum(last - first for first, last in runs)
    lone = len(runs) and others <= BRIDGE_OTHERS * len(equal) and sum(b - a for a, b in runs) < len(equal) / 2
    spans = [(first, (last - first + 1) * dt) for first, last in runs] if lone else []
    for first, seconds in spans:
        last = min(first + math.ceil(seconds / dt), len(points) - 1)
        said = f"{seconds:.3g} s are missing at row {first}, {seconds / dt:.0f} times the usual step"
        remedy = f"a straight line stands for them: .split_at([{first + 1}, {last}]) leaves it out"
        yield Finding("gap", (first, last), None, seconds, "s", f"{said}; {remedy}")


def reach(points: Array) -> tuple[int, int]:
    """The first and the last row of the motion itself, without rests and sways before and after it."""
    calm, last = _calm(points), len(points) - 1
    first, behind = _rest(calm), _rest(calm[::-1])
    return (first, last - behind) if last - behind - first >= max(3, 0.1 * last) else (0, last)


def _rest(calm: Array) -> int:
    """The row up to which a motion rests or sways; 0 if it starts at once."""
    size, count = extent(calm), len(calm)
    away = np.linalg.norm(calm - calm[0], axis=1) > REST_BALL * size
    leaves = int(away.argmax()) if away.any() else 0
    if leaves < max(3, REST_SHARE * count):
        return 0
    centre = np.median(calm[:leaves], axis=0)
    distance = np.linalg.norm(calm - centre, axis=1)
    near = distance[:leaves] <= max(2 * float(np.median(distance[:leaves])), REST_STILL * size)
    until = int(np.flatnonzero(near)[-1])
    if until < REST_SHARE * count:
        return 0
    wide = extent(calm[: until + 1])
    way = float(step_lengths(calm[: until + 1 : max(1, count // 100)]).sum())
    beside = float(distance[until : 2 * until + 1].max())
    still = wide < REST_STILL * size
    return until if still or beside > REST_CONTRAST * wide or way > SWAY_LENGTH * wide else 0


def _pauses(points: Array) -> list[tuple[int, int]]:
    speeds = step_lengths(_calm(points))
    slow = speeds < PAUSE_SPEED * np.median(speeds)
    long = [run for run in _runs(slow) if run[1] - run[0] > max(2, PAUSE_SHARE * len(speeds))]
    return [(first, last) for first, last in long if first > 0 and last < len(speeds)]


class Hidden(NamedTuple):
    """What hides a motion in its recording: "noise" or "steps", and of how many sizes."""

    kind: str
    share: float

    def __str__(self) -> str:
        if self.kind == "noise":
            return f"noise of {self.share:.2g} of its size hides the motion"
        return f"recorded in steps of {self.share:.2g} of its size, which hide the motion between them"


def what_hides(positions: Array, limit: float) -> Hidden | None:
    """Noise above a limit in sizes, read off fourth differences, or steps; None if little hides the motion."""
    if len(positions) < 10:
        return None
    size = extent(positions)
    noise = jitter(positions, 4) / size
    if noise > limit:
        return Hidden("noise", noise)
    moves = np.abs(np.diff(positions, axis=0))
    steps = [float(np.median(one[one > 0])) for one in moves.T if 0 < np.count_nonzero(one) < len(one) / 2]
    if steps and max(steps) > limit * size:
        return Hidden("steps", max(steps) / size)
    return None


def _meetings(points: Array, offset: int, size: float, hidden: bool) -> Iterator[Finding]:
    """A closed loop, and the place where strands come nearest if they nearly meet."""
    gap = float(np.linalg.norm(points[-1] - points[0])) / size
    if gap < LOOP:
        far = offset + int(np.linalg.norm(points - points[0], axis=1).argmax())
        said = f"ends {gap:.2g} of the size from where it begins, and no autonomous system can follow a closed loop"
        yield Finding(
            "loop", (offset, offset + len(points) - 1), None, gap, "sizes", f"{said}: .split_at([{far}]) makes two"
        )
    elif not hidden and len(points) > LEAST_ROWS and points.shape[1] > 1:
        curve = evenly_resampled(points, STRAND_POINTS)
        apart = scipy.spatial.distance.cdist(curve, curve)
        between = np.maximum.accumulate(np.triu(apart), axis=1)
        spacing = float(step_lengths(curve).max())
        first, second = np.nonzero(np.triu((between > AWAY * size) & (apart < NEAR * size + 2 * spacing), 2))
        keep = (first < STRAND_POINTS - 1) & (second < STRAND_POINTS - 1)
        first, second, step = first[keep], second[keep], np.diff(curve, axis=0)
        if not len(first):
            return
        distances = segment_distances(curve[first] - curve[second], step[first], step[second])
        worst = int(distances.argmin())
        near = float(distances[worst]) / size
        if near < NEAR:
            rows = np.interp(np.linspace(0, 1, STRAND_POINTS), progress_along(points), np.arange(len(points)))
            a, b = (offset + round(float(rows[at[worst]])) for at in (first, second))
            said = f"rows {a} and {b} come within {near:.2g} of the size of each other, and a system has one velocity"
            kind = "crossing" if near < CROSSING else "near crossing"
            yield Finding(
                kind, (a, b), None, near, "sizes", f"{said} at each point: .split_at([{(a + b) // 2}]) makes two"
            )
