"""
A process, and a cycle
======================

Left: paths of a stochastic system learned from seven strokes, drawn without error of a time step, and its mean motion.
Right: a limit cycle learned from two turns of a motion that repeats; every motion tends to it, from inside and outside.
"""

import math

import torch
from matplotlib.figure import Figure

from baselines import ImitationFlow, LimitCycleFlow
from latentds import Demonstration, datasets

stroke = datasets.drawn("ess", n_points=200)
draw = torch.Generator().manual_seed(0)
share = torch.linspace(0, math.pi, 200, dtype=torch.float64)
rises = torch.stack([torch.sin(share), torch.sin(2 * share)], -1)
weights = 0.05 * torch.randn(7, 2, 2, generator=draw, dtype=torch.float64)
strokes = [Demonstration(stroke.positions + rises @ weight, stroke.dt) for weight in weights]
process = ImitationFlow(2, seed=0).fit(strokes)

angle = torch.linspace(0, 4 * math.pi, 301, dtype=torch.float64)
x, y = torch.cos(angle), torch.sin(angle)
turns = Demonstration(torch.stack([x + 0.3 * x.square(), 0.8 * y + 0.4 * x.square()], -1), 0.02)
cycle = LimitCycleFlow(2, seed=0).fit(turns)
starts = cycle.diffeomorphism.center + torch.tensor([[0.05, 0.0], [-1.9, 1.2], [2.0, 1.2], [0.3, -1.9], [-0.1, 0.1]])

figure = Figure(figsize=(10, 4.8), layout="constrained")
left, right = figure.subplots(1, 2)
with torch.no_grad():
    paths = process.sample(stroke.start, stroke.times, 60, seed=0)
    mean = process.rollout(stroke.start, stroke.times)
    around = cycle.rollout(starts, torch.linspace(0, 12, 800))
left.plot(*paths.permute(2, 1, 0).numpy(), color="#0072b2", lw=0.5, alpha=0.25)
left.plot(*torch.stack([one.positions for one in strokes], 1).permute(2, 0, 1).numpy(), color="#222222", lw=1)
left.plot(*mean.T.numpy(), color="#d55e00", lw=2)
right.plot(*around.permute(2, 1, 0).numpy(), color="#0072b2", lw=0.8)
right.plot(*turns.positions.T.numpy(), color="#222222", lw=2, ls="--")
for axes in (left, right):
    axes.set_aspect("equal")
