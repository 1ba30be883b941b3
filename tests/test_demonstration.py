"""Demonstrations: what they hold, what they refuse, and their files."""

from __future__ import annotations

import math
import os
import pickle

import numpy as np
import pytest
import torch

from latentds import Demonstration
from latentds.demonstration import demonstrations_of, only_one


@pytest.fixture
def shown():
    t = torch.linspace(0, 2, 41, dtype=torch.float64)
    return Demonstration(torch.stack([t**2, 1 - t], dim=1), 0.05, "parabola")


def test_holds_the_motion(shown):
    assert (len(shown), shown.dim, shown.dt, shown.name) == (41, 2, 0.05, "parabola")
    assert shown.duration == pytest.approx(2)
    assert shown.size == pytest.approx(4)
    assert shown.start.tolist() == [0, 1]
    assert shown.goal.tolist() == [4, -1]
    torch.testing.assert_close(shown.times, torch.linspace(0, 2, 41, dtype=torch.float64))
    assert repr(shown) == "Demonstration('parabola', 41 points, 2-D, 2 s)"


def test_velocities_are_exact_for_a_parabola(shown):
    t = shown.times
    torch.testing.assert_close(shown.velocities, torch.stack([2 * t, -torch.ones_like(t)], dim=1))


@pytest.mark.parametrize(
    "positions",
    [
        torch.rand(5, 3),
        torch.rand(3, 5).T,
        torch.rand(5, 3, requires_grad=True),
        torch.randint(0, 100, (5, 3)),
        torch.rand(10, 6)[::2, ::2],
        torch.rand(5, 3).to(torch.bfloat16),
        np.random.default_rng(0).random((5, 3))[::-1],
        np.arange(15).reshape(5, 3).astype(">i4"),
        np.asfortranarray(np.random.default_rng(0).random((5, 3))),
        [[0, 0, 0], [1, 2, 3], [4, 5, 6], [7, 8, 9], [1, 1, 1]],
    ],
    ids=[
        "float32",
        "transposed",
        "requires_grad",
        "integer",
        "strided",
        "bfloat16",
        "reversed",
        "big-endian",
        "F",
        "list",
    ],
)
def test_takes_any_real_array_and_keeps_float64(positions):
    shown = Demonstration(positions, 0.1)
    assert shown.positions.dtype == torch.float64
    assert shown.positions.shape == (5, 3)
    assert shown.positions.is_contiguous()
    assert not shown.positions.requires_grad
    wanted = (
        positions.detach().double().numpy() if isinstance(positions, torch.Tensor) else np.asarray(positions, float)
    )
    np.testing.assert_array_equal(shown.positions.numpy(), wanted)


def test_does_not_share_memory():
    source = np.random.default_rng(0).random((5, 2))
    shown = Demonstration(source, 0.1)
    before = shown.positions.clone()
    source[:] = 0
    assert torch.equal(shown.positions, before)


def test_is_frozen(shown):
    with pytest.raises(AttributeError):
        shown.dt = 3.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"positions": torch.rand(5)}, r"positions: expected shape \(N, n\)"),
        ({"positions": torch.rand(2, 3)}, "positions: expected at least 3 points, got 2"),
        ({"positions": torch.rand(5, 0)}, r"positions: expected shape \(N, n\)"),
        ({"positions": torch.ones(5, 3)}, "positions: expected a motion, got 5 equal points"),
        ({"positions": torch.full((5, 3), math.nan)}, "positions: expected finite numbers, got NaN or inf in row 0"),
        ({"positions": [[1, 2], [3, math.inf], [4, 5]]}, "positions: expected finite numbers, got NaN or inf in row 1"),
        ({"positions": "walk"}, "positions: expected an array of real numbers, got 'walk'"),
        ({"positions": None}, "positions: expected an array of real numbers, got None"),
        ({"positions": torch.ones(5, 3, dtype=torch.complex64)}, "positions: expected an array of real numbers"),
        ({"positions": torch.eye(3, dtype=torch.bool)}, "positions: expected an array of real numbers"),
        ({"dt": 0}, "dt: expected a finite number > 0, got 0"),
        ({"dt": -0.1}, "dt: expected a finite number > 0, got -0.1"),
        ({"dt": math.nan}, "dt: expected a finite number > 0, got nan"),
        ({"dt": math.inf}, "dt: expected a finite number > 0, got inf"),
        ({"dt": "fast"}, "dt: expected a number > 0, got 'fast'"),
        ({"dt": None}, "dt: expected a number > 0, got None"),
        ({"name": 3}, "name: expected a string, got int"),
    ],
)
def test_refuses(change, message):
    with pytest.raises(ValueError, match=message):
        Demonstration(**({"positions": torch.rand(5, 3), "dt": 0.1} | change))


