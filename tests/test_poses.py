"""Poses: the chart and its twists against SciPy's rotations, motions that reach the goal from any orientation."""

from __future__ import annotations

import copy
import math
import pickle
import warnings

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from latentds import ChebyshevDS, Demonstration, PoseDemonstration, PoseDS, TubeDS

F64 = torch.float64
AXES = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])


def rotation(quaternions):
    """SciPy's, of w, x, y, z."""
    return Rotation.from_quat(np.asarray(quaternions)[..., [1, 2, 3, 0]])


def quaternion(turns):
    return turns.as_quat()[..., [3, 0, 1, 2]]


def reach(scale=1.0, turn=2.2, count=120, tilt=(0.4, -1.0, 0.7)):
    """A curve in space, turning by ``turn`` about an axis that moves: positions and quaternions."""
    share = np.linspace(0, 1, count)
    way = share**3 * (10 - 15 * share + 6 * share**2)
    positions = scale * np.stack([way, 0.5 * np.sin(3 * way), 0.3 * np.cos(2 * way)], 1)
    axes = np.stack([np.cos(way), np.sin(2 * way), np.full(count, 0.5)], 1)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return positions, quaternion(Rotation.from_rotvec(tilt) * Rotation.from_rotvec(turn * (1 - way)[:, None] * axes))


def tube():
    return TubeDS(6, n_layers=20, refined=False)


@pytest.fixture(scope="module")
def shown():
    return PoseDemonstration(*reach(), 0.03)


@pytest.fixture(scope="module")
def pose(shown):
    return PoseDS(tube()).fit(shown).requires_grad_(False)


def drawn(count, seed=0):
    rng = np.random.default_rng(seed)
    turns = rng.normal(size=(count, 4))
    return torch.from_numpy(np.hstack([rng.normal(size=(count, 3)), turns / np.linalg.norm(turns, axis=1)[:, None]]))


def apart(p, q):
    """Angles between orientations (..., 4)."""
    return (rotation(p).inv() * rotation(q)).magnitude()


def test_the_chart_is_two_tangents_of_half_the_angle_and_leads_back(pose):
    poses = drawn(50)
    chart = pose.to_chart(poses)
    turns = (rotation(pose.orientation).inv() * rotation(poses[:, 3:])).as_rotvec()
    angles = np.linalg.norm(turns, axis=1, keepdims=True)
    wanted = float(pose.length) * 2 * np.tan(angles / 2) * turns / angles
    np.testing.assert_allclose(chart[:, 3:], wanted, rtol=1e-9)
    assert torch.equal(chart[:, :3], poses[:, :3])
    back = pose.from_chart(chart)
    assert apart(back[:, 3:], poses[:, 3:]).max() < 1e-12
    assert bool((back[:, 3:] @ pose.orientation > 0).all())
    torch.testing.assert_close(pose.to_chart(back), chart)
    small = 1e-3 * turns / angles
    near = torch.from_numpy(
        np.hstack([poses[:, :3], quaternion(rotation(pose.orientation) * Rotation.from_rotvec(small))])
    )
    np.testing.assert_allclose(pose.to_chart(near)[:, 3:], float(pose.length) * small, atol=1e-9)


def test_signs_of_quaternions_change_nothing(shown, pose):
    signs = np.where(np.arange(len(shown)) % 7 < 3, -1.0, 1.0)[:, None]
    other = PoseDemonstration(shown.positions, signs * shown.quaternions.numpy(), shown.dt)
    torch.testing.assert_close(other.demonstration.positions, shown.demonstration.positions, rtol=0, atol=1e-12)
    assert other.length == pytest.approx(shown.length)
    poses = drawn(20)
    other_side = torch.cat([poses[:, :3], -poses[:, 3:]], 1)
    torch.testing.assert_close(pose(other_side), pose(poses), rtol=0, atol=1e-12)
    torch.testing.assert_close(pose.lyapunov(other_side), pose.lyapunov(poses))


