"""C headers, compiled as strictly as C99 is, against the systems that they were made of."""

from __future__ import annotations

import ctypes
import inspect
import shutil
import subprocess
import textwrap

import numpy as np
import pytest
import torch

from baselines import SDSEF
from latentds import ChebyshevDS, Demonstration, TubeDS
from latentds.deploy import c
from latentds.testing import wavy_motion

COMPILER = shutil.which("gcc") or shutil.which("cc")
STRICT = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-Wdouble-promotion", "-Wshadow"]
LIBRARY = """
#include "field.h"
void in_double(const double *y, double *v, int n) {
    for (int i = 0; i < n; i++) field_velocity(y + i * field_DIM, v + i * field_DIM);
}
void in_float(const float *y, float *v, int n) {
    for (int i = 0; i < n; i++) field_velocityf(y + i * field_DIM, v + i * field_DIM);
}
"""
FUNCTIONS = {np.dtype(np.float64): "in_double", np.dtype(np.float32): "in_float"}

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")


def build(folder, source, *options):
    (folder / "source.c").write_text(source)
    built = folder / "built"
    done = subprocess.run(
        [COMPILER, *STRICT, "-O1", *options, "source.c", "-o", built, "-lm"], cwd=folder, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return built


@pytest.fixture
def run(tmp_path):
    """A system's velocity at points, in their dtype, by way of a header."""

    def velocity(ds, points, in_place=False):
        c.write(ds, tmp_path / "field.h", name="field")
        library = ctypes.CDLL(str(build(tmp_path, LIBRARY, "-shared", "-fPIC")))
        y = np.asarray(points).copy()
        out = y if in_place else np.empty_like(y)
        pointers = (array.ctypes.data_as(ctypes.c_void_p) for array in (y, out))
        getattr(library, FUNCTIONS[y.dtype])(*pointers, ctypes.c_int(len(y)))
        return out

    return velocity


@pytest.mark.parametrize("dim", [1, 3, 7])
def test_equal_for_every_law(dim, dynamics, make_field, positions, run, assert_same_velocity):
    ds = make_field(dim, dynamics)
    points = positions(ds)
    assert_same_velocity(run(ds, points), ds, points, 1e-12)


def test_float_errs_as_a_rounding_of_the_position_would(dynamics, make_field, positions, run):
    ds = make_field(3, dynamics)
    points = positions(ds).float()
    assert_errs_as_rounding_would(run(ds, points), ds, points, 3)


def assert_errs_as_rounding_would(velocities, ds, points, times):
    """No more than ``times`` what rounding the positions to float changes the velocity by."""
    y = points.double()
    with torch.no_grad():
        expected, jacobians = ds(y), torch.func.vmap(torch.func.jacfwd(ds))(y)
        rounding = jacobians.norm(dim=(1, 2)) * y.norm(dim=-1) * torch.finfo(torch.float32).eps / 2
        largest = expected.norm(dim=-1).max()
    error = (torch.from_numpy(velocities).double() - expected).norm(dim=-1)
    assert (error <= times * rounding + 1e-6 * largest).all()


@pytest.mark.parametrize("n_layers", [1, 10])
@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_sdsef(dim, n_layers, run, draw, assert_same_velocity):
    # Every layer rounds the latent point, in a product and a sum, and near the goal that counts a thousandfold: the
    # speed falls to 0 within a thousandth of the way. Points lie as near as motions do: the features' angles grow with
    # distance, from layer to layer, and far away no digit of their cosines is left.
    ds = coupled(dim, n_layers)
    reach = torch.logspace(-9, 0.3, 60, dtype=torch.float64).unsqueeze(-1)
    points = ds.attractor + reach * torch.randn(60, dim, generator=draw, dtype=torch.float64)
    assert_same_velocity(run(ds, points), ds, points, 1e-11)
    assert_errs_as_rounding_would(run(ds, points.float()), ds, points.float(), 2 + 2 * n_layers)


@pytest.mark.parametrize("dim", [1, 2])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_sdsef_anywhere(dtype, dim, run, assert_spoils_its_row_alone):
    ds = coupled(dim, 2)
    assert_spoils_its_row_alone(run, ds, dtype)
    goal, far = ds.attractor.to(dtype), {torch.float64: 1e200, torch.float32: 1e30}[dtype]
    points = torch.stack([goal, goal + torch.finfo(dtype).tiny, torch.full_like(goal, far)])
    velocities = run(ds, points)
    assert np.abs(velocities[:2]).max() < {torch.float64: 1e-9, torch.float32: 1e-2}[dtype]
    assert np.isfinite(velocities).all()
    assert np.array_equal(run(ds, points, in_place=True), velocities)


def coupled(dim, n_layers):
    """An SDS-EF with layers as a fit leaves them, and an attractor off the origin."""
    ds, draw = SDSEF(dim, n_layers=n_layers, n_features=50, seed=dim), torch.Generator().manual_seed(dim)
    with torch.no_grad():
        ds.diffeomorphism.amplitudes.normal_(0, 0.015, generator=draw)
        ds.diffeomorphism.center.normal_(generator=draw)
        ds.diffeomorphism.scale.uniform_(0.5, 2, generator=draw)
        ds.attractor.normal_(generator=draw)
        ds.start.copy_(ds.attractor + 1)
    return ds


def test_ten_thousand_points(make_field, positions, run, assert_same_velocity):
    ds = make_field(3, n_layers=150)
    points = positions(ds, 10_000)
    assert_same_velocity(run(ds, points), ds, points, 1e-12)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_positions_that_are_not_finite(dtype, make_field, run, assert_spoils_its_row_alone):
    assert_spoils_its_row_alone(run, make_field(3), dtype)


def test_at_rest_and_very_far(dynamics, make_field, run):
    ds = make_field(2, dynamics)
    far = {torch.float64: 1e200, torch.float32: 1e30}
    for dtype, distance in far.items():
        near = ds.attractor.to(dtype)
        velocities = run(
            ds, torch.stack([near, near + torch.finfo(dtype).tiny, torch.full((2,), distance, dtype=dtype)])
        )
        assert np.abs(velocities[:2]).max() < {torch.float64: 1e-9, torch.float32: 1e-3}[dtype]
        assert np.isfinite(velocities).all()


def test_in_place(make_field, positions, run):
    ds = make_field(3)
    points = positions(ds)
    assert np.array_equal(run(ds, points, in_place=True), run(ds, points))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_unfitted_systems_and_those_in_float32(dtype, run, assert_same_velocity, draw):
    ds = TubeDS(2, n_layers=4).to(dtype)
    points = torch.randn(9, 2, generator=draw).to(dtype)
    assert_same_velocity(run(ds, points.double()), ds, points, {torch.float64: 1e-12, torch.float32: 1e-6}[dtype])


def test_the_program_in_the_docstring(tmp_path):
    program = inspect.getdoc(c.write).partition("::\n")[2]
    c.write(ChebyshevDS(2, n_layers=10).fit(wavy_motion(2)), tmp_path / "reach.h", name="reach")
    printed = subprocess.run([build(tmp_path, textwrap.dedent(program))], capture_output=True, text=True, check=True)
    reached, goal = np.array([line.split() for line in printed.stdout.splitlines()], float).T
    assert np.abs(goal).max() > 0.1
    assert np.abs(reached - goal).max() < 1e-6


def test_two_fields_in_one_program(make_field, tmp_path):
    for name, dim in (("reach", 2), ("Reach", 3)):
        c.write(make_field(dim), tmp_path / f"{name}_{dim}.h", name=name)
    source = '#include "reach_2.h"\n#include "Reach_3.h"\nint main(void) { return reach_DIM + 10 * Reach_DIM; }\n'
    assert subprocess.run([build(tmp_path, source)]).returncode == 32


def test_the_file_tells_where_it_comes_from(tmp_path):
    motion = wavy_motion(2)
    shown = Demonstration(motion.positions, motion.dt, name='a "name" */ int x; ??/\n\N{SNOWMAN}')
    ds = ChebyshevDS(2, n_layers=10).fit(shown)
    c.write(ds, tmp_path / "field.h", name="field")
    about = (tmp_path / "field.h").read_text("ascii").partition("*/")[0]
    goal = ", ".join(map(str, shown.goal.tolist()))
    for line in ("method: ChebyshevDS", "dim: 2", f"goal: {goal}", "units: position as in", shown.fingerprint[1]):
        assert line in about
    build(tmp_path, LIBRARY, "-shared", "-fPIC")


@pytest.mark.parametrize("name", ["", "1st", "_field", "my-field", "Größe", "a b", "field\n", None, 3])
def test_bad_names_are_refused(name, make_field, tmp_path):
    with pytest.raises(ValueError, match="name: expected letters, digits and underscores after a first letter, got"):
        c.write(make_field(2), tmp_path / "field.h", name=name)
    assert not list(tmp_path.iterdir())


class Doubled(ChebyshevDS):
    def forward(self, y):
        return 2 * super().forward(y)


def test_what_cannot_be_written_is_refused(make_field, tmp_path):
    with pytest.raises(ValueError, match="got Doubled: its velocity is its own, and its tables"):
        c.write(Doubled(2, n_layers=2), tmp_path / "field.h", name="field")
    with pytest.raises(ValueError, match="got MovedDS: its velocity is its own, and its tables"):
        c.write(coupled(2, 2).with_goal(torch.ones(2)), tmp_path / "field.h", name="field")
    ds = coupled(2, 2)
    ds.diffeomorphism.center[0] = torch.nan
    with pytest.raises(ValueError, match="ds: expected finite parameters, got SDSEF with NaN or inf"):
        c.write(ds, tmp_path / "field.h", name="field")
    ds.diffeomorphism.center[0] = 1e60
    with pytest.raises(ValueError, match="ds: expected parameters that a float can hold, got 1e"):
        c.write(ds, tmp_path / "field.h", name="field")
    ds = make_field(2)
    with torch.no_grad():
        ds.diffeomorphism.log_widths.fill_(60.0)
    with pytest.raises(ValueError, match="ds: expected parameters that a float can hold, got "):
        c.write(ds, tmp_path / "field.h", name="field")
    assert not list(tmp_path.iterdir())
