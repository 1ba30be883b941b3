"""
The goal moved, and a tube
==========================

The object stands elsewhere: the motion is turned and scaled to fit, and is as stable as before. Lines beside the
latent one show how the surroundings of the path bend with it.
"""

import torch
from matplotlib.figure import Figure

from latentds import TubeDS, datasets, plotting

shown = datasets.drawn("hook", n_points=300)
ds = TubeDS(2).fit(shown)
figure = Figure(figsize=(10, 4.8), layout="constrained")
left, right = figure.subplots(1, 2)
for shift in ([0.5, 0.2], [0.2, -0.6], [-0.6, -0.3]):
    moved = ds.with_start_and_goal(shown.start, shown.goal + torch.tensor(shift))
    with torch.no_grad():
        plotting.motions(moved.rollout(shown.start, 1.5 * shown.times), shown, left, label="TubeDS")
    left.plot(*moved.attractor.numpy(), "*", color="#E69F00", ms=12)
for radius in (0.03, 0.06, 0.09):
    plotting.tube(ds, shown, right, radius=radius)
for axes in (left, right):
    axes.set_aspect("equal")
