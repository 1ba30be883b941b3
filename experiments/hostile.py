"""What the fuzzer shows: motions of many shapes, spoiled, in every form that positions may come in."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from hypothesis import strategies as st

from baselines import FDM, SDSEF
from experiments.tampering import TAMPERINGS
from latentds import ChebyshevDS, Demonstration, StableDS, TubeDS
from latentds.arguments import Array
from latentds.curves import interpolated

SLOW = "SDS-EF"
"""Learns by gradient, so it gets a third of the others' cases."""
METHODS: dict[str, Callable[[int], StableDS]] = {
    "ChebyshevDS": lambda dim: ChebyshevDS(dim, n_layers=40),
    "FDM": lambda dim: FDM(dim, n_layers=40),
    SLOW: lambda dim: SDSEF(dim, n_layers=3, n_features=30, seed=0, epochs=100),
    "TubeDS": lambda dim: TubeDS(dim, n_layers=40, refined=False),
}
SEVERAL = (SLOW, "TubeDS")
"""Those that learn from more than one demonstration."""
Draw = np.random.Generator
ANY_DIM: dict[str, Callable[[Array, Array, Draw], Array]] = {
    "smooth": lambda t, axis, draw: (
        np.sin(2 * np.pi * (draw.uniform(0.2, 1.0, len(axis)) * t + draw.uniform(0, 1, len(axis)))) - 2 * t
    ),
    "walk": lambda t, axis, draw: np.cumsum(draw.normal(size=(len(t), len(axis))), axis=0) / math.sqrt(len(t)),
    "zigzag": lambda t, axis, draw: t * axis + 0.2 * (np.arange(len(t))[:, None] % 2) * draw.normal(size=len(axis)),
    "collinear": lambda t, axis, draw: t * axis,
    "one axis": lambda t, axis, draw: t * np.eye(len(axis))[0],
    "spiral": lambda t, axis, draw: (1 - t) * np.cos(2 * np.pi * draw.uniform(1, 8) * t + np.arange(len(axis))),
    "corners": lambda t, axis, draw: interpolated(t[:, 0], np.linspace(0, 1, 4), draw.normal(size=(4, len(axis)))),
    "loop": lambda t, axis, draw: np.cos(2 * np.pi * (t % 1) + np.arange(len(axis))),  # ends where it began
    "crossing": lambda t, axis, draw: np.sin((np.arange(len(axis)) + 1) * np.pi * 1.7 * t),
    "there and back": lambda t, axis, draw: np.minimum(t, 1.2 - t) * axis,
}
"""Curves (N, n) in as many dimensions as an axis (n,) has, over t (N, 1) from 0 to 1."""
WINDING: dict[str, Callable[[Array, Array, Draw], tuple[Array, ...]]] = {
    "planar spiral": lambda t, near, draw: _spiral(1 - 0.95 * t, 2 * np.pi * draw.uniform(2, 5) * t),
    "near circle": lambda t, near, draw: (np.cos(near), np.sin(near)),
    "near Lissajous": lambda t, near, draw: (np.sin(3 * near), np.sin(4 * near + 0.4), np.sin(5 * near + 1.1)),
    "near trefoil": lambda t, near, draw: (
        np.sin(near) + 2 * np.sin(2 * near), np.cos(near) - 2 * np.cos(2 * near), -np.sin(3 * near)
    ),
    "helix": lambda t, near, draw: (*_spiral(1.0, 2 * np.pi * draw.uniform(2, 30) * t), draw.uniform(0.5, 4) * t),
    "loop-the-loop": lambda t, near, draw: _loop_the_loop(t, draw.uniform(0.05, 0.5)),
}  # fmt: skip
"""Coordinates (N,) each of curves in a plane or in space that wind, or come back to where they began, or nearly so.

Of t (N,), from 0 to 1, and of an angle that almost comes round.
"""
SHAPES = (*ANY_DIM, *WINDING)
FLAWS: dict[str, Callable[[Array, int, Draw], Array]] = {
    "none": lambda path, middle, draw: path,
    "noise": lambda path, middle, draw: path + 10.0 ** draw.uniform(-12, -1) * draw.normal(size=path.shape),
    "pause": lambda path, middle, draw: _with(path, slice(middle, middle + max(1, len(path) // 3)), path[middle]),
    "rest at start": lambda path, middle, draw: _with(path, slice(middle), path[0]),
    "rest at end": lambda path, middle, draw: _with(path, slice(middle, None), path[-1]),
    "repeats": lambda path, middle, draw: path[np.sort(draw.integers(0, len(path), len(path)))],
    "jump": lambda path, middle, draw: _with(
        path, slice(middle, None), path[middle:] + 100 * draw.normal(size=path.shape[1])
    ),
    "near loop": lambda path, middle, draw: _with(
        path, -1, path[0] + 10.0 ** draw.uniform(-15, -3) * draw.normal(size=path.shape[1])
    ),
    "nan": lambda path, middle, draw: _not_finite(path, math.nan, middle, draw),
    "inf": lambda path, middle, draw: _not_finite(path, draw.choice([-math.inf, math.inf]), middle, draw),
    "equal": lambda path, middle, draw: _with(path, slice(draw.choice([0, len(path) // 4]), None), path[0]),
}
"""What spoils a path (N, n); ``middle`` is N // 2."""
FORMS: dict[str, Callable[[Array], Any]] = {
    "float64": torch.from_numpy,
    "float32": lambda path: torch.from_numpy(path.astype(np.float32)),
    "float16": lambda path: torch.from_numpy(path.astype(np.float16)),
    "int64": lambda path: torch.from_numpy(path.astype(np.int64)),
    "strided": lambda path: _strided(path),
    "transposed": lambda path: torch.from_numpy(np.ascontiguousarray(path.T)).T,
    "requires_grad": lambda path: torch.from_numpy(path).requires_grad_(),
    "numpy": lambda path: path,
    "list": lambda path: path.tolist(),
}


class Case(NamedTuple):
    """How to make demonstrations, and what is done to a system that follows them; all of it is drawn by hypothesis."""

    method: str
    shape: str
    flaw: str
    form: str
    n_points: int
    dim: int
    scale: float
    offset: float
    dt: float
    seed: int
    n_shown: int = 1
    apart: float = 0.0
    """How far a demonstration is from the first, in sizes; every other seed brings them together at the goal."""
    tampering: str = ""

    def shown(self) -> list[Demonstration]:
        return [Demonstration(self.positions(which), self.dt) for which in range(self.n_shown)]

    def positions(self, which: int = 0) -> Any:
        """The first motion, or one beside it, (N, n), in the form that it is handed over in."""
        draw = np.random.default_rng(self.seed)
        path = _path(self.shape, self.n_points, self.dim, draw)
        if self.flaw not in FLAWS:
            raise ValueError(f"flaw: expected one of {(*FLAWS,)}, got {self.flaw!r}")
        spoiled = FLAWS[self.flaw](path, len(path) // 2, draw)
        if which > 0:
            aside = np.random.default_rng([self.seed, which]).normal(size=self.dim)
            left = 1 - self.seed % 2 * np.linspace(0, 1, len(path))[:, None]
            spoiled = spoiled + self.apart * np.ptp(path, axis=0).max() * left * aside / np.linalg.norm(aside)
        with np.errstate(over="ignore", invalid="ignore"):
            return FORMS[self.form](self.scale * spoiled + self.offset)


def _path(shape: str, count: int, dim: int, draw: Draw) -> Array:
    t, axis = np.linspace(0, 1, count), draw.normal(size=dim)
    if shape in ANY_DIM:
        return ANY_DIM[shape](t[:, None], axis, draw)
    if shape not in WINDING:
        raise ValueError(f"shape: expected one of {SHAPES}, got {shape!r}")
    near = 2 * np.pi * (1 - 10.0 ** draw.uniform(-4, -1)) * t
    columns = np.stack(WINDING[shape](t, near, draw))
    turned = np.linalg.qr(draw.normal(size=(max(dim, len(columns)), len(columns))))[0]
    return np.asarray((turned[:dim] @ columns).T)


def _spiral(radius: Array | float, angle: Array) -> tuple[Array, Array]:
    return radius * np.cos(angle), radius * np.sin(angle)


def _loop_the_loop(t: Array, apart: float) -> tuple[Array, ...]:
    angle = 2 * np.pi * np.clip(3 * t - 1, 0, 1)
    return 3 * t + np.sin(angle), 1 - np.cos(angle), apart * t


def _with(path: Array, where: Any, value: Any) -> Array:
    spoiled = path.copy()
    spoiled[where] = value
    return spoiled


def _not_finite(path: Array, number: float, middle: int, draw: Draw) -> Array:
    """From the middle on, one sample or all that follow, in one coordinate."""
    return _with(path, (slice(middle, draw.choice([middle + 1, len(path)])), draw.integers(path.shape[1])), number)


def _strided(path: Array) -> torch.Tensor:
    wide = np.zeros((2 * len(path), 3 * path.shape[1]))
    wide[::2, ::3] = path
    return torch.from_numpy(wide)[::2, ::3]


def cases(largest: int = 5000) -> st.SearchStrategy[Case]:
    """Demonstrations with N from 3 to ``largest`` points in 1 to 10 dimensions, at scales from 1e-9 to 1e9."""
    counts = st.one_of(st.integers(3, 12), st.integers(13, 300), st.integers(301, max(301, largest)))
    return st.builds(
        Case,
        st.sampled_from([name for name in sorted(METHODS) for _ in range(1 if name == SLOW else 3)]),
        st.sampled_from(SHAPES),
        st.sampled_from([*FLAWS]),
        st.sampled_from([*FORMS]),
        counts.map(lambda count: min(count, largest)),
        st.integers(1, 10),
        st.floats(-9, 9).map(lambda power: 10.0**power),
        st.sampled_from([0.0, 0.0, 1.0, -1e3, 1e6]),
        st.sampled_from([1e-2, 1e-6, 1.0, 1e4]),
        st.integers(0, 2**32 - 1),
        st.sampled_from([1, 1, 2, 3, 4]),
        st.floats(-3, -0.3).map(lambda power: 10.0**power),
        st.sampled_from([*TAMPERINGS]),
    ).map(lambda case: case if case.method in SEVERAL else case._replace(n_shown=1))
