"""The command `latentds`: from a recording to a system, a motion, a picture, a certificate, a comparison, a report."""

from __future__ import annotations

import ast
import csv
import importlib.metadata
import inspect
import io
import math
import pkgutil
import re
import shlex
import sys
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from enum import Enum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from . import fidelity, readers, storage
from .base import FitReport, StableDS
from .benchmark import Cell, Factory, RolloutProtocol, run
from .cell import interrupts_kept
from .certificate import certify as certified
from .datasets import joint_motion
from .demonstration import Demonstration
from .fidelity import FitWarning
from .files import atomic_write
from .methods.chebyshev import ChebyshevDS
from .methods.tube import TubeDS

if TYPE_CHECKING:
    import pandas as pd

HTML = (".html", ".htm")
NOT_FITTED = "source: expected a system that keeps its demonstration, got one that was not fitted"
PLUGINS = "latentds.methods"
"""The group of entry points under which an installed package names its methods: ``label = "module:Class"``."""
RADIUS = 0.05
"""Of the ball of perturbed starts, in sizes of the motion: the 0.1 of the paper, whose spirals are 2 wide."""


class Group(TyperGroup):
    """Tells what a user can mend in one line on stderr, and warnings likewise; a traceback is then a bug of ours."""

    def invoke(self, ctx: Any) -> Any:
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.showwarning = lambda message, *_: say(f"note: {message}", "yellow")  # type: ignore[assignment]
            try:
                return super().invoke(ctx)
            except KeyboardInterrupt:
                say("latentds: interrupted", "red")
                raise typer.Exit(130) from None
            except (ValueError, OSError, ImportError) as error:
                text = re.sub(r"\b(columns|time|unit|dt)=(?=[\s),.;]|$)", r"--\1", " ".join(str(error).split()))
                say(f"latentds: {text}", "red")
                raise typer.Exit(1) from None


app = typer.Typer(
    cls=Group, no_args_is_help=True, rich_markup_mode="rich", pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)  # fmt: skip

Source = Annotated[
    list[Path],
    typer.Argument(
        help="A system that `latentds fit` wrote, or recordings: several are several demonstrations of one motion.",
        show_default=False,
    ),
]
Recordings = Annotated[
    list[Path], typer.Argument(help="Tables of text, .npy, .npz, .mat or .json files.", show_default=False)
]
Columns = Annotated[
    list[str] | None,
    typer.Option(
        help="Positions: names of columns, or their numbers from 0, with commas or one by one.",
        rich_help_panel="How to read a recording",
    ),
]
Time = Annotated[str | None, typer.Option(help="Column of time stamps.", rich_help_panel="How to read a recording")]
Unit = Annotated[
    str | None,
    typer.Option(help="Of the time stamps: s, ms, us or ns.", rich_help_panel="How to read a recording"),
]
Dt = Annotated[
    float | None,
    typer.Option(
        help="Seconds between two rows; time stamps are not looked at.", rich_help_panel="How to read a recording"
    ),
]
METHOD_HELP = "A name that `latentds compare --help` lists, or module:Class; settings after it: TubeDS,n_layers=100."
Method = Annotated[str, typer.Option(help=METHOD_HELP)]
Methods = Annotated[list[str] | None, typer.Option("--method", help=METHOD_HELP, show_default=False)]
Starts = Annotated[int, typer.Option(min=0, help="Motions from other starts, beside the demonstrated one.")]
Radius = Annotated[
    float | None, typer.Option(help="Of the ball of those starts, in the positions' units; 5 % of the size by default.")
]
Seeds = Annotated[list[int] | None, typer.Option("--seed", min=0, help="Each is a fit of its own; 0 by default.")]
Jobs = Annotated[int | None, typer.Option(help="Processes; all cores by default.")]
Out = Annotated[Path | None, typer.Option("--out", "-o", help="File to write.", show_default=False)]


def say(text: str, style: str = "") -> None:
    """A line on stderr; nothing in it is markup."""
    Console(stderr=True).print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def tell(item: str | Table) -> None:
    """A line or a table on stdout."""
    width = None if sys.stdout.isatty() else 100
    Console(width=width).print(item, markup=False, highlight=False, soft_wrap=isinstance(item, str))


