"""
A certificate that fails, on purpose
====================================

A plain network follows what it was shown and promises nothing elsewhere. The certificate finds a start that shows it.
"""

import torch

from baselines import BehaviourCloning
from latentds import certify, datasets, plotting

shown = datasets.drawn("wave", n_points=200)
ds = BehaviourCloning(2, seed=0, epochs=150).fit(shown)
certificate = certify(ds, n_samples=100)
print(certificate)
assert not certificate.holds

# %%
# Motions from around the path: some never arrive.

starts = shown.start + 0.5 * torch.randn(8, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
with torch.no_grad():
    paths = ds.rollout(starts, 2 * shown.times)
figure = plotting.vector_field(ds, shown, paths, "BehaviourCloning", margin=0.6)
