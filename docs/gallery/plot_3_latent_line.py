"""
The latent line
===============

ψ maps a straight line onto the demonstration. Seen through its inverse, every motion is simple.
"""

import torch
from matplotlib.figure import Figure

from latentds import TubeDS, datasets

shown = datasets.unstable_spiral(3, n_points=300)
ds = TubeDS(3).fit(shown)
near = 0.05 * torch.randn(10, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
with torch.no_grad():
    paths = ds.rollout(shown.start + near, shown.times)
    latent = ds.encode(paths)

figure = Figure(figsize=(9, 4.2), layout="constrained")
for place, (title, curves, known) in enumerate(
    [("in space", paths, shown.positions), ("in latent space", latent, ds.encode(shown.positions).detach())]
):
    axes = figure.add_subplot(1, 2, place + 1, projection="3d")
    axes.plot(*known.T.numpy(), color="black", lw=1.5)
    for curve in curves:
        axes.plot(*curve.T.numpy(), color="#CC79A7", lw=0.8)
    axes.set_title(title)
