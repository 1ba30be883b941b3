"""LPV-DS: stable whatever its parameters are, and its programs find what is known."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

import latentds
from baselines.lpvds import LEAST_RATE, LPVDS, LinearSystems
from latentds import Demonstration, datasets
from latentds.testing import parametrize_stable_ds, wavy_motion

pytestmark = pytest.mark.slow  # fits and integrates for each clause; `make test` runs it

pytest.importorskip("cvxpy")


def small(dim, **settings):
    return LPVDS(dim, **{"n_components": 4, "seed": 0, **settings})


@parametrize_stable_ds({"LPVDS": small}, dims=[2])
def test_contract(check):
    check()


@parametrize_stable_ds({"LPVDS": small}, dims=[1, 7])
def test_contract_in_other_dimensions(check):
    check()


@pytest.fixture(scope="module")
def fitted():
    return small(3).fit(wavy_motion(3))


def test_the_inequality_holds_whatever_the_parameters_are(draw):
    systems = LinearSystems(4)
    systems.assign(np.eye(4), np.stack([-np.eye(4)] * 3))
    for parameter in systems.parameters():
        torch.nn.init.normal_(parameter, generator=draw)
    pulled = systems.metric() @ systems.matrices() + LEAST_RATE * systems.metric()
    assert float(torch.linalg.eigvalsh(pulled + pulled.mT).detach().max()) < 1e-9
    assert float(torch.linalg.eigvalsh(systems.metric()).detach().min()) > 0


def test_assigned_systems_come_back():
    metric = np.array([[1.0, 0.2], [0.2, 0.5]])
    matrices = np.stack([[[-1.0, 2.0], [-3.0, -1.0]], [[-0.5, 0.0], [0.1, -0.7]]])
    systems = LinearSystems(2)
    systems.assign(metric, matrices)
    torch.testing.assert_close(systems.metric().detach(), torch.from_numpy(metric))
    torch.testing.assert_close(systems.matrices().detach(), torch.from_numpy(matrices))


def test_finds_the_linear_system_that_moved():
    """One that spirals in, whose motion is known: exp(At) y₀."""
    matrix = torch.tensor([[-1.0, 3.0], [-3.0, -1.0]], dtype=torch.float64)
    start = torch.tensor([1.0, 0.5], dtype=torch.float64)
    path = torch.stack([torch.linalg.matrix_exp(t * matrix) @ start for t in torch.linspace(0, 8, 801)])
    ds = small(2, n_components=1).fit(Demonstration(path, 0.01))
    with torch.no_grad():
        slope = torch.func.jacrev(ds)(ds.attractor + 0.1)
    torch.testing.assert_close(slope, matrix, rtol=0.02, atol=0.02)


def test_v_falls_as_fast_as_promised(fitted, draw):
    y = fitted.attractor + 3 * torch.randn(300, 3, generator=draw, dtype=torch.float64)
    energy, slope = torch.func.jvp(fitted.lyapunov, (y,), (fitted(y).detach(),))
    assert bool((slope <= -2 * LEAST_RATE / fitted.duration * energy * (1 - 1e-9)).all())


def test_learns_from_several_and_is_kept(tmp_path):
    one, other = wavy_motion(2), wavy_motion(2, seed=1)
    ds, y = small(2).fit([one, other]), one.positions
    torch.testing.assert_close(ds.attractor, (one.goal + other.goal) / 2)
    with torch.no_grad():
        assert torch.equal(small(2).fit([one, other])(y), ds(y))
        ds.save(tmp_path / "ds")
        assert torch.equal(latentds.load(tmp_path / "ds", classes=[LPVDS])(y), ds(y))
        assert torch.equal(copy.deepcopy(ds)(y), ds(y))


def test_follows_a_winding_spiral():
    report = LPVDS(3, seed=0).fit(datasets.unstable_spiral(7, 500)).fit_report
    assert report.fidelity.miss < 0.08


@pytest.mark.parametrize("dim", [3, 7])
def test_learns_what_leaves_most_directions_open(dim):
    """A straight line, and a motion of an arm on which the solver once found no end."""
    way = torch.linspace(1, 0, 200, dtype=torch.float64).unsqueeze(-1)
    shown = datasets.joint_motion(3) if dim == 7 else Demonstration(way * torch.tensor([1.0, 2.0, 0.5]), 0.01)
    assert LPVDS(dim, seed=0).fit(shown).fit_report.fidelity.miss < 0.06


@pytest.mark.parametrize(("argument", "value"), [("n_components", 0), ("seed", -1)])
def test_bad_arguments_are_named(argument, value):
    with pytest.raises(ValueError, match=f"^{argument}: expected"):
        small(2, **{argument: value})


def test_matrices_that_are_kept_are_those_of_the_parameters():
    systems = LinearSystems(2)
    u = torch.ones(3, 2, dtype=torch.float64)
    for part in (systems.root, systems.turning, systems.damping):
        part.data.add_(torch.arange(part.numel(), dtype=torch.float64).view_as(part) / 10 + 0.3)
        with torch.no_grad():
            kept = systems(u)
        torch.testing.assert_close(kept, systems(u).detach())
