"""Which columns are what: taken for what was meant, or asked about with the argument that settles it."""

from __future__ import annotations

import contextlib
import logging
import pickle
from dataclasses import replace

import numpy as np
import pytest

from latentds import Demonstration
from tests.recordings.tables import DT, JOINTS, READ, T1, TAU, XYZ, N, Q, T, V, archive, as_json, lists, text


@pytest.mark.parametrize(
    ("name", "kind", "columns"),
    [
        ("header", "comma", ("x", "y", "z")),
        ("no header", "no header", ()),
        ("left out", "velocities and efforts", ("q1", "q2", "q3")),
        ("names beside", "lists in cells", tuple(JOINTS)),
        ("one row per joint", "one row per joint", tuple(JOINTS)),
        ("trajectory", "JSON, ROS trajectory", tuple(JOINTS)),
        ("an array", "npz", ()),
    ],
)
def test_keeps_the_names_through_files_pickles_and_copies(name, kind, columns, tmp_path):
    file, write = READ[kind]
    write(tmp_path / file)
    shown = Demonstration.load(tmp_path / file, name=name)
    assert shown.columns == columns
    shown.save(tmp_path / "saved.npz")
    for back in (Demonstration.load(tmp_path / "saved.npz"), pickle.loads(pickle.dumps(shown)), replace(shown)):
        assert (back.columns, back.name) == (columns, name)
        np.testing.assert_array_equal(back.positions, shown.positions)


@pytest.mark.parametrize("dt", [1e-9, 1.0, 1e6])
@pytest.mark.parametrize("suffix", [".csv", ".npz"])
def test_its_own_files_are_read_whatever_their_time(dt, suffix, tmp_path):
    shown = Demonstration(Q, dt)
    shown.save(tmp_path / f"a{suffix}")
    back = Demonstration.load(tmp_path / f"a{suffix}")
    assert back.dt == pytest.approx(dt)
    assert back.columns == ()
    np.testing.assert_allclose(back.positions, Q, atol=1e-14)


def test_says_what_was_understood(tmp_path, caplog):
    READ["velocities and efforts"][1](tmp_path / "a.csv")
    with caplog.at_level(logging.INFO, logger="latentds"):
        shown = Demonstration.load(tmp_path / "a.csv")
    assert caplog.messages == [shown.origin]
    assert shown.origin == (
        "a.csv: 60 rows; time 't' in s, the unit that makes sense: 1.18 s; positions q1, q2, q3; "
        "left out dq1, dq2, dq3 (velocity), tau_1, tau_2, tau_3 (effort)"
    )


