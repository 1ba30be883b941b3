"""The real-time handle against the system that it was made of."""

from __future__ import annotations

import copy
import pickle
import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from baselines import FDM, SDSEF
from latentds import ChebyshevDS, LatentDS, Learned, LocallyWeightedTranslations
from latentds.dynamics import TubeDynamics
from latentds.testing import wavy_motion
from latentds.time_law import ChebyshevLaw, KnottedLaw


class Tube(LatentDS):
    """Every law of the package: a demonstrated one along the axis and a pull to it across."""

    def __init__(self, dim):
        along = KnottedLaw(torch.tensor([0.1, 0.4, 0.7, 1.0]), torch.tensor([0.2, 0.5, 0.3, 1.0]))
        super().__init__(dim, LocallyWeightedTranslations(dim, 30), TubeDynamics(along, ChebyshevLaw(0.2)))

    def _learn(self, shown, progress):
        donor = ChebyshevDS(self.dim, n_layers=30, pinned=False).fit(shown[0])
        self.diffeomorphism.load_state_dict(donor.diffeomorphism.state_dict())
        self.attractor.copy_(shown[0].goal)
        self.start.copy_(shown[0].start)
        return Learned(0.0)


class Scaled(ChebyshevDS):
    """A system whose velocity the kernel does not know."""

    def forward(self, y):
        return 2 * super().forward(y)


COMPILED = {
    "Chebyshev": lambda dim: ChebyshevDS(dim, n_layers=30),
    "FDM": lambda dim: FDM(dim, n_layers=30),
    "Tube": Tube,
    "SDSEF": lambda dim: SDSEF(dim, n_layers=2, n_features=10, seed=0),
}
OTHER = {
    "Scaled": lambda dim: Scaled(dim, n_layers=30),
}


def fitted(make, dim):
    shown = wavy_motion(dim)
    ds = make(dim)
    with torch.no_grad():
        return (ds if isinstance(ds, SDSEF) else ds.fit(shown)), shown


def around(shown, count=200):
    """Points on the motion, at its goal, near it and far away."""
    positions = shown.positions.numpy()
    rng = np.random.default_rng(0)
    picked = positions[rng.integers(len(positions), size=count)]
    away = 10.0 ** rng.uniform(-6, 1, (count, 1)) * rng.standard_normal(picked.shape)
    return np.concatenate([positions[-1:], positions[:1], picked, picked + away])


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
@pytest.mark.parametrize("make", (COMPILED | OTHER).values(), ids=(COMPILED | OTHER).keys())
def test_velocity_of_the_system(make, dim):
    ds, shown = fitted(make, dim)
    points, controller = around(shown), ds.controller()
    with torch.no_grad():
        expected = ds(torch.from_numpy(points)).numpy()
    assert controller.compiled == (make in COMPILED.values())
    scale = np.abs(expected).max()
    np.testing.assert_allclose(controller(points), expected, rtol=1e-9, atol=1e-10 * scale)
    np.testing.assert_allclose([controller(p) for p in points[:9]], expected[:9], rtol=1e-9, atol=1e-10 * scale)
    assert controller(points[:0]).shape == (0, dim)
    assert controller(points[:6].reshape(2, 3, dim)).shape == (2, 3, dim)


@pytest.mark.parametrize("make", [ChebyshevDS, SDSEF])
def test_any_real_numbers_in(make):
    controller = make(3).controller()
    expected = controller(np.array([1.0, 2.0, 3.0]))
    assert expected.dtype == np.float64
    for y in ([1, 2, 3], (1.0, 2.0, 3.0), np.array([1, 2, 3], np.int32), torch.tensor([1.0, 2.0, 3.0])):
        np.testing.assert_array_equal(controller(y), expected)
    strided = np.zeros(6)
    strided[::2] = 1, 2, 3
    np.testing.assert_array_equal(controller(strided[::2]), expected)


@pytest.mark.parametrize("make", [ChebyshevDS, SDSEF])
@pytest.mark.parametrize(
    ("y", "message"),
    [
        (np.zeros(2), "y: expected shape"),
        (np.zeros((3, 1)), "y: expected shape"),
        (1.0, "y: expected shape"),
        ("here", "y: expected real numbers"),
        ([[1.0], [1.0, 2.0]], "y: expected real numbers"),
        (None, "y: expected real numbers"),
        (np.zeros(3, complex), "y: expected real numbers"),
        ([0.0, np.nan, 0.0], "y: expected finite numbers"),
        ([0.0, np.inf, 0.0], "y: expected finite numbers"),
    ],
)
def test_bad_points(make, y, message):
    with pytest.raises(ValueError, match=message):
        make(3).controller()(y)


