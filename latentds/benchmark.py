"""A fair comparison: every method learns every demonstration, moves from the same starts, gets the same scores."""

from __future__ import annotations

import importlib
import math
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from . import kernels, metrics
from .arguments import number_in, whole_number
from .base import StableDS
from .demonstration import Demonstration
from .store import CellStore, fingerprint

if TYPE_CHECKING:
    import pandas as pd

Factory = Callable[[int], StableDS]

HORIZON = 20.0
"""Demonstration durations after which ``converged`` looks where a motion is."""
CONVERGED = 1e-2
"""``converged``: largest distance from the attractor by then, as a share of the motion's size."""
ON_GOAL = 1e-6
"""``converged``: largest distance of the attractor from the demonstrated goal, as a share of the motion's size."""

SCORES = (
    "dtw", "dtw_fast", "dtw_per_point", "dtw_fast_per_point", "frechet", "endpoint_error", "path_length_ratio",
    "velocity_rmse", "velocity_cosine", "mse", "n_parameters", "n_layers", "fit_seconds", "rollout_seconds",
)  # fmt: skip
COLUMNS = ("method", "demonstration", "seed", "start", "status", "error", "converged", *SCORES)


@dataclass(frozen=True)
class Protocol:
    """From where, how long and how finely a learned system is rolled out.

    Args:
        n_starts: >= 0 starts beside the demonstrated one, uniform in a ball around it.
        radius: >= 0, of that ball, in the units of the positions.
        n_points: >= 2, per rollout, uniform in time over the demonstration's duration.

    Raises:
        ValueError: if one is out of range.
    """

    n_starts: int = 20
    radius: float = 0.1
    n_points: int = 500

    def __post_init__(self) -> None:
        whole_number(self.n_starts, "n_starts", at_least=0)
        number_in(self.radius, "radius", 0, math.inf, ends="[)")
        whole_number(self.n_points, "n_points", at_least=2)

    def starts(self, demonstration: Demonstration) -> Tensor:
        """(1 + n_starts, n): the demonstrated start, then the others; the same offsets for every method and motion."""
        # The first n coordinates of a uniform point on the sphere of R^(n+2) are uniform in the ball of R^n.
        normal = np.random.default_rng(0).standard_normal((self.n_starts, demonstration.dim + 2))
        ball = (normal / np.linalg.norm(normal, axis=1, keepdims=True))[:, : demonstration.dim]
        offsets = np.concatenate([np.zeros((1, demonstration.dim)), self.radius * ball])
        return demonstration.start + torch.from_numpy(offsets)

    def times(self, demonstration: Demonstration) -> Tensor:
        """(n_points,) seconds."""
        return torch.linspace(0, demonstration.duration, self.n_points, dtype=torch.float64)

    def reference(self, demonstration: Demonstration) -> NDArray[np.float64]:
        """The demonstration at :meth:`times`, (n_points, n)."""
        return demonstration.at(self.times(demonstration).numpy())


@dataclass(frozen=True)
class Cell:
    """One method on one demonstration with one seed: one fit, and all its rollouts."""

    method: str
    factory: Factory
    demonstration: Demonstration
    seed: int = 0


@dataclass(frozen=True)
class Outcome:
    """What came of a cell.

    Attributes:
        rows: one mapping from ``COLUMNS`` per start.
        paths: (1 + n_starts, n_points, n) rollouts, NaN where there are none.
    """

    method: str
    demonstration: str
    seed: int
    rows: tuple[dict[str, Any], ...]
    paths: NDArray[np.float64]


