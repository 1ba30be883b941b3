"""Recordings as people have them: each is read as it was meant, or refused with the argument that settles it."""

from __future__ import annotations

import json
import logging
import pickle
from dataclasses import replace

import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from latentds import Demonstration

N, DT = 60, 0.02
T = np.arange(N) * DT
S = (1 - np.cos(np.pi * T / T[-1])) / 2
Q = np.stack([0.3 + S, np.sin(3 * S) - 1, 2 * S**3 - S], axis=1)
"""(N, 3) from rest to rest."""
V = np.gradient(Q, DT, axis=0)
TAU = 5 * np.cos(Q) + 0.1
JOINTS = ["shoulder_pan", "elbow", "wrist_1"]


def text(header, *columns, sep=",", digits=9, decimal=".", end="", bom=False, above="", encoding="utf-8"):
    """A writer of a table of text."""

    def cell(value):
        return value if isinstance(value, str) else f"{value:.{digits}f}".replace(".", decimal)

    def write(path):
        flat = [c for column in columns for c in (column.T if isinstance(column, np.ndarray) else [column])]
        flat = [c for column in flat for c in ([column] if np.ndim(column) else [[column] * N])]
        lines = [sep.join(map(cell, row)) + end for row in zip(*flat, strict=True)]
        content = above + "\n".join([header] * bool(header) + lines) + "\n"
        path.write_bytes((b"\xef\xbb\xbf" if bom else b"") + content.encode(encoding))

    return write


def lists(values):
    return ["[" + ", ".join(f"{v:.9f}" for v in row) + "]" for row in values]


def stamps(scale, offset=0):
    return [str(round(t * scale) + offset) for t in T]


def archive(**arrays):
    return lambda path: np.savez(path, **arrays)


def matlab(**variables):
    return lambda path: scipy.io.savemat(path, variables)


def as_json(value):
    return lambda path: path.write_text(json.dumps(value))


def trajectory():
    points = [
        {"positions": list(q), "velocities": list(v), "time_from_start": {"secs": int(t), "nsecs": round(t % 1 * 1e9)}}
        for t, q, v in zip(T, Q, V, strict=True)
    ]
    return {"joint_trajectory": {"joint_names": JOINTS, "points": points}}


