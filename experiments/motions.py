"""The motions that the studies show: spirals, handwriting and recordings from files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from latentds import Demonstration, datasets
from latentds.readers import READERS


def spirals(quick: bool) -> list[Demonstration]:
    """The paper's ten; three of theirs if ``quick``."""
    if quick:
        return [datasets.unstable_spiral(3), datasets.unstable_spiral(7), datasets.stable_spiral(2)]
    return datasets.spiral_suite()


def spiral(name: str, n_points: int = 1000, slowest: float = 1e-2) -> Demonstration:
    """The spiral of that name, "unstable c=7"."""
    family, c = name.split(" c=")
    if family == "unstable":
        return datasets.unstable_spiral(float(c), n_points)
    return datasets.stable_spiral(float(c), n_points, slowest=slowest)


def handwriting() -> dict[str, list[Demonstration]]:
    """{shape: its seven demonstrations, named by it} of LASA handwriting; empty where that is not installed."""
    try:
        return {name: [replace(d, name=name) for d in datasets.lasa(name)] for name in datasets.lasa_shapes()}
    except ImportError:
        return {}


def recordings(paths: Sequence[Path]) -> list[Demonstration]:
    """What the files hold, and all files of the folders that a demonstration is read from, in alphabetical order.

    Raises:
        ValueError: if there is none, one is no recording, or two have one name.
        FileNotFoundError: if there is no such file.
    """
    every = [file for path in paths for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
    files = [file for file in every if file.suffix.lower() in READERS]
    if paths and not files:
        raise ValueError(
            f"data: expected files of kind {' '.join(READERS)}, found none in {', '.join(map(str, paths))}"
        )
    found = [Demonstration.load(file) for file in files]
    if twice := [name for name, count in Counter(d.name for d in found).items() if count > 1]:
        raise ValueError(f"data: expected recordings of different names, got {twice[0]!r} again")
    return found
