"""Hostile demonstrations: each ends in a system that follows it, in one that says it does not, or in a ValueError.

A system that follows is then tampered with, and must be told from what it was.

Run it with ``make fuzz``; ``ARGS="--cases 5000 --seed 3"`` changes what is tried. Leaves results/fuzz/cases.csv.
"""

from __future__ import annotations

import faulthandler
import sys
import time
import warnings
from collections import Counter
from pathlib import Path
from typing import Annotated

import numpy as np
import pandas as pd
import torch
import typer
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import seed as seeded
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from torch import Tensor

from experiments import report
from experiments.hostile import METHODS, Case, cases
from experiments.tampering import TAMPERINGS
from latentds import Demonstration, FitWarning, certify
from latentds.certificate import Line
from latentds.fidelity import END_LIMIT, MISS_LIMIT

LONGEST_WAIT = 60.0
"""Seconds that a case may take; ten times as many, and it hangs."""
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
        shown = case.shown()
        with warnings.catch_warnings(record=True) as raised:
            warnings.simplefilter("always")
            ds = METHODS[case.method](case.dim).fit(shown)
    except ValueError as error:
        text = str(error)
        named = text.startswith(("positions: ", "demonstration: ", "dt: "))
        return f"{REFUSED}: {text}" if named else f"{BROKEN} a ValueError that names no argument: {text}"
    except Exception as error:
        return f"{BROKEN} {type(error).__name__}: {error}"
    said = [str(warning.message) for warning in raised if issubclass(warning.category, FitWarning)]
    says = any("does not follow what it was shown" in text for text in said)
    try:
        with torch.no_grad():
            times = torch.linspace(0, shown[0].duration, 1000, dtype=torch.float64)
            paths = ds.rollout(torch.stack([one.start for one in shown]), times)
            finite = bool(torch.isfinite(paths).all() and torch.isfinite(ds(paths)).all())
        certificate = certify(ds, n_samples=40)
    except Exception as error:
        return f"{BROKEN} after the fit, {type(error).__name__}: {error}"
    if not finite:
        return f"{BROKEN} NaN or inf in a rollout from the demonstrated start"
    missed = "" if says else _missed(shown, paths)
    if missed:
        return f"{BROKEN} a silent misfit {missed}"
    lost = "encode inverts decode" in {line.claim for line in certificate.falsified}
    broken = [line for line in certificate.falsified if not (says and _excused(line, lost))]
    if broken:
        return f"{BROKEN} certificate: " + "; ".join(str(line) for line in broken)
    if says or not case.tampering:
        return SAYS if says else FOLLOWS
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            silence = TAMPERINGS[case.tampering](ds, shown, np.random.default_rng(case.seed))
    except Exception as error:
        silence = f"{type(error).__name__}: {error}"
    return f"{BROKEN} after tampering, {case.tampering}: {silence}" if silence else FOLLOWS


def _missed(shown: list[Demonstration], paths: Tensor) -> str:
    """How a motion misses its own demonstration, though no alignment in time, exact DTW's neither, brings them nearer.

    Goals that lie apart excuse the end alone, by as much as they do.
    """
    middle = torch.stack([one.goal for one in shown]).mean(0)
    for one, path in zip(shown, paths, strict=True):
        off = float(torch.cdist(one.positions, path).amin(1).mean()) / one.size
        if off > 1.2 * MISS_LIMIT:
            return f"off by {off:.2g} of the size"
    spread, late = (
        max(float(torch.linalg.vector_norm(one.goal - end)) / one.size for one, end in zip(shown, ends, strict=True))
        for ends in ([middle] * len(shown), paths[:, -1])
    )
    return f"off by {late:.2g} of the size at its end" if late > 1.2 * (END_LIMIT + spread) else ""


def _excused(line: Line, lost: bool) -> bool:
    """A map that floats have ``lost`` may be so flat that they cannot tell moving there from rest."""
    known = (*EXCUSED, "no equilibrium but the attractor") if lost else EXCUSED
    return line.claim in known or (line.claim.startswith("V decreases") and line.worst <= FLAT_COSINE)


def summary(results: list[tuple[Case, str, float]]) -> str:
    """Outcomes of each method, then what was refused, broken or told of tampering, by kind, the commonest first."""
    ends = (FOLLOWS, SAYS, REFUSED, BROKEN)
    counts = Counter((case.method, end) for case, ending, _ in results for end in ends if ending.startswith(end))
    methods = sorted({case.method for case, *_ in results})
    lines = [[method, *(str(counts[method, end]) for end in ends)] for method in methods]
    kinds = Counter(_kind(ending) for _, ending, _ in results if ending.startswith((REFUSED, BROKEN)))
    kinds.update(f"told: {case.tampering}" for case, ending, _ in results if ending == FOLLOWS and case.tampering)
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
    torch.set_num_threads(1)  # beside other work, threads that wait for each other make minutes of seconds
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
            faulthandler.dump_traceback_later(10 * LONGEST_WAIT, exit=True)
            began = time.perf_counter()
            ending = outcome(case)
            faulthandler.cancel_dump_traceback_later()
            seconds = time.perf_counter() - began
            if seconds > LONGEST_WAIT and not ending.startswith(BROKEN):
                ending = f"{BROKEN} a wait of {seconds:.0f} s"
            results.append((case, ending, seconds))
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
