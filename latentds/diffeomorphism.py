"""Diffeomorphisms ψ of R^n, always latent -> demonstration; inverse, tangent map and determinant in closed form."""

from __future__ import annotations

import functools
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import torch
from torch import Tensor, nn

from .arguments import Array, check_precision
from .kernels import private
from .tabulated import Tabulated

Self = TypeVar("Self", bound="Diffeomorphism")
Method = TypeVar("Method", bound=Callable[..., Any])


class Invertibility(NamedTuple):
    """What makes a map invertible, checked on its parameters."""

    claim: str
    n_checked: int
    """layers"""
    margin: float
    """the least of them; the claim holds while it is above 0"""
    detail: str
    """what the margin is"""
    fold: tuple[float, ...] | None = None
    """(n,) where the map folds space, if the claim is false"""


class Diffeomorphism(Tabulated, nn.Module, ABC):
    """A smooth bijection of R^n with smooth inverse; ``forward`` maps latent -> demonstration.

    Subclasses give :meth:`forward`, :meth:`inverse`, :meth:`linearize`, :meth:`jacobian` and
    :meth:`log_abs_det_jacobian`, all over (..., n).
    """

    dim: int

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """ψ(x): (..., n) -> (..., n)."""

    @abstractmethod
    def inverse(self, y: Tensor) -> Tensor:
        """ψ⁻¹(y): (..., n) -> (..., n)."""

    @abstractmethod
    def linearize(self, y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """x = ψ⁻¹(y), and the map of tangents (..., n) -> (..., n), t ↦ J_ψ(x) t, for one sweep each way."""

    @abstractmethod
    def jacobian(self, x: Tensor) -> Tensor:
        """J_ψ(x): (..., n) -> (..., n, n)."""

    @abstractmethod
    def log_abs_det_jacobian(self, x: Tensor) -> Tensor:
        """The logarithm of the absolute determinant of J_ψ(x): (..., n) -> (...)."""

    def invertibility(self) -> Invertibility | None:
        """What proves this map invertible for the parameters that it has now; None if nothing does."""
        return None

    def inverse_box(self, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor] | None:
        """A box that holds ψ⁻¹ of all points of the box from ``low`` to ``high``, all (n,); None if none is known."""
        return None

    def _apply(self: Self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        check_precision(fn(torch.zeros((), dtype=torch.float64)).dtype)
        moved: Self = super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        return moved

    def table(self) -> Array | None:
        """The map as the velocity kernel reads it, a row (c, v, ρ², ρ²‖v‖²) per layer (M, 2n+2); None if it cannot."""
        return None


def eager_for_derivatives(method: Method) -> Method:
    """Leave the graph of torch.compile for calls whose derivative is asked: a loop there has none, or a wrong one."""
    eager = private.disable_dynamo(method)

    @functools.wraps(method)
    def call(self: nn.Module, *tensors: Tensor) -> Any:
        if torch.compiler.is_compiling() and not torch.compiler.is_exporting():
            asked = torch.is_grad_enabled() and any(t.requires_grad for t in (*tensors, *self.parameters()))
            if asked or private.function_transforms_active() or private.forward_mode_active():
                return eager(self, *tensors)  # under fullgraph=True freeze it, or call it within torch.no_grad()
        return method(self, *tensors)

    return cast(Method, call)
