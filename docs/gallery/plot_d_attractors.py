"""
Several attractors, told apart
==============================

Left: samples of nine motions, of which nobody said which belong together. Right: what was learned of them, a system for
each attractor; within the circles one acts alone, and its attractor is proven stable.
"""

import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from baselines import MultipleAttractors, separate
from latentds import Demonstration, datasets

shown = []
for name, end in {"hook": (-2.0, 0.0), "wave": (2.0, 0.0), "ess": (0.0, 3.0)}.items():
    stroke = datasets.drawn(name, n_points=200)
    fade = torch.linspace(0.1, 0, len(stroke), dtype=torch.float64).unsqueeze(-1)
    middle = stroke.positions - stroke.goal + torch.tensor(end)
    shown += [Demonstration(middle + at * fade, stroke.dt, f"{name} {at}") for at in (-1, 0, 1)]
positions, velocities = torch.cat([one.positions for one in shown]), torch.cat([one.velocities for one in shown])
found = separate(positions, velocities)
ds = MultipleAttractors.fit(shown)

spread = torch.randn(30, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
starts = positions[:: len(positions) // 30][:30] + 0.3 * spread
with torch.no_grad():
    paths = ds.rollout(starts, torch.linspace(0, 20, 400, dtype=torch.float64))
    ways = ds.membership(starts).argmax(-1)

figure = Figure(figsize=(10, 4.8), layout="constrained")
left, right = figure.subplots(1, 2, sharex=True, sharey=True)
for label in (-1, *range(len(found.attractors))):
    left.scatter(*positions[found.labels == label].T, s=3, color=f"C{label}" if label >= 0 else "black")
for path, way in zip(paths, ways, strict=True):
    right.plot(*path.T, color=f"C{int(way)}", lw=1)
for attractor, radius in zip(ds.attractors, ds.radii, strict=True):
    right.add_patch(Circle(tuple(attractor.tolist()), float(radius), fill=False, color="#999999", ls=":"))
for axes, ends in ((left, found.attractors), (right, ds.attractors)):
    axes.plot(*ends.T, "k*", ms=12)
    axes.set_aspect("equal")
