"""What the fuzzer does to a system that follows its demonstration, and what must then be said of it.

Each kind changes so much that silence is a broken promise; why it is so much stands beside it.
"""

from __future__ import annotations

import copy
import math
import os
import tempfile
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from latentds import Demonstration, Learned, StableDS, certify
from latentds.benchmark import compare
from latentds.fidelity import TIMING_LIMIT

Shown = list[Demonstration]
Draw = np.random.Generator
FIELDS: dict[str, Callable[[Tensor, Tensor], Tensor]] = {
    "turned": lambda velocity, push: torch.cat([-velocity[..., -1:], velocity[..., :-1]], -1),
    "halved": lambda velocity, push: velocity / 2,
    "pushed": lambda velocity, push: velocity + push,
}
"""Velocities whose integral leaves the motion by a multiple of the .05 sizes that it may.

A motion that follows is somewhere half a size from its start. Halved, a quarter of a size is missing there. Turned in
n <= 10 dimensions, each direction is off by at least 2 sin(π/2n) = .31 of it. The push alone goes half a size.
"""
PACES = {"ten times as fast": 10.0, "a tenth as fast": 0.1}
"""A tenth as fast, a motion ends where it was after a tenth of its time, and is too short for any limit of lengths.

Ten times as fast, it waits at the goal from the first tenth on, while the demonstration is ``AWAY`` sizes from there.
"""
AWAY = 4 * TIMING_LIMIT


class Mute(Exception):
    def __str__(self) -> str:
        raise RuntimeError("no text")


def _raise(error: BaseException) -> None:
    raise error


LEARNED = 0.5, 3, (1.0,)
REPORTS: dict[str, tuple[str, Callable[[], Any]]] = {
    "NumPy's numbers": ("ok", lambda: Learned(np.float32(0.5), np.int64(3), [np.float32(1)])),  # type: ignore[arg-type]
    "tensors": ("ok", lambda: Learned(*map(torch.tensor, LEARNED))),  # type: ignore[arg-type]
    "a note no file holds": ("ok", lambda: Learned(*LEARNED, notes=(os.fsdecode(b"caf\xe9"),))),
    "no number": ("failed", lambda: Learned("much", 3)),  # type: ignore[arg-type]
    "nothing": ("failed", lambda: None),
    "an unknown detail": ("failed", lambda: Learned(*LEARNED, details={"color": "red"})),
    "an exit": ("failed", lambda: _raise(SystemExit("no licence"))),
    "a generator's exit": ("failed", lambda: _raise(GeneratorExit("over"))),
    "a mute error": ("failed", lambda: _raise(Mute())),
    "an error no file holds": ("failed", lambda: _raise(OSError(os.fsdecode(b"caf\xe9")))),
}
"""What rows say of a method, and how it ends its learning."""


def _override(module: nn.Module, **changes: Callable[[Any, Any], Any]) -> None:
    """Let a module be of a subclass, in which a method is a function of the class's own and the argument."""
    kind = type(module)
    own = {name: getattr(kind, name) for name in changes if hasattr(kind, name)}
    made = {name: lambda self, x, name=name: changes[name](lambda value: own[name](self, value), x) for name in own}
    module.__class__ = type(f"Changed{kind.__name__}", (kind,), made)


def _field(name: str, place: str, ds: StableDS, shown: Shown, draw: Draw) -> str:
    """Another field than the rollouts are of."""
    push = torch.from_numpy(draw.normal(size=ds.dim))
    push *= shown[0].size / 2 / shown[0].duration / torch.linalg.vector_norm(push)
    if place == "subclass":
        _override(ds, forward=lambda own, y: FIELDS[name](own(y), push))
    else:
        module = ds if place == "hook" else ds.get_submodule("dynamics")
        module.register_forward_hook(lambda module, inputs, velocity: FIELDS[name](velocity, push))
    return _unsaid(ds, shown[0], proves=place != "hook on its dynamics")


