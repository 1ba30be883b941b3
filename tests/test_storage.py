"""Files of systems: exact, atomic, and harmless whoever wrote them."""

from __future__ import annotations

import itertools
import json
import math
import os
import pickle
import struct
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass

import pytest
import torch
from safetensors.torch import save_file

import latentds
from baselines import FDM, SDSEF
from latentds import ChebyshevDS, Demonstration, Learned, StableDS, TubeDS, datasets
from latentds.base import FORMAT, FitReport
from latentds.files import read_tensors, write_tensors
from latentds.methods.tube import TubeReport
from latentds.testing import wavy_motion


def same(a, b):
    y, times = wavy_motion(3).positions, torch.linspace(0, 1, 3)
    with torch.no_grad():
        return torch.equal(a(y), b(y)) and torch.equal(a.rollout(y[:2], times), b.rollout(y[:2], times))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_gives_the_system_back(fitted, method, tmp_path, dtype):
    ds = fitted(method, 3).to(dtype)
    ds.save(tmp_path / "ds.safetensors")
    back = latentds.load(tmp_path / "ds.safetensors", classes=[FDM, SDSEF])
    assert type(back) is type(ds)
    assert back.settings == ds.settings
    assert back.attractor.dtype == dtype
    assert same(back, ds)
    assert os.listdir(tmp_path) == ["ds.safetensors"]


def test_keeps_the_report_and_what_it_was_learned_from(fitted, method, tmp_path):
    ds = fitted(method, 3)
    ds.save(tmp_path / "a")
    report = latentds.load(tmp_path / "a", classes=[FDM, SDSEF]).fit_report
    assert type(report) is type(ds.fit_report)
    assert report == ds.fit_report


def test_the_report_names_its_demonstrations(tmp_path):
    shown = datasets.unstable_spiral(1, 100)
    ChebyshevDS(3, n_layers=5).fit(shown).save(tmp_path / "a")
    assert latentds.load(tmp_path / "a").fit_report.learned_from == (shown.fingerprint,)
    assert shown.fingerprint[0] == "unstable c=1"


@dataclass(frozen=True)
class Detail:
    worst: float
    where: tuple[float, ...]


@dataclass(frozen=True)
class RichReport(FitReport):
    follows: bool | None = None
    detail: Detail | None = None
    pair: tuple[str, int] = ("", 0)


def test_a_third_partys_report_comes_back(tmp_path):
    ds = Reports(2)
    for report in (
        RichReport(1.0, 2, math.inf, (1.0, math.nan), ("ü",)),
        RichReport(0.1, 2, 0.0, follows=False, detail=Detail(0.1 + 0.2, (1, 2.5)), pair=("a", 3)),
    ):
        ds.fit_report = report
        ds.save(tmp_path / "a")
        back = latentds.load(tmp_path / "a", classes=[Reports]).fit_report
        assert type(back) is RichReport
        assert repr(back) == repr(ds.fit_report).replace("(1, 2.5)", "(1.0, 2.5)")


def test_fingerprint_tells_demonstrations_apart():
    shown = wavy_motion(2)
    other = shown.positions.clone()
    other[3, 1] += 1e-15 + 1e-15 * other[3, 1].abs()
    prints = {
        Demonstration(shown.positions, shown.dt).fingerprint[1],
        Demonstration(shown.positions, shown.dt * (1 + 1e-15)).fingerprint[1],
        Demonstration(other, shown.dt).fingerprint[1],
        Demonstration(shown.positions.reshape(-1, 1), shown.dt).fingerprint[1],
    }
    assert len(prints) == 4
    assert Demonstration(shown.positions, shown.dt, "x").fingerprint == ("x", shown.fingerprint[1])


class Mine(StableDS):
    """A third party's."""

    def __init__(self, dim, *, rate=1.0):
        super().__init__(dim)
        self.rate = rate

    def _learn(self, shown, progress):
        return Learned(0.0)

    def forward(self, y):
        return -self.rate * y

    def lyapunov(self, y):
        return y.square().sum(-1)

    def rollout(self, y0, t):
        return y0.unsqueeze(-2) * torch.exp(-self.rate * self._times(t)).unsqueeze(-1)


