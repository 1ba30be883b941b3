"""A network learns, from what two cameras see, the goal with which a frozen motion meets a cup on its way."""

from __future__ import annotations

from pathlib import Path

import torch
from matplotlib.figure import Figure
from torch import Tensor, nn

from experiments.report import plain
from experiments.training.loop import Learned, Loop, solid
from latentds import TubeDS, datasets, plotting

CAMERAS = ((1.0, 0.0, 0.3), (0.0, 1.0, 0.0))
"""Where they stand, from the middle of the cups' places, at which they look."""
NOISE = 0.01
"""Standard deviation of each coordinate of a picture, at a focal length of 1."""
SPREAD = 0.2
"""Cups stand within ± this, in each coordinate, of the point that the demonstration passes when …"""
WHEN = 0.3
"""… this share of its time is over. At that time the motion shall be at the cup; nobody says which goal does it."""


def learn(quick: bool, seed: int, folder: Path) -> Learned:
    shown = datasets.stable_spiral(1)
    ds = TubeDS(shown.dim, n_layers=40 if quick else 150, refined=not quick).fit(shown).requires_grad_(False)
    middle = shown.positions[round(WHEN * (len(shown) - 1))]
    network = small_network(2 * len(CAMERAS), shown.dim, seed)

    def paths(contexts: Tensor, times: Tensor) -> Tensor:
        """The motions to the goals that the network chooses: (B, 4), (T,) -> (B, T, n)."""
        goals = ds.attractor + SPREAD * network(contexts / SPREAD)
        return torch.stack([ds.with_goal(goal).rollout(shown.start, times) for goal in goals])

    met = torch.tensor([0, WHEN * shown.duration])

    def loss(draw: torch.Generator) -> Tensor:
        cups = places(8, draw)
        reached = paths(pictures(cups, draw), met)[:, -1]
        return (reached - middle - cups).square().sum(-1).mean()

    history = Loop("context", 60 if quick else 400, 3e-2, seed, folder / "checkpoint.pt").run(network, loss)

    draw = torch.Generator().manual_seed(seed + 1)
    cups = places(200, draw)
    with torch.no_grad():
        moved = paths(pictures(cups, draw), torch.linspace(0, shown.duration, 101))
        passed = moved[:, round(WHEN * (moved.shape[1] - 1))] - middle
        ignored = ds.rollout(shown.start, met)[-1] - middle
    numbers = {
        "held-out distance from the cup, goal as demonstrated": rms(ignored - cups),
        "held-out distance from the cup, goal by the network": rms(passed - cups),
        "distance that the noise alone costs": rms_by_noise(cups),
    }
    notes = f"Root mean squares over {len(cups)} cups, each seen once. The motion itself was not trained."
    return Learned(history, numbers, notes, draw_cups(moved, passed, cups, middle))


def small_network(inputs: int, outputs: int, seed: int) -> nn.Module:
    """In float64, as systems are."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return nn.Sequential(nn.Linear(inputs, 32), nn.Tanh(), nn.Linear(32, outputs)).double()


def places(count: int, draw: torch.Generator) -> Tensor:
    """Of cups, from the middle: (count, 3)."""
    return SPREAD * (2 * torch.rand(count, 3, generator=draw, dtype=torch.float64) - 1)


def project(places: Tensor) -> Tensor:
    """What the cameras see of a place without noise, two coordinates each: (..., 3) -> (..., 4)."""
    seen = []
    for camera in torch.tensor(CAMERAS, dtype=torch.float64):
        ahead = -camera / torch.linalg.vector_norm(camera)
        right = torch.nn.functional.normalize(torch.linalg.cross(ahead, torch.eye(3).to(ahead)[2]), dim=0)
        offset = places - camera
        depth = (offset * ahead).sum(-1)
        seen += [(offset * axis).sum(-1) / depth for axis in (right, torch.linalg.cross(right, ahead))]
    return torch.stack(seen, -1)


def pictures(places: Tensor, draw: torch.Generator) -> Tensor:
    """What they do see: (B, 3) -> (B, 4)."""
    seen = project(places)
    return seen + NOISE * torch.randn(seen.shape, generator=draw, dtype=seen.dtype)


def rms(offsets: Tensor) -> float:
    return float(offsets.square().sum(-1).mean().sqrt())


def rms_by_noise(places: Tensor) -> float:
    """Of the best unbiased estimate of places from pictures (Cramér and Rao's bound)."""
    slopes = torch.func.vmap(torch.func.jacrev(project))(places)
    return float(NOISE * torch.linalg.inv(slopes.mT @ slopes).diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt())


def draw_cups(paths: Tensor, passed: Tensor, cups: Tensor, middle: Tensor) -> Figure:
    """Some motions with their cups, and the coordinates of all: where the motion was against where the cup stands."""
    colors = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00")
    figure = Figure(figsize=(9.6, 4.4), dpi=plotting.DPI, layout="constrained")
    panels = figure.add_gridspec(1, 2, width_ratios=(1.15, 1))
    space, scatter = figure.add_subplot(panels[0], projection="3d"), figure.add_subplot(panels[1])
    for i, (path, cup, color) in enumerate(zip(paths, cups + middle, colors, strict=False)):
        space.plot(*path.T, color=color, lw=1.2)
        space.plot(*cup, "o", color=color, mec=plotting.SHOWN, ms=8, label="" if i else "cup")
        space.plot(*path[-1], "*", color=color, mec=plotting.SHOWN, ms=11, label="" if i else "goal by the network")
    space.plot(*paths[0, 0], "s", color=plotting.SHOWN, ms=4, label="start")
    solid(space, -50)
    for name, marker, color, theirs, ours in zip("xyz", "o^s", colors, cups.T, passed.T, strict=False):
        scatter.plot(theirs, ours, marker, color=color, ms=3.5, alpha=0.7, label=name)
    scatter.plot([-SPREAD, SPREAD], [-SPREAD, SPREAD], color=plotting.SHOWN, lw=0.8)
    scatter.set(xlabel="cup, from the middle", ylabel="motion at the agreed time", title=f"{len(cups)} held-out cups")
    scatter.set_aspect("equal")
    scatter.legend(frameon=False)
    plain(scatter)
    figure.legend(*space.get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return figure
