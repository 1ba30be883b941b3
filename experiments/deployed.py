"""What becomes of a fitted system outside of eager torch: exported, compiled, as ONNX and as C, on one core.

    python -m experiments.deployed

A part of ``make speed`` that runs alone, in minutes. Needs a C compiler and onnxruntime. Seconds are wall time and
grow with what else runs.
"""

from __future__ import annotations

import ctypes
import io
import os
import re
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np
import onnxruntime
import torch
from torch import Tensor

from experiments import report
from experiments.report import Goal, at_most
from latentds import Demonstration, LatentDS, TubeDS, datasets
from latentds.arguments import Array
from latentds.deploy import c, onnx
from latentds.testing import wavy_motion

T = TypeVar("T")

LIMITS = {torch.float64: 1e-12, torch.float32: 1e-5}
"""Of the difference from eager torch, in largest speeds."""
SHOWN: dict[int, Callable[[], Demonstration]] = {3: lambda: datasets.unstable_spiral(7), 7: lambda: wavy_motion(7)}
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-O2", "-shared", "-fPIC", "-D_POSIX_C_SOURCE=199309L")
"""POSIX for the clock of the program alone."""
PROGRAM = """
#include <time.h>
#include "field.h"
static double now(void) {
    struct timespec t;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}
void run(const double *y, double *velocity, double *seconds, int count) {
    for (int i = 0; i < count; i++) {
        const double began = now();
        field_velocity(y + i * field_DIM, velocity + i * field_DIM);
        seconds[i] = now() - began;
    }
}
"""


def fitted(dim: int, n_layers: int) -> TubeDS:
    return TubeDS(dim, n_layers=n_layers).fit(SHOWN[dim]())


def points_near(ds: LatentDS, count: int) -> Tensor:
    """Around the motion, off by a tenth of its size."""
    shown, generator = SHOWN[ds.dim]().positions, torch.Generator().manual_seed(0)
    on_path = shown[torch.randint(len(shown), (count,), generator=generator)]
    return on_path + 0.1 * shown.std(0) * torch.randn(on_path.shape, generator=generator, dtype=torch.float64)


def timed(call: Callable[[], T], clock: Callable[[], float] = time.perf_counter) -> tuple[T, float]:
    """What a call gives, and its seconds, of wall time unless another clock is given."""
    began = clock()
    return call(), clock() - began


def within(what: str, velocity: Any, ds: LatentDS, y: Tensor, bound: float) -> Goal:
    """That velocities differ from eager torch by no more than ``bound``, in largest speeds."""
    expected = ds(y).double()
    error = (torch.as_tensor(velocity).double() - expected).abs().max() / torch.linalg.vector_norm(
        expected, dim=-1
    ).max()
    return at_most(f"{what}, distance from eager", float(error), bound, unit="top speed")


def take_turns(compiled: Callable[[Tensor], Tensor], ds: LatentDS, y: Tensor) -> str:
    """CPU time of a call, compiled and eager: medians."""
    pairs = [[timed(lambda call=call: call(y), time.thread_time)[1] for call in (compiled, ds)] for _ in range(15)]  # type: ignore[misc]
    ours, eager = 1e3 * np.median(pairs, axis=0)
    return f"{ours:.1f} ms for {len(y)} points, eager {eager:.1f} ms"


def size(program: torch.nn.Module) -> int:
    """Nodes of a graph and of the graphs inside it."""
    return sum(len(part.graph.nodes) for part in program.modules() if isinstance(part, torch.fx.GraphModule))


def in_torch(dim: int, dtype: torch.dtype) -> list[Goal]:
    """torch.export and torch.compile at M = 300, without any cache of code compiled before."""
    ds = fitted(dim, 300).to(dtype)
    y, batch = points_near(ds, 1000).to(dtype), ({0: torch.export.Dim("batch")},)
    label = f"M = 300, n = {dim}, {str(dtype).removeprefix('torch.')}"
    program, exported = timed(lambda: torch.export.export(ds, (y,), dynamic_shapes=batch))
    small = torch.export.export(TubeDS(dim, n_layers=2).to(dtype), (y,), dynamic_shapes=batch)
    nodes = size(program.graph_module)
    file = io.BytesIO()
    torch.export.save(program, file)
    torch.compiler.reset()
    with torch._inductor.config.patch(force_disable_caches=True):
        compiled, before = torch.compile(ds), os.times()
        velocity, first = timed(lambda: compiled(y))
        cpu_seconds = sum(os.times()[:4]) - sum(before[:4])  # of this process and of those that it waited for
        busy = f"{cpu_seconds:.0f} s of CPU time, the C++ compiler's included"
    calls = take_turns(compiled, ds, y)
    note = f"{nodes} nodes, {size(small.graph_module)} at M = 2; a file of {file.getbuffer().nbytes / 1000:.0f} kB"
    return [
        at_most(f"torch.export, {label}", exported, 30, unit="s", note=note),
        within(f"torch.export, {label}", program.module()(y), ds, y, LIMITS[dtype]),
        at_most(f"torch.compile, {label}, first answer", first, 90, unit="s", note=f"{busy}; then {calls}"),
        within(f"torch.compile, {label}", velocity, ds, y, LIMITS[dtype]),
    ]