def compare(
    methods: Mapping[str, Factory],
    demonstrations: Demonstration | Sequence[Demonstration],
    *,
    n_starts: int = 20,
    radius: float = 0.1,
    seeds: Sequence[int] = (0,),
    n_points: int = 500,
    n_jobs: int | None = None,
    progress: bool = False,
    store: str | os.PathLike[str] | None = None,
) -> pd.DataFrame:
    """Fit every method to every demonstration with every seed, roll each out from shared starts, and score it.

    Args:
        methods: {label: callable(dim) -> StableDS}. A lambda does; it is called once per cell, after torch's generator
            was seeded for it.
        demonstrations: one or more, their names all different.
        n_starts: >= 0 perturbed starts beside the demonstrated one, which is start 0.
        radius: >= 0, in the units of the positions; the perturbed starts lie uniformly in a ball of this radius around
            the demonstrated one. They are the same for every method and seed, their offsets for every demonstration.
        seeds: whole numbers >= 0, all different; each makes a cell of its own.
        n_points: >= 2 points per rollout, uniform in time over the demonstration's duration.
        n_jobs: processes, as joblib counts them. None: what ``joblib.parallel_config`` says around the call (that is
            how cells go to a Dask or Ray cluster, too), without it all local cores. Rows do not depend on it.
        progress: show a bar with method, demonstration and time left.
        store: a file that keeps every finished cell (:class:`latentds.store.CellStore`), so that a run that was
            interrupted goes on where it stopped. A cell is known by its label, the method's settings and code, the
            demonstration, the seed and the protocol: if one changes, it is computed anew. Failed cells are not kept.

    Returns:
        One row per method, demonstration, seed and start:

        * ``status``: "ok", "diverged" (the rollout holds NaN or inf) or "failed" (``error`` then says what was raised);
          their scores are NaN.
        * ``dtw``, ``dtw_fast``: exact and FastDTW (radius 1) distance to the demonstration, raw sums; ``…_per_point``
          divided by ``n_points``. ``frechet``, ``endpoint_error``, ``path_length_ratio``: see :mod:`latentds.metrics`.
        * ``converged``: after ``HORIZON`` durations the motion is within ``CONVERGED`` of the demonstration's size from
          the attractor, and that lies within ``ON_GOAL`` of it from the demonstrated goal.
        * ``velocity_rmse``, ``velocity_cosine``: the learned field against the demonstrated velocities at the
          demonstrated points; ``mse``: the fit's own. These and all below are one number per cell.
        * ``n_parameters``, ``n_layers``, ``fit_seconds``, ``rollout_seconds`` (of all starts together).

    Raises:
        ValueError: if an argument is out of range, before any work.
        ImportError: without pandas and joblib: ``pip install 'latentds[studies]'``.
    """
    pandas = _studies("pandas")
    shown = [demonstrations] if isinstance(demonstrations, Demonstration) else demonstrations
    _check(methods, shown, seeds)
    cells = [Cell(label, factory, d, seed) for d in shown for label, factory in methods.items() for seed in seeds]
    outcomes = run(cells, Protocol(n_starts, radius, n_points), n_jobs=n_jobs, progress=progress, store=store)
    rows = [row for outcome in outcomes for row in outcome.rows]
    place = {key: i for i, key in enumerate(map(_name, cells))}
    rows.sort(key=lambda row: (place[row["method"], row["demonstration"], row["seed"]], row["start"]))
    frame: pd.DataFrame = pandas.DataFrame(rows, columns=list(COLUMNS))
    return frame


def run(
    cells: Iterable[Cell],
    protocol: Protocol | None = None,
    *,
    n_jobs: int | None = None,
    progress: bool = False,
    store: str | os.PathLike[str] | None = None,
) -> Iterator[Outcome]:
    """Outcomes of the cells, as they end; for studies in which a method's settings change with the demonstration.

    Args:
        cells: no two alike in method, demonstration's name and seed.
        protocol: the default one if None.
        n_jobs, progress, store: as for :func:`compare`.

    Raises:
        ValueError: if two cells are alike, before any work.
    """
    cells = list(cells)
    protocol = Protocol() if protocol is None else protocol
    _only_once("cells", [_name(cell) for cell in cells])
    if n_jobs is not None and (isinstance(n_jobs, bool) or not isinstance(n_jobs, int) or n_jobs == 0):
        raise ValueError(f"n_jobs: expected a whole number other than 0, or None, got {n_jobs!r}")
    return _run(cells, protocol, n_jobs, progress, store)


