"""The command `latentds`: from a recording to a system, a motion, a picture, a certificate, a comparison, a report."""

from __future__ import annotations

import csv
import io
import math
import re
import shlex
import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import rich
import torch
import typer
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from .. import benchmark, findings, recordings
from ..base import FitReport, StableDS
from ..cell import STARTS_WITHIN, Cell, Factory, RolloutProtocol, interrupts_kept, judge
from ..certificate import certify as certified
from ..datasets import joint_motion
from ..demonstration import Demonstration
from ..fidelity import FitWarning
from ..files import atomic_write
from ..integrate import integrate
from . import given
from .given import RecordingOptions, reads_recordings, say, tell

if TYPE_CHECKING:
    import pandas as pd

HTML = (".html", ".htm")
NOT_FITTED = "source: expected a system that keeps its demonstration, got one that was not fitted"
DOUBTFUL = 3
"""The exit status of what was done and should be looked at: 1 is an error, 2 one of usage."""


class Group(TyperGroup):
    """Errors that the user can mend become one line on stderr, and so do warnings; a traceback is a bug of ours."""

    def invoke(self, ctx: Any) -> Any:
        rich.reconfigure(stderr=True)  # bars, which all draw on rich's own console, so that one may hold another
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.showwarning = lambda message, *_: say(f"note: {message}", "yellow")  # type: ignore[assignment]
            try:
                return super().invoke(ctx)
            except KeyboardInterrupt:
                say("latentds: interrupted", "red")
                raise typer.Exit(130) from None
            except (ValueError, OSError, ImportError) as error:
                text = re.sub(r"\b(columns|time|unit|dt|episode)=(?=[\s),.;]|$)", r"--\1", " ".join(str(error).split()))
                text = text.replace("Demonstration.load_all", "--episode all")
                say(f"latentds: {text}", "red")
                raise typer.Exit(1) from None


app = typer.Typer(
    cls=Group, no_args_is_help=True, rich_markup_mode="rich", pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)  # fmt: skip


# The commands ---------------------------------------------------------------------------------------------------------


@app.callback(epilog="Begin with: latentds demo")
def latentds() -> None:
    """Show a robot a motion once; get back a velocity field that reproduces it and reaches the goal from everywhere."""


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="File to write.")] = Path("arm.csv"),
    seed: Annotated[int, typer.Option(min=0, help="Each makes another motion.")] = 0,
) -> None:
    """Write a made-up recording of a seven-joint arm, to try all this with.

    \b
    latentds demo
    latentds fit arm.csv
    latentds report arm.csv
    """
    if out.exists():
        raise ValueError(f"out: {out} is there already; say where: --out FILE")
    motion, names = joint_motion(seed), [f"joint_{i}" for i in range(1, 8)]
    write_motion(given.target(out, (), ""), motion.times.numpy(), motion.positions.numpy(), names)
    tell(f"{out}: {motion.duration:.1f} s of a made-up reach, seven joints in rad. Now try:\n")
    tell(f"  latentds fit {out}\n  latentds report {out}")


@app.command()
@reads_recordings
def check(files: given.Recordings, out: given.Out = None, *, options: RecordingOptions) -> None:
    """Say what in a recording would hurt a fit, where and what helps, and exit with 3 if there is something.

    \b
    latentds check mine.csv
    latentds check first.csv second.csv -o mine.png        every coordinate over time, with the places marked
    """
    path = None if out is None else given.target(out, files, "", (".png", ".svg", ".pdf"))
    shown = options.read(files)
    found = findings.Check(findings.every_finding(shown))
    tell(str(found))
    if path is not None:
        from .. import plotting

        with atomic_write(path) as file:
            plotting.checked(shown).savefig(file, format=path.suffix[1:].lower())
        tell(f"wrote {path}")
    if len(found):
        raise typer.Exit(DOUBTFUL)