@pytest.mark.parametrize(("scale", "dt"), [(1e300, 1e-10), (1e308, 1.0)])
def test_refuses_numbers_whose_differences_overflow(scale, dt):
    with pytest.raises(ValueError, match=r"positions: expected .* velocities .* finite"):
        Demonstration([[-scale, 0], [scale, 0], [scale, scale]], dt)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([0, 1, 2], r"times: expected shape \(4,\), one per position, got \(3,\)"),
        ([0, 1, 1, 2], "times: expected strictly increasing, got 1 then 1 at row 1"),
        ([0, 2, 1, 3], "times: expected strictly increasing, got 2 then 1 at row 1"),
        ([0, 1, math.nan, 3], "times: expected finite numbers, got NaN or inf"),
        (["a", "b", "c", "d"], "times: expected an array of real numbers"),
        (None, "times: expected an array of real numbers"),
    ],
)
def test_from_times_refuses(times, message):
    with pytest.raises(ValueError, match=message):
        Demonstration.from_times(times, np.random.default_rng(0).random((4, 2)))


def test_from_times_resamples_evenly():
    times = np.array([0.0, 0.1, 0.5, 0.6, 2.0])
    shown = Demonstration.from_times(times, np.stack([3 * times, 1 - times], axis=1), "line")
    assert shown.dt == pytest.approx(0.5)
    torch.testing.assert_close(shown.positions, torch.stack([3 * shown.times, 1 - shown.times], dim=1))


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_files_give_the_motion_back(shown, tmp_path, suffix):
    path = tmp_path / f"motion{suffix}"
    shown.save(path)
    back = Demonstration.load(path)
    exact = suffix == ".npz"
    torch.testing.assert_close(back.positions, shown.positions, rtol=0, atol=0 if exact else 1e-14)
    assert back.dt == pytest.approx(shown.dt, rel=1e-12)
    assert back.name == ("parabola" if exact else "motion")
    assert os.listdir(tmp_path) == [path.name]


def test_names_of_the_coordinates(shown):
    assert shown.columns == ()
    named = Demonstration(shown.positions, shown.dt, columns=["height", "fall"])
    assert named.columns == ("height", "fall")
    assert named.fingerprint[1] == shown.fingerprint[1]
    for columns in (["height"], "hf!", 3):
        with pytest.raises(ValueError, match="columns: expected 2 names"):
            Demonstration(shown.positions, shown.dt, columns=columns)
    with pytest.raises(ValueError, match="columns: expected names that differ"):
        Demonstration(shown.positions, shown.dt, columns=["height", "height"])


def test_npz_with_times(tmp_path):
    np.savez(tmp_path / "a.npz", positions=[[0, 0], [1, 1], [3, 3]], times=[0, 1, 3])
    assert Demonstration.load(tmp_path / "a.npz").positions[:, 0].tolist() == [0, 1.5, 3]


def save_bare(path):
    with path.open("wb") as file:
        np.save(file, np.eye(3))


def save_text(path, text):
    path.write_text(text)


