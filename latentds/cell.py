"""One cell of a comparison: a method learns a motion, then is rolled out and scored."""

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
from .arguments import Array, number_in, whole_number
from .base import StableDS
from .demonstration import Demonstration
from .fidelity import FitWarning
from .probes import unit_ball

Factory = Callable[[int], StableDS]
Measure = Callable[[Any, "Cell"], Mapping[str, Any]]
"""callable(fitted system, cell) -> what else rows hold."""

CONVERGED_AFTER = 20.0
"""``converged``: the motion is looked at after this many durations of the demonstration."""
CONVERGED_WITHIN = 1e-2
"""``converged``: largest distance from the attractor then, as a share of the motion's size."""
ON_GOAL = 1e-6
"""``converged``: largest distance of the attractor from where motions were shown to end, in the motion's size; of
several demonstrations from the mean of their goals, and no further than the farthest of these."""

STARTS_WITHIN = 0.05
"""Radius of the ball of starts, in sizes of the demonstration, where none is given: the 0.1 of the paper, whose spirals
are 2 wide."""
SCORES = (
    "dtw", "dtw_fast", "dtw_per_point", "dtw_fast_per_point", "frechet", "endpoint_error", "path_length_ratio",
    "velocity_rmse", "velocity_cosine", "mse", "n_parameters", "n_layers", "fit_seconds", "rollout_seconds",
)  # fmt: skip
COLUMNS = ("method", "demonstration", "seed", "start", "status", "error", "follows", "converged", *SCORES)


@dataclass(frozen=True)
class RolloutProtocol:
    """From where, how long and how finely a learned system is rolled out.

    Args:
        n_starts: >= 0 starts beside the demonstrated one, uniform in a ball around it.
        radius: >= 0, of that ball, in the units of the positions; None for a twentieth of the demonstration's size.
        n_points: >= 2, per rollout, uniform in time over the demonstration's duration.
        fast_dtw: whether rows tell FastDTW, the paper's score: it costs forty times as much as the exact one.

    Raises:
        ValueError: if one is out of range.
    """

    n_starts: int = 20
    radius: float | None = None
    n_points: int = 500
    fast_dtw: bool = True

    def __post_init__(self) -> None:
        whole_number(self.n_starts, "n_starts", at_least=0)
        if self.radius is not None:
            number_in(self.radius, "radius", 0, math.inf, ends="[)")
        whole_number(self.n_points, "n_points", at_least=2)

    def starts(self, demonstration: Demonstration) -> Tensor:
        """(1 + n_starts, n): the demonstrated start, then the others; the same offsets for every method."""
        ball = unit_ball(self.n_starts, demonstration.dim, np.random.default_rng(0))
        radius = STARTS_WITHIN * demonstration.size if self.radius is None else self.radius
        offsets = np.concatenate([np.zeros((1, demonstration.dim)), radius * ball])
        return demonstration.start + torch.from_numpy(offsets)

    def times(self, demonstration: Demonstration) -> Tensor:
        """(n_points,) seconds."""
        return torch.linspace(0, demonstration.duration, self.n_points, dtype=torch.float64)

    def reference(self, demonstration: Demonstration) -> Array:
        """The demonstration at :meth:`times`, (n_points, n)."""
        return demonstration.at(self.times(demonstration).numpy())


@dataclass(frozen=True)
class Cell:
    """One fit and all its rollouts: a method, a motion that it is shown, and a seed.

    Args:
        method: its label.
        factory: callable(dim) -> StableDS.
        shown: the demonstration to fit, or several to fit together.
        seed: whole number >= 0, for torch's generator.
        judges: the demonstration that scores the rollouts, or several; by default those that are shown. The system
            starts where each judge starts and at n_starts points around that, moves for that judge's duration, and is
            compared with that judge. Start 0 is the first judge's own, start 1 + n_starts the second's, and so on:
            with n_starts = 0, start i is judge i's.
        measure: what else the rows hold: callable(fitted system, cell) -> mapping from names, none of them in
            ``COLUMNS``, to numbers or strings.

    Raises:
        ValueError: if ``shown`` or ``judges`` holds no demonstrations, or some of another dimension.
    """

    method: str
    factory: Factory
    shown: tuple[Demonstration, ...]
    seed: int
    judges: tuple[Demonstration, ...]
    measure: Measure | None

    def __init__(
        self,
        method: str,
        factory: Factory,
        shown: Demonstration | Sequence[Demonstration],
        seed: int = 0,
        *,
        judges: Demonstration | Sequence[Demonstration] | None = None,
        measure: Measure | None = None,
    ) -> None:
        fitted = several(shown, "shown")
        scoring = fitted if judges is None else several(judges, "judges", fitted[0].dim)
        vars(self).update(method=method, factory=factory, shown=fitted, seed=seed, judges=scoring, measure=measure)

    @property
    def demonstration(self) -> str:
        """The name of what is shown; of several, their names joined by " + ", each once."""
        return joint_name(self.shown)

    @property
    def name(self) -> tuple[str, str, int]:
        """Method, demonstration and seed, which no other cell of a run shares."""
        return self.method, self.demonstration, self.seed


