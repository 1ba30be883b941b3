"""SDS-EF: stable dynamics from Euclideanizing flows, learned by gradient (Rana et al. 2020)."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from latentds.arguments import Array, refuse_tracing, whole_number
from latentds.base import LatentDS
from latentds.dynamics import Frame
from latentds.kernels.dispatch import can_use_kernel, rows_of, run
from latentds.kernels.functions import Operation, evaluate
from latentds.kernels.private import is_altered

from .coupling_sweeps import LEAK, N_UNITS, speed_kernel
from .coupling_tables import CouplingTables
from .couplings import AffineCouplings, arrays_of, no_autocast
from .flows import FlowDS, FlowDynamics, Normalized, descend_bending, ray_loss, unit_vector, velocity_loss
from .networks import linear, seeded_generator
from .training import Plan, Training, descend

PLANS = {
    "official": Plan(epochs=5000, learning_rate=1e-4, weight_decay=1e-10, clip=0.1, patience=250),
    "tuned": Plan(epochs=710, learning_rate=1e-3, n_batches=4, warm_up=0.05, clip=1.0, slack=0.3),
}
LINEAR_WITHIN = 1e-3
"""Share of the demonstration's latent length below which the speed falls linearly: a unit vector is not Lipschitz."""
EVEN_WITHIN = 1.5
"""Latent lengths from the goal within which a rollout's nodes are ``LINEAR_WITHIN`` apart; farther out sparser."""
TAIL_NODES = 40
"""Nodes of a rollout within the guard, each a factor e nearer to the goal: the last is at 1e-20 of the length."""


