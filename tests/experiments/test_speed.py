"""The arithmetic of the speed study, and that what it races computes the same."""

from __future__ import annotations

import sys

import pandas as pd
import pytest
import torch

from experiments import speed
from latentds import ChebyshevDS


@pytest.fixture(scope="module")
def ds():
    return ChebyshevDS(3, n_layers=20).fit(speed.SHOWN).requires_grad_(False)


def test_the_loops_compute_what_the_kernels_compute(ds):
    layers, x = speed.layers_of(ds), speed.latent_points(ds, 50)
    y = ds.decode(x)
    torch.testing.assert_close(speed.forward_loop(layers, x), y)
    torch.testing.assert_close(speed.inverse_loop(layers, y)[0], x)
    torch.testing.assert_close(speed.velocity_loop(layers, y, lambda x: ds.dynamics(x, x, ds.frame())), ds(y))


def test_exponents_of_a_power_law():
    sizes = [100, 200, 400, 800, 1600]
    curves = pd.DataFrame(
        [("N", "fit", size, 3e-6 * size**1.5) for size in sizes], columns=["grows", "call", "size", "seconds"]
    )
    (row,) = speed.exponents(curves).itertuples(index=False)
    assert row[:4] == ("N", "fit", 200, 1600)
    assert row.exponent == pytest.approx(1.5)


def test_without_zuko_a_sentence_says_so_and_torch_func_is_raced(ds, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "zuko.flows", None)
    assert ["torch.func" in goal.what for goal in speed.rivals(ds, 1)] == [True, True]
    assert "pip install zuko" in capsys.readouterr().out
