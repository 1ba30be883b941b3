"""SDS-EF: its rollout against an ODE solver, its invariances, its training, and that it learns a spiral."""

from __future__ import annotations

import copy
import math
import sys

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

import baselines.flows
from baselines import SDSEF
from baselines.training import MAX_RECOVERIES, Plan, descend
from latentds import Demonstration, datasets
from latentds.kernels.dispatch import reference
from latentds.testing import wavy_motion


def small(dim=3, **settings):
    return SDSEF(dim, **{"n_layers": 4, "n_features": 30, "seed": 0, "epochs": 20, **settings})


@pytest.fixture(scope="module")
def fitted():
    return small(seed=1, epochs=60).fit(wavy_motion(3))


@pytest.mark.slow
def test_rollout_is_the_integral_of_the_velocity(fitted):
    shown = wavy_motion(3)
    away = torch.tensor([[0.0], [0.2], [0.5]], dtype=torch.float64)
    starts = shown.start + away * torch.tensor([0.5, -1.0, 0.7], dtype=torch.float64)
    times = np.linspace(0, 1.3 * shown.duration, 60)
    with torch.no_grad():

        def velocity(_, y):
            return fitted(torch.from_numpy(y).reshape(3, 3)).flatten().numpy()

        # g has kinks, which a solver must not step over
        options = {"method": "DOP853", "rtol": 1e-8, "atol": 1e-10, "max_step": shown.duration / 50}
        solved = solve_ivp(velocity, (0, times[-1]), starts.flatten().numpy(), t_eval=times, **options).y.T
        rolled = fitted.rollout(starts, torch.from_numpy(times)).transpose(0, 1).flatten(1).numpy()
    assert np.abs(rolled - solved).max() < 2e-6 * shown.size


def test_gradients_of_a_rollout_are_right(fitted):
    ds = copy.deepcopy(fitted)
    start = wavy_motion(3).start
    times = torch.tensor([0.0, 0.4, 1.1], dtype=torch.float64)
    weights = ds.dynamics.weights
    rows = start.expand(2, 3).clone().requires_grad_()
    ds.rollout(rows, times)[:, -1, 0].sum().backward()
    assert all(p.grad is not None and bool((p.grad != 0).any()) for p in ds.parameters())
    step = 1e-5
    with torch.no_grad():
        for j in range(3):
            ahead, behind = (ds.rollout(start + sign * step * torch.eye(3)[j], times)[-1, 0] for sign in (1, -1))
            assert float(rows.grad[0, j]) == pytest.approx(float(ahead - behind) / (2 * step), rel=1e-3, abs=1e-5)
        found = []
        for sign in (1, -1):
            weights[-1] += sign * step  # the last bias
            found.append(float(ds.rollout(start, times)[-1, 0]))
            weights[-1] -= sign * step
    assert float(weights.grad[-1]) == pytest.approx(2 * (found[0] - found[1]) / (2 * step), rel=1e-3)


def test_speed_is_in_units_per_second_and_the_goal_exact(fitted):
    shown = wavy_motion(3)
    assert torch.equal(fitted.attractor, shown.goal)
    assert float(fitted(shown.goal).detach().norm()) < 1e-9
    with torch.no_grad():
        error = fitted(shown.positions) - shown.velocities
    assert fitted.fit_report.mse == pytest.approx(float(error.square().mean()))
    assert fitted.fit_report.mse < 0.2 * float(shown.velocities.square().mean())


@pytest.mark.parametrize("recipe", ["official", "tuned"])
@pytest.mark.parametrize(("size", "pace"), [(1000.0, 1.0), (1e-6, 1.0), (1.0, 60.0)])
def test_units_do_not_matter(recipe, size, pace):
    shown = wavy_motion(3)
    scaled = Demonstration(size * shown.positions, pace * shown.dt)
    here, there = small(recipe=recipe).fit(shown), small(recipe=recipe).fit(scaled)
    with torch.no_grad():
        wanted = here(shown.positions) * size / pace
        torch.testing.assert_close(there(scaled.positions), wanted, rtol=0, atol=1e-4 * float(wanted.abs().max()))


def test_a_coordinate_at_rest_stays_at_rest():
    shown = wavy_motion(3)
    flat = torch.cat([shown.positions, torch.full((len(shown), 1), 5.0, dtype=torch.float64)], dim=1)
    ds = small(4).fit(Demonstration(flat, shown.dt))
    with torch.no_grad():
        path = ds.rollout(flat[0], shown.times)
    assert bool(torch.isfinite(path).all())
    assert float((path[:, 3] - 5).abs().max()) < 1e-3 * shown.size