# What commands are given ----------------------------------------------------------------------------------------------


class Reading:
    """How the user wants recordings to be read."""

    def __init__(self, columns: list[str] | None, time: str | None, unit: str | None, dt: float | None) -> None:
        self.columns = [name.strip() for text in columns or () for name in text.split(",")] or None
        self.time, self.unit, self.dt = time, unit, dt

    def __call__(self, paths: Sequence[Path]) -> list[Demonstration]:
        """The recordings, each told in a line; their names differ."""
        shown = []
        for path in paths:
            names: set[str] = set()
            if any(name.isdigit() for name in [*(self.columns or ()), self.time or ""]):
                names = set(readers.read_table(path))  # a column called "3" is meant before the fourth one
            number = partial(_name_or_number, names=names)
            columns = None if self.columns is None else [number(name) for name in self.columns]
            time = None if self.time is None else number(self.time)
            twin = sum(path.stem == other.stem for other in paths) > 1
            name = str(path) if twin else None
            shown.append(Demonstration.load(path, columns=columns, time=time, unit=self.unit, dt=self.dt, name=name))
            say(shown[-1].origin, "dim")
        return shown

    def refuse(self, path: Path) -> None:
        """That nobody says how to read a system."""
        for name in ("columns", "time", "unit", "dt"):
            if getattr(self, name) is not None:
                raise ValueError(f"{name}: expected a recording, got a system: {path}")


def _name_or_number(text: str, names: set[str]) -> str | int:
    return int(text) if text.isdigit() and text not in names else text


def known_methods() -> dict[str, Any]:
    """{label: class, or an entry point that loads one}: ours, and those of installed packages."""
    plugged = {point.name: point for point in importlib.metadata.entry_points(group=PLUGINS)}
    return {"TubeDS": TubeDS, "Chebyshev": ChebyshevDS} | plugged


def method_of(text: str) -> Factory:
    """What ``NAME[,setting=value …]`` makes systems with.

    Raises:
        ValueError: if there is no such method, or it has no such setting.
        ImportError: if what it names cannot be imported.
    """
    name, *told = text.split(",")
    known = known_methods()
    if name in known:
        found = known[name]
        made = found.load() if hasattr(found, "load") else found
    elif ":" in name:
        try:
            made = pkgutil.resolve_name(name)
        except (AttributeError, ValueError) as error:
            raise ValueError(f"method: expected module:Class, got {name!r}: {error}") from None
    else:
        raise ValueError(f"method: expected one of {', '.join(known)}, or module:Class, got {name!r}")
    if not (inspect.isclass(made) and issubclass(made, StableDS)):
        raise ValueError(f"method: expected a StableDS, got {name!r}")
    wanted = [setting for setting in inspect.signature(made).parameters if setting != "dim"]
    settings = {}
    for part in told:
        setting, equals, value = part.partition("=")
        if not equals or setting not in wanted:
            raise ValueError(f"method: expected settings of {name} as NAME=VALUE, of {', '.join(wanted)}, got {part!r}")
        settings[setting] = _literal(value)
    return partial(made, **settings)


def methods_of(texts: Iterable[str]) -> dict[str, Factory]:
    """A label, which is what the user wrote, for each."""
    return {text: method_of(text) for text in texts}


def _literal(text: str) -> Any:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def is_system(paths: Sequence[Path]) -> bool:
    """Whether it is one file of a kind that no recording has."""
    return len(paths) == 1 and paths[0].suffix.lower() not in readers.READERS


def loaded(path: Path, method: str = "") -> tuple[StableDS, list[Demonstration]]:
    """A system from a file, and what its report keeps of its demonstrations."""
    classes = [kind.load() for kind in known_methods().values() if hasattr(kind, "load")]
    classes += [method_of(method).func] if ":" in method else []  # type: ignore[attr-defined]
    ds = storage.load(path, classes=classes)
    report = ds.fit_report
    names = [name for name, _ in report.learned_from] if report else []
    shown = []
    for i, one in enumerate(ds.excerpts()):
        name = names[i] if len(names) == len(ds.excerpts()) else f"{path.stem} {i + 1}"
        columns = report.columns if report else ()
        step = one.duration / (len(one.path) - 1)
        shown.append(Demonstration(np.array(one.path), step, name, columns=columns))  # type: ignore[arg-type]
    return ds, shown


