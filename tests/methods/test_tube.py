"""TubeDS: motions that are hard to learn from, several at once, far starts, units, depth and its report."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from latentds import Demonstration, datasets
from latentds.fitting.average import mean_motion
from latentds.methods.tube import TubeDS
from latentds.metrics import dtw
from latentds.testing import wavy_motion
from tests.motions import creep_then_dash, motion, pause, planar_spiral, rest_at_both_ends, rest_first, tensor


def fast(dim, **settings):
    return TubeDS(dim, **{"n_layers": 60, "refined": False} | settings)


def rolled(ds, shown, start=None):
    with torch.no_grad():
        return ds.rollout(shown.start if start is None else start, shown.times)


# --- hard demonstrations ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("clock", [rest_first, pause, rest_at_both_ends, creep_then_dash])
def test_position_at_time_t_is_the_demonstrations(clock):
    shown = motion(clock)
    ds = fast(2).fit(shown)
    path = rolled(ds, shown)
    missed = (path - shown.positions).norm(dim=-1) / shown.size
    assert missed.max() < 0.03
    assert missed.mean() < 0.006
    assert dtw(path, shown.positions) / len(shown) < 0.003 * shown.size


@pytest.mark.slow
def test_seven_joints():
    shown = wavy_motion(7, n_points=400)
    ds = fast(7, refined=True).fit(shown)
    assert dtw(rolled(ds, shown), shown.positions) / len(shown) < 0.003 * shown.size
    assert ds.fit_report.condition_path <= ds.fit_report.condition_tube < 30


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
@pytest.mark.parametrize("n_layers", [5, 60])
def test_the_attractor_is_exact(dim, n_layers):
    shown = wavy_motion(dim)
    ds = fast(dim, n_layers=n_layers).fit(shown)
    assert torch.equal(ds.attractor, shown.goal)
    with torch.no_grad():
        assert ds(shown.goal).norm() < 1e-9 * shown.size
        late = ds.rollout(shown.start + 0.1, tensor([0.0, 40 * shown.duration]))[-1]
    assert (late - shown.goal).norm() < 1e-9 * shown.size


@pytest.mark.parametrize("n_layers", [1, 5])
def test_few_layers_are_still_a_stable_system(n_layers):
    """Too few to follow the motion, so the start is where it must begin and the goal where it must end."""
    shown = motion(lambda t: t)
    ds = fast(2, n_layers=n_layers).fit(shown)
    path = rolled(ds, shown)
    assert torch.equal(path[0], shown.start)
    assert (path[-1] - shown.goal).norm() < 0.05 * shown.size
    assert ds.fit_report.n_layers == n_layers


def closed_loop():
    t = np.linspace(0, 2 * np.pi, 300)
    return np.stack([np.cos(t), np.sin(t)], 1)


def figure_of_alpha():
    t = np.linspace(-1.4, 1.4, 300)
    return np.stack([t**2, t**3 - t], 1)


@pytest.mark.parametrize("positions", [closed_loop(), figure_of_alpha()], ids=["closed loop", "crossing"])
def test_a_path_that_meets_itself_is_refused(positions):
    with pytest.raises(ValueError, match=r"demonstration: expected a path that does not meet itself.*one velocity"):
        fast(2).fit(Demonstration(positions, 0.01))


def test_a_path_that_passes_itself_at_a_distance_is_learned():
    """The same crossing, its strands 0.4 apart in the third dimension."""
    flat = figure_of_alpha()
    shown = Demonstration(np.column_stack([flat, np.linspace(0, 0.6, len(flat))]), 0.01)
    ds = fast(3, n_layers=100).fit(shown)
    assert dtw(rolled(ds, shown), shown.positions) / len(shown) < 0.003 * shown.size


@pytest.mark.parametrize(("gap", "meets"), [(1e-9, True), (1e-4, False)])
def test_strands_meet_when_nearer_than_a_robot_could_tell(gap, meets):
    """An eight in space whose strands pass each other at a distance, told in the demonstration's own coordinates."""
    t = np.linspace(-0.5, 2 * np.pi - 1.2, 400)
    eight = np.stack([np.sin(t), np.sin(2 * t) / 2, gap * (t - np.pi) / np.pi], 1)
    shown = Demonstration(1000 * eight + np.array([7000.0, 0, 0]), 0.01)
    if meets:
        with pytest.raises(ValueError, match=r"comes back to \[69\d\d, -?\d"):
            fast(3).fit(shown)
    else:
        assert fast(3).fit(shown).fit_report is not None


def test_noise_is_no_crossing():
    shown = motion(pause)
    noise = 3e-4 * tensor(np.random.default_rng(0).standard_normal((400, 2)))
    noisy = Demonstration(shown.positions + noise, shown.dt)
    ds = fast(2).fit(noisy)
    assert dtw(rolled(ds, shown), shown.positions) / len(shown) < 0.005 * shown.size


