"""
A tool that turns on its way
============================

Position and orientation in one motion: the tool's axes along the motion shown, and along those from three other poses.
"""

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from latentds import PoseDemonstration, PoseDS, TubeDS

share = np.linspace(0, 1, 200)
way = share**3 * (10 - 15 * share + 6 * share**2)
positions = np.stack([0.5 * way, 0.2 * np.sin(np.pi * way), 0.3 - 0.2 * way], 1)
turns = Rotation.from_euler("zx", np.stack([1.5 * way, -1.2 * way**2], 1))
shown = PoseDemonstration(positions, turns.as_quat()[:, [3, 0, 1, 2]], dt=0.02)
pose = PoseDS(TubeDS(6, n_layers=100)).fit(shown)

draw = torch.Generator().manual_seed(3)
off = torch.randn(4, 7, generator=draw, dtype=torch.float64) * torch.tensor([0.06] * 3 + [0.1] * 4)
off[0] = 0
with torch.no_grad():
    paths = pose.rollout(shown.poses[0] + off, shown.times).numpy()

figure = Figure(figsize=(8, 5.5), layout="constrained")
axes = figure.add_subplot(projection="3d")
for path, count in zip(paths, (15, 4, 4, 4), strict=True):  # of the others, how they come in
    axes.plot(*path[:, :3].T, color="#222222", lw=1)
    way = np.append(0, np.linalg.norm(np.diff(path[:, :3], axis=0), axis=1).cumsum())
    rows = path[np.searchsorted(way, np.linspace(0, way[-1], 15)[:count])]
    frames = Rotation.from_quat(rows[:, [4, 5, 6, 3]]).as_matrix()
    for axis, color in enumerate(("#D55E00", "#009E73", "#0072B2")):
        axes.quiver(*rows[:, :3].T, *frames[:, :, axis].T, length=0.04, color=color, arrow_length_ratio=0)
axes.set(xlabel="x", ylabel="y", zlabel="z", aspect="equal")
axes.locator_params(nbins=4)
axes.view_init(elev=25, azim=-115)
