"""
A motion that turns
===================

Position and orientation as one system: the tool's axes along motions from where it was shown to begin, and from beside
it, turned otherwise.
"""

import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from latentds import PoseDemonstration, PoseDS, TubeDS

s = np.linspace(0, 1, 200)
positions = np.column_stack([s, 0.4 * np.sin(4 * s), 0.3 * np.cos(3 * s)])
turns = Rotation.from_euler("zyx", np.column_stack([2.0 * (1 - s), 0.8 * s, 0.5 * np.sin(3 * s)]))
shown = PoseDemonstration(positions, turns.as_quat(scalar_first=True), dt=0.02)
pose = PoseDS(TubeDS(6)).fit(shown)

turned = (Rotation.from_rotvec([1.5, 0.5, 0.0]) * turns[0]).as_quat(scalar_first=True)
first = np.concatenate([positions[0], shown.quaternions[0]])
starts = torch.from_numpy(np.stack([first, np.concatenate([positions[0] + [0.0, 0.25, 0.2], turned])]))
with torch.no_grad():
    paths = pose.rollout(starts, torch.linspace(0, 5, 200, dtype=torch.float64)).numpy()

figure = Figure(figsize=(7, 5.6), layout="constrained")
axes = figure.add_subplot(projection="3d")
axes.plot(*positions.T, "--", color="#222222", lw=1)
for path in paths:
    axes.plot(*path[:, :3].T, color="#CC79A7", lw=1.4)
    for point in path[::14]:
        tool = 0.1 * Rotation.from_quat(point[3:], scalar_first=True).as_matrix()
        for k, color in enumerate(("#D55E00", "#009E73", "#0072B2")):
            axes.plot(*np.stack([point[:3], point[:3] + tool[:, k]]).T, color=color, lw=1)
axes.set_aspect("equal")