T1, Q1 = T[:, None], Q
XYZ = "t,x,y,z"
READ = {
    "comma": ("a.csv", text(XYZ, T1, Q1)),
    "comma, blanks after": ("a.csv", text("t, x, y, z", T1, Q1, sep=", ")),
    "semicolon": ("a.csv", text("t;x;y;z", T1, Q1, sep=";")),
    "decimal comma": ("a.csv", text("Zeit;x;y;z", T1, Q1, sep=";", decimal=",")),
    "decimal comma, tabs": ("a.txt", text("t\tx\ty\tz", T1, Q1, sep="\t", decimal=",")),
    "decimal comma, blanks": ("a.txt", text("t x y z", T1, Q1, sep=" ", decimal=",")),
    "decimal comma, quoted": (
        "a.csv",
        text(XYZ, *[[f'"{v:.9f}"'.replace(".", ",") for v in c] for c in np.column_stack([T, Q]).T]),
    ),
    "tabs": ("a.tsv", text("time\tx\ty\tz", T1, Q1, sep="\t")),
    "blanks": ("a.txt", text("time x y z", T1, Q1, sep="   ")),
    "no header": ("a.csv", text("", T1, Q1)),
    "no header, blanks": ("a.dat", text("", T1, Q1, sep=" ")),
    "byte order mark": ("a.csv", text(XYZ, T1, Q1, bom=True)),
    "UTF-16": ("a.csv", text("t\tx\ty\tz", T1, Q1, sep="\t", encoding="utf-16")),
    "Latin letters": ("a.csv", text("Zeit [µs];x;y;z", stamps(1e6), Q1, sep=";", encoding="cp1252")),
    "CR LF": ("a.csv", text(XYZ, T1, Q1, end="\r")),
    "comments": ("a.csv", text(XYZ, T1, Q1, above="# made by a robot, today\n# 3 joints, 50 Hz\n\n")),
    "header in a comment": ("a.txt", text("# t x y z", T1, Q1, sep=" ")),
    "header after %": ("a.txt", text("% t, x, y, z", T1, Q1)),
    "quoted": ("a.csv", text('"t","x","y","z"', *[[f'"{v:.9f}"' for v in c] for c in np.column_stack([T, Q]).T])),
    "comma at the end": ("a.csv", text(XYZ + ",", T1, Q1, end=",")),
    "comma at the end of numbers": ("a.csv", text(XYZ, T1, Q1, end=",")),
    "blank rows below": ("a.csv", lambda p: (text(XYZ, T1, Q1)(p), p.write_text(p.read_text() + ",,,\n,,,\n\n"))),
    "sep= line": ("a.csv", text("t;x;y;z", T1, Q1, sep=";", above="sep=;\n")),
    "title above": ("a.csv", text(XYZ, T1, Q1, above="My recording\n")),
    "units in a second line": ("a.csv", text(XYZ + "\n[ms],[m],[m],[m]", 1e3 * T1, Q1)),
    "pandas index": ("a.csv", text(",t,x,y,z", [str(i) for i in range(N)], T1, Q1)),
    "time last": ("a.csv", text("x,y,z,time", Q1, T1)),
    "rows numbered": ("a.csv", text("frame,t,x,y,z", [str(i) for i in range(N)], T1, Q1)),
    "milliseconds": ("a.csv", text("timestamp,x,y,z", stamps(1e3), Q1)),
    "milliseconds by name": ("a.csv", text("time_ms,x,y,z", stamps(1e3), Q1)),
    "microseconds": ("a.csv", text("t,x,y,z", stamps(1e6, 77_000_000), Q1)),
    "nanoseconds since 1970": ("a.csv", text("%time,x,y,z", stamps(1e9, 1_700_000_000_000_000_000), Q1)),
    "seconds since 1970": ("a.csv", text("stamp,x,y,z", T1 + 1.7e9, Q1)),
    "dates": ("a.csv", text("timestamp,x,y,z", [f"2024-05-01 12:59:{59 + t:09.6f}" for t in T * 0.8 / T[-1]], Q1)),
    "times of day": ("a.csv", text("clock,x,y,z", [f"9:00:{t:06.3f}" for t in T], Q1)),
    "sec and nanosec": (
        "a.csv",
        text("header.stamp.sec,header.stamp.nanosec,x,y,z",
             *[[str(int(17e8 + (round(t * 1e9) + 5e8) // 1e9)) for t in T],
               [str(int((round(t * 1e9) + 5e8) % 1e9)) for t in T]], Q1),
    ),
    "velocities and efforts": ("a.csv", text("t,q1,q2,q3,dq1,dq2,dq3,tau_1,tau_2,tau_3", T1, Q1, V, TAU)),
    "joint by joint": (
        "a.csv",
        text("time," + ",".join(f"{j}_{k}" for j in JOINTS for k in ("pos", "vel", "effort")), T1,
             np.stack([Q, V, TAU], axis=2).reshape(N, 9)),
    ),
    "joints by name": ("a.csv", text("time,shoulder,elbow,wrist,shoulder_vel,elbow_vel,wrist_vel", T1, Q1, V)),
    "robot and command": (
        "a.csv",
        text("t," + ",".join(f"{k}_q_{i}" for k in ("actual", "target") for i in range(3)), T1, Q, Q),
    ),
    "desired postures": ("a.csv", text("t,q_0,q_1,q_2,q_d_0,q_d_1,q_d_2,dq_0,dq_1,dq_2", T1, Q, Q + 1, V)),
    "pixels": ("a.csv", text("t,u,v,c", T1, Q)),
    "rostopic echo -p": (
        "a.csv",
        text("%time,field.header.seq,field.header.stamp,field.header.frame_id,"
             + ",".join(f"field.{k}{i}" for k in ("name", "position", "velocity", "effort") for i in range(3)),
             stamps(1e9, 17 * 10**17), [str(i) for i in range(N)], stamps(1e9, 17 * 10**17 - 3), ["base"] * N,
             *[[j] * N for j in JOINTS], Q, V, TAU),
    ),
    "lists in cells": (
        "a.csv",
        text("stamp;name;position;velocity;effort", T1, [str(JOINTS)] * N, lists(Q), lists(V), ["[]"] * N, sep=";"),
    ),
    "quoted lists": (
        "a.csv",
        text("time,name,position,velocity", T1, [f'"{JOINTS}"'] * N, [f'"({c[1:-1]})"' for c in lists(Q)],
             [f'"array(\'d\', {c})"' for c in lists(V)]),
    ),
    "one row per joint": (
        "a.csv",
        lambda p: p.write_text("time,joint,position,velocity\n" + "".join(
            f"{t:.3f},{j},{q:.9f},{v:.9f}\n"
            for t, qs, vs in zip(T, Q, V, strict=True) for j, q, v in zip(JOINTS, qs, vs, strict=True))),
    ),
    "npy with time": ("a.npy", lambda p: np.save(p, np.column_stack([T, Q]))),
    "npy of fields": (
        "a.npy",
        lambda p: np.save(p, np.rec.fromarrays([T, *Q.T], names="t,x,y,z")),
    ),
    "npz": ("a.npz", archive(q=Q, qd=V, t=T)),
    "npz, other names": ("a.npz", archive(joint_positions=Q, joint_velocities=V, timestamps=1e3 * T, robot="arm")),
    "npz, vectors": ("a.npz", archive(time=T, x=Q[:, 0], y=Q[:, 1], z=Q[:, 2], vx=V[:, 0])),
    "npz, dt": ("a.npz", archive(trajectory=Q, dt=DT)),
    "npz, rate": ("a.npz", archive(data=Q, fs=50)),
    "npz, steps": ("a.npz", archive(q=Q, qd=V, delta_t=np.full(N, DT))),
    "npz, one step fewer": ("a.npz", archive(q=Q, dt=np.full(N - 1, DT))),
    "npz, one array": ("a.npz", archive(arr_0=np.column_stack([T, Q]))),
    "npz, transposed": ("a.npz", archive(q=Q.T, t=T[None])),
    "npz, a pickle beside": ("a.npz", archive(q=Q, t=T, info=np.array({"robot": 1}, dtype=object))),
    "MATLAB": ("a.mat", matlab(q=Q, t=T1)),
    "MATLAB, rows": ("a.mat", matlab(q=Q.T, dq=V.T, t=T)),
    "MATLAB, struct": ("a.mat", matlab(rec={"pos": Q, "vel": V, "time": T, "robot": "arm"})),
    "JSON, columns": ("a.json", as_json({"time": T.tolist(), "positions": Q.tolist(), "velocities": V.tolist()})),
    "JSON, records": (
        "a.json",
        as_json([{"t": t, "q": q.tolist(), "gripper": None, "ok": True} for t, q in zip(T, Q, strict=True)]),
    ),
    "JSON, rows": ("a.json", as_json(np.column_stack([T, Q]).tolist())),
    "JSON, dt": ("a.json", as_json({"robot": "arm", "dt": DT, "trajectory": Q.tolist()})),
    "JSON, ROS trajectory": ("a.json", as_json(trajectory())),
}  # fmt: skip


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", READ)
def test_reads_what_was_meant(kind, tmp_path):
    name, write = READ[kind]
    write(tmp_path / name)
    shown = Demonstration.load(tmp_path / name)
    duration = 0.8 if kind == "dates" else T[-1]
    assert shown.positions.shape == (N, 3)
    assert shown.duration == pytest.approx(duration, rel=1e-5)
    np.testing.assert_allclose(shown.positions, Q, atol=2e-5)
    assert shown.name == "a"
    assert shown.origin.startswith(f"{name}: {N} rows; ")
    assert "\n" not in shown.origin


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
    "several motions": ("a.npz", archive(q_0=Q, q_1=Q[5:], dt=DT), "columns: .*q_0 60×3, q_1 55×3"),
    "raw and filtered": ("a.csv", text("t,raw_x,raw_y,filtered_x,filtered_y", T1, Q[:, :2], Q[:, :2]),
                         "columns: .*'x'"),
    "names twice": ("a.csv", text("t,x,y,x,y", T1, Q[:, :2], Q[:, :2]), "columns: .*several"),
    "velocities without names": ("a.csv", text("", T1, Q, V), "columns: .*velocities of 1, 2, 3"),
    "and efforts": ("a.npy", lambda p: np.save(p, np.column_stack([T, Q, V, TAU])), "columns: .*velocities of 1, 2, 3"),
    "velocities alone": ("a.csv", text("t,dq1,dq2,dq3", T1, V), "columns: "),
    "(n, N)": ("a.npy", lambda p: np.save(p, Q.T), "dt: |columns: .*transposed"),
    "1000 columns": ("a.npz", archive(data=np.tile(Q, (20, 400)), dt=DT), "columns: .*at most 200"),
    "three axes": ("a.npz", archive(q=np.stack([Q, Q]), dt=DT), "columns: .*q 2×60×3"),
    "header too short": ("a.csv", text("t,x", *[[f"{v:.3f}".replace(".", ",") for v in c] for c in (T, Q[:, 0])]),
                         "path: .*names 2 columns, the numbers have 4"),
    "commas for everything": ("a.csv", text("", *[[f"{v:.3f}".replace(".", ",") for v in c] for c in (T, T / T[-1])]),
                              "path: .*decimal commas"),
    "points and commas": ("a.csv", text("t;x;y", T1, [f"{v:.3f}".replace(".", ",") for v in T], T1, sep=";"),
                          "path: .*point"),
    "columns numbered": ("a.csv", text("0,1,2,3", T1, Q), "path: .*numbers the columns"),
    "a word": ("a.csv", lambda p: p.write_text("t,x\n0,1\n0.1,oops\n0.2,3\n"), "path: .*line 3: 'oops'.*'x'"),
    "ragged": ("a.csv", lambda p: p.write_text("t,x\n0,1\n0.1\n0.2,3\n"), "path: .*line 3 has 1 cells"),
    "a lost marker": ("a.csv", lambda p: p.write_text("t,x\n0,1\n0.1,\n0.2,3\n"), "positions: .*NaN.* row 1"),
    "names that change": ("a.csv", text("t;name;position", T1, ["['a', 'b', 'c']"] * (N - 1) + ["['b', 'a', 'c']"],
                                        lists(Q), sep=";"), "columns: .*'name'"),
    "HDF5": ("a.mat", lambda p: p.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(99)), "path: .*-v7"),
    "broken MATLAB": ("a.mat", lambda p: p.write_bytes(b"MATLAB 5.0" + bytes(200)), "path: .*not a readable .mat"),
    "broken JSON": ("a.json", lambda p: p.write_text('{"t": [1,'), "path: .*not a readable .json"),
    "JSON too deep": ("a.json", lambda p: p.write_text("[" * 10**5), "path: .*not a readable .json"),
    "empty JSON": ("a.json", as_json({}), "columns: .*holds nothing"),
    "a pickle": ("a.npy", lambda p: p.write_bytes(pickle.dumps(Q)), "path: .*without pickles"),
    "a pickled array": ("a.npy", lambda p: np.save(p, np.array([Q], dtype=object), allow_pickle=True),
                        "path: .*without pickles"),
    "a bag": ("a.bag", lambda p: p.write_bytes(b"#ROSBAG V2.0\n"), "path: .*from_table"),
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


def test_what_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("latentds.files.MAX_BYTES", 10**5)
    scipy.io.savemat(tmp_path / "a.mat", {"q": np.zeros((10**5, 3))}, do_compression=True)
    assert (tmp_path / "a.mat").stat().st_size < 10**4
    with pytest.raises(ValueError, match=r"^path: a\.mat .*holds more than 100000 bytes"):
        Demonstration.load(tmp_path / "a.mat")


def test_uneven_stamps_are_resampled(tmp_path):
    uneven = T + 0.004 * np.sin(40 * T)
    text(XYZ, uneven[:, None], Q)(tmp_path / "a.csv")
    shown = Demonstration.load(tmp_path / "a.csv")
    wanted = Demonstration.from_times(uneven, Q)
    np.testing.assert_allclose(shown.positions, wanted.positions, atol=1e-6)


def test_frames_of_pandas():
    pandas = pytest.importorskip("pandas")
    plain = pandas.DataFrame({"t": T, **{f"q{i}": Q[:, i] for i in range(3)}, "dq0": V[:, 0], "robot": "arm"})
    cells = pandas.DataFrame({"time": 1e3 * T, "position": list(Q), "velocity": list(V)})
    dated = pandas.DataFrame(Q, columns=JOINTS, index=pandas.to_datetime(1e9 * T + 1.7e18))
    dated.index.name = "when"
    kinds = {
        "columns": plain,
        "rows of another frame": plain.set_index(np.arange(N) + 7),
        "time as index": plain.set_index("t"),
        "arrays in cells": cells,
        "dates": dated,
        "dates with a zone": dated.tz_localize("Europe/Zurich"),
        "nullable": plain.convert_dtypes(),
        "no names": pandas.DataFrame(np.column_stack([T, Q])),
        "two levels": pandas.DataFrame(
            np.column_stack([T, Q]), columns=pandas.MultiIndex.from_tuples([("time", ""), *(("pos", k) for k in "xyz")])
        ),
        "a mapping": {"t": T, "q": Q, "qd": V},
        "a mapping of lists": {"t": T.tolist(), "q": Q.tolist()},
    }
    for kind, table in kinds.items():
        shown = Demonstration.from_table(table, name="mine")
        np.testing.assert_allclose(shown.positions, Q, atol=2e-5, err_msg=kind)
        assert shown.duration == pytest.approx(T[-1], rel=1e-5), kind
        assert (shown.name, shown.origin[:5]) == ("mine", "mine:"), kind
    with pytest.raises(ValueError, match="table: expected a pandas frame or a mapping to arrays, got ndarray"):
        Demonstration.from_table(Q)
    with pytest.raises(ValueError, match=r"dt: .*the table holds x 60"):
        Demonstration.from_table({"x": Q[:, 0]})


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    sep=st.sampled_from([",", ";", "\t", " ", ", "]),
    decimal=st.sampled_from([".", ","]),
    header=st.sampled_from([["t", "q1", "q2"], ["timestamp", "x", "y"], ["time", "elbow_pos", "wrist_pos"], None]),
    unit=st.sampled_from([1, 1e3, 1e6, 1e9]),
    rate=st.sampled_from([20, 100, 125]),
    seed=st.integers(0, 10**6),
    above=st.sampled_from(["", "# a remark\n", "\n"]),
    end=st.sampled_from(["\n", "\r\n"]),
)
def test_any_everyday_table_gives_the_motion_back(tmp_path, sep, decimal, header, unit, rate, seed, above, end):
    if sep.strip() == "," and decimal == ",":
        decimal = "."
    random = np.random.default_rng(seed)
    times = np.arange(80) / rate
    motion = np.cumsum(np.sin(np.outer(np.linspace(0, 3, 80), random.uniform(1, 3, 2)) + random.uniform(0, 6, 2)), 0)
    rows = [[f"{t * unit:.6f}", *(f"{v:.9f}" for v in row)] for t, row in zip(times, motion, strict=True)]
    lines = [sep.join(header)] if header else []
    lines += [sep.join(cell.replace(".", decimal) for cell in row) for row in rows]
    (tmp_path / "a.txt").write_bytes((above + "\n".join(lines) + "\n").replace("\n", end).encode())
    shown = Demonstration.load(tmp_path / "a.txt")
    np.testing.assert_allclose(shown.positions, motion, atol=1e-6)
    assert shown.dt == pytest.approx(1 / rate, rel=1e-6)
