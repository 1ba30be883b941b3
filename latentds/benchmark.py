"""A fair comparison: every method learns every demonstration, moves from the same starts, gets the same scores."""

from __future__ import annotations

import importlib
import os
import warnings
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, MutableMapping, Sequence
from contextlib import closing, contextmanager, nullcontext
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import nn

from .arguments import whole_number
from .cell import COLUMNS, Cell, Factory, Outcome, Protocol, build, evaluate, isolated_rng, several
from .demonstration import Demonstration
from .store import CellStore, UnreadableError, fingerprint

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["COLUMNS", "Cell", "Factory", "Outcome", "Protocol", "compare", "evaluate", "run"]


def compare(
    methods: Mapping[str, Factory],
    demonstrations: Demonstration | Sequence[Demonstration | Sequence[Demonstration]],
    *,
    judged_by: Demonstration | Sequence[Demonstration | Sequence[Demonstration]] | None = None,
    n_starts: int = 20,
    radius: float = 0.1,
    seeds: Sequence[int] = (0,),
    n_points: int = 500,
    n_jobs: int | None = None,
    progress: bool = False,
    store: str | os.PathLike[str] | None = None,
    paths: MutableMapping[tuple[str, str, int], NDArray[np.float64]] | None = None,
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
            the demonstrated one. They are the same for every method and seed, their offsets for every demonstration.
        seeds: whole numbers >= 0, all different; each makes a cell of its own.
        n_points: >= 2 points per rollout, uniform in time over the demonstration's duration.
        n_jobs: processes, as joblib counts them. None: what ``joblib.parallel_config`` says around the call (that is
            how cells go to a Dask or Ray cluster, too), without it all local cores. Rows do not depend on it.
        progress: show a bar with method, demonstration and time left.
        store: a file that keeps every finished cell (:class:`latentds.store.CellStore`), so that a run that was
            interrupted goes on where it stopped. A cell is known by its label, the method's settings and code, the
            demonstrations and judges, the seed and the protocol: if one changes, it is computed anew. Failed cells are
            not kept, nor are those of a method whose code or settings cannot be read; a warning names it.
        paths: a mapping to put the rollouts into, {(method, demonstration, seed): (starts, n_points, n)}, for pictures
            and for :func:`latentds.report.write`.

    Returns:
        One row per method, demonstration, seed and start:

        * ``status``: "ok", "diverged" (the rollout holds NaN or inf) or "failed" (``error`` then says what was raised);
          their scores are NaN.
        * ``follows``: whether the fit measured itself and found nothing off (:mod:`latentds.fidelity`); one per cell.
        * ``dtw``, ``dtw_fast``: exact and FastDTW (radius 1) distance to the demonstration, raw sums; ``…_per_point``
          divided by ``n_points``. ``frechet``, ``endpoint_error``, ``path_length_ratio``: see :mod:`latentds.metrics`.
        * ``converged``: after ``HORIZON`` durations the motion is within ``CONVERGED`` of the demonstration's size from
          the attractor, and that lies within ``ON_GOAL`` of it from the demonstrated goal.
        * ``velocity_rmse``, ``velocity_cosine``: the learned field against the demonstrated velocities at the
          demonstrated points, one number per judge.
        * ``mse``: the fit's own. This and all below are one number per cell.
        * ``n_parameters``, ``n_layers``, ``fit_seconds``, ``rollout_seconds`` (of all starts together).

    Raises:
        ValueError: if an argument is out of range or a method cannot be made, before any work.
        ImportError: without pandas and joblib: ``pip install 'latentds[studies]'``.

    Warns:
        RuntimeWarning: once, if rows failed.
    """
    pandas = _studies("pandas")
    motions = _motions(demonstrations, judged_by)
    _check(methods, seeds)
    cells = [
        Cell(label, factory, shown, seed, judges=judges)
        for shown, judges in motions
        for label, factory in methods.items()
        for seed in seeds
    ]
    _only_once("demonstrations", [cell.demonstration for cell in cells[:: len(methods) * len(seeds)]])
    outcomes = run(cells, Protocol(n_starts, radius, n_points), n_jobs=n_jobs, progress=progress, store=store)
    _try_out(cells)
    rows: list[dict[str, Any]] = []
    for outcome in outcomes:
        rows += outcome.rows
        if paths is not None:
            paths[outcome.method, outcome.demonstration, outcome.seed] = outcome.paths
    place = {key: i for i, key in enumerate(cell.name for cell in cells)}
    rows.sort(key=lambda row: (place[row["method"], row["demonstration"], row["seed"]], row["start"]))
    _warn_of_failures(rows)
    plain = all(len(shown) == 1 and judges == shown for shown, judges in motions)
    columns = COLUMNS if plain else (*COLUMNS[:2], "judge", *COLUMNS[2:])
    frame: pd.DataFrame = pandas.DataFrame(rows, columns=list(columns))
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
    _only_once("cells", [cell.name for cell in cells])
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
        keys = {} if kept is None else _keys(cells, protocol)
        todo = []
        for cell in cells:
            key = keys.get(cell.name)
            found = kept.get(key) if kept is not None and key is not None else None
            if found is None:
                todo.append(cell)
            else:
                outcome = Outcome(*cell.name, *found)
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


def _keys(cells: Sequence[Cell], protocol: Protocol) -> dict[tuple[str, str, int], str | None]:
    """What finished cells are known by; warns once of each method that no key can stand for."""
    keys, hidden = {}, {}
    for cell in cells:
        try:
            keys[cell.name] = _key(cell, protocol)
        except UnreadableError as error:
            hidden[cell.method] = str(error)
    for method, reason in hidden.items():
        told = f"store: {method!r} is not kept but computed by every run: {reason}"
        warnings.warn(told, RuntimeWarning, stacklevel=2)
    return keys


def _key(cell: Cell, protocol: Protocol) -> str | None:
    """What a finished cell is known by; None for a method that cannot even be made."""
    try:
        with isolated_rng(cell.seed):
            ds = build(cell)
    except Exception:
        return None
    shown, judges = ([(d.positions, d.dt, d.name) for d in some] for some in (cell.shown, cell.judges))
    return fingerprint(cell.method, ds, shown, judges, cell.seed, protocol, cell.measure)


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


def _motions(demonstrations: Any, judged_by: Any) -> list[tuple[tuple[Demonstration, ...], ...]]:
    """What is shown and what judges it, motion by motion."""
    alone = isinstance(demonstrations, Demonstration)
    items = [demonstrations] if alone else demonstrations
    if not isinstance(items, Sequence) or not items:
        raise ValueError(f"demonstrations: expected a Demonstration or a non-empty sequence of them, got {items!r}")
    shown = [several(item, "demonstrations") for item in items]
    if judged_by is None:
        return [(some, some) for some in shown]
    judges = [judged_by] if alone else judged_by
    if not isinstance(judges, Sequence) or len(judges) != len(shown):
        raise ValueError(f"judged_by: expected one item for each of the {len(shown)} motions, got {judged_by!r}")
    return [(some, several(item, "judged_by", some[0].dim)) for some, item in zip(shown, judges, strict=True)]


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
            with isolated_rng(cell.seed):
                build(cell)
        except Exception as error:
            told = f"{type(error).__name__}: {error}"
            raise ValueError(f"methods: expected {cell.method!r} to make a StableDS, got {told}") from error


def _warn_of_failures(rows: Sequence[Mapping[str, Any]]) -> None:
    failed = Counter((row["method"], row["error"]) for row in rows if row["error"])
    if failed:
        reasons = "; ".join(f"{count} of {method!r}, {error}" for (method, error), count in failed.items())
        told = f"compare: {failed.total()} of {len(rows)} rows failed, their scores are NaN: {reasons}"
        warnings.warn(told, RuntimeWarning, stacklevel=3)


def _only_once(name: str, items: Sequence[Any]) -> None:
    twice = [item for item, times in Counter(items).items() if times > 1]
    if twice:
        raise ValueError(f"{name}: expected each only once, got {twice[0]!r} again")


def _studies(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"comparing needs {module}: pip install 'latentds[studies]'") from error