def _pace(factor: float, place: str, ds: StableDS, shown: Shown, draw: Draw) -> str:
    dynamics = ds.get_submodule("dynamics")
    law = getattr(dynamics, "law", dynamics)
    if place == "subclass":
        _override(
            law,
            speed=lambda own, s: factor * own(s),
            time_to_go=lambda own, s: own(s) / factor,
            progress_at=lambda own, time: own(factor * time),
        )
    else:
        for name, buffer in law.named_buffers(recurse=False):
            buffer.mul_({"omega": factor, "speeds": factor, "duration": 1 / factor}.get(name, 1.0))
    away = torch.linalg.vector_norm(shown[0].positions[len(shown[0]) // 4 :] - shown[0].goal, dim=-1).mean()
    if factor > 1 and float(away) < AWAY * shown[0].size:
        return ""
    return _unsaid(ds, shown[0], proves=place != "subclass")


def _unsaid(ds: StableDS, shown: Demonstration, proves: bool) -> str:
    """What is not said of a system that no longer follows, and whose rate is proven only if it ``proves`` one."""
    certificate = certify(ds, n_samples=10)
    if "follows its demonstration" not in {line.claim for line in certificate.falsified}:
        return "a certificate that says that it follows"
    if not proves and any(line.verdict == "proven" and "approach the goal" in line.claim for line in certificate.lines):
        return "a rate that is proven of other code"
    with torch.no_grad():
        wanted = ds(shown.positions).numpy()
    if np.abs(ds.controller()(shown.positions.numpy()) - wanted).max() > 1e-6 * np.abs(wanted).max():
        return "a controller that runs another field"
    return ""


TRANSLATIONS = {f"diffeomorphism.{name}" for name in ("centers", "log_widths", "strengths")}
"""Parameters that every velocity depends on. Not so a law's last knot, or what a network's limits swallow."""


def _not_finite(number: float, ds: StableDS, shown: Shown, draw: Draw) -> str:
    """One number of the state is none: a map that leaves it out would be another one."""
    state = {name: tensor for name, tensor in ds.state_dict().items() if tensor.is_floating_point() and tensor.numel()}
    name = str(draw.choice([*state]))
    with torch.no_grad():
        before = ds(shown[0].positions)
        state[name].view(-1)[int(draw.integers(state[name].numel()))] = number
        after = ds(shown[0].positions)
    if name in TRANSLATIONS and bool((after.isfinite() & ((after - before).abs() > 1e-6 * before.abs().max())).any()):
        return f"velocities of another system with {number} in {name}"
    if [line.claim for line in certify(ds, n_samples=10).falsified][:1] != ["parameters and velocities are finite"]:
        return f"a certificate that does not say first that velocities are not finite, with {number} in {name}"
    with tempfile.TemporaryDirectory() as folder:
        for use in (StableDS.controller, lambda ds: ds.save(Path(folder) / "never")):
            try:
                use(ds)
            except ValueError as error:
                if str(error).startswith("ds: expected finite"):
                    continue
            return f"a controller or a file with {number} in {name}"
    return ""


def _reports(name: str, ds: StableDS, shown: Shown, draw: Draw) -> str:
    """A method that ends its learning badly, beside one that does not, with a store for every other."""

    def learning(learn: Callable[[], Any], dim: int) -> StableDS:
        made = copy.deepcopy(ds)  # so nothing is learned twice
        vars(made)["_learn"] = lambda shown, progress: learn()
        return made

    status, learn = REPORTS[name]
    methods = {"bad": partial(learning, learn), "good": partial(learning, lambda: Learned(*LEARNED))}
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "cells" if draw.random() < 0.5 else None
        for _ in range(1 if store is None else 2):
            rows = compare(methods, [shown], n_starts=0, n_points=50, n_jobs=1, store=store).groupby("method")
            bad, good = rows.get_group("bad"), rows.get_group("good")
            if set(good["status"]) != {"ok"}:
                return "another method's rows fail with it"
            if set(bad["status"]) != {status} or (bad["error"] != "").all() != (status == "failed"):
                return f"rows that do not say {status!r} and why, but {bad[['status', 'error']].to_numpy().tolist()}"
            scores = ["dtw", "mse", "n_layers", "follows"]
            if status == "ok" and not np.array_equal(bad[scores], good[scores]):
                return "rows that are not right"
    return ""


TAMPERINGS: Mapping[str, Callable[[StableDS, Shown, Draw], str]] = (
    {f"{name} by a {place}": partial(_field, name, place) for name in FIELDS for place in ("hook", "subclass")}
    | {"halved by a hook on its dynamics": partial(_field, "halved", "hook on its dynamics")}
    | {f"{name} by {by}": partial(_pace, pace, by) for name, pace in PACES.items() for by in ("numbers", "subclass")}
    | {f"{number} in it": partial(_not_finite, number) for number in (math.nan, math.inf)}
    | {f"reports {name}": partial(_reports, name) for name in REPORTS}
)
"""What is broken, "" for nothing, once a system that follows what was shown was changed, in place."""
