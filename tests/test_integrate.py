"""The default rollout. Oracles: exact flows, scipy, finite differences; and the whole contract without a rollout."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from torch import nn

from latentds import ChebyshevDS, Learned, StableDS
from latentds.demonstration import only_one
from latentds.integrate import integrate
from latentds.testing import check_stable_ds, wavy_motion

F64 = torch.float64
ORIGIN = torch.zeros(2, dtype=F64)
TIMES = torch.linspace(0, 3, 31, dtype=F64)
TURNING = torch.tensor([[-1.0, -8.0], [8.0, -1.0]], dtype=F64)


def turning(y):
    return y @ TURNING.T


def bent(y):
    """Nonlinear, and elementwise, so that a row is rounded alike in every batch; ‖y‖² falls."""
    first, second = y.unbind(-1)
    return torch.stack([-first + 6 * second - first**3, -6 * first - second - second**3], dim=-1)


@pytest.fixture
def starts(draw):
    return torch.randn(6, 2, generator=draw, dtype=F64)


def solved(velocity, start, times):
    def of_time(_, y):
        return velocity(torch.from_numpy(y)[None])[0].numpy()

    answer = solve_ivp(of_time, (0, times[-1]), start.numpy(), "DOP853", times.numpy(), rtol=1e-12, atol=1e-14)
    assert answer.success
    return torch.from_numpy(answer.y.T)


@pytest.mark.parametrize("velocity", [turning, bent])
def test_agrees_with_scipy(velocity, starts):
    paths = integrate(velocity, starts, TIMES, ORIGIN)
    for path, start in zip(paths, starts, strict=True):
        assert (path - solved(velocity, start, TIMES)).abs().max() < 1e-8 * start.norm()


def test_agrees_with_the_matrix_exponential(draw):
    spread = torch.randn(7, 7, generator=draw, dtype=F64)
    matrix = spread - spread.T - torch.diag(torch.linspace(0.5, 20, 7, dtype=F64))
    attractor, starts = torch.randn(2, 3, 7, generator=draw, dtype=F64).mul(5)[0, 0], torch.randn(4, 7, dtype=F64)
    flow = torch.linalg.matrix_exp(TIMES[:, None, None] * matrix)
    exact = attractor + torch.einsum("tij,bj->bti", flow, starts - attractor)
    size = (starts - attractor).norm(dim=-1).max()
    paths = integrate(lambda y: (y - attractor) @ matrix.T, starts, TIMES, attractor)
    assert (paths - exact).abs().max() < 1e-8 * size
    narrow = attractor.float()
    paths = integrate(lambda y: (y - narrow) @ matrix.T.float(), starts.float(), TIMES, narrow)
    assert paths.dtype == torch.float32
    assert (paths - exact).abs().max() < 1e-4 * size


@pytest.mark.parametrize("power", [-0.5, -1.0, 2.0])
def test_finite_and_infinite_times_of_arrival(power, starts):
    """ẏ = -‖y‖^p y: the square root's law and constant speed arrive in finite time, the cube's law never does."""
    times = torch.cat([TIMES, torch.tensor([1e3, 1e8], dtype=F64)])
    first = starts.norm(dim=-1, keepdim=True)
    exact = (first**-power + power * times).clamp(min=0) ** (-1 / power)
    paths = integrate(lambda y: -(y.norm(dim=-1, keepdim=True) ** power) * y, starts, times, ORIGIN)
    assert ((paths.norm(dim=-1) - exact) / first).abs().max() < 1.5e-8


def test_the_error_is_that_of_the_tolerance_between_steps_too(starts):
    """Many times cost no more evaluations, and the state between two steps is as good as that after one."""
    few, many = Counting(turning), Counting(turning)
    integrate(few, starts, TIMES[[0, -1]], ORIGIN)
    dense = torch.linspace(0, 3, 5000, dtype=F64)
    paths = integrate(many, starts, dense, ORIGIN)
    assert few.count == many.count < 5000
    exact = torch.einsum("tij,bj->bti", torch.linalg.matrix_exp(dense[:, None, None] * TURNING), starts)
    assert (paths - exact).abs().max() < 1e-8 * starts.norm(dim=-1).max()


class Counting:
    def __init__(self, velocity):
        self.velocity, self.count = velocity, 0

    def __call__(self, y):
        self.count += 1
        return self.velocity(y)


def test_units_do_not_matter(starts):
    def in_units(length, second):
        return integrate(lambda y: bent(y / length) * length / second, length * starts, second * TIMES, ORIGIN) / length

    assert torch.equal(in_units(2.0**10, 2.0**-7), in_units(1.0, 1.0))
    assert (in_units(1e-3, 60.0) - in_units(1.0, 1.0)).abs().max() < 1e-9 * starts.abs().max()


def test_where_the_attractor_lies_matters_only_by_rounding(starts):
    far = torch.tensor([300.0, -700.0], dtype=F64)
    moved = integrate(lambda y: bent(y - far), starts + far, TIMES, far) - far
    assert (moved - integrate(bent, starts, TIMES, ORIGIN)).abs().max() < 1e-9 * starts.norm(dim=-1).max()


def test_a_row_depends_on_no_other_row_and_on_no_other_time(starts):
    starts = starts * torch.tensor([1e-6, 1.0, 1e3, 1.0, 30.0, 1e-3], dtype=F64)[:, None]
    paths = integrate(bent, starts, TIMES, ORIGIN)
    for row, start in enumerate(starts):
        assert torch.equal(integrate(bent, start, TIMES, ORIGIN), paths[row])
    assert torch.equal(integrate(bent, starts[[4, 1]], TIMES, ORIGIN), paths[[4, 1]])
    assert torch.equal(integrate(bent, starts, TIMES[[0, 3, 3, 20]], ORIGIN), paths[:, [0, 3, 3, 20]])


def test_batches_and_times_of_every_shape(starts):
    paths = integrate(bent, starts, TIMES, ORIGIN)
    assert torch.equal(integrate(bent, starts.reshape(3, 2, 2), TIMES, ORIGIN), paths.reshape(3, 2, 31, 2))
    assert integrate(bent, starts[:0], TIMES, ORIGIN).shape == (0, 31, 2)
    assert torch.equal(integrate(bent, starts, TIMES[:1], ORIGIN), starts[:, None])
    assert torch.equal(integrate(bent, starts, torch.zeros(3, dtype=F64), ORIGIN), starts[:, None].expand(6, 3, 2))
    assert torch.equal(paths[:, 0], starts)


def test_rests_at_the_attractor_and_near_it_for_any_time():
    """Also where the velocity at the attractor is 0/0, and within the attractor's own rounding."""
    attractor = torch.tensor([3.0, -1.0], dtype=F64)

    def velocity(y):
        assert not (y == attractor).all(-1).any()
        return -(y - attractor) / (y - attractor).norm(dim=-1, keepdim=True)

    start = torch.stack([attractor, attractor + 2e-15, attractor + 1]).requires_grad_()
    paths = integrate(velocity, start, torch.tensor([0.0, 1e9], dtype=F64), attractor)
    assert torch.equal(paths[:2, 1], start[:2])
    assert (paths[2, 1] - attractor).abs().max() < 1e-8
    assert torch.autograd.grad(paths.sum(), start)[0].isfinite().all()


