"""The C client of an arm commands what Python would, ignores what is no datagram, waits for a held arm, and ends."""

from __future__ import annotations

import shutil
import socket
import threading

import numpy as np
import pytest

from experiments.robot import bridge
from experiments.robot.bridge import DATAGRAM, LEASH, STOP, build, commanded, lines, play, running
from latentds import TubeDS, datasets

STRICT = ("-Werror", "-pedantic", "-Wconversion", "-Wdouble-promotion", "-Wshadow")
needs_compiler = pytest.mark.skipif(not (shutil.which("cc") or shutil.which("gcc")), reason="needs a C compiler")


@pytest.fixture(scope="module")
def shown():
    return datasets.joint_motion(0, n_points=200)


@pytest.fixture(scope="module")
def ds(shown):
    return TubeDS(7, n_layers=40).fit(shown)


@pytest.fixture(scope="module")
def program(ds, tmp_path_factory):
    return build(ds, tmp_path_factory.mktemp("bridge"), *STRICT)


@needs_compiler
def test_commands_as_python_would_arrives_and_ends_when_told(program, ds, shown):
    cycle, goal = 0.01, shown.goal.numpy()
    with running(program, cycle) as (child, port):
        run = play(port, shown.start.numpy(), 1500, cycle, clock=False)
        assert child.wait(timeout=5) == 0
    assert not run.missed.any()
    expected = commanded(ds.controller(), run.measured, cycle)
    assert np.abs(run.answers - expected).max() <= 1e-9
    assert np.array_equal(run.commands, run.answers)
    assert np.abs(run.measured[-1] - goal).max() < 0.01
    table = {row[0]: row[-1] for row in lines(run, expected, goal, cycle)}
    assert table["cycles"] == "1500"
    assert table["missed deadlines, last command kept"] == table["never answered"] == "0"


@needs_compiler
def test_starts_softly(program, shown):
    with running(program, 1e-3) as (_, port):
        answers = play(port, shown.start.numpy(), 1000, 1e-3, clock=False).answers
    assert np.array_equal(answers[0], shown.start.numpy())
    accelerations = np.abs(np.diff(answers, n=2, axis=0)) / 1e-6
    assert accelerations.max() < 10  # rad/s²; a tenth of a rad/s at once would be a hundred


@needs_compiler
def test_waits_for_an_arm_that_is_held(program, ds, shown):
    with running(program, 0.01) as (_, port):
        run = play(port, shown.start.numpy(), 400, 0.01, lag=np.inf, clock=False)
    away = np.abs(run.answers - run.measured).max(axis=1)
    assert LEASH < away[-1] < LEASH + 0.05
    assert np.array_equal(run.answers[-1], run.answers[-2])
    assert np.abs(run.answers - commanded(ds.controller(), run.measured, 0.01)).max() <= 1e-9


@needs_compiler
def test_what_is_no_datagram_is_not_answered(program, shown):
    good = DATAGRAM.pack(7, *shown.start.tolist())
    with running(program, 1e-3) as (child, port), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.connect(("127.0.0.1", port))
        udp.settimeout(5)
        for data in (b"", good[:-1], good + b"\0", DATAGRAM.pack(6, *[np.nan] * 7), good):
            udp.send(data)
        sequence, *angles = DATAGRAM.unpack(udp.recv(100))
        assert sequence == 7
        assert angles == shown.start.tolist()  # the first command: where the arm is
        udp.send(DATAGRAM.pack(STOP, *angles))
        assert child.wait(timeout=5) == 0
        udp.setblocking(False)
        with pytest.raises((BlockingIOError, ConnectionRefusedError)):
            udp.recv(100)


@needs_compiler
def test_is_killed_when_the_robot_fails(program):
    with pytest.raises(RuntimeError, match="robot"), running(program, 1e-3) as (child, _):
        raise RuntimeError("robot")
    assert child.returncode is not None


def test_a_missed_answer_keeps_the_last_command():
    """A client that leaves out every third answer, and sends it too late, is followed but for that."""
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.bind(("127.0.0.1", 0))
    client.settimeout(5)

    def serve():
        kept = None
        while (got := client.recvfrom(100))[0] and (sequence := DATAGRAM.unpack(got[0])[0]) != STOP:
            answer = DATAGRAM.pack(sequence, *[0.1 * sequence] * 7)
            if kept is not None:
                client.sendto(kept, got[1])
            kept = answer if sequence % 3 == 2 else None
            if kept is None:
                client.sendto(answer, got[1])

    thread = threading.Thread(target=serve)
    thread.start()
    run = play(client.getsockname()[1], np.zeros(7), 20, 0.02, lag=0)
    thread.join(timeout=5)
    client.close()
    assert run.missed[2::3].all()
    for k in range(1, 20):
        kept = run.commands[k - 1] if run.missed[k] else run.answers[k]
        assert np.array_equal(run.commands[k], kept)
    assert np.allclose(run.answers[:, 0], 0.1 * np.arange(20))  # late ones are noted, not followed
    assert np.array_equal(run.measured[1:], run.commands[:-1])


def test_says_what_it_needs(ds, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="seven joints"):
        build(TubeDS(2), tmp_path)
    monkeypatch.setattr(bridge.shutil, "which", lambda name: None)
    with pytest.raises(ValueError, match="C compiler"):
        build(ds, tmp_path)
