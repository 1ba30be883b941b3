"""What moving, turning, scaling and slowing a system comes down to: a similarity transform, and a change of pace.

The system that wraps another, MovedDS, is in ``base``: every system makes one of itself.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from .arguments import positive, real_array
from .demonstration import Demonstration
from .deploy.tables import FieldTables
from .fidelity import Excerpt
from .kernels.dispatch import no_active_transforms

ORTHOGONAL = 1e-5
"""How far RᵀR of a rotation may be from the identity: as far as rounding to float32 leaves it, or typing it in."""
OPPOSITE = 1e-9
"""Directions whose cosine is so near to -1 are opposite: which turn is the shortest is then for rounding to say."""


class Similarity(nn.Module):
    """y = y* + s R (z - z*), and a clock that runs faster; z* and y* are the attractors before and after.

    Args:
        dim: n >= 1.

    Attributes:
        rotation: R, (n, n) buffer, orthogonal.
        scale: s, () buffer, > 0.
        speed: () buffer, > 0, seconds of the motion before in one of the motion after.
    """

    rotation: Tensor
    scale: Tensor
    speed: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.register_buffer("rotation", torch.eye(dim, dtype=torch.float64))
        self.register_buffer("scale", torch.ones((), dtype=torch.float64))
        self.register_buffer("speed", torch.ones((), dtype=torch.float64))

    def carry(self, z: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """y of z, with the attractors z* = ``before`` and y* = ``after``: (..., n) -> (..., n)."""
        return after + self.scale * _turned(z - before, self.rotation)

    def fetch(self, y: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """z of y: (..., n) -> (..., n)."""
        return before + _turned(y - after, self.rotation.mT) / self.scale

    def velocity(self, v: Tensor) -> Tensor:
        """ẏ of ż: (..., n) -> (..., n)."""
        return self.speed * self.scale * _turned(v, self.rotation)

    def fetch_motion(self, shown: Demonstration, before: Tensor, after: Tensor) -> Demonstration:
        """The demonstration z(t) that becomes ``shown``."""
        own = [part.to(self.rotation) for part in (shown.positions, before, after)]
        return replace(shown, positions=self.fetch(*own), dt=shown.dt * float(self.speed))

    def carry_excerpt(self, shown: Excerpt, before: Tensor, after: Tensor) -> Excerpt:
        """What becomes of an excerpt of a demonstration z(t)."""
        own = [part.detach().double().cpu() for part in (self.rotation, before, after)]
        scale, speed = float(self.scale), float(self.speed)
        path = own[2] + scale * (torch.tensor(shown.path, dtype=torch.float64) - own[1]) @ own[0].mT
        rows = tuple(map(tuple, path.tolist()))
        return Excerpt(rows, shown.duration / speed, scale * speed * shown.fastest, scale * shown.ruler)

    def tables(self, tables: FieldTables, before: Tensor, after: Tensor) -> FieldTables:
        """Those of the field after, where ``tables`` are those of the field before; in latent space all moves alike."""
        rotation, origin, goal = (part.detach().double().cpu().numpy() for part in (self.rotation, before, after))
        scale, speed, n = float(self.scale), float(self.speed), len(goal)
        layers, ends = tables.layers.copy(), tables.goal.copy()
        layers[:, :n] = goal + scale * (layers[:, :n] - origin) @ rotation.T
        layers[:, n : 2 * n] = scale * layers[:, n : 2 * n] @ rotation.T
        layers[:, 2 * n] /= scale**2
        ends[0] = goal + scale * (ends[0] - origin) @ rotation.T
        ends[1] = rotation @ ends[1]
        ends[2] *= scale
        return FieldTables(layers, ends, tables.along.faster(speed), tables.across.faster(speed))

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        held = {name: state_dict[prefix + name] for name in self._buffers if prefix + name in state_dict}
        try:
            if "rotation" in held:
                check_rotation(held["rotation"], *self.rotation.shape[:1])
            for name in held.keys() - {"rotation"}:
                positive(held[name], name)
        except ValueError as error:
            rest[-1].append(str(error))  # load_state_dict's list of what went wrong
            return
        super()._load_from_state_dict(state_dict, prefix, *rest)


def _turned(v: Tensor, rotation: Tensor) -> Tensor:
    """R v, not as a matrix product, which torch.autocast would take in half precision: (..., n) -> (..., n)."""
    return (rotation * v.unsqueeze(-2)).sum(-1)


def turned_onto(before: Tensor, after: Tensor) -> tuple[Tensor, Tensor]:
    """The rotation R by the least angle, (n, n), and the scale s, (), for which s R ``before`` = ``after``, both (n,).

    In float64 on the CPU. R = I + K + K²/(1 + aᵀb), K = baᵀ - abᵀ, for the directions a and b.

    Raises:
        ValueError: if one is 0, or if they are opposite in 3 or more dimensions, where many turns are as short.
    """
    ways = torch.stack([before, after]).to("cpu", torch.float64)
    lengths = torch.linalg.vector_norm(ways, dim=-1)
    a, b = ways / lengths[:, None]
    seen, dim = no_active_transforms(), len(before)
    if seen and not bool(lengths.min() > 0):
        raise ValueError("start, goal: expected two points, got one")
    together = (a * b).sum()
    eye = torch.eye(dim, dtype=torch.float64)
    if seen and float(together) < OPPOSITE - 1:
        if dim > 2:
            raise ValueError(
                "start, goal: expected a way that is not the opposite of the shown one, as no turn to it is the "
                "shortest; say which: transformed(rotation=, translation=, scale=)"
            )
        return -eye, lengths[1] / lengths[0]
    across = b[:, None] * a - a[:, None] * b
    twice = (across[:, :, None] * across).sum(1)
    return eye + across + twice / (1 + together), lengths[1] / lengths[0]


def check_rotation(rotation: Any, dim: int) -> Tensor:
    """The orthogonal matrix (dim, dim) nearest to one that is so but for rounding, in float64.

    Raises:
        ValueError: if ``rotation`` is none.
    """
    matrix = real_array(rotation, "rotation")
    if matrix.shape != (dim, dim) or not np.abs(matrix.T @ matrix - np.eye(dim)).max() <= ORTHOGONAL:
        raise ValueError(f"rotation: expected an orthogonal matrix ({dim}, {dim}), got {matrix.tolist()!r:.200}")
    left, _, right = np.linalg.svd(matrix)
    return torch.from_numpy(left @ right)
