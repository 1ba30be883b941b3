"""Several motions in one table, told apart."""

from __future__ import annotations

import re
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import vocabulary
from .readers import Table

LEAST_ROWS = 3
"""Of a motion."""
NUMBERED = re.compile(r"^(?P<before>(?:.*/)?)(?P<stem>[^/\d]*)(?P<number>\d+)(?P<after>/.*)?$")
"""A name of which one part, between slashes, ends with a number."""


def split(table: Table) -> tuple[str, dict[str, Table]]:
    """By what a table's motions are told apart, and the table of each by its label; ("", {}) if it holds but one.

    A column that numbers them; arrays or groups of arrays that are numbered in their names; arrays (K, N, n); or a time
    that starts over.
    """
    for way in (_by_column, _by_name, _by_axis, _by_time):
        how, parts = way(table)
        if len(parts) > 1:
            return how, parts
    return "", {}


def _by_column(table: Table) -> tuple[str, dict[str, Table]]:
    for name, column in table.items():
        told = vocabulary.has_word(name.rpartition("/")[2], vocabulary.EPISODE_WORDS)
        if not told or column.ndim != 1 or len(column) < LEAST_ROWS:
            continue
        starts = np.flatnonzero(column[1:] != column[:-1]) + 1
        if len(starts) and np.diff([0, *starts, len(column)]).min() < LEAST_ROWS:
            continue  # a coordinate of that name
        values = column[[0, *starts]]
        whole = values.dtype.kind == "f" and bool((values == values.round()).all())
        labels = [str(value) for value in (values.astype(np.int64) if whole else values)]
        if len(set(labels)) == len(labels):
            return f"column {name!r}", _rows(table, len(column), starts, labels)
    return "", {}


def _by_time(table: Table) -> tuple[str, dict[str, Table]]:
    for name, column in table.items():
        known = (
            column.ndim == 1 and column.dtype.kind in "fiuM" and len(column) > LEAST_ROWS and vocabulary.is_time(name)
        )
        if known and vocabulary.unit_in(name) != "ns":  # which may stand beside whole seconds
            starts = np.flatnonzero(np.diff(column) < np.zeros(1, np.diff(column).dtype)) + 1
            if len(starts) and np.diff([0, *starts, len(column)]).min() >= LEAST_ROWS:
                labels = [str(k) for k in range(len(starts) + 1)]
                return f"time {name!r}, which starts over", _rows(table, len(column), starts, labels)
    return "", {}


def _rows(table: Table, count: int, starts: NDArray[Any], labels: list[str]) -> dict[str, Table]:
    """The table of each run of rows."""

    def part(low: int, high: int) -> Table:
        return {name: a[low:high] if a.ndim and len(a) == count else a for name, a in table.items()}

    return {label: part(*ends) for label, ends in zip(labels, pairwise([0, *starts, count]), strict=True)}


def _by_name(table: Table) -> tuple[str, dict[str, Table]]:
    numbered = {name: match for name, a in table.items() if a.ndim and (match := NUMBERED.match(name))}
    stems = {match["stem"] for match in numbered.values()}
    parts: dict[str, Table] = {}
    for name, match in numbered.items():
        label, kept = (match["stem"] + match["number"], "") if len(stems) == 1 else (match["number"], match["stem"])
        inside = (match["before"] + kept + (match["after"] or "")).replace("//", "/").strip("/")
        parts.setdefault(label, {})[inside] = table[name]
    wide = all(any(a.ndim == 2 and min(a.shape) > 1 for a in part.values()) for part in parts.values())
    alike = len({frozenset(part) for part in parts.values()}) == 1
    together = len({match["before"] for match in numbered.values()}) == 1
    shared = {name: array for name, array in table.items() if array.ndim == 0}
    how = f"names such as {next(iter(numbered), '')!r}"
    return how, {label: shared | part for label, part in parts.items()} if wide and alike and together else {}


def _by_axis(table: Table) -> tuple[str, dict[str, Table]]:
    stacks = {name: a for name, a in table.items() if a.ndim == 3 and a.dtype.kind in "fiu"}
    counts = {len(a) for a in stacks.values()}
    rows = {len(a) for name, a in table.items() if a.ndim == 1 and vocabulary.is_time(name)}
    if len(counts) != 1 or counts & rows:  # with a time for each along the first axis it is rows of several points
        return "", {}
    count = counts.pop()
    several = {name for name, a in table.items() if a.ndim > 1 and len(a) == count}
    how = f"the first axis of {next(iter(stacks)) or 'the array'}"
    return how, {str(k): {name: a[k] if name in several else a for name, a in table.items()} for k in range(count)}
