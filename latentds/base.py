"""The one interface of every method: a globally asymptotically stable system that is learned and rolled out.

One file, though long: every system makes moved ones of itself, and a moved one is a system.
"""

from __future__ import annotations

import copy
import hashlib
import inspect
import json
import math
import os
import time
import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from typing import Any, ClassVar, TypeVar, final

import torch
from torch import Tensor, nn

from .arguments import check_points, check_precision, positive, real_tensor, whole_number
from .demonstration import Demonstration, demonstrations_of
from .deploy.controller import Controller
from .deploy.one_point import OnePoint
from .deploy.tables import Compiled, FieldTables, field_tables
from .diffeomorphism import Diffeomorphism, eager_for_derivatives
from .dynamics import Frame, LatentDynamics
from .fidelity import (
    COMMAND_LIMIT,
    EXCERPT_POINTS,
    ROUNDING_LIMIT,
    Excerpt,
    Fidelity,
    FitWarning,
    largest_speed,
    measure,
)
from .files import write_tensors
from .findings import every_finding
from .integrate import integrate
from .kernels.dispatch import no_active_transforms
from .kernels.private import is_altered, structure_of, tensors_of
from .memo import Memo
from .probes import restart_gap, round_trip_gap
from .similarity import Similarity, check_rotation, turned_onto

FORMAT = 5
"""Of the files of systems; raised when they change so that another latentds would misread them."""

Self = TypeVar("Self", bound="StableDS")
T = TypeVar("T")


@dataclass(frozen=True)
class FitReport:
    """What a fit reached.

    Attributes:
        mse: mean squared error per coordinate (mean over all N n entries), units squared. Position error of the
            mapped points for matching methods, velocity error for gradient methods; see the method.
        n_layers: layers of the diffeomorphism.
        seconds: wall time of the fit.
        history: loss per epoch, for methods that learn by gradient.
        notes: what the user should know of this fit (early stop, divergence handled, choices made, what in the
            demonstration would hurt it, what does not follow it).
        learned_from: name and SHA-256 of each demonstration.
        fidelity: how the fitted system follows what it was shown; None if a motion of it raised an error.
        columns: names of the coordinates, from the demonstrations; () if they have none.
        state: SHA-256 of the system's state after the fit, to the precision of float32.
    """

    mse: float
    n_layers: int
    seconds: float
    history: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()
    learned_from: tuple[tuple[str, str], ...] = ()
    fidelity: Fidelity | None = None
    columns: tuple[str, ...] = ()
    state: str = ""

    def __str__(self) -> str:
        """A page to read: what was learned from what, whether it follows, each figure beside its limit, the notes."""
        names = ", ".join(name for name, _ in self.learned_from[:3])
        more = f" and {len(self.learned_from) - 3} more" if len(self.learned_from) > 3 else ""
        layers = f"{self.n_layers} layers, " if self.n_layers else ""
        learned = f"learned from {names or 'nothing that it keeps'}{more}: {layers}{self.seconds:.1f} s"
        lines = [f"{learned}, mean squared error per coordinate {self.mse:.2e}"]
        if self.fidelity is not None:
            follows = "It follows" if self.fidelity.follows else "It does NOT follow"
            lines += [f"{follows} what it was shown.", str(self.fidelity)]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


@dataclass(frozen=True)
class Learned:
    """What a method tells of its learning; :meth:`StableDS.fit` makes the report of it.

    Attributes:
        mse, n_layers, history, notes: see :class:`FitReport`.
        details: the further fields of the method's own ``report_type``.
    """

    mse: float
    n_layers: int = 0
    history: tuple[float, ...] = ()
    notes: tuple[str, ...] = ()
    details: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Python's own numbers of NumPy's or torch's: a report is kept in files."""
        for name, value in {
            "mse": float(self.mse),
            "n_layers": int(self.n_layers),
            "history": tuple(map(float, self.history)),
            "notes": tuple(map(str, self.notes)),
        }.items():
            object.__setattr__(self, name, value)


