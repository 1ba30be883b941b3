"""Interrupted runs go on where they stopped, and a cell that changed is not mistaken for the old one."""

import functools
import os
import signal
import sqlite3
import subprocess
import sys
import time

import numpy as np
import pytest
import torch

from baselines import FDM, SDSEF
from experiments import kill
from latentds import ChebyshevDS, Demonstration, datasets
from latentds.benchmark import Cell, Protocol, _key, compare, run
from latentds.store import CellStore, fingerprint

SPIRAL = datasets.unstable_spiral(1, 60)
QUICK = {"n_starts": 1, "n_points": 30, "n_jobs": 1}
TIMES = ["fit_seconds", "rollout_seconds"]


@pytest.fixture
def file(tmp_path):
    return tmp_path / "cells.sqlite"


def counting(made):
    def factory(dim):
        made.append(dim)
        return FDM(dim, n_layers=5)

    return factory


def test_a_store_gives_back_what_it_got(file):
    rows = ({"method": "a", "demonstration": "b", "seed": 0, "dtw": 0.1 + 0.2, "nan": float("nan"), "ok": True},)
    paths = np.random.default_rng(0).standard_normal((2, 5, 3))
    paths[0] = np.nan
    with CellStore(file) as store:
        assert store.get("key") is None
        store.put("key", rows, paths)
        store.put("key", ({**rows[0], "dtw": 7.0},), paths)  # the first stays
    with CellStore(file) as store:
        found, moved = store.get("key")
        assert store.keys() == {"key"}
        assert len(store) == 1
    assert repr(found) == repr(rows)
    assert np.array_equal(moved, paths, equal_nan=True)


def test_a_second_run_computes_nothing_and_gives_the_same_rows(file):
    first = compare({"FDM": counting([]), "Chebyshev": ChebyshevDS}, SPIRAL, store=file, **QUICK)
    made = []
    again = compare({"FDM": counting(made), "Chebyshev": ChebyshevDS}, SPIRAL, store=file, **QUICK)
    assert len(made) == 1  # to know its settings, not to fit
    assert first.equals(again)  # times included: they are the first run's
    without = compare({"FDM": counting([]), "Chebyshev": ChebyshevDS}, SPIRAL, **QUICK)
    assert first.drop(columns=TIMES).equals(without.drop(columns=TIMES))


def test_paths_come_back(file):
    cells = [Cell("FDM", lambda dim: FDM(dim, n_layers=5), SPIRAL)]
    (first,) = run(cells, Protocol(n_starts=1), n_jobs=1, store=file)
    (again,) = run(cells, Protocol(n_starts=1), n_jobs=1, store=file)
    assert np.array_equal(first.paths, again.paths)


def test_a_run_that_stops_keeps_what_it_has(file):
    methods = {str(i): (lambda dim, i=i: FDM(dim, n_layers=i)) for i in range(1, 7)}
    cells = [Cell(label, factory, SPIRAL) for label, factory in methods.items()]
    outcomes = run(cells, Protocol(**{k: QUICK[k] for k in ("n_starts", "n_points")}), n_jobs=1, store=file)
    seen = {next(outcomes).method, next(outcomes).method}
    outcomes.close()
    with CellStore(file) as store:
        assert len(store) == len(seen) == 2
    whole = compare(methods, SPIRAL, store=file, **QUICK)
    assert list(whole["method"].unique()) == list("123456")


def test_failures_are_tried_again(file):
    broken = {"now": True}

    def factory(dim):
        ds = FDM(dim, n_layers=5)
        if broken["now"]:
            ds.fit = lambda demonstration: 1 / 0
        return ds

    def refuse(dim):
        raise RuntimeError("cannot even be made")

    methods = {"FDM": factory, "none": refuse}
    assert list(compare(methods, SPIRAL, store=file, **QUICK)["status"]) == ["failed"] * 4
    broken["now"] = False
    assert list(compare(methods, SPIRAL, store=file, **QUICK)["status"]) == ["ok"] * 2 + ["failed"] * 2


