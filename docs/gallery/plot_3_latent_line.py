"""
The latent line
===============

ψ maps a straight line onto the demonstration. Seen through its inverse, every motion is simple: along the line
and toward it, in any dimension.
"""

import torch
from matplotlib.figure import Figure

from latentds import TubeDS, datasets, plotting

shown = datasets.unstable_spiral(3, n_points=300)
ds = TubeDS(3).fit(shown)
near = 0.05 * torch.randn(10, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
with torch.no_grad():
    paths = ds.rollout(shown.start + near, shown.times)

figure = Figure(figsize=(9, 4.2), layout="constrained")
plotting.motions(paths, shown, figure.add_subplot(1, 2, 1, projection="3d"), label="TubeDS")
plotting.embedding(ds, shown, paths, figure.add_subplot(1, 2, 2))
