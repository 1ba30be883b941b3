"""The public contract: what every method promises, checked by trying it. Needs no test runner."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.integrate import solve_ivp
from torch import Tensor

from .arguments import whole_number
from .base import FitReport, LatentDS, StableDS
from .demonstration import Demonstration

Factory = Callable[[int], StableDS]


def check_stable_ds(
    factory: Factory, *, dims: Sequence[int] = (2, 3, 7), fitted: Sequence[bool] = (False, True), seed: int = 0
) -> None:
    """Hold a method to the contract of :class:`~latentds.StableDS`, line by line, on small motions.

    Give a factory with small budgets (few layers, few epochs): about five fits are made for each dimension. A
    method with a seed should be given one.

    Args:
        factory: n -> a new, unfitted system of that dimension.
        dims: the dimensions to try, each >= 1.
        fitted: whether to try the system before a fit, after one, or both.
        seed: of the demonstrations and probe points.

    Raises:
        AssertionError: naming the method, the line of the contract that it breaks, and what was found.
    """
    for dim in dims:
        for after_fit in fitted:
            where = f"{dim}-D, {'fitted' if after_fit else 'unfitted'}"
            try:
                case = _Case.of(factory, dim, after_fit, seed)
            except Exception as error:
                raise AssertionError(f"the factory ({where}) breaks “{_Case.of.__doc__}” {_told(error)}") from error
            for line in (*_FIT_LINES, *_LINES) if after_fit else _LINES:
                try:
                    line(case)
                except Exception as error:
                    name = type(case.ds).__name__
                    raise AssertionError(f"{name} ({where}) breaks “{line.__doc__}” {_told(error)}") from error


def wavy_motion(dim: int, seed: int = 0, n_points: int = 200) -> Demonstration:
    """A smooth motion of about unit size that never meets itself, in any dimension, for trying methods out."""
    dim = whole_number(dim, "dim", at_least=1)
    draw = np.random.default_rng(seed)
    t = np.linspace(0, 1, n_points)
    s = t - 0.8 * np.sin(2 * np.pi * t) / (2 * np.pi)
    cycles, phases = draw.uniform(0.3, 1.2, dim), draw.uniform(0, 2 * np.pi, dim)
    positions = 0.3 * np.sin(2 * np.pi * cycles * s[:, None] + phases)
    positions[:, 0] = 1 - s  # monotone, so that no two points coincide
    positions += draw.uniform(-1, 1, dim)
    return Demonstration(torch.from_numpy(positions), 2.0 / (n_points - 1), f"wavy {dim}-D")


@dataclass(frozen=True)
class _Case:
    """One system under examination, with the places to try it at."""

    factory: Factory
    dim: int
    seed: int
    ds: StableDS
    shown: Demonstration
    probes: Tensor
    """(P, n): on the demonstration, near it, around it and ten sizes away; none at the attractor."""
    starts: Tensor
    """(S, n): the start, two near it, two far away."""
    generator_states: tuple[Tensor, Tensor]
    """Torch's random state after two fits that began from different states."""
    world: dict[str, object]
    """What nobody may change, as it was before."""

    @classmethod
    def of(cls, factory: Factory, dim: int, fitted: bool, seed: int) -> _Case:
        """factory(n) gives a float64 StableDS; its attractor, a buffer (n,), is 0 and after fit the motion's end."""
        shown = wavy_motion(dim, seed)
        world, states = _world(), []
        with torch.random.fork_rng(devices=[]):
            for begin in (seed + 1, seed):
                torch.manual_seed(begin)
                ds = factory(dim)
                _expect(isinstance(ds, StableDS), f"expected a StableDS, got {type(ds).__name__}")
                if fitted:
                    ds.fit(shown)
                states.append(torch.get_rng_state())
        attractor = dict(ds.named_buffers()).get("attractor")
        _expect(attractor is not None, "attractor is no buffer")
        assert attractor is not None
        _same(attractor, torch.zeros(dim) if not fitted else shown.goal, "attractor")
        _expect(attractor.dtype == torch.float64, f"attractor: expected float64, got {attractor.dtype}")
        draw = torch.Generator().manual_seed(seed)
        path = shown.positions - shown.goal + attractor
        size = shown.size

        def spread(count: int, scale: float) -> Tensor:
            return (
                scale
                * size
                * torch.nn.functional.normalize(torch.randn(count, dim, generator=draw, dtype=torch.float64), dim=-1)
            )

        on_path = path[:: len(path) // 12][:-1]
        probes = torch.cat(
            [on_path, on_path + spread(len(on_path), 0.1), attractor + spread(8, 1), attractor + spread(4, 10)]
        )
        starts = torch.cat([path[:1], path[:1] + spread(2, 0.1), attractor + spread(2, 10)])
        return cls(factory, dim, seed, ds, shown, probes, starts, (states[0], states[1]), world)

    def refitted(self, shown: Demonstration, ds: StableDS | None = None) -> StableDS:
        """A system (new unless given) fitted from the same random state as ``ds``."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            return (self.factory(self.dim) if ds is None else ds).fit(shown)


def _world() -> dict[str, object]:
    return {
        "the default dtype": torch.get_default_dtype(),
        "the thread count": torch.get_num_threads(),
        "gradient mode": torch.is_grad_enabled(),
        "NumPy's random state": str(np.random.get_state()),  # noqa: NPY002 - the global state is what we watch
    }


def _expect(holds: bool, found: str) -> None:
    if not holds:
        raise AssertionError(found)


def _told(error: Exception) -> str:
    return str(error) if isinstance(error, AssertionError) else f"raised {type(error).__name__}: {error}"


def _same(got: Tensor, wanted: Tensor, what: str, *, relative: float = 1e-9) -> None:
    _expect(got.shape == wanted.shape, f"{what}: expected shape {tuple(wanted.shape)}, got {tuple(got.shape)}")
    _expect(bool(torch.isfinite(got).all()), f"{what}: expected finite numbers")
    if not got.numel():
        return
    gap, scale = float((got - wanted).detach().abs().max()), float(wanted.detach().abs().max())
    _expect(gap <= relative * scale, f"{what}: off by {gap:.3g} at a scale of {scale:.3g}")


def _batches(case: _Case) -> None:
    """Velocities, V and rollouts keep every batch shape: (), (1,), (B,), (A, B), (0,); a batch of one is its row."""
    ds, times = case.ds, torch.linspace(0, case.shown.duration, 5, dtype=torch.float64)
    with torch.no_grad():
        velocity, energy, paths = ds(case.probes), ds.lyapunov(case.probes), ds.rollout(case.probes, times)
        for shape in ((), (1,), (6,), (3, 2), (0,)):
            count = math.prod(shape)
            y = case.probes[:count].reshape(*shape, case.dim)
            _same(ds(y), velocity[:count].reshape(y.shape), f"velocity of batch {shape}")
            _same(ds.lyapunov(y), energy[:count].reshape(shape), f"V of batch {shape}")
            wanted = paths[:count].reshape(*shape, 5, case.dim)
            _same(ds.rollout(y, times), wanted, f"rollout of batch {shape}", relative=1e-6)
        _expect(bool((ds.rollout(case.probes, times)[:, 0] == case.probes).all()), "rollout does not begin at y0")
        _same(ds.rollout(case.probes, times + 7), paths, "rollout at times that begin at 7 s")


def _rests(case: _Case) -> None:
    """The attractor is an equilibrium: f = 0 and V = 0 there, and a rollout from it stays."""
    ds, goal = case.ds, case.ds.attractor
    with torch.no_grad():
        fastest = float(torch.linalg.vector_norm(ds(case.probes), dim=-1).max())
        speed = float(torch.linalg.vector_norm(ds(goal)))
        _expect(speed <= 1e-6 * fastest, f"speed {speed:.3g} at the attractor, {fastest:.3g} elsewhere")
        energy = float(ds.lyapunov(goal))
        _expect(abs(energy) <= 1e-9 * float(ds.lyapunov(case.probes).max()), f"V = {energy:.3g} at the attractor")
        drift = float((ds.rollout(goal, torch.tensor([0.0, case.shown.duration])) - goal).abs().max())
        _expect(drift <= 1e-6 * case.shown.size, f"a rollout from the attractor drifts by {drift:.3g}")


def _decreases(case: _Case) -> None:
    """V > 0 and V̇ = ∇V·f < 0 away from the attractor."""
    ds, y = case.ds, case.probes
    with torch.no_grad():
        velocity = ds(y)
    energy, slope = (part.detach() for part in torch.func.jvp(ds.lyapunov, (y,), (velocity,)))
    low, high = int(energy.argmin()), int(slope.argmax())
    _expect(bool((energy > 0).all()), f"V = {float(energy[low]):.3g} at {y[low].tolist()}")
    _expect(bool((slope < 0).all()), f"V̇ = {float(slope[high]):.3g} at {y[high].tolist()}")


def _converges(case: _Case) -> None:
    """Every rollout, from near and from far, ends at the attractor, and V falls along it."""
    ds, y = case.ds, case.starts
    horizon = case.shown.duration
    with torch.no_grad():
        for _ in range(24):  # twice the time at each stage: 2^24 durations in all
            paths = ds.rollout(y, torch.linspace(0, horizon, 20, dtype=torch.float64))
            energy = ds.lyapunov(paths)
            rise = float(energy.diff(dim=-1).max() / energy.max())
            _expect(rise <= 1e-9, f"V rises by {rise:.3g} of itself along a rollout")
            y = paths[:, -1]
            left = torch.linalg.vector_norm(y - ds.attractor, dim=-1)
            if bool((left < 1e-3 * case.shown.size).all()):
                return
            horizon *= 2
    worst = int(left.nan_to_num(math.inf).argmax())
    raise AssertionError(f"a rollout from {case.starts[worst].tolist()} is still {float(left[worst]):.3g} away")


def _flows(case: _Case) -> None:
    """rollout is the flow of forward: it agrees with scipy's solve_ivp."""
    ds, starts = case.ds, case.starts[:3]
    times = np.linspace(0, 0.8 * case.shown.duration, 9)
    with torch.no_grad():

        def velocity(_: float, flat: np.ndarray) -> np.ndarray:
            return np.asarray(ds(torch.from_numpy(flat).reshape(starts.shape)).reshape(-1))

        solved = solve_ivp(velocity, (0, times[-1]), starts.numpy().ravel(), "LSODA", times, rtol=1e-7, atol=1e-9)
        _expect(solved.success, f"solve_ivp gave up: {solved.message}")
        expected = torch.from_numpy(solved.y.T.reshape(len(times), *starts.shape)).transpose(0, 1)
        gap = float((ds.rollout(starts, torch.from_numpy(times)) - expected).abs().max())
    _expect(gap <= 1e-4 * case.shown.size, f"rollout is {gap:.3g} off the integral of forward")


def _inverts(case: _Case) -> None:
    """decode and encode are each other's inverse (LatentDS)."""
    if isinstance(ds := case.ds, LatentDS):
        with torch.no_grad():
            x = ds.encode(case.probes)
            _same(ds.decode(x), case.probes, "decode(encode(y))", relative=1e-7)
            between = (x[:-1] + x[1:]) / 2
            _same(ds.encode(ds.decode(between)), between, "encode(decode(x))", relative=1e-7)


def _differentiates(case: _Case) -> None:
    """The closed-form Jacobian equals autograd's (LatentDS)."""
    if isinstance(ds := case.ds, LatentDS):
        with torch.no_grad():
            x = ds.encode(case.probes)[::4]
            closed = ds.jacobian(x)
        for row, found in zip(x, closed, strict=True):
            _same(found, torch.func.jacrev(ds.decode)(row), "jacobian(x)", relative=1e-8)


def _passes_gradients(case: _Case) -> None:
    """Gradients reach the input and every parameter, and are finite."""
    ds = copy.deepcopy(case.ds)
    times = torch.linspace(0, case.shown.duration, 3, dtype=torch.float64)
    calls: dict[str, Callable[[Tensor], Tensor]]
    calls = {"velocity": ds, "V": ds.lyapunov, "rollout": lambda y: ds.rollout(y, times)}
    for what, call in calls.items():
        y = case.probes.clone().requires_grad_()
        answer = call(y)
        _expect(answer.requires_grad, f"no gradient leaves {what}")
        (slope,) = torch.autograd.grad(answer.square().sum(), y)
        _expect(bool(torch.isfinite(slope).all()), f"the gradient of {what} by its input is not finite")
    y = case.probes.clone().requires_grad_()
    (ds(y).square().sum() + ds.lyapunov(y).sum()).backward()
    for name, parameter in ds.named_parameters():
        if parameter.requires_grad:
            _expect(parameter.grad is not None, f"no gradient reaches {name}")
            assert parameter.grad is not None
            _expect(bool(torch.isfinite(parameter.grad).all()), f"the gradient of {name} is not finite")


def _keeps_types(case: _Case) -> None:
    """The answer has the input's dtype, whatever the module's; .to(torch.float32) moves every floating tensor."""
    times = torch.linspace(0, 1, 3)
    narrow = copy.deepcopy(case.ds).to(torch.float32)
    for name, tensor in narrow.state_dict().items():
        _expect(tensor.dtype != torch.float64, f"{name} stayed float64 after .to(torch.float32)")
    with torch.no_grad():
        for ds in (case.ds, narrow):
            for dtype in (torch.float32, torch.float64):
                y = case.probes.to(dtype)
                answers = {"velocity": ds(y), "V": ds.lyapunov(y), "rollout": ds.rollout(y, times)}
                if isinstance(ds, LatentDS):
                    answers |= {"encode": ds.encode(y), "decode": ds.decode(y), "jacobian": ds.jacobian(y)}
                for what, answer in answers.items():
                    _expect(answer.dtype == dtype, f"{what} of {dtype} input is {answer.dtype}")
                    _expect(bool(torch.isfinite(answer).all()), f"{what} of {dtype} input is not finite")
        fastest = float(torch.linalg.vector_norm(narrow(case.probes), dim=-1).max())
        speed = float(torch.linalg.vector_norm(narrow(narrow.attractor)))
        _expect(speed <= 1e-3 * fastest, f"speed {speed:.3g} at the attractor in float32, {fastest:.3g} elsewhere")


def _travels(case: _Case) -> None:
    """state_dict loads into a fresh instance; deepcopy and pickle give the same system."""
    fresh = case.factory(case.dim)
    fresh.load_state_dict(case.ds.state_dict())
    pickled = pickle.loads(pickle.dumps(case.ds))
    times = torch.linspace(0, case.shown.duration, 4)
    with torch.no_grad():
        for way, twin in {"state_dict": fresh, "deepcopy": copy.deepcopy(case.ds), "pickle": pickled}.items():
            _same(twin.attractor, case.ds.attractor, f"attractor after {way}", relative=0)
            _same(twin(case.probes), case.ds(case.probes), f"velocity after {way}", relative=1e-12)
            _same(twin.lyapunov(case.probes), case.ds.lyapunov(case.probes), f"V after {way}", relative=1e-12)
            _same(twin.rollout(case.starts, times), case.ds.rollout(case.starts, times), f"rollout after {way}")


def _leaves_the_world(case: _Case) -> None:
    """Nothing global changes: default dtype, thread count, gradient mode, seeds."""
    used = torch.get_rng_state()
    case.ds(case.probes), case.ds.rollout(case.starts, torch.linspace(0, 1, 3))
    _expect(torch.equal(used, torch.get_rng_state()), "evaluating draws from torch's generator")
    _expect(not torch.equal(case.generator_states[0], case.generator_states[1]), "fit seeds torch's generator")
    for what, now in _world().items():
        _expect(now == case.world[what], f"{what} changed")


def _reports(case: _Case) -> None:
    """fit returns self and leaves a FitReport."""
    ds = case.factory(case.dim)
    _expect(case.refitted(case.shown, ds) is ds, "fit did not return self")
    report = ds.fit_report
    _expect(isinstance(report, FitReport), f"fit_report is {type(report).__name__}")
    assert report is not None
    _expect(math.isfinite(report.mse) and report.mse >= 0, f"fit_report.mse is {report.mse}")
    _expect(report.n_layers >= 0 and report.seconds >= 0, f"fit_report: {report}")


def _repeats(case: _Case) -> None:
    """The same seed gives the same system, and a second fit forgets the first."""
    again = case.refitted(case.shown)
    other = case.refitted(wavy_motion(case.dim, case.seed + 1, n_points=150))
    forgot = case.refitted(case.shown, other)
    with torch.no_grad():
        wanted = case.ds(case.probes)
        _same(again(case.probes), wanted, "velocity after the same fit in a new instance", relative=1e-6)
        _same(forgot(case.probes), wanted, "velocity after a refit of a fitted instance", relative=1e-6)


def _scales(case: _Case) -> None:
    """Units do not matter: a motion 1024 times as large gives velocities 1024 times as large."""
    factor = 1024.0  # a power of two, so that rounding is the same and cannot be the reason for a difference
    large = case.refitted(Demonstration(case.shown.positions * factor, case.shown.dt))
    with torch.no_grad():
        _same(large(factor * case.probes) / factor, case.ds(case.probes), "velocity in other units", relative=1e-5)


_LINES = (
    _batches,
    _rests,
    _decreases,
    _converges,
    _flows,
    _inverts,
    _differentiates,
    _passes_gradients,
    _keeps_types,
    _travels,
    _leaves_the_world,
)
_FIT_LINES = (_reports, _repeats, _scales)
