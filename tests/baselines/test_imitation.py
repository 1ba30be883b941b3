"""ImitationFlow: its process against SciPy's algebra, its density against its definition; and its limit cycle."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_continuous_lyapunov

from baselines import ImitationFlow, LimitCycleFlow
from latentds import Demonstration, StableDS, datasets
from latentds.deploy import c
from latentds.testing import parametrize_stable_ds, wavy_motion

METHODS = {"ImitationFlow": lambda dim: ImitationFlow(dim, n_layers=3, n_features=20, epochs=10, seed=0)}


@parametrize_stable_ds(METHODS, dims=[2, 3])
def test_contract(check):
    check()


@pytest.mark.slow
@parametrize_stable_ds(METHODS, dims=[1, 7])
def test_contract_in_other_dimensions(check):
    check()


def shaken(dim, draw):
    """A fitted system of which every number has then been moved, so that none of them is special."""
    ds = METHODS["ImitationFlow"](dim).fit(wavy_motion(dim))
    with torch.no_grad():
        for parameter in ds.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=draw, dtype=torch.float64))
        ds.dynamics.log_spread.fill_(math.log(0.3) / 10)
    return ds.requires_grad_(False)


def moments(ds, z, t):
    """Mean and covariance of the latent process t seconds after z, by SciPy: of dz = A z dt + C dw, CCᵀ = -s²(A+Aᵀ)."""
    A = ds.dynamics.drift().numpy() / float(ds.dynamics.duration)
    driven = -(float(ds.dynamics.spread()) ** 2) * (A + A.T)
    assert (np.linalg.eigvalsh(driven) > 0).all()
    move, stationary = expm(A * t), solve_continuous_lyapunov(A, -driven)
    return move @ z, stationary - move @ stationary @ move.T


def test_samples_have_the_moments_of_the_process(draw):
    ds, shown = shaken(3, draw), wavy_motion(3)
    times = torch.tensor([0.0, 0.05, 0.05, 0.9], dtype=torch.float64)
    paths = ds.sample(shown.start, times, 20_000, seed=0)
    assert paths.shape == (20_000, 4, 3)
    assert bool((paths[:, 0] == shown.start).all())
    assert torch.equal(paths[:, 1], paths[:, 2])
    goal = ds.encode(shown.goal)
    states = ds.encode(paths) - goal
    for k in (1, 3):
        mean, covariance = moments(ds, (ds.encode(shown.start) - goal).numpy(), float(times[k]))
        np.testing.assert_allclose(states[:, k].mean(0), mean, atol=5 * covariance.max() ** 0.5 / 140)
        np.testing.assert_allclose(np.cov(states[:, k].numpy().T), covariance, atol=0.05 * np.abs(covariance).max())


def test_samples_keep_shapes_and_draw_from_their_seed_alone(draw):
    ds, times = shaken(2, draw), torch.linspace(0, 1, 5)
    starts = wavy_motion(2).positions[:6].reshape(2, 3, 2)
    before = torch.get_rng_state()
    paths = ds.sample(starts, times, 4, seed=3)
    assert torch.equal(before, torch.get_rng_state())
    assert paths.shape == (4, 2, 3, 5, 2)
    assert torch.equal(paths, ds.sample(starts, times + 7, 4, seed=3))
    assert not torch.equal(paths, ds.sample(starts, times, 4, seed=4))
    assert ds.sample(starts.float(), times, 1, seed=0).dtype == torch.float32


@pytest.mark.parametrize("dim", [1, 2])
def test_the_density_is_one(dim, draw):
    ds, shown = shaken(dim, draw), wavy_motion(dim)
    here, dt = shown.positions[60], 0.1
    reached = ds.sample(here, [0.0, dt], 2000, seed=1)[:, 1]
    middle, width = reached.mean(0), reached.std(0)
    axis = torch.linspace(-9, 9, 361, dtype=torch.float64)
    grid = middle + width * torch.cartesian_prod(*[axis] * dim).reshape(-1, dim)
    total = ds.log_density(grid, here, dt).exp().sum() * (width * (axis[1] - axis[0])).prod()
    assert float(total) == pytest.approx(1, abs=1e-3)


def test_the_density_is_that_of_scipys_gaussian_and_autograds_determinant(draw):
    ds, shown = shaken(3, draw), wavy_motion(3)
    here, dt, goal = shown.positions[80], 0.03, ds.encode(shown.goal)
    mean, covariance = moments(ds, (ds.encode(here) - goal).numpy(), dt)
    gaussian = torch.distributions.MultivariateNormal(torch.from_numpy(mean), torch.from_numpy(covariance))
    later = shown.positions[80:90]
    volume = torch.stack([torch.linalg.slogdet(torch.func.jacrev(ds.encode)(y))[1] for y in later])
    wanted = gaussian.log_prob(ds.encode(later) - goal) + volume
    torch.testing.assert_close(ds.log_density(later, here, dt), wanted, rtol=1e-8, atol=1e-8)


def test_v_is_the_stationary_density_of_the_latent_process(draw):
    ds, y = shaken(2, draw), wavy_motion(2).positions[:50:10]
    volume = torch.stack([torch.linalg.slogdet(torch.func.jacrev(ds.encode)(row))[1] for row in y])
    forgotten = ds.log_density(y, y[0], 1e3) - volume
    torch.testing.assert_close(ds.lyapunov(y).diff(), -2 * forgotten.diff())


def test_follows_a_spiral_and_the_likelihood_grows():
    shown = datasets.stable_spiral(1, 200)
    ds = ImitationFlow(3, n_layers=6, n_features=60, epochs=300, seed=0).fit(shown)
    assert ds.fit_report.history[-1] < ds.fit_report.history[0] - 5
    with torch.no_grad():
        path = ds.rollout(shown.start, shown.times)
        error = ds(shown.positions) - shown.velocities
    assert float((path - shown.positions).norm(dim=-1).max()) < 0.05 * shown.size
    assert float(error.square().mean() / shown.velocities.square().mean()) < 0.01
    assert ds.fit_report.mse == pytest.approx(float(error.square().mean()))


def test_the_density_of_a_process_is_learned():
    """Of one whose transitions are known, simulated by NumPy; told by pairs that the fit does not see."""
    random, dt, spread = np.random.default_rng(0), 0.02, 0.1
    rates = np.array([3.0, 5.0])
    shrunk = np.exp(-rates * dt)
    noise = spread * np.sqrt(1 - shrunk**2)
    motions = []
    for _ in range(12):
        states = [np.array([1.0, -1.0])]
        for _ in range(50):
            states.append(shrunk * states[-1] + noise * random.standard_normal(2))
        motions.append(np.stack(states))
    shown = [Demonstration(motion, dt) for motion in motions[:8]]
    ds = ImitationFlow(2, n_layers=2, n_features=10, epochs=200, seed=0).fit(shown)
    held = torch.from_numpy(np.stack(motions[8:]))
    before, after = held[:, :-1], held[:, 1:]
    true = torch.distributions.Normal(before * torch.from_numpy(shrunk), torch.from_numpy(noise))
    short = true.log_prob(after).sum(-1).mean() - ds.log_density(after, before, dt).mean().detach()
    assert abs(float(short)) < 0.03


@pytest.mark.parametrize(
    ("call", "named"),
    [
        (lambda: ImitationFlow(0), "dim"),
        (lambda: ImitationFlow(2, epochs=0), "epochs"),
        (lambda: ImitationFlow(2).sample([0.0, 0.0], [0.0], 0), "count"),
        (lambda: ImitationFlow(2).sample([0.0, 0.0], [1.0, 0.0], 1), "t"),
        (lambda: ImitationFlow(2).sample([0.0], [0.0], 1), "y0"),
        (lambda: ImitationFlow(2).log_density([1.0, 0.0], [0.0, 0.0], 0.0), "dt"),
        (lambda: ImitationFlow(2).log_density([1.0], [0.0, 0.0], 1.0), "y_next"),
        (lambda: LimitCycleFlow(1), "dim"),
        (lambda: LimitCycleFlow(2)([0.0]), "y"),
        (lambda: LimitCycleFlow(2).rollout([0.0, 1.0], [1.0, 0.0]), "t"),
        (lambda: LimitCycleFlow(2).fit(datasets.drawn("wave", 50)), "demonstration"),
        (lambda: LimitCycleFlow(2).fit(there_and_back()), "demonstration"),
    ],
)
def test_bad_arguments_are_named(call, named):
    with pytest.raises(ValueError, match=f"^{named}: expected"):
        call()


def test_an_export_says_what_is_missing(tmp_path):
    with pytest.raises(ValueError, match="AffineCouplings has no table"):
        c.write(ImitationFlow(2, n_layers=2, n_features=5), tmp_path / "field.h", name="field")


def there_and_back():
    """Along an arc: it closes, but does not go around."""
    way = torch.sin(torch.linspace(0, 2 * math.pi, 100, dtype=torch.float64))
    return Demonstration(torch.stack([way, way**2], 1), 0.01)


def bean(turns=2.0, size=1.0, dim=2):
    """A closed curve that is no circle, 201 points of it in 2 s, in 3-D bent out of its plane."""
    t = torch.linspace(0, turns * 2 * math.pi, 201, dtype=torch.float64)
    columns = [
        torch.cos(t) * (1 + 0.3 * torch.cos(t)),
        0.6 * torch.sin(t) + 0.2 * torch.cos(t) ** 2,
        0.2 * torch.sin(2 * t),
    ]
    return Demonstration(size * torch.stack(columns, 1)[:, :dim], 0.01)


def small(dim=2, epochs=150):
    return LimitCycleFlow(dim, n_layers=4, n_features=40, epochs=epochs, seed=0)


@pytest.mark.parametrize(("dim", "turns"), [(2, -2.0), (3, 1.0)])
def test_a_cycle_is_learned_and_all_motions_tend_to_it(dim, turns, draw):
    """No StableDS: the contract is of systems with an attractor, and this one has a cycle instead."""
    shown = bean(turns, dim=dim)
    flow = small(dim).fit(shown).requires_grad_(False)
    assert not isinstance(flow, StableDS)
    assert flow.period == pytest.approx(2 / abs(turns), rel=0.02)
    assert float((flow.rollout(shown.start, shown.times) - shown.positions).norm(dim=-1).max()) < 0.1 * shown.size
    starts = 3 * torch.randn(20, dim, generator=draw, dtype=torch.float64)
    times = torch.tensor([0.0, 50.0, 50.0 + flow.period], dtype=torch.float64)
    late = flow.rollout(starts, times)[:, 1:]
    torch.testing.assert_close(late[:, 0], late[:, 1], rtol=0, atol=1e-9)
    cycle = flow.rollout(late[0, 0], torch.linspace(0, flow.period, 2000))
    assert float(torch.cdist(late[:, 0], cycle).min(1).values.max()) < 5e-3 * shown.size


def test_its_rollout_is_the_integral_of_its_velocity():
    flow = small(3, epochs=20).fit(bean(dim=3)).requires_grad_(False)
    start, times = torch.tensor([0.3, 1.0, 0.4], dtype=torch.float64), np.linspace(0, 1.5, 20)
    options = {"rtol": 1e-9, "atol": 1e-9, "t_eval": times}
    solved = solve_ivp(lambda _, y: flow(y).numpy(), (0, 1.5), start.numpy(), **options).y.T
    np.testing.assert_allclose(flow.rollout(start, times), solved, atol=1e-6)
    center = flow.diffeomorphism.center
    np.testing.assert_allclose(flow.rollout(center, [0.0, 1e6]), center.expand(2, 3), atol=1e-9)


def test_a_cycle_in_other_units_is_the_same_and_a_refit_forgets():
    here, there = small(epochs=10).fit(bean()), small(epochs=10).fit(bean(turns=1)).fit(bean(size=1024.0))
    y = bean().positions[::20]
    torch.testing.assert_close(there(1024 * y), 1024 * here(y))
