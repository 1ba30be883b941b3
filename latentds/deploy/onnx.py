"""A velocity field as an ONNX model: the loops over the layers are Scan nodes, so that the file stays small."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from ..arguments import Array
from ..files import atomic_write
from ..kernels.translations import BEYOND
from ..tabulated import LINEAR_BELOW, LawKind, LawTable
from ..translations import ROOT_STEPS
from .tables import FieldTables, VelocityField, describe, tables_of

try:
    from onnx import NodeProto, TensorProto, checker, helper, numpy_helper
except ImportError as error:
    raise ImportError("writing ONNX needs onnx: pip install 'latentds[onnx]'") from error

OPSET, IR_VERSION = 17, 8
"""Of 2022, so that older runtimes read the files too."""
DTYPES = {torch.float64: TensorProto.DOUBLE, torch.float32: TensorProto.FLOAT}


def write(ds: VelocityField, path: str | os.PathLike[str], *, dtype: torch.dtype = torch.float64) -> None:
    """Write the velocity of a system as it is now: one model, from ``y`` (batch, n) to ``velocity`` (batch, n).

    The batch may have any size, none included; a position that is not finite has a velocity of NaN. The model consists
    of standard operators of opset 17; its metadata tell the method, the goal, the units and the demonstrations. A call
    takes onnxruntime some 0.2 ms a layer, for one point as for a hundred: control loops are better served by
    :mod:`latentds.deploy.c` or a :class:`~latentds.deploy.controller.Controller`.

    Args:
        ds: a system of locally weighted translations with the dynamics of this package, fitted or not, in any dtype
            and on any device.
        path: the file, by custom ``*.onnx``; it is there whole or not at all.
        dtype: torch.float64 or torch.float32, of positions and velocities. What is between is float64 either way, as
            in the kernels of this package: in float32 a velocity would be off by up to 1e-4 of the largest one.

    Raises:
        ValueError: for a system that cannot be written so, naming what is missing, or another dtype.
        ImportError: without onnx: ``pip install 'latentds[onnx]'``.

    Example::

        onnx.write(ds, "reach.onnx", dtype=torch.float32)
        session = onnxruntime.InferenceSession("reach.onnx")
        (velocity,) = session.run(None, {"y": numpy.zeros((1, ds.dim), numpy.float32)})
    """
    if dtype not in DTYPES:
        raise ValueError(f"dtype: expected torch.float64 or torch.float32, got {dtype}")
    tables, graph = tables_of(ds), _Graph()
    y = _Value(graph, "y")
    velocity = _velocity(tables, y.op("Cast", to=TensorProto.DOUBLE))
    graph.nodes.append(helper.make_node("Cast", [velocity.name], ["velocity"], to=DTYPES[dtype]))
    ends = [helper.make_tensor_value_info(name, DTYPES[dtype], ["batch", ds.dim]) for name in ("y", "velocity")]
    constants = [numpy_helper.from_array(value, name) for name, value in graph.constants.items()]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "velocity", ends[:1], ends[1:], constants),
        opset_imports=[helper.make_opsetid("", OPSET)],
        ir_version=IR_VERSION,
        producer_name="latentds",
    )
    helper.set_model_props(model, describe(ds))
    checker.check_model(model)
    with atomic_write(path) as file:
        file.write(model.SerializeToString())


class _Graph:
    """Nodes in the order of their making; a body of a Scan shares names and constants with the graph around it."""

    def __init__(self, around: _Graph | None = None) -> None:
        self.nodes: list[NodeProto] = []
        self.names: itertools.count[int] = around.names if around else itertools.count()
        self.constants: dict[str, Array] = around.constants if around else {}

    def new(self) -> _Value:
        return _Value(self, f"t{next(self.names)}")

    def constant(self, value: Array | float) -> _Value:
        array = np.asarray(value)
        known = (name for name, other in self.constants.items() if other.dtype == array.dtype)
        same = next((name for name in known if np.array_equal(self.constants[name], array)), None)
        if same is None:
            same = f"c{len(self.constants)}"
            self.constants[same] = array
        return _Value(self, same)


class _Value:
    """A tensor of a graph; arithmetic adds nodes to it."""

    def __init__(self, graph: _Graph, name: str) -> None:
        self.graph, self.name = graph, name

    def op(self, kind: str, *others: _Value | Array | float, **attributes: Any) -> _Value:
        inputs = [self, *(v if isinstance(v, _Value) else self.graph.constant(v) for v in others)]
        out = self.graph.new()
        self.graph.nodes.append(helper.make_node(kind, [v.name for v in inputs], [out.name], **attributes))
        return out

    def __add__(self, other: _Value | Array | float) -> _Value:
        return self.op("Add", other)

    def __sub__(self, other: _Value | Array | float) -> _Value:
        return self.op("Sub", other)

    def __mul__(self, other: _Value | Array | float) -> _Value:
        return self.op("Mul", other)

    def __truediv__(self, other: _Value | Array | float) -> _Value:
        return self.op("Div", other)

    def sum(self) -> _Value:
        """Over the last axis, which stays as one of length 1."""
        return self.op("ReduceSum", np.array([-1], np.int64), keepdims=1)


def _velocity(tables: FieldTables, y: _Value) -> _Value:
    """J_ψ(x) g(x), x = ψ⁻¹(y), as in :func:`latentds.kernels.velocity.velocity_kernel`."""
    attractor, axis, (length, *_) = tables.goal
    (x,) = _scan(tables.layers, [y], _untranslate, reverse=True)
    offset = (x - attractor) / length
    along = (offset * axis).sum()
    across = offset - along * axis
    distance = (across * across).sum().op("Sqrt")
    inward = _rate(tables.along, along.op("Abs")) * along * axis + _rate(tables.across, distance) * across
    _, velocity = _scan(tables.layers, [x, inward * -length], _push)
    return velocity + (y * 0.0).sum()  # NaN where y is not finite


def _scan(
    layers: Array, state: Sequence[_Value], step: Callable[..., Sequence[_Value]], *, reverse: bool = False
) -> list[_Value]:
    """``state`` after ``step(c, v, ρ², ρ²‖v‖², *state)`` of every layer."""
    graph, dim = state[0].graph, layers.shape[1] // 2 - 1
    body = _Graph(graph)
    parts = [graph.constant(part) for part in np.split(layers, [dim, 2 * dim, 2 * dim + 1], axis=1)]
    before, layer = [body.new() for _ in state], [body.new() for _ in parts]
    after = step(*layer, *before)
    ends = (
        [helper.make_tensor_value_info(v.name, TensorProto.DOUBLE, None) for v in vs] for vs in (before + layer, after)
    )
    out = [graph.new() for _ in state]
    scan = helper.make_node(
        "Scan",
        [v.name for v in (*state, *parts)],
        [v.name for v in out],
        body=helper.make_graph(body.nodes, step.__name__.strip("_"), next(ends), next(ends)),
        num_scan_inputs=len(parts),
        scan_input_directions=[int(reverse)] * len(parts),
    )
    graph.nodes.append(scan)
    return out


def _untranslate(c: _Value, v: _Value, q: _Value, a: _Value, y: _Value) -> list[_Value]:
    """x of y = x + exp(-ρ²‖x-c‖²) v, by the steps of :func:`latentds.diffeomorphism._solve`."""
    w = y - c
    b, c = (w * v).sum() * q, (w * w).sum() * q
    tiny, eps = np.finfo(np.float64).tiny, np.finfo(np.float64).eps
    s = ((b - (a * 0.5).op("Sqrt")) / a.op("Max", tiny)).op("Clip", 0.0, 1.0)
    for _ in range(ROOT_STEPS):
        g = b - a * s
        k = (s * (g + b) - c).op("Min", 0.0).op("Exp")
        gap = s - k
        gap = gap.op("Abs").op("LessOrEqual", 2 * eps).op("Where", 0.0, gap)
        p = g * k
        slope = p * -2.0 + 1.0
        spread = (slope * slope - gap * 3.0 * (a * k - g * p * 2.0)).op("Abs").op("Sqrt")
        s = (s - gap * 3.0 / (slope + spread * 2.0).op("Max", tiny)).op("Clip", 0.0, 1.0)
    return [y - c.op("Greater", BEYOND).op("Where", 0.0, s) * v]


def _push(c: _Value, v: _Value, q: _Value, a: _Value, x: _Value, tangent: _Value) -> list[_Value]:
    """ψ_j(x), and J_ψ_j(x) of a tangent."""
    w = x - c
    k = ((w * w).sum() * q * -1.0).op("Exp")
    return [x + k * v, tangent + (tangent * w).sum() * (q * k) * -2.0 * v]


def _rate(law: LawTable, s: _Value) -> _Value:
    """h(s)/s."""
    if law.kind is LawKind.EIGENMAP:
        s = s.op("Max", LINEAR_BELOW)
        inside = s.op("Min", 1.0)
        return ((inside * -1.0 + 2.0) / inside).op("Sqrt") * (inside / s) * float(law.speeds[0])
    s = s.op("Max", np.finfo(np.float64).tiny ** 0.25)  # far inside the tail, where h(s)/s no longer changes
    pieces = law.pieces()
    index = s.op("Greater", pieces[0, 1:]).op("Cast", to=TensorProto.INT64).sum()
    start, speed, slope, bend = (s.graph.constant(part).op("Gather", index) for part in pieces)
    ahead = s.op("Min", pieces[0, -1]) - start
    return (speed + ahead * (slope + ahead * bend)) / s
