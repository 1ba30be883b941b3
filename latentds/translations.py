"""Locally weighted translations: their parameters, and what one layer does to points and tangents in torch."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from .arguments import Array, check_points, whole_number
from .diffeomorphism import Diffeomorphism, Invertibility, eager_for_derivatives
from .kernels import private, translations
from .kernels.dispatch import is_plain, no_active_transforms
from .kernels.functions import Operation, TorchLayers, evaluate
from .resizing import make_room, resize

WIDTH_BOUND = math.sqrt(math.e / 2)
"""A layer x + exp(-ρ²‖x-c‖²) v is invertible while ρ‖v‖ < √(e/2) (Perrin and Schlehuber-Caissier 2016)."""


def directions_of(strengths: Any, widths: Any, mu: float = 1.0) -> Any:
    """v = μ√(e/2)/ρ · a/√(1+‖a‖²), so that ρ‖v‖√(2/e) < μ for every a: arrays or tensors (M, n), (M,) -> (M, n)."""
    root = (1 + (strengths**2).sum(-1)[..., None]) ** 0.5
    return mu * WIDTH_BOUND * strengths / root / widths[..., None]


def strengths_of(directions: Any, widths: Any, mu: float = 1.0) -> Any:
    """The inverse of :func:`directions_of` in a, for directions within the bound."""
    bounded = widths[..., None] * directions / (mu * WIDTH_BOUND)
    return bounded / (1 - (bounded**2).sum(-1)[..., None]) ** 0.5


class Layers(NamedTuple):
    """Locally weighted translations x + exp(-ρ²‖x-c‖²) v, first to last."""

    centers: Array
    """(m, n)"""
    directions: Array
    """(m, n)"""
    widths: Array
    """(m,) ρ > 0"""


class LocallyWeightedTranslations(Diffeomorphism):
    """ψ = ψ_M ∘ … ∘ ψ_1 with layers ψ_j(x) = x + exp(-ρ_j² ‖x - c_j‖²) v_j (paper, Sec. VI; Perrin 2016, eq. 5).

    The bound that keeps every layer invertible, ρ_j ‖v_j‖ √(2/e) < 1, holds by parametrisation: with a_j free,
    v_j = √(e/2)/ρ_j · a_j/√(1+‖a_j‖²). So any optimiser may train the module. a = 0 is the identity.

    Args:
        dim: n >= 1.
        n_layers: M >= 1.
        any_number: whether M becomes the number of layers that are assigned or loaded.

    Attributes:
        centers: c, (M, n) parameter.
        log_widths: log ρ, (M,) parameter.
        strengths: a, (M, n) parameter.
    """

    def __init__(self, dim: int, n_layers: int, *, any_number: bool = False) -> None:
        super().__init__()
        self.dim = whole_number(dim, "dim", at_least=1)
        self.any_number = any_number
        count = whole_number(n_layers, "n_layers", at_least=1)
        self.centers = nn.Parameter(torch.zeros(count, dim, dtype=torch.float64))
        self.log_widths = nn.Parameter(torch.zeros(count, dtype=torch.float64))
        self.strengths = nn.Parameter(torch.zeros(count, dim, dtype=torch.float64))

    def extra_repr(self) -> str:
        return f"dim={self.dim}, n_layers={self.n_layers}"

    @property
    def n_layers(self) -> int:
        """M"""
        return len(self.centers)

    @property
    def widths(self) -> Tensor:
        """ρ, (M,), per unit length."""
        return self.log_widths.exp()

    @property
    def directions(self) -> Tensor:
        """v, (M, n), in units of length."""
        directions: Tensor = directions_of(self.strengths, self.widths)
        return directions

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
            centers: (m, n), m <= M unless any number is taken.
            directions: (m, n).
            widths: (m,), > 0.

        Raises:
            ValueError: if a layer breaks the invertibility bound.
        """
        used = len(centers)
        if self.any_number:
            for parameter in (self.centers, self.log_widths, self.strengths):
                resize(parameter, max(1, used))
        squared = (widths.unsqueeze(-1) * directions / WIDTH_BOUND).square().sum(-1)
        if used > self.n_layers or not bool((squared < 1).all()) or not bool((widths > 0).all()):
            raise ValueError(
                f"layers: expected at most {self.n_layers} with widths > 0 and ρ‖v‖√(2/e) < 1, got {used} "
                f"with largest bound {float(squared.max().sqrt()) if used else 0.0:g}"
            )
        self.centers.zero_()[:used] = centers.to(self.centers)
        self.strengths.zero_()[:used] = strengths_of(directions, widths).to(self.strengths)
        self.log_widths.zero_()[:used] = widths.log().to(self.log_widths)
        self.log_widths[used:] = self.log_widths[:used].mean() if used else 0.0

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        if self.any_number:
            make_room(self, state_dict, prefix, translations.PARAMETERS)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    @eager_for_derivatives
    def forward(self, x: Tensor) -> Tensor:
        check_points(self.dim, x, "x")
        return self._evaluated(_FORWARD, x)

    @eager_for_derivatives
    def inverse(self, y: Tensor) -> Tensor:
        check_points(self.dim, y, "y")
        return self._evaluated(_INVERSE, y)

    @eager_for_derivatives
    def linearize(self, y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        check_points(self.dim, y, "y")
        held = self._for_kernels(y)
        if held is None:
            x = self.inverse(y)
            return x, functools.partial(self._pushed, x)
        packed, parameters = held
        x = evaluate(_INVERSE, packed, parameters, y)

        def push(tangent: Tensor) -> Tensor:
            if not (no_active_transforms() and is_plain(tangent, x.dtype)):
                return (self.jacobian(x) @ tangent.unsqueeze(-1)).squeeze(-1)
            points, tangents = torch.broadcast_tensors(x, tangent)  # type: ignore[no-untyped-call]
            return evaluate(_PUSH, packed, parameters, points, tangents)

        return x, push

    @eager_for_derivatives
    def _pushed(self, x: Tensor, tangent: Tensor) -> Tensor:
        points, tangents = torch.broadcast_tensors(x, tangent)  # type: ignore[no-untyped-call]
        return _through(_push, self._stacked(), points, tangents.unsqueeze(-2))[1].squeeze(-2)

    @eager_for_derivatives
    def jacobian(self, x: Tensor) -> Tensor:
        check_points(self.dim, x, "x")
        return self._evaluated(_JACOBIAN, x)

    @eager_for_derivatives
    def log_abs_det_jacobian(self, x: Tensor) -> Tensor:
        check_points(self.dim, x, "x")
        return _through(_step_with_log_det, self._stacked(), x, torch.zeros_like(x[..., 0]))[1]

    @torch.no_grad()
    def invertibility(self) -> Invertibility:
        bound = self.widths * torch.linalg.vector_norm(self.directions, dim=-1) / WIDTH_BOUND
        margins = torch.nan_to_num(torch.minimum(self.margins, 1 - bound + 1e-12), nan=-math.inf)
        margins = torch.where(torch.isfinite(self.centers).all(-1), margins, -math.inf)
        worst = int(margins.argmin())
        fold = None if margins[worst] > 0 else self._fold(worst)
        claim, detail = "every layer is invertible, ρ‖v‖√(2/e) < 1", "smallest margin"
        return Invertibility(claim, len(margins), float(margins[worst]), detail, fold)

    @torch.no_grad()
    def inverse_box(self, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        # Each layer moves a point by a share of its v between 0 and 1.
        v = self.directions
        return low - v.clamp(min=0).sum(0), high - v.clamp(max=0).sum(0)

    def table(self) -> Array:
        parameters = self.centers, self.log_widths, self.strengths
        return translations.packed([parameter.to("cpu", torch.float64) for parameter in parameters])

    def _fold(self, index: int) -> tuple[float, ...]:
        """Where a layer that breaks its bound folds space most."""
        layers = list(zip(*self._stacked(), strict=True))[index:]
        c, v, q = layers[0]
        y = c + v / torch.linalg.vector_norm(v) / (2 * q).sqrt()
        for layer in layers:
            (y,) = _translate(*layer, y)
        return tuple(y.tolist())

    def _stacked(self) -> tuple[Tensor, Tensor, Tensor]:
        """(c, v, ρ²) of all layers."""
        return self.centers, self.directions, torch.exp(2 * self.log_widths).unsqueeze(-1)

    def _for_kernels(self, points: Tensor) -> tuple[Array, list[Tensor]] | None:
        """The layers as the kernels read them, and the parameters that they are made of; None where torch is to do it.

        Kernels skip layers that are far from a point. One of NaN is far from none, and would be left out in silence.
        """
        if not translations.can_use_kernel(self, points):
            return None
        parameters: Any = private.held_tensors(self, translations.PARAMETERS)
        packed = translations.packed(parameters)
        return (packed, parameters) if math.isfinite(packed.sum()) else None

    def _evaluated(self, operation: Operation, points: Tensor) -> Tensor:
        held = self._for_kernels(points)
        return operation.by_torch(self._stacked(), points) if held is None else evaluate(operation, *held, points)


def _layers_of(centers: Tensor, log_widths: Tensor, strengths: Tensor) -> TorchLayers:
    """As ``LocallyWeightedTranslations._stacked``, of parameters that stand for its own."""
    return centers, directions_of(strengths, log_widths.exp()), torch.exp(2 * log_widths).unsqueeze(-1)


def _forward(layers: TorchLayers, x: Tensor) -> Tensor:
    return _through(_translate, layers, x)[0]


def _inverse(layers: TorchLayers, y: Tensor) -> Tensor:
    return _through(_untranslate, layers, y, reverse=True)[0]


def _jacobian(layers: TorchLayers, x: Tensor) -> Tensor:
    dim = x.shape[-1]
    columns = torch.eye(dim, dtype=x.dtype, device=x.device).expand(*x.shape[:-1], dim, dim)
    return _through(_push, layers, x, columns)[1].mT


def _pushed(layers: TorchLayers, x: Tensor, tangent: Tensor) -> Tensor:
    return (_jacobian(layers, x) @ tangent.unsqueeze(-1)).squeeze(-1)


Step = Callable[..., tuple[Tensor, ...]]
"""What one layer (c, v, ρ²) does to a state: (c, v, ρ², *state) -> state."""


def _translate(c: Tensor, v: Tensor, q: Tensor, x: Tensor) -> tuple[Tensor]:
    return (x + torch.exp(-q * (x - c).square().sum(-1, keepdim=True)) * v,)


def _untranslate(c: Tensor, v: Tensor, q: Tensor, y: Tensor) -> tuple[Tensor]:
    return (y - _root(y - c, v, q) * v,)


def _push(c: Tensor, v: Tensor, q: Tensor, x: Tensor, tangents: Tensor) -> tuple[Tensor, Tensor]:
    """Tangents (..., T, n) at x."""
    w = x - c
    k = torch.exp(-q * w.square().sum(-1, keepdim=True))
    along = (tangents * (-2 * q * k * w).unsqueeze(-2)).sum(-1, keepdim=True)
    return x + k * v, tangents + along * v


def _step_with_log_det(c: Tensor, v: Tensor, q: Tensor, x: Tensor, log_volume: Tensor) -> tuple[Tensor, Tensor]:
    w = x - c
    k = torch.exp(-q * w.square().sum(-1, keepdim=True))
    return x + k * v, log_volume + torch.log1p((-2 * q * k * w * v).sum(-1))  # matrix determinant lemma


def _through(step: Step, layers: TorchLayers, *state: Tensor, reverse: bool = False) -> tuple[Tensor, ...]:
    """``state`` after the step of every layer, first to last or the other way round."""
    if torch.compiler.is_compiling():
        return _loop_in_graph(step, layers, state, reverse)
    each = list(zip(*(part.unbind() for part in layers), strict=True))
    for layer in reversed(each) if reverse else each:
        state = step(*layer, *state)
    return state


def _loop_in_graph(
    step: Step, layers: tuple[Tensor, ...], state: tuple[Tensor, ...], reverse: bool
) -> tuple[Tensor, ...]:
    """The loop over the layers as one node of a graph, whose size so does not grow with their number.

    torch.export records a ``scan``, which is differentiable; torch.compile a ``while_loop``, as its default compiler
    takes a scan under ``fullgraph=True`` alone. On the CPU both compute in float64, as the kernels do.
    """
    scan, while_loop = private.graph_loops()

    def widened(tensor: Tensor) -> Tensor:
        return (tensor.double() if tensor.is_cpu else tensor).contiguous()

    layers, start = tuple(map(widened, layers)), tuple(map(widened, state))
    if torch.compiler.is_exporting():

        def one(state: tuple[Tensor, ...], layer: tuple[Tensor, ...]) -> tuple[tuple[Tensor, ...], Tensor]:
            return step(*layer, *state), layer[-1].clone()  # a scan must also hand out something

        end, _ = scan(one, start, layers, reverse=reverse)
    else:
        count = len(layers[0])
        first, stride = (count - 1, -1) if reverse else (0, 1)

        def unfinished(index: Tensor, *state: Tensor) -> Tensor:
            return ((index >= 0) & (index < count)).squeeze()

        def at(index: Tensor, *state: Tensor) -> tuple[Tensor, ...]:
            layer = (part.index_select(0, index).squeeze(0) for part in layers)
            return index + stride, *step(*layer, *state)

        begin = torch.full((1,), first, device=start[0].device)
        _, *end = while_loop(unfinished, at, (begin, *start))
    return tuple(new.to(old.dtype) for new, old in zip(end, state, strict=True))


ROOT_STEPS = 8
"""Steps after which every root is found; see :func:`_solve`."""


def _root(w: Tensor, v: Tensor, q: Tensor) -> Tensor:
    """The one s in [0, 1] with s = exp(-q ‖w - s v‖²), over (..., n) -> (..., 1); differentiable twice.

    It is computed without a graph; two Newton steps from it, in the graph, carry derivatives up to third order.
    """
    a = q * v.square().sum(-1, keepdim=True)
    b = q * (w * v).sum(-1, keepdim=True)
    c = q * w.square().sum(-1, keepdim=True)
    with torch.no_grad():
        s = _solve(a.detach(), b.detach(), c.detach())
    if torch.is_grad_enabled():
        for _ in range(2):
            k = torch.exp(-((a * s - 2 * b) * s + c).clamp(min=0))
            s = s - (s - k) / (1 - 2 * (b - a * s) * k)
    return s


def _solve(a: Tensor, b: Tensor, c: Tensor) -> Tensor:
    """The root s in [0, 1] of s = k(s) = exp(-(a s² - 2 b s + c)), for a < e/2 and b² <= a c.

    Laguerre's method for cubics, from where k bends over and s - k(s) is flattest: near the invertibility bound it is
    almost a cubic with a triple root there, which slows other methods down. In t = √(2a) (s - b/a) the equation has two
    parameters, t + τ = κ exp(-t²/2) with 0 <= κ < √e, and a scan of them (tests/test_translations.py) finds
    |s - k(s)| within 5 rounding errors after eight steps, up to the bound itself; common layers need four.
    """
    tiny, eps = torch.finfo(a.dtype).tiny, torch.finfo(a.dtype).eps
    s = ((b - (a / 2).sqrt()) / a.clamp(min=tiny)).clamp(0, 1)
    for _ in range(ROOT_STEPS):
        g = b - a * s
        k = torch.exp((s * (g + b) - c).clamp(max=0))
        gap = s - k
        gap = torch.where(gap.abs() <= 2 * eps, 0.0, gap)  # where s - k is flat, rounding errors would carry s away
        if _everywhere(gap == 0):
            break
        p = g * k
        slope = 1 - 2 * p
        spread = (slope * slope - 3 * gap * (a * k - 2 * g * p)).abs().sqrt()
        s = (s - 3 * gap / (slope + 2 * spread).clamp(min=tiny)).clamp(0, 1)
    return torch.where(c > translations.BEYOND, 0.0, s)


def _everywhere(done: Tensor) -> bool:
    """Whether a loop may end early; never under vmap, export or tracing, where no value can be read or is the last."""
    if torch.compiler.is_compiling() or private.tracing_active():
        return False
    try:
        return bool(done.all())
    except RuntimeError:
        return False


_FORWARD = Operation(translations.forward, _forward, _layers_of, translations.forward_gradients)
_INVERSE = Operation(translations.inverse, _inverse, _layers_of, translations.inverse_gradients)
_JACOBIAN = Operation(translations.jacobian, _jacobian, _layers_of, translations.jacobian_gradients)
_PUSH = Operation(translations.push, _pushed, _layers_of, translations.push_gradients)
