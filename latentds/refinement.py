"""Joint refinement: all centres, directions and widths of a greedy match moved together by L-BFGS."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from .diffeomorphism import WIDTH_BOUND, Layers
from .kernels.compiling import cached

Array = NDArray[np.float64]


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
    points, targets = np.ascontiguousarray(x.T), np.ascontiguousarray(y.T)
    share = np.ones(len(x)) if weights is None else np.asarray(weights, dtype=np.float64)
    share = share / (share.sum() * shape[1])
    unit = float(np.abs(targets - targets.mean(1, keepdims=True)).max())
    states, kernels = np.empty((shape[0], *points.shape)), np.empty((shape[0], points.shape[1]))

    def unpack(flat: Array) -> tuple[Array, Array, Array, Array, Array]:
        centers, free = flat[: -shape[0]].reshape(2, *shape)
        root = np.sqrt(1 + (free**2).sum(1, keepdims=True))
        widths = np.exp(flat[-shape[0] :]) / unit
        return centers * unit, free, root, widths, mu * WIDTH_BOUND * free / root / widths[:, None]

    def loss(flat: Array) -> tuple[float, Array]:
        centers, free, root, widths, directions = unpack(flat)
        squares = widths**2
        missed = _forward(points, centers, directions, squares, states, kernels) - targets
        pull = 2 * share * missed
        d_centers, d_directions, d_squares = _backward(pull, centers, directions, squares, states, kernels)
        d_bounded = mu * WIDTH_BOUND * d_directions / widths[:, None]
        d_free = d_bounded / root - free * ((d_bounded * free).sum(1, keepdims=True) / root**3)
        d_logs = 2 * squares * d_squares - (d_directions * directions).sum(1)
        gradient = np.concatenate([d_centers.ravel() * unit, d_free.ravel(), d_logs])
        return scale * float((share * missed**2).sum()), scale * gradient

    bounded = layers.widths[:, None] * layers.directions / (mu * WIDTH_BOUND)
    squared = (bounded**2).sum(1, keepdims=True)
    bounded *= np.minimum(1, np.sqrt(0.9999 / np.maximum(squared, 1e-300)))
    free = bounded / np.sqrt(1 - (bounded**2).sum(1, keepdims=True))
    start = np.concatenate([(layers.centers / unit).ravel(), free.ravel(), np.log(layers.widths * unit)])
    scale = 1.0
    before = loss(start)[0]
    if not before > 0:
        return layers
    scale = 1 / before
    options = {"maxiter": steps, "maxfun": 2 * steps, "maxcor": 20, "ftol": 1e-12, "gtol": 1e-10}
    found = minimize(loss, start, jac=True, method="L-BFGS-B", options=options)
    centers, _, _, widths, directions = unpack(found.x)
    return Layers(centers, directions, widths)


_fast = cached(nogil=True, fastmath={"reassoc", "contract", "arcp", "nsz"})


@_fast
def _forward(points, centers, directions, squares, states, kernels):  # type: ignore[no-untyped-def]
    """ψ of (n, N) points, keeping each layer's input and exp(-ρ²‖x-c‖²) for the way back."""
    x = points.copy()
    distance = np.empty(x.shape[1])
    for j in range(centers.shape[0]):
        distance[:] = 0.0
        for a in range(x.shape[0]):
            for i in range(x.shape[1]):
                states[j, a, i] = x[a, i]
                offset = x[a, i] - centers[j, a]
                distance[i] += offset * offset
        for i in range(x.shape[1]):
            exponent = squares[j] * distance[i]
            kernels[j, i] = np.exp(-exponent) if exponent < 650.0 else 0.0
        for a in range(x.shape[0]):
            for i in range(x.shape[1]):
                x[a, i] += kernels[j, i] * directions[j, a]
    return x


@_fast
def _backward(pull, centers, directions, squares, states, kernels):  # type: ignore[no-untyped-def]
    """The adjoint sweep: from dloss/dψ (n, N) to the gradients of centres, directions and ρ²."""
    pull = pull.copy()
    d_centers, d_directions = np.empty_like(centers), np.empty_like(directions)
    d_squares = np.empty_like(squares)
    along = np.empty(pull.shape[1])
    for j in range(centers.shape[0] - 1, -1, -1):
        along[:] = 0.0
        for a in range(pull.shape[0]):
            total = 0.0
            for i in range(pull.shape[1]):
                along[i] += directions[j, a] * pull[a, i]
                total += kernels[j, i] * pull[a, i]
            d_directions[j, a] = total
        for i in range(pull.shape[1]):
            along[i] *= kernels[j, i]
        square = 0.0
        for a in range(pull.shape[0]):
            total = 0.0
            for i in range(pull.shape[1]):
                offset = states[j, a, i] - centers[j, a]
                square -= along[i] * offset * offset
                change = -2.0 * squares[j] * along[i] * offset
                pull[a, i] += change
                total -= change
            d_centers[j, a] = total
        d_squares[j] = square
    return d_centers, d_directions, d_squares