# --- far away ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3, 7])
def test_far_starts_and_starts_behind_the_goal_arrive_without_wild_speeds(dim, draw):
    shown = wavy_motion(dim)
    ds = fast(dim).fit(shown)
    scale = shown.size * torch.tensor([0.3, 1.0, 3.0, 10.0], dtype=torch.float64).repeat_interleave(8)
    around = torch.nn.functional.normalize(torch.randn(32, dim, generator=draw, dtype=torch.float64), dim=-1)
    behind = shown.goal + (shown.goal - shown.start) * tensor([[0.5], [2.0], [10.0]])
    starts = torch.cat([shown.goal + scale[:, None] * around, behind])
    times = torch.linspace(0, 40 * shown.duration, 4001, dtype=torch.float64)
    with torch.no_grad():
        path = ds.rollout(starts, times)
        speeds = ds(path).norm(dim=-1).amax(dim=-1)
    assert ((path[:, -1] - shown.goal).norm(dim=-1) < 1e-3 * shown.size).all()
    pull = 0.25 * ds.fit_report.contraction * shown.size / shown.duration  # as fast as it may come in from the side
    most = shown.velocities.norm(dim=-1).max() + pull
    assert speeds.max() < 3 * ds.fit_report.condition_tube * most


def test_far_from_the_axis_the_pull_stops_growing():
    """An unfitted map is the identity: what is left of the velocity across the path is the pull alone."""
    shown = Demonstration(torch.stack([torch.linspace(2, 0, 200), torch.zeros(200)], 1), 0.01)
    ds = TubeDS(2, contraction=10.0, refined=False).fit(shown)
    aside = tensor([0.1, 0.5, 5.0])[:, None] * shown.size * tensor([0.0, 1.0])
    with torch.no_grad():
        inward = -ds(shown.start / 2 + aside)[:, 1]
    wanted = tensor([0.1, 0.25, 0.25]) * shown.size * 10 / shown.duration
    torch.testing.assert_close(inward, wanted, rtol=1e-6, atol=0)


@pytest.mark.parametrize("kappa", [5.0, 20.0, 80.0])
def test_a_start_off_the_path_is_back_within_three_over_kappa(kappa):
    shown = datasets.unstable_spiral(3)
    aside = torch.cat([tensor([[0.05, 0.05, 0.0]]), 0.07 * torch.eye(3, dtype=torch.float64)])
    ds = TubeDS(3, contraction=kappa, refined=False).fit(shown)
    with torch.no_grad():
        paths = ds.rollout(shown.start + aside, tensor([0, 1, 3]) * shown.duration / kappa)
    away = torch.cdist(paths, datasets.unstable_spiral(3, 20_000).positions).amin(-1)
    # e^-1 and e^-3 of it, were the tube straight
    assert (away[:, 1] < 0.5 * away[:, 0]).all()
    assert (away[:, 2] < 0.1 * away[:, 0]).all()


@pytest.mark.parametrize("contraction", [0, -1, math.inf, math.nan, "much"])
def test_bad_contraction(contraction):
    with pytest.raises(ValueError, match="contraction: expected a number in "):
        TubeDS(2, contraction=contraction)


# --- several demonstrations -------------------------------------------------------------------------------------------


def family(count=5, *, end_apart=0.0, power=1):
    """One bend, wider and narrower, from starts in a row; each of another length. Offsets die as (1 - way)^power."""
    found = []
    for i, wide in enumerate(np.linspace(-1, 1, count)):
        way = np.linspace(0, 1, 300 + 20 * i)
        bend = np.stack(
            [1 - way, (0.3 + 0.1 * wide * (power == 1)) * np.sin(np.pi * way) + 0.15 * wide * (1 - way) ** power], 1
        )
        found.append(Demonstration(bend + end_apart * np.array([wide, 0]), 0.01, f"{i}"))
    return found


@pytest.fixture(scope="module")
def together():
    return fast(2).fit(family())


@pytest.fixture(scope="module")
def alone():
    return fast(2).fit(family()[0])


def test_several_are_followed_better_than_one(together, alone):
    shown = family()
    scores = np.array([[dtw(rolled(ds, d), d.positions) / len(d) for d in shown[1:]] for ds in (together, alone)])
    assert scores[0].mean() < 0.7 * scores[1].mean()


def test_several_agree_on_a_goal_and_report_their_spread():
    shown = family(3, end_apart=0.02)
    ds = fast(2).fit(shown)
    goals = torch.stack([d.goal for d in shown])
    torch.testing.assert_close(ds.attractor, goals.mean(0))
    assert len(ds.fit_report.spread) == 2
    assert ds.fit_report.spread[1] > 0.03
    assert ds.fit_report.spread[1] > 2 * ds.fit_report.spread[0]


