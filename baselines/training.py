"""The one loop for methods that learn by gradient: batches, schedule, early stop, recovery from divergence."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor, nn

from latentds.arguments import Array
from latentds.fitting.lbfgs import minimize

MAX_RECOVERIES = 25


@dataclass(frozen=True)
class Plan:
    """How to descend, with Adam.

    Attributes:
        epochs: passes over the samples, >= 1.
        learning_rate: > 0, at its highest.
        n_batches: random batches an epoch, >= 1.
        warm_up: share of all steps in [0, 1) over which the rate rises from 0; it then falls to 0 as a cosine.
            None keeps the rate constant.
        weight_decay: Adam's L2 penalty, >= 0.
        clip: largest norm of the gradient.
        patience: epochs without a new best after which to stop.
        slack: a batch whose loss is above 4 best + slack has diverged.
    """

    epochs: int
    learning_rate: float
    n_batches: int = 1
    warm_up: float | None = None
    weight_decay: float = 0.0
    clip: float = math.inf
    patience: int = sys.maxsize
    slack: float = math.inf

    def rate(self, step: int) -> float:
        """Learning rate at a step, counted from 0."""
        if self.warm_up is None:
            return self.learning_rate
        total = self.epochs * self.n_batches
        rising = max(1.0, self.warm_up * total)
        done = min(1.0, max(0.0, (step - rising) / max(1.0, total - rising)))
        return self.learning_rate * min((step + 1) / rising, (1 + math.cos(math.pi * done)) / 2)


class Training(NamedTuple):
    """What a descent did."""

    history: tuple[float, ...]
    """Mean loss over the batches of each epoch; epochs that diverged are left out."""
    notes: tuple[str, ...]
    n_parts: int = 0
    """What the report tells as ``n_layers``: components of a mixture."""


def descend(
    loss: Callable[[Tensor], Tensor],
    parameters: Sequence[nn.Parameter],
    n_samples: int,
    plan: Plan,
    *,
    generator: torch.Generator | None = None,
    progress: bool | str = False,
) -> Training:
    """Minimise the mean of ``loss`` over samples; the parameters are left as they entered the best epoch.

    A gradient that is not finite, or a diverged batch, brings back the best parameters and continues from there with a
    fresh Adam and 0.6 of the rate.

    Args:
        loss: (b,) sample indices -> (), the mean loss over them.
        parameters: what to move.
        n_samples: how many samples there are, >= 1.
        plan: how.
        generator: draws the batches (torch's global one if None).
        progress: show a bar on the terminal, with this title if it is one.

    Raises:
        ValueError: if the loss is not finite at the start already.
    """
    parameters = list(parameters)
    device = parameters[0].device
    entered = [p.detach().clone() for p in parameters]
    best_parameters = [p.detach().clone() for p in parameters]
    best, best_epoch, slow, recoveries, step = math.inf, 0, 1.0, 0, 0
    history: list[float] = []
    notes: list[str] = []
    adam = _adam(parameters, plan)
    with _bar(plan.epochs, progress) as advance:
        for epoch in range(plan.epochs):
            _copy(entered, parameters)
            losses = []
            step = epoch * plan.n_batches
            for batch in torch.randperm(n_samples, generator=generator).tensor_split(plan.n_batches):
                if not len(batch):
                    continue
                adam.zero_grad()
                with torch.enable_grad():
                    value = loss(batch.to(device))
                value.backward()  # type: ignore[no-untyped-call]
                norm = nn.utils.clip_grad_norm_(parameters, plan.clip)
                losses.append(float(value.detach()))
                if not (math.isfinite(losses[-1]) and bool(torch.isfinite(norm))):
                    losses.append(math.inf)
                if losses[-1] > 4 * best + plan.slack or losses[-1] == math.inf:
                    break
                for group in adam.param_groups:
                    group["lr"] = slow * plan.rate(step)
                adam.step()
                step += 1
            else:
                history.append(math.fsum(losses) / len(losses))
                if history[-1] < best:
                    best, best_epoch = history[-1], epoch
                    _copy(best_parameters, entered)
                advance(best)
                if epoch - best_epoch >= plan.patience:
                    notes.append(f"stopped early at epoch {epoch + 1} of {plan.epochs}, best at {best_epoch + 1}")
                    break
                continue
            if not history:
                raise ValueError("loss: expected a finite loss and gradient at the start, got NaN or inf")
            recoveries += 1
            if recoveries > MAX_RECOVERIES:
                notes.append(f"gave up at epoch {epoch + 1} of {plan.epochs}: diverged {recoveries} times")
                break
            _copy(parameters, best_parameters)
            adam, slow = _adam(parameters, plan), 0.6 * slow
            advance(best)
    _copy(parameters, best_parameters)
    if recoveries:
        notes.append(f"recovered from {min(recoveries, MAX_RECOVERIES)} divergences")
    return Training(tuple(history), tuple(notes))


def descend_smoothly(
    loss: Callable[[], Tensor], parameters: Mapping[nn.Parameter, float], iterations: int
) -> tuple[float, ...]:
    """Minimise a smooth loss of all samples at once by L-BFGS; the parameters end where it ends.

    Args:
        loss: () -> (), of the parameters as they are; float64.
        parameters: what to move, and by how much at a time, > 0: where steps of such lengths change the loss about
            equally, L-BFGS does not get stuck.
        iterations: at most, >= 1.

    Returns:
        The loss after each iteration.
    """
    moved = list(parameters)
    sizes = [p.numel() for p in moved]
    steps = torch.cat([torch.full((p.numel(),), step, dtype=p.dtype) for p, step in parameters.items()])

    def assign(flat: Array) -> None:
        values = torch.split(torch.from_numpy(flat) * steps, sizes)
        _copy(moved, [value.view_as(p) for value, p in zip(values, moved, strict=True)])

    def evaluate(flat: Array) -> tuple[float, Array]:
        assign(flat)
        with torch.enable_grad():
            value = loss()
            slopes = torch.autograd.grad(value, moved)
        return float(value.detach()), (torch.cat([slope.flatten() for slope in slopes]) * steps).numpy()

    begin = (torch.cat([p.detach().flatten() for p in moved]) / steps).numpy()
    minimum = minimize(evaluate, begin, steps=iterations, least_change=1e-8)
    assign(minimum.at)
    return minimum.history


def _adam(parameters: Sequence[nn.Parameter], plan: Plan) -> torch.optim.Adam:
    return torch.optim.Adam(parameters, plan.learning_rate, weight_decay=plan.weight_decay, foreach=True)


@torch.no_grad()
def _copy(targets: Sequence[Tensor], sources: Sequence[Tensor]) -> None:
    for target, source in zip(targets, sources, strict=True):
        target.copy_(source)


@contextmanager
def _bar(total: int, shown: bool | str) -> Iterator[Callable[[float], None]]:
    """A function to call after every epoch with the best loss; lines on stderr where rich is not installed."""
    title = shown if isinstance(shown, str) else "learning"
    if not shown:
        yield lambda best: None
        return
    try:
        from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
    except ImportError:
        done = 0

        def line(best: float) -> None:
            nonlocal done
            done += 1
            if done % max(1, total // 10) == 0:
                print(f"{title}: epoch {done}/{total}, best loss {best:.4g}", file=sys.stderr)

        yield line
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.completed}/{task.total} epochs"))
    with Progress(*columns, TimeRemainingColumn()) as bar:
        task = bar.add_task(title, total=total)
        yield lambda best: bar.update(task, advance=1, description=f"{title}, best loss {best:.4g}")
