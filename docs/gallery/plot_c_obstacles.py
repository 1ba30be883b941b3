"""
Around an obstacle, and within limits
=====================================

Left: no motion enters the discs, and all arrive. Middle: none passes the dotted wall, though what was shown does.
Right: a DMP, bent by coupling terms that were learned from motions around other obstacles, keeps clear of the point in
the disc's middle. It arrives as well, but nothing says that it stays out of the disc.
"""

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from baselines import DMP, AvoidanceTerms
from latentds import Demonstration, TubeDS, datasets, plotting
from latentds.modulation import AvoidingDS, BoundedDS, sphere

shown = datasets.drawn("wave", n_points=300)
ds = TubeDS(2).fit(shown)
discs = [sphere(shown.positions[135], 0.2), sphere(shown.positions[230] + 0.1, 0.12)]
top = float(shown.positions[:, 1].max()) - 0.25
bounded = BoundedDS(ds, [-1.3, -1.5], [1.3, top], margin=0.1)
starts = shown.start + 0.12 * torch.randn(12, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
times = torch.linspace(0, 3 * shown.duration, 400, dtype=torch.float64)

around, middles = [], shown.positions[[90, 120, 150, 180]] + torch.tensor([0.03, -0.03])
for middle in middles:
    path = AvoidingDS(ds, [sphere(middle, 0.15)]).rollout(shown.start, times).detach()
    there = int((path - shown.goal).norm(dim=-1).lt(0.02).nonzero()[0]) + 1
    around.append(Demonstration(path[:there], float(times[1])))
terms = AvoidanceTerms(DMP(2).fit(shown)).learn(around, middles)

figure = Figure(figsize=(14, 4.6), layout="constrained")
panels = figure.subplots(1, 3)
for axes, system in zip(panels, (AvoidingDS(ds, discs), bounded), strict=False):
    plotting.field(system, shown, axes)
    with torch.no_grad():
        plotting.motions(system.rollout(starts, times), shown, axes, label="TubeDS")
plotting.motions(terms.rollout(starts, times, discs[0].center), shown, panels[2], label="DMP")
for axes, drawn in ((panels[0], discs), (panels[2], discs[:1])):
    for disc in drawn:
        axes.add_patch(Circle(tuple(disc.center.tolist()), float(disc.half_axes[0]), color="#999999", zorder=3))
panels[1].axhline(top, color="#222222", ls=":")
for axes, title in zip(panels, ("AvoidingDS", "BoundedDS", "DMP with coupling terms"), strict=True):
    axes.set(aspect="equal", title=title)