def test_mean_of_equal_ones_is_each_of_them():
    shown = family()[0]
    mean, strands, _ = mean_motion([shown] * 3)
    torch.testing.assert_close(mean.positions, shown.positions, rtol=0, atol=1e-3)
    assert mean.dt == pytest.approx(shown.dt)
    assert strands.std(0).max() < 1e-12
    alone, strands, _ = mean_motion([shown])
    assert alone == shown
    assert len(strands) == 1


def test_the_mean_does_not_smear_a_corner_that_all_took_at_another_time():
    """One pauses before a corner, one behind it: at equal times their mean cuts it, at equal progress it does not."""
    corner = np.concatenate([np.linspace([0, 1], [1, 1], 200), np.linspace([1, 1], [1, 0], 200)[1:]])
    early, late = np.linspace(0, 1, 400) ** 2, np.linspace(0, 1, 400) ** 0.5
    shown = [
        Demonstration(np.stack([np.interp(pace, np.linspace(0, 1, 399), c) for c in corner.T], 1), 0.01)
        for pace in (early, late)
    ]
    mean = mean_motion(shown)[0].positions
    assert torch.linalg.vector_norm(mean - tensor([1.0, 1.0]), dim=1).min() < 0.02


# --- beside the path --------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_several_make_the_map_near_isometric_across_the_path():
    """Points at a distance from the path encode to that distance from the axis, in the scale of the axis."""
    shown = family(3)
    ds = TubeDS(2, n_layers=80).fit(shown)
    mean = mean_motion(shown)[0]
    path, tangents = mean.positions[30:-30:10], torch.nn.functional.normalize(mean.velocities[30:-30:10], dim=-1)
    across = torch.stack([-tangents[:, 1], tangents[:, 0]], dim=1)
    length = torch.linalg.vector_norm(mean.positions.diff(dim=0), dim=-1).sum()
    for distance in (0.02 * mean.size, -0.05 * mean.size):
        with torch.no_grad():
            x, frame = ds.encode(path + distance * across), ds.frame()
        offset = x - frame.attractor
        aside = (offset - (offset @ frame.axis).unsqueeze(-1) * frame.axis).norm(dim=-1)
        ratio = aside / abs(distance) * length / frame.length
        assert ratio.min() > 0.75
        assert ratio.max() < 1.33


def test_the_contraction_is_read_unless_it_is_asked_for(together, alone):
    asked = fast(2, contraction=9.0).fit(family(2))
    assert 1 <= together.fit_report.contraction < 9
    assert asked.fit_report.contraction == 9
    assert together.contraction is None
    assert alone.fit_report.contraction == 20
    assert fast(2).fit(family(power=12)).fit_report.contraction > together.fit_report.contraction


def test_each_of_several_keeps_its_own_time(together):
    shown, ds = family(), together
    with torch.no_grad():
        left = ds.dynamics.law.time_to_go(
            ds.dynamics.phase(ds.encode(torch.stack([d.start for d in shown])), ds.frame())
        )
    mean = np.mean([d.duration for d in shown])
    assert abs(left.mean() - mean) < 0.1 * mean


# --- units, types, report ---------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-3, 1e3])
@pytest.mark.parametrize("refined", [False, True])
def test_units_and_origin_do_not_matter(scale, refined):
    """Metres or millimetres, wherever the origin lies."""
    shown, shift = motion(pause), tensor([7.0, -2.0])
    here = fast(2, refined=refined).fit(shown)
    there = fast(2, refined=refined).fit(Demonstration(scale * (shown.positions + shift), shown.dt))
    start = shown.start + tensor([0.03, 0.05])
    moved = rolled(there, shown, scale * (start + shift)) / scale - shift
    assert (moved - rolled(here, shown, start)).norm(dim=-1).max() < 1e-9 * shown.size
    assert here.fit_report.homotopy == there.fit_report.homotopy


def test_a_slower_clock_slows_everything():
    shown = motion(pause)
    slow = Demonstration(shown.positions, 10 * shown.dt)
    here, there = fast(2).fit(shown), fast(2).fit(slow)
    y = shown.positions[::40] + 0.02
    with torch.no_grad():
        torch.testing.assert_close(there(y) * 10, here(y), rtol=1e-6, atol=1e-9)


def test_a_float32_module():
    shown = motion(pause)
    ds = fast(2).float().fit(shown)
    assert {t.dtype for t in ds.state_dict().values()} == {torch.float32}
    path = rolled(ds, shown)
    assert path.dtype == torch.float64  # the input's
    assert dtw(path, shown.positions) / len(shown) < 0.003 * shown.size
    torch.testing.assert_close(path, rolled(fast(2).fit(shown), shown), rtol=0, atol=1e-3)


