"""Obstacles that no motion enters, limits that none leaves, and what of a system that costs."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from latentds import ChebyshevDS, TubeDS, datasets
from latentds.deploy.tables import FieldTables
from latentds.modulation import AvoidingDS, BoundedDS, Obstacle, box, sphere

WAVE = datasets.drawn("wave", n_points=200)


@pytest.fixture(scope="module")
def tube():
    return TubeDS(2, n_layers=40).fit(WAVE)


def times(shown, durations=4.0, count=200):
    return torch.linspace(0, durations * shown.duration, count, dtype=torch.float64)


def starts_around(shown, count, spread=0.1, seed=0):
    noise = torch.randn(count, shown.dim, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.cat([shown.start[None], shown.start + spread * shown.size * noise])


def driven(ds, starts, durations=4.0, steps=4000):
    """(steps, ..., n) by small steps of the controller, much faster than by the module's adaptive ones."""
    controller, y, path = ds.controller(), starts.numpy().copy(), []
    for _ in range(steps):
        y = y + durations * WAVE.duration / steps * controller(y)
        path.append(y)
    return torch.from_numpy(np.array(path))


@pytest.mark.parametrize("radius", [0.06, 0.15])
def test_motions_around_a_ball_on_the_path_do_not_enter_it_and_arrive(tube, radius):
    ds = AvoidingDS(tube, [sphere(WAVE.positions[90], radius * WAVE.size)])
    path = driven(ds, starts_around(WAVE, 20))
    assert float(ds.obstacles[0].level(path).min()) > 0.98  # steps are not infinitely small
    assert float((path[-1] - WAVE.goal).norm(dim=-1).max()) < 0.01 * WAVE.size
    start = WAVE.positions[60]
    slow = ds.rollout(start, torch.linspace(0, 0.4 * WAVE.duration, 20, dtype=torch.float64))
    assert float(ds.obstacles[0].level(slow).min()) > 0.9999
    assert float((slow[-1] - driven(ds, start, 0.4)[-1]).norm()) < 0.01 * WAVE.size


def test_without_straight_motions_a_tube_would_hold_where_its_path_meets_the_surface(tube, monkeypatch):
    ds = AvoidingDS(tube, [sphere(WAVE.positions[90], 0.15 * WAVE.size)])
    arrived = driven(ds, WAVE.positions[40])[-1]
    monkeypatch.setattr(FieldTables, "straight", lambda tables: tables)
    held = driven(ds, WAVE.positions[40])[-1]
    assert float((arrived - WAVE.goal).norm()) < 0.01 * WAVE.size
    assert float((held - WAVE.goal).norm()) > 0.1 * WAVE.size


BODIES = {
    "ball": lambda c, s: sphere(c, 0.2 * s),
    "ellipsoid": lambda c, s: Obstacle(c, s * torch.tensor([0.1, 0.2, 0.3]), rotation=turn()),
    "box": lambda c, s: box(c, s * torch.tensor([0.1, 0.2, 0.15]), rotation=turn()),
}


def turn():
    generator = torch.Generator().manual_seed(3)
    return torch.linalg.qr(torch.randn(3, 3, generator=generator, dtype=torch.float64))[0]


