"""The arithmetic of what is measured in processes of its own, and what those processes are given."""

from __future__ import annotations

import itertools
import subprocess
import sys

import pytest

from experiments import scale


def test_rivals_take_turns_as_often_as_their_share_asks_for():
    now, called = itertools.count(), []
    times = scale.take_turns(
        {"a": lambda: called.append("a"), "b": lambda: called.append("b")}, 3, share=2.0, clock=lambda: next(now)
    )
    assert "".join(called) == "aabb" + "aabb" * 3
    assert {name: list(seconds) for name, seconds in times.items()} == {"a": [0.5] * 3, "b": [0.5] * 3}


def test_children_have_one_thread_or_the_default_whatever_this_process_has(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    told = "import os; print(os.environ.get('OMP_NUM_THREADS', 0))"
    assert scale.child(told) == [1]
    assert scale.child(told, {}) == [0]


def test_a_child_that_fails_ends_the_study():
    with pytest.raises(subprocess.CalledProcessError):
        scale.child("raise SystemExit(1)")


@pytest.mark.skipif(sys.platform != "linux", reason="memory is read where Linux tells it")
def test_peak_memory_stays_after_what_took_it_is_gone():
    before, after = scale.child("from experiments.scale import peak; print(peak()); b'1' * 10**8; print(peak())")
    assert after > before + 90


def test_a_store_of_many_cells_and_a_new_one_are_held_against_each_other():
    goals = scale.stored(20, 3)
    assert [goal.what.partition(" a store")[0] for goal in goals] == ["write to", "read from"]
    assert all(goal.met is not None for goal in goals)


def test_without_dask_a_sentence_says_so(monkeypatch, capsys):
    monkeypatch.setattr(scale.importlib.util, "find_spec", lambda name: None)
    assert scale.on_dask(1) == []
    assert "latentds[distributed]" in capsys.readouterr().out
