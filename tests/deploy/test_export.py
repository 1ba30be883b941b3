"""torch.export and torch.compile against the eager system: equal, right in their derivatives, of one size."""

from __future__ import annotations

import copy
import io

import pytest
import torch
from torch.func import jacfwd, jacrev, jvp, vmap

from latentds import TubeDS

BATCH = {0: torch.export.Dim("batch")}


def size(program):
    """Nodes of a graph and of the graphs inside it."""
    return sum(len(part.graph.nodes) for part in program.modules() if isinstance(part, torch.fx.GraphModule))


class Call(torch.nn.Module):
    """A method of a system, as the module that torch.export takes."""

    def __init__(self, ds, name):
        super().__init__()
        self.ds, self.name = ds, name

    def forward(self, y):
        return getattr(self.ds, self.name)(y)


@pytest.fixture(autouse=True)
def _forget_compiled():
    torch._dynamo.reset()


@pytest.mark.slow
def test_export_and_compile(make_field, positions, assert_same_velocity):
    """All at once, in small; one trace of the root takes seconds."""
    ds = make_field(3, n_layers=3).requires_grad_(False)
    points = positions(ds)
    exported = torch.export.export(ds, (points[:5],), dynamic_shapes=(BATCH,)).module()
    compiled = torch.compile(ds, backend="aot_eager", fullgraph=True)
    for y in (points, points[:2], points.T.contiguous().T):
        assert_same_velocity(exported(y), ds, y, 1e-12)
    for y in (points, points[:2]):
        assert_same_velocity(compiled(y), ds, y, 1e-12)
    with pytest.raises(ValueError, match=r"y: expected shape \(\.\.\., 3\), got \(4, 2\)"):
        torch.compile(ds, backend="eager")(torch.zeros(4, 2, dtype=torch.float64))


@pytest.mark.slow
def test_real_size(make_field, positions, assert_same_velocity):
    """One case of the four that ``make speed`` measures."""
    ds = make_field(7, n_layers=300).float()
    points = positions(ds)
    exported = torch.export.export(ds, (points,), dynamic_shapes=(BATCH,))
    small = torch.export.export(make_field(7, n_layers=2).float(), (points,), dynamic_shapes=(BATCH,))
    assert size(exported.graph_module) == size(small.graph_module)
    file = io.BytesIO()
    torch.export.save(exported, file)
    file.seek(0)
    loaded = torch.export.load(file).module()
    with torch.no_grad():
        assert_same_velocity(torch.compile(ds)(points), ds, points, 1e-5)
        for y in (points, points[:7]):
            assert_same_velocity(loaded(y), ds, y, 1e-5)


@pytest.mark.slow
def test_every_law(make_field, dynamics, positions, assert_same_velocity):
    ds = make_field(2, dynamics, n_layers=5).requires_grad_(False)
    points = positions(ds)
    exported = torch.export.export(ds, (points,), dynamic_shapes=(BATCH,), strict=True).module()
    assert_same_velocity(exported(points), ds, points, 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["encode", "decode", "jacobian", "lyapunov"])
def test_every_map(name, make_field, positions):
    ds = make_field(2, n_layers=5).requires_grad_(False)
    points = positions(ds)
    expected = getattr(ds, name)(points)
    compiled = torch.compile(Call(ds, name), backend="aot_eager")
    for program in (torch.export.export(Call(ds, name), (points,)).module(), compiled):
        torch.testing.assert_close(program(points), expected, rtol=1e-11, atol=1e-11)


@pytest.mark.slow
def test_exported_programs_have_the_gradients_of_the_system(make_field, positions):
    """While no compiled loop has: where torch.compile meets a gradient, the system is called outside of the graph."""
    ds = make_field(2, n_layers=4)
    points = positions(ds)
    exported = torch.export.export(ds, (points,)).module()
    for system in (exported, torch.compile(ds, backend="aot_eager")):
        for asked in (False, True):
            y = points.clone().requires_grad_(asked)
            inputs = [y] if asked else []
            wanted = torch.autograd.grad(ds(y).square().sum(), [*inputs, *ds.parameters()])
            gradients = torch.autograd.grad(system(y).square().sum(), [*inputs, *system.parameters()])
            for one, other in zip(gradients, wanted, strict=True):
                torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11)
    ds.requires_grad_(False)
    y = points.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(torch.compile(ds, backend="aot_eager")(y).sum(), [y])
    (wanted,) = torch.autograd.grad(ds(y).sum(), [y])
    torch.testing.assert_close(gradient, wanted, rtol=1e-9, atol=1e-11)


TRANSFORMS = {
    "vmap": vmap,
    "jacrev": lambda f: vmap(jacrev(f)),
    "jacfwd": lambda f: vmap(jacfwd(f)),
    "jvp": lambda f: lambda y: jvp(f, (y,), (y.flip(0),))[1],
}


@pytest.mark.slow
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_compiled_transforms(transform, make_field, positions):
    ds = make_field(2, n_layers=3).requires_grad_(False)
    points = positions(ds, 6)[:3]
    for call in (ds, ds.encode, ds.decode):
        transformed = TRANSFORMS[transform](lambda y, call=call: call(y))
        torch._dynamo.reset()
        compiled = torch.compile(transformed, backend="aot_eager")(points)
        torch.testing.assert_close(compiled, transformed(points), rtol=1e-9, atol=1e-11)


def test_exporting_a_rollout_is_refused(make_field, positions):
    ds = make_field(2, n_layers=2)

    class Motion(torch.nn.Module):
        def forward(self, y):
            return ds.rollout(y, torch.linspace(0, 1, 5))

    with pytest.raises(ValueError, match="rollout: cannot be exported"):
        torch.export.export(Motion(), (positions(ds),))


def test_compiling_the_whole_graph_with_gradients_is_refused(make_field):
    ds = make_field(2, n_layers=2)
    with pytest.raises(torch._dynamo.exc.Unsupported, match="under fullgraph=True freeze it"):
        torch.compile(ds, backend="eager", fullgraph=True)(ds.attractor)


@pytest.mark.slow
def test_unfitted_systems_and_copies(assert_same_velocity):
    ds = TubeDS(2, n_layers=2).requires_grad_(False)
    for system in (ds, copy.deepcopy(ds).float()):
        y = torch.ones(3, 2).to(system.attractor)
        assert_same_velocity(torch.export.export(system, (y,)).module()(y), system, y, 1e-6)


@pytest.mark.filterwarnings("ignore::DeprecationWarning:torch", "ignore::torch.jit.TracerWarning")  # of any trace
def test_traces_take_every_step(make_field, positions):
    """The point that is traced needs fewer steps of the root than others."""
    ds = make_field(2, n_layers=5)
    points = positions(ds)
    with torch.no_grad():
        traced = torch.jit.trace(ds, torch.full((1, 2), 1e3, dtype=torch.float64))
        torch.testing.assert_close(traced(points), ds(points), rtol=1e-10, atol=1e-10)
