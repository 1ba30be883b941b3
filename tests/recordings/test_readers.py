"""Files of every kind that people have, and frames: each is read as it was meant, or refused with the reason."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from latentds import Demonstration
from tests.recordings.tables import JOINTS, READ, T1, N, Q, T, V, text


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


REFUSED = {
    "header too short": ("a.csv", text("t,x", *[[f"{v:.3f}".replace(".", ",") for v in c] for c in (T, Q[:, 0])]),
                         "path: .*names 2 columns, the numbers have 4"),
    "commas for everything": ("a.csv", text("", *[[f"{v:.3f}".replace(".", ",") for v in c] for c in (T, T / T[-1])]),
                              "path: .*decimal commas"),
    "points and commas": ("a.csv", text("t;x;y", T1, [f"{v:.3f}".replace(".", ",") for v in T], T1, sep=";"),
                          "path: .*point"),
    "columns numbered": ("a.csv", text("0,1,2,3", T1, Q), "path: .*numbers the columns"),
    "a word": ("a.csv", lambda p: p.write_text("t,x\n0,1\n0.1,oops\n0.2,3\n"), "path: .*line 3: 'oops'.*'x'"),
    "ragged": ("a.csv", lambda p: p.write_text("t,x\n0,1\n0.1\n0.2,3\n"), "path: .*line 3 has 1 cells"),
    "HDF5": ("a.mat", lambda p: p.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(99)), "path: .*-v7"),
    "broken MATLAB": ("a.mat", lambda p: p.write_bytes(b"MATLAB 5.0" + bytes(200)), "path: .*not a readable .mat"),
    "broken JSON": ("a.json", lambda p: p.write_text('{"t": [1,'), "path: .*not a readable .json"),
    "JSON too deep": ("a.json", lambda p: p.write_text("[" * 10**5), "path: .*not a readable .json"),
    "a pickle": ("a.npy", lambda p: p.write_bytes(pickle.dumps(Q)), "path: .*without pickles"),
    "a pickled array": ("a.npy", lambda p: np.save(p, np.array([Q], dtype=object), allow_pickle=True),
                        "path: .*without pickles"),
    "a bag": ("a.bag", lambda p: p.write_bytes(b"#ROSBAG V2.0\n"), "path: .*from_table"),
}  # fmt: skip


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("kind", REFUSED)
def test_says_why_a_file_is_none(kind, tmp_path):
    name, write, message = REFUSED[kind]
    write(tmp_path / name)
    with pytest.raises(ValueError, match=f"^({message})"):
        Demonstration.load(tmp_path / name)


def test_what_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("latentds.files.MAX_BYTES", 10**5)
    scipy.io.savemat(tmp_path / "a.mat", {"q": np.zeros((10**5, 3))}, do_compression=True)
    assert (tmp_path / "a.mat").stat().st_size < 10**4
    with pytest.raises(ValueError, match=r"^path: a\.mat .*holds more than 100000 bytes"):
        Demonstration.load(tmp_path / "a.mat")


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
