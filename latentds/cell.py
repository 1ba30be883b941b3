"""One cell of a comparison: a method learns a motion, moves from given starts, and is scored by its judges."""

from __future__ import annotations

import math
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from . import kernels, metrics
from .arguments import number_in, whole_number
from .base import StableDS
from .demonstration import Demonstration
from .fidelity import FitWarning

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
COLUMNS = ("method", "demonstration", "seed", "start", "status", "error", "follows", "converged", *SCORES)


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
    """One method, shown one motion, with one seed: one fit, and all its rollouts.

    Args:
        method: its label.
        factory: callable(dim) -> StableDS.
        shown: the demonstration to fit, or several to fit together.
        seed: whole number >= 0, for torch's generator.
        judges: the demonstration that scores the rollouts, or several; by default those that are shown. The system
            starts where each judge starts and at n_starts points around that, moves for that judge's duration, and is
            compared with that judge. Start 0 is the first judge's own, start 1 + n_starts the second's, and so on:
            with n_starts = 0, start i is judge i's.
        measure: what else the rows tell: callable(fitted system, cell) -> mapping from names, none of them in
            ``COLUMNS``, to numbers or strings.

    Raises:
        ValueError: if ``shown`` or ``judges`` holds no demonstrations, or some of another dimension.
    """

    method: str
    factory: Factory
    shown: tuple[Demonstration, ...]
    seed: int
    judges: tuple[Demonstration, ...]
    measure: Callable[[Any, Cell], Mapping[str, Any]] | None

    def __init__(
        self,
        method: str,
        factory: Factory,
        shown: Demonstration | Sequence[Demonstration],
        seed: int = 0,
        *,
        judges: Demonstration | Sequence[Demonstration] | None = None,
        measure: Callable[[Any, Cell], Mapping[str, Any]] | None = None,
    ) -> None:
        some = several(shown, "shown")
        others = some if judges is None else several(judges, "judges", some[0].dim)
        vars(self).update(method=method, factory=factory, shown=some, seed=seed, judges=others, measure=measure)

    @property
    def demonstration(self) -> str:
        """The name of what is shown; of several, their names joined by " + ", each once."""
        return joint_name(self.shown)

    @property
    def name(self) -> tuple[str, str, int]:
        """Method, demonstration and seed: what tells it from the other cells of a run."""
        return self.method, self.demonstration, self.seed


def joint_name(shown: Sequence[Demonstration]) -> str:
    """What rows call demonstrations that are fitted together."""
    return " + ".join(dict.fromkeys(d.name for d in shown))