FILES = {
    "not a zip": (".npz", lambda p: p.write_bytes(b"\x00" * 100), "not a readable .npz"),
    "empty": (".npz", lambda p: p.write_bytes(b""), "not a readable .npz"),
    "truncated": (
        ".npz",
        lambda p: (np.savez(p, positions=np.eye(3), dt=1), p.write_bytes(p.read_bytes()[:300])),
        "not a readable",
    ),
    "a pickle": (".npz", lambda p: p.write_bytes(pickle.dumps([1, 2])), "not a readable .npz without pickles"),
    "pickled array": (
        ".npz",
        lambda p: np.savez(p, positions=np.array([object()] * 3), dt=1),
        "not a readable .npz without pickles",
    ),
    "a bare array": (".npz", lambda p: save_bare(p), "not a readable .npz|expected arrays"),
    "no dt": (".npz", lambda p: np.savez(p, positions=np.eye(3)), "dt: expected .* pass dt="),
    "no positions": (".npz", lambda p: np.savez(p, dt=1.0), "columns: expected columns of positions"),
    "two dts": (".npz", lambda p: np.savez(p, positions=np.eye(3), dt=[1.0, 2.0, 1.0, 2.0]), "dt: expected one number"),
    "text dt": (".npz", lambda p: np.savez(p, positions=np.eye(3), dt="soon"), "dt: expected"),
    "bad times": (
        ".npz",
        lambda p: np.savez(p, positions=np.eye(3), times=[2, 1, 0]),
        "times: expected strictly increasing",
    ),
    "nan": (".npz", lambda p: np.savez(p, positions=np.eye(3) * np.nan, dt=1), "positions: expected finite"),
    "empty text": (".csv", lambda p: save_text(p, ""), "path: "),
    "header alone": (".csv", lambda p: save_text(p, "t,y0\n"), "path: |positions: "),
    "words": (".csv", lambda p: save_text(p, "t,y0\n0,a\n1,b\n2,c\n"), "not a table of numbers"),
    "ragged": (".csv", lambda p: save_text(p, "t,y0\n0,1\n1,2,3\n2,3\n"), "not a table of numbers"),
    "no t": (".csv", lambda p: save_text(p, "x,y\n0,1\n1,2\n2,3\n"), "dt: expected .* pass dt="),
    "t alone": (".csv", lambda p: save_text(p, "t\n0\n1\n2\n"), "columns: expected columns of positions"),
    "binary": (".csv", lambda p: p.write_bytes(b"\xff\xfe\x00" * 50), "not a table of numbers"),
    "csv back in time": (
        ".csv",
        lambda p: save_text(p, "t,y0\n0,1\n2,2\n1,3\n"),
        "times: expected strictly increasing",
    ),
    "csv nan": (".csv", lambda p: save_text(p, "t,y0\n0,1\n1,nan\n2,3\n"), "positions: expected finite numbers"),
    "other": (".pkl", lambda p: p.write_bytes(pickle.dumps([1, 2])), "path: expected a file of kind .* got 'file.pkl'"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", FILES)
def test_damaged_files(tmp_path, name):
    suffix, write, message = FILES[name]
    path = tmp_path / f"file{suffix}"
    write(path)
    with pytest.raises(ValueError, match=message):
        Demonstration.load(path)


def test_a_zip_bomb_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr("latentds.files.MAX_BYTES", 10**5)
    np.savez_compressed(tmp_path / "bomb.npz", positions=np.zeros((10**5, 3)), dt=1.0)
    assert (tmp_path / "bomb.npz").stat().st_size < 10**4
    (tmp_path / "long.csv").write_text("t,y\n" + "0,0\n" * 10**5)
    for name in ("bomb.npz", "long.csv"):
        with pytest.raises(ValueError, match=f"^path: {name} .*holds .* bytes, more than 100000"):
            Demonstration.load(tmp_path / name)


class Explosive:
    def __reduce__(self):
        return os.mkdir, ("exploded",)


def test_a_malicious_pickle_is_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.savez(tmp_path / "bad.npz", positions=np.array([Explosive()] * 3, dtype=object), dt=1.0)
    (tmp_path / "worse.npz").write_bytes(pickle.dumps(Explosive()))
    for name in ("bad.npz", "worse.npz"):
        with pytest.raises(ValueError, match="without pickles"):
            Demonstration.load(name)
    assert not (tmp_path / "exploded").exists()


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="path: no such file"):
        Demonstration.load(tmp_path / "nothing.npz")


def test_save_refuses_other_suffixes(shown, tmp_path):
    with pytest.raises(ValueError, match=r"path: expected a \.npz or \.csv file, got 'a\.pkl'"):
        shown.save(tmp_path / "a.pkl")


@pytest.mark.parametrize("suffix", [".npz", ".csv"])
def test_what_is_no_file_is_refused_before_reading(tmp_path, suffix):
    os.mkfifo(tmp_path / f"fifo{suffix}")
    (tmp_path / f"endless{suffix}").symlink_to("/dev/zero")
    (tmp_path / f"folder{suffix}").mkdir()
    for name in ("fifo", "endless", "folder"):
        with pytest.raises(ValueError, match=f"path: expected a regular file, got a .*{name}"):
            Demonstration.load(tmp_path / f"{name}{suffix}")


def test_demonstrations_of(shown):
    assert demonstrations_of(shown, 2) == [shown]
    assert demonstrations_of((shown, shown), 2) == [shown, shown]
    assert only_one([shown], "Method") is shown
    with pytest.raises(ValueError, match="demonstration: expected dimension 3, got 2"):
        demonstrations_of([shown], 3)
    with pytest.raises(ValueError, match="demonstration: Method learns from exactly one, got 2"):
        only_one([shown, shown], "Method")


def test_positions_at_any_time():
    shown = Demonstration([[0, 1], [2, 1], [2, 5.0]], 0.5)
    found = shown.at(np.array([[-1, 0.25], [0.5, 9]]))
    np.testing.assert_allclose(found, [[[0, 1], [1, 1]], [[2, 1], [2, 5]]])
