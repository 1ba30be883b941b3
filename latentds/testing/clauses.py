"""The clauses of the contract: each takes a case and raises an AssertionError that says what it found."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable
from functools import partial
from itertools import product

import numpy as np
import torch
from scipy.integrate import solve_ivp

from ..base import LatentDS
from ..demonstration import Demonstration
from .case import Case, Clause, cause_of, expect, same, watched, wavy_motion


def check_attractor(case: Case) -> None:
    """The attractor is a float64 buffer (n,): 0 at first, the end of the motion after a fit."""
    attractor = dict(case.ds.named_buffers()).get("attractor")
    expect(attractor is not None, "attractor is no buffer")
    assert attractor is not None
    expect(attractor.dtype == torch.float64, f"attractor: expected float64, got {attractor.dtype}")
    same(attractor, case.shown.goal if case.after_fit else torch.zeros(case.dim), "attractor")


def check_batches(case: Case) -> None:
    """Velocities, V and rollouts keep every batch shape: (), (1,), (B,), (A, B), (0,); a batch of one is its row."""
    ds, times = case.ds, torch.linspace(0, case.shown.duration, 5, dtype=torch.float64)
    with torch.no_grad():
        velocity, energy, paths = ds(case.probes)[::4], ds.lyapunov(case.probes)[::4], ds.rollout(case.few, times)
        for shape in ((), (1,), (6,), (3, 2), (0,)):
            count = math.prod(shape)
            y = case.few[:count].reshape(*shape, case.dim)
            same(ds(y), velocity[:count].reshape(y.shape), f"velocity of batch {shape}")
            same(ds.lyapunov(y), energy[:count].reshape(shape), f"V of batch {shape}")
            wanted = paths[:count].reshape(*shape, 5, case.dim)
            same(ds.rollout(y, times), wanted, f"rollout of batch {shape}", relative=1e-6)


def check_times(case: Case) -> None:
    """A rollout is y0 at t[0], bit for bit, whenever that is, for one time as for many; equal times, equal states."""
    ds, duration = case.ds, case.shown.duration
    times = torch.tensor([0, 0, 0.25, 1], dtype=torch.float64) * duration
    with torch.no_grad():
        paths = ds.rollout(case.starts, times)
        for what, clock in {"": times, " at times that begin at 7 s": times + 7, " at one time": times[:1] + 7}.items():
            path = ds.rollout(case.starts, clock)
            same(path, paths[:, : len(clock)], f"rollout{what}")
            expect(bool((path[:, 0] == case.starts).all()), f"rollout{what} does not begin at y0")
        same(paths[:, 1], case.starts, "rollout at t[1] == t[0]")


def check_equilibrium(case: Case) -> None:
    """The attractor is an equilibrium: f = 0 and V = 0 there, and a rollout from it stays."""
    ds, goal = case.ds, case.ds.attractor
    with torch.no_grad():
        fastest = float(torch.linalg.vector_norm(ds(case.probes), dim=-1).max())
        speed = float(torch.linalg.vector_norm(ds(goal)))
        expect(speed <= 1e-6 * fastest, f"speed {speed:.3g} at the attractor, {fastest:.3g} elsewhere")
        energy = float(ds.lyapunov(goal))
        expect(abs(energy) <= 1e-9 * float(ds.lyapunov(case.probes).max()), f"V = {energy:.3g} at the attractor")
        drift = float((ds.rollout(goal, torch.tensor([0.0, case.shown.duration])) - goal).abs().max())
        expect(drift <= 1e-6 * case.shown.size, f"a rollout from the attractor drifts by {drift:.3g}")


def check_descent(case: Case) -> None:
    """V > 0 and V̇ = ∇V·f < 0 away from the attractor."""
    ds, y = case.ds, case.probes
    with torch.no_grad():
        velocity = ds(y)
    energy, slope = (part.detach() for part in torch.func.jvp(ds.lyapunov, (y,), (velocity,)))
    low, high = int(energy.argmin()), int(slope.argmax())
    expect(bool((energy > 0).all()), f"V = {float(energy[low]):.3g} at {y[low].tolist()}")
    expect(bool((slope < 0).all()), f"V̇ = {float(slope[high]):.3g} at {y[high].tolist()}")


def check_convergence(case: Case) -> None:
    """Every rollout, from near and from far, arrives at the attractor and stays there."""
    octave = torch.linspace(0.5, 1, 21, dtype=torch.float64)[1:]  # to whose end it lasts twice as long as before it
    times = torch.cat([torch.zeros(1), *(2.0**k * case.shown.duration * octave for k in range(24))])
    with torch.no_grad():
        paths = case.ds.rollout(case.starts, times)[:, 1:]
    left = torch.linalg.vector_norm(paths - case.ds.attractor, dim=-1).nan_to_num(math.inf)
    for of in left.split(len(octave), dim=-1):
        if bool((of < 1e-3 * case.shown.size).all()):
            return
    worst = int(left[:, -1].argmax())
    raise AssertionError(f"a rollout from {case.starts[worst].tolist()} is still {float(left[worst, -1]):.3g} away")


def check_fall(case: Case) -> None:
    """V falls along every rollout, from near and from far."""
    times = torch.linspace(0, 4 * case.shown.duration, 160, dtype=torch.float64)
    with torch.no_grad():
        energy = case.ds.lyapunov(case.ds.rollout(case.starts, times))
    rise = float(energy.diff(dim=-1).max() / energy.max())
    expect(rise <= 1e-9, f"V rises by {rise:.3g} of itself along a rollout")


def check_training(case: Case) -> None:
    """Whatever its parameters become, a LatentDS rests at its attractor and its motions end there, to 1e-9."""
    if not isinstance(case.ds, LatentDS):
        return
    ds, draw = copy.deepcopy(case.ds), torch.Generator().manual_seed(case.seed)
    goal, size, y = ds.attractor.clone(), case.shown.size, case.starts
    with torch.no_grad():
        for parameter in ds.parameters():
            noise = torch.randn(parameter.shape, generator=draw, dtype=torch.float64).to(parameter)
            parameter.add_(0.05 * (1 + parameter.abs().mean()) * noise)
        same(ds.attractor, goal, "attractor after the parameters changed", relative=0)
        for what, call in {"speed": lambda y: torch.linalg.vector_norm(ds(y), dim=-1), "V": ds.lyapunov}.items():
            there, elsewhere = float(call(goal)), float(call(case.probes).max())
            expect(abs(there) <= 1e-9 * elsewhere, f"{what} {there:.3g} at the attractor, {elsewhere:.3g} elsewhere")
        for doubling in range(24):
            y = ds.rollout(y, torch.tensor([0.0, case.shown.duration * 2.0**doubling], dtype=torch.float64))[:, -1]
            left = float(torch.linalg.vector_norm(y - goal, dim=-1).max())
            if left < 1e-9 * size:
                return
    raise AssertionError(f"a motion ends {left:.3g} away from the attractor")


def check_flow(case: Case) -> None:
    """rollout is the flow of forward: it agrees with scipy's solve_ivp."""
    ds, starts = case.ds, case.starts[:3]
    times = torch.linspace(0, 0.8 * case.shown.duration, 65, dtype=torch.float64)
    with torch.no_grad():
        paths = ds.rollout(starts, times)
        begin, end = paths[:, :-1], paths[:, 1:]

        def velocity(_: float, flat: np.ndarray) -> np.ndarray:
            slope = ds(torch.from_numpy(flat).reshape(begin.shape))
            expect(bool(torch.isfinite(slope).all()), "the velocity along a rollout is not finite")
            return np.asarray(slope.reshape(-1))

        # All 64 stretches at once, each from where the rollout has it, take far fewer calls than one integration from
        # start to end. What they miss is added up, as it would be there. No row depends on another: a narrow band.
        span, band = (0.0, float(times[1])), case.dim - 1
        solver = {"method": "LSODA", "t_eval": span[1:], "rtol": 1e-7, "atol": 1e-9, "lband": band, "uband": band}
        solved = solve_ivp(velocity, span, begin.numpy().ravel(), **solver)
        expect(solved.success, f"solve_ivp gave up: {solved.message}")
        misses = (torch.from_numpy(solved.y).reshape(end.shape) - end).abs().amax(-1)
    gap = float(misses.sum(-1).max())
    expect(gap <= 1e-4 * case.shown.size, f"rollout is {gap:.3g} off the integral of forward")


