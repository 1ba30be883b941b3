"""Files of every kind that people have, and frames: each is read as it was meant, or refused with the reason."""

from __future__ import annotations

import pickle
import sys
import warnings

import numpy as np
import pytest
import scipy.io
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from latentds import Demonstration
from latentds.recordings import as_table, read_table
from tests.recordings.tables import DT, JOINTS, READ, T1, N, Q, T, V, text


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
    "HDF5": ("a.mat", lambda p: p.write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(99)), "path: a.mat is not a readable .mat"),
    "three header lines": ("a.csv", lambda p: p.write_text("a,b\nc,d\ne,f\n0,1\n1,2\n"),
                           "path: .*3 header lines .* delete the others"),
    "days or months": ("a.csv", lambda p: p.write_text("t,x\n01/02/2023 23:59:59,1\n02/02/2023 00:00:00,2\n"),
                       "path: .*'01/02/2023 23:59:59', day or month first"),
    "a day that is none": ("a.csv", lambda p: p.write_text("t,x\n2023/14/02 23:59:59,1\n"), "path: .*no dates"),
    "a spreadsheet": ("a.xlsx", lambda p: p.write_bytes(b"PK"), r"path: .*from_table\(pandas.read_excel\('a.xlsx'\)\)"),
    "an unusual end": ("a.hdf", lambda p: p.write_bytes(b""), "path: .*rename it if it is a .hdf5 file"),
    "a folder": ("a", lambda p: p.mkdir(), "path: expected a file of kind"),
    "broken MATLAB": ("a.mat", lambda p: p.write_bytes(b"MATLAB 5.0" + bytes(200)), "path: .*not a readable .mat"),
    "broken JSON": ("a.json", lambda p: p.write_text('{"t": [1,'), "path: .*not a readable .json"),
    "JSON too deep": ("a.json", lambda p: p.write_text("[" * 10**5), "path: .*not a readable .json"),
    "a pickle": ("a.npy", lambda p: p.write_bytes(pickle.dumps(Q)), "path: .*without pickles"),
    "a pickled array": ("a.npy", lambda p: np.save(p, np.array([Q], dtype=object), allow_pickle=True),
                        "path: .*without pickles"),
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
    with pytest.raises(ValueError, match=r"^path: a\.mat .*holds .* bytes, more than 100000"):
        Demonstration.load(tmp_path / "a.mat")


def test_motive_names_bodies_and_markers(tmp_path):
    above = [
        "Format Version,1.23,Take Name,Take 1,Capture Frame Rate,50.0",
        ",Type,Rigid Body,Rigid Body,Rigid Body,Rigid Body,Rigid Body Marker",
        ",Name,Hammer,Hammer,Hammer,Hammer,Hammer:Marker 1",
        ",ID,1,1,1,1,7",
        ",,Rotation,Position,Position,Mean Marker Error,Position",
        "Frame,Time (Seconds),W,X,Y,,X",
    ]
    rows = ["0,0.00,1,0.5,0.6,0.0001,", "1,0.02,1,,,,", "2,0.04,1,0.7,0.8,0.0001,"]
    (tmp_path / "a.csv").write_text("\n".join([above[0], "", *above[1:], *rows]))
    table = read_table(tmp_path / "a.csv")
    marker = "Rigid Body Marker/Hammer:Marker 1/Position/X"
    body = [f"Hammer/{name}" for name in ("Rotation/W", "Position/X", "Position/Y", "Mean Marker Error")]
    assert list(table) == ["Frame", "Time (Seconds)", *body, marker]
    np.testing.assert_array_equal(table["Hammer/Position/X"], [0.5, np.nan, 0.7])
    assert np.isnan(table[marker]).all()