def test_third_parties_by_explicit_argument(tmp_path):
    Mine(2, rate=3.0).save(tmp_path / "mine")
    assert latentds.load(tmp_path / "mine", classes=[Mine]).rate == 3.0
    with pytest.raises(
        ValueError, match=r"expected a class among \['ChebyshevDS', 'MovedDS', 'TubeDS'\], got 'Mine'; allow others"
    ):
        latentds.load(tmp_path / "mine")
    FDM(2).save(tmp_path / "fdm")
    with pytest.raises(ValueError, match="got 'FDM'; allow others by classes="):
        latentds.load(tmp_path / "fdm")


class Reports(Mine):
    report_type = RichReport


class Forgets(Mine):
    def __init__(self, dim, *, gain=1.0):
        super().__init__(dim)


def test_save_refuses_what_it_could_not_load(tmp_path):
    reported, told = Mine(2), Mine(2)
    reported.fit_report = TubeReport(0.0, 1, 0.0)
    told.fit_report = FitReport(torch.zeros(()), 1, 0.0)
    for ds, message in {
        Forgets(2): "expected constructor arguments kept as attributes, got none for gain",
        Mine(2, rate=torch.ones(1)): r"expected settings of numbers, strings or None, got rate=tensor\(\[1\.\]\)",
        Mine(2, rate=[1.0]): r"expected settings of numbers, strings or None, got rate=\[1\.0\]",
        reported: "expected a fit_report of report_type FitReport, got TubeReport",
        told: "expected a fit_report of numbers, .* got Object of type Tensor",
    }.items():
        with pytest.raises(ValueError, match=f"ds: {message}"):
            ds.save(tmp_path / "a")
    assert not os.listdir(tmp_path)


def written(path, *, state=None, text=None, **changes):
    """A genuine file with its metadata or its tensors changed."""
    ds = ChebyshevDS(2, n_layers=3)
    told = {"format": FORMAT, "class": "ChebyshevDS", "settings": ds.settings, "report": None} | changes
    told = {key: value for key, value in told.items() if value is not ...}
    tensors = ds.state_dict() | (state or {})
    tensors = {name: value.clone() for name, value in tensors.items() if value is not ...}
    save_file(tensors, path, metadata={"latentds": json.dumps(told) if text is None else text})


def damage(path, change):
    written(path)
    path.write_bytes(change(path.read_bytes()))


class Explosive:
    def __reduce__(self):
        return os.mkdir, ("exploded",)


def with_header(change):
    def apply(data):
        size = struct.unpack("<Q", data[:8])[0]
        header = json.loads(data[8 : 8 + size])
        change(header)
        packed = json.dumps(header).encode()
        return struct.pack("<Q", len(packed)) + packed + data[8 + size :]

    return apply


def settings(**changes):
    return ChebyshevDS(2, n_layers=3).settings | changes


def inside(dim):
    return {"class": "ChebyshevDS", "settings": settings(dim=dim, n_layers=1)}


