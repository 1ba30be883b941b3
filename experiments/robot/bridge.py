"""A learned motion in C, answering a robot cycle by cycle as KUKA's FRI and libfranka ask, against a robot played here.

    python -m experiments.robot.bridge [--seconds S] [--rate HZ]

Needs a C compiler and the loopback. ``bridge.c`` is what would run beside a real arm; docs/bridge.md says how.
"""

from __future__ import annotations

import math
import os
import shutil
import socket
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, NamedTuple

import numpy as np
import typer

from experiments import report
from latentds import TubeDS, datasets
from latentds.arguments import Array, positive
from latentds.base import LatentDS
from latentds.deploy import c

SOURCE = Path(__file__).with_suffix(".c")
OPTIONS = ("-std=c99", "-Wall", "-Wextra", "-O2", "-D_POSIX_C_SOURCE=200112L")
DATAGRAM = struct.Struct("=Q7d")
"""Sequence number; angles in rad, measured or commanded."""
STOP = 2**64 - 1
LEASH, SOFT_START = 0.2, 0.5
"""rad, s: as in ``bridge.c``."""
LAG = 0.02
"""s, of the joints behind their command."""
PATIENCE = 2.0
"""s for an answer that no clock waits for."""


def build(ds: LatentDS, folder: Path, *options: str) -> Path:
    """The program for a system of seven joints, compiled, its header beside it.

    Args:
        ds: as :func:`latentds.deploy.c.write` takes it, n = 7.
        folder: where header and program go.
        options: more for the compiler.

    Raises:
        ValueError: without a C compiler, for another dimension, or if the source does not compile.
    """
    if ds.dim != 7:
        raise ValueError(f"ds: expected seven joints, got {ds.dim}")
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        raise ValueError("build: expected a C compiler, cc or gcc, on the path, and there is none")
    c.write(ds, folder / "motion.h", name="motion")
    program = folder / "bridge"
    command = [compiler, *OPTIONS, *options, "-I", str(folder), str(SOURCE), "-o", str(program), "-lm"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise ValueError(f"build: {compiler} refused {SOURCE.name}:\n{done.stderr}")
    return program


@contextmanager
def running(program: Path, cycle: float) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """The program and the port that it listens on; killed at the end if it still runs."""
    with subprocess.Popen([program, repr(cycle)], stdout=subprocess.PIPE, text=True) as child:
        try:
            assert child.stdout is not None
            yield child, int(child.stdout.readline())
        finally:
            child.kill()  # of a program that has ended: nothing


class Run(NamedTuple):
    """What a robot of K cycles saw; rows that never came are NaN.

    Attributes:
        measured: (K, 7) rad, as sent.
        answers: (K, 7) rad, as received, late ones included.
        commands: (K, 7) rad, that the joints followed.
        missed: (K,) bool: no answer before the next cycle.
        round_trips: (K,) s, from sending to having read the answer.
        delays: (K,) s, from when a cycle should have begun to when it did; zero without a clock.
    """

    measured: Array
    answers: Array
    commands: Array
    missed: Array
    round_trips: Array
    delays: Array


def play(port: int, q: Array, cycles: int, cycle: float, *, lag: float = LAG, clock: bool = True) -> Run:
    """Be a robot: send the measured angles each cycle, and follow the command that answers them before the next.

    A command that comes late or never is not followed: the last one is kept. An answer counts from when it is read
    here, so that what this process loses to others counts as the client's.

    Args:
        port: of the client, on the loopback.
        q: (7,) rad, at rest.
        cycles: K >= 1.
        cycle: s, > 0.
        lag: s: the joints are low-pass filters of first order behind their command; 0 follow at once.
        clock: False waits for each answer, up to ``PATIENCE``, and not for any clock.
    """
    nan = np.full((cycles, 7), np.nan)
    run = Run(nan, nan.copy(), nan.copy(), np.ones(cycles, dtype=bool), nan[:, 0].copy(), np.zeros(cycles))
    q, command, sent = q.copy(), q.copy(), np.zeros(cycles)
    share = -math.expm1(-cycle / lag) if lag > 0 else 1.0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.connect(("127.0.0.1", port))

        def answered(k: int, deadline: float) -> bool:
            """Whether cycle k is answered by then; older answers that come meanwhile are noted."""
            while (left := deadline - time.perf_counter()) > 0:
                udp.settimeout(left)
                try:
                    data = udp.recv(DATAGRAM.size + 1)
                except TimeoutError:
                    return False
                if len(data) != DATAGRAM.size:
                    continue
                (sequence, *angles), now = DATAGRAM.unpack(data), time.perf_counter()
                if sequence < cycles:
                    run.answers[sequence], run.round_trips[sequence] = angles, now - sent[sequence]
                if sequence == k:
                    return now <= deadline
            return False

        began = time.perf_counter()
        for k in range(cycles):
            due = began + k * cycle
            if clock:
                time.sleep(max(0.0, due - time.perf_counter()))
            sent[k] = time.perf_counter()
            run.delays[k] = sent[k] - due if clock else 0.0
            run.measured[k] = q
            udp.send(DATAGRAM.pack(k, *q))
            if answered(k, due + cycle if clock else sent[k] + PATIENCE):
                command, run.missed[k] = run.answers[k].copy(), False
            run.commands[k] = command
            q += share * (command - q)
        if run.missed[-1]:
            answered(cycles - 1, time.perf_counter() + 0.1)
        udp.send(DATAGRAM.pack(STOP, *q))
    return run


def commanded(velocity_field: Callable[[Array], Array], measured: Array, cycle: float) -> Array:
    """What the program answers to measured angles (K, 7) rad, by another velocity field of the same system."""
    command, answers = measured[0].copy(), np.empty_like(measured)
    for k, q in enumerate(measured):
        if (np.abs(command - q) <= LEASH).all():
            command += cycle * min(1.0, k * cycle / SOFT_START) * velocity_field(command)
        answers[k] = command
    return answers


def lines(run: Run, expected: Array, goal: Array, cycle: float) -> list[list[str]]:
    """Rows of the table: what, and median, 99 % and worst, or one figure."""
    known = np.isfinite(run.round_trips)
    off = np.abs(run.answers - expected)[known].max(initial=0.0)
    speeds = np.abs(np.diff(run.answers, axis=0)).max(axis=1) / cycle
    short = np.abs(run.measured[-1] - goal).max()
    late = np.logical_and(run.missed, run.delays > cycle / 2)

    def three(values: Array) -> list[str]:
        return [f"{1e6 * value:.0f}" for value in (*np.quantile(values, (0.5, 0.99)), values.max())]

    def one(value: object) -> list[str]:
        return ["", "", str(value)]

    return [
        ["round trip [µs]", *(three(run.round_trips[known]) if known.any() else one("no answer"))],
        ["the robot's own clock, late by [µs]", *three(run.delays)],
        ["cycles", *one(len(known))],
        ["missed deadlines, last command kept", *one(run.missed.sum())],
        ["of them, robot itself late by half a cycle", *one(late.sum())],
        ["never answered", *one((~known).sum())],
        ["fastest command of a joint [rad/s]", *one(f"{np.nanmax(speeds, initial=0.0):.2f}")],
        ["farthest from Python's commands [rad]", *one(f"{off:.1g}")],
        ["from the goal at the end [rad]", *one(f"{short:.2g}")],
    ]


def main(
    seconds: Annotated[float, typer.Option(help="How long; the motion takes about 11.")] = 12.0,
    rate: Annotated[float, typer.Option(help="Cycles a second.")] = 1000.0,
) -> None:
    """Answer a played robot from C, and tell how fast, how often too late, and whether as Python would."""
    cycle = 1 / positive(rate, "rate")
    cycles = max(2, round(positive(seconds, "seconds") * rate))
    shown = datasets.joint_motion(0)
    ds = TubeDS(7).fit(shown)
    with TemporaryDirectory() as folder:
        try:
            program = build(ds, Path(folder))
        except ValueError as error:
            typer.echo(error, err=True)
            raise typer.Exit(1) from None
        with running(program, cycle) as (child, port):
            run = play(port, shown.start.numpy(), cycles, cycle)
            ended = child.wait(timeout=PATIENCE)
    expected = commanded(ds.controller(), run.measured, cycle)
    typer.echo(report.table(["", "median", "99 %", "worst"], lines(run, expected, shown.goal.numpy(), cycle)))
    where = report.environment()
    load = f", load average {os.getloadavg()[0]:.1f}"
    typer.echo(f"\nThe program ended with status {ended}. {where['cores']} cores of {where['cpu']}{load},")
    typer.echo(f"{where['platform']}, revision {where['revision']}, {where['date'][:10]}.")


if __name__ == "__main__":
    typer.run(main)
