"""
Around an obstacle, and within limits
=====================================

Left: no motion enters the discs, and all arrive. Right: none passes the dotted walls, though what was shown does.
"""

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from latentds import TubeDS, datasets, plotting
from latentds.modulation import AvoidingDS, BoundedDS, sphere

shown = datasets.drawn("wave", n_points=300)
ds = TubeDS(2).fit(shown)
discs = [sphere(shown.positions[135], 0.2), sphere(shown.positions[230] + 0.1, 0.12)]
top = float(shown.positions[:, 1].max()) - 0.25
bounded = BoundedDS(ds, [-1.3, -1.5], [1.3, top], margin=0.1)
starts = shown.start + 0.12 * torch.randn(12, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
times = torch.linspace(0, 3 * shown.duration, 400, dtype=torch.float64)

figure = Figure(figsize=(10, 4.8), layout="constrained")
for axes, system in zip(figure.subplots(1, 2), (AvoidingDS(ds, discs), bounded), strict=True):
    plotting.field(system, shown, axes)
    with torch.no_grad():
        plotting.motions(system.rollout(starts, times), shown, axes, label="TubeDS")
    axes.set_aspect("equal")
for disc in discs:
    figure.axes[0].add_patch(Circle(tuple(disc.center.tolist()), float(disc.half_axes[0]), color="#999999", zorder=3))
figure.axes[1].axhline(top, color="#222222", ls=":")