@dataclass(frozen=True)
class Outcome:
    """What came of a cell.

    Attributes:
        rows: one mapping per start: from ``COLUMNS``, from "judge" to the judge's name, and what the cell measures.
        paths: (J (1 + n_starts), n_points, n) rollouts from the starts of all J judges, NaN where there are none.
    """

    method: str
    demonstration: str
    seed: int
    rows: tuple[dict[str, Any], ...]
    paths: NDArray[np.float64]


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Ctrl-C in this block ends it with KeyboardInterrupt, whatever became of it there.

    What is raised while compiled code calls back into Python is dropped or comes out as another error: an interrupt
    while numba loads or compiles a kernel as "RuntimeError: no compiled object yet", or not at all.
    """
    usual = signal.default_int_handler
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is not usual:
        yield  # Ctrl-C is heard elsewhere
        return
    pressed = False

    def handler(number: int, frame: FrameType | None) -> None:
        nonlocal pressed
        pressed = True
        usual(number, frame)

    signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
        if pressed:
            raise KeyboardInterrupt


@interrupts_kept()
def evaluate(cell: Cell, protocol: Protocol) -> Outcome:
    """Fit, roll out and score one cell. Whatever the method raises is told in its rows; Ctrl-C is no failure of it."""
    shown, judges, share = cell.shown, cell.judges, protocol.n_starts + 1
    paths = np.full((len(judges), share, protocol.n_points, shown[0].dim), np.nan)
    converged = np.zeros((len(judges), share), dtype=bool)
    follows = False
    facts: dict[str, Any] = dict.fromkeys(SCORES, math.nan)
    of_judge: list[dict[str, float]] = [{} for _ in judges]
    error = ""
    try:
        with isolated_rng(cell.seed):
            ds = build(cell)
            kernels.warmup([ds.dim])  # compiling is nobody's fitting time
            began = time.perf_counter()
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FitWarning)  # the rows tell it
                ds.fit(shown[0] if len(shown) == 1 else list(shown))
            facts["fit_seconds"] = time.perf_counter() - began
            follows = bool(ds.fit_report and ds.fit_report.fidelity and ds.fit_report.fidelity.follows)
            of_judge = [_velocity_scores(ds, judge) for judge in judges]
            more = dict(cell.measure(ds, cell)) if cell.measure else {}
            if taken := more.keys() & {*COLUMNS, "judge"}:
                raise ValueError(f"measure: expected names that rows do not have, got {sorted(taken)}")
            facts |= _facts(ds) | more
            starts = [protocol.starts(judge) for judge in judges]
            began = time.perf_counter()
            with torch.no_grad():
                moved = [ds.rollout(y0, protocol.times(judge)) for y0, judge in zip(starts, judges, strict=True)]
                facts["rollout_seconds"] = time.perf_counter() - began
                converged[:] = [_converged(ds, judge, y0) for y0, judge in zip(starts, judges, strict=True)]
            for path in moved:
                if path.shape != paths.shape[1:]:
                    raise ValueError(f"rollout: expected shape {paths.shape[1:]}, got {tuple(path.shape)}")
            paths[:] = [path.numpy() for path in moved]
    except Exception as raised:
        error = f"{type(raised).__name__}: {raised}"
    rows = [
        {"method": cell.method, "demonstration": cell.demonstration, "seed": cell.seed, "start": share * i + k}
        | {
            "status": _status(error, path),
            "error": error,
            "follows": follows and not error,
            "converged": bool(converged[i, k]),
        }
        | {"judge": judge.name}
        | facts
        | of_judge[i]
        | _scores(path, protocol.reference(judge))
        for i, judge in enumerate(judges)
        for k, path in enumerate(paths[i])
    ]
    return Outcome(*cell.name, tuple(rows), paths.reshape(-1, *paths.shape[2:]))


def build(cell: Cell) -> StableDS:
    ds, dim = cell.factory(cell.shown[0].dim), cell.shown[0].dim
    if not isinstance(ds, StableDS):
        raise TypeError(f"expected a StableDS, got {type(ds).__name__}")
    if ds.dim != dim:
        raise ValueError(f"expected a system of {dim} dimensions, got one of {ds.dim}")
    return ds


def _velocity_scores(ds: StableDS, judge: Demonstration) -> dict[str, float]:
    with torch.no_grad():
        velocities = ds(judge.positions)
    return {
        "velocity_rmse": metrics.velocity_rmse(velocities, judge.velocities),
        "velocity_cosine": metrics.velocity_cosine(velocities, judge.velocities),
    }


def _facts(ds: StableDS) -> dict[str, float]:
    """What is the same from every start."""
    report = ds.fit_report
    return {
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


def _converged(ds: StableDS, judge: Demonstration, starts: Tensor) -> NDArray[np.bool_]:
    later = torch.tensor([0.0, HORIZON * judge.duration], dtype=torch.float64)
    left = torch.linalg.vector_norm(ds.rollout(starts, later)[:, -1] - ds.attractor, dim=-1)
    missed = torch.linalg.vector_norm(ds.attractor - judge.goal)
    arrived = (left <= CONVERGED * judge.size) & (missed <= ON_GOAL * judge.size)
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


def several(value: Any, name: str, dim: int | None = None) -> tuple[Demonstration, ...]:
    """An argument that is one demonstration or more, of one dimension: ``dim`` if given."""
    found = [value] if isinstance(value, Demonstration) else value
    if not isinstance(found, Sequence) or not found or not all(isinstance(d, Demonstration) for d in found):
        raise ValueError(f"{name}: expected a Demonstration or a non-empty sequence of them, got {value!r}")
    wanted = found[0].dim if dim is None else dim
    for item in found:
        if item.dim != wanted:
            raise ValueError(f"{name}: expected demonstrations of {wanted} dimensions, got {item!r}")
    return tuple(found)