def check_inverse(case: Case) -> None:
    """decode and encode are each other's inverse (LatentDS)."""
    if isinstance(ds := case.ds, LatentDS):
        with torch.no_grad():
            x = ds.encode(case.probes)
            same(ds.decode(x), case.probes, "decode(encode(y))", relative=1e-7)
            between = (x[:-1] + x[1:]) / 2
            same(ds.encode(ds.decode(between)), between, "encode(decode(x))", relative=1e-7)


def check_jacobian(case: Case) -> None:
    """The closed-form Jacobian equals autograd's (LatentDS)."""
    if isinstance(ds := case.ds, LatentDS):
        with torch.no_grad():
            x = ds.encode(case.probes)[::4]
            closed = ds.jacobian(x)
        for row, jacobian in zip(x, closed, strict=True):  # torch.func takes the torch path, which no kernel runs
            same(jacobian, torch.func.jacrev(ds.decode)(row), "jacobian(x)", relative=1e-8)


def check_gradients(case: Case) -> None:
    """Gradients reach the input and, from velocity or V, every parameter, and are finite."""
    ds = copy.deepcopy(case.ds)
    learned = {name: parameter for name, parameter in ds.named_parameters() if parameter.requires_grad}
    for what in ("velocity", "V", "rollout"):
        y = (case.few if what == "rollout" else case.probes).clone().requires_grad_()
        answer = case.calls(ds)[what](y)
        expect(answer.requires_grad, f"no gradient leaves {what}")
        torch.autograd.backward(answer.square().sum())
        expect(y.grad is not None, f"no gradient of {what} reaches its input")
        for name, leaf in {"its input": y, **learned}.items():
            finite = leaf.grad is None or bool(torch.isfinite(leaf.grad).all())
            expect(finite, f"the gradient of {what} by {name} is not finite")
            expect(what != "V" or leaf.grad is not None, f"no gradient of velocity or V reaches {name}")


