"""
The same field in C
===================

A system as one C99 header, compiled here with a loop of Euler steps around it, and drawn over Python's own motion.
"""

import ctypes
import subprocess
import tempfile
from pathlib import Path

import numpy as np
import torch

from latentds import TubeDS, datasets, plotting
from latentds.deploy import c

shown = datasets.drawn("curl", n_points=300)
ds = TubeDS(2).fit(shown)
folder = Path(tempfile.mkdtemp())
c.write(ds, folder / "curl.h", name="curl")
(folder / "move.c").write_text("""
#include "curl.h"
void move(double *path, int steps, double dt) {
    for (int k = 1; k < steps; k++) {
        double v[curl_DIM];
        curl_velocity(path + (k - 1) * curl_DIM, v);
        for (int d = 0; d < curl_DIM; d++) path[k * curl_DIM + d] = path[(k - 1) * curl_DIM + d] + dt * v[d];
    }
}
""")
command = ["cc", "-std=c99", "-O2", "-shared", "-fPIC", "move.c", "-o", "move.so", "-lm"]
subprocess.run(command, cwd=folder, check=True)
path = np.empty((6000, 2))
path[0] = shown.start
move = ctypes.CDLL(str(folder / "move.so")).move
move(path.ctypes.data_as(ctypes.c_void_p), len(path), ctypes.c_double(0.001))
assert np.abs(path[-1] - shown.goal.numpy()).max() < 0.01
figure = plotting.vector_field(ds, shown, torch.from_numpy(path[None, ::20]), "in C")
