"""A chain of locally weighted translations and its adjoint sweep: the gradients that refinement descends on."""

from __future__ import annotations

import numpy as np

from .compiling import cached

_fast = cached(nogil=True, fastmath={"reassoc", "contract", "arcp", "nsz"})


@_fast
def chain(points, centers, directions, squares, states, kernels):  # type: ignore[no-untyped-def]
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
def chain_adjoint(cotangent, centers, directions, squares, states, kernels):  # type: ignore[no-untyped-def]
    """The adjoint sweep: from dloss/dψ (n, N) to the gradients of centres, directions and ρ²."""
    cotangent = cotangent.copy()
    d_centers, d_directions = np.empty_like(centers), np.empty_like(directions)
    d_squares = np.empty_like(squares)
    along = np.empty(cotangent.shape[1])
    for j in range(centers.shape[0] - 1, -1, -1):
        along[:] = 0.0
        for a in range(cotangent.shape[0]):
            total = 0.0
            for i in range(cotangent.shape[1]):
                along[i] += directions[j, a] * cotangent[a, i]
                total += kernels[j, i] * cotangent[a, i]
            d_directions[j, a] = total
        for i in range(cotangent.shape[1]):
            along[i] *= kernels[j, i]
        square = 0.0
        for a in range(cotangent.shape[0]):
            total = 0.0
            for i in range(cotangent.shape[1]):
                offset = states[j, a, i] - centers[j, a]
                square -= along[i] * offset * offset
                change = -2.0 * squares[j] * along[i] * offset
                cotangent[a, i] += change
                total -= change
            d_centers[j, a] = total
        d_squares[j] = square
    return d_centers, d_directions, d_squares
