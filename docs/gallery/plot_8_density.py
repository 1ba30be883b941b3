"""
A density by ψ
==============

The map of a system is a normalizing flow, too: a Gaussian carried along a stroke.
"""

import numpy as np
import torch
from matplotlib.figure import Figure
from torch.distributions import Independent, Normal, TransformedDistribution

from latentds import TubeDS, as_transform, datasets

shown = datasets.drawn("ess", n_points=300)
ds = TubeDS(2).fit(shown)
with torch.no_grad():
    middle = ds.encode(shown.positions[150])
base = Independent(Normal(middle, torch.tensor([0.25, 0.25], dtype=torch.float64)), 1)
density = TransformedDistribution(base, as_transform(ds.diffeomorphism))

x, y = np.linspace(-1.5, 1.5, 150), np.linspace(-1.7, 1.7, 150)
with torch.no_grad():
    height = density.log_prob(torch.from_numpy(np.stack(np.meshgrid(x, y), axis=-1))).exp().numpy()
figure = Figure(figsize=(5.2, 5.6), layout="constrained")
axes = figure.add_subplot()
axes.contourf(x, y, height, levels=20, cmap="magma")
axes.plot(*shown.positions.T.numpy(), color="white", lw=1)
axes.set_aspect("equal")
