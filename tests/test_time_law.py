"""The time laws' closed-form flow against an ODE solver and against quadrature."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.integrate import quad, solve_ivp
from scipy.ndimage import gaussian_filter1d

from latentds.dynamics import Frame, RayDynamics
from latentds.tabulated import LINEAR_BELOW
from latentds.time_law import ChebyshevLaw, KnottedLaw
from tests.motions import tensor


def random_law(seed, n_knots):
    draw = np.random.default_rng(seed)
    knots = np.sort(draw.uniform(LINEAR_BELOW, 1.5, n_knots))
    return KnottedLaw(torch.from_numpy(knots), torch.from_numpy(np.exp(draw.uniform(-3, 2, n_knots))))


LAWS = {
    "chebyshev": ChebyshevLaw(2.5),
    "uniform": KnottedLaw.uniform(2.5),
    "one knot": random_law(0, 1),
    "five knots": random_law(1, 5),
    "sixty knots": random_law(2, 60),
    "flat": KnottedLaw(torch.tensor([0.1, 0.5, 0.9]), torch.tensor([2.0, 2.0, 2.0])),
    "nearly flat": KnottedLaw(torch.tensor([0.1, 0.5, 0.9]), torch.tensor([2.0, 2.0 + 1e-9, 2.0])),
}


@pytest.fixture(params=LAWS.values(), ids=LAWS.keys())
def law(request):
    return request.param


def progress(low=1e-6, high=3.0, count=200):
    return torch.logspace(np.log10(low), np.log10(high), count, dtype=torch.float64)


def test_speed_is_positive_and_zero_at_the_goal(law):
    assert (law.speed(progress()) > 0).all()
    assert law.speed(torch.zeros(1, dtype=torch.float64)).item() == 0


def test_speed_is_continuous(law):
    s = torch.linspace(0, 2, 400_001, dtype=torch.float64)
    assert law.speed(s).diff().abs().max() < 6e-3 * law.speed(s).max()


def test_time_to_go_is_the_integral_of_one_over_speed(law):
    edges = sorted({LINEAR_BELOW, 1.0, *(law.table().pieces()[0] if isinstance(law, KnottedLaw) else ())})
    for low, high in [(2e-4, 8e-4), (LINEAR_BELOW, 0.01), (0.05, 0.9), (0.5, 2.5)]:
        inner = [edge for edge in edges if low < edge < high]
        points = [low, *inner, high]
        seconds = sum(
            quad(lambda s: 1 / law.speed(torch.tensor([s], dtype=torch.float64)).item(), a, b, epsrel=1e-10)[0]
            for a, b in pairwise(points)
        )
        taken = law.time_to_go(torch.tensor([low, high], dtype=torch.float64)).diff().item()
        assert taken == pytest.approx(seconds, rel=1e-8)


def test_progress_at_inverts_time_to_go(law):
    s = progress()
    time = law.time_to_go(s)
    assert (time.diff() > 0).all()
    torch.testing.assert_close(law.progress_at(time), s, rtol=1e-9, atol=0)


def test_flow_agrees_with_solve_ivp(law):
    times = np.linspace(0, 2.0, 9)
    starts = np.array([2e-4, 0.3, 1.0, 1.7])
    fine = {"rtol": 1e-11, "atol": 1e-13, "max_step": 1e-3}  # at its knots the law is C1 alone: long steps miss that
    solved = solve_ivp(lambda _, s: -law.speed(torch.from_numpy(s)).numpy(), (0, 2.0), starts, "DOP853", times, **fine)
    progress = law.progress_at(law.time_to_go(torch.from_numpy(starts)).unsqueeze(-1) - torch.from_numpy(times))
    assert np.abs(progress.numpy() - solved.y).max() < 1e-7


EXTREME = {
    "rests": ([0.1, 0.2, 0.3, 0.4], [10, 1e-6, 1e-6, 10]),
    "uneven gaps": ([0.1, 0.5, 0.501, 0.9, 1], [10, 1e-6, 10, 1e-6, 1e-6]),
    "falls and falls": ([0.1, 0.2, 0.3], [10, 1e-6, 1e-13]),
    "almost straight": ([0.1, 0.2, 0.3], [1e-6, 5, 10 - 1e-9]),
    "slow above": ([0.1, 0.3, 1.0], [3, 1e-3, 1e-4]),
}
KNOTTED = {name: law for name, law in LAWS.items() if isinstance(law, KnottedLaw)} | {
    name: KnottedLaw(*map(tensor, numbers)) for name, numbers in EXTREME.items()
}


@pytest.fixture(params=KNOTTED.values(), ids=KNOTTED.keys())
def knotted(request):
    return request.param


def test_the_slope_is_continuous_where_pieces_meet(knotted):
    """By difference quotients on either side, so short that a quadratic piece cannot bend as far as a corner would."""
    knots = torch.cat([tensor([0.0]), knotted.knots])
    speeds = torch.cat([tensor([0.0]), knotted.speeds])
    steepest, gap = float((speeds.diff() / knots.diff()).abs().max()), float(knots.diff().min())
    rounds = torch.cat([knots.diff(), knots[-1:] - knots[-2:-1]]) / 2
    half = torch.minimum(rounds[:-1], rounds[1:])
    for place in (knotted.knots - half, knotted.knots, knotted.knots + half):
        step = 1e-4 * gap
        below, at, above = knotted.speed(torch.stack([place - step, place, place + step]))
        assert float((above - 2 * at + below).abs().max()) / step < 1e-3 * steepest


def test_speed_stays_between_its_neighbours_on_the_polygon(knotted):
    s = torch.linspace(1e-3, 1.6, 20_001, dtype=torch.float64)
    knots = np.concatenate([[0.0], knotted.knots.numpy(), [100.0]])
    speeds = np.concatenate([[0.0], knotted.speeds.numpy(), knotted.speeds[-1:].numpy()])
    polygon, index = np.interp(s.numpy(), knots, speeds), np.searchsorted(knots, s.numpy())
    near = np.stack([speeds[np.clip(index + by, 0, len(speeds) - 1)] for by in (-2, -1, 0, 1)] + [polygon])
    speed = knotted.speed(s).numpy()
    assert (speed > 0).all()
    assert (near.min(0) - 1e-12 <= speed).all()
    assert (speed <= near.max(0) + 1e-12).all()


def test_extreme_laws_come_back_to_where_they_were(knotted):
    s = torch.cat([progress(), knotted.knots, tensor(knotted.table().pieces()[0, 1:])]).sort().values
    time = knotted.time_to_go(s)
    torch.testing.assert_close(knotted.progress_at(time), s, rtol=1e-12, atol=1e-12)


def test_the_rate_bound_is_the_least_of_a_dense_scan(knotted):
    for reach in (0.05, 0.25, 0.77, 3.0):
        s = torch.linspace(0, reach, 300_001, dtype=torch.float64)[1:]
        least, bound = float((knotted.speed(s) / s).min()), knotted.convergence_rate_bound(reach)
        assert bound <= least * (1 + 1e-12)
        assert bound == pytest.approx(least, rel=1e-3)


def test_gradients_by_knots_and_speeds():
    given = [tensor([0.1, 0.25, 0.6, 1.0]), tensor([0.4, 1.5, 0.3, 0.9])]
    s = tensor([0.02, 0.08, 0.2, 0.31, 0.5, 0.77, 1.05, 1.5])

    def flow(s, knots, speeds):
        law = KnottedLaw.uniform()
        law.knots, law.speeds = knots, speeds
        time = law.time_to_go(s)
        return law.speed(s), time, law.progress_at(time - 0.1)

    assert torch.autograd.gradcheck(flow, [value.clone().requires_grad_() for value in (s, *given)])


def test_law_needs_its_duration():
    """From the start to the edge of the tail; the tail takes what is left."""
    assert ChebyshevLaw(3.0).time_to_go(torch.ones(1, dtype=torch.float64)).item() == pytest.approx(3.0, rel=0.03)
    uniform = KnottedLaw.uniform(3.0).time_to_go(torch.ones(1, dtype=torch.float64)).item()
    assert uniform == pytest.approx(3.0, rel=LINEAR_BELOW)


def test_gradients_of_the_flow(law):
    s = torch.tensor([5e-4, 0.02, 0.33, 0.77, 1.2], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: law.progress_at(law.time_to_go(s) - 0.05), (s,))
    assert torch.autograd.gradcheck(law.speed, (s,))


def test_a_law_with_other_knots_loads(law):
    """A fit may choose how many knots; a fresh law takes them."""
    fresh = ChebyshevLaw() if isinstance(law, ChebyshevLaw) else KnottedLaw.uniform()
    fresh.load_state_dict(law.state_dict())
    assert torch.equal(fresh.speed(progress()), law.speed(progress()))


def test_a_law_that_breaks_its_own_rules_does_not_load():
    state = {"knots": torch.tensor([0.5, 0.2]), "speeds": torch.tensor([1.0, 1.0])}
    with pytest.raises(RuntimeError, match="knots"):
        KnottedLaw.uniform().load_state_dict(state)


@pytest.mark.parametrize("dim", [1, 3])
def test_rays_go_straight_to_the_goal(law, dim, draw):
    dynamics = RayDynamics(law)
    goal, start = torch.randn(2, dim, generator=draw, dtype=torch.float64)
    frame = Frame.between(start, goal)
    x = goal + torch.randn(6, dim, generator=draw, dtype=torch.float64)
    times = torch.linspace(0, 1, 5, dtype=torch.float64)
    path = dynamics.flow(x, times, frame)
    torch.testing.assert_close(path[:, 0], x, rtol=1e-12, atol=1e-12)
    share = (path - goal).norm(dim=-1, keepdim=True) / (x - goal).norm(dim=-1, keepdim=True).unsqueeze(1)
    torch.testing.assert_close(path - goal, share * (x - goal).unsqueeze(1), rtol=0, atol=1e-12)
    assert (dynamics.lyapunov(path, frame).diff(dim=-1) < 0).all()
    solved = solve_ivp(
        lambda _, x: dynamics(torch.from_numpy(x).view(6, dim), torch.zeros(6, dim), frame).reshape(-1).numpy(),
        (0, 1),
        x.numpy().ravel(),
        "LSODA",
        times.numpy(),
        rtol=1e-9,
        atol=1e-12,
    )
    assert np.abs(solved.y.T.reshape(5, 6, dim).swapaxes(0, 1) - path.numpy()).max() < 1e-6
    assert (dynamics(goal, goal, frame) == 0).all()
    torch.testing.assert_close(dynamics.flow(goal, times, frame), goal.expand(5, dim), rtol=0, atol=0)


@pytest.mark.parametrize("value", [0, -1.0, float("nan"), float("inf"), "long", None])
def test_bad_duration(value):
    with pytest.raises(ValueError, match=r"duration: expected a (finite )?number > 0"):
        ChebyshevLaw(value)
    with pytest.raises(ValueError, match=r"duration: expected a (finite )?number > 0"):
        KnottedLaw.uniform(value)


@pytest.mark.parametrize(
    ("knots", "speeds", "name"),
    [
        ([], [], "knots"),
        ([0.0, 1.0], [1.0, 1.0], "knots"),
        ([0.5, 0.5], [1.0, 1.0], "knots"),
        ([0.5, float("nan")], [1.0, 1.0], "knots"),
        ([0.5, float("inf")], [1.0, 1.0], "knots"),
        ([0.1, 0.5], [1.0], "speeds"),
        ([0.1, 0.5], [1.0, 0.0], "speeds"),
        ([0.1, 0.5], [1.0, float("inf")], "speeds"),
    ],
)
def test_bad_knots(knots, speeds, name):
    with pytest.raises(ValueError, match=f"{name}: expected"):
        KnottedLaw(knots, speeds)


TIMINGS = {
    "even": (np.linspace(1, 0, 200), np.linspace(0, 2, 200)),
    "slow start": (1 - np.linspace(0, 1, 200) ** 3, np.linspace(0, 2, 200)),
    "pause": (np.array([1, 0.8, 0.6, 0.59, 0.3, 0.0]), np.array([0, 0.2, 0.4, 1.9, 2.2, 2.5])),
    "rest at the start": (np.array([1, 0.999, 0.5, 0.0]), np.array([0, 3.0, 3.5, 4.0])),
    "two points": (np.array([1.0, 0.0]), np.array([0.0, 0.7])),
    "milliseconds": (np.linspace(1, 0, 200), np.linspace(0, 2e-3, 200)),
}


@pytest.mark.parametrize(("progress", "times"), TIMINGS.values(), ids=TIMINGS.keys())
def test_a_law_takes_the_demonstrated_time(progress, times):
    law = KnottedLaw.from_timing(tensor(progress), tensor(times))
    left = law.time_to_go(torch.ones(1, dtype=torch.float64))
    s = law.progress_at(left - tensor(times))
    # a tail of 1e-3 is all that is missing at the end
    assert np.abs(s.numpy() - progress).max() < 0.02
    spent = (left - law.time_to_go(tensor(np.maximum(progress, 2e-3)))).numpy()
    assert np.abs(spent - times)[:-1].max() < 0.01 * times[-1]


@pytest.mark.parametrize(("progress", "times"), TIMINGS.values(), ids=TIMINGS.keys())
def test_knots_are_reached_when_shown(progress, times):
    law = KnottedLaw.from_timing(tensor(progress), tensor(times))
    knots = law.knots[:-1]
    taken = law.time_to_go(knots[-1]) - law.time_to_go(knots)
    assert np.abs(taken.numpy() - np.interp(-knots.numpy(), -progress, times)).max() < 1e-3 * times[-1]


def test_above_the_start_the_speed_becomes_the_mean():
    """What starts behind a rest is not held up by it."""
    progress, times = TIMINGS["rest at the start"]
    law = KnottedLaw.from_timing(tensor(progress), tensor(times))
    speed = law.speed(tensor([1.0, 1.031, 1.5, 10.0]))
    assert speed[0] < 0.1 * 0.25
    torch.testing.assert_close(speed[1:], torch.full((3,), 0.25, dtype=torch.float64))


def smooth_fall(start, count=400):
    """From ``start`` at rest to 0 at rest, evenly in time."""
    t = np.linspace(0, 1, count)
    return start * (1 - (10 * t**3 - 15 * t**4 + 6 * t**5))


def pooled(*progress, duration=3.0):
    times = np.linspace(0, duration, len(progress[0]))
    return KnottedLaw.pooled(np.stack(progress), np.stack([times] * len(progress)))


def test_equal_motions_keep_their_timing_when_pooled():
    law, times = pooled(smooth_fall(1.0), smooth_fall(1.0)), np.linspace(0, 3, 400)
    found = law.progress_at(law.time_to_go(tensor(1.0)) - tensor(times)).numpy()
    assert abs(found - smooth_fall(1.0)).max() < 0.06
    np.testing.assert_allclose(float(law.speeds.max()), 1.875 / 3, rtol=0.01)


def test_who_starts_behind_does_not_wait_where_others_stood():
    starts = (1.25, 1.0, 0.8)
    law = pooled(*map(smooth_fall, starts))
    takes = law.time_to_go(tensor(starts)) - law.time_to_go(tensor(0.01))
    assert 2.4 < float(takes[0]) < 3.3
    slow = pooled(*map(smooth_fall, starts), duration=3000.0)
    torch.testing.assert_close(1000 * slow.speeds, law.speeds, rtol=1e-9, atol=0)


@pytest.mark.parametrize("seed", range(5))
def test_no_place_is_faster_than_what_was_shown_there(seed):
    """However far apart they start, stop and hurry on the way."""
    draw, times = np.random.default_rng(seed), np.linspace(0, 3, 400)
    shown = []
    for start in 1 + 0.3 * draw.standard_normal(4):
        pace = np.clip(gaussian_filter1d(draw.standard_normal(400), 20), 0, None) + 1e-3
        passed = np.concatenate([[0], np.cumsum(pace)[:-1]])
        shown.append(max(start, 0.1) * (1 - passed / passed[-1]))
    law = KnottedLaw.pooled(np.stack(shown), np.stack([times] * 4))
    for s in np.linspace(0.05, 0.9 * max(one[0] for one in shown), 50):
        near = [abs(one[:-1] - s) < 0.06 for one in shown]  # within a few cells, over which the law is smoothed
        there = max(
            (float((-np.diff(one) / np.diff(times))[at].max()) for one, at in zip(shown, near, strict=True) if at.any())
        )
        assert float(law.speed(tensor(s))) <= 1.2 * there


def test_motions_that_never_move_on_still_make_a_law():
    law = pooled(np.full(100, 0.7), np.linspace(1, 0.9, 100))
    assert float(law.speeds.min()) > 0


def test_a_law_is_of_its_dtype_whatever_it_was_before():
    law = KnottedLaw(torch.tensor([0.25, 0.5]), torch.tensor([0.5, 1.0]))  # the same numbers in float32
    for dtype in (torch.float64, torch.float32, torch.float64):
        law.to(dtype)
        assert law.speed(torch.full((3,), 0.3, dtype=dtype)).dtype == dtype
    law.to("meta")
    for _ in range(2):
        assert law.speed(torch.zeros(3, device="meta", dtype=torch.float64)).is_meta
