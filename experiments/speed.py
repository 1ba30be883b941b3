"""How near to the machine's limit: every public call against a plain torch loop and a measured floor, on one core.

    python -m experiments.speed [--quick] [--out results/speed]

Then what needs processes and cores of its own: :mod:`experiments.scale` and, but for ``--quick``,
:mod:`experiments.deployed`.

Rivals take turns, and what counts are ratios of medians, in CPU time of the one thread that computes: other processes
then slow both through shared caches only, where in wall time they would interrupt the longer call more often than the
shorter one. A control loop's latency is wall time, interruptions included, so run this on an otherwise idle machine.
Leaves goals.csv, growth.csv, summary.md, growth.png and environment.json in ``--out``.
"""

from __future__ import annotations

import importlib
import math
import os
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numba
import numpy as np
import pandas as pd
import torch
import typer
from matplotlib.figure import Figure
from rich.console import Console
from rich.markdown import Markdown
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar
from torch import Tensor, nn

from baselines import SDSEF
from experiments import deployed, report, scale
from experiments.report import Goal, at_most
from experiments.scale import SHOWN, take_turns
from latentds import ChebyshevDS, LatentDS, TubeDS, datasets, kernels
from latentds.arguments import Array
from latentds.fitting.matching import match
from latentds.kernels.compiling import OPTIONS
from latentds.kernels.dispatch import BLOCK, reference
from latentds.kernels.lanes import WIDTH, exp, load, store
from latentds.translations import WIDTH_BOUND

N_LAYERS = 150

# --- the floor --------------------------------------------------------------------------------------------------------


@numba.njit(**OPTIONS)
def exponentials(buffer: Array, repeats: int) -> None:
    """One exponential for each of ``BLOCK`` numbers in the L1 cache."""
    for _ in range(repeats):
        for u in range(0, BLOCK, WIDTH):
            store(buffer, u, exp(load(buffer, u, WIDTH) * -1.0))


@numba.njit(**OPTIONS)
def products(buffer: Array, repeats: int) -> None:
    """Twelve independent chains of multiply-add in registers."""
    m = load(buffer, 0, WIDTH)
    a, b, c, d, e, f = m, m, m, m, m, m
    g, h, i, j, k, n = m, m, m, m, m, m
    for _ in range(repeats):
        a, b, c, d, e, f = a * m + m, b * m + m, c * m + m, d * m + m, e * m + m, f * m + m
        g, h, i, j, k, n = g * m + m, h * m + m, i * m + m, j * m + m, k * m + m, n * m + m
    store(buffer, 0, a + b + c + d + e + f + g + h + i + j + k + n)


BUFFER, REPEATS = np.full(BLOCK, 0.5), 20_000
"""What the two run over; of the first, ``REPEATS * BLOCK`` exponentials."""

OPERATIONS = 3 + 3 + 1 + 3
"""Vector operations of a layer at n = 3 beside its exponential: x - c, the squared length, times ρ², and x + k v."""

# --- the calls as one writes them first, in loops of torch ------------------------------------------------------------

Layers = list[tuple[Tensor, Tensor, Tensor]]
"""(c, v, ρ) of each."""


def layers_of(ds: ChebyshevDS) -> Layers:
    psi = ds.diffeomorphism
    return list(zip(*(part.detach() for part in (psi.centers, psi.directions, psi.widths)), strict=True))


def forward_loop(layers: Layers, x: Tensor) -> Tensor:
    for c, v, rho in layers:
        x = x + torch.exp(-(rho**2) * ((x - c) ** 2).sum(-1, keepdim=True)) * v
    return x


def inverse_loop(layers: Layers, y: Tensor) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """x, and the gradient of each layer's weight with its direction, last layer first."""
    steps = []
    for c, v, rho in reversed(layers):
        w = y - c
        a, b, r = v @ v, (w * v).sum(-1, keepdim=True), (w * w).sum(-1, keepdim=True)
        low, high, s = torch.zeros_like(b), torch.ones_like(b), torch.exp(-(rho**2) * r)
        for _ in range(60):
            k = torch.exp(-(rho**2) * (a * s * s - 2 * b * s + r))
            gap = s - k
            low, high = torch.where(gap < 0, s, low), torch.where(gap > 0, s, high)
            new = s - gap / (1 - 2 * rho**2 * (b - a * s) * k)
            new = torch.where((new < low) | (new > high), (low + high) / 2, new)
            moved, s = (new - s).abs().max(), new
            if moved < 1e-15:
                break
        y = y - s * v
        steps.append((-2 * rho**2 * s * (y - c), v))
    return y, steps


