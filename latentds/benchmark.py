"""A fair comparison: every method learns every demonstration, moves from the same starts, gets the same scores."""

from __future__ import annotations

import importlib
import os
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

from torch import nn

from .arguments import Array, whole_number
from .cache import CellStore, UnreadableError, fingerprint
from .cell import COLUMNS, Cell, Factory, Outcome, RolloutProtocol, build, evaluate, reproducible_torch, several
from .demonstration import Demonstration

if TYPE_CHECKING:
    import pandas as pd

Paths = MutableMapping[tuple[str, str, int], Array]
"""{(method, demonstration, seed): rollouts (starts, n_points, n)}."""

__all__ = ["COLUMNS", "Cell", "Factory", "Outcome", "Paths", "RolloutProtocol", "compare", "evaluate", "run", "table"]


def compare(
    methods: Mapping[str, Factory],
    demonstrations: Demonstration | Sequence[Demonstration | Sequence[Demonstration]],
    *,
    judged_by: Demonstration | Sequence[Demonstration | Sequence[Demonstration]] | None = None,
    n_starts: int = 20,
    radius: float | None = None,
    seeds: Sequence[int] = (0,),
    n_points: int = 500,
    fast_dtw: bool = True,
    n_jobs: int | None = None,
    progress: bool = False,
    store: str | os.PathLike[str] | None = None,
    paths: Paths | None = None,
    measure: Callable[[Any, Cell], Mapping[str, Any]] | None = None,
) -> pd.DataFrame:
    """Fit every method to every demonstration with every seed, roll each out from shared starts, and score it.

    Args:
        methods: {label: callable(dim) -> StableDS}. A lambda does; it is called once per cell, after torch's generator
            was seeded for it, and once per dimension before any work, to see whether it does.
        demonstrations: one or more, their names all different. An item that is itself a sequence is one motion that is
            shown several times: its demonstrations are fitted together.
        judged_by: for each item of ``demonstrations``, the demonstration or several that score it instead of itself:
            ``compare(methods, [six], judged_by=[seventh])``. Rollouts then start where these start, last as long as
            they do, and are compared with them; a further column "judge" names the one.
        n_starts: >= 0 perturbed starts beside the demonstrated one, which is start 0. With several judges each has its
            own 1 + n_starts, one after the other.
        radius: >= 0, in the units of the positions; the perturbed starts lie uniformly in a ball of this radius around
            the demonstrated one, by default a twentieth of the demonstration's size. They are the same for every method
            and seed, and their offsets, for a given radius, for every demonstration.
        seeds: whole numbers >= 0, all different; each makes a cell of its own.
        n_points: >= 2 points per rollout, uniform in time over the demonstration's duration.
        fast_dtw: whether to tell FastDTW, too, which costs forty times as much as exact DTW; without it NaN.
        n_jobs: processes, as joblib counts them. None: what ``joblib.parallel_config`` says around the call (that is
            how cells go to a Dask or Ray cluster, too), without it all local cores. Rows do not depend on it.
        progress: show a bar with method, demonstration and time left.
        store: a file that keeps every finished cell (:class:`latentds.cache.CellStore`), so that a run that was
            interrupted goes on where it stopped. A cell is known by its label, the method's settings and code, the
            demonstrations and judges, the seed and the protocol: if one changes, it is computed anew. Not seen is a
            change of a data file that the method reads, or of a module that it imports under a computed name: delete
            the file of cells then (:func:`latentds.cache.fingerprint` says more). Failed cells are not kept, nor are
            those of a method whose code or settings cannot be read; a warning names it.
        paths: a mapping to put the rollouts into, {(method, demonstration, seed): (starts, n_points, n)}, for pictures
            and for :func:`latentds.report.write`.
        measure: what else the rows hold, in further columns: callable(fitted system, cell) -> mapping from names to
            numbers or strings; see :class:`Cell`.

    Returns:
        One row per method, demonstration, seed and start:

        * ``status``: "ok", "diverged" (the rollout holds NaN or inf) or "failed" (``error`` then says what was raised);
          their scores are NaN.
        * ``follows``: whether the fit measured itself and found nothing off (:mod:`latentds.fidelity`); one per cell.
        * ``dtw``, ``dtw_fast``: exact and FastDTW (radius 1) distance to the demonstration, raw sums; ``…_per_point``
          divided by ``n_points``. ``frechet``, ``endpoint_error``, ``path_length_ratio``: see :mod:`latentds.metrics`.
        * ``converged``: after 20 durations the motion is no further from the attractor than 1 % of the demonstration's
          size, and the attractor no further from the demonstrated goal than 1e-6 of it; of several demonstrations, from
          the mean of their goals than the farthest of these.
        * ``velocity_rmse``, ``velocity_cosine``: the learned field against the demonstrated velocities at the
          demonstrated points, one number per judge.
        * ``mse``: the fit's own. This and all below are one number per cell.
        * ``n_parameters``, ``n_layers``, ``fit_seconds`` (of learning, without the library's own measuring of what was
          learned), ``rollout_seconds`` (of all starts together).

    Raises:
        ValueError: if an argument is out of range or a method cannot be made, before any work.
        ImportError: without pandas and joblib: ``pip install 'latentds[studies]'``.

    Warns:
        RuntimeWarning: once, if rows failed.
    """
    motions = _motions(demonstrations, judged_by)
    _check(methods, seeds)
    cells = [
        Cell(label, factory, shown, seed, judges=judges, measure=measure)
        for shown, judges in motions
        for label, factory in methods.items()
        for seed in seeds
    ]
    _only_once("demonstrations", [cell.demonstration for cell in cells[:: len(methods) * len(seeds)]])
    outcomes = run(
        cells, RolloutProtocol(n_starts, radius, n_points, fast_dtw), n_jobs=n_jobs, progress=progress, store=store
    )
    _try_out(cells)
    rows = table(cells, outcomes, paths)
    _warn_of_failures(rows)
    plain = all(len(shown) == 1 and judges == shown for shown, judges in motions)
    return rows.drop(columns="judge") if plain else rows


