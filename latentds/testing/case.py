"""One system under examination, and what the clauses of the contract share."""

from __future__ import annotations

import pickle
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from ..arguments import whole_number
from ..base import LatentDS, StableDS
from ..demonstration import Demonstration

T = TypeVar("T")
Factory = Callable[[int], StableDS]
Clause = Callable[["Case"], None]


def wavy_motion(dim: int, seed: int = 0, n_points: int = 200) -> Demonstration:
    """A smooth motion of about unit size that never meets itself, in any dimension, for trying methods out."""
    dim = whole_number(dim, "dim", at_least=1)
    draw = np.random.default_rng(seed)
    t = np.linspace(0, 1, n_points)
    s = t - 0.8 * np.sin(2 * np.pi * t) / (2 * np.pi)
    cycles, phases = draw.uniform(0.3, 1.2, dim), draw.uniform(0, 2 * np.pi, dim)
    positions = 0.3 * np.sin(2 * np.pi * cycles * s[:, None] + phases)
    positions[:, 0] = 1 - s  # monotone, so that no two points coincide
    positions += draw.uniform(-1, 1, dim)
    return Demonstration(torch.from_numpy(positions), 2.0 / (n_points - 1), f"wavy {dim}-D")


@dataclass(frozen=True)
class Case:
    """One system under examination, shared by all clauses (none may change it), with the places to try it at."""

    factory: Factory
    seed: int
    after_fit: bool
    ds: StableDS
    shown: Demonstration
    learned: Demonstration
    """What ``ds`` was fitted to: ``shown``, in memory of its own."""
    changed: tuple[str, ...]
    """What global state the factory and fit changed."""
    probes: Tensor
    """(P, n): on the demonstration, near it, around it and ten sizes away; none at the attractor."""
    starts: Tensor
    """(S, n): the start, two near it, two far away."""

    @classmethod
    def of(cls, factory: Factory, dim: int, after_fit: bool, seed: int) -> Case:
        """factory(n) gives a StableDS with an attractor (n,), and fit takes a demonstration of n dimensions."""
        try:
            shown, learned = wavy_motion(dim, seed), wavy_motion(dim, seed)
            ds, changed = seeded(lambda: factory(dim), seed)
            expect(isinstance(ds, StableDS), f"expected a StableDS, got {type(ds).__name__}")
            _, changed_by_fit = seeded(lambda: ds.fit(learned) if after_fit else None, seed)
            goal = ds.attractor.detach().to(torch.float64)
            expect(goal.shape == (dim,), f"attractor: expected shape ({dim},), got {tuple(goal.shape)}")
        except Exception as error:
            where = f"{dim}-D, {state_of(after_fit)}"
            raise AssertionError(f"the factory ({where}) breaks “{cls.of.__doc__}” {cause_of(error)}") from error
        draw = torch.Generator().manual_seed(seed)

        def spread(count: int, scale: float) -> Tensor:
            offsets = torch.randn(count, dim, generator=draw, dtype=torch.float64)
            return scale * shown.size * torch.nn.functional.normalize(offsets, dim=-1)

        path = shown.positions - shown.goal + goal
        on_path = path[:: len(path) // 12][:-1]
        probes = torch.cat([on_path, on_path + spread(len(on_path), 0.1), goal + spread(8, 1), goal + spread(4, 10)])
        starts = torch.cat([path[:1], path[:1] + spread(2, 0.1), goal + spread(2, 10)])
        changes = (*changed, *changed_by_fit)
        return cls(factory, seed, after_fit, ds, shown, learned, changes, probes, starts)

    def __str__(self) -> str:
        return f"{type(self.ds).__name__} ({self.dim}-D, {state_of(self.after_fit)})"

    @property
    def dim(self) -> int:
        return self.shown.dim

    @property
    def few(self) -> Tensor:
        """Some probes of every kind: a rollout can cost as much as a thousand velocities."""
        return self.probes[::4]

    def hold(self, clause: Clause) -> None:
        try:
            seeded(lambda: clause(self), self.seed)
        except Exception as error:
            raise AssertionError(f"{self} breaks {clause.__name__}, “{clause.__doc__}” {cause_of(error)}") from error

    def refitted(self, shown: Demonstration, ds: StableDS | None = None) -> StableDS:
        """``ds``, or a new system, fitted from the same random state as the one under examination."""
        system = seeded(lambda: self.factory(self.dim), self.seed)[0] if ds is None else ds
        seeded(lambda: system.fit(shown), self.seed)
        return system

    def calls(self, ds: StableDS, times: Any = None) -> dict[str, Callable[[Any], Tensor]]:
        """Everything that takes points and answers, by name; a rollout is to ``times``, by default its duration."""
        times = torch.linspace(0, self.shown.duration, 3, dtype=torch.float64) if times is None else times
        calls: dict[str, Callable[[Any], Tensor]]
        calls = {"velocity": ds, "V": ds.lyapunov, "rollout": lambda y: ds.rollout(y, times)}
        if isinstance(ds, LatentDS):
            calls |= {"encode": ds.encode, "decode": ds.decode, "jacobian": ds.jacobian}
        return calls


def state_of(after_fit: bool) -> str:
    return "fitted" if after_fit else "unfitted"


_GLOBALS: dict[str, tuple[Callable[[], Any], Callable[[Any], object]]] = {
    "sets the default dtype": (torch.get_default_dtype, torch.set_default_dtype),
    "sets the thread count": (torch.get_num_threads, torch.set_num_threads),
    "sets gradient mode": (torch.is_grad_enabled, torch.set_grad_enabled),
    "seeds torch's generator": (torch.initial_seed, torch.default_generator.manual_seed),
    "moves NumPy's random state": (np.random.get_state, np.random.set_state),
    "moves Python's random state": (random.getstate, random.setstate),
}
"""What nobody may change, with how to read and how to write it. Drawing from torch's generator is allowed."""


@contextmanager
def watched() -> Iterator[list[str]]:
    """Puts global state back that its block changes, so that nothing later suffers from it, and lists it then."""
    before = {what: read() for what, (read, _) in _GLOBALS.items()}
    changed: list[str] = []
    try:
        yield changed
    finally:
        for what, (read, write) in _GLOBALS.items():
            if pickle.dumps(read()) != pickle.dumps(before[what]):
                changed.append(what)
                write(before[what])


def seeded(call: Callable[[], T], seed: int) -> tuple[T, list[str]]:
    """What ``call`` returns if torch's generator is in the state of ``seed``, and the global state that it changed."""
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(0x5EED_0000 + seed)  # not a number that a method would seed it with
        with watched() as changed:
            result = call()
    return result, changed


def expect(holds: bool, found: str) -> None:
    if not holds:
        raise AssertionError(found)


def cause_of(error: Exception) -> str:
    return str(error) if isinstance(error, AssertionError) else f"raised {type(error).__name__}: {error}"


def same(got: Tensor, wanted: Tensor, what: str, *, relative: float = 1e-9) -> None:
    expect(got.shape == wanted.shape, f"{what}: expected shape {tuple(wanted.shape)}, got {tuple(got.shape)}")
    expect(bool(torch.isfinite(got).all()), f"{what}: expected finite numbers")
    if not got.numel():
        return
    gap, scale = float((got - wanted).detach().abs().max()), float(wanted.detach().abs().max())
    expect(gap <= relative * scale, f"{what}: off by {gap:.3g} at a scale of {scale:.3g}")
