"""
A stroke and its field
======================

What a fit makes of a stroke of the pen: a velocity everywhere in the plane.
"""

import torch

from latentds import TubeDS, datasets, plotting

shown = datasets.drawn("ess", n_points=300)
ds = TubeDS(2).fit(shown)
starts = shown.start + torch.tensor([[0.0, 0.0], [0.3, 0.2], [0.4, -0.4], [-0.3, 0.3], [0.2, -1.5]])
with torch.no_grad():
    paths = ds.rollout(starts, shown.times)
figure = plotting.vector_field(ds, shown, paths, "TubeDS")