def fitted(ds: StableDS, shown: list[Demonstration]) -> StableDS:
    """Fit, with something to look at meanwhile."""
    what = shown[0].name if len(shown) == 1 else f"{len(shown)} demonstrations"
    columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    with interrupts_kept(), bar:
        bar.add_task(f"fitting {type(ds).__name__} to {what}")
        return ds.fit(shown[0] if len(shown) == 1 else shown)


def system_of(paths: list[Path], reading: Reading, method: str) -> tuple[StableDS, list[Demonstration]]:
    """The system in a file, or one fitted to recordings; and the demonstrations, as far as they are known."""
    if is_system(paths):
        reading.refuse(paths[0])
        return loaded(paths[0], method)
    shown = reading(paths)
    return fitted(method_of(method)(shown[0].dim), shown), shown


def target(out: Path | None, paths: Sequence[Path], suffix: str, among: Sequence[str] = ()) -> Path:
    """Where to write: never over what was read."""
    chosen = out or Path(paths[0].stem + suffix)
    if among and chosen.suffix.lower() not in among:
        raise ValueError(f"out: expected a file of kind {' '.join(among)}, got {chosen.name!r}")
    if any(chosen.resolve() == path.resolve() for path in paths):
        raise ValueError(f"out: expected another file than {chosen}, which is what was read; say where: --out FILE")
    if not chosen.parent.is_dir():
        raise ValueError(f"out: expected a folder that exists, got {chosen.parent}")
    return chosen


