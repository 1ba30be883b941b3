"""The paper's arm in MuJoCo: a KUKA LBR iiwa 14 R820, the motions shown to it, and its runs under torque control.

All joint angles zero, it stands straight up, the flange 1.306 m above the base and turned like it. The axes are then,
from the base, z, y, z, -y, z, y, z, as KUKA counts: positive angles of joints 2 and 6 bend it forward (to x), of joint
4 back.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np
import torch
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from latentds import Demonstration, datasets
from latentds.arguments import Array, number_in, point_array, positive, real_array, whole_number
from latentds.curves import arc_lengths

Torque = Callable[[float, Array, Array], Array]
"""A controller: seconds, angles (7,) rad, velocities (7,) rad/s -> torques (7,) N m."""
Disturbance = Callable[[float], "Array | None"]
"""Seconds -> a force (3,) N in the frame of the base, at the tool, or none."""

JOINTS = tuple(f"joint_{i}" for i in range(1, 8))
HEIGHTS = (0.1575, 0.36, 0.5645, 0.78, 0.9645, 1.18, 1.261, 1.306)
"""m, of the seven joints and the flange when it stands up: .36 to joint 2, .42 on to 4, .40 to 6, .126 to the flange
(KUKA's data sheet). Where on their axes joints 1, 3, 5, 7 lie changes nothing but which link a mass counts to; that is
from ROS's iiwa_stack (Hennersperger et al. 2017)."""
AXES = ("0 0 1", "0 1 0", "0 0 1", "0 -1 0", "0 0 1", "0 1 0", "0 0 1")
MASSES = (5.0, 5.76, 6.35, 3.5, 3.5, 3.5, 1.8, 1.2)
"""kg, of base and links, as Drake's iiwa14 has them: 30.6 together, about what it weighs; those of iiwa_stack
come to 22.5. Centres and moments are ours: MuJoCo takes them from capsules of these masses along the axis."""
RADII = (0.09, 0.07, 0.07, 0.065, 0.06, 0.055, 0.045, 0.045)
"""m, of the same capsules, the flange a cylinder: ours, about the arm's own thickness."""
ARMATURE = 0.1
"""kg m², the rotor behind its gear as a joint feels it: ours, as is the damping, a hundredth of the largest torque at 1
rad/s."""

SHOULDER = np.array([0.0, 0.0, HEIGHTS[1]])
HOME = np.radians([0.0, 30.0, 0.0, -90.0, 0.0, 60.0, 0.0])
"""The middle posture: elbow up, flange down, half stretched forward."""
DOWN = np.diag([-1.0, 1.0, -1.0])
"""The flange's rotation at ``HOME``: its axis points to the floor."""
CENTRE = np.array([0.6, 0.0, 0.37])
"""m, the middle of what the tool draws in front of the arm. The flange down, the elbow's limits keep the wrist 0.41 to
0.82 m from the shoulder, which a sphere of radius 0.2 m fills almost. From here, the nearest and the farthest place on
it lie between the turns of the unstable spiral."""
KINESTHETIC = "abcdef"
"""Names of the made-up kinesthetic motions; the number is the seed."""

_STEPS, _RESTARTS = 300, 50
_NEAR, _ALIGNED = 1e-4, 1e-3  # m and rad by which inverse kinematics may miss


def mjcf(tool: float = 0.0) -> str:
    """The arm on a floor, for MuJoCo; a stick of that length (m), weightless, carries the tool beyond the flange."""
    links, ends = "", ""
    for i, (low, high) in enumerate(pairwise(HEIGHTS)):
        kind = "capsule" if i < 6 else "cylinder"
        size = f'type="{kind}" size="{RADII[i + 1]}" mass="{MASSES[i + 1]}" fromto="0 0 0 0 0 {high - low:.4f}"'
        links += (
            f'<body name="link_{i + 1}" pos="0 0 {low - (HEIGHTS[i - 1] if i else 0):.4f}">'
            f'<joint name="{JOINTS[i]}" axis="{AXES[i]}" range="{Arm.LOWER[i]} {Arm.UPPER[i]}" '
            f'armature="{ARMATURE}" damping="{Arm.DAMPING[i]}"/>'
            f'<geom {size} rgba="{"0.93 0.45 0.1 1" if i % 2 else "0.8 0.8 0.82 1"}"/>'
        )
        ends += "</body>"
    flange = HEIGHTS[7] - HEIGHTS[6]
    if tool:
        along = f'fromto="0 0 {flange} 0 0 {flange + tool}"'
        links += f'<geom type="cylinder" size="0.01" mass="0" contype="0" conaffinity="0" {along}/>'
    links += f'<site name="tool" size="0.012" pos="0 0 {flange + tool}" rgba="0.1 0.3 0.9 1"/>'
    names = ["base", *(f"link_{i}" for i in range(1, 8))]
    # Capsules of neighbours, and of neighbours' neighbours, overlap at the joints: they are no obstacles to each other.
    apart = "".join(
        f'<exclude body1="{a}" body2="{b}"/>' for n in (1, 2) for a, b in zip(names, names[n:], strict=False)
    )
    motors = "".join(
        f'<motor joint="{name}" ctrlrange="{-most} {most}"/>' for name, most in zip(JOINTS, Arm.STRONGEST, strict=True)
    )
    return f"""<mujoco model="LBR iiwa 14 R820">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.001" integrator="implicitfast" gravity="0 0 -9.81"/>
  <visual><global offwidth="1280" offheight="960"/></visual>
  <asset><texture type="skybox" builtin="flat" rgb1="1 1 1" width="8" height="8"/></asset>
  <worldbody>
    <light pos="1 -1 3" dir="-0.3 0.3 -1"/>
    <camera name="front" fovy="34" pos="1.8 -1.8 1.2" xyaxes="1.8 1.5 0 -0.975 1.17 5.49"/>
    <geom name="floor" type="plane" size="2 2 0.1" rgba="0.95 0.95 0.95 1"/>
    <body name="base"><geom type="capsule" size="{RADII[0]}" mass="{MASSES[0]}" fromto="0 0 0 0 0 {HEIGHTS[0]}"
      rgba="0.4 0.4 0.42 1"/>{links}{ends}</body>
  </worldbody>
  <contact>{apart}</contact>
  <actuator>{motors}</actuator>
</mujoco>"""


class Arm:
    """The arm's kinematics and dynamics. One thread at a time: all answers come from one ``data``.

    Args:
        tool: m, >= 0, from the flange to the point that counts as the tool.

    Attributes:
        length: m, of the tool.
        model: MuJoCo's, with the site ``tool`` and the camera ``front``.
        data: MuJoCo's, at whatever was asked last.
    """

    UPPER = datasets.JOINT_LIMITS
    LOWER = -UPPER
    FASTEST = np.radians([85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0])
    """rad/s (KUKA's brochure, as Drake's iiwa_description quotes it)."""
    STRONGEST = np.array([320.0, 320.0, 176.0, 176.0, 110.0, 40.0, 40.0])
    """N m (the same)."""
    DAMPING = STRONGEST / 100
    """N m s/rad."""

    def __init__(self, tool: float = 0.0) -> None:
        self.length = number_in(tool, "tool", 0, np.inf, ends="[)")
        self.model = mujoco.MjModel.from_xml_string(mjcf(self.length))
        self.data = mujoco.MjData(self.model)
        self._site = self.model.site("tool").id

    def forward(self, q: Array) -> tuple[Array, Array]:
        """The tool's position (3,) m and rotation (3, 3) in the frame of the base, at angles (7,) rad."""
        self._place(_shaped(q, "q", 7))
        return self._pose()

    def links(self, q: Array) -> Array:
        """(9, 3) m, from the foot by the seven joints to the tool: the arm as a line, for pictures."""
        self._place(_shaped(q, "q", 7))
        places: Array = np.vstack([np.zeros(3), self.data.xpos[-7:], self._pose()[0]])
        return places

    def jacobian(self, q: Array) -> Array:
        """(6, 7): the tool's velocity, m/s, and below its turning, rad/s in the frame of the base, per rad/s."""
        self._place(_shaped(q, "q", 7))
        return self._slopes()

    def bias(self, q: Array, v: Array) -> Array:
        """Torques (7,) N m against gravity, Coriolis and centrifugal forces; the joints' damping is not among them."""
        return self.torques(q, v, np.zeros(7)) - self.DAMPING * v

    def torques(self, q: Array, v: Array, acceleration: Array) -> Array:
        """Torques (7,) N m that accelerate it by (7,) rad/s², the damping of the joints made up for."""
        self.data.qpos[:], self.data.qvel[:] = _shaped(q, "q", 7), _shaped(v, "v", 7)
        mujoco.mj_fwdPosition(self.model, self.data)
        mujoco.mj_fwdVelocity(self.model, self.data)
        needed = np.empty(7)
        mujoco.mj_mulM(self.model, self.data, needed, _shaped(acceleration, "acceleration", 7))
        total: Array = needed + self.data.qfrc_bias + self.DAMPING * v
        return total

    def inverse(self, position: Array, rotation: Array | None, start: Array) -> Array:
        """Angles (7,) rad within the limits that bring the tool there, of all that do those nearest to ``HOME``.

        Least squares damped by the error (Sugihara 2011), the elbow drawn to its middle where the tool does not move.
        So the answer depends on ``start`` only where there are several nearest. If it does not lead there, others do.

        Args:
            position: (3,) m.
            rotation: (3, 3), or None: any.
            start: (7,) rad.

        Raises:
            ValueError: if it misses by more than 1e-4 m or 1e-3 rad from everywhere.
        """
        target = _shaped(position, "position", 3)
        turn = None if rotation is None else _shaped(rotation, "rotation", 3, 3)
        others = np.random.default_rng(0).uniform(self.LOWER, self.UPPER, (_RESTARTS, 7))
        misses = []
        for begin in (_shaped(start, "start", 7), *others):
            q, *miss = self._descend(target, turn, begin)
            if miss[0] <= _NEAR and miss[1] <= _ALIGNED:
                return q
            misses.append(miss)
        away, askew = min(misses)
        raise ValueError(
            f"position: expected a pose that the tool can take, got {target.round(4).tolist()}, missed by {away:.2g} m "
            f"and {askew:.2g} rad"
        )

    def path(self, positions: Array, rotation: Array | None, start: Array) -> Array:
        """Angles (N, 7) rad along a path of the tool, each found from the last: smooth if the path is and avoids folds.

        Args:
            positions: (N, 3) m.
            rotation: (3, 3) all along, (N, 3, 3), or None: any.
            start: (7,) rad, from where the first is sought.

        Raises:
            ValueError: if a point is missed by more than 1e-4 m or 1e-3 rad, sought from the last alone.
        """
        points = point_array(positions, "positions")
        turns: list[None] | Array = [None] * len(points)
        if rotation is not None:
            given = real_array(rotation, "rotation")
            if given.shape not in ((3, 3), (len(points), 3, 3)):
                raise ValueError(f"rotation: expected (3, 3) or ({len(points)}, 3, 3), got {given.shape}")
            turns = np.broadcast_to(given, (len(points), 3, 3))
        angles = [self.inverse(points[0], turns[0], start)]
        for row, (point, turn) in enumerate(zip(points[1:], turns[1:], strict=True), 1):
            q, away, askew = self._descend(point, turn, angles[-1])
            if not (away <= _NEAR and askew <= _ALIGNED):
                raise ValueError(
                    f"positions: expected points within reach from the last, got row {row}, missed by {away:.2g} m and "
                    f"{askew:.2g} rad"
                )
            angles.append(q)
        return np.stack(angles)

    def _descend(self, position: Array, rotation: Array | None, start: Array) -> tuple[Array, float, float]:
        """Angles, and by how many m and rad they miss."""
        rows = 6 if rotation is not None else 3
        q, error = np.clip(start, self.LOWER, self.UPPER), np.zeros(6)
        for _ in range(_STEPS):
            self._place(q)
            here, turn = self._pose()
            error[:3] = position - here
            if rotation is not None:
                error[3:] = Rotation.from_matrix(rotation @ turn.T).as_rotvec()
            slopes, miss = self._slopes()[:rows], error[:rows]
            free = np.ones(7, dtype=bool)
            while True:  # without the joints that stand at a limit and would go on
                movable, pull = slopes * free, free * (HOME - q) / 2
                # The damping vanishes with the error, lest the pull on the elbow move the tool.
                damped = movable @ movable.T + (miss @ miss / 2 + 1e-10) * np.eye(rows)
                step = movable.T @ np.linalg.solve(damped, miss - movable @ pull) + pull
                stuck = free & (((q >= self.UPPER) & (step > 0)) | ((q <= self.LOWER) & (step < 0)))
                if not stuck.any():
                    break
                free &= ~stuck
            step *= min(1.0, 0.3 / max(np.abs(step).max(), 1e-300))
            last, q = q, np.clip(q + step, self.LOWER, self.UPPER)
            if np.abs(q - last).max() < 1e-7:
                break
        self._place(q)
        here, turn = self._pose()
        askew = 0.0 if rotation is None else Rotation.from_matrix(rotation @ turn.T).magnitude()
        return q, float(np.linalg.norm(position - here)), float(askew)

    def _place(self, q: Array) -> None:
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)  # which Jacobians are taken from

    def _pose(self) -> tuple[Array, Array]:
        return self.data.site_xpos[self._site].copy(), self.data.site_xmat[self._site].reshape(3, 3).copy()

    def _slopes(self) -> Array:
        slopes = np.empty((6, 7))
        mujoco.mj_jacSite(self.model, self.data, slopes[:3], slopes[3:], self._site)
        return slopes


