"""LDDMM: its flow against SciPy's and against what is known of Hamilton's equations, and that it inverts."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from baselines.lddmm import LDDMM, LandmarkFlow, even_steps
from latentds import datasets
from latentds.testing import parametrize_stable_ds, wavy_motion

pytestmark = pytest.mark.slow  # fits and integrates for each clause; `make test` runs it

METHODS = {"LDDMM": lambda dim: LDDMM(dim, n_landmarks=12, width=0.3, iterations=5)}


@parametrize_stable_ds(METHODS, dims=[2])
def test_contract(check):
    check()


@parametrize_stable_ds(METHODS, dims=[1, 3, 7], fitted=[True])
def test_contract_after_a_fit(check):
    check()


@pytest.fixture
def flow(draw):
    """Seven landmarks in space with momenta that bend their ways."""
    flow = LandmarkFlow(3, 7)
    flow.steps = even_steps(40)
    with torch.no_grad():
        flow.landmarks.normal_(generator=draw)
        flow.momenta.normal_(0, 0.5, generator=draw)
        flow.width.fill_(0.8)
    return flow.requires_grad_(False)


def test_the_flow_is_that_of_hamiltons_equations(flow, draw):
    """By SciPy, with slopes of H by autograd; a point is carried along as a landmark without momentum."""
    x = torch.randn(3, generator=draw, dtype=torch.float64)

    def slopes(_, state):
        q, p = (torch.from_numpy(half).reshape(8, 3).requires_grad_() for half in np.split(state, 2))
        along, against = torch.autograd.grad(flow.energy(q, p), (p, q))
        return torch.cat([along.flatten(), -against.flatten()]).numpy()

    q = torch.cat([flow.landmarks, x[None]]).flatten()
    p = torch.cat([flow.momenta, torch.zeros(1, 3, dtype=torch.float64)]).flatten()
    end = solve_ivp(slopes, (0, 1), torch.cat([q, p]).numpy(), rtol=1e-9, atol=1e-10).y[:, -1].reshape(16, 3)
    landmarks, momenta, carried = flow.carried(flow.landmarks, flow.momenta, x)
    np.testing.assert_allclose(landmarks, end[:7], atol=1e-6)
    np.testing.assert_allclose(momenta, end[8:15], atol=1e-6)
    np.testing.assert_allclose(carried, end[7], atol=1e-6)


def test_energy_is_constant(flow):
    end = flow.carried(flow.landmarks, flow.momenta)
    torch.testing.assert_close(flow.energy(*end), flow.energy(flow.landmarks, flow.momenta), rtol=1e-6, atol=0)


def test_a_lone_landmark_moves_straight_at_its_momentum(draw):
    flow = LandmarkFlow(2, 1)
    with torch.no_grad():
        flow.momenta.normal_(generator=draw)
        landmark, momentum = flow.carried(flow.landmarks, flow.momenta)
    torch.testing.assert_close(landmark, flow.landmarks + flow.momenta)
    torch.testing.assert_close(momentum, flow.momenta.detach())


def test_a_point_in_its_kernels_middle_goes_along(flow):
    """A landmark's own place is carried where the landmark goes."""
    torch.testing.assert_close(flow(flow.landmarks), flow.carried(flow.landmarks, flow.momenta)[0])


def test_it_inverts_and_its_slopes_are_autograds(flow, draw):
    x = torch.randn(20, 3, generator=draw, dtype=torch.float64)
    torch.testing.assert_close(flow.inverse(flow(x)), x, rtol=0, atol=1e-7)
    torch.testing.assert_close(flow.jacobian(x[0]), torch.func.jacrev(flow)(x[0]))
    back = torch.func.jacrev(flow.inverse)(flow(x[0]))
    torch.testing.assert_close(back @ flow.jacobian(x[0]), torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-6)


def test_without_newtons_step_it_inverts_as_integration_does(flow):
    """Of order 4: half the step leaves about a sixteenth."""
    gaps = []
    for count in (10, 20):
        flow.steps = even_steps(count)
        gaps.append(flow.integration_gap(flow.landmarks + 0.3))
    assert 8 < gaps[0] / gaps[1] < 40


@pytest.mark.parametrize("straight", [False, True], ids=["eigenmap", "straight line"])
def test_learns_a_stroke(straight):
    shown = datasets.drawn("wave", n_points=200)
    ds = LDDMM(2, n_landmarks=40, width=0.1, iterations=40, straight=straight).fit(shown)
    assert ds.fit_report.fidelity.follows
    assert ds.fit_report.mse < 1e-5 * shown.size**2
    assert any("differ by at most" in note for note in ds.fit_report.notes)


def test_takes_more_steps_where_the_flow_and_the_flow_back_differ():
    shown = wavy_motion(2)
    few, more = (LDDMM(2, n_landmarks=12, width=width, iterations=5).fit(shown) for width in (0.3, 0.05))
    for ds in (few, more):
        x = ds.encode(shown.positions)
        assert ds.diffeomorphism.integration_gap(x) < 2e-5 * shown.size
    assert len(more.diffeomorphism.steps) >= len(few.diffeomorphism.steps)


def test_the_nearer_of_two_widths_is_taken():
    shown = datasets.drawn("wave", n_points=50)
    tried = [LDDMM(2, n_landmarks=12, width=width, iterations=5).fit(shown) for width in (0.1, 0.3, None)]
    reached = [one.fit_report.history[4] for one in tried]
    assert reached[2] == min(reached[:2])