RAMP = np.linspace(1, 3, N)
REFUSED = {
    "no time": ("a.csv", text("x,y,z", Q), "dt: .*a.csv holds x 60, y 60, z 60"),
    "no time, npy": ("a.npy", lambda p: np.save(p, Q), "dt: .*pass dt="),
    "rows numbered instead": ("a.csv", text("", [str(i) for i in range(N)], Q), "unit: .*row number"),
    "time or rows": ("a.csv", text(XYZ, [str(i) for i in range(N)], Q), "unit: .*row number"),
    "two units make sense": ("a.csv", text(XYZ, (0.5 + np.arange(N) * 10)[:, None] / 5, Q), "unit: .*s or ms"),
    "a minute a row": ("a.csv", text("time_s,x,y,z", 60e3 * T1, Q), "unit: .* in s"),
    "seconds called milliseconds": ("a.csv", text("t_ms,x,y,z", T1, Q), "unit: .* in ms"),
    "dt of an hour": ("a.npz", archive(q=Q, dt=3600.0), "dt: .*got 3600 from 'dt'"),
    "two clocks": ("a.csv", text("sim_time,wall_time,x,y,z", T1, 1.5 * T1, Q), "time: .*'sim_time', 'wall_time'"),
    "clock and dt differ": ("a.npz", archive(q=Q, t=T, dt=0.5), "time: .*0.02 .* 0.5 by 'dt'"),
    "two that rise evenly": ("a.csv", text("", T1, RAMP[:, None], Q), "time: .*0, 1.*pass dt="),
    "time twice the same": ("a.csv", text(XYZ, np.repeat(T[::2], 2)[:, None], Q), "times: .*'t'.* pass time= or dt="),
    "time with a gap": ("a.csv", text(XYZ, ["0.0", "", *map(str, T[2:])], Q), "time: .*row 1"),
    "joints and hand": ("a.csv", text("t,q1,q2,q3,x,y,z", T1, Q, Q + 1), "columns: .*pass columns="),
    "two arms": ("a.npz", archive(left=Q, right=Q, t=T), "columns: .*left 60×3, right 60×3"),
    "several motions": ("a.npz", archive(q_0=Q, q_1=Q[5:], dt=DT), "episode: .*by names .*: q_0, q_1; pass"),
    "raw and filtered": ("a.csv", text("t,raw_x,raw_y,filtered_x,filtered_y", T1, Q[:, :2], Q[:, :2]),
                         "columns: .*'x'"),
    "names twice": ("a.csv", text("t,x,y,x,y", T1, Q[:, :2], Q[:, :2]), "columns: .*several"),
    "velocities without names": ("a.csv", text("", T1, Q, V), "columns: .*velocities of 1, 2, 3"),
    "and efforts": ("a.npy", lambda p: np.save(p, np.column_stack([T, Q, V, TAU])), "columns: .*velocities of 1, 2, 3"),
    "velocities alone": ("a.csv", text("t,dq1,dq2,dq3", T1, V), "columns: "),
    "(n, N)": ("a.npy", lambda p: np.save(p, Q.T), "dt: "),
    "1000 columns": ("a.npz", archive(data=np.tile(Q, (20, 400)), dt=DT), "columns: .*at most 200"),
    "three axes": ("a.npz", archive(q=np.stack([Q, Q]), dt=DT), "episode: .*first axis of q: 0, 1;.*load_all"),
    "a lost marker": ("a.csv", lambda p: p.write_text("t,x\n0,1\n0.1,\n0.2,3\n"), "positions: .*NaN.* row 1"),
    "names that change": ("a.csv", text("t;name;position", T1, ["['a', 'b', 'c']"] * (N - 1) + ["['b', 'a', 'c']"],
                                        lists(Q), sep=";"), "columns: .*'name'"),
    "empty JSON": ("a.json", as_json({}), "columns: .*holds nothing"),
}  # fmt: skip


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", REFUSED)
def test_asks_about_what_is_ambiguous(kind, tmp_path):
    name, write, message = REFUSED[kind]
    write(tmp_path / name)
    with pytest.raises(ValueError, match=f"^({message})"):
        Demonstration.load(tmp_path / name)


@pytest.mark.parametrize(
    ("kind", "answer"),
    [
        ("no time", {"dt": DT}),
        ("no time, npy", {"dt": DT}),
        ("rows numbered instead", {"dt": DT}),
        ("time or rows", {"dt": DT}),
        ("two units make sense", {"dt": DT}),
        ("seconds called milliseconds", {"unit": "s"}),
        ("a minute a row", {"unit": "s", "duration": 60e3 * T[-1]}),
        ("dt of an hour", {"dt": DT}),
        ("two clocks", {"time": "sim_time"}),
        ("two clocks", {"time": 1, "duration": 1.5 * T[-1]}),
        ("clock and dt differ", {"time": "t"}),
        ("two that rise evenly", {"time": 0, "columns": [2, 3, 4]}),
        ("joints and hand", {"columns": ["q1", "q2", "q3"]}),
        ("two arms", {"columns": "left"}),
        ("several motions", {"columns": "q_0"}),
        ("several motions", {"episode": "q_0"}),
        ("three axes", {"episode": 1}),
        ("(n, N)", {"dt": DT}),
        ("raw and filtered", {"columns": ["raw_x", "raw_y"], "of": [0, 1]}),
        ("names twice", {"columns": (1, 2), "of": [0, 1]}),
        ("velocities without names", {"columns": range(1, 4)}),
        ("and efforts", {"columns": range(1, 4), "time": 0}),
        ("velocities alone", {"columns": ["dq2"], "wanted": V[:, [1]]}),
    ],
)
def test_an_answer_settles_it(kind, answer, tmp_path):
    name, write, _ = REFUSED[kind]
    write(tmp_path / name)
    wanted = answer.pop("wanted", Q[:, answer.pop("of", [0, 1, 2])])
    duration = answer.pop("duration", T[-1])
    shown = Demonstration.load(tmp_path / name, **answer)
    np.testing.assert_allclose(shown.positions, wanted, atol=2e-5)
    assert shown.duration == pytest.approx(duration, rel=1e-5)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"columns": "foo"}, "columns: .*got 'foo'.*holds t 60, x 60"),
        ({"columns": 9}, "columns: .*got 9"),
        ({"columns": []}, "columns: .*got none"),
        ({"columns": [None]}, "columns: .*got None"),
        ({"time": "foo"}, "time: .*got 'foo'"),
        ({"unit": "h"}, "unit: expected one of s, ms, us, ns, got 'h'"),
        ({"unit": 3}, "unit: expected one of s, ms, us, ns, got 3"),
        ({"dt": 0}, "dt: expected a finite number > 0"),
        ({"dt": 1, "unit": "s"}, "dt: expected either"),
        ({"dt": 1, "time": "t"}, "dt: expected either"),
        ({"name": 3}, "name: expected a string"),
    ],
)
def test_refuses_arguments(asked, message, tmp_path):
    READ["comma"][1](tmp_path / "a.csv")
    with pytest.raises(ValueError, match=message):
        Demonstration.load(tmp_path / "a.csv", **asked)


