"""The loop of the training scripts: Adam, seeded, and resumable to the last bit."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn

from latentds.files import atomic_write, read_file

EVERY = 20
"""Steps between checkpoints."""


class Learned(NamedTuple):
    """What a script reached."""

    history: tuple[float, ...]
    """Loss of every step."""
    numbers: Mapping[str, float]
    """What was measured after the training, by what it is."""
    notes: str
    figure: Figure


@dataclass(frozen=True)
class Loop:
    """How long and how fast to descend.

    Attributes:
        title: of the progress bar.
        steps: >= 1.
        rate: Adam's at the start, > 0; it falls to 0 as a cosine.
        seed: of all that the loss draws.
        checkpoint: the file from which a run that was stopped goes on.
    """

    title: str
    steps: int
    rate: float
    seed: int
    checkpoint: Path

    def run(self, module: nn.Module, loss: Callable[[torch.Generator], Tensor]) -> tuple[float, ...]:
        """Train the module; the loss of every step.

        The checkpoint holds module, optimiser, schedule and generator, so that a run that was killed takes the very
        steps that it would have taken. A finished run is not repeated.

        Raises:
            ValueError: if the checkpoint is damaged, or that of another run.
            FloatingPointError: if the loss is not finite; the checkpoint stays as it was.
        """
        adam = torch.optim.Adam(module.parameters(), self.rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, self.steps)
        draw = torch.Generator().manual_seed(self.seed)
        history: list[float] = []
        if self.checkpoint.exists():
            kept = self._read()
            for part, name in ((module, "module"), (adam, "adam"), (schedule, "schedule")):
                part.load_state_dict(kept[name])
            draw.set_state(kept["generator"])
            history = kept["history"]
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns) as bar:
            task = bar.add_task(self.title, total=self.steps, completed=len(history))
            while len(history) < self.steps:
                adam.zero_grad()
                value = loss(draw)
                told = value.item()
                if not math.isfinite(told):
                    raise FloatingPointError(f"loss: expected a finite number at step {len(history)}, got {told}")
                value.backward()
                adam.step()
                schedule.step()
                history.append(told)
                bar.update(task, advance=1, description=f"{self.title}, loss {told:.3g}")
                if len(history) % EVERY == 0 or len(history) == self.steps:
                    parts = {
                        "module": module.state_dict(),
                        "adam": adam.state_dict(),
                        "schedule": schedule.state_dict(),
                    }
                    rest = {"generator": draw.get_state(), "history": history, "about": self._about()}
                    with atomic_write(self.checkpoint) as file:
                        torch.save(parts | rest, file)
        return tuple(history)

    def _about(self) -> dict[str, object]:
        return {"title": self.title, "steps": self.steps, "rate": self.rate, "seed": self.seed}

    def _read(self) -> dict:
        try:
            kept: dict = torch.load(io.BytesIO(read_file(self.checkpoint)), weights_only=True)
            theirs = kept["about"]
        except Exception as error:  # whatever torch makes of a damaged file
            raise ValueError(f"checkpoint: {self.checkpoint} is none of this loop's ({error})") from None
        if theirs != self._about():
            raise ValueError(
                f"checkpoint: expected {self._about()} in {self.checkpoint}, got {theirs}; take another --out"
            )
        return kept


def plain(axes: Axes) -> None:
    """Leave of the frame what carries numbers."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color="#DDDDDD", lw=0.6)
    axes.set_axisbelow(True)


def solid(axes: Any, azimuth: float) -> None:
    """Dress axes in 3-D: equal scales, few numbers."""
    axes.set(xlabel="x", ylabel="y", zlabel="z")
    axes.set_aspect("equal")
    axes.view_init(elev=25, azim=azimuth)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(3))