def numbers(text: str, name: str, dim: int) -> torch.Tensor:
    """A point from ``0.1,0.2,…``."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != dim or not all(map(math.isfinite, values)):
        raise ValueError(f"{name}: expected {dim} numbers with commas between them, got {text!r}")
    return torch.tensor(values, dtype=torch.float64)


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
    write_motion(target(out, (), ""), motion.times.numpy(), motion.positions.numpy(), names)
    tell(f"{out}: {motion.duration:.1f} s of a made-up reach, seven joints in rad. Now try:\n")
    tell(f"  latentds fit {out}\n  latentds report {out}")


@app.command()
def fit(
    files: Recordings,
    out: Out = None,
    method: Method = "TubeDS",
    columns: Columns = None,
    time: Time = None,
    unit: Unit = None,
    dt: Dt = None,
) -> None:
    """Learn a system from a recording, or from several of one motion, and say how it follows them.

    \b
    latentds fit mine.csv                      writes mine.safetensors
    latentds fit first.csv second.csv -o reach.safetensors
    latentds fit log.csv --columns x,y,z --time stamp --unit ms
    latentds fit mine.csv --method Chebyshev,n_layers=200
    """
    path = target(out, files, ".safetensors")
    if path.suffix.lower() in readers.READERS:
        raise ValueError(f"out: expected a name that no recording has, such as mine.safetensors, got {path.name!r}")
    make = method_of(method)
    shown = Reading(columns, time, unit, dt)(files)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FitWarning)  # the table tells it
        ds = fitted(make(shown[0].dim), shown)
    ds.save(path)
    if isinstance(ds.fit_report, FitReport):
        tell_fit(ds.fit_report, type(ds).__name__)
    tell(f"wrote {path}")


def tell_fit(report: FitReport, title: str) -> None:
    table = Table("", "measured", "may be", title=f"{title}, {report.n_layers} layers, {report.seconds:.1f} s")
    for column in table.columns[1:]:
        column.justify = "right"
    table.add_row("mean squared error of the fit, per coordinate", f"{report.mse:.2e}", "")
    if (found := report.fidelity) is not None:
        more = found.spread
        for what, value, limit in (
            ("distance of the motion from the demonstration, in its sizes", found.miss, fidelity.MISS + more),
            ("  the worst from starts beside the demonstrated one", found.nearby, fidelity.NEARBY_MISS + more),
            ("  of their ends when the demonstration ends", found.end, fidelity.END + more),
            ("largest speed within 10 % of the size, over the largest shown", found.fastest, fidelity.FASTEST),
        ):
            table.add_row(what, f"{value:.3g}", f"{limit:.3g}")
        span = f"{fidelity.SHORTEST:g} to {fidelity.LONGEST:g}"
        table.add_row("length of the motion over that of the demonstration", f"{found.length_ratio:.3g}", span)
        if more:
            table.add_row("distance of the demonstrations from each other", f"{more:.3g}", "")
    tell(table)
    for note in report.notes:
        tell(f"note: {note}")
    if found is not None and found.follows:
        tell("It follows what it was shown.")


@app.command()
def rollout(
    source: Source,
    out: Out = None,
    start: Annotated[str | None, typer.Option("--from", help="Where to begin: 0.1,0.2,… As shown by default.")] = None,
    points: Annotated[int, typer.Option(min=2, help="Rows to write, even in time.")] = 500,
    duration: Annotated[float | None, typer.Option(help="Seconds; those of the demonstration by default.")] = None,
    method: Method = "TubeDS",
    columns: Columns = None,
    time: Time = None,
    unit: Unit = None,
    dt: Dt = None,
) -> None:
    """Write the motion from a start to the goal, as a table of time and coordinates.

    \b
    latentds rollout mine.safetensors          writes mine-rollout.csv
    latentds rollout mine.safetensors --from 0.1,0.2,-0.3 --duration 20 -o far.csv
    """
    path = target(out, source, "-rollout.csv", (".csv",))
    ds, shown = system_of(source, Reading(columns, time, unit, dt), method)
    if not shown and (start is None or duration is None):
        raise ValueError("from: expected a start and a duration, as this system keeps no demonstration")
    begin = shown[0].start if start is None else numbers(start, "from", ds.dim)
    seconds = max(d.duration for d in shown) if duration is None else duration
    if not (math.isfinite(seconds) and seconds > 0):
        raise ValueError(f"duration: expected seconds > 0, got {seconds:g}")
    times = torch.linspace(0, seconds, points, dtype=torch.float64)
    with torch.no_grad(), interrupts_kept():
        motion = ds.rollout(begin.to(ds.attractor), times)
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
def plot(
    source: Source,
    out: Out = None,
    starts: Starts = 20,
    radius: Radius = None,
    method: Method = "TubeDS",
    columns: Columns = None,
    time: Time = None,
    unit: Unit = None,
    dt: Dt = None,
) -> None:
    """Draw the demonstration and the system's motions: .png, .svg or .pdf.

    The field in two dimensions, a view in three, every coordinate over time in others.

    \b
    latentds plot mine.csv                     fits, and writes mine.png
    latentds plot mine.safetensors -o mine.pdf --starts 5
    """
    path = target(out, source, ".png", (".png", ".svg", ".pdf"))
    from . import plotting

    ds, shown = system_of(source, Reading(columns, time, unit, dt), method)
    if not shown:
        raise ValueError(NOT_FITTED)
    one = shown[0]
    protocol = RolloutProtocol(starts, RADIUS * one.size if radius is None else radius)
    begin = torch.cat([protocol.starts(one), *(d.start.unsqueeze(0) for d in shown[1:])])
    with torch.no_grad(), interrupts_kept():
        paths = ds.rollout(begin.to(ds.attractor), protocol.times(one)).double().numpy()
    label = type(ds).__name__
    if ds.dim == 2:
        figure = plotting.vector_field(ds, one, paths, label)
    elif ds.dim == 3:
        figure = plotting.replications(one, {label: paths})
    else:
        figure = plotting.joints(one, {label: paths})
    with atomic_write(path) as file:
        figure.savefig(file, format=path.suffix[1:].lower())
    tell(f"wrote {path}: {len(begin)} motions")


@app.command()
def certify(
    source: Source,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write it as JSON, too.", show_default=False)] = None,
    samples: Annotated[int, typer.Option(min=10, help="Points to search.")] = 1000,
    seed: Annotated[int, typer.Option(min=0, help="Of those points.")] = 0,
    method: Method = "TubeDS",
    columns: Columns = None,
    time: Time = None,
    unit: Unit = None,
    dt: Dt = None,
) -> None:
    """Say what is proven about a system, what was searched for in vain, and what is false (then it exits with 1).

    \b
    latentds certify mine.safetensors
    latentds certify mine.csv --samples 10000 -o certificate.json
    """
    path = None if out is None else target(out, source, "", (".json",))
    ds, _ = system_of(source, Reading(columns, time, unit, dt), method)
    with interrupts_kept():
        found = certified(ds, n_samples=samples, seed=seed)
    tell(str(found))
    if path is not None:
        with atomic_write(path) as file:
            file.write(found.to_json().encode())
        tell(f"wrote {path}")
    if not found.holds:
        raise typer.Exit(1)


def c_name(text: str) -> str:
    """As much of it as C takes for a name."""
    plain = re.sub(r"\W", "_", text, flags=re.ASCII)
    return plain if plain[:1].isalpha() else f"field_{plain}"


@app.command(epilog=f"Methods: {', '.join(known_methods())}.")
def compare(
    files: Recordings,
    method: Methods = None,
    starts: Starts = 20,
    radius: Radius = None,
    seed: Seeds = None,
    jobs: Jobs = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Write all rows as .csv, too.")] = None,
    report: Annotated[Path | None, typer.Option(help="Write a page of HTML, too.")] = None,
    columns: Columns = None,
    time: Time = None,
    unit: Unit = None,
    dt: Dt = None,
) -> None:
    """Compare methods on recordings, each a motion of its own: who follows best, from the same starts.

    \b
    latentds compare mine.csv                  every method that is installed
    latentds compare mine.csv --method TubeDS --method FDM,n_layers=200
    latentds compare one.csv two.csv --report report.html
    latentds compare mine.csv --method TubeDS --method my_package.motions:MyDS
    """
    table = None if out is None else target(out, files, "", (".csv",))
    page = None if report is None else target(report, files, "", HTML)
    methods = methods_of(method or known_methods())
    shown: list[Any] = Reading(columns, time, unit, dt)(files)
    rows, paths, told = compared(shown, methods, starts, radius, seed, jobs)
    tell_rows(rows, shown)
    if table is not None:
        with atomic_write(table) as file:
            file.write(rows.drop(columns=["certificate", "notes"]).to_csv(index=False).encode())
        tell(f"wrote {table}")
    if page is not None:
        write_report(page, rows, shown, paths, told)


@app.command()
def report(
    source: Source,
    out: Out = None,
    method: Methods = None,
    starts: Starts = 20,
    radius: Radius = None,
    seed: Seeds = None,
    jobs: Jobs = None,
    columns: Columns = None,
    time: Time = None,
    unit: Unit = None,
    dt: Dt = None,
) -> None:
    """Write one page of HTML that shows, without a network, how methods follow a motion: to turn, to play, to sort.

    TubeDS by default. `latentds compare --report` does it for every method, and for several motions.

    \b
    latentds report mine.csv                   writes mine.html
    latentds report mine.safetensors           of a system that was fitted
    latentds report mine.csv --method TubeDS --method Chebyshev -o both.html
    """
    page = target(out, source, ".html", HTML)
    reading = Reading(columns, time, unit, dt)
    if is_system(source):
        if seed or any(":" not in text for text in method or ()):
            raise ValueError(f"method, seed: expected recordings to fit to, got a system: {source[0]}")
        reading.refuse(source[0])
        ds, shown = loaded(source[0], *(method or ()))
        if not shown:
            raise ValueError(NOT_FITTED)
        make = partial(kept, ds.double())
        rows, paths, told = compared([shown], {type(ds).__name__: make}, starts, radius, None, 1)
        rows["fit_seconds"] = ds.fit_report.seconds if ds.fit_report else math.nan
    else:
        methods = methods_of(method or ["TubeDS"])
        shown = reading(source)
        rows, paths, told = compared([shown], methods, starts, radius, seed, jobs)
    write_report(page, rows, [shown], paths, told)


def kept(ds: StableDS, dim: int) -> StableDS:
    """The system itself, whose fit is done."""
    ds.fit = lambda *_, **__: ds  # type: ignore[method-assign]
    return ds


def compared(
    shown: Sequence[Demonstration | list[Demonstration]],
    methods: Mapping[str, Factory],
    starts: int,
    radius: float | None,
    seeds: list[int] | None,
    jobs: int | None,
) -> tuple[pd.DataFrame, dict[tuple[str, str, int], Any], dict[str, Any]]:
    """Rows, rollouts, and what to tell of how they came about."""
    import pandas as pd

    from .report import findings

    sizes = [one.size for item in shown for one in (item if isinstance(item, list) else [item])]
    protocol = RolloutProtocol(starts, RADIUS * min(sizes) if radius is None else radius)
    cells = [
        Cell(label, make, item, seed, measure=findings)
        for item in shown
        for label, make in methods.items()
        for seed in seeds or [0]
    ]
    done = list(run(cells, protocol, n_jobs=1 if len(cells) == 1 else jobs, progress=True))
    places = [cell.name for cell in cells]
    done.sort(key=lambda outcome: places.index((outcome.method, outcome.demonstration, outcome.seed)))
    rows = pd.DataFrame([row for outcome in done for row in outcome.rows])
    for (label, name), reason in (
        rows[rows["error"] != ""].groupby(["method", "demonstration"])["error"].first().items()
    ):
        say(f"note: {label} fails on {name}: {reason}", "yellow")
    paths = {(outcome.method, outcome.demonstration, outcome.seed): outcome.paths for outcome in done}
    command = " ".join(["latentds", *map(shlex.quote, sys.argv[1:])])
    settings = {label: make(cells[0].shown[0].dim).settings for label, make in methods.items()}
    return rows, paths, {"command": command, "protocol": asdict(protocol), "methods": settings}


def tell_rows(rows: pd.DataFrame, shown: Sequence[Any]) -> None:
    from .report import Comparison, percent, verdict

    found = Comparison(rows, shown)
    titles = "around", "± sd", "worst", "shown start", "end", "arrive", "follow", "fit [s]"
    table = Table("method", *titles, title="Distances (exact DTW over points) in percent of the motion's size")
    table.columns[0].overflow = "fold"
    for column in table.columns[1:]:
        column.justify = "right"
    for line in found.ranking():
        shares = [percent(line[key]) for key in ("level", "spread", "worst", "own", "end")]
        counts = ["{} of {}".format(*line[key]) for key in ("arrives", "follows")]
        table.add_row(Text(line["method"]), *shares, *counts, f"{line['seconds']:.2g}")
    tell(table)
    for sentence in verdict(found):
        tell(sentence)


def write_report(path: Path, rows: pd.DataFrame, shown: Sequence[Any], paths: Any, settings: dict[str, Any]) -> None:
    from .report import write

    write(path, rows, shown, paths=paths, settings=settings)
    tell(f"wrote {path}")


class Format(str, Enum):
    ONNX = "onnx"
    C = "c"


@app.command()
def export(
    format: Annotated[Format, typer.Argument(help="An ONNX model, or one C99 header.", show_default=False)],
    source: Source,
    out: Out = None,
    name: Annotated[str | None, typer.Option(help="What names in C begin with; the file's by default.")] = None,
    method: Method = "TubeDS",
    columns: Columns = None,
    time: Time = None,
    unit: Unit = None,
    dt: Dt = None,
) -> None:
    """Write the velocity field for a machine without Python.

    \b
    latentds export c mine.safetensors         writes mine.h
    latentds export onnx mine.safetensors -o reach.onnx
    """
    path = target(out, source, {"c": ".h", "onnx": ".onnx"}[format.value])
    if format is Format.ONNX:
        from .deploy import onnx

        write = onnx.write
    else:
        from .deploy import c

        write = partial(c.write, name=name or c_name(path.stem))
    ds, _ = system_of(source, Reading(columns, time, unit, dt), method)
    write(ds, path)
    tell(f"wrote {path}")