def test_everything_that_changes_a_result_changes_its_key():
    demonstration = Demonstration(SPIRAL.positions, SPIRAL.dt, "a")
    base = Cell("m", lambda dim: SDSEF(dim, n_layers=2, n_features=10), demonstration)
    keys = [
        _key(cell, protocol)
        for cell, protocol in [
            (base, Protocol()),
            (Cell("other", base.factory, demonstration), Protocol()),
            (Cell("m", lambda dim: SDSEF(dim, n_layers=3, n_features=10), demonstration), Protocol()),
            (
                Cell("m", lambda dim: SDSEF(dim, n_layers=2, n_features=10, recipe="official"), demonstration),
                Protocol(),
            ),
            (Cell("m", lambda dim: SDSEF(dim, n_layers=2, n_features=10, seed=1), demonstration), Protocol()),
            (Cell("m", lambda dim: FDM(dim), demonstration), Protocol()),
            (Cell("m", lambda dim: FDM(dim, beta=0.4), demonstration), Protocol()),
            (Cell("m", lambda dim: FDM(dim, mu=0.8), demonstration), Protocol()),
            (Cell("m", base.factory, Demonstration(SPIRAL.positions + 1e-15, SPIRAL.dt, "a")), Protocol()),
            (Cell("m", base.factory, Demonstration(SPIRAL.positions, 2 * SPIRAL.dt, "a")), Protocol()),
            (Cell("m", base.factory, Demonstration(SPIRAL.positions, SPIRAL.dt, "b")), Protocol()),
            (Cell("m", base.factory, demonstration, 1), Protocol()),
            (base, Protocol(n_starts=19)),
            (base, Protocol(radius=0.2)),
            (base, Protocol(n_points=400)),
        ]
    ]
    assert len(set(keys)) == len(keys)
    same = Cell("m", lambda n: SDSEF(n, n_features=10, n_layers=2), Demonstration(SPIRAL.positions, SPIRAL.dt, "a"))
    assert _key(same, Protocol()) == keys[0]


class Slots:
    __slots__ = ("a",)

    def __init__(self, a):
        self.a = a


def test_fingerprints_tell_values_apart_and_know_them_again():
    def things():
        loop = []
        loop.append(loop)
        return [
            None, True, 1, 1.0, 1 + 0j, "1", b"1", (1,), [1], {1: 2}, {2: 1}, {1, 2}, {"b", "a", "c"}, loop,
            Slots(1), Slots(2),
            torch.float32, torch.float64, torch.tensor([1.0]), torch.tensor([1.0], dtype=torch.float64), np.float64(1),
            np.zeros((2, 3)), np.zeros((3, 2)), functools.partial(int, 1), functools.partial(int, 2), len, max,
            lambda x: x + 1, lambda x: x + 2, Slots, torch.nn.Linear, np,
        ]  # fmt: skip

    hashes = [fingerprint(thing) for thing in things()]
    assert len(set(hashes)) == len(hashes)
    assert hashes == [fingerprint(thing) for thing in things()]


def test_fingerprints_do_not_depend_on_the_process():
    code = """
import torch
from baselines import SDSEF
from latentds.store import fingerprint
torch.manual_seed(0)
print(fingerprint(SDSEF(3, n_layers=2, n_features=10), {"b", "a", "c"}))"""
    found = {
        subprocess.run(
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": seed},
        ).stdout
        for seed in "12"
    }
    assert len(found) == 1


def test_a_file_of_another_kind_is_refused(file):
    file.write_text("rows\n" * 1000)
    with pytest.raises(ValueError, match=r"^store: expected a file of finished cells"):
        compare({"FDM": FDM}, SPIRAL, store=file, **QUICK)
    assert file.read_text() == "rows\n" * 1000
    file.unlink()
    with sqlite3.connect(file) as other:
        other.execute("CREATE TABLE theirs (x)")
    with pytest.raises(ValueError, match=r"^store: expected a file of finished cells"):
        CellStore(file)
    with pytest.raises(ValueError, match=r"^store: expected a file of finished cells"):
        CellStore(file.parent / "nowhere" / "cells.sqlite")


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
def test_killed_runs_lose_nothing():
    kill.main(kills=3, seed=1, n_seeds=8)


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
def test_ctrl_c_ends_with_what_is_done(file):
    code = f"""
from experiments import kill
try: kill.work({str(file)!r}, 2, 60)
except KeyboardInterrupt: print("interrupted")"""
    child = subprocess.Popen(
        [sys.executable, "-c", code], start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    kill._wait_for_more_than(3, file, child)
    os.killpg(child.pid, signal.SIGINT)  # as a terminal does
    began = time.monotonic()
    out, err = child.communicate(timeout=60)
    assert out == b"interrupted\n", err
    assert b"Traceback" not in err
    assert time.monotonic() - began < 30
    with CellStore(file) as store:
        assert 3 < len(store) < len(kill.cells(60))
