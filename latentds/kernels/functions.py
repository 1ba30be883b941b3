"""Operations as functions of autograd: values and first derivatives by kernels, further derivatives by torch.

One autograd function serves all operations: which way a backward pass goes, and who needs a gradient, is decided alike
for each. They differ in what :class:`Operation` names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from ..arguments import Array
from .dispatch import is_plain, no_active_transforms, reference
from .private import is_batch_of_gradients

TorchLayers = tuple[Tensor, ...]
"""What the parameters make of every layer; of locally weighted translations c (M, n), v (M, n) and ρ² (M, 1)."""


@dataclass(frozen=True)
class Operation:
    """What layers do to tensors of points and tangents, in two ways."""

    kernel: Callable[..., Tensor]
    """(layers as packed, *points) -> value"""
    by_torch: Callable[..., Tensor]
    """(:data:`TorchLayers`, *points) -> value, by operations of torch"""
    layers_of: Callable[..., TorchLayers] = lambda *parameters: parameters
    """The layers that the parameters make, by operations of torch."""
    adjoint: Callable[..., tuple[tuple[Tensor, ...], Array]] | None = None
    """(layers as packed, dloss/dvalue, value, *points) -> dloss/dpoints, dloss/d(c, v, ρ²) of the layers (M, 2n+1);
    None where torch takes first derivatives, too."""


def evaluate(operation: Operation, packed: Any, parameters: Sequence[Tensor], *points: Tensor) -> Tensor:
    """The value by the kernel, differentiable by points and parameters if that is asked.

    First derivatives run the adjoint kernel, if there is one. Those with ``create_graph``, and under torch.func, go by
    torch, once more and on the very tensors of the forward pass.
    """
    if torch.is_grad_enabled() and any(t.requires_grad for t in (*points, *parameters)):
        return _Compiled.apply(operation, packed, len(points), *points, *parameters)  # type: ignore[no-any-return,no-untyped-call]
    return operation.kernel(packed, *points)


class _Compiled(torch.autograd.Function):
    """Inputs are so many points, then the parameters."""

    @staticmethod
    def forward(ctx: Any, operation: Operation, packed: Any, n_points: int, *tensors: Tensor) -> Tensor:
        ctx.operation, ctx.packed, ctx.n_points = operation, packed, n_points
        value = operation.kernel(packed, *tensors[:n_points])
        ctx.save_for_backward(value, *tensors)
        return value

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Any:
        value, *tensors = ctx.saved_tensors
        operation, n_points, needed = ctx.operation, ctx.n_points, ctx.needs_input_grad[3:]
        again = torch.is_grad_enabled()
        plain = is_plain(gradient, value.dtype) and not is_batch_of_gradients(gradient)
        by_kernel = operation.adjoint is not None and plain and not again and no_active_transforms()
        with torch.enable_grad(), reference():
            # Views, so that the gradient for one input does not also flow through another made from it.
            inputs = [tensor.view_as(tensor) for tensor in tensors]
            points, parameters = inputs[:n_points], inputs[n_points:]
            if not by_kernel:
                value = operation.by_torch(operation.layers_of(*parameters), *points)
                return None, None, None, *_gradients(value, inputs, needed, gradient, again)
            of_points, of_layers = operation.adjoint(ctx.packed, gradient, value, *(p.detach() for p in points))
            of_parameters: list[Tensor | None] = [None] * len(parameters)
            of_own = needed[n_points:]
            if any(of_own):
                made = torch.cat(operation.layers_of(*parameters), dim=-1)
                of_parameters = _gradients(made, parameters, of_own, torch.from_numpy(of_layers).to(made), False)
        return None, None, None, *(g if n else None for g, n in zip(of_points, needed, strict=False)), *of_parameters


def _gradients(
    value: Tensor, inputs: Sequence[Tensor], needed: Sequence[bool], gradient: Tensor, again: bool
) -> list[Tensor | None]:
    """dloss/dinput of each input that needs it, None for the others; ``again`` if it is differentiated in turn."""
    asked = [tensor for tensor, n in zip(inputs, needed, strict=True) if n]
    grads = iter(torch.autograd.grad(value, asked, gradient, create_graph=again, allow_unused=True))
    return [next(grads) if n else None for n in needed]
