"""Every method keeps the public contract, in every dimension, before and after a fit."""

from __future__ import annotations

import pytest

from baselines import FDM
from latentds import ChebyshevDS
from latentds.testing import check_stable_ds

METHODS = {
    "ChebyshevDS": lambda dim: ChebyshevDS(dim, n_layers=30),
    "FDM": lambda dim: FDM(dim, n_layers=30),
}


@pytest.mark.parametrize("fitted", [False, True], ids=["unfitted", "fitted"])
@pytest.mark.parametrize("dim", [1, 2, 3, 7])
@pytest.mark.parametrize("method", METHODS)
def test_contract(method, dim, fitted):
    check_stable_ds(METHODS[method], dims=[dim], fitted=[fitted])