def velocity_loop(layers: Layers, y: Tensor, latent_velocity: Callable[[Tensor], Tensor]) -> Tensor:
    x, steps = inverse_loop(layers, y)
    moved = latent_velocity(x)
    for gradient, v in reversed(steps):
        moved = moved + (gradient * moved).sum(-1, keepdim=True) * v
    return moved


def runge_kutta(field: Callable[[Tensor], Tensor], y: Tensor, times: Tensor) -> Tensor:
    path = [y]
    for h in times.diff():
        k1 = field(y)
        k2 = field(y + h / 2 * k1)
        k3 = field(y + h / 2 * k2)
        k4 = field(y + h * k3)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        path.append(y)
    return torch.stack(path, dim=-2)


def match_loop(x: Array, y: Array, n_layers: int, beta: float, mu: float) -> float:
    """Greedy matching, one bounded scalar minimisation a layer; the mean squared error that it reaches."""
    for _ in range(n_layers):
        error = y - x
        worst = int((error**2).sum(1).argmax())
        v, squared = beta * error[worst], ((x - x[worst]) ** 2).sum(1)

        def loss(rho: float, v: Array = v, squared: Array = squared, error: Array = error) -> float:
            return float(((error - np.exp(-(rho**2) * squared)[:, None] * v) ** 2).sum())

        rho = minimize_scalar(loss, bounds=(0, mu * WIDTH_BOUND / np.linalg.norm(v)), method="bounded").x
        x = x + np.exp(-(rho**2) * squared)[:, None] * v
    return float(((x - y) ** 2).mean())


# --- timing -----------------------------------------------------------------------------------------------------------


def race(what: str, least: float, slow: Callable[[], Any], fast: Callable[[], Any], rounds: int) -> Goal:
    """That ``fast`` is ``least`` times faster than ``slow``."""
    times = take_turns({"slow": slow, "fast": fast}, rounds)
    return report.ratio(what, least, times["slow"], times["fast"])


# --- studies ----------------------------------------------------------------------------------------------------------


def latent_points(ds: ChebyshevDS, count: int, seed: int = 0) -> Tensor:
    """Spread around the motion: as rollouts from everywhere near it would visit."""
    generator = torch.Generator().manual_seed(seed)
    on_path = ds.encode(SHOWN.positions)[torch.randint(len(SHOWN), (count,), generator=generator)]
    return on_path + 0.3 * torch.randn(count, 3, generator=generator, dtype=torch.float64)