def _shaped(values: Array, name: str, *shape: int) -> Array:
    array = real_array(values, name)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers {shape}, got {array.shape} {array.ravel()[:9].tolist()}")
    return array


# --- runs -------------------------------------------------------------------------------------------------------------


class Record(NamedTuple):
    """What a run left, N samples of it.

    Attributes:
        times: (N,) s, from 0.
        q: (N, 7) rad.
        v: (N, 7) rad/s.
        torque: (N, 7) N m, as applied from then on.
        tool: (N, 3) m.
        hardest: largest torque asked for, over its limit; of all steps. What is above 1 was not given.
        fastest: largest velocity over its limit; of all steps.
    """

    times: Array
    q: Array
    v: Array
    torque: Array
    tool: Array
    hardest: float
    fastest: float


def simulate(
    arm: Arm,
    q0: Array,
    torque: Torque,
    seconds: float,
    disturb: Disturbance | None = None,
    dt: float = 1e-3,
    every: int = 10,
) -> Record:
    """The arm from rest under a controller that is asked every step, its torques cut off at the limits.

    Args:
        arm: whose ``data`` stays free for the controller; its model takes this ``dt``.
        q0: (7,) rad.
        torque: a controller.
        seconds: > 0.
        disturb: pushes or pulls at the tool.
        dt: s, of a step.
        every: steps from a sample to the next.

    Raises:
        ValueError: if the controller returns anything but seven finite numbers.
    """
    steps = round(positive(seconds, "seconds") / positive(dt, "dt"))
    every = whole_number(every, "every", at_least=1)
    model, data = arm.model, mujoco.MjData(arm.model)
    model.opt.timestep = dt
    site, hand = model.site("tool").id, model.body("link_7").id
    data.qpos[:] = _shaped(q0, "q0", 7)
    samples, hardest, fastest = [], 0.0, 0.0
    for i in range(steps + 1):
        mujoco.mj_step1(model, data)
        time, q, v = i * dt, data.qpos.copy(), data.qvel.copy()
        asked = _shaped(torque(time, q, v), "torque", 7)
        data.ctrl[:] = np.clip(asked, -arm.STRONGEST, arm.STRONGEST)
        hardest = max(hardest, float((np.abs(asked) / arm.STRONGEST).max()))
        fastest = max(fastest, float((np.abs(v) / arm.FASTEST).max()))
        if i % every == 0:
            samples.append((time, q, v, data.ctrl.copy(), data.site_xpos[site].copy()))
        if i == steps:
            break
        if disturb is not None:
            force = disturb(time)
            pushed = np.zeros(3) if force is None else _shaped(force, "disturb", 3)
            # MuJoCo lets it act on the link's centre of mass: at the tool it has a lever.
            data.xfrc_applied[hand] = (*pushed, *np.cross(data.site_xpos[site] - data.xipos[hand], pushed))
        mujoco.mj_step2(model, data)
    times, angles, velocities, torques, tool = (np.array(column) for column in zip(*samples, strict=True))
    return Record(times, angles, velocities, torques, tool, hardest, fastest)


