"""
A Lyapunov function
===================

V falls along every motion: its contours show why there is no other way to end than at the goal.
"""

import numpy as np
import torch
from matplotlib.figure import Figure

from latentds import TubeDS, datasets

shown = datasets.drawn("hook", n_points=300)
ds = TubeDS(2).fit(shown)
x, y = np.linspace(-1.6, 1.2, 120), np.linspace(-1.5, 1.5, 120)
places = torch.from_numpy(np.stack(np.meshgrid(x, y), axis=-1))
with torch.no_grad():
    energy, velocity = ds.lyapunov(places).numpy(), ds(places).numpy()

figure = Figure(figsize=(5.6, 5.6), layout="constrained")
axes = figure.add_subplot()
axes.contourf(x, y, np.sqrt(energy), levels=24, cmap="Blues_r", alpha=0.8)
axes.streamplot(x, y, velocity[..., 0], velocity[..., 1], color="white", linewidth=0.5, arrowsize=0.7)
axes.plot(*shown.positions.T.numpy(), color="#D55E00", lw=2)
axes.set_aspect("equal")