def _run(
    cells: list[Cell], protocol: Protocol, n_jobs: int | None, progress: bool, store: str | os.PathLike[str] | None
) -> Iterator[Outcome]:
    with (
        _bar(len(cells)) if progress else nullcontext(lambda outcome: None) as advance,
        nullcontext() if store is None else CellStore(store) as kept,
    ):
        keys = {} if kept is None else {_name(cell): _key(cell, protocol) for cell in cells}
        todo = []
        for cell in cells:
            key = keys.get(_name(cell))
            found = kept.get(key) if kept is not None and key is not None else None
            if found is None:
                todo.append(cell)
            else:
                outcome = Outcome(*_name(cell), *found)
                advance(outcome)
                yield outcome
        with closing(_spread(todo, protocol, n_jobs)) as outcomes:
            for outcome in outcomes:
                key = keys.get((outcome.method, outcome.demonstration, outcome.seed))
                if kept is not None and key is not None and not outcome.rows[0]["error"]:
                    kept.put(key, outcome.rows, outcome.paths)
                advance(outcome)
                yield outcome


def _spread(cells: list[Cell], protocol: Protocol, n_jobs: int | None) -> Generator[Outcome, None, None]:
    """The outcomes as they end, from joblib's workers, wherever they are."""
    joblib = _studies("joblib")
    backend, configured = joblib.parallel.get_active_backend()
    if n_jobs is None and configured is None:
        n_jobs = -1
    streams = backend.supports_return_generator
    parallel = joblib.Parallel(n_jobs=n_jobs, return_as="generator_unordered" if streams else "list", batch_size=1)
    # Ray answers a call as a whole: one call per round of workers then, so that a rerun finds the rounds that ended.
    step = max(1, len(cells) if streams else joblib.effective_n_jobs(-1 if n_jobs is None else n_jobs))
    for first in range(0, len(cells), step):
        yield from parallel(joblib.delayed(evaluate)(cell, protocol) for cell in cells[first : first + step])


def _name(cell: Cell) -> tuple[str, str, int]:
    return cell.method, cell.demonstration.name, cell.seed


def _key(cell: Cell, protocol: Protocol) -> str | None:
    """What a finished cell is known by; None for a method that cannot even be made."""
    try:
        with isolated_rng(cell.seed):
            ds = _build(cell)
    except Exception:
        return None
    shown = cell.demonstration
    return fingerprint(cell.method, ds, shown.positions, shown.dt, shown.name, cell.seed, protocol)


def evaluate(cell: Cell, protocol: Protocol) -> Outcome:
    """Fit, roll out and score one cell. Whatever the method raises is told in its rows."""
    shown, n_rollouts = cell.demonstration, protocol.n_starts + 1
    starts, times = protocol.starts(shown), protocol.times(shown)
    paths = np.full((n_rollouts, protocol.n_points, shown.dim), np.nan)
    converged = np.zeros(n_rollouts, dtype=bool)
    facts: dict[str, Any] = dict.fromkeys(SCORES, math.nan)
    error = ""
    try:
        with isolated_rng(cell.seed):
            ds = _build(cell)
            kernels.warmup([shown.dim])  # compiling is nobody's fitting time
            began = time.perf_counter()
            ds.fit(shown)
            facts["fit_seconds"] = time.perf_counter() - began
            facts |= _facts(ds, shown)
            began = time.perf_counter()
            with torch.no_grad():
                moved = ds.rollout(starts, times)
                facts["rollout_seconds"] = time.perf_counter() - began
                converged = _converged(ds, shown, starts)
            if moved.shape != paths.shape:
                raise ValueError(f"rollout: expected shape {paths.shape}, got {tuple(moved.shape)}")
            paths[:] = moved.numpy()
    except Exception as raised:
        error = f"{type(raised).__name__}: {raised}"
    rows = [
        {"method": cell.method, "demonstration": shown.name, "seed": cell.seed, "start": start}
        | {"status": _status(error, path), "error": error, "converged": bool(converged[start])}
        | facts
        | _scores(path, protocol.reference(shown))
        for start, path in enumerate(paths)
    ]
    return Outcome(cell.method, shown.name, cell.seed, tuple(rows), paths)


def _build(cell: Cell) -> StableDS:
    ds = cell.factory(cell.demonstration.dim)
    if not isinstance(ds, StableDS):
        raise TypeError(f"methods: expected {cell.method!r} to make a StableDS, got {type(ds).__name__}")
    return ds


