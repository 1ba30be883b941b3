"""What the name of a column says of it: the words that people use, and the rules by which they are read."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence, Set


def _vocabulary(words: str) -> frozenset[str]:
    return frozenset(words.split())


UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Seconds in each unit of time."""
UNIT_WORDS = {
    word: unit
    for unit, words in {
        "s": "s sec secs second seconds",
        "ms": "ms msec msecs millis millisecond milliseconds",
        "us": "us µs μs usec usecs micros microsecond microseconds",
        "ns": "ns nsec nsecs nanos nanosec nanosecs nanosecond nanoseconds",
    }.items()
    for word in words.split()
}
TIME_WORDS = _vocabulary(
    "time times timestamp timestamps stamp stamps ts elapsed clock zeit rosbagtimestamp datetime date"
)
STEP_NAMES = _vocabulary(
    "dt delta_t delta_time time_delta time_step timestep period sample_time sample_period sampling_time sampling_period"
)
"""The names, without units, of the seconds between two rows."""
RATE_WORDS = _vocabulary("fs fps hz rate frequency freq")
KINDS = {
    "other": _vocabulary(
        "error err errors std var variance cov covariance temperature temperatures temp voltage status mode id seq "
        "index idx frame frames row rows sample samples count counter reward rewards done success terminal marker "
        "markers gripper grippers episode episodes"
    ),
    "acceleration": _vocabulary(
        "acceleration accelerations acc accel qdd ddq qddot qacc ddx ddy ddz xdd ax ay az ddot"
    ),
    "velocity": _vocabulary(
        "velocity velocities vel vels speed speeds qd dq qdot qvel dx dy dz xdot ydot zdot vx vy vz wx wy wz dot v "
        "omega twist dtheta thetadot"
    ),
    "effort": _vocabulary("effort efforts torque torques tau force forces fx fy fz mx my mz current currents wrench"),
    "command": _vocabulary(
        "desired target targets command commands commanded cmd ref reference setpoint action actions"
    ),
    "joint": _vocabulary("q joint joints angle angles theta qpos j encoder"),
    "orientation": _vocabulary("qx qy qz qw quat quaternion orientation rotation rpy rx ry rz euler"),
    "Cartesian": _vocabulary("x y z px py pz tx ty tz xyz pose tcp ee cartesian"),
    "position": _vocabulary("position positions pos"),
}
"""Kinds of columns and the words that tell them; the first kind that fits is taken."""
SIBLINGS = [
    (_vocabulary("roll pitch yaw"), _vocabulary("roll pitch yaw x y z"), 2),
    (_vocabulary("phi theta psi"), _vocabulary("phi theta psi x y z"), 2),
    (_vocabulary("w x y z"), _vocabulary("w x y z"), 4),
]
"""Words that tell an orientation only beside so many of a set: a wrist_roll alone is a joint like its neighbours."""
EPISODE_WORDS = _vocabulary("episode episodes demo demos trial trials trajectory trajectories rollout")
"""Of a column that numbers several motions in one table."""
POSITION_KINDS = ("joint", "orientation", "Cartesian", "position")
LABEL_WORDS = _vocabulary("name names joints columns labels")
"""Of a list that names the columns of an array beside it."""
SOURCE_WORDS = _vocabulary("actual measured filtered raw smoothed meas msr")
"""By which two recordings of the same quantity differ."""


def words_of(name: str) -> list[str]:
    """A name in small letters, split at whatever is no letter or digit, between the two, and before capitals."""
    parts = re.findall(r"[^\W\d_]+|\d+", re.sub(r"([a-zà-ÿ])([A-Z])", r"\1 \2", name).lower())
    return re.sub(r"\b(milli|micro|nano) (?=s(ec(ond)?s?)?\b)", r"\1", " ".join(parts)).split()


def kind_of(name: str) -> str:
    """What a name says its column is: "time", "step", one of ``KINDS``, or "unknown"."""
    words = words_of(name)
    if is_time(name):
        return "time"
    if is_step(name):
        return "step"
    if words == ["v"]:
        return "unknown"  # beside u, say
    if words[:2] == ["q", "d"]:
        return "command"  # q_d, the desired posture; qd is a velocity
    if "twist" in words[1:] and not {"linear", "angular", "x", "y", "z"} & set(words):
        return kind_of(" ".join(word for word in words if word != "twist"))  # of a forearm, and no velocity
    return next((kind for kind, known in KINDS.items() if known & set(words)), "unknown")


def kinds_of(names: Sequence[str]) -> list[str]:
    """What names say of their columns beside each other.

    Roll, pitch and yaw, φ, θ and ψ, and a quaternion's w are told by others of their set. A "current" before a position
    is the present one, unless the position is there without it.
    """
    words = [tuple(words_of(name)) for name in names]
    known_names, beside = set(words), defaultdict[tuple[tuple[str, ...], tuple[str, ...]], set[str]](set)
    for mine in known_names:
        for k, word in enumerate(mine):
            beside[mine[:k], mine[k + 1 :]].add(word)
    kinds = []
    for name, mine in zip(names, words, strict=True):
        kind = kind_of(name)
        for own, known, enough in SIBLINGS:
            for k in [k for k, word in enumerate(mine) if word in own][-1:]:
                if len(known & beside[mine[:k], mine[k + 1 :]]) >= enough:
                    kind = "orientation"
        if mine[:1] == ("current",) and mine[1:] not in known_names:
            present = kind_of(" ".join(mine[1:]))
            kind = present if present in POSITION_KINDS else kind
        kinds.append(kind)
    return kinds


def is_time(name: str) -> bool:
    """Whether a name is that of time stamps."""
    words = words_of(name)
    bare = _without_units(words)
    unit_alone = not bare and len(words) == 1 and len(words[0]) > 1
    known = bare == ["t"] or bool(TIME_WORDS & set(bare)) or words == ["rosbag", "timestamp"]
    return (known or unit_alone) and not is_step(name)


def is_step(name: str) -> bool:
    """Whether a name is that of the seconds between two rows."""
    return "_".join(_without_units(words_of(name))) in STEP_NAMES


def has_word(name: str, words: Set[str]) -> bool:
    return not words.isdisjoint(words_of(name))


def unit_in(name: str) -> str | None:
    """The unit of time that a name ends with, if any."""
    return next((UNIT_WORDS[word] for word in reversed(words_of(name)) if word in UNIT_WORDS), None)


def quantity_of(name: str) -> str:
    """A name without what tells one source of the same quantity from another."""
    return " ".join(word for word in words_of(name) if word not in SOURCE_WORDS)


def _without_units(words: list[str]) -> list[str]:
    return [word for word in words if word not in UNIT_WORDS]