class StableDS(nn.Module, ABC):
    """A velocity field ẏ = f(y) on R^n, globally asymptotically stable at ``attractor``.

    A new method subclasses this, implements :meth:`_learn`, :meth:`forward` and :meth:`lyapunov`, and certifies itself
    with :func:`latentds.testing.check_stable_ds`. An unfitted system is stable too.

    :meth:`fit` is the same for every method and cannot be overridden. After learning it holds motions of the system
    against the demonstration (:mod:`latentds.fidelity`): the figures are in ``fit_report.fidelity``; what is off is in
    ``fit_report.notes`` and in a :class:`~latentds.FitWarning`.

    Everything is computed in the module's dtype (float64 unless moved with ``.to``; float32 is the narrowest) and
    returned in the dtype of the input. Arrays are accepted where tensors are.

    Args:
        dim: n >= 1.

    Attributes:
        attractor: y*, (n,) buffer, where all motions end. Assigned to or written in place, motions end there, and what
            was learned no longer fits: :meth:`with_goal` gives the system that moves as a whole.
    """

    report_type: ClassVar[type[FitReport]] = FitReport
    """The class of ``fit_report``; a method that tells more than every method does names its own."""
    attractor: Tensor
    _fit_report: FitReport | None

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.dim = whole_number(dim, "dim", at_least=1)
        self._fit_report = None
        self.register_buffer("attractor", torch.zeros(self.dim, dtype=torch.float64))

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if cls.fit is not StableDS.fit:
            raise TypeError(
                f"{cls.__name__}: expected a method that writes _learn(shown, progress), got one that overrides fit, "
                "which checks, measures, reports and restores for every method"
            )

    @property
    def fit_report(self) -> FitReport | None:
        """What the last fit reached; None before one. A ``fit`` sets it last, once the parameters are found."""
        return self._fit_report

    @fit_report.setter
    def fit_report(self, report: FitReport | None) -> None:
        if report is not None and not report.state:
            report = replace(report, state=self._fingerprint())
        self._fit_report = report

    @property
    def fit_report_is_current(self) -> bool:
        """Whether ``fit_report`` tells of this system as it is: fitted, and neither trained nor edited since."""
        return self.fit_report is not None and self.fit_report.state == self._fingerprint()

    @final
    def fit(self: Self, demonstration: Demonstration | Sequence[Demonstration], *, progress: bool = False) -> Self:
        """Learn from a demonstration, or from several where the method can; forgets any fit before.

        A fit is whole or did not happen: where it raises, and where it is interrupted, parameters, buffers, submodules,
        attributes and report are what they were.

        Args:
            demonstration: of dimension ``dim``.
            progress: show a bar, where the method takes long.

        Returns:
            self.

        Raises:
            ValueError: if this is no demonstration that the method can learn from.

        Warns:
            FitWarning: if the system does not follow what it was shown, or may not follow a coordinate of another unit,
                or if something in what was shown (:mod:`latentds.findings`) would hurt a robot that follows it.
        """
        shown = demonstrations_of(demonstration, self.dim)
        with _restored_on_failure(self):
            report = self._learn_and_measure(shown, bool(progress))
            off = report.notes[-1:] if report.fidelity is None else report.fidelity.notes
            follows = report.fidelity is not None and report.fidelity.follows
            found, learned = every_finding(shown), report.notes[: len(report.notes) - len(off)]
            new = tuple(one.text for one in found if not any(note in one.text for note in learned))
            self.fit_report = replace(report, notes=(*learned, *new, *off))
            off = (*off, *(one.text for one in found if one.certain or not follows))
            if off:
                verdict = "follows what it was shown, but" if follows else "does not follow what it was shown:"
                warnings.warn(f"{type(self).__name__} {verdict} {'; '.join(off)}", FitWarning, stacklevel=2)
        return self

    @abstractmethod
    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        """Change parameters and buffers, the attractor among them, so that this system moves as it is shown.

        The method's own part of :meth:`fit`, which checks, measures, reports, and restores where this raises.

        Args:
            shown: at least one demonstration, all of dimension ``dim``; not to be changed.
            progress: whether to show a bar.
        """

    def _learn_and_measure(self, shown: Sequence[Demonstration], progress: bool) -> FitReport:
        began = time.perf_counter()
        # As outside of every mode that the caller is in, but for a system that was made for inference alone.
        for_inference = any(tensor.is_inference() for tensor in (*self.parameters(), *self.buffers()))
        with torch.inference_mode(for_inference), torch.set_grad_enabled(not for_inference):
            learned = self._learn(shown, progress)
        if not isinstance(learned, Learned):
            raise TypeError(f"{type(self).__name__}: expected _learn to return a Learned, got {type(learned).__name__}")
        report = self.report_type(
            mse=learned.mse,
            n_layers=learned.n_layers,
            seconds=time.perf_counter() - began,
            history=learned.history,
            notes=learned.notes,
            learned_from=tuple(one.fingerprint for one in shown),
            columns=next((one.columns for one in shown if one.columns), ()),
            **learned.details,
        )
        try:
            fidelity = measure(self, Excerpt.of_each(shown))
        except ROLLOUT_ERRORS as error:
            return replace(report, notes=(*report.notes, f"could not be measured, {type(error).__name__}: {error}"))
        return replace(report, fidelity=fidelity, notes=report.notes + fidelity.notes)

    @abstractmethod
    def forward(self, y: Tensor) -> Tensor:
        """Velocity at ``y``: (..., n) -> (..., n), units of y per second."""

    def straight_velocity(self, y: Tensor) -> Tensor:
        """ẏ of the straight latent motions through ``y``, which nothing draws to a path: (..., n) -> (..., n).

        Of a system without latent space, and of one whose latent motions are straight, its own velocity.
        """
        velocity: Tensor = self(y)
        return velocity

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
        return self._with_exact_start(y0, integrate(self.forward, points, self._times(t), self.attractor).to(wanted))

    def controller(self, *, max_speed: float = math.inf) -> Controller:
        """The velocity field as it is now for a real-time loop, NumPy in and out: see :class:`Controller`."""
        return Controller(self, max_speed=max_speed)

    def with_goal(self, goal: Any) -> MovedDS:
        """The same motion to another goal, shifted as a whole: its start has moved, too.

        Args:
            goal: (n,) finite. A gradient of what the new system computes reaches it.

        Warns:
            UserWarning: if a robot that stands where it was shown to begin would lunge, with the figure. Not where a
                gradient or a transform passes. What keeps the start is :meth:`with_start_and_goal`.
        """
        moved, shown = self._moved(_vector(goal, self.attractor, "goal")), self.excerpts()
        if shown and no_active_transforms() and not moved.attractor.requires_grad:
            begin = torch.tensor([one.path[0] for one in shown], dtype=torch.float64).to(self.attractor)
            with torch.no_grad():
                command = largest_speed(moved, begin) / max(one.fastest for one in shown)
            if not command <= COMMAND_LIMIT:
                warnings.warn(
                    f"with_goal: from where it was shown to begin, the first command is now {command:.3g} times the "
                    "largest speed shown, as the start has moved with the goal; with_start_and_goal(start, goal) "
                    "keeps it, controller(max_speed=) and Controller.approach hold back",
                    stacklevel=2,
                )
        return moved

    def with_start_and_goal(self, start: Any, goal: Any) -> MovedDS:
        """The same motion between another start and goal: turned the shortest way, scaled and shifted, its shape kept.

        It is what is meant if the object has moved and the robot has not. Its duration stays, so that speeds grow with
        its length. Turning mixes the coordinates, which should have one unit.

        Args:
            start: (n,) finite, where the shown start, of several the mean, comes to lie.
            goal: (n,) finite, another point. A gradient of what the new system computes reaches both.

        Raises:
            ValueError: if the system keeps no demonstration, if start and goal are one point, or if their way is the
                opposite of the shown one in 3 or more dimensions, where no turn is the shortest.

        Warns:
            UserWarning: if the motion becomes more than ``COMMAND_LIMIT`` times as fast, with the figure. Not where a
                gradient or a transform passes.
        """
        shown = self.excerpts()
        if not shown:
            raise ValueError("ds: expected a system that keeps what it was shown, got one that was not fitted")
        begin, end = _vector(start, self.attractor, "start"), _vector(goal, self.attractor, "goal")
        begun = torch.tensor([one.path[0] for one in shown], dtype=torch.float64).mean(0).to(self.attractor)
        rotation, scale = turned_onto(self.attractor - begun, end - begin)
        if no_active_transforms() and not scale.requires_grad and not float(scale) <= COMMAND_LIMIT:
            warnings.warn(
                f"with_start_and_goal: the motion is now {float(scale):.3g} times as long in the same time, and as "
                "fast: slowed(factor) gives it more, controller(max_speed=) holds back",
                stacklevel=2,
            )
        return self._moved(end, rotation=rotation, scale=scale)

    def transformed(self, *, rotation: Any = None, translation: Any = None, scale: float = 1.0) -> MovedDS:
        """The same motion under y ↦ s R y + t, about the origin.

        Args:
            rotation: R, (n, n) orthogonal (a reflection is one, too); None leaves directions as they are.
            translation: t, (n,) finite; None is 0. A gradient of what the new system computes reaches it.
            scale: s > 0.
        """
        turn = torch.eye(self.dim) if rotation is None else check_rotation(rotation, self.dim)
        turn = turn.to(self.attractor)
        factor = positive(scale, "scale")
        goal = factor * (turn * self.attractor).sum(-1)
        if translation is not None:
            goal = goal + _vector(translation, self.attractor, "translation")
        return self._moved(goal, rotation=turn, scale=factor)

    def slowed(self, factor: float) -> MovedDS:
        """The same motion in ``factor`` > 0 times its duration; below 1 it is faster."""
        return self._moved(self.attractor, speed=1 / positive(factor, "factor"))

    def _moved(self, attractor: Tensor, **change: Any) -> MovedDS:
        moved = MovedDS(self)
        moved.register_buffer("attractor", attractor.clone())
        for name, value in change.items():
            moved.similarity.register_buffer(name, torch.as_tensor(value).to(attractor))
        return moved

    def excerpts(self) -> tuple[Excerpt, ...]:
        """What the report of its fit keeps of the demonstrations, as this system is to follow them; () if nothing."""
        report = self.fit_report
        fidelity = report.fidelity if isinstance(report, FitReport) else None
        return () if fidelity is None else fidelity.shown

    def surroundings(self, ball: Tensor) -> Tensor | None:
        """Where the system's own space says that the motion was shown: points (m, n) for those of a unit ball, of which
        0 is the attractor and the start lies at distance 1. None for a system without such a space."""
        return None

    def tables(self) -> Compiled | None:
        """The velocity field as plain arrays, for controllers and exporters; None where it cannot be written so."""
        return None

    def latent_error(self, y0: Tensor, t: Tensor) -> Tensor | None:
        """What rounding does to the map of a latent system, see :class:`LatentDS`; None for any other."""
        return None

    @property
    def settings(self) -> dict[str, Any]:
        """The constructor's arguments; each is an attribute of the same name, as it is in scikit-learn."""
        return {name: getattr(self, name) for name in inspect.signature(type(self)).parameters}

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the system, its :attr:`settings` and its ``fit_report`` to one file that :func:`latentds.load` reads.

        Atomic: the file is there whole or not at all.

        Raises:
            ValueError: if the system holds NaN or inf, if a setting is no number, string, boolean, None or system, if
                the report is not of ``report_type``, or if something other than a regular file is at ``path``.
        """
        header, report = {"format": FORMAT} | _class_and_settings(self), self.fit_report
        for name, tensor in self.state_dict().items():
            if not bool(torch.isfinite(tensor).all()):
                raise ValueError(f"ds: expected finite numbers, got NaN or inf in {name}")
        if report is not None and type(report) is not self.report_type:
            raise ValueError(
                f"ds: expected a fit_report of report_type {self.report_type.__name__}, got {type(report).__name__}"
            )
        try:
            about = json.dumps(header | {"report": None if report is None else asdict(report)})
        except TypeError as error:
            raise ValueError(f"ds: expected a fit_report of numbers, strings and tuples, got {error}") from None
        write_tensors(path, self.state_dict(), about)

    def __setattr__(self, name: str, value: Any) -> None:
        held = self.__dict__.get("_buffers", {}).get("attractor")
        if name == "attractor" and held is not None and not self.__dict__.get("_assigning"):
            if isinstance(value, Tensor) and value.requires_grad:
                raise ValueError("attractor: expected a tensor without gradient, got one with; use ds.with_goal(goal)")
            with torch.no_grad():
                held.copy_(_vector(value, held, "attractor"))
        else:
            super().__setattr__(name, value)

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        self.__dict__["_assigning"] = True  # load_state_dict(…, assign=True) replaces the attractor with all the rest
        try:
            super()._load_from_state_dict(*args, **kwargs)
        finally:
            del self.__dict__["_assigning"]

    def _apply(self: Self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        check_precision(fn(torch.zeros_like(self.attractor)).dtype)
        moved: Self = super()._apply(fn, recurse)  # type: ignore[no-untyped-call]
        return moved

    def _fingerprint(self) -> str:
        digest = hashlib.sha256()
        for name, value in self.state_dict().items():
            digest.update(name.encode() + value.detach().to("cpu", torch.float32).numpy().tobytes())
        return digest.hexdigest()

    def _points(self, y: Any, name: str = "y") -> tuple[Tensor, torch.dtype]:
        """``y`` in the module's dtype, and the dtype in which the caller wants the answer."""
        points = real_tensor(y, name)
        check_points(self.dim, points, name)
        dtype = self.attractor.dtype
        wanted = points.dtype if points.is_floating_point() else dtype
        return (points if points.dtype == dtype else points.to(dtype)), wanted

    def _times(self, t: Any) -> Tensor:
        """``t`` as seconds since its first entry, in the module's dtype."""
        if torch.compiler.is_exporting():
            raise ValueError(
                "rollout: cannot be exported, as times must be seen to be checked; export the velocity, ds(y), and "
                "integrate it, or decode and the flow of the dynamics"
            )
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
    def _with_exact_start(y0: Any, path: Tensor) -> Tensor:
        """``path`` (..., T, n) with ``y0`` itself, not what rounding made of it, as its first point."""
        start = real_tensor(y0, "y0").to(path.dtype)
        return torch.cat([start.unsqueeze(-2), path[..., 1:, :]], dim=-2)


