"""
A tube of several demonstrations
================================

Four people's ways of one stroke: the tube is as wide as they are apart, and its pull as gentle as theirs.
"""

import torch

from latentds import Demonstration, TubeDS, datasets, plotting

stroke = datasets.drawn("wave", n_points=200)
fade = torch.linspace(1, 0, len(stroke), dtype=torch.float64).unsqueeze(-1)
offsets = torch.tensor([[0.0, 0.3], [0.05, 0.1], [-0.05, -0.15], [0.0, -0.35]], dtype=torch.float64)
shown = [Demonstration(stroke.positions + fade * offset, stroke.dt, f"try {i}") for i, offset in enumerate(offsets)]
ds = TubeDS(2).fit(shown)
between = torch.stack([one.start for one in shown]) + torch.tensor([0.0, 0.08])
with torch.no_grad():
    paths = ds.rollout(between, stroke.times)
figure = plotting.vector_field(ds, shown, paths, "TubeDS")
