"""The simulated arm has the figures of its data sheet, answers where its tool is, and stays within its limits."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

pytest.importorskip("mujoco")
from experiments.robot import arm as robot
from experiments.robot.arm import CENTRE, DOWN, HOME, Arm, FollowJoints, simulate


@pytest.fixture(scope="module")
def arm():
    return Arm()


def random_angles(count, share=1.0):
    return np.random.default_rng(0).uniform(share * Arm.LOWER, share * Arm.UPPER, (count, 7))


def exponentials(q):
    """The flange's pose by screws about the axes of an arm that stands up (Lynch and Park 2017, § 4.1)."""
    _, y, z = np.eye(3)
    pose = np.eye(4)
    for angle, axis, height in zip(q, (z, y, z, -y, z, y, z), (0, 0.36, 0, 0.78, 0, 1.18, 0), strict=True):
        twist = np.zeros((4, 4))
        twist[:3, :3] = np.cross(np.eye(3), axis)
        twist[:3, 3] = -np.cross(axis, height * z)
        pose = pose @ expm(angle * twist)
    upright = np.eye(4)
    upright[2, 3] = 0.36 + 0.42 + 0.40 + 0.126
    return pose @ upright


def test_the_figures(arm):
    assert np.allclose(np.degrees(Arm.UPPER), [170, 120, 170, 120, 170, 120, 175])
    assert np.allclose(np.degrees(Arm.FASTEST), [85, 85, 100, 75, 130, 135, 135])
    assert Arm.STRONGEST.tolist() == [320, 320, 176, 176, 110, 40, 40]
    assert np.allclose(arm.model.jnt_range.T, [Arm.LOWER, Arm.UPPER])
    assert np.allclose(arm.model.actuator_ctrlrange[:, 1], Arm.STRONGEST)
    assert arm.model.body_mass.sum() == pytest.approx(30.61)
    position, rotation = arm.forward(np.zeros(7))
    assert np.allclose(position, [0, 0, 1.306])
    assert np.allclose(rotation, np.eye(3))


def test_positive_angles_bend_the_shoulder_forward_and_the_elbow_back(arm):
    ahead = [arm.forward(0.3 * np.eye(7)[i])[0][0] for i in (1, 3, 5)]
    assert ahead[0] > 0.1
    assert ahead[1] < -0.1
    assert ahead[2] > 0.03
    assert np.allclose(arm.forward(HOME)[1], DOWN)


def test_forward_is_the_product_of_exponentials(arm):
    longer = Arm(tool=0.15)
    for q in random_angles(50):
        pose = exponentials(q)
        for one, tool in ((arm, 0.0), (longer, 0.15)):
            position, rotation = one.forward(q)
            assert np.allclose(position, pose[:3, 3] + tool * pose[:3, 2], rtol=0, atol=1e-9)
            assert np.allclose(rotation, pose[:3, :3], rtol=0, atol=1e-9)


def test_the_jacobian_is_the_slope_of_forward(arm):
    step = 1e-6
    for q in random_angles(5):
        slopes = []
        for shift in step * np.eye(7):
            (after, turned), (before, turn) = arm.forward(q + shift), arm.forward(q - shift)
            slopes.append([*(after - before), *Rotation.from_matrix(turned @ turn.T).as_rotvec()])
        assert np.allclose(arm.jacobian(q), np.array(slopes).T / (2 * step), rtol=0, atol=1e-8)


def test_bias_is_the_slope_of_the_potential_energy(arm):
    def energy(q):
        arm.forward(q)
        return 9.81 * arm.model.body_mass @ arm.data.xipos[:, 2]

    step = 1e-5
    for q in random_angles(5):
        slope = [(energy(q + shift) - energy(q - shift)) / (2 * step) for shift in step * np.eye(7)]
        assert np.allclose(arm.bias(q, np.zeros(7)), slope, atol=1e-6)


def test_inverse_finds_any_pose_that_it_can_take(arm):
    for q in random_angles(20):
        position, rotation = arm.forward(q)
        found = arm.inverse(position, rotation, HOME)
        again, turned = arm.forward(found)
        assert np.linalg.norm(again - position) < 1e-4
        assert Rotation.from_matrix(turned @ rotation.T).magnitude() < 1e-3
        assert (np.abs(found) <= Arm.UPPER).all()


def test_inverse_has_the_elbow_in_the_middle_wherever_it_starts(arm):
    position = arm.forward(HOME)[0]
    starts = HOME + 0.5 * random_angles(5, 0.3)
    assert np.allclose([arm.inverse(position, DOWN, start) for start in starts], HOME, atol=1e-5)
    free = arm.inverse(CENTRE, None, HOME)
    assert np.allclose(arm.forward(free)[0], CENTRE, atol=1e-4)
    assert np.linalg.norm(free - HOME) <= np.linalg.norm(arm.inverse(CENTRE, DOWN, HOME) - HOME)


def test_what_is_out_of_reach_is_said(arm):
    with pytest.raises(ValueError, match=r"position: expected a pose that the tool can take, got \[1.2, 0.0, 0.36\]"):
        arm.inverse(np.array([1.2, 0, 0.36]), None, HOME)
    far = CENTRE + np.linspace(0, 0.6, 30)[:, None] * np.eye(3)[0]
    with pytest.raises(ValueError, match="positions: expected points within reach from the last, got row"):
        arm.path(far, DOWN, HOME)
    with pytest.raises(ValueError, match="q: expected finite numbers"):
        arm.forward(np.zeros(6))
    with pytest.raises(ValueError, match=r"rotation: expected \(3, 3\) or \(30, 3, 3\), got \(3,\)"):
        arm.path(far, np.zeros(3), HOME)


