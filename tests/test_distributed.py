"""The cells on a Dask cluster: a real scheduler, two worker processes, one of which is killed in the middle."""

import os
import signal
import time

import joblib
import pytest

from baselines import FDM
from experiments import spirals
from latentds import ChebyshevDS, compare, datasets
from latentds.benchmark import COLUMNS, Cell, RolloutProtocol, run

distributed = pytest.importorskip("distributed")

TIMES = ["fit_seconds", "rollout_seconds"]


@pytest.fixture(scope="module")
def scheduler():
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, protocol="tcp", dashboard_address=None
    ) as cluster:
        yield cluster.scheduler_address


def slowly(make):
    """By value, so that the workers need nothing of this file."""

    def factory(dim):
        time.sleep(0.2)
        return make(dim)

    return factory


METHODS = {
    "Chebyshev": slowly(lambda dim: ChebyshevDS(dim, n_layers=8)),
    "FDM": slowly(lambda dim: FDM(dim, n_layers=8)),
}
SHOWN = [datasets.unstable_spiral(c, 60) for c in (1, 3)]
SEEDS = range(5)


@pytest.mark.slow
def test_rows_equal_the_serial_runs_although_a_worker_was_killed(scheduler):
    import pandas as pd

    protocol = RolloutProtocol(n_starts=2, n_points=30)
    cells = [Cell(m, f, d, seed) for m, f in METHODS.items() for d in SHOWN for seed in SEEDS]
    serial = [row for outcome in run(cells, protocol, n_jobs=1) for row in outcome.rows]
    found, workers = [], {}
    with spirals.cluster(scheduler):
        for count, outcome in enumerate(run(cells, protocol)):
            found.extend(outcome.rows)
            if count == 4:
                workers = distributed.get_client().run(os.getpid)
                os.kill(next(iter(workers.values())), signal.SIGKILL)
    assert len(set(workers.values())) == 2
    assert os.getpid() not in workers.values()
    order = ["method", "demonstration", "seed", "start"]
    frames = [pd.DataFrame(r, columns=list(COLUMNS)).drop(columns=TIMES).sort_values(order) for r in (serial, found)]
    assert len(found) == len(cells) * 3
    assert frames[0].reset_index(drop=True).equals(frames[1].reset_index(drop=True))


@pytest.mark.slow
def test_compare_and_its_store_need_no_change(scheduler, tmp_path):
    settings = {"n_starts": 1, "n_points": 30, "store": tmp_path / "cells.sqlite"}
    with distributed.Client(scheduler), joblib.parallel_config(backend="dask"):
        rows = compare(METHODS, SHOWN, **settings)
    assert (rows["status"] == "ok").all()
    assert compare(METHODS, SHOWN, n_jobs=1, **settings).equals(
        rows
    )  # from the file, written here and not by the workers
