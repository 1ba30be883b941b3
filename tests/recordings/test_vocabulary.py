"""What a name says of its column."""

from __future__ import annotations

import pytest

from latentds.recordings import vocabulary

NAMES = {
    "time": [
        "t",
        "time_ms",
        "field.header.stamp",
        "Zeit [µs]",
        "nanoseconds",
        "rosbagTimestamp",
        "elapsedTime",
        "ts",
        "ZeitInNanoSec",
    ],
    "step": ["dt", "delta_t", "samplingPeriod", "time_step_ms"],
    "other": ["frame", "joint_temperature_3", "error_x"],
    "acceleration": ["qdd1", "ax", "linear_acceleration/y"],
    "velocity": ["qd_2", "elbow_vel", "jointVelocity3", "vx"],
    "effort": ["tau_1", "motor_current"],
    "command": ["q_d_0", "desired_x", "target_q_1"],
    "joint": ["q1", "actual_q_2", "jointPosition"],
    "orientation": ["qw", "pose.orientation.x"],
    "Cartesian": ["x", "ee_z", "tcpPose"],
    "position": ["position", "elbow_pos"],
    "unknown": ["v", "u", "shoulder", "s", "", "yaw", "w", "forearm_twist", "wrist twist 2"],
}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in NAMES.items() for name in names])
def test_a_name_tells_the_kind(kind, name):
    assert vocabulary.kind_of(name) == kind


BESIDE_EACH_OTHER = {
    "yaw": "orientation", "x": "Cartesian", "y": "Cartesian",
    "wrist_roll": "unknown", "shoulder_pan": "unknown",
    "left_w0": "unknown", "left_s0": "unknown",
    "imu.w": "orientation", "imu.x": "orientation", "imu.y": "orientation", "imu.z": "orientation",
    "arm_phi": "orientation", "arm_theta": "orientation", "arm_psi": "orientation", "theta_1": "joint",
    "forearm_twist_angle": "joint", "twist_linear_x": "velocity",
    "current_joint_0": "joint", "current_q1": "effort", "q1": "joint", "motor_current": "effort",
}  # fmt: skip


def test_a_name_tells_the_kind_beside_others():
    kinds = vocabulary.kinds_of(list(BESIDE_EACH_OTHER))
    assert dict(zip(BESIDE_EACH_OTHER, kinds, strict=True)) == BESIDE_EACH_OTHER


@pytest.mark.parametrize(("name", "unit"), [("time_ms", "ms"), ("t [µs]", "us"), ("stamp.sec", "s"), ("time", None)])
def test_a_name_tells_the_unit(name, unit):
    assert vocabulary.unit_in(name) == unit
