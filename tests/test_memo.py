"""What is kept stays right: by content, by owner, in copies and across modes."""

from __future__ import annotations

import copy
import pickle

import torch
from torch import nn

from latentds.kernels.private import tensors_of
from latentds.memo import Memo


class Counted:
    def __init__(self, tensors):
        self.tensors, self.calls = tensors, 0

    def __call__(self):
        self.calls += 1
        return sum(float(tensor.sum()) for tensor in self.tensors)


def test_computed_once_until_a_value_changes_however_it_was_edited():
    one, two = torch.zeros(3), nn.Parameter(torch.ones(2))
    memo, count = Memo(), Counted([one, two])
    for _ in range(3):
        assert memo.of(None, [one, two], count) == 2
    assert count.calls == 1
    one.data[0] = 5  # no version counter moves
    assert memo.of(None, [one, two], count) == 7
    two.detach().numpy()[1] = 2
    assert memo.of(None, [one, two], count) == 8
    assert memo.of("another owner", [one, two], count) == 8
    assert count.calls == 4


def test_not_a_number_is_never_taken_for_the_same():
    tensor = torch.tensor([float("nan")])
    memo, count = Memo(), Counted([tensor])
    memo.of(None, [tensor], count), memo.of(None, [tensor], count)
    assert count.calls == 2


def test_copies_are_empty_and_what_is_kept_has_no_graph():
    weight = nn.Parameter(torch.ones(2))
    memo = Memo()
    kept = memo.of(None, [weight], lambda: 2 * weight)
    assert not kept.requires_grad
    for twin in (copy.deepcopy(memo), pickle.loads(pickle.dumps(memo))):
        assert twin.of(None, [weight], lambda: "anew") == "anew"


def test_what_inference_mode_found_serves_training():
    memo, weight = Memo(), nn.Parameter(torch.ones(2))
    with torch.inference_mode():
        kept = memo.of(None, [weight], lambda: 2 * weight)
    assert memo.of(None, [weight], lambda: None) is kept
    (kept * weight).sum().backward()
    assert torch.equal(weight.grad, torch.full((2,), 2.0))


def test_every_tensor_of_a_module_once():
    module = nn.Sequential(nn.BatchNorm1d(2), nn.Linear(2, 1, bias=False))
    wanted = [*module.parameters(), *module.buffers()]
    assert {id(tensor) for tensor in tensors_of(module)} == {id(tensor) for tensor in wanted}
    assert len(tensors_of(module)) == len(wanted)


def test_another_dtype_or_number_of_tensors_is_a_change():
    one = torch.ones(2)
    memo, count = Memo(), Counted([one])
    memo.of(None, [one], count)
    memo.of(None, [one.double()], count)  # equal in value
    memo.of(None, [one.double(), one], count)
    assert count.calls == 3


def test_what_has_no_content_is_computed_every_time():
    nowhere = torch.ones(2, device="meta")
    memo, calls = Memo(), []
    for _ in range(2):
        memo.of(None, [nowhere], lambda: calls.append(1))
    assert len(calls) == 2