def table(cells: Sequence[Cell], outcomes: Iterable[Outcome], paths: Paths | None = None) -> pd.DataFrame:
    """The rows of outcomes as :func:`compare` gives them, in the order of the cells, with the column "judge".

    Args:
        cells: those that were run.
        outcomes: of :func:`run` or :func:`latentds.cell.judge`; of some cells only, if a run was interrupted.
        paths: a mapping to put the rollouts into, as for :func:`compare`.
    """
    pandas = _studies("pandas")
    place = {cell.name: i for i, cell in enumerate(cells)}
    rows: list[dict[str, Any]] = []
    for outcome in sorted(outcomes, key=lambda outcome: place[outcome.name]):
        rows += outcome.rows
        if paths is not None:
            paths[outcome.name] = outcome.paths
    names = dict.fromkeys((*COLUMNS[:2], "judge", *COLUMNS[2:])) | dict.fromkeys(name for row in rows for name in row)
    frame: pd.DataFrame = pandas.DataFrame(rows, columns=list(names))
    return frame


def run(
    cells: Iterable[Cell],
    protocol: RolloutProtocol | None = None,
    *,
    n_jobs: int | None = None,
    progress: bool = False,
    store: str | os.PathLike[str] | None = None,
) -> Iterator[Outcome]:
    """Outcomes of the cells, as they end: for studies in which a method's settings change with the demonstration.

    Args:
        cells: no two alike in method, demonstration's name and seed.
        protocol: the default one if None.
        n_jobs, progress, store: as for :func:`compare`.

    Raises:
        ValueError: if two cells are alike, before any work.
    """
    cells = list(cells)
    protocol = RolloutProtocol() if protocol is None else protocol
    _only_once("cells", [cell.name for cell in cells])
    if store is not None:
        _check_storable(cells)
    if n_jobs is not None and (isinstance(n_jobs, bool) or not isinstance(n_jobs, int) or n_jobs == 0):
        raise ValueError(f"n_jobs: expected a whole number other than 0, or None, got {n_jobs!r}")
    return _run(cells, protocol, n_jobs, progress, store)


def _run(
    cells: list[Cell],
    protocol: RolloutProtocol,
    n_jobs: int | None,
    progress: bool,
    store: str | os.PathLike[str] | None,
) -> Iterator[Outcome]:
    with (
        _bar(cells) if progress else nullcontext(lambda outcome: None) as advance,
        nullcontext() if store is None else CellStore(store) as finished,
    ):
        keys = {} if finished is None else _keys(cells, protocol)
        todo = []
        for cell in cells:
            key = keys.get(cell.name)
            earlier = finished.get(key) if finished is not None and key is not None else None
            if earlier is None:
                todo.append(cell)
            else:
                outcome = Outcome(*cell.name, *earlier)
                advance(outcome)
                yield outcome
        with closing(_spread(todo, protocol, n_jobs)) as outcomes:
            for outcome in outcomes:
                key = keys.get(outcome.name)
                if finished is not None and key is not None and not outcome.rows[0]["error"]:
                    finished.put(key, outcome.rows, outcome.paths)
                advance(outcome)
                yield outcome


def _spread(cells: list[Cell], protocol: RolloutProtocol, n_jobs: int | None) -> Generator[Outcome, None, None]:
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


def _keys(cells: Sequence[Cell], protocol: RolloutProtocol) -> dict[tuple[str, str, int], str | None]:
    """What finished cells are known by; warns once of each method that no key can stand for."""
    keys, unreadable = {}, {}
    for cell in cells:
        try:
            keys[cell.name] = _key(cell, protocol)
        except UnreadableError as error:
            unreadable[cell.method] = str(error)
    for method, reason in unreadable.items():
        message = f"store: {method!r} is not kept but computed by every run: {reason}"
        warnings.warn(message, RuntimeWarning, stacklevel=2)
    return keys


