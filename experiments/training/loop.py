"""The loop of the training scripts: Adam, seeded, and resumable to the last bit."""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from torch import Tensor, nn

from latentds.files import atomic_write, read_file

STEPS_PER_CHECKPOINT = 20


class Learned(NamedTuple):
    """What a script reached."""

    history: tuple[float, ...]
    """Loss of every step."""
    numbers: Mapping[str, float]
    """What was measured after the training, by what it is."""
    notes: str
    figure: Figure


class Loop(NamedTuple):
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
        parts: dict[str, Any] = {"module": module, "adam": adam, "schedule": schedule}
        history: list[float] = []
        if self.checkpoint.exists():
            state = self._read()
            for name, part in parts.items():
                part.load_state_dict(state[name])
            draw.set_state(state["generator"])
            history = state["history"]
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns) as bar:
            task = bar.add_task(self.title, total=self.steps, completed=len(history))
            while len(history) < self.steps:
                adam.zero_grad()
                value = loss(draw)
                number = value.item()
                if not math.isfinite(number):
                    raise FloatingPointError(f"loss: expected a finite number at step {len(history)}, got {number}")
                value.backward()
                adam.step()
                schedule.step()
                history.append(number)
                bar.update(task, advance=1, description=f"{self.title}, loss {number:.3g}")
                if len(history) % STEPS_PER_CHECKPOINT == 0 or len(history) == self.steps:
                    state = {name: part.state_dict() for name, part in parts.items()}
                    state |= {"generator": draw.get_state(), "history": history, "about": self._about()}
                    with atomic_write(self.checkpoint) as file:
                        torch.save(state, file)
        return tuple(history)

    def _about(self) -> dict[str, object]:
        return {name: value for name, value in self._asdict().items() if name != "checkpoint"}

    def _read(self) -> dict:
        try:
            state: dict = torch.load(io.BytesIO(read_file(self.checkpoint)), weights_only=True)
            about = state["about"]
        except Exception as error:  # whatever torch makes of a damaged file
            raise ValueError(f"checkpoint: {self.checkpoint} is none of this loop's ({error})") from None
        if about != (mine := self._about()):
            raise ValueError(f"checkpoint: expected {mine} in {self.checkpoint}, got {about}; take another --out")
        return state


def solid(axes: Any, azimuth: float) -> None:
    """Dress axes in 3-D: equal scales, few numbers."""
    axes.set(xlabel="x", ylabel="y", zlabel="z")
    axes.set_aspect("equal")
    axes.view_init(elev=25, azim=azimuth)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_major_locator(MaxNLocator(3))