@pytest.mark.parametrize("wall", [float("nan"), float("inf")])
def test_a_row_that_is_not_finite_stops_no_other(wall, starts):
    """The third row runs into a wall at 0.5, the fourth starts behind one, the fifth is no number."""

    def velocity(y):
        return torch.where(((y - 0.5).abs() < 0.1) | (y > 1e3), wall, -y)

    starts = starts.clamp(-1, 0.2)
    starts[2], starts[3], starts[4] = 1.0, 2e3, wall
    with pytest.warns(RuntimeWarning, match=r"2 of 6 motions .* row 3 at 0 s, .* no step was short enough"):
        paths = integrate(velocity, starts, TIMES, ORIGIN)
    others = [0, 1, 5]
    assert torch.equal(paths[others], integrate(velocity, starts[others], TIMES, ORIGIN))
    assert paths[others].isfinite().all()
    before = torch.exp(-TIMES) > 0.6
    assert torch.allclose(paths[2, before], torch.exp(-TIMES[before])[:, None].expand(-1, 2), rtol=0, atol=1e-8)
    assert paths[2, ~before].isnan().all()
    assert paths[3:5, 1:].isnan().all()


def test_what_is_too_stiff_or_jumps_is_told(starts):
    jumps = {
        "stiff": lambda y: -y * torch.tensor([1e7, 1.0], dtype=F64),
        "slides along a jump": lambda y: torch.stack([-y[:, 0].sign(), -y[:, 1]], dim=-1),
    }
    for name, velocity in jumps.items():
        with pytest.warns(RuntimeWarning, match="6 of 6 motions .* 300 steps were not enough"):
            paths = integrate(velocity, starts, TIMES, ORIGIN, max_steps=300)
        assert paths[:, -1].isnan().all(), name


