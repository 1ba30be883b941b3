"""Private parts of torch and numba, each with the reason why no public part does: what a new version may break."""

# mypy: disable-error-code="import-untyped,no-untyped-call,attr-defined"

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

# numba.extending, which is public, gives a type of one's own its layout and its casts, but no operators.
from numba.core.typeconv import Conversion as Conversion
from numba.core.typing.templates import AbstractTemplate as AbstractTemplate
from numba.core.typing.templates import infer_global as infer_global
from numba.core.typing.templates import signature as signature
from torch import Tensor, nn
from torch._compile import _disable_dynamo
from torch.autograd import forward_ad

disable_dynamo = _disable_dynamo
"""As torch.compiler.disable, which imports all of the compiler, for a second."""


def tracing_active() -> bool:
    """Whether torch.jit.trace records; the public torch.jit.is_tracing is not typed, nor exported for type checkers."""
    return torch._C._get_tracing_state() is not None


def modes_active() -> bool:
    """Whether a torch mode sees every operation; only entering one is public."""
    return bool(torch._C._len_torch_function_stack() or torch._C._len_torch_dispatch_stack())


def function_transforms_active() -> bool:
    """Whether torch.func is at work: vmap, grad, jvp or functionalize; it does not tell in public."""
    return bool(torch._C._are_functorch_transforms_active())


def forward_mode_active() -> bool:
    """Whether derivatives are taken in forward mode; only entering a level is public."""
    return forward_ad._current_level >= 0


def is_batch_of_gradients(tensor: Tensor) -> bool:
    """Whether ``is_grads_batched=True`` made it: its type and device are those of one gradient."""
    return not torch._C._dispatch_keys(tensor).has(torch._C.DispatchKey.CPU)


def held_tensors(module: nn.Module, names: Sequence[str]) -> list[Tensor | None]:
    """Parameters or buffers of these names; None for one that torch.nn.utils.parametrize computes, as getattr would."""
    return [module._parameters.get(name, module._buffers.get(name)) for name in names]


def tensors_of(module: nn.Module) -> list[Tensor]:
    """Parameters and buffers of a module and of those in it; several times faster than ``state_dict()`` or its like."""
    held = (part for one in module.modules() for part in (one._parameters, one._buffers))
    return [tensor for part in held for tensor in part.values() if tensor is not None]


KNOWN_BY_VALUE = (bool, int, float, str, type(None), nn.Module)
OF_EVERY_MODULE = frozenset(vars(nn.Module()))
"""What torch keeps in a module, of which none is a method's name; to ask each for it takes as long as all the rest."""


def is_altered(module: nn.Module) -> bool:
    """Whether hooks, or methods set on instances, make a module or one in it compute something else than its class."""
    return structure_of(module) is None


def structure_of(module: nn.Module) -> list[object] | None:
    """The classes of a module and of those in it, with what they keep beside tensors; None if it :func:`is_altered`.

    Equal as long as no attribute is another one. What may change and stay the same object, all but numbers, strings and
    modules, has an ``object()`` in its place, which is equal to none.
    """
    found: list[object] = []
    for part in module.modules():
        own = type(part)
        if part._forward_hooks or part._forward_pre_hooks or part._backward_hooks or part._backward_pre_hooks:
            return None
        found += own, part.training
        for name, value in vars(part).items():
            if name in OF_EVERY_MODULE:
                continue
            if callable(getattr(own, name, None)):
                return None
            if name[0] != "_":
                found.append(value if isinstance(value, KNOWN_BY_VALUE) else object())
    return found


def graph_loops() -> tuple[Any, Any]:
    """``scan`` and ``while_loop``, each one node of a graph; not public yet, and imported, for a second, when asked."""
    from torch._higher_order_ops import scan, while_loop

    return scan, while_loop


def stamp_cache(kernel: Any, stamp: str) -> None:
    """Let a kernel on disk serve for this stamp alone; numba asks only for the age of the file that defines it."""
    kernel._cache._cache_file._source_stamp = stamp