def joint_name(shown: Sequence[Demonstration]) -> str:
    """What rows call demonstrations that are fitted together."""
    return " + ".join(dict.fromkeys(d.name for d in shown))


@dataclass(frozen=True)
class Outcome:
    """The result of a cell.

    Attributes:
        rows: one mapping per start: from ``COLUMNS``, from "judge" to the judge's name, and what the cell measures.
        paths: (J (1 + n_starts), n_points, n) rollouts from the starts of all J judges, NaN where there are none.
    """

    method: str
    demonstration: str
    seed: int
    rows: tuple[dict[str, Any], ...]
    paths: Array

    @property
    def name(self) -> tuple[str, str, int]:
        """That of its cell."""
        return self.method, self.demonstration, self.seed


@contextmanager
def interrupts_kept() -> Iterator[None]:
    """Ctrl-C in this block always ends it with KeyboardInterrupt.

    Without this, an exception raised while compiled code calls back into Python is lost or becomes another one: an
    interrupt while numba compiles a kernel comes out as "RuntimeError: no compiled object yet", or not at all.
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
def evaluate(cell: Cell, protocol: RolloutProtocol) -> Outcome:
    """Fit one cell, then :func:`judge` it. Whatever the method raises stands in its rows; Ctrl-C ends the run."""
    try:
        with reproducible_torch(cell.seed):
            ds = build(cell)
            kernels.compile_all([ds.dim])  # compiling is nobody's fitting time
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FitWarning)  # the rows say it
                ds.fit(cell.shown[0] if len(cell.shown) == 1 else list(cell.shown))
    except KeyboardInterrupt:
        raise
    except BaseException as raised:
        return _outcome(cell, protocol, error=raised)
    return judge(ds, cell, protocol)


@interrupts_kept()
def judge(ds: StableDS, cell: Cell, protocol: RolloutProtocol) -> Outcome:
    """Roll out and score a system that is fitted already. Whatever it raises stands in the rows.

    Args:
        ds: the system.
        cell: the method's label, what the system was shown, the seed, the judges and what else is measured.
        protocol: from where, how long and how finely the system is rolled out.
    """
    report, judges = ds.fit_report, cell.judges
    follows = bool(report and report.fidelity and report.fidelity.follows)
    facts: dict[str, Any] = {"fit_seconds": report.seconds if report else math.nan}
    of_judge: list[dict[str, float]] = []
    try:
        with reproducible_torch(cell.seed):
            of_judge = [_velocity_scores(ds, one) for one in judges]
            measured = {k: _plain(k, v) for k, v in cell.measure(ds, cell).items()} if cell.measure else {}
            if taken := measured.keys() & {*COLUMNS, "judge"}:
                raise ValueError(f"measure: expected names that rows do not have, got {sorted(taken)}")
            facts |= _facts(ds) | measured
            starts = [protocol.starts(one) for one in judges]
            with torch.no_grad():
                began = time.perf_counter()
                moved = [ds.rollout(y0, protocol.times(one)) for y0, one in zip(starts, judges, strict=True)]
                facts["rollout_seconds"] = time.perf_counter() - began
                converged = np.stack([_converged(ds, cell, one, y0) for y0, one in zip(starts, judges, strict=True)])
        wanted = protocol.n_starts + 1, protocol.n_points, ds.dim
        for path in moved:
            if path.shape != wanted:
                raise ValueError(f"rollout: expected shape {wanted}, got {tuple(path.shape)}")
        paths = np.array([path.numpy() for path in moved], dtype=np.float64)
    except KeyboardInterrupt:
        raise
    except BaseException as raised:
        return _outcome(cell, protocol, facts, of_judge, error=raised)
    return _outcome(cell, protocol, facts, of_judge, follows, converged, paths)


def _outcome(
    cell: Cell,
    protocol: RolloutProtocol,
    facts: Mapping[str, Any] | None = None,
    of_judge: Sequence[Mapping[str, float]] = (),
    follows: bool = False,
    converged: NDArray[np.bool_] | None = None,
    paths: Array | None = None,
    error: BaseException | None = None,
) -> Outcome:
    """The rows of a cell; NaN stands for what is missing because of an error."""
    share = protocol.n_starts + 1
    if paths is None:
        paths = np.full((len(cell.judges), share, protocol.n_points, cell.shown[0].dim), np.nan)
    reason = "" if error is None else _reason(error)
    rows = [
        {"method": cell.method, "demonstration": cell.demonstration, "seed": cell.seed, "start": share * i + k}
        | {
            "status": "failed" if error else "ok" if np.isfinite(path).all() else "diverged",
            "error": reason,
            "follows": follows,
            "converged": converged is not None and bool(converged[i, k]),
        }
        | {"judge": judge.name}
        | dict.fromkeys(SCORES, math.nan)
        | dict(facts or {})
        | dict(of_judge[i] if of_judge else {})
        | _scores(path, protocol.reference(judge), protocol.fast_dtw)
        for i, judge in enumerate(cell.judges)
        for k, path in enumerate(paths[i])
    ]
    return Outcome(*cell.name, tuple(rows), paths.reshape(-1, *paths.shape[2:]))


def _reason(error: BaseException) -> str:
    try:
        text = str(error)
    except KeyboardInterrupt:
        raise
    except BaseException:
        text = "an error that cannot say what it is"
    return f"{type(error).__name__}: {text}".encode("utf-8", "backslashreplace").decode()


def _plain(name: Any, value: Any) -> bool | int | float | str | None:
    """A measured value as Python's own, of NumPy's or torch's scalars: rows are kept as JSON."""
    if isinstance(value, np.generic) or (isinstance(value, (Tensor, np.ndarray)) and value.ndim == 0):
        value = value.item()
    if not (isinstance(name, str) and (value is None or isinstance(value, (bool, int, float, str)))):
        raise TypeError(f"measure: expected names with numbers or strings, got {name!r}: {type(value).__name__}")
    return value


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


