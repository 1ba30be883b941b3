"""What the arm's study tells: tables, light paintings, and a short animation."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from PIL import Image

from experiments import report
from experiments.published import TABLE_THREE
from experiments.robot.arm import Arm
from experiments.robot.runs import (
    ACROSS,
    ALONG,
    ENERGY,
    HOLD_SECONDS,
    MARGIN,
    N_POINTS,
    NEAR,
    PUSH,
    PUSH_SECONDS,
    RADIUS,
    SHIFT,
    STRONGEST,
)
from latentds import Demonstration
from latentds.arguments import Array
from latentds.files import atomic_write
from latentds.plotting import color_of

VIEW = np.array([[0.5, 0.866, 0.0], [-0.612, 0.354, 0.707]])
"""Right and up of the pictures, in the frame of the base: from the front, half from above and from the side."""
FRAMES, FRAME_MS, GIF_COLORS = 60, 80, 64
SHOWN_LIGHT = "#9BD1FF"


def document(rows: pd.DataFrame, pictures: Sequence[Path]) -> str:
    """The page, in Markdown."""
    tools = rows[rows["dim"] == 3]
    joints = rows[rows["dim"] == 7]
    parts = ["# On the paper's arm, simulated"]
    parts += [f"![{CAPTIONS[one.stem]}](images/robot/{one.name})" for one in pictures if one.stem == "paintings"]
    parts += [CAPTIONS["paintings"] + ".", verdict(rows), HEAD]
    if len(tools):
        parts += ["## The tool, by forces", TOLD_TOOL, table(tools, TOOL)]
        parts += [
            "## Touched, held, told otherwise, and with something in the way",
            TOLD_TOUCHED,
            table(tools, TOUCHED),
        ]
        parts += [f"![{CAPTIONS[p.stem]}](images/robot/{p.name})" for p in pictures if p.stem in ("touched", "run")]
    if len(joints):
        parts += ["## The joints, by positions, beside the paper's Table III", TOLD_JOINTS, joint_table(joints)]
    where = report.environment()
    parts += [
        "## How it was measured",
        f"{TOLD_ARM} Revision {where['revision']}, {where['date'][:10]}, {where['cores']} cores of {where['cpu']}, "
        f"MuJoCo {version('mujoco')}.",
    ]
    return "\n\n".join(parts) + "\n"


HEAD = "Written by `make robot ARGS='--doc docs/robot.md'`; do not edit."
TOLD_ARM = (
    "The arm is ours, in MuJoCo: a KUKA LBR iiwa 14 from published lengths, limits and masses "
    "(`experiments/robot/arm.py` cites them), its shape and friction made up; torques at 1 kHz, cut off at the "
    "limits, without noise, delay or flexible gears. Methods have their defaults, Chebyshev and FDM the "
    "paper's rule for β, μ, M."
)
TOLD_TOOL = (
    "The paper's two motions of the end effector at its sizes, flange down: g(q) + Jᵀ F, F from the passive "
    f"controller with {ALONG:g} N s/m along the motion, {ACROSS:g} across, {ENERGY:g} J and at most "
    f"{STRONGEST:g} N. FastDTW: raw, in m, of {N_POINTS} points even along the curves. Farthest: the tool from "
    f"the curve. Arrives within {NEAR:g} sizes, in durations. Torque and speed: the largest over the arm's "
    "limits. Tank: the least that it held, of its capacity."
)
TOLD_TOUCHED = (
    f"Pushed: {PUSH:g} N for {PUSH_SECONDS:g} s, half-way, across the motion; how far off, and seconds until "
    f"within {NEAR:g} sizes of the curve again. Held: by a stiff hand for {HOLD_SECONDS:g} s, half-way; how "
    f"much later it arrives: a field waits. Goal moved: by {1e3 * np.linalg.norm(SHIFT):.0f} mm from a third of "
    f"the motion on; how far from it the tool ends. Obstacle: a ball of {1e3 * RADIUS:g} mm on the curve, two "
    f"thirds of the way, to be passed at {1e3 * MARGIN:g} mm; the least distance from its surface, and of the "
    "end from the goal."
)
TOLD_JOINTS = (
    "Angles from the integrated field, followed by computed torque. The paper's six recordings are not public; "
    "ours are made up (tool through random poses, by inverse kinematics), so that the columns stand beside "
    f"each other and cannot be compared line by line. FastDTW: raw, in rad, of {N_POINTS} points; exact DTW: "
    "over their number. Tracking: the largest of any joint. Tool: the farthest from where it was shown. "
    f"Pushed: {PUSH:g} N for {PUSH_SECONDS:g} s down."
)
TOOL = {
    "fast": ("FastDTW", "{:.2f}"),
    "exact": ("exact DTW [m]", "{:.4f}"),
    "off_mm": ("farthest [mm]", "{:.1f}"),
    "arrival": ("arrives", "{:.2f}"),
    "torque": ("torque", "{:.2f}"),
    "speed": ("speed", "{:.2f}"),
    "tank": ("tank", "{:.0%}"),
}
TOUCHED = {
    "push_off_mm": ("pushed, off [mm]", "{:.0f}"),
    "push_back_s": ("back after [s]", "{:.2f}"),
    "hold_later_s": ("held, later by [s]", "{:.2f}"),
    "goal_off_mm": ("goal moved, end off [mm]", "{:.1f}"),
    "clear_mm": ("obstacle, clear by [mm]", "{:.1f}"),
    "around_end_mm": ("obstacle, end off [mm]", "{:.1f}"),
}
JOINTS = {
    "fast": ("FastDTW", "{:.2f}"),
    "exact": ("exact DTW [rad]", "{:.4f}"),
    "track_rad": ("tracking [rad]", "{:.4f}"),
    "off_mm": ("tool [mm]", "{:.1f}"),
    "arrival": ("arrives", "{:.2f}"),
    "torque": ("torque", "{:.2f}"),
    "speed": ("speed", "{:.2f}"),
    "push_off_mm": ("pushed, tool [mm]", "{:.1f}"),
}
CAPTIONS = {
    "paintings": "Light paintings: the tool's light in a long exposure, of what was shown, pale, and of three methods",
    "touched": "TubeDS pushed, held, its goal moved, and around a ball, over what was shown, dashed",
    "run": "The arm draws a spiral",
}


def verdict(rows: pd.DataFrame) -> str:
    """What holds for all runs of a method, in words."""
    told = []
    for method, of in rows.groupby("method", sort=False):
        late = int((~np.isfinite(of["arrival"])).sum())
        limits = of[["torque", "speed"]].max().max()
        tools = of[of["dim"] == 3]
        touched = ""
        if len(tools):
            back = "comes back from every push" if np.isfinite(tools["push_back_s"]).all() else "is lost after a push"
            touched = f", {back}, stays {tools['clear_mm'].min():.1f} mm clear of the ball"
        told.append(
            f"{method} arrives in {len(of) - late} of {len(of)} undisturbed runs at {limits:.0%} of the arm's limits "
            f"at most, at worst {of['off_mm'].max():.1f} mm from the shown tool path{touched}"
        )
    return "; ".join(told) + "."


def table(rows: pd.DataFrame, columns: dict[str, tuple[str, str]]) -> str:
    header = ["motion", "method", "follows", *(title for title, _ in columns.values())]
    lines = [
        [
            row["motion"],
            row["method"],
            "yes" if row["follows"] else "**no**",
            *(_told(row[key], form) for key, (_, form) in columns.items()),
        ]
        for row in rows.to_dict("records")
    ]
    return report.table(header, lines)


def joint_table(rows: pd.DataFrame) -> str:
    """Each made-up motion beside a case of the paper, which is another motion."""
    cases = dict(zip(dict.fromkeys(rows["motion"]), TABLE_THREE.items(), strict=False))
    named = rows.assign(motion=[_beside(motion, cases.get(motion)) for motion in rows["motion"]])
    return table(named, JOINTS)


def _beside(motion: str, case: tuple[str, float] | None) -> str:
    return motion if case is None else f"{motion} (paper's {case[0]}: {case[1]})"


def _told(value: Any, form: str) -> str:
    return form.format(value) if isinstance(value, float) and math.isfinite(value) else "—"


# --- pictures ---------------------------------------------------------------------------------------------------------


def pictures(rows: pd.DataFrame, every: Sequence[Demonstration], out: Path) -> list[Path]:
    """Draw what there is into that folder."""
    out.mkdir(parents=True, exist_ok=True)
    drawn = {(row["motion"], row["method"]): json.loads(row["drawn"]) for row in rows.to_dict("records")}
    figures = {"paintings": paintings(drawn, every)}
    tools = [one for one in every if one.dim == 3 and (one.name, "TubeDS") in drawn]
    if tools:
        figures["touched"] = touched(drawn, tools)
    paths = []
    for name, figure in figures.items():
        paths.append(out / f"{name}.png")
        figure.savefig(paths[-1], dpi=90, facecolor=figure.get_facecolor())
        with Image.open(paths[-1]) as picture:
            picture.convert("RGB").quantize(128).save(paths[-1], optimize=True)
    if tools:
        paths.append(out / "run.gif")
        animate(paths[-1], drawn[tools[-1].name, "TubeDS"])
    return paths


def paintings(drawn: dict[tuple[str, str], Any], every: Sequence[Demonstration]) -> Figure:
    """A row a method, a column a motion: light on black, as a camera sees that stays open."""
    methods = list(dict.fromkeys(method for _, method in drawn))
    figure = Figure(figsize=(2.2 * len(every), 2.3 * len(methods)), layout="constrained", facecolor="black")
    grid = figure.subplots(len(methods), len(every), squeeze=False)
    for across, method in zip(grid, methods, strict=True):
        for ax, shown in zip(across, every, strict=True):
            ax.set_axis_off()
            ax.set_aspect("equal")
            if (kept := drawn.get((shown.name, method))) is None:
                continue
            curve = np.array(kept["shown"]) if shown.dim == 7 else shown.positions.numpy()
            light(ax, curve, SHOWN_LIGHT, 0.25)
            light(ax, np.array(kept["free"]), color_of(method), 1.0)
            if ax in grid[0]:
                ax.set_title(shown.name, color="white", fontsize=8)
        across[0].text(
            -0.02, 0.5, method, color="white", fontsize=9, rotation=90, ha="right", va="center",
            transform=across[0].transAxes,
        )  # fmt: skip
    return figure


def light(ax: Any, path: Array, color: str, share: float) -> None:
    """A line that glows: wide and faint under narrow and bright."""
    x, y = VIEW @ path.T
    for width, alpha in ((9, 0.05), (5, 0.1), (2.5, 0.3), (1.0, 1.0)):
        ax.plot(x, y, color=color, lw=width, alpha=share * alpha, solid_capstyle="round")
    ax.plot(x, y, color="white", lw=0.4, alpha=share)


def touched(drawn: dict[tuple[str, str], Any], tools: Sequence[Demonstration]) -> Figure:
    """The four disturbed runs of TubeDS, a row a motion."""
    names = {"pushed": "pushed", "held": "held", "moved": "goal moved", "around": "around a ball"}
    figure = Figure(figsize=(2.9 * len(names), 2.9 * len(tools)), layout="constrained")
    for across, shown in zip(figure.subplots(len(tools), len(names), squeeze=False), tools, strict=True):
        kept = drawn[shown.name, "TubeDS"]
        for ax, (run, title) in zip(across, names.items(), strict=True):
            if run == "around":
                turn = np.linspace(0, 2 * np.pi, 60)
                ax.fill(*(VIEW @ np.array(kept["ball"])[:, None] + RADIUS * np.array([np.cos(turn), np.sin(turn)])),
                        color="#BBBBBB")  # fmt: skip
            ax.plot(*(VIEW @ shown.positions.numpy().T), "--", color="#222222", lw=0.9)
            ax.plot(*(VIEW @ np.array(kept[run]).T), color=color_of("TubeDS"), lw=1.2)
            ax.set_aspect("equal")
            ax.set(xticks=[], yticks=[], title=f"{shown.name}: {title}")
            ax.title.set_fontsize(9)
    return figure


def animate(path: Path, kept: Any) -> None:
    """The arm as a line, and the light that its tool leaves."""
    arm, angles, tool = Arm(), np.array(kept["angles"]), np.array(kept["free"])
    last = int(np.argmax(np.linalg.norm(tool - tool[-1], axis=1) < 2e-3)) or len(tool) - 1
    frames = []
    for k in np.linspace(1, last, FRAMES).astype(int):
        figure = Figure(figsize=(4.6, 4.6), facecolor="black")
        ax = figure.add_axes((0, 0, 1, 1))
        ax.set_axis_off()
        ax.plot(*(VIEW @ arm.links(angles[k]).T), "-o", color="#888888", lw=6, ms=7, solid_capstyle="round")
        light(ax, tool[: k + 1], color_of("TubeDS"), 1.0)
        ax.set(xlim=(-0.45, 0.75), ylim=(-0.5, 0.7))
        with io.BytesIO() as file:
            figure.savefig(file, dpi=80, facecolor="black", format="png")
            frames.append(Image.open(file).convert("RGB").quantize(GIF_COLORS))
    with atomic_write(path) as out:
        frames[0].save(out, format="GIF", save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0)