@pytest.mark.parametrize("out", [np.zeros(2), np.zeros(3, np.float32), np.zeros((3, 3)), np.zeros(6)[::2], None])
def test_given_room_is_used_or_refused(out):
    controller, y = ChebyshevDS(3).controller(), np.ones(3)
    if out is None:
        out = np.zeros(3)
        assert controller(y, out) is out
        np.testing.assert_array_equal(out, controller(y))
    else:
        with pytest.raises(ValueError, match="out: expected"):
            controller(y, out)


def test_point_and_velocity_may_share_memory():
    ds, shown = fitted(COMPILED["Tube"], 3)
    controller, y = ds.controller(), shown.positions.numpy()[5].copy()
    expected = controller(y)
    np.testing.assert_array_equal(controller(y, y), expected)


def test_it_keeps_the_system_as_it_was():
    for make in (COMPILED["Chebyshev"], OTHER["Scaled"]):
        ds, shown = fitted(make, 2)
        controller, y = ds.controller(), shown.positions.numpy()[3]
        before = controller(y)
        with torch.no_grad():
            ds.diffeomorphism.centers.mul_(1.5)
            ds.start.add_(0.1)
        np.testing.assert_array_equal(controller(y), before)
        assert not np.allclose(ds.controller()(y), before)


def test_threads_do_not_disturb_each_other():
    ds, shown = fitted(COMPILED["Tube"], 3)
    controller, points = ds.controller(), around(shown)
    expected = controller(points)
    with ThreadPoolExecutor(8) as pool:
        velocities = list(pool.map(controller, np.tile(points, (20, 1))))
    np.testing.assert_array_equal(velocities, np.tile(expected, (20, 1)))


def test_nothing_piles_up():
    controller, y, out = ChebyshevDS(3).controller(), np.ones(3), np.empty(3)
    controller(y, out)
    tracemalloc.start()
    try:
        for _ in range(1000):
            controller(y, out)
        assert tracemalloc.get_traced_memory()[1] < 5000
    finally:
        tracemalloc.stop()


def test_a_system_in_single_precision():
    ds, shown = fitted(COMPILED["Tube"], 3)
    points = shown.positions.numpy()[::10]
    exact = ds.controller()(points)
    np.testing.assert_allclose(ds.float().controller()(points), exact, atol=1e-3 * np.abs(exact).max())


# --- derivatives ------------------------------------------------------------------------------------------------------


def differences(controller, y, step=1e-6):
    """∂f/∂y by central differences: (m, n) -> (m, n, n)."""
    nudges = step * np.eye(y.shape[-1])
    columns = [(controller(y + nudge) - controller(y - nudge)) / (2 * step) for nudge in nudges]
    return np.stack(columns, axis=-1)


def autograd(ds, y):
    return torch.func.vmap(torch.func.jacrev(ds))(torch.from_numpy(y)).detach().numpy()