class FollowJoints:
    """Follow a velocity field of the joints by computed torque: a controller for :func:`simulate`, new for each run.

    A reference starts where the arm is and moves by the field alone, never faster than the joints can (all shortened by
    one factor: it stays on its curve). The arm is drawn to it like a critically damped oscillator.

    Args:
        arm: as simulated.
        velocity_field: angles (7,) rad -> velocities (7,) rad/s, such as ``ds.controller()``.
        rate: 1/s, > 0: the gains are rate² on the angle and 2 rate on the velocity.
        dt: s, as simulated.

    Attributes:
        reference: (7,) rad, where the arm should be at the next call; None before the first.
        error: rad, the largest distance from the reference of any joint so far.
    """

    def __init__(
        self, arm: Arm, velocity_field: Callable[[Array], Array], rate: float = 20.0, dt: float = 1e-3
    ) -> None:
        self.arm, self.velocity_field = arm, velocity_field
        self.rate, self.dt = positive(rate, "rate"), positive(dt, "dt")
        self.reference: Array | None = None
        self.error = 0.0

    def __call__(self, time: float, q: Array, v: Array) -> Array:
        reference = q if self.reference is None else self.reference
        wanted = _shaped(self.velocity_field(reference), "velocity_field", 7)
        wanted /= max(1.0, (np.abs(wanted) / self.arm.FASTEST).max())
        self.error = max(self.error, float(np.abs(reference - q).max()))
        self.reference = reference + self.dt * wanted
        return self.arm.torques(q, v, self.rate**2 * (reference - q) + 2 * self.rate * (wanted - v))


