"""Parameters and buffers of any number of rows: layers, components, knots, which a fit or a file decides."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn


def resize(tensor: Tensor, count: int) -> None:
    """Give a tensor (m, ...) so many rows, of 0; it stays the same object, so that an optimiser keeps hold of it."""
    tensor.data = tensor.data.new_zeros((count, *tensor.shape[1:]))


@torch.no_grad()
def assign(module: nn.Module, values: Mapping[str, Any]) -> None:
    """Give parameters or buffers of ``module`` new values of any number of rows, on its device and in its dtype."""
    for name, value in values.items():
        tensor: Tensor = getattr(module, name)
        new = torch.as_tensor(value).to(tensor)
        if len(new) != len(tensor):
            resize(tensor, len(new))
        tensor.copy_(new)


def make_room(module: nn.Module, state_dict: Mapping[str, Tensor], prefix: str, names: Iterable[str]) -> None:
    """Give the named tensors as many rows as those that are about to be loaded have; ``_load_from_state_dict`` asks.

    What differs in more than the number of rows, or has none, is left for torch to refuse.
    """
    for name in names:
        tensor, loaded = getattr(module, name), state_dict.get(prefix + name)
        if loaded is not None and loaded.ndim == tensor.ndim and loaded.shape[1:] == tensor.shape[1:] and len(loaded):
            resize(tensor, len(loaded))