@pytest.mark.parametrize(
    "dim", [pytest.param(1, marks=pytest.mark.slow), 2, 3, pytest.param(7, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("make", (COMPILED | OTHER).values(), ids=(COMPILED | OTHER).keys())
def test_jacobian_is_that_of_the_system(make, dim):
    ds, shown = fitted(make, dim)
    points, controller = around(shown, 20)[2:], ds.controller()  # not where s = 1: laws have a kink there
    wanted = autograd(ds, points)
    scale = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    jacobians = controller.jacobian(points)
    assert (np.abs(jacobians - wanted) <= 1e-7 * scale + 1e-9).all()
    np.testing.assert_allclose(controller.jacobian(points[3]), jacobians[3], rtol=1e-9, atol=1e-12)
    assert controller.jacobian(points[:6].reshape(2, 3, dim)).shape == (2, 3, dim, dim)
    assert controller.jacobian(points[:0]).shape == (0, dim, dim)


@pytest.mark.parametrize("make", [COMPILED["Chebyshev"], COMPILED["Tube"], COMPILED["SDSEF"], OTHER["Scaled"]])
def test_jacobian_of_what_is_returned(make):
    """With another goal, another speed and a limit that half of the points exceed."""
    ds, shown = fitted(make, 3)
    points = around(shown, 30)[1:]
    ends = ds.attractor.numpy() + 0.1
    limit = float(np.median(np.linalg.norm(ds.with_goal(ends).slowed(1 / 1.3).controller()(points), axis=1)))
    controller = ds.controller(max_speed=limit)
    controller.goal, controller.speed = ends, 1.3
    speeds = np.linalg.norm(controller(points), axis=1)
    assert (speeds < 0.999 * limit).any()
    assert (speeds > 0.999 * limit).any()
    jacobians, wanted = controller.jacobian(points), differences(controller, points)
    scale = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    assert np.median(np.abs(jacobians - wanted) / scale) < 1e-7
    # but where a law has a kink between two differences
    assert (np.abs(jacobians - wanted) <= 1e-3 * scale).mean() > 0.95


def test_the_jacobian_feeds_acceleration_forward():
    ds, shown = fitted(COMPILED["Tube"], 3)
    controller, step = ds.controller(), 1e-5
    with torch.no_grad():
        path = ds.rollout(shown.positions[40], torch.tensor([0.0, step, 2 * step], dtype=torch.float64)).numpy()
    wanted = (controller(path[2]) - controller(path[0])) / (2 * step)
    np.testing.assert_allclose(controller.jacobian(path[1]) @ controller(path[1]), wanted, rtol=1e-4)


def test_the_jacobian_leaves_its_argument_and_refuses_what_a_call_does():
    for make in (ChebyshevDS, SDSEF):
        controller, y = make(3).controller(), np.ones(3)
        controller.jacobian(y)
        assert (y == 1).all()
        for bad in (np.zeros(2), [0.0, np.nan, 0.0], "here"):
            with pytest.raises(ValueError, match="y: expected"):
                controller.jacobian(bad)


# --- goals, speeds and limits -----------------------------------------------------------------------------------------

BOTH = [COMPILED["Tube"], COMPILED["SDSEF"], OTHER["Scaled"]]


@pytest.mark.parametrize("make", BOTH)
def test_goal_and_speed_move_the_motion_as_a_whole(make):
    ds, shown = fitted(make, 3)
    points, controller = around(shown, 20), ds.controller()
    np.testing.assert_array_equal(controller.goal, ds.attractor.numpy())
    goal = controller.goal + np.array([1.0, -2.0, 0.5])
    controller.goal, controller.speed = goal, 0.5
    with torch.no_grad():
        wanted = ds.with_goal(goal).slowed(2.0)(torch.from_numpy(points)).numpy()
    np.testing.assert_allclose(controller(points), wanted, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(controller.goal, goal)
    assert np.abs(controller(goal)).max() < 1e-12
    controller.speed = 0
    assert (controller(points) == 0).all()


def test_a_goal_is_copied_and_so_is_the_one_that_is_told():
    controller, goal = ChebyshevDS(3).controller(), np.ones(3)
    controller.goal = goal
    goal[:] = 5
    with pytest.raises(ValueError, match="read-only"):  # it would move nothing
        controller.goal[0] = 6
    np.testing.assert_array_equal(controller.goal, np.ones(3))


@pytest.mark.parametrize("make", BOTH)
def test_a_limit_shortens_and_keeps_the_direction(make):
    ds, shown = fitted(make, 3)
    points = around(shown, 50)[1:]
    free = ds.controller()(points)
    limit = float(np.median(np.linalg.norm(free, axis=1)))
    held = ds.controller(max_speed=limit)(points)
    lengths = np.linalg.norm(free, axis=1)
    np.testing.assert_allclose(np.linalg.norm(held, axis=1), np.minimum(lengths, limit), rtol=1e-9)
    np.testing.assert_allclose(held * lengths[:, None], free * np.linalg.norm(held, axis=1)[:, None], atol=1e-9)
    assert (np.linalg.norm(held, axis=1) <= limit * (1 + 1e-12)).all()


def test_limits_on_single_coordinates_would_break_descent():
    """Why the whole vector is shortened: V falls along it everywhere, and rises somewhere along a clipped one."""
    ds, shown = fitted(COMPILED["Tube"], 3)
    points = torch.from_numpy(around(shown, 500))
    points = points[(points - ds.attractor).norm(dim=-1) > 1e-3].requires_grad_()
    (uphill,) = torch.autograd.grad(ds.lyapunov(points).sum(), points)
    free = ds.controller()(points.detach().numpy())
    limit = 0.1 * float(np.median(np.linalg.norm(free, axis=1)))
    held = ds.controller(max_speed=limit)(points.detach().numpy())
    assert ((uphill.numpy() * held).sum(1) < 0).all()
    assert ((uphill.numpy() * np.clip(free, -limit, limit)).sum(1) > 0).any()


def test_approaching_has_no_jumps_and_the_time_constant():
    ds, shown = fitted(COMPILED["Tube"], 3)
    y, there, dt = shown.positions.numpy()[60], ds.attractor.numpy() + 0.5, 0.001
    jump, smooth = ds.controller(), ds.controller()
    before = smooth(y)
    jump.goal, jump.speed = there, 2.0
    leap = np.linalg.norm(jump(y) - before)
    commands = [before]
    for _ in range(200):
        smooth.approach(dt, 0.2, goal=there, speed=2.0)
        commands.append(smooth(y))
    np.testing.assert_allclose(there - smooth.goal, 0.5 * np.exp(-1), rtol=1e-9)
    assert smooth.speed == pytest.approx(2 - np.exp(-1))
    assert np.linalg.norm(np.diff(commands, axis=0), axis=1).max() < 0.1 * leap
    half = ds.controller()
    for _ in range(400):
        half.approach(dt / 2, 0.2, goal=there, speed=2.0)
    np.testing.assert_allclose(half.goal, smooth.goal)  # whatever the rate of the loop
    for _ in range(10_000):
        smooth.approach(dt, 0.2, goal=there)
    np.testing.assert_allclose(smooth.goal, there, rtol=1e-12)


def test_a_system_that_moves_its_goal_along_converges_to_it():
    """A loop at 1 kHz: the state follows the velocity, the goal jumps on the way."""
    ds, shown = fitted(COMPILED["Chebyshev"], 2)
    controller, y = ds.controller(max_speed=2.0), shown.start.numpy().copy()
    goal = ds.attractor.numpy() + np.array([0.4, 0.3])
    for tick in range(8000):
        controller.approach(0.001, 0.1, goal=goal if tick > 300 else ds.attractor.numpy())
        y += 0.001 * controller(y)
    assert np.linalg.norm(y - goal) < 1e-3


@pytest.mark.parametrize("make", BOTH)
def test_pickles_and_copies_with_its_goal(make):
    ds, shown = fitted(make, 3)
    controller, points = ds.controller(max_speed=1.0), around(shown, 10)
    controller.goal, controller.speed = np.ones(3), 0.3
    for twin in (pickle.loads(pickle.dumps(controller)), copy.deepcopy(controller)):
        np.testing.assert_array_equal(twin(points), controller(points))
        np.testing.assert_array_equal(twin.jacobian(points), controller.jacobian(points))
        twin.goal = np.zeros(3)
        assert (controller.goal == 1).all()
        assert twin.max_speed == 1.0


def test_setting_and_following_piles_nothing_up():
    controller, y, out, goal = ChebyshevDS(3).controller(), np.ones(3), np.empty(3), np.full(3, 0.5)
    controller(y, out)
    tracemalloc.start()
    try:
        for _ in range(1000):
            controller.goal = goal
            controller.approach(0.001, 0.1, goal=y, speed=1.1)
            controller(y, out)
        assert tracemalloc.get_traced_memory()[1] < 5000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("goal", [1.0, 2.0]),
        ("goal", [1.0, np.nan, 0.0]),
        ("goal", "home"),
        ("speed", -1.0),
        ("speed", np.nan),
        ("speed", np.inf),
        ("max_speed", 0.0),
        ("max_speed", -1.0),
        ("max_speed", "fast"),
        ("dt", 0.0),
        ("time_constant", -1.0),
    ],
)
def test_bad_goals_speeds_and_limits(name, value):
    controller = ChebyshevDS(3).controller()
    times = {"dt": 0.1, "time_constant": 0.1}
    ways = {
        "max_speed": lambda: ChebyshevDS(3).controller(max_speed=value),
        **dict.fromkeys(times, lambda: controller.approach(**times | {name: value}, goal=np.ones(3))),
    }
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        ways.get(name, lambda: setattr(controller, name, value))()
    if name in ("goal", "speed"):
        with pytest.raises(ValueError, match=f"^{name}: expected"):
            controller.approach(**times, **{name: value})
    np.testing.assert_array_equal(controller.goal, np.zeros(3))
