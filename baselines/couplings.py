"""Affine coupling layers of random Fourier features: the diffeomorphism of SDS-EF."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from latentds.arguments import Array, check_points, positive, whole_number
from latentds.diffeomorphism import Diffeomorphism, Invertibility
from latentds.kernels.dispatch import can_use_kernel, rows_of, run, tensor_of
from latentds.kernels.functions import Operation, evaluate

from .coupling_kernels import Couplings
from .coupling_sweeps import decode_kernel, encode_kernel, push_kernel

PARAMETERS = ("frequencies", "phases", "amplitudes", "center", "scale")
"""Of the module, in the order in which the functions below take them."""


class AffineCouplings(Diffeomorphism):
    """ψ = φ⁻¹ with φ a composition of affine couplings of random Fourier features (Rana et al. 2020, Sec. IV).

    φ normalises, u = (y - center) / scale, and parts u into its even and its odd coordinates; layer by layer one part
    p moves the other, q ← q ∘ exp(s(p)) + t(p), in turns. Log-scale s and shift t are A cos(W p + b) with frozen
    W ~ N(0, 1) / sigma and b ~ U(0, 2π). A = 0, the start, is the identity. For n = 1 there are no two parts, and φ
    is a learned affine map.

    Args:
        dim: n >= 1.
        n_layers: L >= 1.
        n_features: F >= 1, cosines in each s and in each t.
        sigma: bandwidth of the features, > 0, in normalised units.
        generator: draws W and b (torch's global one if None).

    Attributes:
        frequencies, phases: buffers, of every layer W (2, F, a) with its last two axes exchanged, and b (2, F), of the
            log-scale and of the shift, where the layer reads a coordinates; flat, and (L, 2, F).
        amplitudes: parameter, of every layer A (2, b, F), where it moves b coordinates; flat.
        center, scale: (n,) buffers, units of y; scale > 0.
    """

    frequencies: Tensor
    phases: Tensor
    center: Tensor
    scale: Tensor

    def __init__(
        self,
        dim: int,
        n_layers: int,
        n_features: int,
        *,
        sigma: float = 0.45,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.dim = whole_number(dim, "dim", at_least=1)
        self.n_layers = whole_number(n_layers, "n_layers", at_least=1)
        self.n_features = whole_number(n_features, "n_features", at_least=1)
        sigma = positive(sigma, "sigma")
        frequencies, phases = [], []
        reads = [_n_read(self.dim, layer) for layer in range(self.n_layers)]
        for n_read in reads:
            drawn = torch.randn(2, self.n_features, n_read, dtype=torch.float64, generator=generator) / sigma
            frequencies.append(drawn.mT.flatten())
            phases.append(2 * math.pi * torch.rand(2, self.n_features, dtype=torch.float64, generator=generator))
        n_amplitudes = 2 * self.n_features * sum(self.dim - n_read for n_read in reads)
        self.register_buffer("frequencies", torch.cat(frequencies))
        self.register_buffer("phases", torch.stack(phases))
        self.amplitudes = nn.Parameter(torch.zeros(n_amplitudes, dtype=torch.float64))
        self.register_buffer("center", torch.zeros(dim, dtype=torch.float64))
        self.register_buffer("scale", torch.ones(dim, dtype=torch.float64))

    def extra_repr(self) -> str:
        return f"dim={self.dim}, n_layers={self.n_layers}, n_features={self.n_features}"

    def forward(self, x: Tensor) -> Tensor:
        check_points(self.dim, x, "x")
        return self._evaluated(_DECODE, x)

    def inverse(self, y: Tensor) -> Tensor:
        check_points(self.dim, y, "y")
        return self._evaluated(_ENCODE, y)

    def linearize(self, y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """As in the base class; the map also takes a stack of tangents at once, (..., *y.shape)."""
        check_points(self.dim, y, "y")
        parameters = self.held()
        differentiated = torch.is_grad_enabled() and any(part.requires_grad for part in (y, *parameters))
        if differentiated or not self._can_use_kernel(y):
            return _linearize(parameters, y)
        x, kept = _kept_by_kernel(parameters, y)

        def push(tangent: Tensor) -> Tensor:
            if not self._can_use_kernel(y, tangent):
                return _linearize(parameters, y)[1](tangent)
            return evaluate(_PUSH, kept, parameters, y, tangent)

        return x, push

    def compiled_linearize(self) -> Callable[[Tensor], tuple[Tensor, Callable[[Tensor], Tensor]]]:
        """:meth:`linearize` for training on the CPU in float32: several times faster, differentiable once.

        Takes (N, n) points. Reads the frozen features now, the amplitudes and the normalisation at every call.
        """
        compiled = Couplings(self.frequencies, self.phases)

        def linearize(y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
            x, push = compiled.linearize(self.normalize(y), self.amplitudes)
            return x, lambda tangent: push(tangent) * self.scale

        return linearize

    def jacobian(self, x: Tensor) -> Tensor:
        _, push = self.linearize(self(x))
        axes = torch.eye(self.dim, dtype=x.dtype, device=x.device)
        return push(axes.view(self.dim, *[1] * (x.ndim - 1), self.dim).expand(self.dim, *x.shape)).movedim(0, -1)

    def log_abs_det_jacobian(self, x: Tensor) -> Tensor:
        check_points(self.dim, x, "x")
        return _decode_with_log_det(self.held(), x)[1]

    def invertibility(self) -> Invertibility:
        # Every coupling scales by exp(bounded): positive, whatever the finite parameters are.
        finite = all(bool(torch.isfinite(part).all()) for part in self.state_dict().values())
        margin = float(self.scale.min()) if finite else -math.inf
        return Invertibility("every coupling has a positive determinant", self.n_layers, margin, "least scale")

    def normalize(self, y: Tensor) -> Tensor:
        """(y - center) / scale: (..., n) -> (..., n)."""
        check_points(self.dim, y, "y")
        return (y - self.center) / self.scale

    def held(self) -> list[Tensor]:
        """:data:`PARAMETERS`, as they are now."""
        return [getattr(self, name) for name in PARAMETERS]

    def fits(self) -> bool:
        """Whether the tensors are of the sizes that the constructor gave them: kernels would read beyond them."""
        read = sum(_n_read(self.dim, layer) for layer in range(self.n_layers))
        features = 2 * self.n_features
        sizes = len(self.frequencies), len(self.amplitudes), tuple(self.phases.shape)
        moved = self.n_layers * self.dim - read
        return sizes == (features * read, features * moved, (self.n_layers, 2, self.n_features))

    def _can_use_kernel(self, *points: Tensor) -> bool:
        return can_use_kernel(PARAMETERS, self, *points) and self.fits()

    def _evaluated(self, operation: Operation, points: Tensor) -> Tensor:
        parameters = self.held()
        if not self._can_use_kernel(points):
            return operation.by_torch(parameters, points)
        return evaluate(operation, arrays_of(parameters), parameters, points)


def _n_read(dim: int, layer: int) -> int:
    """How many coordinates a layer reads: the even ones, then the odd ones."""
    return (dim + 1 - layer % 2) // 2


# --- by torch ---------------------------------------------------------------------------------------------------------

Parameters = Sequence[Tensor]
""":data:`PARAMETERS`."""


class _Layer(NamedTuple):
    """One coupling: which part it reads, 0 or 1, and its features."""

    source: int
    frequencies: Tensor
    """(2, a, F)"""
    phases: Tensor
    """(2, F)"""
    amplitudes: Tensor
    """(2, b, F)"""

    def affine(self, p: Tensor) -> tuple[Tensor, Tensor]:
        """s(p), t(p): (..., a) -> (..., b) each."""
        with no_autocast(p):
            cosines = torch.cos(self._angles(p))
            half = cosines.shape[-1] // 2
            return cosines[..., :half] @ self.amplitudes[0].mT, cosines[..., half:] @ self.amplitudes[1].mT

    def with_slopes(self, p: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """s, t and ds/dp, dt/dp: (..., a) -> (..., b), (..., b), (..., b, a), (..., b, a)."""
        with no_autocast(p):
            angles = self._angles(p)
            cosines, sines = torch.cos(angles), torch.sin(angles)
            half = angles.shape[-1] // 2
            # ds_i/dp_k = -Σ_f A_if W_kf sin_f: one product of the sines with the (b a, F) matrix of the A_if W_kf
            slopes = -self.amplitudes.unsqueeze(-2) * self.frequencies.unsqueeze(-3)
            shape = (*p.shape[:-1], *slopes.shape[1:3])
            rows = slopes.flatten(1, 2)
            return (
                cosines[..., :half] @ self.amplitudes[0].mT,
                cosines[..., half:] @ self.amplitudes[1].mT,
                (sines[..., :half] @ rows[0].mT).reshape(shape),
                (sines[..., half:] @ rows[1].mT).reshape(shape),
            )

    def _angles(self, p: Tensor) -> Tensor:
        """W p + b of the log-scale, then of the shift: (..., a) -> (..., 2 F)."""
        return p @ self.frequencies.transpose(0, 1).flatten(1) + self.phases.flatten()


def _layers(parameters: Parameters) -> list[_Layer]:
    frequencies, phases, amplitudes, center, _ = parameters
    dim, (n_layers, _, count) = len(center), phases.shape
    reads = [_n_read(dim, layer) for layer in range(n_layers)]
    own = torch.split(frequencies, [2 * read * count for read in reads])
    shares = torch.split(amplitudes, [2 * (dim - read) * count for read in reads])
    parts = zip(reads, own, phases, shares, strict=True)
    return [
        _Layer(layer % 2, W.view(2, read, count), b, A.view(2, dim - read, count))
        for layer, (read, W, b, A) in enumerate(parts)
    ]


def _decode_with_log_det(parameters: Parameters, x: Tensor) -> tuple[Tensor, Tensor]:
    *_, center, scale = parameters
    parts = [x[..., 0::2], x[..., 1::2]]
    total = scale.log().sum().expand(x.shape[:-1])
    for layer in reversed(_layers(parameters)):
        log_scale, shift = layer.affine(parts[layer.source])
        parts[1 - layer.source] = (parts[1 - layer.source] - shift) * torch.exp(-log_scale)
        total = total - log_scale.sum(-1)
    return _join(parts) * scale + center, total


def _encode(parameters: Parameters, y: Tensor) -> Tensor:
    *_, center, scale = parameters
    u = (y - center) / scale
    parts = [u[..., 0::2], u[..., 1::2]]
    for layer in _layers(parameters):
        log_scale, shift = layer.affine(parts[layer.source])
        parts[1 - layer.source] = parts[1 - layer.source] * torch.exp(log_scale) + shift
    return _join(parts)


def _linearize(parameters: Parameters, y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    *_, center, scale = parameters
    u = (y - center) / scale
    parts = [u[..., 0::2], u[..., 1::2]]
    steps = []
    for layer in _layers(parameters):
        log_scale, shift, log_scale_slope, shift_slope = layer.with_slopes(parts[layer.source])
        grown = parts[1 - layer.source] * torch.exp(log_scale)
        slope = grown.unsqueeze(-1) * log_scale_slope + shift_slope
        steps.append((layer.source, torch.exp(-log_scale), slope))
        parts[1 - layer.source] = grown + shift

    def push(tangent: Tensor) -> Tensor:
        parts = [tangent[..., 0::2], tangent[..., 1::2]]
        for source, inverse_scale, slope in reversed(steps):
            sheared = (slope * parts[source].unsqueeze(-2)).sum(-1)
            parts[1 - source] = (parts[1 - source] - sheared) * inverse_scale
        return _join(parts) * scale

    return _join(parts), push


def _join(parts: list[Tensor]) -> Tensor:
    dim = parts[0].shape[-1] + parts[1].shape[-1]
    even, odd = parts[0], nn.functional.pad(parts[1], (0, dim % 2))
    return torch.stack([even, odd], -1).flatten(-2)[..., :dim]


# --- by kernels -------------------------------------------------------------------------------------------------------

Arrays = tuple[Array, Array, Array, Array]


def arrays_of(parameters: Parameters) -> Arrays:
    """W, b, A, and center and scale (2, n): :data:`PARAMETERS` as the kernels read them."""
    W, b, A, center, scale = (np.ascontiguousarray(part.detach().numpy(), np.float64) for part in parameters)
    return W, b, A, np.stack([center, scale])


def _decode_by_kernel(packed: Arrays, x: Tensor) -> Tensor:
    W, *rest = packed
    points, kernel = rows_of(x), decode_kernel()
    out = np.empty_like(points)
    run(lambda W, *rows: kernel(W, *rest, *rows), W, points, out)
    return tensor_of(out, x, x.shape)


def _encode_by_kernel(packed: Arrays, y: Tensor) -> Tensor:
    W, *rest = packed
    points, kernel = rows_of(y), encode_kernel()
    out, nothing = np.empty_like(points), np.empty((0, 0, 0))
    run(lambda W, *rows: kernel(W, *rest, *rows, nothing), W, points, out)
    return tensor_of(out, y, y.shape)


def _kept_by_kernel(parameters: Parameters, y: Tensor) -> tuple[Tensor, tuple[Array, Array]]:
    """φ(y), and what :func:`push_kernel` needs."""
    W, b, A, box = arrays_of(parameters)
    points, kernel, wide = rows_of(y), encode_kernel(), (y.shape[-1] + 1) // 2
    out, kept = np.empty_like(points), np.empty((len(points), len(b), wide * (1 + wide)))
    run(lambda W, *rows: kernel(W, b, A, box, *rows), W, points, out, kept)
    return tensor_of(out, y, y.shape), (box, kept)


def _push_by_kernel(kept: tuple[Array, Array], y: Tensor, t: Tensor) -> Tensor:
    _, tangents = torch.broadcast_tensors(y, t)  # type: ignore[no-untyped-call]
    count = math.prod(tangents.shape[: tangents.ndim - y.ndim])
    stack = np.ascontiguousarray(tangents.detach().numpy(), np.float64).reshape(count, len(kept[1]), y.shape[-1])
    out = np.empty_like(stack)
    push_kernel()(*kept, stack, out)
    return torch.from_numpy(out).to(t.dtype).reshape(tangents.shape)


_DECODE = Operation(_decode_by_kernel, lambda parameters, x: _decode_with_log_det(parameters, x)[0])
_ENCODE = Operation(_encode_by_kernel, _encode)
_PUSH = Operation(_push_by_kernel, lambda parameters, y, tangent: _linearize(parameters, y)[1](tangent))


def no_autocast(like: Tensor) -> AbstractContextManager[Any]:
    """Within it torch.autocast takes no product in half precision, of which a map would become another one."""
    return nullcontext() if like.is_meta else torch.autocast(like.device.type, enabled=False)