@pytest.mark.parametrize(
    ("above", "names"),
    {
        "two levels of pandas": (",left,left,right\n,x,y,x", ["row index", "left/x", "left/y", "right/x"]),
        "with the index's name": (",left,left,right\n,x,y,x\ntime,,,", ["time", "left/x", "left/y", "right/x"]),
        "three levels": (",l,l,r\n,p,p,p\n,x,y,x", ["row index", "l/p/x", "l/p/y", "r/p/x"]),
        "merged cells": ("Trajectories\n100\n,hand,,knee\nFrame,X,Y,X\n,mm,mm,mm",
                         ["Frame", "hand/X/mm", "hand/Y/mm", "knee/X/mm"]),
        "units": ("t,x,y,x 2\n[s],[m],[m],[m]", ["t [s]", "x [m]", "y [m]", "x 2 [m]"]),
        "read and written again": ("Unnamed: 0,x,y,z", ["row index", "x", "y", "z"]),
    }.values(),
)  # fmt: skip
def test_header_lines_are_joined_where_they_name_groups(above, names, tmp_path):
    (tmp_path / "a.csv").write_text(above + "\n0,1,2,3\n1,1.5,2.5,3.5\n")
    table = read_table(tmp_path / "a.csv")
    assert list(table) == names
    np.testing.assert_array_equal(table[names[3]], [3, 3.5])


@pytest.mark.parametrize(
    "days",
    [("06/02/2023", "06/02/2023"), ("2023/02/06", "2023/02/06"), ("06.02.2023", "06.02.2023"), ("6/2/2023", "6/2/2023"),
     ("31.01.2023", "01.02.2023"), ("01/31/2023", "02/01/2023"), ("2023-01-31", "2023-02-01")],
)  # fmt: skip
def test_dates_of_every_country(days, tmp_path):
    clocks = ("12:00:00.5", "12:00:01.75") if days[0] == days[1] else ("23:59:59.5", "00:00:00.75")
    (tmp_path / "a.csv").write_text("time;x\n" + "".join(f"{d} {c};1\n" for d, c in zip(days, clocks, strict=True)))
    times = read_table(tmp_path / "a.csv")["time"]
    assert times.dtype.kind == "M"
    assert np.diff(times) / np.timedelta64(1, "s") == 1.25


def test_several_motions_in_one_file(tmp_path):
    motions = [{"pos": Q.T, "t": T, "robot": "arm"}, {"pos": Q[:50].T, "t": T[:50], "robot": "arm"}]
    scipy.io.savemat(tmp_path / "a.mat", {"demos": np.array(motions), "dt": DT})
    table = read_table(tmp_path / "a.mat")
    assert table["demos/0/pos"].shape == (3, N)
    np.testing.assert_array_equal(table["demos/1/t"], T[:50])
    np.save(tmp_path / "a.npy", Q[None])
    assert read_table(tmp_path / "a.npy")[""].shape == (N, 3)
    assert as_table({"data": [Q, Q]})["data"].shape == (2, N, 3)
    assert list(as_table({"data": [Q, Q[:50]]})) == ["data/0", "data/1"]


def write_parquet(path):
    pandas, _ = pytest.importorskip("pandas"), pytest.importorskip("pyarrow")
    frame = {"observation.state": list(Q.astype(np.float32)), "timestamp": T, "episode_index": np.zeros(N, int)}
    pictures = [{"bytes": b"png", "path": "a.png"}] * N
    pandas.DataFrame({**frame, "image": pictures, "task": ["reach"] * N}).to_parquet(path)