def in_onnx(calls: int) -> list[Goal]:
    """ONNX in onnxruntime at M = 150."""
    ds, goals = fitted(3, 150), []
    y = points_near(ds, 1000)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    with TemporaryDirectory() as folder:
        path = Path(folder, "field.onnx")
        for dtype, bound in LIMITS.items():
            _, taken = timed(lambda dtype=dtype: onnx.write(ds, path, dtype=dtype))  # type: ignore[misc]
            label = f"ONNX, M = 150, n = 3, {str(dtype).removeprefix('torch.')}"
            session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
            points = y.to(dtype).numpy()
            (velocity,) = session.run(None, {"y": points})
            micro = [1e6 * timed(lambda: session.run(None, {"y": points[:1]}))[1] for _ in range(calls)]  # noqa: B023
            note = f"one point takes onnxruntime {np.median(micro):.0f} µs, worst of {calls}: {max(micro):.0f} µs"
            goals += [
                at_most(f"{label}, written", taken, 10, unit="s", note=note),
                at_most(f"{label}, file", path.stat().st_size / 1000, 100, unit="kB"),
                within(label, velocity, ds, torch.from_numpy(points).double(), bound),
            ]
    return goals


def library(ds: LatentDS, folder: str, *, bounded: bool = False) -> ctypes.CDLL:
    """The header of a system, compiled; ``bounded``: no layer left out, no root goals before its last step."""
    header, built = Path(folder, "field.h"), Path(folder, f"field{bounded:d}.so")
    c.write(ds, header, name="field")
    if bounded:
        text, left = re.subn(r"if \(.*\) (?:break|continue);", "", header.read_text())
        assert left == 6, "the header has other ways out of its loops than this knows"
        header.write_text(text)
    Path(folder, "field.c").write_text(PROGRAM)
    subprocess.run(["cc", *STRICT, "field.c", "-o", built, "-lm"], cwd=folder, check=True)
    return ctypes.CDLL(str(built))


def called(program: ctypes.CDLL, y: Array) -> tuple[Array, Array]:
    """Velocities at points (N, n), and the microseconds of CPU time of each call."""
    velocity, taken = np.empty_like(y), np.empty(len(y))
    pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (y, velocity, taken)]
    program.run(*pointers, ctypes.c_int(len(y)))
    return velocity, 1e6 * taken


def in_c() -> list[Goal]:
    """The C header beside the controller: the same systems, the same points."""
    goals = []
    for ds in (fitted(3, 150), fitted(3, 300), fitted(7, 300)):
        y = points_near(ds, 10_000)
        with TemporaryDirectory() as folder:
            velocity, header = called(library(ds, folder), y.numpy())
            _, bounded = called(library(ds, folder, bounded=True), y.numpy())
        controller, out = ds.controller(), np.empty(ds.dim)
        beside = np.array([1e6 * timed(lambda: controller(at, out), time.thread_time)[1] for at in y.numpy()])  # noqa: B023
        label = f"M = {ds.n_layers}, n = {ds.dim}"
        calls = {"C header": header, "C header, all layers and steps taken": bounded, "controller(y)": beside}
        for name, taken in calls.items():
            note = f"median {np.median(taken):.1f} µs, 99th percentile {np.quantile(taken, 0.99):.1f} µs, of CPU time"
            what = f"{name}, {label}, worst of {len(y)} calls"
            goals.append(Goal(what, "", f"{taken.max():.0f}", unit="µs", note=note))
        goals.append(within(f"C header, {label}, {len(y)} points", velocity, ds, y, 1e-12))
    return goals


def measure(quick: bool) -> list[Goal]:
    """All of it; ``quick``: n = 3 and float64 alone in torch."""
    cases = [(3, torch.float64)] if quick else [(dim, dtype) for dim in SHOWN for dtype in LIMITS]
    return [*in_c(), *in_onnx(20), *(line for case in cases for line in in_torch(*case))]


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    print(report.goal_table(measure(quick=False)), flush=True)
    print(f"\nLoad average at the end: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores.")