def _key(cell: Cell, protocol: RolloutProtocol) -> str | None:
    """What a finished cell is known by; None for a method that cannot even be made."""
    try:
        with reproducible_torch(cell.seed):
            ds = build(cell)
    except Exception:
        return None
    shown, judges = ([(d.positions, d.dt, d.name) for d in group] for group in (cell.shown, cell.judges))
    return fingerprint(cell.method, ds, shown, judges, cell.seed, protocol, cell.measure)


@contextmanager
def _bar(cells: Sequence[Cell]) -> Iterator[Callable[[Outcome], None]]:
    """A function to call with each outcome; the bar names what is still awaited."""
    bars = _studies("rich.progress")
    columns = (
        bars.TextColumn("{task.description}"), bars.BarColumn(), bars.MofNCompleteColumn(),
        bars.TimeElapsedColumn(), bars.TextColumn("left"), bars.TimeRemainingColumn(),
    )  # fmt: skip
    with bars.Progress(*columns) as bar:
        awaited = {cell.name: f"{cell.method} · {cell.demonstration}" for cell in cells}
        task = bar.add_task("", total=len(cells))

        def advance(done: Outcome | None) -> None:
            told = ""
            if done is not None:
                told = f"fitted {awaited.pop(done.name)}"
                bar.advance(task)
            if awaited:
                more = f" and {len(awaited) - 2} more" if len(awaited) > 2 else ""
                told = f"fitting {', '.join([*awaited.values()][:2])}{more}"
            bar.update(task, description=told)

        advance(None)
        yield advance


def _motions(demonstrations: Any, judged_by: Any) -> list[tuple[tuple[Demonstration, ...], ...]]:
    """What is shown and what judges it, motion by motion."""
    alone = isinstance(demonstrations, Demonstration)
    items = [demonstrations] if alone else demonstrations
    if not isinstance(items, Sequence) or not items:
        raise ValueError(f"demonstrations: expected a Demonstration or a non-empty sequence of them, got {items!r}")
    shown = [several(item, "demonstrations") for item in items]
    if judged_by is None:
        return [(motion, motion) for motion in shown]
    judges = [judged_by] if alone else judged_by
    if not isinstance(judges, Sequence) or len(judges) != len(shown):
        raise ValueError(f"judged_by: expected one item for each of the {len(shown)} motions, got {judged_by!r}")
    return [(motion, several(item, "judged_by", motion[0].dim)) for motion, item in zip(shown, judges, strict=True)]


def _check(methods: Any, seeds: Any) -> None:
    if not isinstance(methods, Mapping) or not methods:
        raise ValueError(f"methods: expected a mapping {{label: callable(dim)}} that is not empty, got {methods!r}")
    for label, factory in methods.items():
        if isinstance(factory, nn.Module):  # which is callable, too
            kind = type(factory).__name__
            raise ValueError(
                f"methods: expected a callable(dim), got a {kind} for {label!r}: write lambda dim: {kind}(dim)"
            )
        if not isinstance(label, str) or not callable(factory):
            raise ValueError(f"methods: expected a string and a callable(dim) in each item, got {label!r}: {factory!r}")
    if isinstance(seeds, str) or not isinstance(seeds, Sequence) or not seeds:
        raise ValueError(f"seeds: expected a non-empty sequence of whole numbers, got {seeds!r}")
    _only_once("seeds", [whole_number(seed, "seeds", at_least=0) for seed in seeds])


def _try_out(cells: Sequence[Cell]) -> None:
    """That every method can be made, once for each dimension: called in vain, it costs no fit."""
    for cell in {(cell.method, cell.shown[0].dim): cell for cell in cells}.values():
        try:
            with reproducible_torch(cell.seed):
                build(cell)
        except Exception as error:
            got = f"{type(error).__name__}: {error}"
            raise ValueError(f"methods: expected {cell.method!r} to make a StableDS, got {got}") from error


def _check_storable(cells: Sequence[Cell]) -> None:
    """That a store can hold their names and seeds."""
    for cell in cells:
        if not cell.seed < 2**63:
            raise ValueError(f"seeds: expected whole numbers below 2**63 for a store, got {cell.seed}")
        for text in (cell.method, cell.demonstration, *(judge.name for judge in cell.judges)):
            try:
                text.encode()
            except UnicodeEncodeError:
                raise ValueError(f"store: expected names that UTF-8 can write, got {text!r}; pass name=") from None


def _warn_of_failures(rows: pd.DataFrame) -> None:
    failed = Counter((method, error) for method, error in zip(rows["method"], rows["error"], strict=True) if error)
    if failed:
        reasons = "; ".join(f"{count} of {method!r}, {error}" for (method, error), count in failed.items())
        message = f"compare: {failed.total()} of {len(rows)} rows failed, their scores are NaN: {reasons}"
        warnings.warn(message, RuntimeWarning, stacklevel=3)


def _only_once(name: str, items: Sequence[Any]) -> None:
    twice = [item for item, times in Counter(items).items() if times > 1]
    if twice:
        raise ValueError(f"{name}: expected each only once, got {twice[0]!r} again")


def _studies(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"comparing needs {module}: pip install 'latentds[studies]'") from error
