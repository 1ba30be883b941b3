"""
Trained to pass a point
=======================

An optimiser moves the layers of a fitted system until its motion passes a point that nobody showed. It stays stable.
"""

import torch

from latentds import TubeDS, datasets, plotting

shown = datasets.drawn("wave", n_points=150)
ds = TubeDS(2, n_layers=40).fit(shown)
before = ds.rollout(shown.start, shown.times).detach()
via = before[75] + torch.tensor([0.0, 0.25])
optimizer = torch.optim.Adam(ds.parameters(), lr=3e-3)
for _ in range(80):
    path = ds.rollout(shown.start, shown.times)
    loss = (path - via).norm(dim=-1).min() ** 2 + 0.05 * (path - before).square().mean()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
figure = plotting.vector_field(ds, shown, path.detach().unsqueeze(0), "trained")
figure.axes[0].plot(*via.numpy(), "P", color="#0072B2", ms=12)
