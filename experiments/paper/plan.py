"""How much of the paper is reproduced: all of it, or a quick part."""

from __future__ import annotations

from dataclasses import dataclass

from experiments.paper import tuning
from latentds import datasets


@dataclass(frozen=True)
class Plan:
    """How much is done.

    Attributes:
        spirals, sensitive: names of spirals; the latter are varied.
        grid: of the greedy methods.
        official, tuned: SDS-EF's (L, n_f) where the paper prints none, by either recipe; ``printed`` whether its own
            are used where it does.
        official_epochs, tuned_epochs: most epochs of either recipe; None: the recipe's own.
        layers, features, epochs: SDS-EF's grid, and the epochs of its trials.
        strokes, lasa, arms: planar motions, shapes of handwriting and cases of the joint-space study.
        n_starts, n_points: of the protocol.
        quick: whether the report must say that it is not the whole.
    """

    spirals: tuple[str, ...] = tuple(d.name for d in datasets.spiral_suite(3))
    sensitive: tuple[str, ...] = ("unstable c=3", "unstable c=7", "unstable c=10", "stable c=3")
    grid: tuning.Grid = tuning.FULL
    official: tuple[int, int] = (10, 200)
    tuned: tuple[int, int] = (10, 200)
    printed: bool = True
    official_epochs: int = 5000
    tuned_epochs: int | None = None
    layers: tuple[int, ...] = (10, 20)
    features: tuple[int, ...] = (150, 300)
    epochs: int = 1000
    strokes: tuple[str, ...] = tuple(datasets.STROKES)
    lasa: tuple[str, ...] = ("GShape", "JShape", "Khamesh", "Sshape")
    arms: int = 6
    n_starts: int = 20
    n_points: int = 500
    quick: bool = False


FULL = Plan()
QUICK = Plan(
    spirals=("unstable c=1", "unstable c=7", "stable c=3"),
    sensitive=("unstable c=7",),
    grid=tuning.QUICK,
    official=(4, 40),
    tuned=(4, 60),
    printed=False,
    official_epochs=300,
    layers=(2, 4),
    features=(40,),
    epochs=100,
    strokes=("hook", "curl"),
    lasa=(),
    arms=2,
    quick=True,
)
