"""What a name says of its column."""

from __future__ import annotations

import pytest

from latentds.recordings import vocabulary

NAMES = {
    "time": ["t", "time_ms", "field.header.stamp", "Zeit [µs]", "nanoseconds", "rosbagTimestamp", "elapsedTime"],
    "step": ["dt", "delta_t", "samplingPeriod", "time_step_ms"],
    "other": ["frame", "joint_temperature_3", "error_x"],
    "acceleration": ["qdd1", "ax", "linear_acceleration/y"],
    "velocity": ["qd_2", "elbow_vel", "jointVelocity3", "vx"],
    "effort": ["tau_1", "motor_current"],
    "command": ["q_d_0", "desired_x", "target_q_1"],
    "joint": ["q1", "actual_q_2", "jointPosition"],
    "orientation": ["qw", "pose.orientation.x", "yaw"],
    "Cartesian": ["x", "ee_z", "tcpPose"],
    "position": ["position", "elbow_pos"],
    "unknown": ["v", "u", "shoulder", "s", "", "ts"],
}


@pytest.mark.parametrize(("kind", "name"), [(kind, name) for kind, names in NAMES.items() for name in names])
def test_a_name_tells_the_kind(kind, name):
    assert vocabulary.kind_of(name) == kind


@pytest.mark.parametrize(("name", "unit"), [("time_ms", "ms"), ("t [µs]", "us"), ("stamp.sec", "s"), ("time", None)])
def test_a_name_tells_the_unit(name, unit):
    assert vocabulary.unit_in(name) == unit