def write_hdf5(path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo.attrs["num_samples"] = N
        demo["obs/joint_pos"] = Q
        demo.create_dataset("obs/image", (N, 8, 8, 3), dtype="u1", compression="gzip")
        file["names"] = JOINTS
        file["again"] = h5py.SoftLink("/data")
        file["elsewhere"] = h5py.ExternalLink("b.h5", "/")
        demo["itself"] = h5py.SoftLink("/")


def write_matlab(path):
    """As MATLAB does with -v7.3: transposed, and cells and structs by reference."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(name, value, kind):
            file[name] = value
            file[name].attrs["MATLAB_class"] = np.bytes_(kind)

        put("q", Q.T, "double")
        put("dt", [[DT]], "double")
        put("robot", np.array([[ord(c)] for c in "arm"], np.uint16), "char")
        for i, motion in enumerate((Q, Q[:50])):
            put(f"#refs#/{i}", motion, "double")
        put("data", np.array([[file[f"#refs#/{i}"].ref] for i in (0, 1)], h5py.ref_dtype), "cell")
        file["demos/pos"] = file["data"][()]
    data = path.read_bytes()
    path.write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + data[512:])


def write_c3d(path):
    c3d = pytest.importorskip("c3d")
    writer = c3d.Writer(point_rate=50)
    for k, row in enumerate(Q):
        hand, lost = [*row, 0, 0], [0, 0, 0, -1 if k == 3 else 0, 0]
        writer.add_frames([(np.array([hand, lost]), np.array([[]]))])
    writer.set_point_labels(["hand", "elbow"])
    with open(path, "wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        writer.write(file)


def write_bag(path, kinds=("JointState",), version=1):
    """Joints in two orders, and a gripper on the same topic if ``kinds`` has "gripper"."""
    pytest.importorskip("rosbags")
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if version == 1 else Stores.ROS2_HUMBLE)
    types = store.types
    serialize = store.serialize_ros1 if version == 1 else store.serialize_cdr

    def header(t):
        stamp = types["builtin_interfaces/msg/Time"](1_700_000_000 + int(t), round(t % 1 * 1e9))
        extra = {"seq": 0} if version == 1 else {}
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="base", **extra)

    def joints(t, names, q):
        return types["sensor_msgs/msg/JointState"](header(t), names, q, q, np.zeros(0))

    def pose(t, q):
        point = types["geometry_msgs/msg/Point"](*q)
        turned = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
        return types["geometry_msgs/msg/PoseStamped"](header(t), types["geometry_msgs/msg/Pose"](point, turned))

    bag = rosbag1.Writer(path) if version == 1 else rosbag2.Writer(path, version=8)
    with bag:
        topics = {kind: ("/joint_states" if kind == "gripper" else f"/{kind}") for kind in kinds}
        packages = {"PoseStamped": "geometry_msgs", "String": "std_msgs"}
        links = {}
        for kind in kinds:
            if kind != "gripper":
                links[kind] = bag.add_connection(
                    topics[kind], f"{packages.get(kind, 'sensor_msgs')}/msg/{kind}", typestore=store
                )
        for k, (t, q) in enumerate(zip(T, Q, strict=True)):
            for kind in kinds:
                link = links["JointState" if kind == "gripper" else kind]
                if kind == "gripper":
                    message = joints(t, ["finger"], np.array([t]))
                elif kind == "JointState":
                    message = joints(t, JOINTS, q) if k % 2 == 0 else joints(t, JOINTS[::-1], q[::-1].copy())
                else:
                    message = pose(t, q) if kind == "PoseStamped" else types["std_msgs/msg/String"]("hello")
                bag.write(link, round(1e9 * (t + 5)), serialize(message, link.msgtype))


WRITERS = {
    "a.parquet": write_parquet,
    "a.h5": write_hdf5,
    "a.mat": write_matlab,
    "a.c3d": write_c3d,
    "a.bag": write_bag,
}


def test_parquet(tmp_path):
    write_parquet(tmp_path / "a.parquet")
    table = read_table(tmp_path / "a.parquet")
    assert "image.bytes" not in table
    assert table["task"].dtype.kind == "U"
    np.testing.assert_array_equal(table["observation.state"], Q.astype(np.float32))
    np.testing.assert_array_equal(table["timestamp"], T)


def test_hdf5(tmp_path):
    write_hdf5(tmp_path / "a.h5")
    table = read_table(tmp_path / "a.h5")
    assert set(table) == {"data/demo_0/num_samples", "data/demo_0/obs/joint_pos", "names"}
    assert table["data/demo_0/num_samples"] == N
    assert list(table["names"]) == JOINTS
    np.testing.assert_array_equal(table["data/demo_0/obs/joint_pos"], Q)


def test_matlab_of_version_7_3(tmp_path):
    write_matlab(tmp_path / "a.mat")
    table = read_table(tmp_path / "a.mat")
    assert list(table) == ["data/0", "data/1", "demos/0/pos", "demos/1/pos", "dt", "q", "robot"]
    assert (table["dt"], table["robot"]) == (DT, "arm")
    np.testing.assert_array_equal(table["q"], Q)
    np.testing.assert_array_equal(table["demos/1/pos"], Q[:50].T)


def test_c3d(tmp_path):
    write_c3d(tmp_path / "a.c3d")
    table = read_table(tmp_path / "a.c3d")
    assert list(table) == [*(f"{label}/{axis}" for label in ("hand", "elbow") for axis in "xyz"), "rate"]
    np.testing.assert_allclose(np.stack([table[f"hand/{axis}"] for axis in "xyz"], axis=1), Q, atol=1e-6)
    assert (table["rate"], np.flatnonzero(np.isnan(table["elbow/x"]))) == (50, 3)


@pytest.mark.parametrize(("name", "version"), [("a.bag", 1), ("a", 2)])
def test_bags(name, version, tmp_path):
    write_bag(tmp_path / name, version=version)
    bags = [tmp_path / name, *(tmp_path / name).glob("*.db3")]
    for bag in bags:
        table = read_table(bag)
        assert list(table) == ["stamp", "position", "velocity", "name"]
        np.testing.assert_array_equal(table["position"], Q)
        np.testing.assert_allclose((table["stamp"] - table["stamp"][0]) / np.timedelta64(1, "s"), T, atol=1e-9)
        assert list(table["name"]) == JOINTS


def test_a_bag_of_several_topics(tmp_path):
    write_bag(tmp_path / "a.bag", ("JointState", "gripper", "PoseStamped", "String"))
    table = read_table(tmp_path / "a.bag")
    np.testing.assert_array_equal(table["PoseStamped/position/y"], Q[:, 1])
    np.testing.assert_array_equal(table["JointState/shoulder_pan/position"], Q)
    assert table["JointState/finger/position"].shape == (N, 1)
    assert (table["PoseStamped/orientation/w"] == 1).all()
    write_bag(tmp_path / "b.bag", ("String",))
    with pytest.raises(ValueError, match=r"^path: b.bag .*expected a topic of JointState, .*, got /String \(String\)"):
        read_table(tmp_path / "b.bag")


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_damaged_too_large_or_without_its_package_is_one_error(name, tmp_path, monkeypatch):
    WRITERS[name](tmp_path / name)
    data = (tmp_path / name).read_bytes()
    for cut in (0, 100, len(data) // 2, len(data) - 700):
        (tmp_path / name).write_bytes(data[:cut])
        with pytest.raises(ValueError, match=rf"^path: {name} is not a readable "):
            read_table(tmp_path / name)
    (tmp_path / name).write_bytes(data)
    with monkeypatch.context() as patch:
        patch.setattr("latentds.files.MAX_BYTES", len(data) - 1)
        with pytest.raises(ValueError, match=rf"^path: {name} .*holds "):
            read_table(tmp_path / name)
    package = {"a.parquet": "pyarrow", "a.bag": "rosbags", "a.c3d": "c3d"}.get(name, "h5py")
    for module in [m for m in sys.modules if m.split(".")[0] == package]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(
        ValueError, match=rf"^path: \{name[1:]} files need {package}: pip install 'latentds\[recordings\]'"
    ):
        read_table(tmp_path / name)


def test_pictures_and_links_in_circles_are_bounded(tmp_path, monkeypatch):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("a")
        group["b"] = group["c"] = group
        file.create_dataset("zeros", (10**5, 3), "f8", compression="gzip")
    with pytest.raises(ValueError, match=r"^path: a\.h5 is not"):
        read_table(tmp_path / "a.h5")
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file.create_dataset("zeros", (10**5, 3), "f8", compression="gzip")
    monkeypatch.setattr("latentds.files.MAX_BYTES", 10**5)
    with pytest.raises(ValueError, match=r"^path: b\.h5 .*holds .* bytes, more than 100000"):
        read_table(tmp_path / "b.h5")


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