def check_dtypes(case: Case) -> None:
    """Computed in the module's dtype, answered in the input's (of integers: the module's), whatever the times' is."""
    narrow = copy.deepcopy(case.ds).to(torch.float32)
    for name, tensor in narrow.state_dict().items():
        expect(tensor.dtype != torch.float64, f"{name} stayed float64 after .to(torch.float32)")
    times = torch.linspace(0, 1, 3, dtype=torch.float64)
    for ds in (case.ds, narrow):
        own = ds.attractor.dtype
        of_tensors, of_arrays = case.calls(ds, times), case.calls(ds, times.to(torch.float32).numpy())
        for what, dtype in product(of_tensors, (torch.float32, torch.bfloat16, torch.float64, torch.int64)):
            y = (case.starts[:2] if what == "rollout" else case.probes).to(dtype)
            answer_dtype = dtype if dtype.is_floating_point else own
            with torch.no_grad():
                wanted = of_tensors[what](y.to(own)).to(answer_dtype).to(torch.float64)
                answers = {"input": of_tensors[what](y)}
                if dtype != torch.bfloat16:  # which NumPy does not have
                    answers["array"] = of_arrays[what](y.numpy())
            for kind, answer in answers.items():
                where = f"{what} of {dtype} {kind}"
                expect(answer.dtype == answer_dtype, f"{where} is {answer.dtype}")
                same(answer.to(torch.float64), wanted, where, relative=4 * torch.finfo(own).eps)
                begins = what != "rollout" or bool((answer[:, 0] == y.to(answer_dtype)).all())
                expect(begins, f"{where} does not begin at y0")
    with torch.no_grad():
        fastest = float(torch.linalg.vector_norm(narrow(case.probes), dim=-1).max())
        speed = float(torch.linalg.vector_norm(narrow(narrow.attractor)))
    expect(speed <= 1e-3 * fastest, f"speed {speed:.3g} at the attractor in float32, {fastest:.3g} elsewhere")


def check_dimensions(case: Case) -> None:
    """Points of another dimension are refused by a ValueError."""
    ds, n = case.ds, case.dim
    shapes = [(), (n + 1,), *((4, size) for size in {1, n - 1, n + 1} - {0, n})]
    refused: dict[str, Callable[[], object]]
    refused = {
        f"{what} of shape {shape}": partial(call, torch.zeros(shape, dtype=torch.float64))
        for (what, call), shape in product(case.calls(ds).items(), shapes)
    }
    for what, call in refused.items():
        try:
            call()
        except ValueError:
            continue
        except Exception as error:
            raise AssertionError(f"{what} in {n}-D: expected a ValueError, {cause_of(error)}") from error
        raise AssertionError(f"{what} in {n}-D: expected a ValueError, got an answer")


