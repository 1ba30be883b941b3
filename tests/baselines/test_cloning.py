"""Behaviour cloning: it learns the velocities, and keeps of the contract what needs no stability."""

from __future__ import annotations

import pytest
import torch

import latentds
from baselines.cloning import BehaviourCloning
from latentds import Demonstration
from latentds.testing import parametrize_stable_ds, wavy_motion

pytestmark = pytest.mark.slow  # fits and integrates for each clause; `make test` runs it

PROMISES_NOTHING = {
    "check_equilibrium": "a regression of velocities has no equilibrium at the goal",
    "check_descent": "no function is made to fall",
    "check_convergence": "motions need not end at the goal",
    "check_fall": "no function is made to fall",
    "check_dtypes": "it ends with the rest at the goal, in float32; the types themselves are tested below",
}


def small(dim, **settings):
    return BehaviourCloning(dim, **{"n_units": 24, "seed": 0, "epochs": 40, **settings})


@parametrize_stable_ds({"BehaviourCloning": small}, dims=[2], expected_failures={"BehaviourCloning": PROMISES_NOTHING})
def test_contract(check):
    check()


@parametrize_stable_ds({"BehaviourCloning": small}, dims=[7], expected_failures={"BehaviourCloning": PROMISES_NOTHING})
def test_contract_in_other_dimensions(check):
    check()


def test_learns_the_velocities_in_their_units():
    shown = wavy_motion(3)
    ds = small(3, epochs=150).fit(shown)
    with torch.no_grad():
        error = ds(shown.positions) - shown.velocities
    assert ds.fit_report.mse == pytest.approx(float(error.square().mean()))
    assert ds.fit_report.mse < 0.02 * float(shown.velocities.square().mean())


@pytest.mark.parametrize(("size", "pace"), [(1e-3, 1.0), (1000.0, 60.0)])
def test_units_do_not_matter(size, pace):
    shown = wavy_motion(2)
    here, there = small(2).fit(shown), small(2).fit(Demonstration(size * shown.positions, pace * shown.dt))
    with torch.no_grad():
        wanted = here(shown.positions) * size / pace
        found = there(size * shown.positions)
    torch.testing.assert_close(found, wanted, rtol=0, atol=1e-3 * float(wanted.abs().max()))


def test_learns_from_several_and_is_seeded(tmp_path):
    one, other = wavy_motion(2), wavy_motion(2, seed=1)
    point = one.positions[50]
    ds = small(2).fit([one, other])
    torch.testing.assert_close(ds.attractor, (one.goal + other.goal) / 2)
    assert torch.equal(ds(point), small(2).fit([one, other])(point))
    assert not torch.equal(ds(point), small(2, seed=1).fit([one, other])(point))
    ds.save(tmp_path / "ds")
    assert torch.equal(latentds.load(tmp_path / "ds", classes=[BehaviourCloning])(point), ds(point))


def test_answers_in_the_type_of_its_input():
    ds, y = small(2), wavy_motion(2).positions
    narrow = small(2).to(torch.float32)
    with torch.no_grad():
        assert ds(y.float()).dtype == narrow(y.float()).dtype == torch.float32
        assert ds(y).dtype == narrow(y).dtype == torch.float64
        torch.testing.assert_close(narrow(y), ds(y), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("argument", "value"), [("n_units", 0), ("seed", -1), ("epochs", 0.5)])
def test_bad_arguments_are_named(argument, value):
    with pytest.raises(ValueError, match=f"^{argument}: expected"):
        small(2, **{argument: value})
