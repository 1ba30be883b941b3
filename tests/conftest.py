"""What several test files share."""

from __future__ import annotations

import copy
from collections.abc import Callable

import pytest
import torch

from baselines import FDM, SDSEF
from latentds import ChebyshevDS, StableDS, TubeDS
from latentds.testing import wavy_motion

torch.set_num_threads(1)  # pytest-xdist gives every core a worker; more threads than that only wait for each other

METHODS = {
    "ChebyshevDS": lambda dim: ChebyshevDS(dim, n_layers=40, beta=0.7, mu=0.8),
    "FDM": lambda dim: FDM(dim, n_layers=40),
    "TubeDS": lambda dim: TubeDS(dim, n_layers=40, contraction=7.0, refined=False),
    "SDSEF": lambda dim: SDSEF(dim, n_layers=4, n_features=20, seed=0, epochs=50),
}


@pytest.fixture
def draw() -> torch.Generator:
    return torch.Generator().manual_seed(7)


@pytest.fixture(scope="session")
def fitted() -> Callable[[str, int], StableDS]:
    """``fitted("TubeDS", 3)``: a small system fitted to ``wavy_motion(3)``, once a session; each caller has a copy."""
    kept: dict[tuple[str, int], StableDS] = {}

    def give(method: str, dim: int) -> StableDS:
        if (method, dim) not in kept:
            kept[method, dim] = METHODS[method](dim).fit(wavy_motion(dim))
        return copy.deepcopy(kept[method, dim])

    return give


@pytest.fixture(params=METHODS)
def method(request: pytest.FixtureRequest) -> str:
    """Every method by its name."""
    name: str = request.param
    return name
