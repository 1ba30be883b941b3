"""Joint refinement: all centres, directions and widths of a greedy match moved together by L-BFGS."""

from __future__ import annotations

import numpy as np

from ..arguments import Array
from ..kernels.translations import squares_and_gradients
from ..translations import WIDTH_BOUND, Layers, directions_of, strengths_of
from .lbfgs import minimize


def refine(layers: Layers, x: Array, y: Array, mu: float, *, weights: Array | None = None, steps: int = 300) -> Layers:
    """Lower the weighted squared distance between ψ(x) and y, in float64, over every parameter of every layer.

    The bound ρ‖v‖√(2/e) < μ holds by parametrisation, as in LocallyWeightedTranslations but scaled by μ; a layer that
    comes in above it is shortened first.

    Args:
        layers: the match to start from.
        x, y: (N, n) each.
        mu: μ in (0, 1).
        weights: (N,) >= 0, of the points; all equal by default.
        steps: most L-BFGS steps.
    """
    if not len(layers.widths):
        return layers
    shape = layers.centers.shape
    points, targets = np.ascontiguousarray(x), np.ascontiguousarray(y)
    share = np.ones(len(x)) if weights is None else np.asarray(weights, dtype=np.float64)
    share = (share / (share.sum() * shape[1]))[:, None]
    unit = float(np.abs(targets - targets.mean(0)).max())

    def unpack(flat: Array) -> tuple[Array, Array, Array, Array, Array]:
        centers, free = flat[: -shape[0]].reshape(2, *shape)
        root = np.sqrt(1 + np.einsum("ij,ij->i", free, free))[:, None]
        widths = np.exp(flat[-shape[0] :]) / unit
        return centers * unit, free, root, widths, directions_of(free, widths, mu)

    def loss(flat: Array) -> tuple[float, Array]:
        centers, free, root, widths, directions = unpack(flat)
        squares = widths**2
        layers = np.column_stack([centers, directions, squares, squares * (directions**2).sum(1)])
        missed, gradients = squares_and_gradients(layers, points, targets, share)
        d_centers, d_directions, d_squares = np.split(gradients, [shape[1], 2 * shape[1]], axis=1)
        d_bounded = mu * WIDTH_BOUND * d_directions / widths[:, None]
        d_free = d_bounded / root - free * ((d_bounded * free).sum(1, keepdims=True) / root**3)
        d_logs = 2 * squares * d_squares[:, 0] - (d_directions * directions).sum(1)
        gradient = np.concatenate([d_centers.ravel() * unit, d_free.ravel(), d_logs])
        return scale * missed, scale * gradient

    bounds = layers.widths * np.linalg.norm(layers.directions, axis=1) / (mu * WIDTH_BOUND)
    shortened = layers.directions * np.minimum(1, np.sqrt(0.9999) / np.maximum(bounds, 1e-150))[:, None]
    free = strengths_of(shortened, layers.widths, mu)
    start = np.concatenate([(layers.centers / unit).ravel(), free.ravel(), np.log(layers.widths * unit)])
    scale = 1.0
    before = loss(start)[0]
    if not before > 0:
        return layers
    scale = 1 / before
    centers, _, _, widths, directions = unpack(minimize(loss, start, steps=steps).at)
    return Layers(centers, directions, widths)