def _facts(ds: StableDS, shown: Demonstration) -> dict[str, float]:
    """What is the same from every start."""
    with torch.no_grad():
        velocities = ds(shown.positions)
    report = ds.fit_report
    return {
        "velocity_rmse": metrics.velocity_rmse(velocities, shown.velocities),
        "velocity_cosine": metrics.velocity_cosine(velocities, shown.velocities),
        "mse": report.mse if report else math.nan,
        "n_layers": report.n_layers if report else math.nan,
        "n_parameters": sum(parameter.numel() for parameter in ds.parameters()),
    }


def _scores(path: NDArray[np.float64], reference: NDArray[np.float64]) -> dict[str, float]:
    exact, fast = metrics.dtw(path, reference), metrics.fast_dtw(path, reference)
    return {
        "dtw": exact,
        "dtw_fast": fast,
        "dtw_per_point": exact / len(reference),
        "dtw_fast_per_point": fast / len(reference),
        "frechet": metrics.frechet(path, reference),
        "endpoint_error": metrics.endpoint_error(path, reference),
        "path_length_ratio": metrics.path_length_ratio(path, reference),
    }


def _converged(ds: StableDS, shown: Demonstration, starts: Tensor) -> NDArray[np.bool_]:
    later = torch.tensor([0.0, HORIZON * shown.duration], dtype=torch.float64)
    left = torch.linalg.vector_norm(ds.rollout(starts, later)[:, -1] - ds.attractor, dim=-1)
    missed = torch.linalg.vector_norm(ds.attractor - shown.goal)
    arrived = (left <= CONVERGED * shown.size) & (missed <= ON_GOAL * shown.size)
    return np.asarray(arrived.numpy())


def _status(error: str, path: NDArray[np.float64]) -> str:
    return "failed" if error else "ok" if np.isfinite(path).all() else "diverged"


_TURN = threading.RLock()


@contextmanager
def isolated_rng(seed: int) -> Iterator[None]:
    """Torch's generator seeded and one thread, for this block; both are the process's, so blocks take turns."""
    with _TURN, torch.random.fork_rng():
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        torch.manual_seed(seed)
        try:
            yield
        finally:
            torch.set_num_threads(threads)


@contextmanager
def _bar(total: int) -> Iterator[Callable[[Outcome], None]]:
    bars = _studies("rich.progress")
    columns = (
        bars.TextColumn("{task.description}"), bars.BarColumn(), bars.MofNCompleteColumn(),
        bars.TimeElapsedColumn(), bars.TextColumn("left"), bars.TimeRemainingColumn(),
    )  # fmt: skip
    with bars.Progress(*columns) as bar:
        task = bar.add_task("fitting …", total=total)
        yield lambda done: bar.update(task, advance=1, description=f"{done.method} · {done.demonstration}")


def _check(methods: Any, shown: Any, seeds: Any) -> None:
    if not isinstance(methods, Mapping) or not methods:
        raise ValueError(f"methods: expected a mapping {{label: callable(dim)}} that is not empty, got {methods!r}")
    for label, factory in methods.items():
        if not isinstance(label, str) or not callable(factory):
            raise ValueError(f"methods: expected a string and a callable(dim) in each item, got {label!r}: {factory!r}")
    if not isinstance(shown, Sequence) or not shown or not all(isinstance(d, Demonstration) for d in shown):
        raise ValueError(f"demonstrations: expected a Demonstration or a non-empty sequence of them, got {shown!r}")
    _only_once("demonstrations", [d.name for d in shown])
    if isinstance(seeds, str) or not isinstance(seeds, Sequence) or not seeds:
        raise ValueError(f"seeds: expected a non-empty sequence of whole numbers, got {seeds!r}")
    _only_once("seeds", [whole_number(seed, "seeds", at_least=0) for seed in seeds])


def _only_once(name: str, items: Sequence[Any]) -> None:
    twice = [item for item, times in Counter(items).items() if times > 1]
    if twice:
        raise ValueError(f"{name}: expected each only once, got {twice[0]!r} again")


def _studies(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"comparing needs {module}: pip install 'latentds[studies]'") from error
