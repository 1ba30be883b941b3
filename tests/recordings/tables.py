"""A recording of three joints as people write it: tables of text, archives, MATLAB's files and JSON."""

from __future__ import annotations

import json

import numpy as np
import scipy.io

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