def _scores(path: Array, reference: Array, fast_too: bool) -> dict[str, float]:
    exact, fast = metrics.dtw(path, reference), metrics.fast_dtw(path, reference) if fast_too else math.nan
    return {
        "dtw": exact,
        "dtw_fast": fast,
        "dtw_per_point": exact / len(reference),
        "dtw_fast_per_point": fast / len(reference),
        "frechet": metrics.frechet(path, reference),
        "endpoint_error": metrics.endpoint_error(path, reference),
        "path_length_ratio": metrics.path_length_ratio(path, reference),
    }


def _converged(ds: StableDS, cell: Cell, judge: Demonstration, starts: Tensor) -> NDArray[np.bool_]:
    later = torch.tensor([0.0, CONVERGED_AFTER * judge.duration], dtype=torch.float64)
    left = torch.linalg.vector_norm(ds.rollout(starts, later)[:, -1] - ds.attractor, dim=-1)
    goals = torch.stack([one.goal for one in cell.shown])
    apart = torch.linalg.vector_norm(torch.cat([goals, ds.attractor.unsqueeze(0)]) - goals.mean(0), dim=-1)
    arrived = (left <= CONVERGED_WITHIN * judge.size) & (apart[-1] <= apart[:-1].max() + ON_GOAL * judge.size)
    return np.asarray(arrived.numpy())


_RNG_LOCK = threading.RLock()


@contextmanager
def reproducible_torch(seed: int) -> Iterator[None]:
    """Torch's generator is seeded and torch uses one thread in this block. Both are global, so blocks take turns."""
    with _RNG_LOCK, torch.random.fork_rng():
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        torch.manual_seed(seed)
        try:
            yield
        finally:
            torch.set_num_threads(threads)


def several(value: Any, name: str, dim: int | None = None) -> tuple[Demonstration, ...]:
    """An argument that is one demonstration or a sequence of them, all of one dimension (``dim``, if given)."""
    items = [value] if isinstance(value, Demonstration) else value
    if not isinstance(items, Sequence) or not items or not all(isinstance(item, Demonstration) for item in items):
        raise ValueError(f"{name}: expected a Demonstration or a non-empty sequence of them, got {value!r}")
    wanted = items[0].dim if dim is None else dim
    for item in items:
        if item.dim != wanted:
            raise ValueError(f"{name}: expected demonstrations of {wanted} dimensions, got {item!r}")
    return tuple(items)