# --- motions ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("shape", "size"), [(robot.archimedean, 0.15), (robot.unstable, 0.20)])
def test_the_papers_motions_are_within_reach(arm, shape, size):
    shown = shape(n_points=400)
    positions = shown.positions.numpy()
    assert np.linalg.norm(positions - CENTRE, axis=1).max() == pytest.approx(size)
    assert shown.velocities.norm(dim=1).max() < 0.5
    angles = arm.path(positions, DOWN, HOME)
    assert np.allclose([arm.forward(q)[0] for q in angles[::20]], positions[::20], atol=1e-4)
    assert (np.abs(angles) < 0.97 * Arm.UPPER).all()
    assert (np.abs(np.gradient(angles, shown.dt, axis=0)) < 0.85 * Arm.FASTEST).all()


def test_kinesthetic_motions_are_slow_smooth_and_their_own(arm):
    every = [robot.kinesthetic(arm, seed, 100) for seed in range(6)]
    assert [one.name for one in every] == [f"kinesthetic {letter}" for letter in "abcdef"]
    for one in every:
        velocities = one.velocities.numpy()
        assert one.columns == robot.JOINTS
        assert one.duration >= 6 - 1e-9
        assert (np.abs(one.positions.numpy()) < 0.95 * Arm.UPPER).all()
        assert (np.abs(velocities) <= (0.5 + 1e-9) * Arm.FASTEST).all()
        assert np.abs(velocities[[0, -1]]).max() < 0.02
        assert np.ptp(one.positions.numpy(), axis=0).min() > 0.05  # every joint moves
    again = robot.kinesthetic(Arm(), 2, 100)
    assert (again.positions == every[2].positions).all()
    with pytest.raises(ValueError, match="seed: expected 0 to 5, got 6"):
        robot.kinesthetic(arm, 6)


# --- runs -------------------------------------------------------------------------------------------------------------


def gravity_only(arm):
    return lambda time, q, v: arm.bias(q, v)


def test_gravity_compensation_holds_it_still(arm):
    start = HOME + 0.1
    run = simulate(arm, start, gravity_only(arm), 2.0)
    assert np.abs(run.q - start).max() < 1e-3
    assert run.times[-1] == pytest.approx(2.0)
    assert len(run.times) == len(run.torque) == 201
    assert np.allclose(run.tool[0], arm.forward(start)[0])
    assert 0.05 < run.hardest < 0.5


def test_without_torque_it_falls_and_what_is_too_much_is_cut_off(arm):
    assert np.abs(simulate(arm, HOME, lambda time, q, v: np.zeros(7), 0.3).q[-1] - HOME).max() > 0.1
    run = simulate(arm, HOME, lambda time, q, v: arm.bias(q, v) + 1000 * np.eye(7)[6], 0.02, every=1)
    assert run.hardest == pytest.approx(25, rel=0.01)
    assert np.allclose(run.torque[:, 6], 40)
    with pytest.raises(ValueError, match="torque: expected finite numbers"):
        simulate(arm, HOME, lambda time, q, v: np.full(7, np.nan), 0.1)


def test_damping_brings_it_to_rest_after_a_push(arm):
    def push(time):
        return np.array([0.0, 20.0, 0.0]) if time < 0.2 else None

    run = simulate(arm, HOME, gravity_only(arm), 8.0, push)
    energy = []
    for q, v in zip(run.q, run.v, strict=True):
        momentum = arm.torques(q, np.zeros(7), v) - arm.bias(q, np.zeros(7))
        energy.append(v @ momentum / 2)
    after = np.array(energy)[run.times > 0.2]
    assert run.tool[20, 1] > run.tool[0, 1] + 0.01  # where it was pushed to
    assert (np.diff(after) < 1e-9).all()
    assert after[-1] < 1e-3 * after[0]
    assert np.abs(run.v[-1]).max() < 0.02


def test_a_push_at_the_tool_turns_joints_by_its_jacobian():
    """The force of which the torques J' F hold the balance moves nothing."""
    arm, force = Arm(tool=0.2), np.array([5.0, -8.0, 12.0])
    start = HOME + 0.1
    run = simulate(
        arm, start, lambda time, q, v: arm.bias(q, v) - arm.jacobian(q)[:3].T @ force, 0.5, lambda time: force
    )
    assert np.abs(run.q - start).max() < 1e-3


def test_it_follows_a_field_of_joints_within_its_limits(arm):
    goal = HOME + 0.3

    def field(q):
        away = q - goal
        return np.where(np.arange(7) % 2, -1.2, -0.8) * away + 0.2 * np.sin(6 * away[::-1])

    follow = FollowJoints(arm, field)
    run = simulate(arm, HOME - 0.4, follow, 3.0)
    assert follow.error < 0.02
    assert run.hardest < 1
    assert run.fastest < 1
    expected = HOME - 0.4
    for _ in range(3001):
        expected = expected + 1e-3 * field(expected)
    assert np.allclose(follow.reference, expected)


def test_a_field_that_is_too_fast_is_slowed_and_keeps_its_curve(arm):
    follow = FollowJoints(arm, lambda q: np.array([9.0, 3.0, 0, 0, 0, 0, 0]))
    simulate(arm, HOME, follow, 0.2)
    moved = follow.reference - HOME
    assert moved[0] / 0.201 == pytest.approx(Arm.FASTEST[0])
    assert moved[1] == pytest.approx(moved[0] / 3)
