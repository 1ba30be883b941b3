"""A diffeomorphism as a transform of torch.distributions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import Tensor
from torch.distributions import Transform, constraints

from .diffeomorphism import Diffeomorphism
from .kernels.dispatch import no_active_transforms
from .kernels.private import tensors_of
from .memo import Memo


def as_transform(psi: Diffeomorphism, cache_size: int = 0) -> Transform:
    """ψ as a :class:`torch.distributions.Transform` of vectors, x ↦ ψ(x), with its inverse and determinant.

    ``TransformedDistribution(base, as_transform(psi))`` is a density that is trained through ψ's parameters, which the
    transform refers to and does not copy. Points are in ψ's dtype; a base in another is refused.

    Args:
        psi: of R^n.
        cache_size: 1 keeps the last pair of x and y while ψ stays as it is, as torch's transforms do; 0 none.
    """
    if not isinstance(psi, Diffeomorphism):
        raise ValueError(f"psi: expected a Diffeomorphism, got {type(psi).__name__}")
    return _AsTransform(psi, cache_size=cache_size)


class _AsTransform(Transform):
    domain = constraints.real_vector
    codomain = constraints.real_vector
    bijective = True

    def __init__(self, psi: Diffeomorphism, cache_size: int = 0) -> None:
        self.psi = psi
        self._memo = Memo[list[Any]]()
        super().__init__(cache_size=cache_size)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _AsTransform) and other.psi is self.psi

    __hash__ = Transform.__hash__

    def __repr__(self) -> str:
        return f"as_transform({self.psi!r})"

    def with_cache(self, cache_size: int = 1) -> _AsTransform:
        return self if cache_size == self._cache_size else _AsTransform(self.psi, cache_size)

    def forward_shape(self, shape: Sequence[int]) -> Sequence[int]:
        if not shape or shape[-1] != self.psi.dim:
            raise ValueError(f"shape: expected (..., {self.psi.dim}), got {tuple(shape)}")
        return shape

    inverse_shape = forward_shape

    @property
    def _cached_x_y(self) -> tuple[Any, Any]:
        """Torch's pair of the last x and y, forgotten when ψ changes; else a training step would see an earlier ψ."""
        x, y = self._pair()
        return x, y

    @_cached_x_y.setter
    def _cached_x_y(self, pair: tuple[Any, Any]) -> None:
        self._pair()[:] = pair

    def _pair(self) -> list[Any]:
        nothing = [None, None]
        return self._memo.of(self.psi, tensors_of(self.psi), nothing.copy) if no_active_transforms() else nothing

    def _call(self, x: Tensor) -> Tensor:
        moved: Tensor = self.psi(self._own(x, "x"))
        return moved

    def _inverse(self, y: Tensor) -> Tensor:
        return self.psi.inverse(self._own(y, "y"))

    def log_abs_det_jacobian(self, x: Tensor, y: Tensor) -> Tensor:
        return self.psi.log_abs_det_jacobian(self._own(x, "x"))

    def _own(self, points: Tensor, name: str) -> Tensor:
        dtype = next((t.dtype for t in tensors_of(self.psi) if t.is_floating_point()), points.dtype)
        if points.dtype != dtype:
            raise ValueError(f"{name}: expected the diffeomorphism's {dtype}, got {points.dtype}")
        return points