def test_report_agrees_with_autograd():
    shown = motion(lambda t: t)
    ds = fast(2).fit(shown)
    report = ds.fit_report
    rows = torch.func.vmap(torch.func.jacrev(ds.diffeomorphism))(ds.encode(shown.positions))
    assert report.condition_path == pytest.approx(torch.linalg.cond(rows.detach()).max().item(), rel=0.05)
    with torch.no_grad():
        on_path = ds(shown.positions)
        step = 1e-6 * torch.eye(2, dtype=torch.float64)
        y = shown.positions[:, None]
        slopes = torch.linalg.matrix_norm((ds(y + step) - ds(y - step)) / 2e-6, 2).max() * shown.duration
    length = float(shown.positions.diff(dim=0).norm(dim=-1).sum())
    assert report.largest_velocity >= on_path.norm(dim=-1).max() * shown.duration / length * 0.99
    assert report.largest_gradient >= 0.9 * slopes
    assert report.homotopy in ("linear", "curvature")
    assert 0 <= report.rollout_error < 0.01


@pytest.mark.parametrize("n_layers", [3, 60])
def test_rollout_error_is_the_distance_of_the_rollout(n_layers):
    """At a constant speed equal progress is equal time."""
    angle = torch.linspace(0, 3, 600, dtype=torch.float64)
    shown = Demonstration(torch.stack([angle.cos(), angle.sin()], 1), 0.01)
    ds = fast(2, n_layers=n_layers).fit(shown)
    distance = (rolled(ds, shown) - shown.positions).norm(dim=-1).mean() / shown.size
    assert ds.fit_report.rollout_error == pytest.approx(float(distance), rel=0.05, abs=1e-5)
    assert ds.fit_report.rollout_error > 1e-7


@pytest.mark.parametrize("homotopy", ["linear", "curvature"])
def test_one_homotopy_alone(homotopy):
    ds = TubeDS(2, n_layers=20, refined=False, homotopy=homotopy).fit(motion(lambda t: t))
    assert ds.fit_report.homotopy == homotopy
    assert ds.settings["homotopy"] == homotopy


@pytest.mark.parametrize(("dim", "homotopy"), [(2, "straight"), (2, None), (1, "curvature")])
def test_another_homotopy_is_refused(dim, homotopy):
    with pytest.raises(ValueError, match=r"^homotopy: expected one of \('linear'"):
        TubeDS(dim, homotopy=homotopy)


@pytest.mark.slow
def test_refinement_pays():
    shown = datasets.unstable_spiral(7, 300)
    plain, better = (TubeDS(3, n_layers=60, refined=refined).fit(shown) for refined in (False, True))
    scores = [dtw(rolled(ds, shown), shown.positions) for ds in (plain, better)]
    assert scores[1] < 0.7 * scores[0]


# --- the depth that follows from the motion ---------------------------------------------------------------------------


def follows(ds, shown):
    return dtw(rolled(ds, shown), shown.positions) / len(shown) < 0.005 * shown.size


@pytest.mark.slow
@pytest.mark.parametrize("turns", [1.5, 3])
def test_a_planar_spiral_takes_as_many_layers_as_it_needs(turns):
    shown = planar_spiral(turns)
    ds = TubeDS(2).fit(shown)
    assert ds.n_layers is None
    assert ds.fit_report.n_layers == ds.diffeomorphism.n_layers > 300
    assert follows(ds, shown)
    told = any(note.startswith("its map stretches space unevenly") for note in ds.fit_report.notes)
    assert told == (ds.fit_report.condition_path > 1000)


@pytest.mark.slow
def test_strands_a_hair_apart_are_tracked():
    t = np.linspace(0.1, 0.1 + 2 * np.pi * 0.97, 600)
    shown = Demonstration(np.stack([np.cos(t), np.sin(2 * t), 1e-3 * np.sin(t)], 1), 0.01)
    ds = TubeDS(3).fit(shown)
    assert follows(ds, shown)
    off = [words for badness, words in ds.fit_report.fidelity.findings if badness > 1]
    assert all("as fast as shown from where" in words for words in off)  # a start beside it may be swept along


def test_an_easy_motion_takes_300_layers_and_what_is_asked_for_is_kept(tmp_path):
    shown = motion(lambda t: t)
    chosen, forced = (TubeDS(2, refined=False, **more).fit(shown) for more in ({}, {"n_layers": 300}))
    assert torch.equal(rolled(chosen, shown), rolled(forced, shown))
    assert chosen.fit_report.n_layers == 300
    fresh = TubeDS(2, refined=False)
    fresh.load_state_dict(chosen.state_dict())
    assert torch.equal(rolled(fresh, shown), rolled(chosen, shown))
    assert TubeDS(2, n_layers=20, refined=False).fit(shown).diffeomorphism.n_layers == 20