def test_learns_from_several():
    one = wavy_motion(3)
    other = Demonstration(one.positions[::2] + 0.1 * (1 - torch.linspace(0, 1, 100).unsqueeze(1)), 2 * one.dt)
    other = Demonstration(torch.cat([other.positions, one.goal.expand(1, 3)]), 2 * one.dt)
    ds = small(epochs=60).fit([one, other])
    assert torch.equal(ds.attractor, one.goal)
    assert ds.fit_report.mse < 0.5 * float(one.velocities.square().mean())


def test_seed_decides_everything():
    shown, point = wavy_motion(3), wavy_motion(3).positions[50]
    first, again, other = (small(seed=seed).fit(shown)(point) for seed in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    drawn = []
    for _ in range(2):
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(3)
            drawn.append(small(seed=None).fit(shown)(point))
    assert torch.equal(*drawn)


def test_refit_forgets_and_an_interrupted_fit_changes_nothing(monkeypatch):
    point = wavy_motion(3).positions[50]
    ds = small().fit(wavy_motion(3, seed=5))
    before = ds(point)

    def interrupted(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(baselines.flows, "descend", interrupted)
        with pytest.raises(KeyboardInterrupt):
            ds.fit(wavy_motion(3))
    assert torch.equal(ds(point), before)
    assert torch.equal(ds.fit(wavy_motion(3))(point), small().fit(wavy_motion(3))(point))


def test_a_bad_row_stays_alone(fitted):
    rows = wavy_motion(3).positions[:3].clone()
    rows[1] = math.nan
    times = torch.linspace(0, 1, 5)
    with torch.no_grad():
        bad, clean = fitted.rollout(rows, times), fitted.rollout(rows[::2], times)
    assert bool(bad[1].isnan().all())
    torch.testing.assert_close(bad[::2], clean)


def test_float32_rests_at_the_goal(fitted):
    ds = copy.deepcopy(fitted).float()
    around = float(ds(wavy_motion(3).positions[:5].float()).detach().norm(dim=-1).max())
    assert float(ds(ds.attractor).detach().norm()) < 1e-2 * around


@pytest.mark.parametrize(
    ("argument", "value"),
    [
        ("dim", 0),
        ("n_layers", 0),
        ("n_features", -1),
        ("recipe", "best"),
        ("seed", -1),
        ("seed", 0.5),
        ("epochs", 0),
        ("epochs", 1.5),
    ],
)
def test_bad_arguments_are_named(argument, value):
    with pytest.raises(ValueError, match=f"^{argument}: expected"):
        SDSEF(**{"dim": 3, argument: value})


@pytest.mark.parametrize(("recipe", "dim", "most"), [("official", 3, 7), ("tuned", 2, 7), ("tuned", 3, 40)])
def test_epochs_are_as_many_as_asked_for(recipe, dim, most):
    ds = small(dim, recipe=recipe, epochs=most).fit(wavy_motion(dim))
    assert len(ds.fit_report.history) == most
    assert ds.settings["epochs"] == most


@pytest.mark.parametrize("gap", [0.0, 1e-9])
def test_a_closed_loop_is_refused(gap):
    """Also one that is closed but for rounding: no float near its goal tells where the goal is."""
    angle = torch.linspace(0, 1, 50, dtype=torch.float64) * 2 * math.pi
    loop = torch.stack([torch.cos(angle), torch.sin(angle)], dim=1)
    loop[-1] = loop[0] + gap
    with pytest.raises(ValueError, match="closed loop"):
        small(2).fit(Demonstration(loop, 0.1))


@pytest.mark.slow
def test_follows_a_winding_spiral():
    """Where velocities alone teach a shortcut; a fraction of the default's effort."""
    shown = datasets.unstable_spiral(3, 400)
    with torch.no_grad():
        path = SDSEF(3, n_features=100, seed=0, epochs=150).fit(shown).rollout(shown.start, shown.times)
    assert float((path - shown.positions).norm(dim=-1).max()) < 0.2
    length = float(path.diff(dim=0).norm(dim=-1).sum())
    assert length == pytest.approx(float(shown.positions.diff(dim=0).norm(dim=-1).sum()), rel=0.03)


class TestDescend:
    """The loop by itself, on a parabola."""

    @staticmethod
    def parabola():
        point = torch.nn.Parameter(torch.tensor([3.0, -2.0]))
        targets = torch.tensor([[1.0, 1.0], [2.0, 0.0]])
        return point, lambda batch: (point - targets[batch]).square().sum(-1).mean()

    def test_finds_the_minimum(self):
        point, loss = self.parabola()
        training = descend(loss, [point], 2, Plan(epochs=400, learning_rate=0.1, warm_up=0.05))
        torch.testing.assert_close(point.detach(), torch.tensor([1.5, 0.5]), rtol=0, atol=1e-3)
        assert len(training.history) == 400
        assert training.notes == ()

    def test_keeps_the_best_and_stops_early(self):
        point, loss = self.parabola()
        calls = iter(range(10**6))

        def rising(batch):
            return loss(batch) + (0 if (count := next(calls)) < 20 else count)

        training = descend(rising, [point], 2, Plan(epochs=400, learning_rate=0.1, patience=30))
        assert len(training.history) < 60
        assert "stopped early" in training.notes[0]
        assert float(loss(torch.arange(2)).detach()) == pytest.approx(min(training.history))

    def test_recovers_from_divergence(self):
        point, loss = self.parabola()
        calls = iter(range(10**6))

        def failing(batch):
            return loss(batch) * (math.nan if next(calls) in (30, 60) else 1)

        training = descend(failing, [point], 2, Plan(epochs=300, learning_rate=0.1))
        assert training.notes == ("recovered from 2 divergences",)
        assert all(map(math.isfinite, training.history))
        assert float(loss(torch.arange(2)).detach()) < min(training.history[:30])

    def test_gives_up_in_the_end_and_refuses_to_begin(self):
        point, loss = self.parabola()
        calls = iter(range(10**6))
        training = descend(
            lambda batch: loss(batch) * (math.nan if next(calls) else 1),
            [point],
            2,
            Plan(epochs=300, learning_rate=0.1),
        )
        assert training.history == (float(loss(torch.arange(2)).detach()),)
        assert f"diverged {MAX_RECOVERIES + 1} times" in training.notes[0]
        with pytest.raises(ValueError, match="finite loss"):
            descend(lambda batch: loss(batch) * math.nan, [point], 2, Plan(epochs=3, learning_rate=0.1))

    @pytest.mark.parametrize("installed", [True, False])
    def test_shows_progress(self, capfd, monkeypatch, installed):
        if not installed:
            monkeypatch.setitem(sys.modules, "rich.progress", None)
        point, loss = self.parabola()
        descend(loss, [point], 2, Plan(epochs=20, learning_rate=0.1), progress="parabola")
        out, err = capfd.readouterr()
        assert "parabola" in out + err


def test_one_compiled_call_gives_the_velocity(fitted):
    y = wavy_motion(3).positions[::7] + 0.05
    controller = fitted.controller()
    assert controller.compiled
    with torch.no_grad():
        wanted = fitted(y)
        one_by_one = torch.stack([fitted(row) for row in y])
        with reference():
            by_torch = fitted(y)
    torch.testing.assert_close(wanted, by_torch, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(one_by_one, wanted, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(controller(y.numpy()), wanted, rtol=1e-10, atol=1e-12)
    slopes = torch.func.vmap(torch.func.jacrev(fitted))(y).detach()
    np.testing.assert_allclose(controller.jacobian(y.numpy()), slopes, rtol=1e-8, atol=1e-8)
    limited = fitted.controller(max_speed=0.1)(y.numpy())
    assert np.linalg.norm(limited, axis=1).max() <= 0.1 * (1 + 1e-12)
    controller.goal = fitted.attractor.numpy() + 0.2
    np.testing.assert_allclose(controller(y.numpy() + 0.2), wanted, rtol=1e-9, atol=1e-12)


def test_the_compiled_call_sees_every_change(fitted):
    ds, y = copy.deepcopy(fitted).requires_grad_(False), wavy_motion(3).start + 0.1
    before = ds(y)
    ds.dynamics.weights.data[-1] += 0.1  # no version counter moves
    after = ds(y)
    assert not torch.equal(before, after)
    with reference():
        torch.testing.assert_close(after, ds(y))
    ds.dynamics.duration *= 2
    torch.testing.assert_close(ds(y), after / 2)
    ds.dynamics.register_forward_hook(lambda module, given, result: 3 * result)
    torch.testing.assert_close(ds(y), 3 * after / 2)


def test_a_map_that_is_replaced_leaves_no_tables(fitted):
    ds, y = copy.deepcopy(fitted).requires_grad_(False), wavy_motion(3).start + 0.1
    ds.diffeomorphism = copy.deepcopy(ds.diffeomorphism)  # the speed still reads the other one
    assert ds.tables() is None
    with reference():
        wanted = ds(y)
    torch.testing.assert_close(ds(y), wanted)


def test_in_the_plane_and_from_several_velocities_are_learned():
    hook = datasets.drawn("hook", 200)
    assert SDSEF(2, n_layers=6, n_features=80, seed=0, epochs=200).fit(hook).fit_report.fidelity.miss < 0.02
    way = torch.linspace(1, 0, 200, dtype=torch.float64).unsqueeze(-1)
    shown = [Demonstration(hook.positions + sign * 0.1 * way, hook.dt) for sign in (-1, 1)]
    several = SDSEF(2, n_layers=6, n_features=80, seed=0, epochs=200).fit(shown)
    assert several.fit_report.fidelity.miss < 0.04