@pytest.mark.parametrize("frame", ["world", "body"])
def test_twists_are_the_differences_of_scipys_rotations(shown, pose, frame):
    """Of straight lines in the chart along the field, so that no error of a rollout is in it."""
    poses, h = torch.cat([shown.poses, drawn(50)]), 1e-6
    chart, twist = pose.to_chart(poses), pose(poses, frame)
    step = h * pose.ds(chart)
    before, after = (pose.from_chart(chart + sign * step) for sign in (-1, 1))
    first, second = rotation(before[:, 3:]), rotation(after[:, 3:])
    turned = (second * first.inv() if frame == "world" else first.inv() * second).as_rotvec() / (2 * h)
    np.testing.assert_allclose(twist[:, 3:], turned, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(twist[:, :3], (after - before)[:, :3] / (2 * h), rtol=1e-6, atol=1e-6)


def test_a_rollout_is_the_integral_of_the_twists(shown, pose):
    """By SciPy, with the quaternion's own equation q̇ = ½ (0, ω) q in world axes."""
    control = pose.controller()

    def rate(_, y):
        twist = control(y)
        w, v, omega = y[3], y[4:], twist[3:]
        return np.hstack([twist[:3], -0.5 * omega @ v, 0.5 * (w * omega + np.cross(omega, v))])

    start, times = shown.poses[0] + 0.02, shown.times[::10]
    path = pose.rollout(start, times)
    solved = solve_ivp(rate, (0, float(times[-1])), path[0], t_eval=times, rtol=1e-8, atol=1e-10).y.T
    np.testing.assert_allclose(path, solved, atol=1e-4)


@pytest.mark.parametrize("fitted", [True, False])
def test_from_any_orientation_it_arrives_and_meets_no_half_turn(pose, fitted):
    system = pose if fitted else PoseDS(ChebyshevDS(6)).requires_grad_(False)
    path = system.rollout(drawn(50), torch.cat([torch.zeros(1), torch.logspace(-1, 5, 299)]).to(F64))
    torch.testing.assert_close(path[..., 3:].norm(dim=-1), torch.ones(50, 300, dtype=F64))
    assert bool(((path[:, 1:, 3:] * path[:, :-1, 3:]).sum(-1) > 0).all())  # no jump of sign
    w = path[..., 3:] @ system.orientation
    assert bool((w * w[:, :1].sign() > 0).all())
    assert apart(path[:, -1, 3:], system.attractor[3:]).max() < 1e-3
    assert float((path[:, -1, :3] - system.attractor[:3]).norm(dim=-1).max()) < 1e-3
    height = system.lyapunov(path)
    assert bool((height[:, 1:] <= height[:, :-1] * (1 + 1e-9) + 1e-12).all())


def test_it_follows_what_was_shown(shown, pose):
    assert pose.fit_report.fidelity.follows
    assert pose.fit_report.columns == shown.demonstration.columns == ("x", "y", "z", "rx", "ry", "rz")
    start = -3 * shown.poses[0] + torch.cat([4 * shown.positions[0], torch.zeros(4, dtype=F64)])
    path = pose.rollout(start, shown.times)
    torch.testing.assert_close(path[0], torch.cat([shown.positions[0], -shown.quaternions[0]]))
    assert apart(path[:, 3:], shown.quaternions).max() < 0.05
    assert float((path[:, :3] - shown.positions).norm(dim=-1).max()) < 0.05
    torch.testing.assert_close(pose.attractor, shown.poses[-1])


@pytest.mark.parametrize("several", [False, True])
def test_another_goal_shifts_positions_and_turns_orientations(shown, pose, several):
    if several:
        tilts = ([0.4, -1.0, 0.7], [0.6, -0.8, 0.7], [0.4, -1.1, 0.4])
        pose = PoseDS(ChebyshevDS(6, n_layers=20)).fit([PoseDemonstration(*reach(tilt=tilt), 0.03) for tilt in tilts])
        pose.ds.attractor = pose.ds.attractor + 0.05  # a method may put it beside the chart's origin
    turn = Rotation.from_rotvec([0.3, 0.2, 0.5])

    def carried(poses):
        return torch.from_numpy(np.hstack([poses[:, :3] + 0.02, quaternion(turn * rotation(poses[:, 3:]))]))

    goal = carried(pose.attractor[None].detach())[0]
    moved = pose.with_goal(2 * goal - torch.cat([goal[:3], torch.zeros(4, dtype=F64)]))  # of norm 2
    torch.testing.assert_close(moved.attractor[:3], goal[:3])
    assert apart(moved.attractor[3:], goal[3:]) < 1e-12
    start, times = shown.poses[:1], shown.times[::10]
    with torch.no_grad():
        before, after = pose.rollout(start, times)[0], moved.rollout(carried(start), times)[0]
    torch.testing.assert_close(after[:, :3], carried(before)[:, :3])
    assert apart(after[:, 3:], carried(before)[:, 3:]).max() < 1e-9
    wanted = goal.clone().requires_grad_()
    pose.with_goal(wanted)(drawn(1)).sum().backward()
    assert float(wanted.grad[3:].abs().max()) > 0


def test_millimetres_are_metres(shown):
    large = PoseDemonstration(*reach(1000.0), shown.dt)
    assert large.length == pytest.approx(1000 * shown.length)
    metres, millimetres = (PoseDS(ChebyshevDS(6, n_layers=30)).fit(one) for one in (shown, large))
    poses, unit = drawn(20), torch.tensor([1000.0, 1000, 1000, 1, 1, 1, 1], dtype=F64)
    torch.testing.assert_close(millimetres(poses * unit), metres(poses) * unit[:6], rtol=1e-7, atol=1e-7)


def test_the_controller_is_the_module_and_holds_back_on_the_same_curve(pose):
    control, slow = pose.controller(), pose.controller(max_speed=0.01)
    for point, twist in zip(drawn(30).numpy(), pose(drawn(30)).numpy(), strict=True):
        np.testing.assert_allclose(control(point), twist, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(control(np.hstack([point[:3], -3 * point[3:]])), twist, rtol=1e-9, atol=1e-9)
        held = slow(point)
        size = np.hypot(*(np.linalg.norm(part) for part in (held[:3], float(pose.length) * held[3:])))
        assert size == pytest.approx(0.01)
        np.testing.assert_allclose(held / np.linalg.norm(held), twist / np.linalg.norm(twist), atol=1e-9)
    np.testing.assert_allclose(pickle.loads(pickle.dumps(control))(point), twist, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_half_a_turn_away_is_finite_in_torch_and_refused_in_a_loop(pose, dtype):
    halves = quaternion(rotation(pose.orientation) * Rotation.from_rotvec(math.pi * AXES))
    points, system = np.hstack([np.ones((3, 3)), halves]), copy.deepcopy(pose).to(dtype)
    poses = torch.tensor(points, dtype=dtype, requires_grad=True)
    twists = system(poses)
    (slopes,) = torch.autograd.grad(twists.sum(), poses)
    for values in (twists, slopes, system.to_chart(poses), system.lyapunov(poses)):
        assert bool(torch.isfinite(values).all())
    for point in points:
        with pytest.raises(ValueError, match="pose: expected less than half a turn from the goal's orientation"):
            pose.controller()(point)


def test_it_is_a_module_like_others(pose):
    poses, times = drawn(6).reshape(2, 3, 7), torch.linspace(0, 1, 4, dtype=F64)
    for some, batch in ((poses, (2, 3)), (poses[0, 0], ()), (poses[:0], (0, 3))):
        assert pose(some).shape == pose.to_chart(some).shape == (*batch, 6)
        assert pose.lyapunov(some).shape == batch
        assert pose.from_chart(pose.to_chart(some)).shape == (*batch, 7)
        assert pose.rollout(some, times).shape == (*batch, 4, 7)
    leaf = poses[0].clone().requires_grad_()
    assert torch.autograd.gradcheck(pose.to_chart, leaf)
    assert torch.autograd.gradcheck(pose, leaf)
    assert torch.autograd.gradcheck(lambda p: pose(p, "body"), leaf)
    assert torch.autograd.gradcheck(pose.from_chart, pose.to_chart(leaf).detach().requires_grad_())
    loaded = PoseDS(tube())
    loaded.load_state_dict(pose.state_dict())
    for other in (loaded, copy.deepcopy(pose), pickle.loads(pickle.dumps(pose))):
        torch.testing.assert_close(other(poses), pose(poses))
    single = copy.deepcopy(pose).float()
    assert single.orientation.dtype == single(poses.float()).dtype == single.attractor.dtype == torch.float32
    assert single.rollout(poses.float(), times).dtype == torch.float32
    torch.testing.assert_close(single(poses), pose(poses), rtol=1e-2, atol=1e-2)  # answered in the input's float64
    with pytest.raises(ValueError, match="dtype: expected"):
        single.half()


def test_several_share_the_mean_goals_chart_and_the_first_ones_length():
    tilts = ([0.4, -1.0, 0.7], [0.5, -0.9, 0.7])
    every = [PoseDemonstration(*reach(scale, tilt=tilt), 0.03) for scale, tilt in zip((1, 1.1), tilts, strict=True)]
    every[1] = PoseDemonstration(every[1].positions, -every[1].quaternions, 0.03)
    pose = PoseDS(ChebyshevDS(6, n_layers=20)).fit(every)
    assert float(pose.length) == every[0].length
    first, second = (apart(pose.orientation, one.orientation) for one in every)
    assert first == pytest.approx(second)
    assert first + second == pytest.approx(apart(*(one.orientation for one in every)))
    # Back by 1.6 rad about the axis that the first one's 2.2 are about: 3 of them from the mean goal.
    beyond = Rotation.from_rotvec(tilts[0]) * Rotation.from_rotvec(-1.6 * np.array([1, 0, 0.5]) / math.sqrt(1.25))
    opposite = PoseDemonstration(*reach(tilt=beyond.as_rotvec()), 0.03)
    before = pose.orientation.clone()
    with pytest.raises(ValueError, match=r"quaternions: expected orientations 0\.2 rad short of half a turn"):
        pose.fit([every[0], opposite])
    assert torch.equal(pose.orientation, before)


def test_refuses_motions_near_half_a_turn_from_their_goal():
    PoseDemonstration(*reach(turn=2.9), 0.03)
    with pytest.raises(ValueError, match=r"got a turn of 2\.95 rad at row 15; split the motion after it, or"):
        PoseDemonstration(*reach(turn=3.0), 0.03)
    # Twelve steps of 0.5 rad: no sample within 0.2 of half a turn, and the first is near the goal again.
    angles = 0.5 * np.arange(12, -1, -1)
    spun = quaternion(Rotation.from_rotvec(angles[:, None] * AXES[2]))
    with pytest.raises(ValueError, match=r"got a turn of 3\.00 rad at row 6"):
        PoseDemonstration(reach(count=13)[0], spun, 0.03)
    angles = np.array([4.1, 3.4, 2.7, 2.0, 1.3, 0.6, 0.0])
    spun = quaternion(Rotation.from_rotvec(angles[:, None] * AXES[2]))
    with pytest.raises(ValueError, match=r"got a turn of 3\.40 rad at row 1"):
        PoseDemonstration(reach(count=7)[0], spun, 0.03)


def test_says_what_there_is_no_length_of(shown):
    with pytest.warns(UserWarning, match="length: the positions do not move, so 1 per radian"):
        still = PoseDemonstration(np.full((len(shown), 3), 0.3), shown.quaternions, 0.03)
    assert still.length == 1
    upright = np.tile([0.0, 0, 0, 1], (len(shown), 1))
    with pytest.warns(UserWarning, match="length: the orientation does not turn, so 1 per radian"):
        straight = PoseDemonstration(shown.positions, upright, 0.03)
    assert (
        straight.length == pytest.approx(shown.demonstration.size, rel=0.5) == np.ptp(shown.positions.numpy(), 0).max()
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert PoseDemonstration(shown.positions, upright, 0.03, length=0.4).length == 0.4
    with torch.no_grad():
        assert float(PoseDS(ChebyshevDS(6, n_layers=5)).fit(straight)(straight.poses)[:, 3:].abs().max()) < 1e-9


def test_bad_arguments_are_named(shown, pose):
    positions, quaternions = shown.positions, shown.quaternions
    for arguments, message in [
        ((positions[:, :2], quaternions, 0.03), r"positions: expected shape \(N, 3\) with N >= 3, got \(120, 2\)"),
        ((positions, quaternions[:, :3], 0.03), r"quaternions: expected shape \(N, 4\)"),
        ((positions, quaternions[1:], 0.03), "quaternions: expected 120 rows, one a position, got 119"),
        ((positions * torch.inf, quaternions, 0.03), "positions: expected finite numbers, got NaN or inf in row 0"),
        ((positions, quaternions * 1.02, 0.03), r"quaternions: expected norms of 1 within 0\.01, got 1\.02 in row"),
        ((positions, quaternions * 0, 0.03), r"quaternions: expected norms of 1 within 0\.01, got 0 in row 0"),
        ((positions, quaternions, 0), "dt: expected a finite number > 0"),
        ((positions, quaternions, 0.03, -1), "length: expected a finite number > 0"),
        ((positions * 0, quaternions * 0 + 0.5, 0.03, 1), "positions: expected a motion"),
    ]:
        with pytest.raises(ValueError, match=message):
            PoseDemonstration(*arguments)
    torch.testing.assert_close(PoseDemonstration(positions, 1.009 * quaternions, 0.03).quaternions, quaternions)
    point = shown.poses[0].numpy()
    for call, message in [
        (lambda: PoseDS(TubeDS(3)), "ds: expected a StableDS of dimension 6, got TubeDS of dimension 3"),
        (lambda: PoseDS(torch.nn.Linear(6, 6)), "ds: expected a StableDS of dimension 6, got Linear"),
        (lambda: PoseDS(tube()).fit(shown.demonstration), "demonstration: expected a PoseDemonstration or"),
        (lambda: PoseDS(tube()).fit([]), "demonstration: expected a PoseDemonstration or a non-empty list"),
        (lambda: pose(point, frame="tool"), "frame: expected 'world' or 'body', got 'tool'"),
        (lambda: pose(point[:6]), r"pose: expected shape \(\.\.\., 7\), got \(6,\)"),
        (lambda: pose.rollout(point[:6], shown.times), r"pose0: expected shape \(\.\.\., 7\)"),
        (lambda: pose.from_chart(point), r"c: expected shape \(\.\.\., 6\)"),
        (lambda: pose.with_goal(shown.poses), "pose: expected 7 finite numbers"),
        (lambda: pose.with_goal(np.zeros(7)), "pose: expected 7 finite numbers, a quaternion of norm > 0"),
        (lambda: pose.controller(max_speed=0), "max_speed: expected a number"),
        (lambda: pose.controller()(shown.poses), "pose: expected 7 finite numbers"),
        (lambda: pose.controller()(point * np.nan), "pose: expected 7 finite numbers"),
        (lambda: pose.controller()(np.zeros(7)), "pose: expected a quaternion of norm > 0"),
    ]:
        with pytest.raises(ValueError, match=message):
            call()


@pytest.mark.parametrize(
    "names", [("px", "py", "pz", "qx", "qy", "qz", "qw"), ("qw", "qx", "qy", "qz", "px", "py", "pz")]
)
def test_a_recording_is_read_by_the_names_of_its_columns(shown, names, tmp_path):
    rows = shown.poses[:, [("px", "py", "pz", "qw", "qx", "qy", "qz").index(name) for name in names]].numpy()
    table = np.column_stack([shown.times.numpy(), rows])
    np.savetxt(tmp_path / "hand.csv", table, delimiter=",", header=",".join(("time", *names)), comments="")
    read = PoseDemonstration.of(Demonstration.load(tmp_path / "hand.csv"))
    np.testing.assert_allclose(read.positions, shown.positions, atol=1e-6)
    np.testing.assert_allclose((read.quaternions * shown.quaternions).sum(1).abs(), 1, atol=1e-9)
    with pytest.raises(ValueError, match="recording: expected seven columns"):
        PoseDemonstration.of(Demonstration(rows, shown.dt))


def test_an_orientation_assigned_by_hand_need_not_have_norm_one(pose):
    other = copy.deepcopy(pose)
    other.orientation = 1.7 * pose.orientation
    where = drawn(5)
    torch.testing.assert_close(other(where), pose(where))
    torch.testing.assert_close(other.attractor, pose.attractor)
