"""Affine coupling layers of random Fourier features: the diffeomorphism of SDS-EF."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any, cast

import torch
from torch import Tensor, nn

from latentds.arguments import check_points, positive, whole_number
from latentds.diffeomorphism import Diffeomorphism, Invertibility

from .coupling_kernels import Couplings


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
        center, scale: (n,) buffers, units of y; scale > 0.
    """

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
        parts = torch.arange(0, dim, 2), torch.arange(1, dim, 2)
        self.layers = nn.ModuleList(
            _Coupling(len(parts[j % 2]), len(parts[(j + 1) % 2]), n_features, positive(sigma, "sigma"), generator)
            for j in range(n_layers)
        )
        self.register_buffer("center", torch.zeros(dim, dtype=torch.float64))
        self.register_buffer("scale", torch.ones(dim, dtype=torch.float64))

    def extra_repr(self) -> str:
        return f"dim={self.dim}, n_layers={self.n_layers}, n_features={self.n_features}"

    def forward(self, x: Tensor) -> Tensor:
        check_points(self.dim, x, "x")
        parts = [x[..., 0::2], x[..., 1::2]]
        for source, layer in reversed(self._couplings()):
            log_scale, shift = layer(parts[source])
            parts[1 - source] = (parts[1 - source] - shift) * torch.exp(-log_scale)
        return self._join(parts) * self.scale + self.center

    def inverse(self, y: Tensor) -> Tensor:
        u = self.normalize(y)
        parts = [u[..., 0::2], u[..., 1::2]]
        for source, layer in self._couplings():
            log_scale, shift = layer(parts[source])
            parts[1 - source] = parts[1 - source] * torch.exp(log_scale) + shift
        return self._join(parts)

    def linearize(self, y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """As in the base class; the map also takes a stack of tangents at once, (..., *y.shape)."""
        u = self.normalize(y)
        parts = [u[..., 0::2], u[..., 1::2]]
        steps = []
        for source, layer in self._couplings():
            log_scale, shift, log_scale_slope, shift_slope = layer.with_slopes(parts[source])
            grown = parts[1 - source] * torch.exp(log_scale)
            steps.append((source, torch.exp(-log_scale), grown.unsqueeze(-1) * log_scale_slope + shift_slope))
            parts[1 - source] = grown + shift

        def push(tangent: Tensor) -> Tensor:
            parts = [tangent[..., 0::2], tangent[..., 1::2]]
            for source, inverse_scale, slope in reversed(steps):
                sheared = (slope * parts[source].unsqueeze(-2)).sum(-1)
                parts[1 - source] = (parts[1 - source] - sheared) * inverse_scale
            return self._join(parts) * self.scale

        return self._join(parts), push

    def compiled_linearize(self) -> Callable[[Tensor], tuple[Tensor, Callable[[Tensor], Tensor]]]:
        """:meth:`linearize` for training on the CPU in float32: several times faster, differentiable once.

        Takes (N, n) points. Reads the frozen features now, the amplitudes and the normalisation at every call.
        """
        layers = [layer for _, layer in self._couplings()]
        compiled = Couplings([layer.frequencies for layer in layers], [layer.phases for layer in layers])

        def linearize(y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
            x, push = compiled.linearize(self.normalize(y), [layer.amplitudes for layer in layers])
            return x, lambda tangent: push(tangent) * self.scale

        return linearize

    def jacobian(self, x: Tensor) -> Tensor:
        _, push = self.linearize(self(x))
        axes = torch.eye(self.dim, dtype=x.dtype, device=x.device)
        return push(axes.view(self.dim, *[1] * (x.ndim - 1), self.dim).expand(self.dim, *x.shape)).movedim(0, -1)

    def log_abs_det_jacobian(self, x: Tensor) -> Tensor:
        check_points(self.dim, x, "x")
        parts = [x[..., 0::2], x[..., 1::2]]
        total = self.scale.log().sum().expand(x.shape[:-1])
        for source, layer in reversed(self._couplings()):
            log_scale, shift = layer(parts[source])
            parts[1 - source] = (parts[1 - source] - shift) * torch.exp(-log_scale)
            total = total - log_scale.sum(-1)
        return total

    def invertibility(self) -> Invertibility:
        # Every coupling scales by exp(bounded): positive, whatever the finite parameters are.
        finite = all(bool(torch.isfinite(part).all()) for part in self.state_dict().values())
        margin = float(self.scale.min()) if finite else -math.inf
        return Invertibility("every coupling has a positive determinant", self.n_layers, margin, "least scale")

    def normalize(self, y: Tensor) -> Tensor:
        """(y - center) / scale: (..., n) -> (..., n)."""
        check_points(self.dim, y, "y")
        return (y - self.center) / self.scale

    def _couplings(self) -> list[tuple[int, _Coupling]]:
        """Every layer with the part that it reads: 0, the even coordinates, or 1."""
        return [(j % 2, cast("_Coupling", layer)) for j, layer in enumerate(self.layers)]

    def _join(self, parts: list[Tensor]) -> Tensor:
        even, odd = parts[0], nn.functional.pad(parts[1], (0, self.dim % 2))
        return torch.stack([even, odd], -1).flatten(-2)[..., : self.dim]


def no_autocast(like: Tensor) -> AbstractContextManager[Any]:
    """Within it torch.autocast takes no product in half precision, of which a map would become another one."""
    return nullcontext() if like.is_meta else torch.autocast(like.device.type, enabled=False)


class _Coupling(nn.Module):
    """Log-scale and shift of one coupling, and their slopes, as functions of the part p that it reads."""

    frequencies: Tensor
    phases: Tensor

    def __init__(
        self, n_read: int, n_moved: int, n_features: int, sigma: float, generator: torch.Generator | None
    ) -> None:
        super().__init__()
        frequencies = torch.randn(2, n_features, n_read, dtype=torch.float64, generator=generator) / sigma
        phases = 2 * math.pi * torch.rand(2, n_features, dtype=torch.float64, generator=generator)
        self.register_buffer("frequencies", frequencies)
        self.register_buffer("phases", phases)
        self.amplitudes = nn.Parameter(torch.zeros(2, n_moved, n_features, dtype=torch.float64))

    def forward(self, p: Tensor) -> tuple[Tensor, Tensor]:
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
            # ds_i/dp_k = -Σ_f A_if W_fk sin_f: one product of the sines with the (b a, F) matrix of the A_if W_fk
            slopes = -self.amplitudes.unsqueeze(-2) * self.frequencies.mT.unsqueeze(-3)
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
        return p @ self.frequencies.flatten(0, 1).mT + self.phases.flatten()
