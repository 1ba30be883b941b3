"""The result of a computation on tensors, kept until one of their values changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, TypeVar

import torch
from torch import Tensor

T = TypeVar("T")


class Memo(Generic[T]):
    """The last result of a computation, beside copies of the tensors that it was made from.

    Tensors are compared by content, as an edit through ``.data`` leaves no other trace. Any number of threads may ask
    at once. Copies and pickles of it are empty.
    """

    def __init__(self) -> None:
        self._kept: tuple[object, list[Tensor], T] | None = None

    def of(self, owner: object, tensors: list[Tensor], compute: Callable[[], T]) -> T:
        """``compute()``, or what it gave last if ``owner`` is equal and no value of ``tensors`` has changed."""
        kept = self._kept
        if kept is None or kept[0] != owner or not all(map(torch.equal, kept[1], tensors)):
            with torch.inference_mode(False), torch.no_grad():
                kept = owner, [tensor.detach().clone() for tensor in tensors], compute()
            self._kept = kept
        return kept[2]

    def __reduce__(self) -> tuple[type[Memo[T]], tuple[()]]:
        return type(self), ()
