"""What a learned system does on the arm: undisturbed, pushed, held, its goal moved, and with something in its way."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from experiments.robot.arm import DOWN, HOME, Arm, FollowJoints, Record, simulate
from latentds import Demonstration, StableDS, metrics
from latentds.arguments import Array
from latentds.benchmark import Cell
from latentds.curves import evenly_resampled
from latentds.deploy.passive import PassiveController
from latentds.modulation import AvoidingDS, sphere

DT = 1e-3
ALONG, ACROSS = 1000.0, 1500.0
"""N s/m, damping of the tool along its motion and across it."""
ENERGY, STRONGEST = 4.0, 120.0
"""J that the passive controller may give beyond what it gets back, and N of its force."""
TURN, TURN_DAMPING = 60.0, 6.0
"""N m/rad and N m s/rad, which hold the tool's orientation."""
ELBOW, ELBOW_DAMPING = 5.0, 5.0
"""N m/rad toward the middle posture and N m s/rad, where they do not move the tool."""
PUSH, PUSH_SECONDS, HOLD_SECONDS = 40.0, 0.2, 1.0
"""N for so long, across the motion and half-way; and how long somebody holds the tool there."""
GRIP, GRIP_DAMPING = 4000.0, 150.0
"""N/m and N s/m of the hand that holds."""
SHIFT = np.array([0.0, 0.05, 0.03])
"""m, by which the goal moves after a third of the motion."""
RADIUS, MARGIN = 0.03, 0.01
"""m, of the ball on the path two thirds of the way, and how far the tool is to stay away from it."""
PATIENCE = 1.6
"""Durations that an undisturbed run is given; a held one has the second that it lost on top."""
NEAR = 0.02
"""A motion has arrived when it stays within so many sizes of its goal."""
N_POINTS, DRAWN_POINTS = 500, 300
"""Of a run for its score, and of what is kept for pictures."""


def measured(ds: StableDS, cell: Cell) -> dict[str, Any]:
    """For a cell's ``measure``: all figures of one system, of a tool's motion (n = 3) or of the joints' (n = 7)."""
    (shown,) = cell.shown
    return of_tool(ds, shown) if ds.dim == 3 else of_joints(ds, shown)


# --- the tool, by forces ----------------------------------------------------------------------------------------------


class PassiveTool:
    """Torques of a passive controller of the tool's position, its orientation held ``DOWN``: g(q) + Jᵀ (F, moment).

    The joints' friction is made up for, as the arm's own torque control does; else it would drain the tank.

    Attributes:
        passive: of the position.
        x, velocity: (3,) of the tool, as of the last call.
        least: J, the least that the tank ever held.
    """

    def __init__(self, arm: Arm, field: Callable[..., Any], each_step: Callable[[float], None] | None = None) -> None:
        self.arm, self.each_step = arm, each_step
        self.passive = PassiveController(field, 3, along=ALONG, across=ACROSS, energy=ENERGY, max_force=STRONGEST)
        self.x, self.velocity, self.least = np.zeros(3), np.zeros(3), ENERGY

    def __call__(self, time: float, q: Array, v: Array) -> Array:
        if self.each_step is not None:
            self.each_step(time)
        self.x, rotation = self.arm.forward(q)
        slopes = self.arm.jacobian(q)
        moving = slopes @ v
        self.velocity = moving[:3].copy()
        force = self.passive(self.x, self.velocity, DT)
        self.least = min(self.least, self.passive.tank)
        moment = TURN * Rotation.from_matrix(DOWN @ rotation.T).as_rotvec() - TURN_DAMPING * moving[3:]
        aside = ELBOW * (HOME - q) - ELBOW_DAMPING * v
        aside -= slopes.T @ np.linalg.solve(slopes @ slopes.T, slopes @ aside)
        torque: Array = (
            self.arm.bias(q, np.zeros(7)) + self.arm.DAMPING * v + slopes.T @ np.concatenate([force, moment]) + aside
        )
        return torque