ROLLOUT_ERRORS = (ArithmeticError, AssertionError, AttributeError, LookupError, RuntimeError, TypeError, ValueError)
"""What a method's own code may raise while it is measured. A time-out or an interrupt is none of it: it ends a fit."""


@contextmanager
def _restored_on_failure(ds: StableDS) -> Iterator[None]:
    """Within this context, what raises leaves the system as it was: the very tensors, their values and attributes."""
    attributes = {module: _shallow_copy(module) for module in ds.modules()}
    tensors = [*ds.parameters(), *ds.buffers()]
    values = [tensor.detach().clone() for tensor in tensors]
    try:
        yield
    except BaseException:
        for module, before in attributes.items():
            module.__dict__.clear()
            module.__dict__.update(before)
        for tensor, value in zip(tensors, values, strict=True):
            tensor.data = value if tensor.shape != value.shape else tensor.data.copy_(value)
        raise


def _shallow_copy(module: nn.Module) -> dict[str, Any]:
    """Its attributes, and its own dicts of parameters, buffers and submodules."""
    return {name: value.copy() if isinstance(value, dict) else value for name, value in vars(module).items()}


def _class_and_settings(ds: StableDS) -> dict[str, Any]:
    """What :func:`latentds.load` makes a system of, before its tensors."""
    if lost := [name for name in inspect.signature(type(ds)).parameters if not hasattr(ds, name)]:
        raise ValueError(f"ds: expected constructor arguments kept as attributes, got none for {', '.join(lost)}")
    settings = {}
    for name, value in ds.settings.items():
        if not isinstance(value, (int, float, str, StableDS, type(None))):
            raise ValueError(f"ds: expected settings of numbers, strings or None, got {name}={value!r:.80}")
        settings[name] = _class_and_settings(value) if isinstance(value, StableDS) else value
    return {"class": type(ds).__name__, "settings": settings}


