"""
The paper's figure: a spiral from beside
========================================

The paper's method and ours learn one spiral on a sphere, and move from twelve starts around the demonstrated one.
"""

import torch

from latentds import ChebyshevDS, TubeDS, datasets, plotting

shown = datasets.unstable_spiral(7, n_points=400)
near = 0.1 * torch.randn(12, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
paths = {}
for label, ds in {"Chebyshev": ChebyshevDS(3, n_layers=175), "TubeDS": TubeDS(3)}.items():
    with torch.no_grad():
        paths[label] = ds.fit(shown).rollout(shown.start + near, shown.times)
figure = plotting.replications(shown, paths)
