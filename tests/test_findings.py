"""Each fault that is planted is found where it was planted and mended by its remedy; clean motions are silent."""

from __future__ import annotations

import time
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from latentds import ChebyshevDS, Demonstration, FitWarning, datasets
from latentds.findings import every_finding, findings
from latentds.testing import wavy_motion

SHARE = np.linspace(0, 1, 400)
EASED = SHARE**3 * (10 - 15 * SHARE + 6 * SHARE**2)
CLEAN = [
    *datasets.spiral_suite(),
    datasets.archimedean_spiral(),
    *(datasets.joint_motion(seed) for seed in range(4)),
    *(datasets.drawn(name) for name in datasets.STROKES),
    *(wavy_motion(dim, seed) for dim in (1, 2, 3, 7) for seed in range(3)),
]


def smooth() -> np.ndarray:
    return np.stack([EASED, 0.4 * np.sin(3 * SHARE), 0.3 * np.cos(2 * SHARE)], axis=1)


def named(points: np.ndarray, *columns: str) -> Demonstration:
    return Demonstration(points, 0.01, columns=columns or ("x", "y", "z"), origin="read")


def kinds(shown: Demonstration) -> list[str]:
    return [one.kind for one in shown.check()]


@pytest.mark.parametrize("motion", CLEAN, ids=str)
def test_clean_motions_are_silent(motion):
    assert str(motion.check()) == "nothing found that would hurt a fit"


@pytest.mark.parametrize("period", [2 * np.pi, 360.0])
@settings(max_examples=30)
@given(row=st.integers(30, 370))
def test_a_wrap_is_found_and_undone(period, row):
    angle = period * np.sin(0.8 * (SHARE - SHARE[row]) - 1e-4)
    points = np.stack([EASED, SHARE, angle % period], axis=1)
    found = [one for one in named(points).check() if one.kind == "wrap"]
    assert [(one.column, one.size) for one in found] == [(2, period)]
    assert abs(found[0].rows[0] - row) <= 1
    assert ".unwrapped(['z'])" in found[0].text
    mended = named(points).unwrapped()
    assert not [one for one in mended.check() if one.kind == "wrap"]
    assert np.allclose(np.diff(mended.positions[:, 2]), np.diff(angle))
    assert mended.origin.startswith("read; unwrapped z by")


@settings(max_examples=30)
@given(row=st.integers(20, 380))
def test_a_flip_is_found_and_undone(row):
    quaternion = np.stack([np.sin(SHARE), 0 * SHARE, 0 * SHARE, np.cos(SHARE)], axis=1)
    points = np.concatenate([smooth(), quaternion], axis=1)
    flipped = points.copy()
    flipped[row:, 3:] *= -1
    shown = named(flipped, "x", "y", "z", "qx", "qy", "qz", "qw")
    assert [(one.kind, one.rows, one.column) for one in shown.check()] == [("flip", (row, row), 3)]
    mended = shown.continuous()
    assert np.array_equal(mended.positions, points)
    assert mended.origin == f"read; turned the sign of a quaternion at rows {row}"


@settings(max_examples=30)
@given(row=st.integers(10, 380), column=st.integers(0, 2), length=st.integers(1, 3))
def test_a_glitch_is_found_and_mended(row, column, length):
    points = smooth()
    points[row : row + length, column] += 0.3
    found = named(points).check().found
    assert [(one.kind, one.rows, one.column) for one in found] == [("glitch", (row, row + length - 1), column)]
    mended = named(points).deglitched()
    assert kinds(mended) == []
    assert np.abs(mended.positions.numpy() - smooth()).max() < 1e-3
    assert f"interpolated rows {row}" in mended.origin


@settings(max_examples=30)
@given(row=st.integers(10, 380), column=st.integers(0, 2))
def test_a_lasting_jump_is_found_and_split(row, column):
    points = smooth()
    points[row:, column] += 0.3
    (found,) = (one for one in named(points).check() if one.kind == "jump")
    assert (found.rows, found.column) == ((row - 1, row), column)
    parts = named(points).split_at(row)
    assert [len(part) for part in parts] == [row, 400 - row]
    assert all("jump" not in kinds(part) for part in parts)
    assert parts[1].origin == f"read; rows {row} to 399 of 400"


def test_a_gap_is_found_by_the_straight_line_that_stands_for_it():
    kept = np.r_[:120, 240:400]
    shown = Demonstration.from_times(0.01 * kept, smooth()[kept])
    (gap,) = findings(shown)
    assert gap.kind == "gap"
    assert gap.size == pytest.approx(1.21, rel=0.05)
    assert gap.rows[0] * shown.dt == pytest.approx(1.19, abs=0.05)


def test_a_repeated_row_is_found_and_mended():
    points = smooth()
    points[200:203] = points[199]
    (found,) = named(points).check()
    assert (found.kind, found.rows, found.size) == ("repeat", (200, 202), 3)
    assert kinds(named(points).deglitched()) == []


