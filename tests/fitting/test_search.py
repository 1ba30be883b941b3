"""The search for a match: what hides a motion, a budget of layers, and the same answer on any clock and any threads."""

from __future__ import annotations

import contextlib
import itertools
import re
import subprocess
import sys
import time
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

from latentds import Demonstration, FitWarning, TubeDS
from latentds.findings import what_hides
from latentds.fitting import search
from latentds.methods import tube
from tests.motions import planar_spiral


def wave(count=400):
    """A path in space, (N, 3), of size 2."""
    t = np.linspace(0, 1, count)
    return np.stack([2 * t, 0.4 * np.sin(6 * np.pi * t), 0.2 * np.cos(5 * t)], 1)


def noisy(path, share):
    return path + share * 2 * np.random.default_rng(0).standard_normal(path.shape)


def in_steps(path, share):
    return share * 2 * np.round(path / (share * 2))


@pytest.mark.parametrize(
    ("spoil", "told"),
    [(noisy, "noise of ([0-9.]+) of its size hides"), (in_steps, "recorded in steps of ([0-9.]+) of")],
)
def test_what_hides_the_motion_is_told_with_its_size(spoil, told):
    for share in (0.03, 0.05):
        shown = Demonstration(spoil(wave(), share), 0.01)
        # The noise of a point is the median length of three coordinates' noise; a step is one coordinate's.
        expected = share * 2 / shown.size * (1.54 if spoil is noisy else 1)
        assert float(re.match(told, str(what_hides(shown.positions.numpy(), 0.02)))[1]) == pytest.approx(
            expected, rel=0.1
        )
    assert what_hides(spoil(wave(), 0.005), 0.02) is None
    assert what_hides(wave(), 0.02) is what_hides(wave(9), 0.02) is None


@pytest.mark.slow
@pytest.mark.parametrize("spoil", [noisy, in_steps])
def test_a_fit_to_a_blurred_recording_says_so_and_searches_no_deeper(spoil, monkeypatch):
    monkeypatch.setattr(search.Search, "_deeper", None)
    shown = Demonstration(spoil(wave(), 0.05), 0.01)
    with pytest.warns(FitWarning) if spoil is noisy else contextlib.nullcontext():
        ds = TubeDS(3, refined=False).fit(shown)
    assert ds.fit_report.notes[0] == str(what_hides(shown.positions.numpy(), 0.02))
    assert ds.fit_report.n_layers <= search.PLAN.n_layers


def test_a_search_that_has_laid_its_layers_says_so(monkeypatch):
    monkeypatch.setattr(tube, "PLAN", replace(search.PLAN, layer_budget=1))
    with pytest.warns(FitWarning):
        notes = TubeDS(2, refined=False).fit(planar_spiral(1.5)).fit_report.notes
    assert notes[0].startswith("no match tried follows the path closely; its strands come within ")
    assert notes[1] == "the search for a match stopped after 1000 layers"


def test_neither_a_clock_nor_threads_change_a_fit(monkeypatch):
    """A motion that is searched deeper for: every clock leaps by an hour at each look, and two threads may be used."""
    shown, leaps, threads = planar_spiral(1.5, 300), itertools.count(step=3600.0), torch.get_num_threads()
    monkeypatch.setattr(tube, "PLAN", replace(search.PLAN, layer_budget=4000))
    states = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", FitWarning)
                states.append(TubeDS(2, refined=False).fit(shown).state_dict())
            for name in ("time", "perf_counter", "monotonic", "process_time", "thread_time"):
                monkeypatch.setattr(time, name, lambda: next(leaps))
    finally:
        torch.set_num_threads(threads)
    assert states[0].keys() == states[1].keys()
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())


@pytest.mark.slow
def test_seven_busy_processes_change_no_fit():
    def fitted():
        return TubeDS(2, n_layers=40).fit(planar_spiral(1.5, 300)).state_dict()

    alone = fitted()
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(7)]
    try:
        beside = fitted()
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert all(torch.equal(value, beside[name]) for name, value in alone.items())
