"""Passive control: what it gives a mass in energy, what it follows, and what it does without energy."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from latentds import TubeDS, datasets
from latentds.deploy.passive import PassiveController

DT = 1e-3


def circling(x, out):
    """Round the origin for ever: no potential has such a gradient."""
    out[:] = np.array([-x[1], x[0]]) * (2 / max(1.0, np.linalg.norm(x)))
    return out


def run(controller, x, v, seconds, mass=2.0, friction=0.0, push=lambda time: 0.0):
    """Positions, kinetic energies, work done from outside, and tanks of a mass that the forces move."""
    x, v, work, records = np.array(x, float), np.array(v, float), 0.0, []
    for k in range(round(seconds / DT)):
        force = controller(x, v, DT)
        outside = push(k * DT) - friction * v
        before = v.copy()
        v = v + DT / mass * (force + outside)
        x = x + DT * 0.5 * (before + v)
        work += float(outside @ (0.5 * DT * (before + v)))
        records.append((*x, 0.5 * mass * v @ v, work, controller.tank))
    rows = np.array(records)
    return rows[:, :-3], *rows[:, -3:].T


@pytest.mark.parametrize(("along", "across"), [(20.0, 60.0), (60.0, 5.0)])
def test_energy_never_rises_by_more_than_what_is_pushed_in(along, across):
    rng = np.random.default_rng(0)
    pushes = rng.normal(0, 8, (50, 2))
    controller = PassiveController(circling, 2, along=along, across=across, energy=3.0)
    _, kinetic, work, tank = run(controller, [1, 0], [0, 1], 20, push=lambda t: pushes[int(t / 0.4)])
    # A cycle may overdraw what no one could know of it before: a few thousandths of the tank.
    assert (kinetic - work <= kinetic[0] + 3.0 + 0.01).all()
    assert tank.min() > -0.01
    assert np.diff(kinetic + tank - work).max() < 0.01
    assert (kinetic + tank - work)[-1] < kinetic[0] + 3.0


def test_a_field_that_is_no_gradient_is_driven_until_the_tank_is_empty_and_no_longer():
    controller = PassiveController(circling, 2, along=20.0, across=20.0, energy=3.0)
    _, kinetic, work, tank = run(controller, [1, 0], [0, 0], 30, friction=0.5)
    assert kinetic[:2000].max() > 0.5
    assert tank[-1] < 0.05 * 3.0
    assert kinetic[-1] < 0.05
    assert -work[-1] <= 3.0 + 3e-3  # friction has taken no more than the tank held


def test_a_mass_follows_what_was_shown_comes_back_after_a_push_and_arrives():
    shown = datasets.drawn("wave", n_points=300)
    field = TubeDS(2, n_layers=100).fit(shown).controller()
    fastest = float(shown.velocities.norm(dim=-1).max())
    start, times = shown.start.numpy(), shown.duration

    def follow(push):
        controller = PassiveController(field, 2, along=60.0, across=60.0, energy=4 * fastest**2)
        return run(controller, start, [0, 0], 2 * times, push=push)[0]

    def off(path):
        gaps = np.linalg.norm(path[:, None] - shown.positions.numpy()[None], axis=-1)
        return gaps.min(1) / shown.size

    free = follow(lambda t: 0.0)
    half = 0.5 * times
    pushed = follow(lambda t: np.array([0.0, 200.0 * fastest]) if half < t < half + 0.2 else 0.0)
    assert off(free).max() < 0.06
    assert off(pushed).max() > 2 * off(free).max()
    for path in (free, pushed):
        assert np.linalg.norm(path[-1] - shown.goal.numpy()) < 0.02 * shown.size


def test_force_is_limited_and_yields_across_as_it_is_told():
    controller = PassiveController(circling, 2, along=50.0, across=4.0, energy=1e6, max_force=10.0)
    assert np.linalg.norm(controller(np.array([1.0, 0]), np.zeros(2), DT)) == pytest.approx(10.0)
    controller = PassiveController(circling, 2, along=50.0, across=4.0, energy=1e6)
    # At (1, 0) the field is (0, 2): ẋ off by (0.5, 0) is across it, (0, 0.5) along.
    assert controller(np.array([1.0, 0]), np.array([0.5, 2.0]), DT) == pytest.approx([-4 * 0.5, 0])
    assert controller(np.array([1.0, 0]), np.array([0.0, 2.5]), DT) == pytest.approx([0, -50 * 0.5])


def test_the_loop_allocates_nothing_that_stays():
    controller, out = PassiveController(circling, 2, along=5.0, across=5.0, energy=1.0), np.empty(2)
    x, v = np.ones(2), np.ones(2)
    controller(x, v, DT, out=out)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    for _ in range(1000):
        assert controller(x, v, DT, out=out) is out
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 2000


def test_reset_fills_the_tank():
    controller = PassiveController(circling, 2, along=5.0, across=5.0, energy=1.0)
    run(controller, [1, 0], [0, 0], 5, friction=2.0)
    assert controller.tank < 0.5
    controller.reset()
    assert controller.tank == 1.0


@pytest.mark.parametrize(
    ("change", "named"), [({"along": 0}, "along"), ({"energy": -1}, "energy"), ({"max_force": 0}, "max_force")]
)
def test_bad_settings_are_named(change, named):
    with pytest.raises(ValueError, match=named):
        PassiveController(circling, 2, **({"along": 1.0, "across": 1.0, "energy": 1.0} | change))


def test_bad_measurements_are_named():
    controller = PassiveController(circling, 2, along=1.0, across=1.0, energy=1.0)
    with pytest.raises(ValueError, match="velocity: expected"):
        controller(np.ones(2), np.array([np.nan, 0]), DT)
    with pytest.raises(ValueError, match="velocity: expected"):
        controller(np.ones(2), np.ones(3), DT)
    with pytest.raises(ValueError, match="dt: expected"):
        controller(np.ones(2), np.ones(2), 0.0)
    lost = PassiveController(lambda x, out: np.full(2, np.nan), 2, along=1.0, across=1.0, energy=1.0)
    with pytest.raises(ValueError, match="field: expected finite velocities"):
        lost(np.ones(2), np.ones(2), DT)
    assert lost.tank == 1.0
