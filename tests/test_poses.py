"""Poses: the chart, twists against SciPy's rotations, motions that reach the goal from any orientation."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from latentds import ChebyshevDS, Demonstration, TubeDS
from latentds.poses import PoseDemonstration, PoseDS


def made_up(scale=1.0, turn=2.2, count=200):
    """A curve in space, and orientations that turn by up to ``turn`` rad about an axis that turns, too."""
    s = np.linspace(0, 1, count)
    eased = s**3 * (10 - 15 * s + 6 * s**2)
    positions = scale * np.column_stack([eased, 0.5 * np.sin(3 * eased), 0.3 * np.cos(2 * eased)])
    axes = np.column_stack([np.cos(eased), np.sin(2 * eased), 0.5 + 0 * eased])
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    goal = Rotation.from_rotvec([0.4, -1.0, 0.7])
    turned = goal * Rotation.from_rotvec(turn * (1 - eased)[:, None] * axes)
    return PoseDemonstration(positions, turned.as_quat(scalar_first=True), 0.02, name="pose")


@pytest.fixture(scope="module")
def shown():
    return made_up()


@pytest.fixture(scope="module")
def pose(shown):
    return PoseDS(TubeDS(6, n_layers=60)).fit(shown)


def poses_of(shown):
    return torch.from_numpy(np.concatenate([shown.positions, shown.quaternions], 1))


def random_poses(count, seed=0):
    rng = np.random.default_rng(seed)
    turns = Rotation.random(count, rng=rng).as_quat(scalar_first=True)
    return torch.from_numpy(np.concatenate([rng.normal(size=(count, 3)), turns], 1))


def angle(p, q):
    return 2 * torch.arccos((p * q).sum(-1).abs().clamp(max=1))


def test_the_chart_is_twice_the_tangent_of_half_the_angle_and_leads_back(pose):
    where = random_poses(50)
    chart = pose.to_chart(where)
    goal = Rotation.from_quat(pose.orientation.numpy(), scalar_first=True)
    turns = (goal.inv() * Rotation.from_quat(where[:, 3:].numpy(), scalar_first=True)).as_rotvec()
    angles = np.linalg.norm(turns, axis=1, keepdims=True)
    expected = float(pose.length) * 2 * np.tan(angles / 2) * turns / angles
    np.testing.assert_allclose(chart[:, 3:].numpy(), expected, rtol=1e-9, atol=1e-9)
    again = pose.from_chart(chart)
    assert float(angle(again[:, 3:], where[:, 3:]).max()) < 1e-6
    torch.testing.assert_close(again[:, :3], where[:, :3])


def test_a_sign_flip_changes_nothing(shown, pose):
    signs = np.where(np.arange(len(shown.quaternions)) % 3 == 0, -1, 1)[:, None]
    flipped = PoseDemonstration(shown.positions, signs * shown.quaternions, shown.dt)
    other = PoseDS(TubeDS(6, n_layers=60)).fit(flipped)
    where = random_poses(5)
    torch.testing.assert_close(other(where), pose(where), rtol=1e-7, atol=1e-7)
    mirrored = torch.cat([where[:, :3], -where[:, 3:]], 1)
    torch.testing.assert_close(pose(mirrored), pose(where))


def test_twists_are_the_rollouts_derivative_in_world_and_body_axes(pose):
    h = 1e-5
    times = torch.tensor([0.0, h, 2 * h], dtype=torch.float64)
    starts = random_poses(20, seed=1)
    path = pose.rollout(starts, times)
    turns = [Rotation.from_quat(path[:, k, 3:].detach().numpy(), scalar_first=True) for k in (0, 2)]
    world = (turns[1] * turns[0].inv()).as_rotvec() / (2 * h)
    body = (turns[0].inv() * turns[1]).as_rotvec() / (2 * h)
    middle = path[:, 1]
    linear = ((path[:, 2] - path[:, 0]) / (2 * h))[:, :3]
    np.testing.assert_allclose(pose(middle)[:, 3:].detach(), world, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(pose(middle, frame="body")[:, 3:].detach(), body, rtol=1e-3, atol=1e-3)
    np.testing.assert_allclose(pose(middle)[:, :3].detach(), linear.detach(), rtol=1e-3, atol=1e-3)


def test_integrated_twists_are_the_rollout(shown, pose):
    """By SciPy, of the quaternion's own differential equation q' = ½ ω q in world axes."""
    control, start = pose.controller(), poses_of(shown)[0].numpy()

    def rate(_, y):
        twist = control(y)
        w, v, omega = y[3], y[4:], twist[3:]
        return [*twist[:3], -0.5 * omega @ v, *(0.5 * (w * omega + np.cross(omega, v)))]

    times = np.linspace(0, 4, 20)
    solved = solve_ivp(rate, (0, 4), start, t_eval=times, rtol=1e-9, atol=1e-10).y.T
    path = pose.rollout(torch.from_numpy(start), torch.from_numpy(times)).detach()
    assert float((path - torch.from_numpy(solved)).abs().max()) < 1e-4


@pytest.mark.parametrize("fitted", [True, False])
def test_from_any_orientation_it_arrives_and_never_meets_half_a_turn(pose, fitted):
    system = pose if fitted else PoseDS(ChebyshevDS(6))
    starts = random_poses(50, seed=2)
    path = system.rollout(starts, torch.linspace(0, 400, 400, dtype=torch.float64)).detach()
    norms = torch.linalg.vector_norm(path[..., 3:], dim=-1)
    torch.testing.assert_close(norms, torch.ones_like(norms))
    cosines = (path[..., 3:] * system.orientation).sum(-1)
    assert bool((cosines.abs() > 0).all())
    assert bool((cosines[:, 0].sign()[:, None] == cosines.sign()).all())  # no flip on the way
    assert float(angle(path[:, -1, 3:], system.orientation).max()) < 1e-3
    assert float((path[:, -1, :3] - system.attractor[:3]).norm(dim=-1).max()) < 1e-3
    height = system.lyapunov(path)
    assert bool((height.diff(dim=-1) <= 1e-9 * height[:, :-1] + 1e-12).all())


def test_it_follows_what_was_shown(shown, pose):
    assert pose.fit_report.fidelity.follows
    times = torch.linspace(0, shown.dt * (len(shown.positions) - 1), len(shown.positions), dtype=torch.float64)
    path = pose.rollout(poses_of(shown)[0], times).detach()
    assert float(angle(path[:, 3:], poses_of(shown)[:, 3:]).max()) < 0.05
    assert torch.equal(path[0], pose.rollout(poses_of(shown)[0], times[:1])[0])


def test_a_goal_that_moves_takes_positions_and_orientations_along(shown, pose):
    turn = Rotation.from_rotvec([0.0, 0.0, 0.5])
    goal = pose.attractor.clone()
    orientation = (turn * Rotation.from_quat(goal[3:].numpy(), scalar_first=True)).as_quat(scalar_first=True)
    wanted = torch.cat([goal[:3] + 0.1, torch.from_numpy(orientation)])
    moved = pose.with_goal(wanted)
    assert float(angle(moved.attractor[3:], wanted[3:])) < 1e-7
    start = poses_of(shown)[0]
    begin = torch.cat([start[:3] + 0.1, torch.from_numpy(
        (turn * Rotation.from_quat(start[3:].numpy(), scalar_first=True)).as_quat(scalar_first=True)
    )])  # fmt: skip
    times = torch.linspace(0, 4, 30, dtype=torch.float64)
    before, after = (system.rollout(y, times).detach() for system, y in ((pose, start), (moved, begin)))
    torch.testing.assert_close(after[:, :3], before[:, :3] + 0.1, rtol=1e-7, atol=1e-7)
    carried = (turn * Rotation.from_quat(before[:, 3:].numpy(), scalar_first=True)).as_quat(scalar_first=True)
    assert float(angle(after[:, 3:], torch.from_numpy(carried)).max()) < 1e-6


def test_millimetres_give_the_same_motion():
    small, large = (PoseDS(ChebyshevDS(6, n_layers=60)).fit(made_up(scale)) for scale in (1.0, 1000.0))
    where = random_poses(10, seed=3)
    scaled = torch.cat([1000 * where[:, :3], where[:, 3:]], 1)
    metres, millimetres = small(where), large(scaled)
    torch.testing.assert_close(millimetres[:, :3], 1000 * metres[:, :3], rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(millimetres[:, 3:], metres[:, 3:], rtol=1e-5, atol=1e-6)


def test_the_controller_is_the_module(pose):
    where = random_poses(30, seed=4)
    control = pose.controller()
    np.testing.assert_allclose(control(where.numpy()), pose(where).detach().numpy(), atol=1e-9)
    out = np.empty(6)
    assert control(where[0].numpy(), out=out) is out
    assert np.linalg.norm(pose.controller(max_speed=0.01)(where[0].numpy())[:3]) <= 0.01 + 1e-12
    half = Rotation.from_quat(pose.orientation.numpy(), scalar_first=True) * Rotation.from_rotvec([np.pi, 0, 0])
    opposite = np.concatenate([np.zeros(3), half.as_quat(scalar_first=True)])
    with pytest.raises(ValueError, match="pose: expected less than half a turn"):
        control(opposite)
    assert bool(torch.isfinite(pose(torch.from_numpy(opposite))).all())


def test_it_is_a_module_of_torch(pose):
    where = random_poses(3, seed=5)
    assert pose(where[0]).shape == (6,)
    assert pose(where[:0]).shape == (0, 6)
    assert pose.rollout(where, torch.linspace(0, 1, 4, dtype=torch.float64)).shape == (3, 4, 7)
    assert torch.autograd.gradcheck(pose.to_chart, where.clone().requires_grad_())
    again = PoseDS(TubeDS(6, n_layers=60))
    again.fit(made_up())
    again.load_state_dict(pose.state_dict())
    for other in (again, copy.deepcopy(pose), pickle.loads(pickle.dumps(pose))):
        torch.testing.assert_close(other(where), pose(where))
    assert copy.deepcopy(pose).float()(where.float()).dtype == torch.float32


@pytest.mark.parametrize("names", [("px", "py", "pz", "qx", "qy", "qz", "qw"), ("qw", "qx", "qy", "qz", "x", "y", "z")])
def test_a_recording_is_read_by_its_columns_names(shown, names, tmp_path):
    order = ["px", "py", "pz", "qw", "qx", "qy", "qz"]
    known = {name[-2:] if "q" in name else "p" + name[-1]: k for k, name in enumerate(order)}
    rows = poses_of(shown)[:, [known[name if "q" in name else "p" + name[-1]] for name in names]]
    table = np.column_stack([shown.dt * np.arange(len(rows)), rows.numpy()])
    np.savetxt(tmp_path / "hand.csv", table, delimiter=",", header=",".join(("time", *names)), comments="")
    read = PoseDemonstration.of(Demonstration.load(tmp_path / "hand.csv"))
    np.testing.assert_allclose(read.positions, shown.positions, atol=1e-6)
    np.testing.assert_allclose(np.abs((read.quaternions * shown.quaternions).sum(1)), 1, atol=1e-9)
    with pytest.raises(ValueError, match="recording: expected seven columns"):
        PoseDemonstration.of(Demonstration(rows, shown.dt))


def test_several_are_learned_with_the_mean_of_their_goals():
    first, second = made_up(turn=2.0), made_up(turn=1.6)
    several = PoseDS(TubeDS(6, n_layers=60)).fit([first, second])
    assert float(several.length) == first.length
    assert float(angle(several.orientation, torch.from_numpy(first.orientation))) < 1e-6


def test_bad_input_is_named(shown):
    positions, quaternions = shown.positions, shown.quaternions
    with pytest.raises(ValueError, match="quaternions: expected length 1, got 2 in row 7"):
        PoseDemonstration(positions, quaternions * np.where(np.arange(200) == 7, 2, 1)[:, None], 0.02)
    with pytest.raises(ValueError, match=r"quaternions: expected turns of less than 2\.94 rad .* row 0; split"):
        made_up(turn=3.1)
    with pytest.raises(ValueError, match="positions: expected finite numbers"):
        PoseDemonstration(positions[:50], quaternions, 0.02)
    with pytest.raises(ValueError, match="ds: expected a system of dimension 6"):
        PoseDS(TubeDS(3))
    with pytest.raises(ValueError, match="frame: expected"):
        PoseDS(TubeDS(6))(random_poses(1), frame="tool")
    with pytest.raises(ValueError, match="shown: expected PoseDemonstrations"):
        PoseDS(TubeDS(6)).fit(shown.in_chart(shown.orientation, 1.0))


def test_what_hardly_turns_or_moves_has_a_length_too(shown):
    still = PoseDemonstration(np.zeros((200, 3)), shown.quaternions, 0.02)
    assert still.length == 1
    rng = np.random.default_rng(0)
    wobble = Rotation.from_rotvec(1e-5 * rng.normal(size=(200, 3))).as_quat(scalar_first=True)
    straight = PoseDemonstration(shown.positions, wobble, 0.02)
    assert straight.length == pytest.approx(np.ptp(shown.positions, axis=0).max())