def test_uneven_stamps_are_resampled(tmp_path):
    uneven = T + 0.004 * np.sin(40 * T)
    text(XYZ, uneven[:, None], Q)(tmp_path / "a.csv")
    shown = Demonstration.load(tmp_path / "a.csv")
    wanted = Demonstration.from_times(uneven, Q)
    np.testing.assert_allclose(shown.positions, wanted.positions, atol=1e-6)


def test_every_motion_of_a_file_is_read_and_named(tmp_path):
    """By a column, by names, by an axis, and by a time that starts over; each with the numbers of its own."""
    twice, time = np.concatenate([Q, Q[5:]]), np.concatenate([T, T[5:] + 100])
    numbers = np.repeat([3, 7], [N, N - 5])
    head = [f"{t:.9f}" for t in time]
    text("t,x,y,z,episode_index", head, twice, [str(i) for i in numbers])(tmp_path / "column.csv")
    text("t,x,y,z", [f"{t:.9f}" for t in np.concatenate([T, T[5:]])], twice)(tmp_path / "time.csv")
    np.savez(tmp_path / "names.npz", **{"demo_3/q": Q, "demo_3/t": T, "demo_7/q": Q[5:], "demo_7/t": T[5:]})
    np.savez(tmp_path / "axis.npz", q=np.stack([Q, Q + 1]), t=T)
    for name, labels in {
        "column.csv": "37",
        "time.csv": "01",
        "names.npz": ["demo_3", "demo_7"],
        "axis.npz": "01",
    }.items():
        stem, (first, second) = name.partition(".")[0], Demonstration.load_all(tmp_path / name)
        assert [first.name, second.name] == [f"{stem}[{label}]" for label in labels]
        np.testing.assert_allclose(first.positions, Q, atol=2e-5)
        np.testing.assert_allclose(second.positions, Q + 1 if name == "axis.npz" else Q[5:], atol=2e-5)
        assert second.origin.startswith(f"{name}[{labels[1]}]: ")
        with pytest.raises(ValueError, match=rf"^episode: expected one motion, got 2 in {name}"):
            Demonstration.load(tmp_path / name)
        with pytest.raises(ValueError, match=rf"^episode: expected one of {labels[0]}, {labels[1]}, got 9"):
            Demonstration.load(tmp_path / name, episode=9)
        one = Demonstration.load(tmp_path / name, episode=labels[1])
        assert one.fingerprint == second.fingerprint
    (alone,) = Demonstration.load_all(tmp_path / "axis.npz", columns="q")[:1]
    assert alone.dim == 3


MOTIONS = {
    "joints and their velocities": ({"q_0": Q, "qd_0": V, "q_1": Q[5:], "qd_1": V[5:], "dt": DT}, ["0", "1"]),
    "times of their own": ({"q_0": Q, "t_0": T, "q_1": Q[5:], "t_1": T[5:]}, ["0", "1"]),
    "arm and hand": ({"q7": Q, "x3": Q + 1, "t": T}, None),
    "markers of each row": ({"markers": np.stack([Q, Q + 1], axis=1), "q": Q, "t": T}, None),
}


