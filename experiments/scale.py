"""What a clock inside one process cannot tell: threads, imports, the first fit, and what happens when much is asked.

    python -m experiments.scale

A part of ``make speed`` that runs alone, in minutes, on all cores. What depends on how a process starts is measured in
processes that start for it, and rivals take turns there, too. Memory is read where Linux tells it.
"""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import joblib
import numpy as np
import torch

from baselines import SDSEF
from experiments import report
from experiments.compared import cluster
from experiments.report import Goal, at_most
from latentds import ChebyshevDS, StableDS, TubeDS, datasets, kernels
from latentds.arguments import Array
from latentds.benchmark import Cell, RolloutProtocol, run
from latentds.cache import CellStore
from latentds.cell import reproducible_torch
from latentds.testing import wavy_motion

SHOWN = datasets.unstable_spiral(7)
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
CHUNK = 100_000

# --- timing -----------------------------------------------------------------------------------------------------------


def timed(call: Callable[[], Any], clock: Callable[[], float], calls: int = 1) -> float:
    """Seconds a call."""
    began = clock()
    for _ in range(calls):
        call()
    return (clock() - began) / calls


def take_turns(
    rivals: Mapping[str, Callable[[], Any]],
    rounds: int,
    share: float = 0.02,
    clock: Callable[[], float] = time.thread_time,
) -> dict[str, Array]:
    """Seconds a call, (rounds,) each: in each round, each rival runs for about ``share`` s, once at least."""
    counts = {}
    for name, call in rivals.items():
        taken = timed(call, clock)
        if taken < share:  # what the first call has to set up does not count
            taken = timed(call, clock)
        counts[name] = max(1, int(share / max(taken, 1e-7)))
    seconds: dict[str, list[float]] = {name: [] for name in rivals}
    for _ in range(rounds):
        for name, call in rivals.items():
            seconds[name].append(timed(call, clock, counts[name]))
    return {name: np.array(values) for name, values in seconds.items()}


def child(code: str, environment: Mapping[str, str] = ONE_THREAD) -> Array:
    """The numbers that a new Python prints; of this one's environment it gets all but the numbers of threads."""
    kept = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    command = [sys.executable, "-W", "ignore", "-c", code]
    told = subprocess.run(command, env={**kept, **environment}, stdout=subprocess.PIPE, text=True, check=True)
    return np.array(told.stdout.split(), dtype=float)


def of_child(call: str, environment: Mapping[str, str] = ONE_THREAD) -> Array:
    """What a function of this file returns in a new Python."""
    return child(f"from experiments import scale; print(*scale.{call})", environment)


def peak() -> float:
    """MB that this process ever had in memory; NaN where no file tells. (getrusage would count the parent's, too.)"""
    status = Path("/proc/self/status")
    lines = status.read_text().splitlines() if status.exists() else []
    return next((int(line.split()[1]) / 1000 for line in lines if line.startswith("VmHWM")), np.nan)


# --- what a process costs ---------------------------------------------------------------------------------------------


def busy_calls() -> list[float]:
    """CPU seconds of a TubeDS fit, a rollout of 16 x 1000 points and one of SDS-EF."""
    kernels.warmup([3])
    with reproducible_torch(0):  # on one thread: only what is measured may spin
        ds = ChebyshevDS(3, n_layers=150).fit(SHOWN).requires_grad_(False)
        flow = SDSEF(3, seed=0, epochs=2).fit(SHOWN).requires_grad_(False)
    starts, times = SHOWN.start.expand(16, 3), torch.linspace(0, SHOWN.duration, 1000, dtype=torch.float64)
    rollouts = (partial(ds.rollout, starts, times), partial(flow.rollout, SHOWN.start, times))
    for call in rollouts:
        call()
    fit = timed(partial(TubeDS(3).fit, SHOWN), time.process_time)
    return [fit, *(timed(call, time.process_time, 10) for call in rollouts)]


def threads(rounds: int) -> list[Goal]:
    turns = [[of_child("busy_calls()", env) for env in ({}, ONE_THREAD)] for _ in range(rounds)]
    ratios = np.stack([default / single for default, single in turns], axis=1)
    names = ("TubeDS fit", "rollout 16 x 1000", "SDS-EF rollout")
    return [
        report.median(f"{name}, default threads over one", "times the CPU time", 1.15, ratio, at_most=True)
        for name, ratio in zip(names, ratios, strict=True)
    ]


def imports(rounds: int) -> Goal:
    turns = [
        [child(f"import {name}, time; print(time.process_time())") for name in ("latentds", "torch")]
        for _ in range(rounds)
    ]
    ours, theirs = np.array(turns)[..., 0].T
    note = f"import torch: {np.median(theirs):.2f} s"
    return report.median(
        "import latentds beyond import torch", "s of CPU time", 0.3, ours - theirs, at_most=True, note=note
    )


def first_call(what: str) -> list[float]:
    """CPU seconds of the first fit or warm-up of this process."""
    calls: dict[str, Callable[[], Any]] = {"fit": partial(TubeDS(3).fit, SHOWN), "warmup": partial(kernels.warmup, [3])}
    return [timed(calls[what], time.process_time)]


def fresh(what: str, rounds: int) -> Array:
    """CPU seconds of it where Numba's cache is empty, (rounds,)."""
    seconds = []
    for _ in range(rounds):
        with TemporaryDirectory() as folder:
            seconds += [*of_child(f"first_call({what!r})", {**ONE_THREAD, "NUMBA_CACHE_DIR": folder})]
    return np.array(seconds)


def first_fit(rounds: int) -> Goal:
    note = f"warmup([3]), which compiles more than a fit needs: {fresh('warmup', 1)[0]:.1f} s"
    seconds = fresh("fit", rounds)
    return report.median("first fit on a fresh machine", "s of CPU time", 6, seconds, at_most=True, note=note)