class SDSEF(FlowDS):
    """Stable dynamics by Euclideanizing flows: ẏ = -exp(g(y)) J_φ⁻¹ z/‖z‖, z = φ(y) - φ(y*) (Rana et al. 2020).

    φ = ψ⁻¹ is a chain of affine couplings and g a small network; both are learned together from velocities. Learns
    from one demonstration or from several, pooled; their goals' mean is the attractor.

    ``recipe="official"`` minimises the SmoothL1 error of the velocities as the authors' code does. ``"tuned"``, our
    own, minimises the same with a larger rate that rises and falls, in a seventh of the epochs; but from a single
    winding demonstration in space that loss learns shortcuts, so there ``"tuned"`` also asks that the demonstration lie
    on one latent ray, which is where every motion of this system runs.

    Every motion goes straight to x* in latent space, so the system is globally asymptotically stable by construction.
    Differs from the authors' code in that the speed falls linearly within ``LINEAR_WITHIN`` latent lengths of x*, where
    a unit vector jumps, and is held within the range that it had along the demonstrations, so that far motions arrive.

    ``fit_report.mse`` is the mean over all N n entries of the squared velocity error, (units / second)².

    Args:
        dim: n >= 1.
        n_layers: L >= 1, couplings.
        n_features: F >= 1, random Fourier features in each half of a coupling.
        recipe: "tuned" or "official".
        seed: of the frozen features, the initial network and the batches; None draws them from torch's generator.
        epochs: most passes over the samples, >= 1, in place of the recipe's own 5000 (official) or 710 (tuned); None
            keeps those. In space the tuned recipe learns a single demonstration in stages, each of which gets one
            epoch at least.
    """

    diffeomorphism: AffineCouplings
    dynamics: NormalizedDescent

    def __init__(
        self,
        dim: int,
        *,
        n_layers: int = 10,
        n_features: int = 200,
        recipe: str = "tuned",
        seed: int | None = None,
        epochs: int | None = None,
    ) -> None:
        if recipe not in list(PLANS):
            raise ValueError(f"recipe: expected one of {sorted(PLANS)}, got {recipe!r}")
        self_seed = None if seed is None else whole_number(seed, "seed", at_least=0)
        generator = seeded_generator(self_seed)
        psi = AffineCouplings(dim, n_layers, n_features, generator=generator)
        super().__init__(dim, psi, NormalizedDescent(psi, generator=generator))
        self.n_layers, self.n_features = psi.n_layers, psi.n_features
        self.recipe = recipe
        self.seed = self_seed
        self.epochs = None if epochs is None else whole_number(epochs, "epochs", at_least=1)

    def tables(self) -> CouplingTables | None:
        own = type(self).forward is LatentDS.forward and type(self.dynamics) is NormalizedDescent
        known = own and type(self.diffeomorphism) is AffineCouplings and not is_altered(self)
        known = known and self.dynamics.psi is self.diffeomorphism  # of which the speed is read, too
        if not (known and self.diffeomorphism.fits() and self.dynamics.fits()):
            return None
        exact = copy.deepcopy(self).to("cpu", torch.float64)
        frame, dynamics = exact.frame(), exact.dynamics
        latent = np.append(frame.attractor.detach().numpy(), LINEAR_WITHIN * float(frame.length.detach()))
        ends = np.append(dynamics.log_speed_range.numpy(), float(dynamics.duration))
        arrays = arrays_of(exact.diffeomorphism.held())
        return CouplingTables(*arrays, dynamics.weights.detach().numpy(), ends, latent)

    def _train(self, data: Normalized, generator: torch.Generator | None, progress: bool) -> Training:
        plan = PLANS[self.recipe]
        plan = plan if self.epochs is None else replace(plan, epochs=self.epochs)
        if self.recipe == "tuned" and self.dim > 2 and len(data.starts) == 1:
            loss_of = partial(ray_loss, self.diffeomorphism, self._descent)
            return descend_bending(self, loss_of, data, plan, generator, progress)
        loss, count = velocity_loss(self.diffeomorphism, self._descent, data), len(data.points)
        return descend(loss, list(self.parameters()), count, plan, generator=generator, progress=progress)

    def _descent(self, u: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        return unit_vector(z), -self.dynamics.log_speed(u).exp().unsqueeze(-1)


class NormalizedDescent(FlowDynamics):
    """ẋ = -exp(g(y)) z / max(‖z‖, ε), z = x - x*: straight to the goal, at a speed that is a function of y = ψ(x).

    g, a network of 2 x 100 leaky ReLUs over normalised y, is held within the range that it had along the
    demonstration, widened by 1 each way, so that speeds far away stay bounded and above 0. ε is
    ``LINEAR_WITHIN`` lengths.

    Args:
        diffeomorphism: ψ, for :meth:`flow` and for normalising; a reference, not a submodule.
        generator: draws the network's weights (torch's global one if None).

    Attributes:
        weights: parameter, of the network's three maps W (out, in) and b, flat.
        log_speed_range: (2,) buffer.
    """

    log_speed_range: Tensor
    psi: AffineCouplings

    def __init__(self, diffeomorphism: AffineCouplings, *, generator: torch.Generator | None = None) -> None:
        super().__init__()
        object.__setattr__(self, "psi", diffeomorphism)
        maps = [linear(a, b, generator) for a, b in pairwise([diffeomorphism.dim, N_UNITS, N_UNITS, 1])]
        self.weights = nn.Parameter(torch.cat([part.detach().flatten() for one in maps for part in one.parameters()]))
        self.register_buffer("log_speed_range", torch.tensor([-1.0, 1.0], dtype=torch.float64))

    @torch.no_grad()
    def settle(self, points: Tensor, duration: float) -> None:
        super().settle(points, duration)
        log_speeds = self.log_speed(points.to(self.duration))
        self.log_speed_range.copy_(torch.stack([log_speeds.min() - 1, log_speeds.max() + 1]))

    def forward(self, x: Tensor, y: Tensor, frame: Frame) -> Tensor:
        offset = x - frame.attractor
        distance = torch.linalg.vector_norm(offset, dim=-1).clamp(min=LINEAR_WITHIN * frame.length)
        pull: Tensor = self.speed(y) / distance
        return -pull.unsqueeze(-1) * offset

    def fits(self) -> bool:
        """Whether the network is of the size that the constructor gave it: kernels would read beyond it."""
        return self.weights.shape == (N_UNITS * (self.psi.dim + N_UNITS + 3) + 1,)

    def log_speed(self, u: Tensor) -> Tensor:
        """g, not yet held within its range, at normalised points: (..., n) -> (...)."""
        return _log_speed(self.weights, u)

    def speed(self, y: Tensor) -> Tensor:
        """exp(g(y)), latent units per second: (..., n) -> (...)."""
        psi = self.psi
        parameters = self.weights, self.log_speed_range, self.duration, psi.center, psi.scale
        named = can_use_kernel(("weights", "log_speed_range", "duration"), self, y)
        if not (named and can_use_kernel(("center", "scale"), psi, y) and self.fits()):
            return _speed(parameters, y)
        weights, ends, duration, center, scale = (part.detach().numpy().astype(np.float64) for part in parameters)
        packed = weights, np.append(ends, duration), np.stack([center, scale])
        return evaluate(_SPEED, packed, parameters, y)

    def flow(self, x: Tensor, t: Tensor, frame: Frame) -> Tensor:
        """Every motion runs on the ray from x to x*, so only its timing is integrated.

        The ray is sampled evenly in w, a C¹ function of the distance r that is linear along the demonstration,
        log r below the guard and logarithmic far outside. dt/dw is known at the nodes, the times there follow by a
        rule of fourth order, and w at the given times by cubic Hermite interpolation.
        """
        refuse_tracing("this rollout")
        guard = LINEAR_WITHIN * frame.length
        offset = x - frame.attractor
        floor = torch.finfo(x.dtype).tiny ** 0.25
        distance = (offset.square().sum(-1) + (floor * frame.length) ** 2).sqrt()
        begin = _stretch(distance, guard)
        end = begin.detach().clamp(max=0.0) - TAIL_NODES
        spread = (begin.detach() - end).nan_to_num(0.0, 4096).flatten()
        # The demonstrated start spreads over a whole number of cells: rounding down or up there would make it jump.
        n_cells = 1 + int(torch.cat([spread, spread.new_tensor([8.0])]).amax().clamp(max=4096).round())
        step = (begin - end) / n_cells
        nodes = begin.unsqueeze(-1) - step.unsqueeze(-1) * torch.arange(n_cells + 1, dtype=x.dtype, device=x.device)
        radii, growth = _unstretch(nodes, guard)
        direction = (offset / distance.unsqueeze(-1)).unsqueeze(-2)
        path = self.psi(frame.attractor + radii.unsqueeze(-1) * direction)
        speed = self.speed(path) * (radii / guard).clamp(max=1.0)
        slowness = growth / speed * step.unsqueeze(-1)
        stamps = _cumulative(slowness)
        times = t.expand(*stamps.shape[:-1], -1).clamp(max=stamps[..., -1:])
        cell = torch.searchsorted(stamps.detach(), times.detach().contiguous(), right=True).clamp(1, n_cells) - 1
        here, there = stamps.gather(-1, cell), stamps.gather(-1, cell + 1)
        first, last = slowness.gather(-1, cell), slowness.gather(-1, cell + 1)
        along = cell + _hermite((times - here) / (there - here), (there - here) / first, (there - here) / last)
        later, _ = _unstretch(begin.unsqueeze(-1) - step.unsqueeze(-1) * along, guard)
        states: Tensor = frame.attractor + later.unsqueeze(-1) * direction
        return states

    def convergence_rate_bound(self, radius: float, frame: Frame) -> float:
        finite = all(bool(torch.isfinite(part).all()) for part in self.state_dict().values())
        if not (finite and self.duration > 0 and frame.length > 0):
            return -math.inf
        slowest = float(torch.exp(self.log_speed_range.min()) / self.duration)
        return slowest / max(radius, LINEAR_WITHIN * float(frame.length))

    def _load_from_state_dict(self, state_dict: dict[str, Tensor], prefix: str, *rest: Any) -> None:
        """Refuse numbers that no such dynamics can have: those of a file, say."""
        duration, ends = (state_dict.get(prefix + name) for name in ("duration", "log_speed_range"))
        if duration is not None and not bool((duration > 0).all()):
            rest[-1].append(f"duration: expected a number > 0, got {duration.tolist()}")
        elif ends is not None and not bool((ends.diff() >= 0).all()):
            rest[-1].append(f"log_speed_range: expected its lower end first, got {ends.tolist()}")
        else:
            super()._load_from_state_dict(state_dict, prefix, *rest)


Parameters = Sequence[Tensor]
"""Weights, range of the log-speed, duration; center and scale of the normalisation."""


def _log_speed(weights: Tensor, u: Tensor) -> Tensor:
    dim = u.shape[-1]
    shapes = [(N_UNITS, dim), (N_UNITS,), (N_UNITS, N_UNITS), (N_UNITS,), (1, N_UNITS), (1,)]
    parts = torch.split(weights, [math.prod(shape) for shape in shapes])
    W1, b1, W2, b2, W3, b3 = (part.view(shape) for part, shape in zip(parts, shapes, strict=True))
    with no_autocast(u):
        hidden = nn.functional.leaky_relu(u @ W1.mT + b1, LEAK)
        return (nn.functional.leaky_relu(hidden @ W2.mT + b2, LEAK) @ W3.mT + b3).squeeze(-1)


def _speed(parameters: Parameters, y: Tensor) -> Tensor:
    weights, ends, duration, center, scale = parameters
    return _log_speed(weights, (y - center) / scale).clamp(*ends).exp() / duration


def _speed_by_kernel(packed: tuple[Array, Array, Array], y: Tensor) -> Tensor:
    weights, ends, box = packed
    points = rows_of(y)
    out = np.empty(len(points))
    run(lambda weights, *rows: speed_kernel()(box, weights, ends, *rows), weights, points, out)
    return torch.from_numpy(out).to(y.dtype).reshape(y.shape[:-1])


_SPEED = Operation(_speed_by_kernel, _speed)


def _stretch(r: Tensor, guard: Tensor) -> Tensor:
    """w(r): log(r/ε) below the guard ε, r/ε - 1 up to EVEN_WITHIN lengths, then like a logarithm."""
    unit = r / guard
    edge = EVEN_WITHIN / LINEAR_WITHIN
    beyond = torch.asinh((unit - edge).clamp(min=0) / 100) * 100
    return torch.log(unit.clamp(max=1.0)) + unit.clamp(1.0, edge) - 1 + beyond


def _unstretch(w: Tensor, guard: Tensor) -> tuple[Tensor, Tensor]:
    """r(w) and dr/dw."""
    edge = EVEN_WITHIN / LINEAR_WITHIN - 1
    tail = torch.exp(w.clamp(max=0.0))
    beyond = (w - edge).clamp(min=0) / 100
    return guard * (tail + w.clamp(0.0, edge) + 100 * torch.sinh(beyond)), guard * tail * torch.cosh(beyond)


def _cumulative(f: Tensor) -> Tensor:
    """Integrals from the first node to each, (..., K + 1) with unit spacing, of fourth order, K >= 3."""
    inner = (13 * (f[..., 1:-2] + f[..., 2:-1]) - f[..., :-3] - f[..., 3:]) / 24
    first = (9 * f[..., 0] + 19 * f[..., 1] - 5 * f[..., 2] + f[..., 3]) / 24
    last = (9 * f[..., -1] + 19 * f[..., -2] - 5 * f[..., -3] + f[..., -4]) / 24
    cells = torch.cat([first.unsqueeze(-1), inner, last.unsqueeze(-1)], -1)
    return torch.cat([torch.zeros_like(cells[..., :1]), cells.clamp(min=0).cumsum(-1)], -1)


def _hermite(s: Tensor, left: Tensor, right: Tensor) -> Tensor:
    """From 0 to 1 over s in [0, 1], with slopes ``left`` at 0 and ``right`` at 1."""
    return s * (left + s * (3 - 2 * left - right + s * (left + right - 2)))