@pytest.mark.parametrize("kind", MOTIONS)
def test_numbers_in_names_and_first_axes_are_no_motions_by_themselves(kind, tmp_path):
    arrays, labels = MOTIONS[kind]
    np.savez(tmp_path / "a.npz", **arrays)
    if labels is None:
        with contextlib.suppress(ValueError):  # what is asked about is not of motions
            assert len(Demonstration.load_all(tmp_path / "a.npz")) == 1
        with contextlib.suppress(ValueError):
            assert Demonstration.load(tmp_path / "a.npz").dim == 3
    else:
        shown = Demonstration.load_all(tmp_path / "a.npz")
        assert [one.name for one in shown] == [f"a[{label}]" for label in labels]
        np.testing.assert_allclose(shown[1].positions, Q[5:], atol=1e-12)


@pytest.mark.parametrize("values", [Q[:, 0], np.full(N, np.nan), np.full(N, np.inf)], ids=["moves", "nan", "inf"])
def test_a_coordinate_with_the_name_of_motions_does_not_tell_them_apart(values, tmp_path):
    np.savez(tmp_path / "a.npz", trajectory=values, t=T)
    if np.isfinite(values).all():
        assert Demonstration.load(tmp_path / "a.npz").columns == ("trajectory",)
    else:
        with pytest.raises(ValueError, match=r"^positions: expected finite numbers"):
            Demonstration.load(tmp_path / "a.npz")


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_its_own_files_come_back_as_they_are_and_others_unwrapped(suffix, tmp_path):
    wrapping = np.column_stack([Q, (3 * T + 3) % (2 * np.pi)])
    Demonstration(wrapping, DT).save(tmp_path / f"own{suffix}")
    np.testing.assert_allclose(Demonstration.load(tmp_path / f"own{suffix}").positions, wrapping, atol=1e-14)
    np.savez(tmp_path / "other.npz", q=wrapping, t=T)
    other = Demonstration.load(tmp_path / "other.npz")
    np.testing.assert_allclose(np.diff(other.positions[:, 3]), 3 * np.diff(T), atol=1e-9)
    assert other.origin.endswith("unwrapped column 3 by 2π")


def test_no_number_is_left_out_without_a_word(tmp_path):
    """Beside what is known to be positions, what nothing tells is asked about; what does not move is not."""
    text("t,x,y,z,grasp", T1, Q, Q[:, :1])(tmp_path / "a.csv")
    with pytest.raises(ValueError, match=r"^columns: expected to know whether grasp belong to the positions x, y, z"):
        Demonstration.load(tmp_path / "a.csv")
    assert Demonstration.load(tmp_path / "a.csv", columns=["x", "y", "z"]).dim == 3
    text("t,x,y,z,grasp,k", T1, Q, np.ones((N, 1)), [str(i) for i in range(N)])(tmp_path / "b.csv")
    shown = Demonstration.load(tmp_path / "b.csv")
    assert shown.dim == 3
    assert "left out grasp, k" in shown.origin
    text("t,qx,qy,qz,qw,dx", T1, Q, Q[:, :2])(tmp_path / "c.csv")
    with pytest.raises(ValueError, match=r"^columns: expected positions beside the orientation qx, qy, qz, qw"):
        Demonstration.load(tmp_path / "c.csv")


def test_a_stamp_that_repeats_and_a_gap_are_told(tmp_path):
    times = np.concatenate([T[:20], T[19:30], T[30:] + 3.0])
    text(XYZ, times[:, None], np.concatenate([Q[:20], Q[19:]]))(tmp_path / "a.csv")
    shown = Demonstration.load(tmp_path / "a.csv")
    assert len(shown) == N
    assert "left out 1 row with the time of the row before, such as row 20" in shown.origin
    assert "a gap of 3.02 s after row 30, 151 times the usual step, is bridged by a straight line" in shown.origin


def test_names_that_begin_alike_are_taken_together_and_a_near_name_is_suggested(tmp_path):
    np.savez(tmp_path / "a.npz", t=T, **{f"hand/position/{c}": Q[:, i] for i, c in enumerate("xyz")})
    assert Demonstration.load(tmp_path / "a.npz", columns="hand/position").dim == 3
    with pytest.raises(ValueError, match=r"^columns: .*, perhaps 'hand/position/x', got 'hand/positon/x'"):
        Demonstration.load(tmp_path / "a.npz", columns="hand/positon/x")