def _vector(values: Any, like: Tensor, name: str) -> Tensor:
    """``values`` as a finite vector of the shape, dtype and device of another."""
    vector = real_tensor(values, name).to(like)
    if vector.shape != like.shape or (no_active_transforms() and not bool(torch.isfinite(vector).all())):
        raise ValueError(f"{name}: expected {tuple(like.shape)} finite numbers, got {values!r:.80}")
    return vector


class LatentDS(StableDS):
    """A stable system made of a diffeomorphism ψ (latent -> demonstration) and latent dynamics.

    f(y) = J_ψ(x) g(x) with x = ψ⁻¹(y) (paper, eq. 4), V(y) = ‖x - x*‖². Methods subclass it and implement ``_learn``.

    What was shown is kept in demonstration space; its latent image, :meth:`frame`, follows from it. So the attractor
    stays where it is however ψ is trained, and where it is moved in place, motions end there.

    Args:
        dim: n >= 1.
        diffeomorphism: ψ; the identity until fitted.
        dynamics: g, with its flow.

    Attributes:
        start: (n,) buffer, where the demonstrated motion begins; the first unit vector until fitted.
    """

    start: Tensor
    _memo: Memo[Frame]

    def __init__(self, dim: int, diffeomorphism: Diffeomorphism, dynamics: LatentDynamics) -> None:
        super().__init__(dim)
        self.register_buffer("start", torch.eye(1, self.dim, dtype=torch.float64)[0])
        self.diffeomorphism = diffeomorphism
        self.dynamics = dynamics
        self._memo = Memo[Frame]()
        self._one_point = OnePoint()

    def frame(self) -> Frame:
        """The latent attractor, axis and length, as ψ, ``attractor`` and ``start`` make them now."""
        return self._kept_frame() or self._new_frame()

    def _kept_frame(self) -> Frame | None:
        """The frame, made anew when something changed; None where a derivative or a transform must see it made."""
        psi, attractor = self.diffeomorphism, self.attractor
        sources = [attractor, self.start, *tensors_of(psi)]
        differentiated = torch.is_grad_enabled() and any(source.requires_grad for source in sources)
        if differentiated or attractor.is_meta or not no_active_transforms():
            return None
        structure = structure_of(psi)
        if structure is None:
            return None
        return self._memo.of([psi, *structure], sources, self._new_frame)

    def _new_frame(self) -> Frame:
        return Frame.between(*self.diffeomorphism.inverse(self._ends()).unbind())

    def _ends(self) -> Tensor:
        return torch.stack([self.start, self.attractor])

    def _linearize(self, y: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor], Frame]:
        """x = ψ⁻¹(y), the map of tangents by J_ψ(x), and the frame; in one sweep, if the frame is to be made."""
        frame = self._kept_frame()
        if frame is not None:
            return *self.diffeomorphism.linearize(y), frame
        ends = self._ends()
        rows, push_rows = self.diffeomorphism.linearize(torch.cat([y.reshape(-1, self.dim), ends]))

        def push(tangent: Tensor) -> Tensor:
            tangents = torch.cat([tangent.reshape(-1, self.dim), torch.zeros_like(ends)])
            return push_rows(tangents)[:-2].reshape(tangent.shape)

        return rows[:-2].reshape(y.shape), push, Frame.between(rows[-2], rows[-1])

    @torch.no_grad()
    def _refuse_folds(self, shown: Demonstration) -> None:
        """Refuse a ψ that was fitted to a motion and does not lead back in floats, as it does on paper.

        Raises:
            ValueError: if ψ(ψ⁻¹(y)) is not y along the motion, or if the motion from its start, begun anew half-way, is
                another one.
        """
        points = shown.positions.to(self.attractor)
        gap = float(torch.linalg.vector_norm(shown.goal - shown.start))
        off = float(round_trip_gap(self, points).max()) / gap
        times = torch.linspace(0, shown.duration, EXCERPT_POINTS, dtype=torch.float64)
        apart = float(restart_gap(self, self.rollout(points[0], times), times)) / shown.size
        rounding = torch.finfo(points.dtype).eps ** 0.4
        if not off < rounding:
            raise ValueError(
                "demonstration: expected a motion whose map inverts in floats, got one that comes back off by "
                f"{off:.1e} of the way from start to goal, which is {gap / shown.size:.1e} of its size"
            )
        if not apart <= max(ROUNDING_LIMIT, rounding):
            raise ValueError(
                "demonstration: expected a motion whose map inverts in floats, got one that rounding carries "
                f"{apart:.1e} of its size away; try a smaller mu, fewer layers, or another method"
            )

    def surroundings(self, ball: Tensor) -> Tensor:
        frame = self.frame()
        return self.decode(frame.attractor + frame.length * ball)

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

    def condition_number(self, x: Tensor) -> Tensor:
        """cond(J_ψ), the 2-norm's, at latent ``x``: (..., n) -> (...); inf where J_ψ is not finite."""
        jacobians = self.jacobian(x)
        finite = torch.isfinite(jacobians).all(-1).all(-1)
        safe = torch.where(finite[..., None, None], jacobians, torch.eye(self.dim).to(jacobians))
        return torch.where(finite, torch.linalg.cond(safe), math.inf)

    def latent_motion(self, y0: Tensor, t: Tensor) -> Tensor:
        """Where ψ⁻¹ of the motion from ``y0`` is at times ``t``: (..., n), (T,) seconds -> (..., T, n)."""
        return self.dynamics.flow(self.encode(y0), self._times(t), self.frame())

    def latent_error(self, y0: Tensor, t: Tensor) -> Tensor:
        """How far encode(decode(x)) comes back from x along the latent motion from ``y0``, in the length of its way.

        Invertible on paper is not invertible in floats: where ψ nearly folds, rounding ψ(x) loses x.

        Returns:
            (..., n), (T,) seconds -> (..., T).
        """
        x, frame = self.latent_motion(y0, t), self.frame()
        way = torch.linalg.vector_norm(x[..., 0, :] - frame.attractor, dim=-1, keepdim=True)
        error: Tensor = torch.linalg.vector_norm(self.encode(self.decode(x)) - x, dim=-1) / way
        return error

    def tables(self) -> Compiled | None:
        if type(self).forward is not LatentDS.forward or is_altered(self):
            return None  # a subclass whose velocity is another one must say itself how to write it
        exact = copy.deepcopy(self).to("cpu", torch.float64)
        return field_tables(exact.diffeomorphism, exact.dynamics, exact.frame())

    def straight_velocity(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        x, push, frame = self._linearize(points)
        return push(self.dynamics.straight()(x, points, frame)).to(wanted)

    @eager_for_derivatives
    def forward(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        if (velocity := self._one_point.velocity(self, points)) is not None:
            return velocity.to(wanted)
        x, push, frame = self._linearize(points)
        return push(self.dynamics(x, points, frame)).to(wanted)

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        x, _, frame = self._linearize(points)
        return self.dynamics.lyapunov(x, frame).to(wanted)

    def rollout(self, y0: Tensor, t: Tensor) -> Tensor:
        points, wanted = self._points(y0, "y0")
        times = self._times(t)
        x, _, frame = self._linearize(points)
        return self._with_exact_start(y0, self.diffeomorphism(self.dynamics.flow(x, times, frame)).to(wanted))


class MovedDS(StableDS):
    """Another system, moved, turned, scaled or slowed; what :meth:`StableDS.with_goal` and its like return.

    ẏ = σ s R f(z) with z = z* + Rᵀ(y - y*)/s, where z* is the attractor of the system inside. A system that is one of a
    stable system in other coordinates is as stable: V(y) is V(z). The system inside is a submodule, so that training
    this one trains it; ``fit`` teaches it what becomes the demonstration. ``fit_report`` is that of the system inside,
    in its units.

    Args:
        ds: the system inside; where it is until moved.

    Attributes:
        attractor: y*, (n,) buffer. Moved in place, it takes the whole motion with it.
        similarity: R, s and σ.
    """

    def __init__(self, ds: StableDS) -> None:
        super().__init__(ds.dim)
        self.ds = ds
        self.similarity = Similarity(ds.dim)
        self.to(ds.attractor)
        with torch.no_grad():
            self.attractor.copy_(ds.attractor)

    @property
    def fit_report(self) -> FitReport | None:
        return self.ds.fit_report

    @fit_report.setter
    def fit_report(self, report: FitReport | None) -> None:
        self.ds.fit_report = report

    @property
    def report_type(self) -> type[FitReport]:  # type: ignore[override]
        return self.ds.report_type

    def _learn(self, shown: Sequence[Demonstration], progress: bool) -> Learned:
        return self._teach(self.ds._learn, shown, progress)

    def _learn_and_measure(self, shown: Sequence[Demonstration], progress: bool) -> FitReport:
        report = self._teach(self.ds._learn_and_measure, shown, progress)
        return replace(report, learned_from=tuple(one.fingerprint for one in shown))

    def _teach(
        self, learn: Callable[[Sequence[Demonstration], bool], T], shown: Sequence[Demonstration], progress: bool
    ) -> T:
        """Let the system inside learn what becomes the demonstrations, and end where it then ends."""
        before, after = self.ds.attractor.clone(), self.attractor
        result = learn([self.similarity.fetch_motion(one, before, after) for one in shown], progress)
        with torch.no_grad():
            after.copy_(self.similarity.carry(self.ds.attractor, before, after))
        return result

    def excerpts(self) -> tuple[Excerpt, ...]:
        if not (float(self.similarity.speed) > 0 and float(self.similarity.scale) > 0):
            return ()  # written in place by a hand: no motion of it lasts as long as anything that was shown
        return tuple(
            self.similarity.carry_excerpt(one, self.ds.attractor, self.attractor) for one in self.ds.excerpts()
        )

    def forward(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        return self.similarity.velocity(self.ds(self._inside(points))).to(wanted)

    def straight_velocity(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        return self.similarity.velocity(self.ds.straight_velocity(self._inside(points))).to(wanted)

    def lyapunov(self, y: Tensor) -> Tensor:
        points, wanted = self._points(y)
        return self.ds.lyapunov(self._inside(points)).to(wanted)

    def rollout(self, y0: Tensor, t: Tensor) -> Tensor:
        points, wanted = self._points(y0, "y0")
        path = self.ds.rollout(self._inside(points), self.similarity.speed * self._times(t))
        return self._with_exact_start(y0, self._outside(path).to(wanted))

    def tables(self) -> FieldTables | None:
        inside = None if is_altered(self) else self.ds.tables()
        if not isinstance(inside, FieldTables):
            return None
        return self.similarity.tables(inside, self.ds.attractor, self.attractor)

    def surroundings(self, ball: Tensor) -> Tensor | None:
        inside = self.ds.surroundings(ball)
        return None if inside is None else self._outside(inside)

    def latent_error(self, y0: Tensor, t: Tensor) -> Tensor | None:
        return self.ds.latent_error(self._inside(y0), self.similarity.speed * self._times(t))

    def _inside(self, y: Tensor) -> Tensor:
        return self.similarity.fetch(y, self.ds.attractor, self.attractor)

    def _outside(self, z: Tensor) -> Tensor:
        return self.similarity.carry(z, self.ds.attractor, self.attractor)

    def _fingerprint(self) -> str:
        return self.ds._fingerprint()
