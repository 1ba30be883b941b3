"""Every method keeps the public contract, in every dimension, before and after a fit."""

from __future__ import annotations

import pytest
import torch

from baselines import FDM, SDSEF
from latentds import ChebyshevDS, Demonstration, TubeDS
from latentds.testing import parametrize_stable_ds, wavy_motion

METHODS = {
    "ChebyshevDS": lambda dim: ChebyshevDS(dim, n_layers=15),
    "FDM": lambda dim: FDM(dim, n_layers=15),
    "SDSEF": lambda dim: SDSEF(dim, n_layers=3, n_features=20, epochs=10, seed=0),
    "TubeDS": lambda dim: TubeDS(dim, n_layers=15, refined=False),
}


@parametrize_stable_ds(METHODS, dims=[2, 3])
def test_contract(check):
    check()


@pytest.mark.slow
@parametrize_stable_ds(METHODS, dims=[1, 7])
def test_contract_in_other_dimensions(check):
    check()


@pytest.mark.parametrize("method", METHODS)
def test_where_the_motion_lies_does_not_matter(method):
    """Beyond the contract: ours do not mind where the origin is, to what training makes of another rounding."""
    shown, shift = wavy_motion(3), torch.tensor([8.0, -4.0, 2.0], dtype=torch.float64)
    here = METHODS[method](3).fit(shown)
    there = METHODS[method](3).fit(Demonstration(shown.positions + shift, shown.dt))
    with torch.no_grad():
        wanted = here(shown.positions)
        torch.testing.assert_close(
            there(shown.positions + shift), wanted, rtol=0, atol=1e-3 * float(wanted.abs().max())
        )


@pytest.mark.parametrize("method", METHODS)
def test_random_state_is_untouched(method):
    before = torch.get_rng_state()
    METHODS[method](2).fit(wavy_motion(2))
    assert torch.equal(before, torch.get_rng_state())