# --- much of everything -----------------------------------------------------------------------------------------------


def decoded(chunks: int) -> list[float]:
    """MB of peak memory that further chunks of points add to the first."""
    ds = ChebyshevDS(3, n_layers=150).fit(SHOWN).requires_grad_(False)
    x = ds.encode(SHOWN.positions).repeat(CHUNK // len(SHOWN), 1)
    ds.decode(x)
    before = peak()
    for _ in range(chunks - 1):
        ds.decode(x)
    return [peak() - before]


def points(total: int, rounds: int) -> list[Goal]:
    (grown,) = of_child(f"decoded({total // CHUNK})", {})
    ds = ChebyshevDS(3, n_layers=150).fit(SHOWN).requires_grad_(False)
    x = ds.encode(SHOWN.positions).repeat(total // 10 // len(SHOWN), 1)

    def on(cores: int) -> None:
        torch.set_num_threads(cores)
        ds.decode(x)

    before = torch.get_num_threads()
    times = take_turns({"one": partial(on, 1), "two": partial(on, 2)}, rounds, clock=time.perf_counter)
    torch.set_num_threads(before)
    return [
        at_most(f"{total:.0e} points decoded in chunks of {CHUNK:.0e}, beyond the first", grown, 10, unit="MB of peak"),
        report.ratio(f"decode {len(x):.0e} points on two cores, one core", 1.8, times["one"], times["two"]),
    ]


def large_fit(n_points: int, dim: int) -> list[float]:
    """CPU seconds, and MB of peak memory beyond what the imports and the motion take."""
    TubeDS(dim, n_layers=2).fit(wavy_motion(dim))  # so that little is left to compile
    shown, before = wavy_motion(dim, n_points=n_points), peak()
    return [timed(partial(TubeDS(dim).fit, shown), time.process_time), peak() - before]


def large_fits(n_points: int, dim: int) -> Goal:
    seconds, grown = of_child(f"large_fit({n_points}, {dim})")
    what = f"TubeDS fit, N = {n_points:.0e}, n = {dim}"
    return Goal(what, "", f"{seconds:.3g}", unit="s of CPU time", note=f"peak memory grows by {grown:.0f} MB")


def small(dim: int) -> StableDS:
    return ChebyshevDS(dim, n_layers=300)


def many_fits(where: str, fits: int, workers: int) -> Goal:
    """Share of the workers' time that is spent in fits, once they are up."""
    protocol = RolloutProtocol(n_starts=0, n_points=2)
    cells = [Cell("ChebyshevDS", small, SHOWN, seed) for seed in range(fits)]
    began = time.perf_counter()
    list(run(cells[:workers], protocol))
    up, began = time.perf_counter() - began, time.perf_counter()
    spent = sum(outcome.rows[0]["fit_seconds"] for outcome in run(cells, protocol))
    seconds = time.perf_counter() - began
    note = f"{seconds:.1f} s, {1e3 * spent / fits:.0f} ms a fit; {up:.1f} s until the workers were up"
    share = report.median(f"{fits} fits through {where}", "% in fits", 85, np.array([100 * spent / seconds / workers]))
    return share._replace(quartiles="", note=note)


def on_dask(fits: int) -> list[Goal]:
    if importlib.util.find_spec("distributed") is None:
        print("Fits on a Dask cluster are not measured: pip install 'latentds[distributed]'.")
        return []
    from distributed import LocalCluster

    with (
        LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as local,
        cluster(local.scheduler_address),
    ):
        return [many_fits("Dask, two workers", fits, 2)]


def stored(cells: int, rounds: int) -> list[Goal]:
    """A store that holds many cells and a new one take turns."""
    cell = Cell("ChebyshevDS", small, SHOWN)
    (outcome,) = run([cell], RolloutProtocol(n_starts=0, n_points=100), n_jobs=1)
    with TemporaryDirectory() as folder, CellStore(f"{folder}/full") as full, CellStore(f"{folder}/new") as new:
        keys = {store: count() for store in (full, new)}

        def write(store: CellStore) -> None:
            store.put(f"{next(keys[store]):064d}", outcome.rows, outcome.paths)

        for _ in range(cells):
            write(full)
        wrote = take_turns({"full": partial(write, full), "new": partial(write, new)}, rounds, clock=time.perf_counter)
        read = take_turns(
            {name: partial(store.get, f"{len(store) - 1:064d}") for name, store in (("full", full), ("new", new))},
            rounds,
            clock=time.perf_counter,
        )
        note = f"{len(full)} cells against {len(new)}"
    return [
        report.median(
            f"{what} a store of {cells:.0e} cells, a new one", "times slower", 1.3, times["full"] / times["new"],
            at_most=True, note=f"{1e6 * np.median(times['full']):.0f} µs; {note}",
        )
        for what, times in (("write to", wrote), ("read from", read))
    ]  # fmt: skip


def measure(quick: bool) -> list[Goal]:
    """All of it; ``quick``: a tenth or less of the work, without what takes as long for little: compiling and Dask."""
    few, tenth = (2, 10) if quick else (5, 1)
    return [
        *threads(few // 2),
        imports(few),
        *([] if quick else [first_fit(few // 2)]),
        *points(10**7 // tenth, 5 * few),
        large_fits(1000, 10) if quick else large_fits(10**5, 30),
        many_fits("joblib, all cores", 1000 // tenth, joblib.cpu_count()),
        *([] if quick else on_dask(1000)),
        *stored(10**4 // tenth, 5 * few),
    ]


if __name__ == "__main__":
    torch.set_grad_enabled(False)
    print(report.goal_table(measure(quick=False)), flush=True)
