"""Hostile demonstrations: each ends in a system that follows it, in one that says it does not, or in a ValueError.

Run it with ``make fuzz``; ``ARGS="--cases 5000 --seed 3"`` changes what is tried. Leaves results/fuzz/cases.csv.
"""

from __future__ import annotations

import faulthandler
import math
import sys
import time
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
import torch
import typer
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from hypothesis import strategies as st
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from baselines import FDM, SDSEF
from experiments import report
from latentds import ChebyshevDS, Demonstration, FitWarning, StableDS, TubeDS, certify
from latentds.arguments import Array
from latentds.certificate import Line
from latentds.curves import interpolated
from latentds.fidelity import MISS_LIMIT

SLOW = "SDS-EF"
"""Learns by gradient, so it gets a third of the others' cases."""
METHODS: dict[str, Callable[[int], StableDS]] = {
    "ChebyshevDS": lambda dim: ChebyshevDS(dim, n_layers=40),
    "FDM": lambda dim: FDM(dim, n_layers=40),
    SLOW: lambda dim: SDSEF(dim, n_layers=3, n_features=30, seed=0, epochs=100),
    "TubeDS": lambda dim: TubeDS(dim, n_layers=40, refined=False),
}
Draw = np.random.Generator
ANY_DIM: dict[str, Callable[[Array, Array, Draw], Array]] = {
    "smooth": lambda t, axis, draw: (
        np.sin(2 * np.pi * (draw.uniform(0.2, 1.0, len(axis)) * t + draw.uniform(0, 1, len(axis)))) - 2 * t
    ),
    "walk": lambda t, axis, draw: np.cumsum(draw.normal(size=(len(t), len(axis))), axis=0) / math.sqrt(len(t)),
    "zigzag": lambda t, axis, draw: t * axis + 0.2 * (np.arange(len(t))[:, None] % 2) * draw.normal(size=len(axis)),
    "collinear": lambda t, axis, draw: t * axis,
    "one axis": lambda t, axis, draw: t * np.eye(len(axis))[0],
    "spiral": lambda t, axis, draw: (1 - t) * np.cos(2 * np.pi * draw.uniform(1, 8) * t + np.arange(len(axis))),
    "corners": lambda t, axis, draw: interpolated(t[:, 0], np.linspace(0, 1, 4), draw.normal(size=(4, len(axis)))),
    "loop": lambda t, axis, draw: np.cos(2 * np.pi * (t % 1) + np.arange(len(axis))),  # ends where it began
    "crossing": lambda t, axis, draw: np.sin((np.arange(len(axis)) + 1) * np.pi * 1.7 * t),
    "there and back": lambda t, axis, draw: np.minimum(t, 1.2 - t) * axis,
}
"""Curves (N, n) in as many dimensions as an axis (n,) has, over t (N, 1) from 0 to 1."""
WINDING: dict[str, Callable[[Array, Array, Draw], tuple[Array, ...]]] = {
    "planar spiral": lambda t, near, draw: _spiral(1 - 0.95 * t, 2 * np.pi * draw.uniform(2, 5) * t),
    "near circle": lambda t, near, draw: (np.cos(near), np.sin(near)),
    "near Lissajous": lambda t, near, draw: (np.sin(3 * near), np.sin(4 * near + 0.4), np.sin(5 * near + 1.1)),
    "near trefoil": lambda t, near, draw: (
        np.sin(near) + 2 * np.sin(2 * near), np.cos(near) - 2 * np.cos(2 * near), -np.sin(3 * near)
    ),
    "helix": lambda t, near, draw: (*_spiral(1.0, 2 * np.pi * draw.uniform(2, 30) * t), draw.uniform(0.5, 4) * t),
    "loop-the-loop": lambda t, near, draw: _loop_the_loop(t, draw.uniform(0.05, 0.5)),
}  # fmt: skip
"""Coordinates (N,) each of curves in a plane or in space that wind, or come back to where they began, or nearly so.

Of t (N,), from 0 to 1, and of an angle that almost comes round.
"""
SHAPES = (*ANY_DIM, *WINDING)
FLAWS: dict[str, Callable[[Array, int, Draw], Array]] = {
    "none": lambda path, middle, draw: path,
    "noise": lambda path, middle, draw: path + 10.0 ** draw.uniform(-12, -1) * draw.normal(size=path.shape),
    "pause": lambda path, middle, draw: _with(path, slice(middle, middle + max(1, len(path) // 3)), path[middle]),
    "rest at start": lambda path, middle, draw: _with(path, slice(middle), path[0]),
    "rest at end": lambda path, middle, draw: _with(path, slice(middle, None), path[-1]),
    "repeats": lambda path, middle, draw: path[np.sort(draw.integers(0, len(path), len(path)))],
    "jump": lambda path, middle, draw: _with(
        path, slice(middle, None), path[middle:] + 100 * draw.normal(size=path.shape[1])
    ),
    "near loop": lambda path, middle, draw: _with(
        path, -1, path[0] + 10.0 ** draw.uniform(-15, -3) * draw.normal(size=path.shape[1])
    ),
    "nan": lambda path, middle, draw: _not_finite(path, math.nan, middle, draw),
    "inf": lambda path, middle, draw: _not_finite(path, draw.choice([-math.inf, math.inf]), middle, draw),
    "equal": lambda path, middle, draw: _with(path, slice(draw.choice([0, len(path) // 4]), None), path[0]),
}
"""What spoils a path (N, n); ``middle`` is N // 2."""
FORMS: dict[str, Callable[[Array], Any]] = {
    "float64": torch.from_numpy,
    "float32": lambda path: torch.from_numpy(path.astype(np.float32)),
    "float16": lambda path: torch.from_numpy(path.astype(np.float16)),
    "int64": lambda path: torch.from_numpy(path.astype(np.int64)),
    "strided": lambda path: _strided(path),
    "transposed": lambda path: torch.from_numpy(np.ascontiguousarray(path.T)).T,
    "requires_grad": lambda path: torch.from_numpy(path).requires_grad_(),
    "numpy": lambda path: path,
    "list": lambda path: path.tolist(),
}
HUNG_AFTER = 60.0
"""Seconds."""


class Case(NamedTuple):
    """How to make one demonstration; everything in it is drawn by hypothesis."""

    method: str
    shape: str
    flaw: str
    form: str
    n_points: int
    dim: int
    scale: float
    offset: float
    dt: float
    seed: int

    def positions(self) -> Any:
        """The motion, (N, n), in the form that it is handed over in."""
        draw = np.random.default_rng(self.seed)
        path = _path(self.shape, self.n_points, self.dim, draw)
        if self.flaw not in FLAWS:
            raise ValueError(f"flaw: expected one of {(*FLAWS,)}, got {self.flaw!r}")
        path = self.scale * FLAWS[self.flaw](path, len(path) // 2, draw) + self.offset
        with np.errstate(over="ignore", invalid="ignore"):
            return FORMS[self.form](path)


def _path(shape: str, count: int, dim: int, draw: Draw) -> Array:
    t, axis = np.linspace(0, 1, count), draw.normal(size=dim)
    if shape in ANY_DIM:
        return ANY_DIM[shape](t[:, None], axis, draw)
    if shape not in WINDING:
        raise ValueError(f"shape: expected one of {SHAPES}, got {shape!r}")
    near = 2 * np.pi * (1 - 10.0 ** draw.uniform(-4, -1)) * t
    columns = np.stack(WINDING[shape](t, near, draw))
    turned = np.linalg.qr(draw.normal(size=(max(dim, len(columns)), len(columns))))[0]
    return np.asarray((turned[:dim] @ columns).T)


def _spiral(radius: Array | float, angle: Array) -> tuple[Array, Array]:
    return radius * np.cos(angle), radius * np.sin(angle)


def _loop_the_loop(t: Array, apart: float) -> tuple[Array, ...]:
    angle = 2 * np.pi * np.clip(3 * t - 1, 0, 1)
    return 3 * t + np.sin(angle), 1 - np.cos(angle), apart * t


def _with(path: Array, where: Any, value: Any) -> Array:
    spoiled = path.copy()
    spoiled[where] = value
    return spoiled


def _not_finite(path: Array, number: float, middle: int, draw: Draw) -> Array:
    """From the middle on, one sample or all that follow, in one coordinate."""
    return _with(path, (slice(middle, draw.choice([middle + 1, len(path)])), draw.integers(path.shape[1])), number)


def _strided(path: Array) -> torch.Tensor:
    wide = np.zeros((2 * len(path), 3 * path.shape[1]))
    wide[::2, ::3] = path
    return torch.from_numpy(wide)[::2, ::3]


def cases(largest: int = 5000) -> st.SearchStrategy[Case]:
    """Demonstrations with N from 3 to ``largest`` points in 1 to 10 dimensions, at scales from 1e-9 to 1e9."""
    counts = st.one_of(st.integers(3, 12), st.integers(13, 300), st.integers(301, max(301, largest)))
    return st.builds(
        Case,
        st.sampled_from([name for name in sorted(METHODS) for _ in range(1 if name == SLOW else 3)]),
        st.sampled_from(SHAPES),
        st.sampled_from([*FLAWS]),
        st.sampled_from([*FORMS]),
        counts.map(lambda count: min(count, largest)),
        st.integers(1, 10),
        st.floats(-9, 9).map(lambda power: 10.0**power),
        st.sampled_from([0.0, 0.0, 1.0, -1e3, 1e6]),
        st.sampled_from([1e-2, 1e-6, 1.0, 1e4]),
        st.integers(0, 2**32 - 1),
    )


FOLLOWS, SAYS, REFUSED, BROKEN = "follows", "says that it does not follow", "refused", "BROKEN"
EXCUSED = (
    "decode inverts encode", "encode inverts decode", "the closed-form Jacobian is autograd's",
    "ψ neither folds nor flattens space", "V is above 0, and falls to 0 at the attractor", "V falls along motions",
    "a motion is its two halves", "motions are the field's integral", "every motion arrives within 100 durations",
    "follows its demonstration",
)  # fmt: skip
"""Claims that may be false of a fit that says that it does not follow: what only floats break, and its timing."""
FLAT_COSINE = 1e-12
"""A cosine of ∇V and f that is no larger is none that such a fit's rounding tells from 0."""


def outcome(case: Case) -> str:
    """What became of a case: ``FOLLOWS``, ``SAYS``, "refused: …", or, if a promise is broken, "BROKEN …"."""
    try:
        shown = Demonstration(case.positions(), case.dt)
        with warnings.catch_warnings(record=True) as raised:
            warnings.simplefilter("always")
            ds = METHODS[case.method](case.dim).fit(shown)
    except ValueError as error:
        text = str(error)
        named = text.startswith(("positions: ", "demonstration: ", "dt: "))
        return f"{REFUSED}: {text}" if named else f"{BROKEN} a ValueError that names no argument: {text}"
    except Exception as error:
        return f"{BROKEN} {type(error).__name__}: {error}"
    says = any(issubclass(warning.category, FitWarning) for warning in raised)
    try:
        with torch.no_grad():
            path = ds.rollout(shown.start, torch.linspace(0, shown.duration, 1000, dtype=torch.float64))
            finite = bool(torch.isfinite(path).all() and torch.isfinite(ds(path)).all())
        certificate = certify(ds, n_samples=40)
    except Exception as error:
        return f"{BROKEN} after the fit, {type(error).__name__}: {error}"
    if not finite:
        return f"{BROKEN} NaN or inf in a rollout from the demonstrated start"
    missed = float(torch.cdist(shown.positions, path).amin(1).mean()) / shown.size
    if not says and missed > 1.2 * MISS_LIMIT:  # no alignment in time, exact DTW's neither, can bring them nearer
        return f"{BROKEN} a silent misfit off by {missed:.2g} of the size"
    broken = [line for line in certificate.falsified if not (says and _excused(line))]
    if broken:
        return f"{BROKEN} certificate: " + "; ".join(str(line) for line in broken)
    return SAYS if says else FOLLOWS


def _excused(line: Line) -> bool:
    return line.claim in EXCUSED or (line.claim.startswith("V decreases") and line.worst <= FLAT_COSINE)


def summary(results: list[tuple[Case, str, float]]) -> str:
    """Outcomes of each method, then what was refused or broken, by kind, the commonest first."""
    ends = (FOLLOWS, SAYS, REFUSED, BROKEN)
    counts = Counter((case.method, end) for case, ending, _ in results for end in ends if ending.startswith(end))
    methods = sorted({case.method for case, *_ in results})
    lines = [[method, *(str(counts[method, end]) for end in ends)] for method in methods]
    kinds = Counter(_kind(ending) for _, ending, _ in results if ending.startswith((REFUSED, BROKEN)))
    slowest = max(seconds for *_, seconds in results)
    head, table = f"{len(results)} cases, slowest {slowest:.1f} s", report.table(["", *ends], lines)
    return "\n".join([head, "", table, "", *(f"{count:6d}  {kind}" for kind, count in kinds.most_common())])


def _kind(ending: str) -> str:
    if ending.startswith(f"{BROKEN} certificate"):
        return " ".join(ending.split(" (")[0].split())
    return ending.split(", got")[0].split(" that comes back to")[0].split(" off by")[0][:110]


def main(
    n_cases: Annotated[int, typer.Option("--cases", min=1, help="How many to try.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Of hypothesis.")] = 0,
    largest: Annotated[int, typer.Option(min=3, help="Most points in a demonstration.")] = 5000,
    out: Annotated[Path, typer.Option(help="Folder for cases.csv.")] = Path("results/fuzz"),
) -> None:
    """Try hostile demonstrations and print a summary by outcome; exit code 1 if the promise was broken."""
    results: list[tuple[Case, str, float]] = []
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn()) as bar:
        task = bar.add_task("hostile demonstrations", total=n_cases)

        @seeded(seed)
        @settings(
            max_examples=n_cases, deadline=None, database=None, phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )  # fmt: skip
        @given(cases(largest))
        def attempt(case: Case) -> None:
            faulthandler.dump_traceback_later(HUNG_AFTER, exit=True)
            began = time.perf_counter()
            ending = outcome(case)
            faulthandler.cancel_dump_traceback_later()
            results.append((case, ending, time.perf_counter() - began))
            if ending.startswith(BROKEN):
                bar.console.print(f"{case}\n{ending}\n", markup=False, highlight=False)
            broken = sum(text.startswith(BROKEN) for _, text, _ in results)
            bar.update(task, advance=1, description=f"hostile demonstrations, {broken} broken promises")

        attempt()
    out.mkdir(parents=True, exist_ok=True)
    lines = [(*case, ending, f"{seconds:.3f}") for case, ending, seconds in results]
    table = pd.DataFrame(lines, columns=[*Case._fields, "outcome", "seconds"])
    report.write(out / "cases.csv", table.to_csv(index=False))
    print(summary(results))
    sys.exit(any(ending.startswith(BROKEN) for _, ending, _ in results))


if __name__ == "__main__":
    typer.run(main)