def against_floor(ds: ChebyshevDS, rounds: int) -> list[Goal]:
    layers, x = layers_of(ds), latent_points(ds, 100_000)
    floors = {"exponentials": partial(exponentials, BUFFER, REPEATS), "products": partial(products, BUFFER, REPEATS)}
    times = take_turns({"decode": partial(ds.decode, x), **floors}, rounds)
    each_exp = times["exponentials"] / REPEATS / BLOCK
    each_product = times["products"] / REPEATS / 12 / WIDTH
    floor = (each_exp + OPERATIONS * each_product) * N_LAYERS * len(x)
    note = (
        f"floor {np.median(floor) / N_LAYERS / len(x) * 1e9:.2f} ns a layer and point: exponential "
        f"{np.median(each_exp) * 1e9:.2f} ns, {OPERATIONS} operations of {np.median(each_product) * 1e9:.3f} ns"
    )
    above = report.median("decode 10⁵ points", "times the floor", 2.5, times["decode"] / floor, at_most=True, note=note)
    loop = partial(forward_loop, layers, x)
    return [above, race("decode 10⁵ points, torch loop", 35, loop, partial(ds.decode, x), max(3, rounds // 4))]


def against_loop(ds: ChebyshevDS, rounds: int) -> list[Goal]:
    layers, many = layers_of(ds), ds.decode(latent_points(ds, 1000))

    def latent_velocity(x: Tensor) -> Tensor:
        return ds.dynamics(x, x, ds.frame())

    single, goals = SHOWN.positions[400], []
    for label, points, least in (
        ("velocity of 1000 points", many, 80),
        ("velocity of one point, ds(y)", single, 100),
    ):
        fast, slow = partial(ds, points), partial(velocity_loop, layers, points, latent_velocity)
        torch.testing.assert_close(fast(), slow(), rtol=1e-8, atol=1e-8)
        goals.append(race(f"{label}, torch loop", least, slow, fast, rounds))
    return goals


def control_loop(calls: int) -> list[Goal]:
    goals = []
    for n_layers, most in ((150, 60), (750, 120)):
        controller = ChebyshevDS(3, n_layers=n_layers).fit(SHOWN).controller()
        points, out = SHOWN.positions.numpy(), np.empty(3)
        wall, busy = np.empty(calls), np.empty(calls)
        for seconds, clock in ((wall, time.perf_counter), (busy, time.thread_time)):
            for i in range(calls):
                y = points[i % len(points)]
                began = clock()
                controller(y, out)
                seconds[i] = clock() - began
        micro = wall * 1e6
        label = f"controller(y), M = {n_layers}"
        goals.append(report.median(f"{label}, median", "µs", most, micro, at_most=True))
        late = float(np.quantile(micro, 0.99))
        note = f"worst of {calls}: {micro.max():.0f} µs; of CPU time {np.quantile(busy, 0.99) * 1e6:.0f} µs"
        goals.append(at_most(f"{label}, 99th percentile", late, 1000, unit="µs", note=note))
    return goals


def rollouts(ds: ChebyshevDS, rounds: int) -> list[Goal]:
    generator = torch.Generator().manual_seed(0)
    starts = SHOWN.start + 0.1 * torch.randn(16, 3, generator=generator, dtype=torch.float64)
    times = torch.linspace(0, SHOWN.duration, 1000, dtype=torch.float64)
    fast, slow = partial(ds.rollout, starts, times), partial(runge_kutta, ds, starts, times)
    clock = take_turns({"fast": fast, "rk4": slow}, max(3, rounds // 4))
    controller = ds.controller()

    def field(_: float, y: Array) -> Array:
        return controller(y)

    closed_form = fast()
    began, worst = time.thread_time(), 0.0
    for start, path in zip(starts.numpy(), closed_form.numpy(), strict=True):
        exact = solve_ivp(field, (0, SHOWN.duration), start, "RK45", times.numpy(), rtol=1e-9, atol=1e-12)
        worst = max(worst, float(np.abs(exact.y.T - path).max()))
    seconds = np.array([time.thread_time() - began])
    coarse = float((slow() - closed_form).abs().max())
    note = f"RK4 of 1000 steps: {coarse:.1e}"
    return [
        report.ratio("rollout 16 x 1000, RK4 on ds(y)", 60, clock["rk4"], clock["fast"]),
        report.ratio("rollout 16 x 1000, dopri5 on controller(y)", 60, seconds, clock["fast"]),
        at_most("rollout, distance from dopri5 (rtol 1e-9)", worst, 1e-6, unit="units", note=note),
    ]


def gradients(rounds: int) -> list[Goal]:
    """Of two training steps' losses: by the adjoint kernels, and by autograd through torch's own operations."""
    ds = TubeDS(3, n_layers=300, refined=False).fit(SHOWN)
    losses = {
        "rollout loss": lambda: (ds.rollout(SHOWN.start, SHOWN.times) - SHOWN.positions).square().mean(),
        "velocity loss": lambda: (ds(SHOWN.positions) - SHOWN.velocities).square().mean(),
    }

    def gradient(loss: Callable[[], Tensor]) -> Tensor:
        with torch.enable_grad():
            return torch.cat([g.flatten() for g in torch.autograd.grad(loss(), list(ds.parameters()))])

    def by_torch(loss: Callable[[], Tensor]) -> Tensor:
        with reference():
            return gradient(loss)

    goals = []
    for name, loss in losses.items():
        fast, slow = partial(gradient, loss), partial(by_torch, loss)
        apart = float((fast() - slow()).norm() / slow().norm())
        goal = race(f"gradient of the {name}, M = 300, N = 1000, torch path", 10, slow, fast, max(3, rounds // 4))
        goals += [goal, at_most("... relative difference", apart, 1e-10)]
    return goals


def fits(rounds: int) -> list[Goal]:
    x, y = ChebyshevDS.latent_line(SHOWN), SHOWN.positions.numpy()
    fast, slow = partial(match, x, y, 300, 0.5, 0.9), partial(match_loop, x, y, 300, 0.5, 0.9)
    psi = ChebyshevDS(3, n_layers=300).diffeomorphism
    psi.assign(*(torch.from_numpy(part) for part in fast()))
    error = float((psi(torch.from_numpy(x)) - SHOWN.positions).square().mean())
    theirs = slow()
    note = f"MSE {error:.3g} against {theirs:.3g}"
    return [
        race("fit, M = 300, N = 1000, bounded scalar search", 30, slow, fast, max(3, rounds // 4)),
        at_most("fit, MSE over that of the bounded search", error / theirs, 1, unit="ratio", note=note),
    ]


def sdsef_step(rounds: int) -> list[Goal]:
    ds = SDSEF(3, n_layers=10, n_features=150, seed=0).float()
    psi, log_speed = ds.diffeomorphism, ds.dynamics.log_speed
    with torch.no_grad():
        for parameter in psi.parameters():
            parameter.copy_(0.01 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)))
    points, wanted = SHOWN.positions.float(), SHOWN.velocities.float()
    compiled = psi.compiled_linearize()
    optimizer = torch.optim.Adam(ds.parameters(), lr=0.0)

    def heading(x: Tensor) -> Tensor:
        z = x - x[-1]
        return z / z.norm(dim=-1, keepdim=True).clamp(min=1e-6)

    def back_sweep() -> Tensor:
        x, push = compiled(points)
        return push(heading(x))

    def inverted() -> Tensor:
        u = points.clone().requires_grad_()
        x = psi.inverse(u)
        rows = [torch.autograd.grad(x[:, i].sum(), u, create_graph=True)[0] for i in range(3)]
        return torch.linalg.solve(torch.stack(rows, dim=1), heading(x).unsqueeze(-1)).squeeze(-1)

    def step(direction: Callable[[], Tensor]) -> Tensor:
        optimizer.zero_grad()
        loss = nn.functional.smooth_l1_loss(-log_speed(points).exp().unsqueeze(-1) * direction(), wanted)
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        return torch.cat([p.grad.flatten() for p in psi.parameters() if p.grad is not None])

    with torch.enable_grad():
        torch.testing.assert_close(step(back_sweep), step(inverted), rtol=1e-2, atol=1e-4)
        what = "SDS-EF training step, J by autograd and solve"
        return [race(what, 6, partial(step, inverted), partial(step, back_sweep), rounds)]


def one_point(what: str, ds: LatentDS, rounds: int) -> Goal:
    times = take_turns({"ds(y)": partial(ds, SHOWN.positions[400])}, rounds)
    return report.median(what, "µs", 60, 1e6 * times["ds(y)"], at_most=True)


def rivals(ds: ChebyshevDS, rounds: int) -> list[Goal]:
    """torch.func for the Jacobian of a decoded point, and a public library's coupling flow of as many layers."""
    psi, x = ds.diffeomorphism, latent_points(ds, 1000)
    goals = []
    for derivative in (torch.func.jacrev, torch.func.jacfwd):
        slow = partial(torch.func.vmap(derivative(ds.decode)), x)
        torch.testing.assert_close(psi.jacobian(x), slow())
        what = f"Jacobian of decode at 1000 points, torch.func.{derivative.__name__}"
        goals.append(race(what, 1, slow, partial(psi.jacobian, x), max(3, rounds // 4)))
    try:
        flows = importlib.import_module("zuko.flows")
    except ImportError:
        print("Coupling flows of zuko are not compared: pip install zuko.")
        return goals
    theirs = flows.RealNVP(3, transforms=10, hidden_features=(200,)).double()().transform
    ours = SDSEF(3, n_layers=10, n_features=200, seed=0).diffeomorphism
    what = "10 couplings of 200 features at 1000 points, RealNVP of zuko"
    return [*goals, race(what, 1, partial(theirs, x), partial(ours, x), rounds)]


def growth(quick: bool) -> pd.DataFrame:
    """Seconds of each call as N or M grows."""
    rows = []

    def measure(grows: str, size: int, calls: Mapping[str, Callable[[], Any]], rounds: int) -> None:
        for call, seconds in take_turns(calls, rounds).items():
            rows.append((grows, call, size, float(np.median(seconds))))

    ds = ChebyshevDS(3, n_layers=N_LAYERS).fit(SHOWN)
    for count in (10**power for power in range(6 if quick else 7)):
        x = latent_points(ds, count)
        y = ds.decode(x)
        calls = {"decode": partial(ds.decode, x), "encode": partial(ds.encode, y), "velocity": partial(ds, y)}
        measure("N", count, calls, 5)
    for n_layers in (25, 50, 100, 200, 400, 800):
        ds = ChebyshevDS(3, n_layers=n_layers).fit(SHOWN)
        y = ds.decode(latent_points(ds, 10_000))
        measure("M", n_layers, {"velocity": partial(ds, y), "fit": partial(ds.fit, SHOWN)}, 3)
    for count in (125, 250, 500, 1000, 2000, 4000, 8000):
        shown = datasets.unstable_spiral(7, count)
        line, positions = ChebyshevDS.latent_line(shown), shown.positions.numpy()
        measure("N", count, {"match": partial(match, line, positions, N_LAYERS, 0.5, 0.9)}, 5)
    return pd.DataFrame(rows, columns=["grows", "call", "size", "seconds"])


def exponents(curves: pd.DataFrame) -> pd.DataFrame:
    """Of seconds ∝ size^p between the largest size and one about eight times smaller."""
    rows = []
    for (grows, call), curve in curves.groupby(["grows", "call"]):
        last = curve.iloc[-1]
        first = curve[curve["size"] <= last["size"] / 8].iloc[-1]
        power = math.log(last["seconds"] / first["seconds"]) / math.log(last["size"] / first["size"])
        rows.append((grows, call, int(first["size"]), int(last["size"]), power))
    return pd.DataFrame(rows, columns=["grows", "call", "from", "to", "exponent"])


def draw_growth(curves: pd.DataFrame) -> Figure:
    """Seconds of each call over points N and layers M, on log scales; columns grows, call, size and seconds."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    for axis, (grows, label) in zip(figure.subplots(1, 2), (("N", "points N"), ("M", "layers M")), strict=True):
        for call, curve in curves[curves["grows"] == grows].groupby("call"):
            axis.loglog(curve["size"], curve["seconds"], "o-", label=call, markersize=3)
        axis.set(xlabel=label, ylabel="seconds")
        axis.xaxis.set_minor_formatter("")
        axis.grid(alpha=0.3)
        axis.legend(frameon=False)
    return figure


def main(
    quick: Annotated[bool, typer.Option(help="Fewer rounds, a tenth of the sizes, no export: a minute.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for tables, curves and the picture.")] = Path("results/speed"),
) -> None:
    """Measure every public call against a torch loop and a measured floor, on one core; then what needs more."""
    torch.set_num_threads(1)
    torch.set_grad_enabled(False)
    console, rounds = Console(), 9 if quick else 41
    kernels.warmup([3])
    ds = ChebyshevDS(3, n_layers=N_LAYERS).fit(SHOWN)
    goals = [
        *against_floor(ds, rounds),
        *against_loop(ds, rounds),
        one_point(f"ds(y) of one point, M = {N_LAYERS}", ds, rounds),
        one_point("SDS-EF, L = 10, F = 200, ds(y) of one point", SDSEF(3, seed=0, epochs=2).fit(SHOWN), rounds),
        *control_loop(2000 if quick else 20_000),
        *rollouts(ds, rounds),
        *gradients(rounds),
        *fits(rounds),
        *sdsef_step(rounds),
        *rivals(ds, rounds),
        *scale.measure(quick),
    ]
    outside = [] if quick else deployed.measure(quick)
    curves = growth(quick)
    load = f"Load average while it ran: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores."
    powers = [(*map(str, row[:-1]), f"{row[-1]:.2f}") for row in exponents(curves).itertuples(index=False)]
    growth_table = report.table(("grows", "call", "from", "to", "exponent of the time"), powers)
    tables = [report.goal_table(goals), growth_table, *([report.goal_table(outside)] if outside else [])]
    summary = "\n\n".join([load, *tables])
    out.mkdir(parents=True, exist_ok=True)
    report.write(out / "goals.csv", pd.DataFrame([*goals, *outside]).to_csv(index=False))
    report.write(out / "growth.csv", curves.to_csv(index=False))
    report.write(out / "summary.md", summary + "\n")
    report.write(out / "environment.json", report.environment())
    draw_growth(curves).savefig(out / "growth.png", dpi=150)
    console.print(Markdown(summary))
    console.print(f"{out}: summary.md, goals.csv, growth.csv, growth.png, environment.json")


if __name__ == "__main__":
    typer.run(main)