def check_serialization(case: Case) -> None:
    """state_dict loads into a fresh instance; deepcopy and pickle give the same system."""
    fresh = case.factory(case.dim)
    fresh.load_state_dict(case.ds.state_dict())
    pickled = pickle.loads(pickle.dumps(case.ds))
    times = torch.linspace(0, case.shown.duration, 4)
    with torch.no_grad():
        paths = case.ds.rollout(case.starts, times)
        for way, twin in {"state_dict": fresh, "deepcopy": copy.deepcopy(case.ds), "pickle": pickled}.items():
            same(twin.attractor, case.ds.attractor, f"attractor after {way}", relative=0)
            same(twin(case.probes), case.ds(case.probes), f"velocity after {way}", relative=1e-12)
            same(twin.lyapunov(case.probes), case.ds.lyapunov(case.probes), f"V after {way}", relative=1e-12)
            same(twin.rollout(case.starts, times), paths, f"rollout after {way}")


def check_global_state(case: Case) -> None:
    """Nothing global changes: default dtype, thread count, gradient mode, seeds. Only fit draws random numbers."""
    expect(not case.changed, f"factory or fit {', '.join(case.changed)}")
    used = torch.get_rng_state()
    for what, call in case.calls(case.ds).items():
        with watched() as changed:
            call(case.starts)
        expect(not changed, f"{what} {', '.join(changed)}")
        expect(torch.equal(used, torch.get_rng_state()), f"{what} draws from torch's generator")


def check_report(case: Case) -> None:
    """The report's numbers are finite and not negative."""
    report = case.ds.fit_report
    assert report is not None
    expect(math.isfinite(report.mse) and report.mse >= 0, f"fit_report.mse is {report.mse}")
    expect(report.n_layers >= 0, f"fit_report.n_layers is {report.n_layers}")


def check_memory(case: Case) -> None:
    """fit leaves the demonstration as it was, and changing the demonstration afterwards does not move the system."""
    ds, positions = case.ds, case.learned.positions
    same(positions, case.shown.positions, "the demonstration after fit", relative=0)
    with torch.no_grad():
        attractor, velocity = ds.attractor.clone(), ds(case.probes)
        try:
            positions += case.shown.size
            same(ds.attractor, attractor, "attractor after the demonstration was changed", relative=0)
            same(ds(case.probes), velocity, "velocity after the demonstration was changed", relative=0)
        finally:
            positions.copy_(case.shown.positions)


def check_repeatability(case: Case) -> None:
    """The same seed gives the same system, and a second fit forgets the first."""
    other = case.refitted(wavy_motion(case.dim, case.seed + 1, n_points=150))
    forgot = case.refitted(case.shown, other)
    with torch.no_grad():
        wanted = case.ds(case.probes)
        try:
            same(forgot(case.probes), wanted, "velocity after a refit of a fitted instance", relative=1e-6)
        except AssertionError:  # memory or chance? One more fit tells.
            again = case.refitted(case.shown)
            same(again(case.probes), wanted, "velocity after the same fit in a new instance", relative=1e-6)
            raise


def check_scale_equivariance(case: Case) -> None:
    """Units do not matter: a motion 1024 times as large gives velocities 1024 times as large."""
    factor = 1024.0  # a power of two, so that rounding is the same and cannot be the reason for a difference
    large = case.refitted(Demonstration(case.shown.positions * factor, case.shown.dt))
    with torch.no_grad():
        same(large(factor * case.probes) / factor, case.ds(case.probes), "velocity in other units", relative=1e-5)


CLAUSES: tuple[Clause, ...] = (
    check_attractor,
    check_batches,
    check_times,
    check_equilibrium,
    check_descent,
    check_convergence,
    check_fall,
    check_training,
    check_flow,
    check_inverse,
    check_jacobian,
    check_gradients,
    check_dtypes,
    check_dimensions,
    check_serialization,
    check_global_state,
)
FIT_CLAUSES: tuple[Clause, ...] = (check_report, check_memory, check_repeatability, check_scale_equivariance)
