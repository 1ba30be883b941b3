"""What the commands are given: options, recordings, systems and methods; and how they speak."""

from __future__ import annotations

import ast
import difflib
import importlib.metadata
import inspect
import math
import pkgutil
import sys
from collections.abc import Callable, Iterable, Sequence
from functools import partial, wraps
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from .. import recordings, storage
from ..base import StableDS
from ..cell import Factory, interrupts_kept
from ..demonstration import Demonstration
from ..methods.chebyshev import ChebyshevDS
from ..methods.tube import TubeDS

PLUGINS = "latentds.methods"
"""The group of entry points under which an installed package names its methods: ``label = "module:Class"``."""

Source = Annotated[
    list[Path],
    typer.Argument(
        help="A system that `latentds fit` wrote, or recordings: several are several demonstrations of one motion.",
        show_default=False,
    ),
]
Recordings = Annotated[
    list[Path],
    typer.Argument(help=f"Files of kind {' '.join(recordings.READERS)}, or bags of ROS 2.", show_default=False),
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
_option = partial(typer.Option, rich_help_panel="How to read a recording")
Columns = Annotated[
    list[str] | None, _option(help="Positions: names of columns, or their numbers from 0, with commas or one by one.")
]
Time = Annotated[str | None, _option(help="Column of time stamps.")]
Unit = Annotated[str | None, _option(help="Of the time stamps: s, ms, us or ns.")]
Dt = Annotated[float | None, _option(help="Seconds between two rows; time stamps are not looked at.")]
Episode = Annotated[str | None, _option(help="Which motion of a file that holds several, by its label, or all.")]


def say(text: str, style: str = "") -> None:
    """A line on stderr; nothing in it is markup."""
    Console(stderr=True).print(text, style=style, markup=False, highlight=False, soft_wrap=True)


def tell(item: str | Table) -> None:
    """A line or a table on stdout."""
    width = None if sys.stdout.isatty() else 100
    Console(width=width).print(item, markup=False, highlight=False, soft_wrap=isinstance(item, str))


class RecordingOptions:
    """The options that say how recordings are to be read, the same for every command that reads some."""

    def __init__(
        self, columns: Columns = None, time: Time = None, unit: Unit = None, dt: Dt = None, episode: Episode = None
    ) -> None:
        self.columns = [name.strip() for text in columns or () for name in text.split(",")] or None
        self.time, self.unit, self.dt, self.episode = time, unit, dt, episode

    def read(self, paths: Sequence[Path]) -> list[Demonstration]:
        """The recordings, under names that differ; each is described in a line on stderr."""
        shown = []
        for path in paths:
            names: set[str] = set()
            if any(name.isdigit() for name in [*(self.columns or ()), self.time or ""]):
                names = set(recordings.read_table(path))  # a column called "3" is meant before the fourth one
            number = partial(_name_or_number, names=names)
            columns = None if self.columns is None else [number(name) for name in self.columns]
            time = None if self.time is None else number(self.time)
            twin = sum(path.stem == other.stem for other in paths) > 1
            how: dict[str, Any] = {"columns": columns, "time": time, "unit": self.unit, "dt": self.dt}
            if self.episode == "all":
                several = Demonstration.load_all(path, **how)
            else:
                name = f"{path}{f'[{self.episode}]' if self.episode else ''}" if twin else None
                several = [Demonstration.load(path, **how, episode=self.episode, name=name)]
            for one in several:
                say(one.origin, "dim")
            shown += several
        return shown

    def refuse(self, path: Path) -> None:
        """Raise ValueError if one of the options is given: a file with a system is not a recording."""
        for name in ("columns", "time", "unit", "dt", "episode"):
            if getattr(self, name) is not None:
                raise ValueError(f"{name}: expected a recording, got a system: {path}")


def _name_or_number(text: str, names: set[str]) -> str | int:
    return int(text) if text.isdigit() and text not in names else text


def reads_recordings(command: Callable[..., None]) -> Callable[..., None]:
    """Add these options to a command, which takes them as ``options``, a :class:`RecordingOptions`."""
    added = inspect.signature(RecordingOptions, eval_str=True).parameters

    @wraps(command)
    def with_options(*arguments: Any, **given: Any) -> None:
        options = RecordingOptions(**{name: given.pop(name) for name in added if name in given})
        command(*arguments, options=options, **given)

    own = [one for one in inspect.signature(command, eval_str=True).parameters.values() if one.name != "options"]
    with_options.__signature__ = inspect.Signature([*own, *added.values()])  # type: ignore[attr-defined]
    return with_options


def known_methods() -> dict[str, Any]:
    """{label: class, or an entry point that loads one}: ours, and those of installed packages."""
    plugged = {point.name: point for point in importlib.metadata.entry_points(group=PLUGINS)}
    return {"TubeDS": TubeDS, "Chebyshev": ChebyshevDS} | plugged


def _found(name: str, known: dict[str, Any]) -> str | None:
    """The label that a method is known by under this name: its own, its class's, in upper case or lower."""
    for label, made in known.items():
        if _plain(name) in (_plain(label), _plain(getattr(made, "attr", getattr(made, "__name__", "")))):
            return label
    return None


def _plain(name: str) -> str:
    return name.removeprefix("latentds.").removeprefix("baselines.").replace("-", "").lower()


def method_of(text: str) -> Factory:
    """The callable(dim) that ``NAME[,setting=value …]`` stands for.

    Raises:
        ValueError: if there is no such method, or it has no such setting.
        ImportError: if what it names cannot be imported.
    """
    name, *assignments = text.split(",")
    known = known_methods()
    if (label := _found(name, known)) is not None:
        made = known[label]
        made = made.load() if hasattr(made, "load") else made
    elif ":" in name:
        try:
            made = pkgutil.resolve_name(name)
        except (AttributeError, ValueError) as error:
            raise ValueError(f"method: expected module:Class, got {name!r}: {error}") from None
    else:
        near = difflib.get_close_matches(_plain(name), {_plain(label): label for label in known}, 1)
        meant = "".join(f"; did you mean {label}?" for label in known if _plain(label) in near)
        raise ValueError(f"method: expected one of {', '.join(known)}, or module:Class, got {name!r}{meant}")
    if not (inspect.isclass(made) and issubclass(made, StableDS)):
        raise ValueError(f"method: expected a StableDS, got {name!r}")
    wanted = [setting for setting in inspect.signature(made).parameters if setting != "dim"]
    settings = {}
    for part in assignments:
        setting, equals, value = part.partition("=")
        if not equals or setting not in wanted:
            meant = "".join(f"; did you mean {one}?" for one in difflib.get_close_matches(setting, wanted, 1))
            raise ValueError(
                f"method: expected settings of {name} as NAME=VALUE, of {', '.join(wanted)}, got {part!r}{meant}"
            )
        settings[setting] = _literal(value)
    return partial(made, **settings)


def methods_of(texts: Iterable[str]) -> dict[str, Factory]:
    """{what the user wrote: the method}."""
    return {text: method_of(text) for text in texts}


def _literal(text: str) -> Any:
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def is_system(paths: Sequence[Path]) -> bool:
    """Whether a command is given one file, and not of a kind that recordings have; nor a folder, which a bag may be."""
    return len(paths) == 1 and paths[0].suffix.lower() not in recordings.READERS and not paths[0].is_dir()


def loaded(path: Path, method: str = "") -> tuple[StableDS, list[Demonstration]]:
    """The system in a file, and its demonstrations as far as its report keeps them."""
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
    """Fit, and show for how long already, and the method's own bar, if it has one."""
    what = shown[0].name if len(shown) == 1 else f"{len(shown)} demonstrations"
    columns = SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn()
    bar = Progress(*columns, transient=True)
    with interrupts_kept(), bar:
        bar.add_task(f"fitting {type(ds).__name__} to {what}")
        return ds.fit(shown[0] if len(shown) == 1 else shown, progress=sys.stderr.isatty())


def system_of(paths: list[Path], options: RecordingOptions, method: str) -> tuple[StableDS, list[Demonstration]]:
    """The system in a file, or one fitted to recordings; and the demonstrations, as far as they are known."""
    if is_system(paths):
        options.refuse(paths[0])
        return loaded(paths[0], method)
    shown = options.read(paths)
    return fitted(method_of(method)(shown[0].dim), shown), shown


def target(out: Path | None, paths: Sequence[Path], suffix: str, among: Sequence[str] = ()) -> Path:
    """The file to write, which must not be one of those that were read."""
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
