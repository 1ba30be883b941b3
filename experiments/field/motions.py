"""What is shown to the methods, and what judges them: motions, each in the field's way of showing it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from experiments.compared import handwriting, recordings, spirals
from latentds import Demonstration, datasets
from latentds.arguments import whole_number

TRAINING = 4
"""Demonstrations of a shape that protocol C trains on; it is judged by the others."""
LEFT_OUT = (0, 3)
"""Which demonstrations, one at a time, leave-one-out judges by."""
TEN = ("Angle", "BendedLine", "CShape", "GShape", "Leaf_1", "NShape", "Sshape", "Spoon", "Worm", "Zshape")
"""The shapes of leave-one-out and of protocol A, and …"""
FIVE = ("Angle", "GShape", "Leaf_1", "Sshape", "Worm")
"""… those of the seeds and of the pictures: straight and bent, a loop, a cusp."""
SPIRALS = ("unstable c=3", "unstable c=7", "unstable c=15", "stable c=2", "stable c=5", "stable c=7")
N_JOINT_MOTIONS = 6
HELD_OUT, LEAVE_ONE_OUT, IN_SAMPLE, ALONE, YOURS = "C", "leave-one-out", "A", "alone", "yours"
DEFINITIONS = {
    HELD_OUT: "Protocol C (Figueroa and Billard 2018): demonstrations 1 to 4 of each of LASA's 26 shapes are shown, 5 "
    "to 7 judge, every second sample.",
    LEAVE_ONE_OUT: f"Leave-one-out: six of the seven are shown, every fourth sample, and the seventh judges; "
    f"{len(TEN)} shapes, {len(LEFT_OUT)} folds.",
    IN_SAMPLE: f"Protocol A (CONDOR, PUMA): all seven are shown, every fourth sample, and judge; {len(TEN)} shapes.",
    ALONE: f"Alone: one demonstration is shown and judges: {len(SPIRALS)} of the paper's spirals, {N_JOINT_MOTIONS} "
    f"made-up motions of seven joints, {len(datasets.STROKES)} strokes.",
    YOURS: "Yours: each recording is shown and judges.",
}


class Motion(NamedTuple):
    """One thing to learn.

    Attributes:
        name: unlike that of any other.
        protocol: a key of ``DEFINITIONS``.
        shown: demonstrations that are fitted together.
        judges: those that were kept back; in protocol A those that were shown, every tenth sample; or none.
    """

    name: str
    protocol: str
    shown: tuple[Demonstration, ...]
    judges: tuple[Demonstration, ...] = ()


def motions(quick: bool, data: Sequence[Path] = ()) -> list[Motion]:
    """All of the study's, without the handwriting where LASA is not installed; of the quick one, a few of each kind."""
    shapes = handwriting()
    chosen = {name: shapes[name] for name in (FIVE[:2] if quick else shapes) if name in shapes}
    every = [held_out(name, shape) for name, shape in chosen.items()]
    if not quick:
        ten = {name: shapes[name] for name in TEN if name in shapes}
        every += [leave_one_out(name, shape, fold) for name, shape in ten.items() for fold in LEFT_OUT]
        every += [in_sample(name, shape) for name, shape in ten.items()]
    suite = [one for one in spirals(False) if one.name in (SPIRALS[1:2] if quick else SPIRALS)]
    joints = [datasets.joint_motion(seed) for seed in range(1 if quick else N_JOINT_MOTIONS)]
    strokes = [datasets.drawn(name) for name in list(datasets.STROKES)[: 1 if quick else None]]
    every += [Motion(one.name, ALONE, (one,)) for one in (*suite, *joints, *strokes)]
    return every + [Motion(one.name, YOURS, (one,)) for one in recordings(data)]


def held_out(name: str, shape: Sequence[Demonstration]) -> Motion:
    """Protocol C."""
    thin = [thinned(one, 2) for one in shape]
    return Motion(f"{name} 4", HELD_OUT, tuple(thin[:TRAINING]), tuple(thin[TRAINING:]))


def leave_one_out(name: str, shape: Sequence[Demonstration], fold: int) -> Motion:
    """All demonstrations but that number, from 0."""
    if len(shape) < 2 or not whole_number(fold, "fold", at_least=0) < len(shape):
        raise ValueError(f"shape: expected 2 demonstrations or more, and number {fold} among them, got {len(shape)}")
    others = tuple(thinned(one, 4) for i, one in enumerate(shape) if i != fold)
    return Motion(f"{name} but {fold + 1}", LEAVE_ONE_OUT, others, (shape[fold],))


def in_sample(name: str, shape: Sequence[Demonstration]) -> Motion:
    """Protocol A."""
    shown, judges = ([thinned(one, stride) for one in shape] for stride in (4, 10))
    return Motion(f"{name} all", IN_SAMPLE, tuple(shown), tuple(judges))


def thinned(shown: Demonstration, stride: int) -> Demonstration:
    """Every ``stride``-th sample."""
    return replace(shown, positions=shown.positions[::stride], dt=shown.dt * stride)


def called(name: str, shown: Sequence[Demonstration]) -> list[Demonstration]:
    """Demonstrations of one name, which is then that of the cell: a progress bar has no room for seven."""
    return [replace(one, name=name) for one in shown]
