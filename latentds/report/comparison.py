"""What the rows of a comparison say of each method: how near it stays to each motion, and which comes first."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..arguments import Array
from ..cell import COLUMNS, joint_name, several
from ..demonstration import Demonstration

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Motion:
    """One motion of a comparison: its judges, and how many starts each has."""

    name: str
    shown: tuple[Demonstration, ...]
    share: int

    @property
    def size(self) -> float:
        return max(one.size for one in self.shown)

    def judge(self, start: int) -> Demonstration:
        """The one that a start, by its number, belongs to."""
        return self.shown[start // self.share]


@dataclass(frozen=True)
class Distances:
    """How far one method's rollouts are from one motion: exact DTW over points, in sizes of the motion.

    Attributes:
        own: from the demonstrated starts, means over seeds; NaN where a rollout failed.
        others: from the starts around them, likewise.
    """

    own: Array
    others: Array

    @property
    def judged(self) -> Array:
        """What methods are ranked by: starts nobody showed, if there are some."""
        return self.others if len(self.others) else self.own

    @property
    def level(self) -> float:
        return level(self.judged)

    @property
    def spread(self) -> float:
        """The standard deviation; NaN where a rollout failed."""
        return float(self.judged.std(ddof=1)) if len(self.judged) > 1 else 0.0


def level(scores: Array) -> float:
    """The mean; inf where a rollout failed."""
    return float(scores.mean()) if np.isfinite(scores).all() else math.inf


class Comparison:
    """Rows of :func:`latentds.compare` beside the demonstrations that they were scored by.

    Args:
        rows, demonstrations: as for :func:`latentds.report.write`.

    Raises:
        ValueError: if rows lack columns of ``compare``, or the demonstrations do not fit them.
    """

    def __init__(self, rows: pd.DataFrame, demonstrations: Any) -> None:
        if missing := {*COLUMNS} - set(rows):
            raise ValueError(f"rows: expected the columns of compare, got none named {sorted(missing)}")
        if rows.empty:
            raise ValueError("rows: expected at least one")
        self.rows = rows
        self.methods: list[str] = list(rows["method"].unique())
        items = [demonstrations] if isinstance(demonstrations, Demonstration) else list(demonstrations)
        demonstrated = {joint_name(shown): shown for shown in (several(item, "demonstrations") for item in items)}
        self.motions = [
            self._motion(name, demonstrated[name]) for name in demonstrated if (rows["demonstration"] == name).any()
        ]
        if absent := set(rows["demonstration"]) - set(demonstrated):
            raise ValueError(f"demonstrations: expected those of the rows, got none named {min(absent)!r}")

    def _motion(self, name: str, shown: tuple[Demonstration, ...]) -> Motion:
        of = self.rows[self.rows["demonstration"] == name]
        count = int(of["start"].max()) + 1
        if count % len(shown):
            raise ValueError(f"demonstrations: expected the judges of {name!r}, got {len(shown)} for {count} starts")
        if "judge" in of and {*of["judge"]} != {one.name for one in shown}:
            raise ValueError(f"rows: expected motions judged by those that were shown, got {name!r} judged by others")
        return Motion(name, shown, count // len(shown))

    @property
    def n_starts(self) -> int:
        """Starts beside a demonstrated one."""
        return max(motion.share for motion in self.motions) - 1

    def distances(self, method: str, motion: Motion) -> Distances | None:
        """None if the method was not tried on the motion."""
        of = self.rows[(self.rows["demonstration"] == motion.name) & (self.rows["method"] == method)]
        if of.empty:
            return None
        scores = of.groupby("start")["dtw_per_point"].apply(lambda values: values.mean(skipna=False))
        own = scores.index.to_numpy() % motion.share == 0
        values = scores.to_numpy(dtype=np.float64) / [motion.judge(start).size for start in scores.index]
        return Distances(values[own], values[~own])

    def ranking(self) -> list[dict[str, Any]]:
        """A line for each method, the best first; a method that was not tried on every motion comes after those.

        Returns:
            Mappings of "method"; "level", "spread" and "worst": mean, standard deviation and largest distance from the
            starts around the demonstrated one (from that if there are no others), means over motions; "own" from the
            demonstrated one; "end", how far motions end from the demonstrated end, in sizes; "arrives" and "follows",
            (how many, of how many) rows converged and fits follow; "seconds" of a fit; "failed" rows; "motions" tried.
        """
        sizes = {motion.name: motion.size for motion in self.motions}
        lines = []
        for method in self.methods:
            of = self.rows[self.rows["method"] == method]
            known = [one for motion in self.motions if (one := self.distances(method, motion)) is not None]
            fits = of.groupby(["demonstration", "seed"], sort=False).first()
            lines.append(
                {
                    "method": method,
                    "level": float(np.mean([one.level for one in known])),
                    "own": float(np.mean([level(one.own) for one in known])),
                    "spread": float(np.mean([one.spread for one in known])),
                    "worst": float(np.max([one.judged.max() for one in known])),
                    "end": float((of["endpoint_error"] / of["demonstration"].map(sizes)).mean(skipna=False)),
                    "arrives": (int(of["converged"].sum()), len(of)),
                    "follows": (int(fits["follows"].sum()), len(fits)),
                    "seconds": float(fits["fit_seconds"].mean()),
                    "failed": int((of["status"] != "ok").sum()),
                    "motions": len(known),
                }
            )
        return sorted(lines, key=lambda line: (-line["motions"], line["level"]))

    def by_motion(self) -> list[dict[str, Any]]:
        """A line for each motion: its name, each method's :class:`Distances` or None, and the lowest level."""
        lines = []
        for motion in self.motions:
            cells = [self.distances(method, motion) for method in self.methods]
            best = min(cell.level for cell in cells if cell is not None)
            lines.append({"name": motion.name, "cells": cells, "best": best})
        return lines

    def certificates(self) -> list[dict[str, Any]]:
        """What each fit's certificate says; of several seeds the first one's."""
        if "certificate" not in self.rows:
            return []
        certificates = []
        for (name, method), of in self.rows.groupby(["demonstration", "method"], sort=False):
            text = of["certificate"].iloc[0]
            if isinstance(text, str):
                lines: Sequence[dict[str, Any]] = json.loads(text)["lines"]
                counts = [[line["verdict"] for line in lines].count(kind) for kind in ("proven", "not falsified")]
                false = [line["claim"] for line in lines if line["verdict"] == "falsified"]
                certificates.append(
                    {"motion": name, "method": method, "counts": counts, "false": false, "lines": lines}
                )
        return certificates
