"""What every study leaves behind: tables, what was reached of its goals, p-values, and where it was measured."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
import typer
from matplotlib.axes import Axes
from rich.console import Console
from scipy import stats

from latentds import report
from latentds.arguments import Array
from latentds.files import atomic_write


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table: the first column to the left, the others to the right."""
    rule = [":--", *["--:"] * (len(header) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *rows))


def environment() -> dict[str, Any]:
    """Versions, machine, date and, in a git checkout, revision."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        revision = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        revision = None
    return {"revision": revision, **report.environment()}


def write(path: Path, content: str | dict[str, Any]) -> None:
    """Text, or a mapping as JSON; the file is there whole or not at all."""
    text = content if isinstance(content, str) else json.dumps(content, indent=2) + "\n"
    with atomic_write(path) as file:
        file.write(text.encode())


@contextmanager
def interruptible(console: Console) -> Iterator[None]:
    """Ctrl-C ends the command with what a reader needs to know: the work that is done is kept."""
    try:
        yield
    except KeyboardInterrupt:
        console.print("Interrupted; the same command goes on from here.")
        raise typer.Exit(130) from None


def plain(axes: Axes, grid: Literal["x", "y", "both"] = "both") -> None:
    """Leave of a picture's frame what carries numbers, with a pale grid behind."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(axis=grid, color="#DDDDDD", lw=0.6)
    axes.set_axisbelow(True)


# --- scores over starts -----------------------------------------------------------------------------------------------


def welch(first: Any, second: Any) -> float:
    """p of Welch's t-test: two samples that may differ in variance, as the paper takes it."""
    return float(stats.ttest_ind(first, second, equal_var=False).pvalue)


def paired(first: Any, second: Any) -> float:
    """p of the paired t-test: both methods move from the same starts."""
    return float(stats.ttest_rel(first, second).pvalue)


def mean_or_inf(scores: Array) -> float:
    """The mean; inf where a rollout failed."""
    return float(scores.mean()) if np.isfinite(scores).all() else np.inf


def mean_and_spread(scores: Array) -> str:
    """Mean ± standard deviation."""
    return f"{scores.mean():.2f} ± {scores.std(ddof=1):.2f}" if np.isfinite(scores).all() else "failed"


# --- goals ------------------------------------------------------------------------------------------------------------


class Goal(NamedTuple):
    """What a study asks for, and what it reached: a line of :func:`goal_table`."""

    what: str
    goal: str
    reached: str
    quartiles: str = ""
    """Over the rounds of a measurement."""
    unit: str = ""
    met: bool | None = None
    """None: not measured, or reported without a goal."""
    note: str = ""


def goal_table(goals: Sequence[Goal]) -> str:
    """A line per goal, without the columns that none of them fills."""
    met = {None: "—", True: "yes", False: "**no**"}
    lines = [[met[cell] if name == "met" else cell for name, cell in g._asdict().items()] for g in goals]
    filled = [i for i, column in enumerate(zip(*lines, strict=True)) if any(column)]
    return table([Goal._fields[i] for i in filled], [[line[i] for i in filled] for line in lines])


def at_most(
    what: str, values: pd.Series[float] | float, bound: float, suffix: str = "", *, unit: str = "", note: str = ""
) -> Goal:
    """That no value is larger than ``bound``; names those that are. ``suffix`` follows both, "≤ 10 s"."""
    series = values if isinstance(values, pd.Series) else pd.Series([float(values)])
    if series.empty:
        return Goal(what, f"≤ {bound:g}{suffix}", "not measured")
    over = series[~(series <= bound)]
    reached = f"{series.max():.3g}{suffix}"
    if len(over) and len(series) > 1:
        reached += f"; above it: {', '.join(f'{name} {value:.3g}' for name, value in over.items())}"
    return Goal(what, f"≤ {bound:g}{suffix}", reached, unit=unit, met=over.empty, note=note)


def median(what: str, unit: str, bound: float, rounds: Array, *, at_most: bool = False, note: str = "") -> Goal:
    """That the median over the rounds is at least ``bound``, or at most."""
    low, reached, high = np.quantile(rounds, (0.25, 0.5, 0.75))
    met = bool(reached <= bound if at_most else reached >= bound)
    goal = f"{'≤' if at_most else '≥'} {bound:g}"
    return Goal(what, goal, f"{reached:.3g}", f"{low:.3g} to {high:.3g}", unit, met, note)


def ratio(what: str, least: float, slow: Array, fast: Array) -> Goal:
    """That ``slow`` takes ``least`` times longer than ``fast``: of medians, with the quartiles round by round."""
    reached = float(np.median(slow) / np.median(fast))
    note = f"{_time(np.median(slow))} against {_time(np.median(fast))}"
    line = median(what, "times faster", least, slow / fast, note=note)
    return line._replace(reached=f"{reached:.3g}", met=reached >= least)


def _time(seconds: np.floating) -> str:
    scales = (("s", 1), ("ms", 1e3), ("µs", 1e6))
    return next(f"{seconds * scale:.3g} {unit}" for unit, scale in scales if seconds * scale >= 1)
