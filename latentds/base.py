"""The one interface of every method: a globally asymptotically stable system that is learned and rolled out."""

from __future__ import annotations

import inspect
import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeVar

import torch
from torch import Tensor, nn

from .arguments import check_points, real_tensor, whole_number
from .demonstration import Demonstration
from .diffeomorphism import Diffeomorphism
from .integrate import integrate
from .time_law import LatentDynamics

if TYPE_CHECKING:
    from .controller import Controller

Self = TypeVar("Self", bound="StableDS")


@dataclass(frozen=True)
class FitReport:
    """What a fit reached.

    Attributes:
        mse: mean squared error per coordinate (mean over all N n entries), units squared. Position error of the
            mapped points for matching methods, velocity error for gradient methods; see the method.
        n_layers: layers of the diffeomorphism.
        seconds: wall time of the fit.
        history: loss per epoch, for methods that learn by gradient.
        notes: what the user should know of this fit (early stop, divergence handled, choices made).
        learned_from: name and SHA-256 of each demonstration.
    """

    mse: float
    n_layers: int
    seconds: float
    history: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()
    learned_from: tuple[tuple[str, str], ...] = ()


class StableDS(nn.Module, ABC):
    """A velocity field ẏ = f(y) on R^n, globally asymptotically stable at ``attractor``.

    A new method subclasses this, implements :meth:`fit`, :meth:`forward` and :meth:`lyapunov`, and certifies itself
    with :func:`latentds.testing.check_stable_ds`. An unfitted system is stable too.

    Everything is computed in the module's dtype (float64 unless moved with ``.to``) and returned in the dtype of
    the input. Arrays are accepted where tensors are.

    Args:
        dim: n >= 1.
    """

    attractor: Tensor
    fit_report: FitReport | None

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.dim = whole_number(dim, "dim", at_least=1)
        self.fit_report = None
        self.register_buffer("attractor", torch.zeros(self.dim, dtype=torch.float64))

    @abstractmethod
    def fit(self: Self, demonstration: Demonstration | Sequence[Demonstration], *, progress: bool = False) -> Self:
        """Learn from a demonstration (or several, where the method can); forgets any fit before; returns self."""

    @abstractmethod
    def forward(self, y: Tensor) -> Tensor:
        """Velocity at ``y``: (..., n) -> (..., n), units of y per second."""

    @abstractmethod
    def lyapunov(self, y: Tensor) -> Tensor:
        """V(y) >= 0, zero only at the attractor, decreasing along every motion: (..., n) -> (...)."""

    def rollout(self, y0: Tensor, t: Tensor) -> Tensor:
        """The motion from ``y0`` at times ``t``: (..., n), (T,) seconds, not decreasing -> (..., T, n).

        The state at ``t[0]`` is ``y0``: ``out[..., 0, :] == y0``.

        Unless a method knows its flow in closed form and overrides this, as :class:`LatentDS` does, :meth:`forward` is
        integrated: see :func:`latentds.integrate.integrate` for the tolerance, and for the RuntimeWarning of a motion
        that cannot go on and is NaN from there.
        """
        points, wanted = self._points(y0, "y0")
        return self._begun_at(y0, integrate(self.forward, points, self._times(t), self.attractor).to(wanted))

    def controller(self) -> Controller:
        """The velocity field as it is now for a real-time loop, NumPy in and out: see :class:`Controller`."""
        from .controller import Controller

        return Controller(self)

    @property
    def settings(self) -> dict[str, Any]:
        """The constructor's arguments; each is an attribute of the same name, as it is in scikit-learn."""
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one file that :func:`latentds.load` reads, atomically; see :mod:`latentds.storage`."""
        from .storage import save

        save(self, path)

    def _points(self, y: Any, name: str = "y") -> tuple[Tensor, torch.dtype]:
        """``y`` in the module's dtype, and the dtype in which the caller wants the answer."""
        points = real_tensor(y, name)
        check_points(self.dim, points, name)
        dtype = self.attractor.dtype
        wanted = points.dtype if points.is_floating_point() else dtype
        return (points if points.dtype == dtype else points.to(dtype)), wanted

    def _times(self, t: Any) -> Tensor:
        """``t`` as seconds since its first entry, in the module's dtype."""
        times = real_tensor(t, "t").to(self.attractor.device)
        if times.ndim != 1 or len(times) == 0:
            raise ValueError(f"t: expected shape (T,) with T >= 1, got {tuple(times.shape)}")
        times = times.to(torch.float64)
        if not bool(torch.isfinite(times).all()):
            raise ValueError("t: expected finite seconds, got NaN or inf")
        if bool((times.diff() < 0).any()):
            raise ValueError("t: expected times that do not decrease, got a step back")
        return (times - times[0]).to(self.attractor.dtype)

    @staticmethod
    def _begun_at(y0: Any, path: Tensor) -> Tensor:
        """``path`` (..., T, n) with ``y0`` itself, not what rounding made of it, as its first point."""
        start = torch.as_tensor(y0).to(path.dtype)
        return torch.cat([start.unsqueeze(-2), path[..., 1:, :]], dim=-2)


class LatentDS(StableDS):
    """A stable system made of a diffeomorphism ψ (latent -> demonstration) and latent dynamics.

    f(y) = J_ψ(x) g(x) with x = ψ⁻¹(y) (paper, eq. 4), V(y) = ‖x - x*‖². Methods subclass it and implement ``fit``.

    Args:
        dim: n >= 1.
        diffeomorphism: ψ; the identity until fitted.
        dynamics: g, with its flow.
    """

    def __init__(self, dim: int, diffeomorphism: Diffeomorphism, dynamics: LatentDynamics) -> None:
        super().__init__(dim)
        self.diffeomorphism = diffeomorphism
        self.dynamics = dynamics

    def encode(self, y: Tensor) -> Tensor:
        """ψ⁻¹: demonstration -> latent, (..., n) -> (..., n)."""
        points, wanted = self._points(y)
        return self.diffeomorphism.inverse(points).to(wanted)

    def decode(self, x: Tensor) -> Tensor:
        """ψ: latent -> demonstration, (..., n) -> (..., n)."""
        points, wanted = self._points(x, "x")
        decoded: Tensor = self.diffeomorphism(points)
        return decoded.to(wanted)

    def jacobian(self, x: Tensor) -> Tensor:
        """J_ψ at latent ``x``, in closed form: (..., n) -> (..., n, n)."""
        points, wanted = self._points(x, "x")
        return self.diffeomorphism.jacobian(points).to(wanted)

    def forward(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        x, push = self.diffeomorphism.linearize(points)
        return push(self.dynamics(x, points)).to(wanted)

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        return self.dynamics.lyapunov(self.diffeomorphism.inverse(points)).to(wanted)

    def rollout(self, y0: Tensor, t: Tensor) -> Tensor:
        points, wanted = self._points(y0, "y0")
        times = self._times(t)
        latent = self.dynamics.flow(self.diffeomorphism.inverse(points), times)
        return self._begun_at(y0, self.diffeomorphism(latent).to(wanted))
