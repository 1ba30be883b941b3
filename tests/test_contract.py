"""Every method keeps the public contract, in every dimension, before and after a fit."""

from __future__ import annotations

import inspect
from contextlib import contextmanager

import pytest
import torch

import baselines
from baselines import FDM, SDSEF
from latentds import ChebyshevDS, Demonstration, StableDS, TubeDS
from latentds.testing import parametrize_stable_ds, wavy_motion

METHODS = {
    "ChebyshevDS": lambda dim: ChebyshevDS(dim, n_layers=15),
    "FDM": lambda dim: FDM(dim, n_layers=15),
    "SDSEF": lambda dim: SDSEF(dim, n_layers=3, n_features=20, epochs=10, seed=0),
    "TubeDS": lambda dim: TubeDS(dim, n_layers=15, refined=False),
}
BASELINES = {name for name, kind in vars(baselines).items() if isinstance(kind, type) and issubclass(kind, StableDS)}


@parametrize_stable_ds(METHODS, dims=[2, 3])
def test_contract(check):
    check()


@pytest.mark.slow
@parametrize_stable_ds(METHODS, dims=[1, 7])
def test_contract_in_other_dimensions(check):
    check()


@parametrize_stable_ds(
    {"neighbours": lambda dim: ChebyshevDS(dim, n_layers=15, embedding="neighbours")}, dims=[3], fitted=[True]
)
def test_contract_of_the_other_embedding(check):
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


@contextmanager
def set_while(setter, value, before):
    setter(value)
    try:
        yield
    finally:
        setter(before)


@pytest.mark.parametrize("name", [*sorted(BASELINES - set(METHODS)), *METHODS])
def test_neither_torchs_default_dtype_nor_its_threads_change_a_fit(name):
    def fitted():
        return factory(2).fit(shown).state_dict()

    kind, shown = getattr(baselines, name, FDM), wavy_motion(2)
    few = {key: value for key, value in {"epochs": 10, "seed": 0}.items() if key in inspect.signature(kind).parameters}
    factory = METHODS.get(name, lambda dim: kind(dim, **few))
    wanted = fitted()
    with set_while(torch.set_default_dtype, torch.float64, torch.float32):
        doubled = fitted()
    with set_while(torch.set_num_threads, 3 - min(torch.get_num_threads(), 2), torch.get_num_threads()):
        spread = fitted()
    for part, values in wanted.items():
        assert torch.equal(values, doubled[part]), part
        assert torch.equal(values, spread[part]), part
