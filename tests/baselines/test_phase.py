"""DMP and ProMP: against the differential equation, against Gaussian conditioning, and what a phase means for both."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from baselines import DMP, ProMP
from baselines.dmp import FADING, STIFFNESS
from baselines.promp import OBSERVATION_NOISE
from latentds import Demonstration, datasets
from latentds.testing import parametrize_stable_ds, wavy_motion

pytestmark = pytest.mark.slow  # fits and integrates for each clause; `make test` runs it

METHODS = {"DMP": lambda dim: DMP(dim, n_basis=30), "ProMP": lambda dim: ProMP(dim, n_basis=20)}

NO_FIELD = {
    "check_descent": "what is proven is proven of y and its phase: off the path nothing leads to the goal",
    "check_flow": "a rollout carries its phase, the velocity of y alone is that at the nearest one",
}
NO_REST = {"check_equilibrium": "begun at its goal, a DMP makes its whole motion and is not quite back when that ends"}
NO_FALL = {"check_fall": "the motion may lead away from the goal first: the distance to it need not fall"}


@parametrize_stable_ds(METHODS, dims=[2, 3, 7], fitted=[False], expected_failures=dict.fromkeys(METHODS, NO_FIELD))
def test_contract_before_a_fit(check):
    check()


@parametrize_stable_ds(
    METHODS,
    dims=[1, 2],
    fitted=[True],
    expected_failures={"DMP": NO_FIELD | NO_REST | NO_FALL, "ProMP": NO_FIELD | NO_FALL},
)
def test_contract_where_the_motion_leads_away_from_the_goal(check):
    check()


@parametrize_stable_ds(
    METHODS, dims=[3], fitted=[True], expected_failures={"DMP": NO_FIELD | NO_REST, "ProMP": NO_FIELD}
)
def test_contract(check):
    check()


@parametrize_stable_ds(
    METHODS, dims=[7], fitted=[True], expected_failures={"DMP": NO_FIELD | NO_REST | NO_FALL, "ProMP": NO_FIELD}
)
def test_contract_of_an_arm(check):
    check()


def test_a_dmp_stays_at_its_goal_after_the_end():
    shown = wavy_motion(2)
    ds = DMP(2).fit(shown)
    later = shown.duration * torch.linspace(1.01, 10, 500, dtype=torch.float64)
    with torch.no_grad():
        away = ds.rollout(shown.start, torch.cat([torch.zeros(1), later]))[1:] - shown.goal
    assert float(away.norm(dim=-1).max()) < 2e-3 * shown.size


@pytest.fixture(params=METHODS)
def method(request):
    return METHODS[request.param]


@torch.no_grad()
def test_a_motion_goes_on_where_its_clock_stands(method):
    shown = wavy_motion(3)
    ds = method(3).fit(shown)
    times = torch.linspace(0, shown.duration, 21, dtype=torch.float64)
    starts = shown.start + torch.tensor([[0.0, 0.0, 0.0], [0.1, -0.1, 0.2]], dtype=torch.float64)
    paths = ds.rollout(starts, times)
    same = ds.resume(paths[0, 10], float(times[10]), times[10:])
    torch.testing.assert_close(same, paths[0, 10:])
    assert float((ds.rollout(paths[0, 10], times[:11]) - paths[0, 10:]).norm(dim=-1).max()) > 0.1 * shown.size


@torch.no_grad()
def test_the_velocity_on_the_path_is_the_motions(method):
    shown = wavy_motion(2)
    ds = method(2).fit(shown)
    error = ds(shown.positions) - shown.velocities
    assert float(error[5:-5].norm(dim=-1).max()) < 0.05 * float(shown.velocities.norm(dim=-1).max())
    assert float(ds(shown.goal).abs().max()) == 0.0


@torch.no_grad()
def test_several_demonstrations_are_pooled(method):
    offsets = [torch.tensor([0.1 * k, -0.05 * k], dtype=torch.float64) for k in (-1, 0, 2)]
    base = wavy_motion(2)
    left = torch.linspace(1, 0, len(base), dtype=torch.float64).unsqueeze(-1)
    shown = [Demonstration(base.positions + offset * left, base.dt) for offset in offsets]
    ds = method(2).fit(shown)
    assert torch.equal(ds.attractor, base.goal)
    torch.testing.assert_close(ds.start, torch.stack([d.start for d in shown]).mean(0))
    assert ds.fit_report.mse < (0.05 * base.size) ** 2


def test_dmp_is_its_differential_equation():
    shown = datasets.unstable_spiral(3, 400)
    ds = DMP(3, n_basis=40).fit(shown)
    weights, goal = ds.weights.detach().numpy(), ds.attractor.numpy()
    centers = np.exp(-FADING * np.linspace(0, 1, 40))
    widths = np.diff(centers)[[*range(39), 38]]

    def pull(s, state):
        y, pace = state.reshape(2, 3)
        x = np.exp(-FADING * s)
        heights = np.exp(-(((x - centers) / widths) ** 2))
        force = x * heights @ weights / heights.sum()
        return np.concatenate([pace, STIFFNESS * (STIFFNESS / 4 * (goal - y) - pace) + force])

    start = shown.start.numpy() + np.array([0.1, 0.0, -0.2])
    phases = np.linspace(0, 4, 60)
    begin = np.concatenate([start, ds.departure.numpy()])
    solved = solve_ivp(pull, (0, 4), begin, t_eval=phases, rtol=1e-9, atol=1e-10, max_step=0.01).y[:3].T
    with torch.no_grad():
        rolled = ds.rollout(torch.from_numpy(start), torch.from_numpy(phases) * ds.duration).numpy()
        held = ds.resume(torch.from_numpy(start), 0.5 * float(ds.duration), ds.duration * torch.arange(3), at_rest=True)
    assert np.abs(rolled - solved)[phases < 3].max() < 1e-5
    assert np.abs(rolled - solved).max() < 1e-4  # the force is cut off at three durations
    rest = solve_ivp(pull, (0.5, 2.5), np.append(start, np.zeros(3)), t_eval=[1.5, 2.5], rtol=1e-9, atol=1e-10)
    assert np.abs(held[1:].numpy() - rest.y[:3].T).max() < 1e-5


def test_dmp_follows_a_tight_spiral():
    shown = datasets.unstable_spiral(7)
    ds = DMP(3).fit(shown)
    with torch.no_grad():
        missed = ds.rollout(shown.start, shown.times) - shown.positions
    assert float(missed.norm(dim=-1).max()) < 0.02
    assert "begun anew half-way" in " ".join(ds.fit_report.notes)


def test_promp_is_the_conditional_mean():
    count, base = 8, wavy_motion(2, n_points=60)
    left = torch.linspace(1, 0, len(base), dtype=torch.float64).unsqueeze(-1)
    shown = [Demonstration(base.positions + left**k * torch.tensor([0.1, 0.2 * k]), base.dt) for k in (1, 2, 3)]
    ds = ProMP(2, n_basis=count).fit(shown)
    start, phases = shown[0].start + 0.3, np.array([0.0, 0.2, 0.7, 1.0, 1.5])

    def phi(s):
        heights = np.exp(-(((min(s, 1.0) - np.linspace(0, 1, count)) * (count - 1)) ** 2) / 4)
        return np.kron(heights / heights.sum(), np.eye(2))  # of the weights in the order of ds.mean

    each = np.stack([ds._weights(d).numpy().ravel() for d in shown])
    mean, doubt = each.mean(0), OBSERVATION_NOISE * max(d.size for d in shown)
    covariance = np.cov(each.T, bias=True) + doubt**2 * np.eye(2 * count)
    seen = np.concatenate([phi(0.0), phi(1.0)])
    gain = covariance @ seen.T @ np.linalg.inv(seen @ covariance @ seen.T)
    weights = mean + gain @ (np.concatenate([start, base.goal]) - seen @ mean)
    wanted = np.stack([phi(s) @ weights for s in phases])
    with torch.no_grad():
        found = ds.rollout(start, torch.from_numpy(phases) * ds.duration)
    np.testing.assert_allclose(found.numpy(), wanted, atol=1e-8)
    np.testing.assert_allclose(found[-1], base.goal, atol=1e-8)


def test_promp_cannot_go_on_after_its_end():
    ds = ProMP(2)
    with pytest.raises(ValueError, match="before the motion ends"):
        ds.resume(torch.ones(2), 1.0, torch.arange(3))