@pytest.mark.parametrize("kind", BODIES)
def test_on_a_surface_nothing_points_inward_also_where_it_moves(kind):
    shown = datasets.unstable_spiral(3, 200)
    body = BODIES[kind](shown.positions[60], shown.size)
    body.velocity += torch.tensor([0.3, -0.2, 0.5])
    ds = AvoidingDS(ChebyshevDS(3, n_layers=60).fit(shown), [body])
    rays = torch.randn(200, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    surface = body.center + rays / body.level(body.center + rays)[:, None]
    surface.requires_grad_()
    (normal,) = torch.autograd.grad(body.level(surface).sum(), surface)  # an oracle for the closed form
    speed = (normal * (ds(surface) - body.velocity)).sum(-1) / normal.norm(dim=-1)
    assert float(speed.detach().abs().max()) < 1e-9 * float(ds(surface).detach().norm(dim=-1).max()) + 1e-9


@pytest.mark.parametrize("kind", BODIES)
def test_a_start_inside_is_led_out(kind):
    shown = datasets.unstable_spiral(3, 200)
    body = BODIES[kind](shown.positions[60], shown.size)
    ds = AvoidingDS(ChebyshevDS(3, n_layers=60).fit(shown), [body])
    inside = body.center + 0.3 * body.half_axes.min() * torch.tensor([[1.0, 0, 0], [0, 1, 0], [-1, 0, 1]])
    assert float(body.level(ds.rollout(inside.double(), times(shown, 20))[:, -1]).min()) > 0.99


def test_two_obstacles_one_of_them_moving(tube):
    """Through the controller, whose arrays are told where the second is."""
    size, dt = WAVE.size, 2e-3 * WAVE.duration
    far = WAVE.positions[150].numpy() + np.array([0.0, 0.5 * size])
    ds = AvoidingDS(tube, [sphere(WAVE.positions[60], 0.08 * size), sphere(far, 0.08 * size)], margin=0.02 * size)
    controller, y = ds.controller(), WAVE.start.numpy().copy()
    second = controller.obstacles[1]
    second.velocity[:] = (WAVE.positions[150].numpy() - far) / (0.7 * WAVE.duration)
    lowest = np.inf
    for step in range(1500):
        y = y + dt * controller(y)
        if step < 350:
            second.center[:] += dt * second.velocity
        else:
            second.velocity[:] = 0
        gaps = [np.linalg.norm(y - body.center) / body.half_axes[0] for body in controller.obstacles]
        lowest = min(lowest, *gaps)
    assert lowest > 0.98
    assert np.linalg.norm(y - WAVE.goal.numpy()) < 0.01 * size
    assert float(ds.obstacles[1].center[1]) == pytest.approx(far[1])  # the controller's copy moved, not the system's


def test_controller_is_the_module_with_its_limit_and_goal(tube):
    ds = AvoidingDS(tube, [sphere(WAVE.positions[90], 0.1 * WAVE.size), box(WAVE.positions[30], [0.05, 0.1])])
    points = WAVE.positions[::7] + 0.05
    np.testing.assert_allclose(ds.controller()(points.numpy()), ds(points).detach().numpy(), atol=1e-9)
    limited = ds.controller(max_speed=0.1)(points.numpy())
    assert np.linalg.norm(limited, axis=1).max() < 0.1 + 1e-12
    moved = ds.controller()
    moved.field.goal = WAVE.goal.numpy() + 0.1
    assert np.abs(moved(WAVE.goal.numpy() + 0.1)).max() < 1e-9


def test_an_attractor_moved_in_place_takes_the_motion_and_not_the_obstacle(tube):
    ds = AvoidingDS(tube, [sphere(WAVE.positions[90], 0.1)])
    ds.attractor += 0.05
    points = WAVE.positions[:40:4]
    torch.testing.assert_close(ds.controller()(points.numpy()), ds(points).detach().numpy(), atol=1e-9, rtol=1e-9)
    assert float(ds(WAVE.goal + 0.05).norm()) < 1e-9
    body = ds.obstacles[0]
    surface = body.center + torch.tensor([[0.1, 0.0], [0.0, -0.1]], dtype=torch.float64)
    assert float(((surface - body.center) * ds(surface)).sum(-1).abs().max()) < 1e-9
    assert torch.equal(tube.attractor, WAVE.goal)


def test_far_away_and_at_the_goal_the_field_is_the_one_inside(tube):
    ds = AvoidingDS(tube, [sphere(WAVE.start + 100 * WAVE.size, 0.1)])
    torch.testing.assert_close(ds(WAVE.positions), tube(WAVE.positions), atol=1e-5, rtol=1e-5)
    assert torch.equal(ds.attractor, tube.attractor)
    assert float(ds(ds.attractor).norm()) < 1e-9


def test_it_is_a_module_of_torch(tube):
    ds = AvoidingDS(tube, [sphere(WAVE.positions[90], 0.1)])
    assert "obstacles.0.center" in ds.state_dict()
    again = copy.deepcopy(ds).to(torch.float32)
    assert again(WAVE.positions.float()).dtype == torch.float32
    points = WAVE.positions[20:24].clone().requires_grad_()
    assert torch.autograd.gradcheck(ds, points)
    assert ds(WAVE.positions[0]).shape == (2,)
    assert ds(WAVE.positions[:0]).shape == (0, 2)
    moved = AvoidingDS(tube.with_start_and_goal(WAVE.start, WAVE.goal + 0.05), [sphere(WAVE.positions[90], 0.1)])
    assert float((driven(moved, WAVE.start)[-1] - WAVE.goal - 0.05).norm()) < 0.01 * WAVE.size


def test_bad_input_is_named(tube):
    with pytest.raises(ValueError, match="obstacles: expected none at the goal"):
        AvoidingDS(tube, [sphere(WAVE.goal, 0.1)])
    with pytest.raises(ValueError, match="obstacles: expected at least one Obstacle in 2-D"):
        AvoidingDS(tube, [sphere([0, 0, 0], 0.1)])
    with pytest.raises(ValueError, match="half_axes: expected numbers > 0"):
        Obstacle([0, 0], [0.1, 0])
    around = AvoidingDS(tube, [sphere([9.0, 9], 0.1)])
    with pytest.raises(ValueError, match="fit: expected the system inside"):
        around.fit(WAVE)
    with pytest.raises(ValueError, match="ds: expected a system that nothing holds back, got AvoidingDS"):
        BoundedDS(around, WAVE.goal - 1, WAVE.goal + 1, 0.1)
    with pytest.raises(ValueError, match="AvoidingDS: expected the system inside, as what stands around"):
        around.with_goal(WAVE.goal + 1)
    with pytest.raises(ValueError, match="lower, upper: expected the goal"):
        BoundedDS(tube, WAVE.goal, WAVE.goal + 1, 0.1)


def test_a_box_encloses_its_corners():
    corners = torch.tensor([[1.0, 2, 3], [-1, 2, -3], [1, -2, 3]]).double()
    assert float(box([0, 0, 0], [1, 2, 3]).level(corners).max()) <= 1 + 1e-12


def test_no_motion_leaves_the_limits(tube):
    """Half of the path lies outside: it slides along the wall and arrives."""
    positions = WAVE.positions
    low, high = positions.amin(0) - 0.2, positions.amax(0) + 0.2
    high[1] = 0.5 * (positions[:, 1].amax() + positions[-1, 1])
    margin = 0.05 * WAVE.size
    ds = BoundedDS(tube, low, high, margin)
    begin = torch.minimum(starts_around(WAVE, 20), high - 0.01)
    assert float(tube.rollout(WAVE.start, times(WAVE, 1))[:, 1].max()) > float(high[1])
    path = ds.rollout(torch.maximum(begin, low + 0.01), times(WAVE))
    assert bool(((path >= low) & (path <= high)).all())  # < on paper; in floats a wall is reached
    assert float((path[:, -1] - WAVE.goal).norm(dim=-1).max()) < 0.01 * WAVE.size


def test_limits_slow_nothing_that_is_far_from_them(tube):
    ds = BoundedDS(tube, WAVE.positions.amin(0) - 1, WAVE.positions.amax(0) + 1, 0.1)
    assert torch.equal(ds(WAVE.positions), tube(WAVE.positions))