@pytest.mark.slow
def test_gradients_are_those_of_finite_differences(starts):
    times = TIMES[[0, 2, 9]]
    matrix = (TURNING / 4).requires_grad_()

    def of(start, matrix):
        return integrate(lambda y: y @ matrix.T - y**3, start, times, ORIGIN)

    torch.autograd.gradcheck(of, (starts[:3].requires_grad_(), matrix), atol=1e-7)


def test_gradients_are_those_of_the_flow(starts):
    times = TIMES[:11:2]
    flow = torch.linalg.matrix_exp(times[:, None, None] * TURNING)
    jacobian = torch.func.jacrev(lambda y: integrate(turning, y, times, ORIGIN))(starts[0])
    assert (jacobian - flow).abs().max() < 1e-8
    _, pushed = torch.func.jvp(lambda y: integrate(turning, y, times, ORIGIN), (starts,), (starts,))
    assert (pushed - torch.einsum("tij,bj->bti", flow, starts)).abs().max() < 1e-8


@pytest.mark.slow
def test_a_rejected_step_that_is_not_finite_spoils_no_gradient(starts):
    """ẏ = -r √y on a line; a step that is too long meets the root of a negative number."""
    rate = torch.ones(1, dtype=F64, requires_grad=True)
    met = []

    def velocity(y):
        slope = -rate * y.sqrt()
        met.append(bool(slope.isnan().any()))
        return slope

    start = starts[:, :1].abs().requires_grad_()
    paths = integrate(velocity, start, TIMES, ORIGIN[:1])
    assert any(met)
    assert ((start.sqrt() - TIMES / 2).clamp(min=0) ** 2 - paths[..., 0]).abs().max() < 1e-7
    assert all(grad.isfinite().all() for grad in torch.autograd.grad(paths.sum(), (start, rate)))


class Descent(StableDS):
    """ẏ = -(S + K) ∇U(y - y*) in units of the motion's size, S = diag(rates) > 0, K skew, V = U: all a method needs.

    U(z) = ‖z‖²/2, and for ``bent`` ones + Σ z⁴/4, which is stiff where it is far away.
    """

    def __init__(self, dim, fastest=3.0, bent=False):
        super().__init__(dim)
        self.fastest, self.bent = fastest, bent
        self.rates = nn.Parameter(torch.logspace(0, np.log10(fastest), dim, dtype=F64))
        self.register_buffer("size", torch.ones((), dtype=F64))

    def _learn(self, shown, progress):
        motion = only_one(shown, "Descent")
        self.attractor.copy_(motion.goal)
        self.size.fill_(motion.size)
        with torch.no_grad():
            missed = self(motion.positions) - motion.velocities
        return Learned(float(missed.square().mean()), 0)

    def forward(self, y):
        points, wanted = self._points(y)
        z = (points - self.attractor) / self.size
        slope = z + z**3 if self.bent else z
        turned = 2 * (slope.roll(1, -1) - slope.roll(-1, -1))
        return (-(self.rates * slope + turned) * self.size).to(wanted)

    def lyapunov(self, y):
        points, wanted = self._points(y)
        z = (points - self.attractor) / self.size
        return (z.square() / 2 + (z**4 / 4 if self.bent else 0)).sum(-1).to(wanted)


@pytest.mark.parametrize(
    ("settings", "dim", "fitted"),
    [
        ({}, 1, [False, True]),
        pytest.param({}, 7, [True], marks=pytest.mark.slow),
        pytest.param({"bent": True}, 3, [True], marks=pytest.mark.slow),
        pytest.param({"fastest": 100.0}, 2, [True], marks=pytest.mark.slow),
    ],
    ids=["linear, 1-D", "linear, 7-D", "bent", "stiff"],
)
def test_fit_forward_and_lyapunov_make_a_method(settings, dim, fitted):
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        check_stable_ds(lambda dim: Descent(dim, **settings), dims=[dim], fitted=fitted)


def test_the_default_rollout_is_the_closed_form_where_there_is_one():
    shown = wavy_motion(3)
    ds = ChebyshevDS(3, n_layers=20).fit(shown)
    times = torch.linspace(7, 7 + 1.5 * shown.duration, 40)
    with torch.no_grad():
        default, closed = StableDS.rollout(ds, shown.start, times), ds.rollout(shown.start, times)
    assert (default - closed).abs().max() < 1e-6 * shown.size


def test_the_first_point_is_y0_bit_for_bit_in_every_dtype(draw):
    y0 = torch.randn(4, 2, generator=draw, dtype=F64)
    for ds in (Descent(2), Descent(2).to(torch.float32)):
        for start in (y0, y0.float()):
            paths = ds.rollout(start, torch.tensor([5.0, 6.0]))
            assert paths.dtype == start.dtype
            assert torch.equal(paths[:, 0], start)
