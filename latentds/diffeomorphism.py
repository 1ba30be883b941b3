"""Diffeomorphisms ψ of R^n, always latent -> demonstration; inverse, tangent map and determinant in closed form."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from .arguments import check_points, positive, whole_number
from .coupling_kernels import Couplings
from .kernels import translations

WIDTH_BOUND = math.sqrt(math.e / 2)
"""A layer x + exp(-ρ²‖x-c‖²) v is invertible while ρ‖v‖ < √(e/2) (Perrin and Schlehuber-Caissier 2016)."""


class Diffeomorphism(nn.Module, ABC):
    """A smooth bijection of R^n with smooth inverse; ``forward`` maps latent -> demonstration.

    Subclasses give :meth:`forward`, :meth:`inverse`, :meth:`linearize`, :meth:`jacobian` and
    :meth:`log_abs_det_jacobian`, all over (..., n).
    """

    dim: int

    @abstractmethod
    def forward(self, x: Tensor) -> Tensor:
        """ψ(x): (..., n) -> (..., n)."""

    @abstractmethod
    def inverse(self, y: Tensor) -> Tensor:
        """ψ⁻¹(y): (..., n) -> (..., n)."""

    @abstractmethod
    def linearize(self, y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """x = ψ⁻¹(y), and the map of tangents (..., n) -> (..., n), t ↦ J_ψ(x) t, for one sweep each way."""

    @abstractmethod
    def jacobian(self, x: Tensor) -> Tensor:
        """J_ψ(x): (..., n) -> (..., n, n)."""

    @abstractmethod
    def log_abs_det_jacobian(self, x: Tensor) -> Tensor:
        """log |det J_ψ(x)|: (..., n) -> (...)."""


class Layers(NamedTuple):
    """Locally weighted translations x + exp(-ρ²‖x-c‖²) v, first to last."""

    centers: NDArray[np.float64]
    """(m, n)"""
    directions: NDArray[np.float64]
    """(m, n)"""
    widths: NDArray[np.float64]
    """(m,) ρ > 0"""


class LocallyWeightedTranslations(Diffeomorphism):
    """ψ = ψ_M ∘ … ∘ ψ_1 with layers ψ_j(x) = x + exp(-ρ_j² ‖x - c_j‖²) v_j (paper, Sec. VI; Perrin 2016, eq. 5).

    The bound that keeps every layer invertible, ρ_j ‖v_j‖ √(2/e) < 1, holds by parametrisation: with a_j free,
    v_j = √(e/2)/ρ_j · a_j/√(1+‖a_j‖²). So any optimiser may train the module. a = 0 is the identity.

    Args:
        dim: n >= 1.
        n_layers: M >= 1.

    Attributes:
        centers: c, (M, n) parameter.
        log_widths: log ρ, (M,) parameter.
        strengths: a, (M, n) parameter.
    """

    def __init__(self, dim: int, n_layers: int) -> None:
        super().__init__()
        self.dim = whole_number(dim, "dim", at_least=1)
        self.n_layers = whole_number(n_layers, "n_layers", at_least=1)
        self.centers = nn.Parameter(torch.zeros(n_layers, dim, dtype=torch.float64))
        self.log_widths = nn.Parameter(torch.zeros(n_layers, dtype=torch.float64))
        self.strengths = nn.Parameter(torch.zeros(n_layers, dim, dtype=torch.float64))

    def extra_repr(self) -> str:
        return f"dim={self.dim}, n_layers={self.n_layers}"

    @property
    def widths(self) -> Tensor:
        """ρ, (M,), per unit length."""
        return self.log_widths.exp()

    @property
    def directions(self) -> Tensor:
        """v, (M, n), in units of length."""
        bounded = self.strengths / (1 + self.strengths.square().sum(-1, keepdim=True)).sqrt()
        return WIDTH_BOUND * torch.exp(-self.log_widths).unsqueeze(-1) * bounded

    @property
    def margins(self) -> Tensor:
        """1 - ρ‖v‖√(2/e), (M,), > 0: the smallest directional derivative of each layer."""
        squared = self.strengths.square().sum(-1)
        root = (1 + squared).sqrt()
        return 1 / (root * (root + squared.sqrt()))

    @torch.no_grad()
    def assign(self, centers: Tensor, directions: Tensor, widths: Tensor) -> None:
        """Take given layers; the rest, if fewer than M come, become the identity.

        Args:
            centers: (m, n), m <= M.
            directions: (m, n).
            widths: (m,), > 0.

        Raises:
            ValueError: if a layer breaks the invertibility bound.
        """
        used = len(centers)
        bounded = widths.unsqueeze(-1) * directions / WIDTH_BOUND
        squared = bounded.square().sum(-1, keepdim=True)
        if used > self.n_layers or not bool((squared < 1).all()) or not bool((widths > 0).all()):
            raise ValueError(
                f"layers: expected at most {self.n_layers} with widths > 0 and ρ‖v‖√(2/e) < 1, got {used} "
                f"with largest bound {float(squared.max().sqrt()) if used else 0.0:g}"
            )
        self.centers.zero_()[:used] = centers.to(self.centers)
        self.strengths.zero_()[:used] = (bounded / (1 - squared).sqrt()).to(self.strengths)
        self.log_widths.zero_()[:used] = widths.log().to(self.log_widths)
        self.log_widths[used:] = self.log_widths[:used].mean() if used else 0.0

    def forward(self, x: Tensor) -> Tensor:
        check_points(self.dim, x, "x")
        if translations.can_use_kernel(self, x):
            return translations.forward(self, x)
        for c, v, q in self._layers():
            x = x + torch.exp(-q * (x - c).square().sum(-1, keepdim=True)) * v
        return x

    def inverse(self, y: Tensor) -> Tensor:
        check_points(self.dim, y, "y")
        if translations.can_use_kernel(self, y):
            return translations.inverse(self, y)
        for c, v, q in reversed(self._layers()):
            y = y - _root(y - c, v, q) * v
        return y

    def linearize(self, y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        check_points(self.dim, y, "y")
        if translations.can_use_kernel(self, y):
            return translations.linearize(self, y)
        steps = []
        for c, v, q in reversed(self._layers()):
            k = _root(y - c, v, q)
            y = y - k * v
            steps.append((-2 * q * k * (y - c), v))

        def push(tangent: Tensor) -> Tensor:
            for gradient, v in reversed(steps):
                tangent = tangent + (gradient * tangent).sum(-1, keepdim=True) * v
            return tangent

        return y, push

    def jacobian(self, x: Tensor) -> Tensor:
        check_points(self.dim, x, "x")
        if translations.can_use_kernel(self, x):
            return translations.jacobian(self, x)
        columns = torch.eye(self.dim, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], self.dim, self.dim)
        for c, v, q in self._layers():
            w = x - c
            k = torch.exp(-q * w.square().sum(-1, keepdim=True))
            x = x + k * v
            row = ((-2 * q * k * w).unsqueeze(-2) @ columns).squeeze(-2)
            columns = columns + v.unsqueeze(-1) * row.unsqueeze(-2)
        return columns

    def log_abs_det_jacobian(self, x: Tensor) -> Tensor:
        check_points(self.dim, x, "x")
        total = torch.zeros_like(x[..., 0])
        for c, v, q in self._layers():
            w = x - c
            k = torch.exp(-q * w.square().sum(-1, keepdim=True))
            total = total + torch.log1p((-2 * q * k * w * v).sum(-1))  # matrix determinant lemma
            x = x + k * v
        return total

    def _layers(self) -> list[tuple[Tensor, Tensor, Tensor]]:
        """(c, v, ρ²) of every layer, first to last."""
        squares = torch.exp(2 * self.log_widths)
        return list(zip(self.centers.unbind(), self.directions.unbind(), squares.unbind(), strict=True))


def _root(w: Tensor, v: Tensor, q: Tensor) -> Tensor:
    """The one s in [0, 1] with s = exp(-q ‖w - s v‖²), over (..., n) -> (..., 1); differentiable twice.

    Newton's method alone fails on 3-4 % of hard layers; kept inside a shrinking bracket it never did. The root is
    found without a graph; two free Newton steps from it then carry derivatives up to third order.
    """
    a = q * v.square().sum(-1, keepdim=True)
    b = q * (w * v).sum(-1, keepdim=True)
    c = q * w.square().sum(-1, keepdim=True)
    with torch.no_grad():
        s = _bracketed_root(a.detach(), b.detach(), c.detach())
    if torch.is_grad_enabled():
        for _ in range(2):
            k = torch.exp(-((a * s - 2 * b) * s + c).clamp(min=0))
            s = s - (s - k) / (1 - 2 * (b - a * s) * k)
    return s


def _bracketed_root(a: Tensor, b: Tensor, c: Tensor, max_steps: int = 64) -> Tensor:
    low, high = torch.zeros_like(c), torch.ones_like(c)
    s = torch.exp(-c)
    tolerance = 4 * torch.finfo(c.dtype).eps
    for _ in range(max_steps):
        k = torch.exp(-((a * s - 2 * b) * s + c).clamp(min=0))
        gap = s - k
        low, high = torch.where(gap < 0, s, low), torch.where(gap > 0, s, high)
        new = s - gap / (1 - 2 * (b - a * s) * k)
        new = torch.where((new >= low) & (new <= high), new, (low + high) / 2)
        moved, s = (new - s).abs(), new
        if _everywhere((moved <= tolerance * s) | ~(moved > 0)):
            break
    return s


def _everywhere(done: Tensor) -> bool:
    """Whether a loop may end early; never under vmap or export, where no value can be read."""
    if torch.compiler.is_compiling():
        return False
    try:
        return bool(done.all())
    except RuntimeError:
        return False


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
    _order: Tensor

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
        self.register_buffer("_order", torch.cat(parts).argsort(), persistent=False)

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
        """As declared; the map also takes a stack of tangents at once, (..., *y.shape)."""
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
            for source, shrink, slope in reversed(steps):
                sheared = (slope * parts[source].unsqueeze(-2)).sum(-1)
                parts[1 - source] = (parts[1 - source] - sheared) * shrink
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

    def normalize(self, y: Tensor) -> Tensor:
        """(y - center) / scale: (..., n) -> (..., n)."""
        check_points(self.dim, y, "y")
        return (y - self.center) / self.scale

    def _couplings(self) -> list[tuple[int, _Coupling]]:
        """Every layer with the part that it reads: 0, the even coordinates, or 1."""
        return [(j % 2, cast("_Coupling", layer)) for j, layer in enumerate(self.layers)]

    def _join(self, parts: list[Tensor]) -> Tensor:
        return torch.cat(parts, -1)[..., self._order]


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
        cosines = torch.cos(self._angles(p))
        half = cosines.shape[-1] // 2
        return cosines[..., :half] @ self.amplitudes[0].mT, cosines[..., half:] @ self.amplitudes[1].mT

    def with_slopes(self, p: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """s, t and ds/dp, dt/dp: (..., a) -> (..., b), (..., b), (..., b, a), (..., b, a)."""
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