def of_tool(ds: StableDS, shown: Demonstration) -> dict[str, Any]:
    """The five runs of a system of the tool's position."""
    arm, curve, goal = Arm(), shown.positions.numpy(), shown.goal.numpy()
    begin, half, size = arm.inverse(shown.start.numpy(), DOWN, HOME), 0.5 * shown.duration, shown.size

    def run(controller: PassiveTool, seconds: float, disturb: Any = None) -> Record:
        return simulate(arm, begin, controller, seconds, disturb, DT)

    free_tool = PassiveTool(arm, ds.controller())
    free = run(free_tool, PATIENCE * shown.duration)
    figures: dict[str, Any] = scores(free.tool, curve)
    figures |= {"off_mm": 1e3 * gaps(free.tool, curve).max(), "tank": free_tool.least / ENERGY}
    figures |= loads(free) | {"arrival": arrival(free, free.tool, goal, size) / shown.duration}

    across = np.cross(shown.velocities[len(shown) // 2].numpy(), [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    tool = PassiveTool(arm, ds.controller())
    pushed = run(tool, PATIENCE * shown.duration, lambda t: PUSH * across if half <= t < half + PUSH_SECONDS else None)
    off = gaps(pushed.tool, curve)
    figures |= {"push_off_mm": 1e3 * off.max(), "push_back_s": time_back(pushed, off, half, size)}
    figures |= {"push_end_mm": 1e3 * np.linalg.norm(pushed.tool[-1] - goal), "push_tank": tool.least / ENERGY}

    held_tool = PassiveTool(arm, ds.controller())
    where: list[Array] = []

    def grip(t: float) -> Array | None:
        if not half <= t < half + HOLD_SECONDS:
            return None
        where.append(held_tool.x)
        force: Array = GRIP * (where[0] - held_tool.x) - GRIP_DAMPING * held_tool.velocity
        return force

    held = run(held_tool, PATIENCE * shown.duration + HOLD_SECONDS, grip)
    figures |= {"hold_off_mm": 1e3 * gaps(held.tool, curve).max()}
    lost = arrival(held, held.tool, goal, size) - arrival(free, free.tool, goal, size)
    figures |= {"hold_later_s": math.inf if math.isnan(lost) else lost}

    field = ds.controller()

    def move(t: float) -> None:
        if t >= shown.duration / 3:
            field.approach(DT, 0.3, goal=goal + SHIFT)

    moved = run(PassiveTool(arm, field, move), PATIENCE * shown.duration)
    figures |= {"goal_off_mm": 1e3 * np.linalg.norm(moved.tool[-1] - goal - SHIFT)}

    ball = shown.positions[2 * len(shown) // 3].numpy()
    around = run(PassiveTool(arm, AvoidingDS(ds, [sphere(ball, RADIUS)], MARGIN).controller()), 2 * shown.duration)
    clear = np.linalg.norm(around.tool - ball, axis=1).min() - RADIUS
    figures |= {"clear_mm": 1e3 * clear, "around_end_mm": 1e3 * np.linalg.norm(around.tool[-1] - goal)}
    runs = {"free": free, "pushed": pushed, "held": held, "moved": moved, "around": around}
    kept = {name: thinned(record.tool) for name, record in runs.items()}
    return plain(figures) | {"drawn": json.dumps(kept | {"angles": thinned(free.q), "ball": ball.tolist()})}


# --- the joints, by positions -----------------------------------------------------------------------------------------


def of_joints(ds: StableDS, shown: Demonstration) -> dict[str, Any]:
    """Two runs of a system of seven joint angles, by computed torque: undisturbed, and pushed at the tool."""
    arm, curve, goal = Arm(), shown.positions.numpy(), shown.goal.numpy()
    if (beyond := np.abs(curve).max(0) / Arm.UPPER).max() >= 1:
        worst = int(beyond.argmax())
        raise ValueError(
            f"data: expected angles within the arm's limits, rad, got {shown.name} with joint {worst + 1} at "
            f"{np.abs(curve[:, worst]).max():.2f}, beyond {Arm.UPPER[worst]:.2f}"
        )
    half, drawn = 0.5 * shown.duration, np.array([arm.forward(q)[0] for q in curve])
    follow = FollowJoints(arm, ds.controller(), dt=DT)
    free = simulate(arm, curve[0], follow, PATIENCE * shown.duration, None, DT)
    figures: dict[str, Any] = scores(free.q, curve) | loads(free)
    figures |= {"track_rad": follow.error, "off_mm": 1e3 * gaps(free.tool, drawn).max()}
    figures |= {"arrival": arrival(free, free.q, goal, shown.size) / shown.duration}
    pushing = FollowJoints(arm, ds.controller(), dt=DT)
    down = np.array([0.0, 0.0, -PUSH])
    pushed = simulate(
        arm,
        curve[0],
        pushing,
        PATIENCE * shown.duration,
        lambda t: down if half <= t < half + PUSH_SECONDS else None,
        DT,
    )
    figures |= {"push_off_mm": 1e3 * gaps(pushed.tool, drawn).max(), "push_track_rad": pushing.error}
    figures |= {"push_end_rad": float(np.abs(pushed.q[-1] - goal).max())}
    kept = {"free": thinned(free.tool), "shown": thinned(drawn)}
    return plain(figures) | {"drawn": json.dumps(kept)}


# --- figures ----------------------------------------------------------------------------------------------------------


def scores(path: Array, curve: Array) -> dict[str, float]:
    """FastDTW (radius 1), the paper's, a raw sum over ``N_POINTS`` even points of each; exact DTW over their number.

    Points are even along the curves: where a robot waits does not count.
    """
    ours, theirs = (evenly_resampled(one, N_POINTS) for one in (path, curve))
    return {"fast": metrics.fast_dtw(ours, theirs), "exact": metrics.dtw(ours, theirs) / N_POINTS}


def loads(record: Record) -> dict[str, float]:
    """Largest torque and velocity over what the arm can."""
    return {"torque": record.hardest, "speed": record.fastest}


def gaps(path: Array, curve: Array) -> Array:
    """Distance of each point of a path from the nearest sample of the curve."""
    a, b = torch.from_numpy(np.ascontiguousarray(path)), torch.from_numpy(np.ascontiguousarray(curve))
    nearest: Array = torch.cdist(a, b).amin(1).numpy()
    return nearest


def arrival(record: Record, path: Array, goal: Array, size: float) -> float:
    """Seconds until it stays within ``NEAR`` sizes of the goal; inf if it does not."""
    away = np.flatnonzero(np.linalg.norm(path - goal, axis=1) > NEAR * size)
    last = away[-1] + 1 if len(away) else 0
    return float(record.times[last]) if last < len(path) else math.inf


def time_back(record: Record, off: Array, since: float, size: float) -> float:
    """Seconds from a push until the tool stays within ``NEAR`` sizes of the curve; inf if it does not."""
    away = np.flatnonzero(off > NEAR * size)
    if not len(away):
        return 0.0
    return float(record.times[away[-1] + 1]) - since if away[-1] + 1 < len(off) else math.inf


def thinned(path: Array) -> list[Any]:
    """For a picture."""
    rows: list[Any] = path[np.linspace(0, len(path) - 1, DRAWN_POINTS).astype(int)].round(4).tolist()
    return rows


def plain(figures: dict[str, Any]) -> dict[str, float]:
    return {name: float(value) for name, value in figures.items()}
