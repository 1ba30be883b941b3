"""
A Lyapunov function, and speeds
===============================

V falls along every motion: its contours show why there is no other way to end than at the goal.
"""

import torch
from matplotlib.figure import Figure

from latentds import TubeDS, datasets, plotting

shown = datasets.drawn("hook", n_points=300)
ds = TubeDS(2).fit(shown)
with torch.no_grad():
    path = ds.rollout(shown.start + 0.1, shown.times)
figure = Figure(figsize=(10, 4.6), layout="constrained")
left, right = figure.subplots(1, 2)
plotting.field(ds, shown, left, lyapunov=True)
plotting.motions(path, shown, left, label="TubeDS")
plotting.speeds(path, shown.times, shown, right, label="TubeDS").legend(frameon=False)