# --- motions ----------------------------------------------------------------------------------------------------------


def kinesthetic(arm: Arm, seed: int, n_points: int = 500, seconds: float = 6.0) -> Demonstration:
    """A made-up guided motion: the tool along a spline through random poses, from rest to rest with the least jerk.

    Four to six points in front of the arm, the flange tilted from ``DOWN`` by up to 0.6 rad about each axis, in joint
    angles by :meth:`Arm.path`. What comes near the ends of the arm's reach or within 5 % of a joint's limit, or would
    take more than twice the time, is drawn again.

    Args:
        arm: whose tool moves.
        seed: 0 to 5; each makes another motion.
        n_points: N >= 3, even in time.
        seconds: > 0; longer if a joint would exceed half of its largest velocity.

    Returns:
        (N, 7) rad.
    """
    if not whole_number(seed, "seed", at_least=0) < len(KINESTHETIC):
        raise ValueError(f"seed: expected 0 to {len(KINESTHETIC) - 1}, got {seed}")
    random, seconds = np.random.default_rng(seed), positive(seconds, "seconds")
    share = np.linspace(0, 1, whole_number(n_points, "n_points", at_least=3))
    eased = share**3 * (10 - 15 * share + 6 * share**2)
    while True:
        count = random.integers(4, 7)
        points = random.uniform([0.3, -0.4, 0.2], [0.65, 0.4, 0.7], (count, 3))
        tilts = random.uniform(-0.6, 0.6, (count, 3))
        chords = arc_lengths(points)
        poses = CubicSpline(chords, np.hstack([points, tilts]))(eased * chords[-1])
        positions, rotations = poses[:, :3], Rotation.from_rotvec(poses[:, 3:]).as_matrix() @ DOWN
        wrists = positions - (HEIGHTS[7] - HEIGHTS[5] + arm.length) * rotations[:, :, 2]
        stretched = np.linalg.norm(wrists - SHOULDER, axis=1)
        if stretched.min() < 0.45 or stretched.max() > 0.78:  # the elbow's limits leave 0.41 to 0.82
            continue
        try:
            angles = arm.path(positions, rotations, HOME)
        except ValueError:
            continue
        dt = seconds / (len(share) - 1)
        slower = (np.abs(np.gradient(angles, dt, axis=0, edge_order=2)) / (0.5 * arm.FASTEST)).max()
        if slower <= 2 and (np.abs(angles) < 0.95 * arm.UPPER).all():
            return Demonstration(
                torch.from_numpy(angles), dt * max(1.0, slower), f"kinesthetic {KINESTHETIC[seed]}", columns=JOINTS
            )


def archimedean(radius: float = 0.15, n_points: int = 1000, seconds: float = 10.0) -> Demonstration:
    """The paper's planar spiral for the tool, (N, 3) m: flange ``DOWN``, horizontal, inward to ``CENTRE``."""
    flat = datasets.archimedean_spiral(n_points).positions.numpy() / 0.1
    return _drawn(np.column_stack([flat, np.zeros(len(flat))]), radius, seconds, "archimedean")


def unstable(radius: float = 0.20, n_points: int = 1000, seconds: float = 15.0) -> Demonstration:
    """The paper's unstable spiral, c = 7, for the tool, (N, 3) m: flange ``DOWN``, about ``CENTRE``, from the top.

    In 15 s the elbow comes to four fifths of its largest velocity; in 10 s it would exceed it.
    """
    return _drawn(datasets.unstable_spiral(7, n_points).positions.numpy(), radius, seconds, "unstable c=7")


def _drawn(shape: Array, radius: float, seconds: float, name: str) -> Demonstration:
    dt = positive(seconds, "seconds") / (len(shape) - 1)
    positions = torch.from_numpy(CENTRE + positive(radius, "radius") * shape)
    return Demonstration(positions, dt, name, columns=("x", "y", "z"))