def test_rests_and_swaying_are_found_and_cut():
    sway = 0.01 * np.sin(np.linspace(0, 12 * np.pi, 150))[:, None]
    points = smooth()
    shown = named(np.concatenate([points[0] + sway, points, points[-1] + np.zeros((100, 3))]))
    (found,) = (one for one in shown.check() if one.kind == "rest")
    assert found.rows == (pytest.approx(150, abs=40), pytest.approx(550, abs=40))
    mended = shown.trimmed()
    assert "rest" not in kinds(mended)
    assert "trimmed to" in mended.origin


@pytest.mark.parametrize("kind", ["noise", "steps"])
def test_what_hides_the_motion_is_found(kind):
    points = smooth()
    noisy = points + 0.04 * np.random.default_rng(0).standard_normal(points.shape)
    shown = named(noisy if kind == "noise" else 0.1 * np.round(points / 0.1))
    assert kind in kinds(shown)
    mended = shown.smoothed(0.4)
    assert kind not in kinds(mended)
    assert np.array_equal(mended.positions[[0, -1]], shown.positions[[0, -1]])
    assert mended.origin == "read; smoothed over 0.4 s"


@pytest.mark.parametrize(("kind", "turns", "goal"), [("loop", 1, 0.0), ("near crossing", 1.2, 0.004), ("", 0.8, 0.0)])
def test_meetings_are_found(kind, turns, goal):
    angle = 2 * np.pi * turns * SHARE
    radius = 1 + goal * SHARE
    shown = Demonstration(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1), 0.01)
    assert kinds(shown) == ([kind] if kind else [])


def test_a_crossing_is_found_where_two_strands_meet():
    angle = 2 * np.pi * (0.8 * SHARE - 0.1)
    shown = Demonstration(np.stack([np.sin(2 * angle), np.sin(angle)], axis=1), 0.01)  # a lemniscate, open at one end
    (found,) = shown.check()
    assert found.kind == "crossing"
    met = shown.positions[list(found.rows)].norm(dim=1)
    assert float(met.max()) < 0.03  # it crosses at the origin
    assert all("crossing" not in kinds(part) for part in shown.split_at((found.rows[0] + found.rows[1]) // 2))


def test_a_pause_on_the_way_is_found():
    points = smooth()
    (found,) = named(np.concatenate([points[:200], np.repeat(points[200:201], 60, axis=0), points[200:]])).check()
    assert (found.kind, found.unit) == ("pause", "s")
    assert found.rows == (pytest.approx(199, abs=5), pytest.approx(260, abs=5))
    assert found.size == pytest.approx(0.6, abs=0.1)


def test_lengths_that_differ_are_told():
    aside, angle = 0.1 * np.sin(np.pi * SHARE), 16 * np.pi * SHARE
    straight, helix = (
        Demonstration(np.stack([SHARE, radius * np.cos(angle), radius * np.sin(angle)], axis=1), 0.01)
        for radius in (0 * aside, aside)
    )
    found = every_finding([straight, helix])
    assert [item.kind for item in found] == ["lengths"]


def test_several_that_differ_are_told():
    one = datasets.drawn("hook")
    assert every_finding([one, one]) == ()
    other = Demonstration(one.positions + 3, 3 * one.dt)
    assert [found.kind for found in every_finding([one, other])] == ["starts", "goals", "durations"]


def test_a_fit_tells_what_it_was_shown_and_a_clean_one_is_silent():
    points = smooth()
    points[200:, 1] += 0.3
    with pytest.warns(FitWarning, match=r"column y jumps at row 200 \("):
        notes = ChebyshevDS(3, n_layers=20).fit(named(points)).fit_report.notes
    assert sum("jumps at row 200" in note for note in notes) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert ChebyshevDS(3).fit(named(smooth())).fit_report.notes == ()


def test_resampled_and_unchanged():
    shown = named(smooth())
    assert shown.unwrapped() is shown.deglitched() is shown.trimmed() is shown.continuous() is shown
    coarse = shown.resampled(100)
    assert (len(coarse), coarse.duration) == (100, pytest.approx(shown.duration))
    assert coarse.origin == "read; resampled from 400 to 100 points"


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda d: d.unwrapped("w"), r"columns: expected names or numbers among \['x', 'y', 'z'\], got 'w'"),
        (lambda d: d.unwrapped([0]), "columns: expected a column with steps near 2π or 360"),
        (lambda d: d.smoothed(100), r"seconds: expected 0\.04 to 3\.99, got 100"),
        (lambda d: d.resampled(2), "n: expected"),
        (lambda d: d.split_at([9, 10]), "rows: expected rising"),
    ],
)
def test_bad_arguments_are_refused(call, said):
    with pytest.raises(ValueError, match=said):
        call(named(smooth()))


def test_it_is_cheap():
    shown = datasets.joint_motion(0)
    findings(shown)
    took = []
    for _ in range(3):
        began = time.perf_counter()
        findings(shown)
        took.append(time.perf_counter() - began)
    assert min(took) < 0.1
