"""ONNX models in onnxruntime against the systems that they were made of."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from baselines import SDSEF
from latentds import ChebyshevDS, TubeDS
from latentds.testing import wavy_motion

onnxruntime = pytest.importorskip("onnxruntime")
onnx = pytest.importorskip("onnx")
from latentds.deploy import onnx as export  # noqa: E402

LIMITS = {torch.float64: 1e-12, torch.float32: 1e-5}


@pytest.fixture
def run(tmp_path):
    """A system's velocity at points, by way of a file."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1

    def velocity(ds, points, dtype=torch.float64):
        export.write(ds, tmp_path / "field.onnx", dtype=dtype)
        session = onnxruntime.InferenceSession(tmp_path / "field.onnx", options, providers=["CPUExecutionProvider"])
        return session.run(None, {"y": points.to(dtype).numpy()})[0]

    return velocity


@pytest.mark.parametrize("dtype", LIMITS)
@pytest.mark.parametrize("dim", [1, 3, 7])
def test_equal_for_every_law(dim, dtype, dynamics, make_field, positions, run, assert_same_velocity):
    ds = make_field(dim, dynamics)
    points = positions(ds).to(dtype)
    velocities = run(ds, points, dtype)
    assert velocities.dtype == points.numpy().dtype
    assert_same_velocity(velocities, ds, points.double(), LIMITS[dtype])


def test_real_size(make_field, positions, run, assert_same_velocity, tmp_path):
    ds = make_field(3, n_layers=150)
    points = positions(ds, 1000)
    assert_same_velocity(run(ds, points), ds, points, 1e-12)
    assert (tmp_path / "field.onnx").stat().st_size < 100_000
    small = run(make_field(3, n_layers=2), points)
    nodes = [len(onnx.load(tmp_path / "field.onnx").graph.node)]
    export.write(ds, tmp_path / "field.onnx")
    assert small.shape == points.shape
    assert nodes == [len(onnx.load(tmp_path / "field.onnx").graph.node)]


@pytest.mark.parametrize("count", [0, 1, 5])
def test_any_batch(count, make_field, positions, run, assert_same_velocity):
    ds = make_field(2)
    points = positions(ds)[:count]
    velocities = run(ds, points)
    assert velocities.shape == (count, 2)
    if count:
        assert_same_velocity(velocities, ds, torch.cat([points, positions(ds)])[:count], 1e-12)


def test_positions_that_are_not_finite(dynamics, make_field, run, assert_spoils_its_row_alone):
    assert_spoils_its_row_alone(run, make_field(3, dynamics))


def test_at_rest_and_very_far(dynamics, make_field, run):
    ds = make_field(2, dynamics)
    points = torch.stack([ds.attractor, ds.attractor + 1e-160, torch.full((2,), 1e200, dtype=torch.float64)])
    velocities = run(ds, points)
    assert np.abs(velocities[:2]).max() < 1e-9
    assert np.isfinite(velocities).all()


@pytest.mark.parametrize("dtype", LIMITS)
def test_unfitted_systems_and_those_in_float32(dtype, run, assert_same_velocity, draw):
    ds = TubeDS(2, n_layers=4).to(dtype)
    points = torch.randn(9, 2, generator=draw).to(dtype)
    assert_same_velocity(run(ds, points, dtype), ds, points, LIMITS[dtype])


def test_the_file_tells_where_it_comes_from(tmp_path):
    shown = wavy_motion(2)
    ds = ChebyshevDS(2, n_layers=10).fit(shown)
    export.write(ds, tmp_path / "field.onnx")
    model = onnx.load(tmp_path / "field.onnx")
    onnx.checker.check_model(model, full_check=True)
    metadata = {entry.key: entry.value for entry in model.metadata_props}
    assert metadata["method"] == "ChebyshevDS"
    assert metadata["dim"] == "2"
    assert [float(value) for value in metadata["goal"].split(", ")] == shown.goal.tolist()
    assert shown.fingerprint[1] in metadata["learned from"]


class Doubled(ChebyshevDS):
    def forward(self, y):
        return 2 * super().forward(y)


class OwnRay(type(ChebyshevDS(1, n_layers=1).dynamics)):
    def forward(self, x, y, frame):
        return 2 * super().forward(x, y, frame)


def own_dynamics():
    ds = ChebyshevDS(2, n_layers=2)
    ds.dynamics = OwnRay(ds.dynamics.law)
    return ds


def broken():
    ds = copy.deepcopy(ChebyshevDS(2, n_layers=2))
    with torch.no_grad():
        ds.diffeomorphism.centers[0, 0] = torch.nan
    return ds


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: SDSEF(2, n_layers=2, n_features=5, seed=0), "got SDSEF: its diffeomorphism AffineCouplings has no"),
        (own_dynamics, "got ChebyshevDS: its dynamics OwnRay, or a time law of theirs, have no"),
        (lambda: Doubled(2, n_layers=2), "got Doubled: its velocity is its own"),
        (broken, "expected finite parameters, got ChebyshevDS with NaN or inf"),
    ],
)
def test_what_cannot_be_written_is_refused(make, message, tmp_path):
    (tmp_path / "field.onnx").write_bytes(b"before")
    with pytest.raises(ValueError, match=message):
        export.write(make(), tmp_path / "field.onnx")
    assert (tmp_path / "field.onnx").read_bytes() == b"before"
    assert [file.name for file in tmp_path.iterdir()] == ["field.onnx"]


def test_other_dtypes_are_refused(make_field, tmp_path):
    with pytest.raises(ValueError, match=r"dtype: expected torch.float64 or torch.float32, got torch.float16"):
        export.write(make_field(2), tmp_path / "field.onnx", dtype=torch.float16)