@app.command()
@reads_recordings
def fit(
    files: given.Recordings,
    out: given.Out = None,
    method: given.Method = "TubeDS",
    anyway: Annotated[bool, typer.Option("--anyway", help="Write a system that does not follow, too.")] = False,
    *,
    options: RecordingOptions,
) -> None:
    """Learn a system from a recording, or from several of one motion, and say how it follows them.

    \b
    latentds fit mine.csv                      writes mine.safetensors
    latentds fit first.csv second.csv -o reach.safetensors
    latentds fit log.csv --columns x,y,z --time stamp --unit ms
    latentds fit mine.csv --method Chebyshev,n_layers=200

    A system that does not follow is written only with --anyway, and the exit status is 3 then, too.
    """
    path = given.target(out, files, ".safetensors")
    if path.suffix.lower() in recordings.READERS:
        raise ValueError(f"out: expected a name that no recording has, such as mine.safetensors, got {path.name!r}")
    make = given.method_of(method)
    shown = options.read(files)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)  # the table tells it
        ds = given.fitted(make(shown[0].dim), shown)
    report = ds.fit_report
    assert isinstance(report, FitReport)
    follows = report.fidelity is not None and report.fidelity.follows
    if not follows:
        off = report.fidelity.notes[0] if report.fidelity else report.notes[-1]
        say(f"It does NOT follow what it was shown: it {off}.", "red")
    tell(f"{type(ds).__name__}, {report}")
    if follows or anyway:
        ds.save(path)
    tell(f"wrote {path}" if follows or anyway else f"{path} was not written; --anyway writes it")
    if not follows:
        raise typer.Exit(DOUBTFUL)


@app.command()
@reads_recordings
def rollout(
    source: given.Source,
    out: given.Out = None,
    start: Annotated[str | None, typer.Option("--from", help="Where to begin: 0.1,0.2,… As shown by default.")] = None,
    goal: Annotated[
        str | None,
        typer.Option(help="Where to end: 0.1,0.2,… The motion is turned and scaled to lead there.", show_default=False),
    ] = None,
    max_speed: Annotated[
        float, typer.Option(help="Positions' units per second that no velocity exceeds; the curve stays.")
    ] = math.inf,
    points: Annotated[int, typer.Option(min=2, help="Rows to write, even in time.")] = 500,
    duration: Annotated[float | None, typer.Option(help="Seconds; those of the demonstration by default.")] = None,
    method: given.Method = "TubeDS",
    *,
    options: RecordingOptions,
) -> None:
    """Write the motion from a start to the goal, as a table of time and coordinates.

    \b
    latentds rollout mine.safetensors          writes mine-rollout.csv
    latentds rollout mine.safetensors --from 0.1,0.2,-0.3 --duration 20 -o far.csv
    latentds rollout mine.safetensors --goal 0.4,0.1,0.3 --max-speed 0.25
    """
    path = given.target(out, source, "-rollout.csv", (".csv",))
    ds, shown = given.system_of(source, options, method)
    if not shown and (start is None or duration is None):
        raise ValueError("from: expected a start and a duration, as this system keeps no demonstration")
    begin = shown[0].start if start is None else given.numbers(start, "from", ds.dim)
    seconds = max(d.duration for d in shown) if duration is None else duration
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError(f"duration: expected seconds > 0, got {seconds:g}")
    if goal is not None:
        ds = ds.with_start_and_goal(begin, given.numbers(goal, "goal", ds.dim))
    times = torch.linspace(0, seconds, points, dtype=torch.float64)
    with torch.no_grad(), interrupts_kept():
        if max_speed == math.inf:
            motion = ds.rollout(begin.to(ds.attractor), times)
        else:
            held = ds.controller(max_speed=max_speed)
            motion = integrate(
                lambda y: torch.from_numpy(held(y.numpy())), begin.double(), times, ds.attractor.double()
            )
    left = float(torch.linalg.vector_norm(motion[-1] - ds.attractor))
    report = ds.fit_report
    write_motion(path, times.numpy(), motion.double().numpy(), report.columns if isinstance(report, FitReport) else ())
    tell(f"wrote {path}: {points} rows, {seconds:.4g} s; it ends {left:.3g} from the goal")


