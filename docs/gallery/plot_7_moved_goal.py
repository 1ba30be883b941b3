"""
The goal moved
==============

The object stands elsewhere: the motion is turned and scaled to fit, and is as stable as before.
"""

import torch
from matplotlib.figure import Figure

from latentds import TubeDS, datasets

shown = datasets.drawn("hook", n_points=300)
ds = TubeDS(2).fit(shown)
figure = Figure(figsize=(6, 5), layout="constrained")
axes = figure.add_subplot()
axes.plot(*shown.positions.T.numpy(), color="black", lw=2, ls="--", label="shown")
for shift in ([0.5, 0.2], [0.2, -0.6], [-0.6, -0.3]):
    goal = shown.goal + torch.tensor(shift)
    moved = ds.with_start_and_goal(shown.start, goal)
    with torch.no_grad():
        path = moved.rollout(shown.start, 1.5 * shown.times)
    axes.plot(*path.T.numpy(), color="#CC79A7")
    axes.plot(*goal.numpy(), "*", color="#E69F00", ms=12)
axes.set_aspect("equal")
axes.legend(frameon=False)