BAD = {
    "pickle": (lambda p: p.write_bytes(pickle.dumps(Explosive())), "not a readable safetensors file"),
    "torch.save": (lambda p: torch.save({"a": Explosive()}, p), "not a readable safetensors file"),
    "empty": (lambda p: p.write_bytes(b""), "not a readable safetensors file"),
    "text": (lambda p: p.write_text("hello, world" * 10), "not a readable safetensors file"),
    "truncated": (lambda p: damage(p, lambda data: data[:-8]), "not a readable safetensors file"),
    "truncated header": (lambda p: damage(p, lambda data: data[:100]), "not a readable safetensors file"),
    "longer": (lambda p: damage(p, lambda data: data + b"\0" * 8), "not a readable safetensors file"),
    "huge header": (
        lambda p: damage(p, lambda data: struct.pack("<Q", 2**62) + data[8:]),
        "not a readable safetensors file",
    ),
    "huge tensor": (
        lambda p: damage(p, with_header(lambda h: h["attractor"].update(shape=[2**60]))),
        "not a readable safetensors file",
    ),
    "tensor outside": (
        lambda p: damage(p, with_header(lambda h: h["attractor"].update(data_offsets=[0, 2**50]))),
        "not a readable safetensors file",
    ),
    "someone else's": (lambda p: save_file({"a": torch.ones(2)}, p), "expected a file that latentds wrote"),
    "no JSON": (lambda p: written(p, text="{"), "does not hold a system"),
    "deep JSON": (lambda p: written(p, text="[" * 100_000), "does not hold a system"),
    "a list": (lambda p: written(p, text="[1, 2]"), "expected a format number in its metadata"),
    "no format": (lambda p: written(p, format=...), "expected a format number in its metadata"),
    "newer": (
        lambda p: written(p, format=FORMAT + 1),
        f"expected format {FORMAT}, got {FORMAT + 1}: it needs a newer latentds",
    ),
    "older": (lambda p: written(p, format=1), f"expected format {FORMAT}, got 1: it needs an older latentds"),
    "no class": (lambda p: written(p, **{"class": ...}), "does not hold a system .* 'class'"),
    "a module's class": (lambda p: written(p, **{"class": "os.system"}), "expected a class among .*, got 'os.system'"),
    "unhashable class": (lambda p: written(p, **{"class": ["FDM"]}), "does not hold a system"),
    "no settings": (lambda p: written(p, settings=...), "does not hold a system .* 'settings'"),
    "odd settings": (lambda p: written(p, settings=[2]), "expected the settings"),
    "missing setting": (lambda p: written(p, settings={"dim": 2, "n_layers": 3}), "expected the settings .'beta', .*"),
    "unknown setting": (lambda p: written(p, settings=settings(callback="os.system")), "expected the settings"),
    "bad setting": (lambda p: written(p, settings=settings(beta=7)), "beta: expected a number in"),
    "absurd dim beside a zero": (
        lambda p: written(p, settings=settings(dim=10**12, n_layers=0)),
        "expected sizes that .* stored numbers can fill",
    ),
    "absurd dim": (
        lambda p: written(p, settings=settings(dim=10**12)),
        "expected sizes that .* stored numbers can fill",
    ),
    "absurd dim of what is moved": (
        lambda p: written(p, **{"class": "MovedDS", "settings": {"ds": inside(16_000)}}),
        "expected sizes that .* stored numbers can fill",
    ),
    "absurd dim of what is moved twice": (
        lambda p: written(
            p, **{"class": "MovedDS", "settings": {"ds": {"class": "MovedDS", "settings": {"ds": inside(16_000)}}}}
        ),
        "expected sizes that .* stored numbers can fill",
    ),
    "absurd layers": (lambda p: written(p, settings=settings(n_layers=10**9)), "expected sizes that .* can fill"),
    "endless number": (lambda p: written(p, settings=settings(n_layers=10**400)), "does not hold a system"),
    "other dim": (lambda p: written(p, settings=settings(dim=3)), "size mismatch for attractor"),
    "missing tensor": (lambda p: written(p, state={"start": ...}), "Missing key"),
    "missing attractor": (lambda p: written(p, state={"attractor": ...}), "attractor"),
    "extra tensor": (lambda p: written(p, state={"extra": torch.ones(3)}), "Unexpected key"),
    "wrong shape": (lambda p: written(p, state={"attractor": torch.ones(2, 2)}), "size mismatch for attractor"),
    "whole numbers": (
        lambda p: written(p, state={"attractor": torch.ones(2, dtype=torch.int64)}),
        "attractor in float64 or float32",
    ),
    "eight bits": (
        lambda p: written(p, state={"attractor": torch.ones(2).to(torch.float8_e5m2)}),
        "attractor in float64 or float32",
    ),
    "complex numbers": (
        lambda p: written(p, state={"attractor": torch.ones(2, dtype=torch.complex64)}),
        "expected real numbers, got complex",
    ),
    "a complex layer": (
        lambda p: written(p, state={"start": torch.ones(2, dtype=torch.complex64)}),
        "expected real numbers, got complex",
    ),
    "nan": (lambda p: written(p, state={"attractor": torch.full((2,), torch.nan)}), "expected finite numbers, got NaN"),
    "bad report": (lambda p: written(p, report={"mse": "x"}), "does not hold a system"),
    "odd report": (lambda p: written(p, report=[1]), "report: expected .*FitReport.*, got \\[1\\]"),
    "no report": (lambda p: written(p, report=...), "does not hold a system .* 'report'"),
    "another method's report": (
        lambda p: written(p, report=asdict(TubeReport(0.0, 1, 0.0))),
        "report: expected the fields of FitReport, got unknown or missing ones: .'condition_path', .*'homotopy'",
    ),
    "half a report": (
        lambda p: written(p, report={"mse": 0.0}),
        "report: expected the fields of FitReport, .*: .*'history', .*'seconds'",
    ),
    "mistyped report": (
        lambda p: written(p, report=asdict(FitReport(0.0, 1, "soon"))),
        "seconds: expected <class 'float'>, got 'soon'",
    ),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    write, message = BAD[name]
    write(tmp_path / "bad")
    with pytest.raises(ValueError, match=f"path: .*{message}"):
        latentds.load("bad")
    assert os.listdir(tmp_path) == ["bad"]


def changed(path, ds, **tensors):
    """A genuine file with some of its tensors replaced."""
    ds.save(path)
    about, state = read_tensors(path)
    assert state.keys() >= tensors.keys()
    write_tensors(path, state | {name: torch.as_tensor(value) for name, value in tensors.items()}, about)


NO_SYSTEM = [
    (SDSEF, {"dynamics.duration": -1.0}, r"duration: expected a number > 0, got -1\.0"),
    (SDSEF, {"dynamics.log_speed_range": [1.0, -1.0]}, "log_speed_range: expected its lower end first"),
    (ChebyshevDS, {"dynamics.law.omega": 0.0}, r"omega: expected a number > 0, got 0\.0"),
    *[
        (TubeDS, {f"dynamics.{law}.knots": knots, f"dynamics.{law}.speeds": speeds}, message)
        for law in ("law", "transverse_law")
        for knots, speeds, message in [
            ([0.5, 0.1], [1.0, 1.0], r"knots: expected \(m,\) finite numbers increasing from above 0"),
            ([0.0, 0.1], [1.0, 1.0], r"knots: expected \(m,\) finite numbers increasing from above 0"),
            ([[0.1, 0.5]], [[1.0, 1.0]], r"knots: expected \(m,\) finite numbers increasing from above 0"),
            (0.1, 1.0, r"knots: expected \(m,\) finite numbers increasing from above 0"),
            ([], [], r"knots: expected \(m,\) finite numbers increasing from above 0"),
            ([0.1, 0.5], [1.0, 0.0], r"speeds: expected \(2,\) finite numbers > 0"),
            ([0.1, 0.5], [1.0, -1.0], r"speeds: expected \(2,\) finite numbers > 0"),
            ([0.1, 0.5], [1.0], r"speeds: expected \(2,\) finite numbers > 0"),
        ]
    ],
]


@pytest.mark.parametrize(("kind", "tensors", "message"), NO_SYSTEM)
def test_numbers_that_make_no_system_are_refused(tmp_path, kind, tensors, message):
    changed(tmp_path / "a", kind(2, n_layers=3), **tensors)
    with pytest.raises(ValueError, match=f"path: a does not hold a system that can be loaded: .*{message}"):
        latentds.load(tmp_path / "a", classes=[FDM, SDSEF])


@pytest.mark.parametrize("dtypes", [(torch.float32,), (torch.float32, torch.float64)])
def test_rounding_makes_no_system_unloadable(tmp_path, dtypes):
    ds = TubeDS(3, n_layers=5, refined=False).fit(wavy_motion(3))
    for dtype in dtypes:
        ds.to(dtype)
    ds.save(tmp_path / "a")
    assert torch.equal(latentds.load(tmp_path / "a").frame().axis, ds.frame().axis)


def test_every_truncation_is_a_clear_error(tmp_path):
    written(tmp_path / "whole")
    data = (tmp_path / "whole").read_bytes()
    for length in range(0, len(data), 37):
        (tmp_path / "cut").write_bytes(data[:length])
        with pytest.raises(ValueError, match="path: cut is not a readable safetensors file"):
            latentds.load(tmp_path / "cut")


def test_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="path: no such file"):
        latentds.load(tmp_path / "nothing")


def test_a_load_beside_a_writer_gives_one_system_whole(tmp_path):
    path, done = tmp_path / "a", threading.Event()

    def replace(values):
        for value in values:
            ds = ChebyshevDS(2, n_layers=3, beta=value)
            ds.attractor.fill_(value)
            ds.start.fill_(value)
            ds.save(path)
            if done.is_set():
                return

    replace([0.5])
    with ThreadPoolExecutor(2) as pool:
        writers = [pool.submit(replace, itertools.cycle((0.25, 0.75))) for _ in range(2)]
        try:
            for _ in range(300):
                ds = latentds.load(path)
                assert [ds.beta, *ds.attractor.tolist(), *ds.start.tolist()] == [ds.beta] * 5
        finally:
            done.set()
        for writer in writers:
            writer.result()


def test_a_save_that_fails_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a"
    ChebyshevDS(2).save(path)
    before = path.read_bytes()
    monkeypatch.setattr("safetensors.torch.save", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        ChebyshevDS(3).save(path)
    assert path.read_bytes() == before
    assert os.listdir(tmp_path) == ["a"]