def write_motion(path: Path, times: np.ndarray, positions: np.ndarray, columns: Sequence[str]) -> None:
    """A table that `Demonstration.load` reads, with names."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["t [s]", *(columns or [f"y{i}" for i in range(positions.shape[1])])])
    table.writerows(np.column_stack([times, positions]).tolist())
    with atomic_write(path) as file:
        file.write(text.getvalue().encode())


@app.command()
@reads_recordings
def plot(
    source: given.Source,
    out: given.Out = None,
    starts: given.Starts = 20,
    radius: given.Radius = None,
    method: given.Method = "TubeDS",
    *,
    options: RecordingOptions,
) -> None:
    """Draw the demonstration and the system's motions: .png, .svg or .pdf.

    The field in two dimensions, a view in three, every coordinate over time in others.

    \b
    latentds plot mine.csv                     fits, and writes mine.png
    latentds plot mine.safetensors -o mine.pdf --starts 5
    """
    path = given.target(out, source, ".png", (".png", ".svg", ".pdf"))
    from .. import plotting

    ds, shown = given.system_of(source, options, method)
    if not shown:
        raise ValueError(NOT_FITTED)
    protocol = RolloutProtocol(starts, radius)
    begin = torch.cat([protocol.starts(shown[0]), *(d.start.unsqueeze(0) for d in shown[1:])])
    with torch.no_grad(), interrupts_kept():
        paths = ds.rollout(begin.to(ds.attractor), protocol.times(shown[0])).double().numpy()
    label = type(ds).__name__
    if ds.dim == 2:
        figure = plotting.vector_field(ds, shown, paths, label)
    elif ds.dim == 3:
        figure = plotting.replications(shown, {label: paths})
    else:
        figure = plotting.joints(shown, {label: paths})
    with atomic_write(path) as file:
        figure.savefig(file, format=path.suffix[1:].lower())
    tell(f"wrote {path}: {len(begin)} motions")


@app.command()
@reads_recordings
def certify(
    source: given.Source,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write it as JSON, too.", show_default=False)] = None,
    samples: Annotated[int, typer.Option(min=10, help="Points to search.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Of those points.")] = 0,
    method: given.Method = "TubeDS",
    *,
    options: RecordingOptions,
) -> None:
    """Say what is proven about a system, what was searched for in vain, and what is false (then it exits with 1).

    \b
    latentds certify mine.safetensors
    latentds certify mine.csv --samples 10000 -o certificate.json
    """
    path = None if out is None else given.target(out, source, "", (".json",))
    ds, _ = given.system_of(source, options, method)
    with interrupts_kept():
        certificate = certified(ds, n_samples=samples, seed=seed)
    tell(str(certificate))
    if path is not None:
        with atomic_write(path) as file:
            file.write(certificate.to_json().encode())
        tell(f"wrote {path}")
    if not certificate.holds:
        raise typer.Exit(1)


def c_name(text: str) -> str:
    """The text as an identifier in C."""
    plain = re.sub(r"\W", "_", text, flags=re.ASCII)
    return plain if plain[:1].isalpha() else f"field_{plain}"


@app.command(epilog=f"Methods: {', '.join(given.known_methods())}.")
@reads_recordings
def compare(
    files: given.Recordings,
    method: given.Methods = None,
    starts: given.Starts = 20,
    radius: given.Radius = None,
    seed: given.Seeds = None,
    jobs: given.Jobs = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write all rows as .csv, too.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write a page of HTML, too.")] = None,
    *,
    options: RecordingOptions,
) -> None:
    """Compare methods on recordings, each a motion of its own: who follows best, from the same starts.

    \b
    latentds compare mine.csv                  every method that is installed, in minutes
    latentds compare mine.csv --method TubeDS --method FDM,n_layers=200
    latentds compare one.csv two.csv --report report.html
    latentds compare mine.csv --method TubeDS --method my_package.motions:MyDS
    """
    table = None if out is None else given.target(out, files, "", (".csv",))
    page = None if report is None else given.target(report, files, "", HTML)
    methods = given.methods_of(method or given.known_methods())
    shown = options.read(files)
    rows, paths, settings = compared(methods, shown, starts, radius, seed, jobs)
    tell_rows(rows, shown)
    if table is not None:
        with atomic_write(table) as file:
            file.write(rows.drop(columns=["certificate", "notes"], errors="ignore").to_csv(index=False).encode())
        tell(f"wrote {table}")
    if page is not None:
        write_report(page, rows, shown, paths, settings)


@app.command()
@reads_recordings
def report(
    source: given.Source,
    out: given.Out = None,
    method: given.Methods = None,
    starts: given.Starts = 20,
    radius: given.Radius = None,
    seed: given.Seeds = None,
    jobs: given.Jobs = None,
    *,
    options: RecordingOptions,
) -> None:
    """Write one page of HTML that shows, without a network, how methods follow a motion: to turn, to play, to sort.

    TubeDS by default. `latentds compare --report` does it for every method, and for several motions.

    \b
    latentds report mine.csv                   writes mine.html
    latentds report mine.safetensors           of a system that was fitted
    latentds report mine.csv --method TubeDS --method Chebyshev -o both.html
    """
    page = given.target(out, source, ".html", HTML)
    if given.is_system(source):
        if seed or any(":" not in text for text in method or ()):
            raise ValueError(f"method, seed: expected recordings to fit to, got a system: {source[0]}")
        options.refuse(source[0])
        from ..report import findings

        ds, shown = given.loaded(source[0], *(method or ()))
        if not shown:
            raise ValueError(NOT_FITTED)
        cell, protocol = Cell(type(ds).__name__, type(ds), shown, measure=findings), RolloutProtocol(starts, radius)
        paths: benchmark.Paths = {}
        rows = benchmark.table([cell], [judge(ds.double(), cell, protocol)], paths)
        settings = settings_of(protocol, {cell.method: ds})
    else:
        methods = given.methods_of(method or ["TubeDS"])
        shown = options.read(source)
        rows, paths, settings = compared(methods, [shown], starts, radius, seed, jobs)
    write_report(page, rows, [shown], paths, settings)


def compared(
    methods: Mapping[str, Factory],
    motions: Sequence[Demonstration | list[Demonstration]],
    starts: int,
    radius: float | None,
    seeds: list[int] | None,
    jobs: int | None,
) -> tuple[pd.DataFrame, benchmark.Paths, dict[str, Any]]:
    """Rows with certificates, rollouts, and the settings that a report shows."""
    from ..report import findings

    every = [one for item in motions for one in (item if isinstance(item, list) else [item])]
    protocol, seeds = RolloutProtocol(starts, radius), seeds or [0]
    paths: benchmark.Paths = {}
    jobs = 1 if len(methods) * len(motions) * len(seeds) == 1 else jobs
    how = {**asdict(protocol), "seeds": seeds, "n_jobs": jobs, "progress": True}
    rows = benchmark.compare(methods, motions, **how, paths=paths, measure=findings)
    return rows, paths, settings_of(protocol, {label: make(every[0].dim) for label, make in methods.items()})


def settings_of(protocol: RolloutProtocol, systems: Mapping[str, StableDS]) -> dict[str, Any]:
    command = " ".join(["latentds", *map(shlex.quote, sys.argv[1:])])
    methods = {label: ds.settings for label, ds in systems.items()}
    how = asdict(protocol)
    if protocol.radius is None:
        how["radius"] = f"{STARTS_WITHIN:.0%} of the size of each motion"
    return {"command": command, "protocol": how, "methods": methods}


def tell_rows(rows: pd.DataFrame, shown: Sequence[Any]) -> None:
    from ..report import ARRIVE, Comparison, percent, verdict

    comparison = Comparison(rows, shown)
    titles = "around", "± sd", "worst", "shown start", "end", "arrive", "follow", "fit [s]"
    table = Table(
        "method", *titles, title="Distances (exact DTW over points) in percent of the motion's size", caption=ARRIVE
    )
    table.columns[0].overflow = "fold"
    for column in table.columns[1:]:
        column.justify = "right"
    for line in comparison.ranking():
        shares = [percent(line[key]) for key in ("level", "spread", "worst", "own", "end")]
        counts = ["{} of {}".format(*line[key]) for key in ("arrives", "follows")]
        table.add_row(Text(line["method"]), *shares, *counts, f"{line['seconds']:.2g}")
    tell(table)
    for sentence in verdict(comparison):
        tell(sentence)


def write_report(path: Path, rows: pd.DataFrame, motions: Sequence[Any], paths: Any, settings: dict[str, Any]) -> None:
    from ..report import write

    write(path, rows, motions, paths=paths, settings=settings)
    tell(f"wrote {path}")


class Format(str, Enum):
    ONNX = "onnx"
    C = "c"


@app.command()
@reads_recordings
def export(
    format: Annotated[Format, typer.Argument(help="An ONNX model, or one C99 header.", show_default=False)],
    source: given.Source,
    out: given.Out = None,
    name: Annotated[str | None, typer.Option(help="What names in C begin with; the file's by default.")] = None,
    method: given.Method = "TubeDS",
    *,
    options: RecordingOptions,
) -> None:
    """Write the velocity field for a machine without Python.

    \b
    latentds export c mine.safetensors         writes mine.h
    latentds export onnx mine.safetensors -o reach.onnx
    """
    path = given.target(out, source, {"c": ".h", "onnx": ".onnx"}[format.value])
    if format is Format.ONNX:
        from ..deploy import onnx

        write = onnx.write
    else:
        from ..deploy import c

        write = partial(c.write, name=name or c_name(path.stem))
    ds, _ = given.system_of(source, options, method)
    write(ds, path)
    tell(f"wrote {path}")
