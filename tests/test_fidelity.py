"""Every fit measures itself: one that does not follow its demonstration says so, whatever the method; no other does."""

from __future__ import annotations

import copy
import pickle
import warnings
from dataclasses import replace

import cloudpickle
import numpy as np
import pytest
import torch

import latentds
from baselines import FDM
from latentds import (
    ChebyshevDS,
    Demonstration,
    FitWarning,
    Learned,
    StableDS,
    TubeDS,
    certify,
    datasets,
)
from latentds.fidelity import (
    END_LIMIT,
    EXCERPT_POINTS,
    MISS_LIMIT,
    MOST_EXCERPT_POINTS,
    NEARBY_LIMIT,
    SPREAD_LIMIT,
    TIMING_LIMIT,
    Excerpt,
    Fidelity,
    measure,
)
from latentds.testing import wavy_motion

SHARE = np.linspace(0, 1, 1000)


def shown(*columns: np.ndarray) -> Demonstration:
    return Demonstration(np.stack(np.broadcast_arrays(*columns), axis=1), 4 / (len(SHARE) - 1))


def circle(gap: float) -> Demonstration:
    angle = (2 * np.pi - gap) * SHARE
    return shown(np.cos(angle), np.sin(angle))


def planar_spiral(turns: float, inward: bool) -> Demonstration:
    radius, angle = 1 - SHARE if inward else SHARE, 2 * np.pi * turns * SHARE
    return shown(radius * np.cos(angle), radius * np.sin(angle))


def helix(turns: float) -> Demonstration:
    angle = 2 * np.pi * turns * SHARE
    return shown(0.5 * np.cos(angle), 0.5 * np.sin(angle), SHARE)


def lissajous() -> Demonstration:
    angle = 2 * np.pi * (0.97 * SHARE + 0.01)
    return shown(np.sin(3 * angle + 0.5), np.sin(4 * angle), np.sin(5 * angle))


def trefoil() -> Demonstration:
    angle = 2 * np.pi * 0.97 * SHARE
    return shown(np.sin(angle) + 2 * np.sin(2 * angle), np.cos(angle) - 2 * np.cos(2 * angle), -np.sin(3 * angle))


def loop_the_loop() -> Demonstration:
    angle = 2 * np.pi * np.clip((SHARE - 0.3) / 0.4, 0, 1)
    ahead = 3 * (np.clip(SHARE - 0.7, 0, None) + np.clip(SHARE, None, 0.3) - 0.3)
    return shown(ahead + 0.5 * np.sin(angle), 0.5 * (1 - np.cos(angle)), 0.1 * SHARE)


def noisy(level: float) -> Demonstration:
    motion = datasets.joint_motion(1, 600)
    noise = np.random.default_rng(0).standard_normal(motion.positions.shape)
    return Demonstration(motion.positions.numpy() + level * motion.size * noise, motion.dt)


HARD = {
    "circle, gap 0.1": circle(0.1),
    "circle, gap 0.02": circle(0.02),
    "spiral, 2 turns in": planar_spiral(2, True),
    "spiral, 3 turns out": planar_spiral(3, False),
    "spiral, 5 turns in": planar_spiral(5, True),
    "helix, 30 turns": helix(30),
    "Lissajous 3:4:5": lissajous(),
    "trefoil": trefoil(),
    "loop": loop_the_loop(),
    "noise, 5 %": noisy(0.05),
}
METHODS = {
    "ChebyshevDS": ChebyshevDS,
    "FDM": FDM,
    "TubeDS": lambda dim: TubeDS(dim, n_layers=120, refined=False),
}


def plain_dtw(path: np.ndarray, reference: np.ndarray) -> float:
    """Per point; the textbook's recursion."""
    cost = np.full((len(path) + 1, len(reference) + 1), np.inf)
    cost[0, 0] = 0
    gaps = np.linalg.norm(path[:, None] - reference, axis=-1)
    for i in range(len(path)):
        for j in range(len(reference)):
            cost[i + 1, j + 1] = gaps[i, j] + min(cost[i, j], cost[i, j + 1], cost[i + 1, j])
    return float(cost[-1, -1]) / len(path)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    "curve", [pytest.param(curve, marks=[pytest.mark.slow] * (curve not in ("loop", "trefoil"))) for curve in HARD]
)
def test_no_misfit_is_silent(curve, method):
    motion = HARD[curve]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            ds = METHODS[method](motion.dim).fit(motion)
        except ValueError as refused:
            assert str(refused).startswith("demonstration: expected a motion whose map inverts in floats")  # noqa: PT017
            return
    times = np.linspace(0, motion.duration, 240)
    with torch.no_grad():
        path = ds.rollout(motion.start, torch.from_numpy(times)).numpy()
    missed = plain_dtw(path, motion.at(times)) / motion.size
    report = ds.fit_report
    assert report.fidelity.miss == pytest.approx(missed, abs=0.02)
    said = [warning for warning in caught if issubclass(warning.category, FitWarning)]
    assert bool(said) is not report.fidelity.follows
    assert set(report.fidelity.notes) <= set(report.notes)
    if missed > MISS_LIMIT + 0.005:
        assert not report.fidelity.follows
        assert f"misses its demonstration by {report.fidelity.miss:.3g} of the size" in str(said[0].message)
    line = certify(ds, n_samples=10).lines[-1]
    assert line.claim == "follows its demonstration"
    assert (line.verdict == "falsified") is bool(said)


def test_what_is_hard_is_missed():
    """Else the test above would test nothing."""
    for motion in (circle(0.02), planar_spiral(2, True), helix(30), lissajous(), trefoil(), noisy(0.05)):
        assert FDM(motion.dim).fit(motion).fit_report.fidelity.miss > MISS_LIMIT


@pytest.mark.parametrize(
    "motion",
    [
        *(datasets.unstable_spiral(c, 500) for c in (1, 3, 7)),
        *(datasets.stable_spiral(c, 500) for c in (1, 2, 3)),
        datasets.drawn("hook", 500),
        datasets.joint_motion(0, 500),
        wavy_motion(2),
        noisy(0.005),
    ],
    ids=str,
)
@pytest.mark.parametrize("method", METHODS)
def test_good_fits_are_silent(method, motion):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report = METHODS[method](motion.dim).fit(motion).fit_report
    assert report.fidelity.follows
    assert report.notes == ()


class Follower(StableDS):
    """ẏ = -(y - y*)/τ, which is what :func:`decay` shows: the smallest method, written as a third party would."""

    tau = 1.0

    def _learn(self, shown, progress):
        self.attractor.copy_(shown[0].goal)
        return Learned(0.0, 0)

    def forward(self, y):
        return -(y - self.attractor) / self.tau

    def lyapunov(self, y):
        return (y - self.attractor).square().sum(-1)

    def rollout(self, y0, t):
        decay = torch.exp(-(t - t[0]) / self.tau).unsqueeze(-1)
        return self.attractor + decay * (y0 - self.attractor).unsqueeze(-2)


def decay(wiggle: float = 0.0) -> Demonstration:
    """To the goal in seven time constants, with a tight helix of some radius around the way."""
    t = np.linspace(0, 7, 700)
    left, angle = np.exp(-t), 60 * np.exp(-t)
    return Demonstration(np.stack([left, wiggle * np.cos(angle), wiggle * np.sin(angle)], axis=1), 0.01)


class IsLate(Follower):
    tau = 2.5


class Scatters(Follower):
    """Nothing is off from the demonstrated start itself."""

    def rollout(self, y0, t):
        y0 = torch.as_tensor(y0)
        aside = (y0[..., 1:].norm(dim=-1) > 1e-4).to(y0)
        return super().rollout(y0, t) + 5 * aside[..., None, None] * (t - t[0])[:, None] / t[-1].clamp(min=1)


class Races(Follower):
    def forward(self, y):
        aside = (y[..., 1:].norm(dim=-1, keepdim=True) > 0.05).to(y)
        return super().forward(y) * (1 + 20 * aside)


class Lunges(Follower):
    """From within nine thousandths of a size from the path's beginning, and nowhere that is looked at beside it."""

    def forward(self, y):
        begins = ((y - y.new_tensor([1.0, 0.0, 0.0])).norm(dim=-1, keepdim=True) < 0.009).to(y)
        return super().forward(y) * (1 + 3 * begins)


class Rises(Follower):
    def lyapunov(self, y):
        return super().lyapunov(y) + 0.1 * torch.exp(-((y[..., 0] - 0.5).square()) / 1e-3)


class DependsOnTheTime(Follower):
    def rollout(self, y0, t):
        path = super().rollout(y0, t)
        return path + 0.005 * torch.sin(2 * (t - t[0])).unsqueeze(-1)


class LosesX(Follower):
    def latent_error(self, y0, t):
        return torch.full_like(t, 0.5)


class Diverges(Follower):
    def rollout(self, y0, t):
        return super().rollout(y0, t) * torch.where(t > 1, torch.nan, 1.0).unsqueeze(-1)


PLANTED = {
    IsLate: "of the size from the end when the demonstration ends",
    Scatters: "of the size from a start beside the demonstrated one",
    Races: "times as fast as shown within 10% of the size from the path",
    Lunges: "moves 4.02 times as fast as shown from where it was shown to begin or from beside it",
    Rises: "V rises by 0.0",
    DependsOnTheTime: "its motion begun anew half-way is another one",
    LosesX: "rounding breaks its map, encode(decode(x)) is 0.5 latent lengths from x",
    Diverges: "misses its demonstration by nan",
}


def test_a_third_party_is_measured_without_asking_for_it():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ds = Follower(3).fit(decay())
    assert ds.fit_report.fidelity.follows
    with pytest.warns(FitWarning, match="Follower does not follow .*: .*misses its demonstration by") as caught:
        Follower(3).fit(demonstration=datasets.unstable_spiral(3, 200))
    assert caught[0].filename == __file__


@pytest.mark.parametrize("stub", PLANTED, ids=lambda stub: stub.__name__)
def test_each_figure_tells_its_fault(stub):
    with pytest.warns(FitWarning) as caught:
        ds = stub(3).fit(decay())
    assert len(caught) == 1
    fidelity = ds.fit_report.fidelity
    assert [note for note in fidelity.notes if PLANTED[stub] in note], fidelity.notes
    assert stub in (Diverges, IsLate, Scatters) or len(fidelity.notes) == 1, fidelity.notes
    assert not fidelity.follows
    assert certify(ds, [[-2, -2, -2], [2, 2, 2]], n_samples=10).lines[-1].verdict == "falsified"


def test_a_shortcut_within_the_limit_of_the_miss_is_told_by_its_length():
    with pytest.warns(FitWarning) as caught:
        fidelity = Follower(3).fit(decay(wiggle=0.03)).fit_report.fidelity
    assert fidelity.miss < MISS_LIMIT
    assert "times as far as its demonstration" in str(caught[0].message)


def test_noise_does_not_count_as_way():
    motion = decay()
    noise = 0.01 * np.random.default_rng(0).standard_normal(motion.positions.shape)
    noise[[0, -1]] = 0
    fidelity = Follower(3).fit(Demonstration(motion.positions.numpy() + noise, motion.dt)).fit_report.fidelity
    assert fidelity.follows
    assert 0.9 < fidelity.length_ratio < 1.1


def test_a_start_beside_a_goal_that_lies_near_it_is_not_asked_to_go_the_long_way():
    """The goal is 0.3 % of the size from the start; 1 % beside it lies what no continuous field sends around."""

    class Tracks(Follower):
        def _learn(self, shown, progress):
            learned = super()._learn(shown, progress)
            self.path = shown[0].positions
            return learned

        def rollout(self, y0, t):
            far = (torch.as_tensor(y0) - self.path[0]).norm(dim=-1) > 0.003
            steps = ((t - t[0]) / 4 * (len(self.path) - 1)).round().long().clamp(max=len(self.path) - 1)
            return torch.where(far[..., None, None], super().rollout(y0, t), self.path[steps])

    fidelity = Tracks(2).fit(circle(0.006)).fit_report.fidelity
    assert fidelity.miss < 1e-2
    assert fidelity.nearby < NEARBY_LIMIT


def test_a_method_that_cannot_be_rolled_out_keeps_its_fit_and_says_so():
    class Unfinished(Follower):
        def rollout(self, y0, t):
            raise NotImplementedError("later")

    with pytest.warns(FitWarning, match="could not be measured, NotImplementedError: later"):
        ds = Unfinished(3).fit(decay())
    assert ds.fit_report.fidelity is None
    assert ds.fit_report.notes == ("could not be measured, NotImplementedError: later",)
    assert torch.equal(ds.attractor, decay().goal)


def test_a_rollout_of_another_shape_is_told():
    class Squeezes(Follower):
        def rollout(self, y0, t):
            return super().rollout(y0, t)[0]

    with pytest.warns(FitWarning, match=r"could not be measured, ValueError: rollout: expected shape \(9, 200, 3\)"):
        Squeezes(3).fit(decay())


def test_a_fit_that_raises_is_not_measured():
    class Refuses(Follower):
        def _learn(self, shown, progress):
            raise ValueError("demonstration: no")

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(ValueError, match="demonstration: no"):
            Refuses(3).fit(decay())
        Follower(3).fit(decay())  # and the next fit is the outermost again


def test_a_method_that_lets_another_learn_is_told_once():
    class Holds(StableDS):
        """Another system does the work."""

        def __init__(self, dim):
            super().__init__(dim)
            self.inner = Follower(dim)

        def _learn(self, shown, progress):
            learned = self.inner._learn(shown, progress)
            self.attractor.copy_(self.inner.attractor)
            return learned

        def forward(self, y):
            return self.inner(y)

        def lyapunov(self, y):
            return self.inner.lyapunov(y)

        def rollout(self, y0, t):
            return self.inner.rollout(y0, t)

    with pytest.warns(FitWarning) as caught:
        ds = Holds(3).fit(datasets.unstable_spiral(3, 200))
    assert len(caught) == 1
    assert ds.inner.fit_report is None
    assert ds.fit_report.notes == ds.fit_report.fidelity.notes


class FitsItself:
    def fit(self, demonstration, *, progress=False):
        return self


@pytest.mark.parametrize("bases", [(Follower,), (FitsItself, Follower)], ids=["itself", "by a mixin"])
def test_a_method_that_overrides_fit_is_refused_when_it_is_defined(bases):
    own = {"fit": FitsItself.fit} if len(bases) == 1 else {}
    with pytest.raises(
        TypeError, match=r"^Mine: expected a method that writes _learn\(shown, progress\), got one that"
    ):
        type("Mine", bases, own)


class Ends(Exception):
    """A user's own time-out, of a class that nobody knows."""


@pytest.mark.parametrize("raised", [KeyboardInterrupt, TimeoutError, Ends, FitWarning, MemoryError])
@pytest.mark.parametrize("during", ["learning", "measuring"])
def test_a_fit_is_whole_or_did_not_happen(raised, during):
    class Breaks(TubeDS):
        broken = False

        def _learn(self, shown, progress):
            learned = super()._learn(shown, progress)
            self.remembered = shown
            if self.broken and during == "learning":
                raise raised
            return learned

        def rollout(self, y0, t):
            if self.broken and during == "measuring" and hasattr(self, "remembered"):
                raise raised
            return super().rollout(y0, t)

    ds = Breaks(3, n_layers=20, refined=False, homotopy="linear").fit(decay())
    del ds.remembered
    law, tensors, report = ds.dynamics.law, dict(ds.state_dict(keep_vars=True)), ds.fit_report
    values = {name: tensor.clone() for name, tensor in tensors.items()}
    ds.broken = True
    with pytest.raises(raised):
        ds.fit(datasets.unstable_spiral(1, 200))
    assert ds.dynamics.law is law
    assert ds.fit_report is report
    assert not hasattr(ds, "remembered")
    for name, tensor in ds.state_dict(keep_vars=True).items():
        assert tensor is tensors[name]
        assert torch.equal(tensor, values[name])


def test_a_warning_that_is_an_error_leaves_the_fit_before():
    ds = Follower(3).fit(decay())
    report, goal = ds.fit_report, ds.attractor.clone()
    with warnings.catch_warnings():
        warnings.simplefilter("error", FitWarning)
        with pytest.raises(FitWarning):
            ds.fit(datasets.unstable_spiral(3, 200))
    assert ds.fit_report is report
    assert torch.equal(ds.attractor, goal)


class Modulated(ChebyshevDS):
    """Rolls out as its parent does, but the field goes aside half-way."""

    def forward(self, y):
        aside = torch.exp(-((y - self.start).norm(dim=-1, keepdim=True) ** 2))
        return super().forward(y) + 0.5 * aside * torch.tensor([0.0, 1.0, 0.0], dtype=y.dtype)


@pytest.mark.parametrize("hooked", [False, True])
def test_what_a_robot_runs_is_what_is_judged(hooked):
    """Rollouts that are perfect say nothing of a field that is another one."""
    shown = datasets.unstable_spiral(1, 300)
    ds = (ChebyshevDS if hooked else Modulated)(3, n_layers=60)
    if hooked:
        ds.register_forward_hook(lambda module, inputs, velocity: 0.8 * velocity)
    with pytest.warns(FitWarning, match="sizes off the integral of its velocity field, which a robot runs"):
        fidelity = ds.fit(shown).fit_report.fidelity
    assert fidelity.miss < MISS_LIMIT
    assert not fidelity.follows
    assert "motions are the field's integral" in {line.claim for line in certify(ds, n_samples=40).falsified}


def test_a_coordinate_of_another_unit_that_is_hardly_followed_is_told():
    """Radians beside millimetres: what is nothing of the size is half of the joint's range."""
    s = np.linspace(0, 1, 200) ** 2 * (3 - 2 * np.linspace(0, 1, 200))
    mixed = np.stack([300 * s, 200 * np.sin(2 * s), 0.8 * np.sin(12 * s)], axis=1)
    with pytest.warns(
        FitWarning, match=r"ChebyshevDS follows .*, but a coordinate that moves little is missed by 0\.2"
    ):
        report = ChebyshevDS(3, n_layers=10).fit(Demonstration(mixed, 0.01)).fit_report
    assert report.fidelity.follows
    assert "scale the coordinates to like ranges" in report.notes[-1]
    report = ChebyshevDS(3, n_layers=200).fit(Demonstration(mixed, 0.01)).fit_report
    assert report.notes == ()
    resting = np.stack([mixed[:, 0], mixed[:, 1], 1e-3 * mixed[:, 2]], axis=1)
    assert ChebyshevDS(3, n_layers=10).fit(Demonstration(resting, 0.01)).fit_report.notes == ()


@pytest.mark.parametrize(
    "learned", [Learned(np.float32(0.5), np.int64(3), [np.float32(1)]), Learned(torch.tensor(0.5), 3, (1,))]
)
def test_a_report_holds_pythons_own_numbers(learned):
    class Reports(Follower):
        def _learn(self, shown, progress):
            super()._learn(shown, progress)
            return learned

    report = Reports(3).fit(decay()).fit_report
    assert [type(value) for value in (report.mse, report.n_layers, *report.history)] == [float, int, float]


def test_a_report_reads_like_a_page():
    good, bad = Follower(3).fit(decay()).fit_report, Races(3).fit(decay()).fit_report
    lines = str(good).splitlines()
    assert lines[0].startswith("learned from ")
    assert lines[1] == "It follows what it was shown."
    assert sum(line.split()[-2:] == [f"{good.fidelity.command:.3g}", "2"] for line in lines) == 1
    assert max(map(len, lines)) < 100
    assert "It does NOT follow what it was shown." in str(bad)
    assert str(bad).splitlines()[-1] == f"note: {bad.notes[0]}"


def test_a_refit_forgets_what_was_off():
    ds = Follower(3).fit(datasets.unstable_spiral(3, 200))
    assert ds.fit_report.notes
    assert ds.fit(decay()).fit_report.notes == ()


def test_a_class_from_a_notebook_travels():
    """cloudpickle sends a class of the calling script by value, its fit included."""

    class Local(Follower):
        def _learn(self, shown, progress):
            return super()._learn(shown, progress)

    there = pickle.loads(cloudpickle.dumps(Local))
    assert there(3).fit(decay()).fit_report.fidelity.follows


def test_nothing_global_changes():
    state, numpy_state = torch.get_rng_state(), str(np.random.get_state())  # noqa: NPY002 - the global one is watched
    ds = Follower(3).fit(decay())
    before = {name: value.clone() for name, value in ds.state_dict().items()}
    measure(ds, ds.fit_report.fidelity.shown)
    assert torch.equal(state, torch.get_rng_state())
    assert numpy_state == str(np.random.get_state())  # noqa: NPY002
    assert all(torch.equal(value, before[name]) for name, value in ds.state_dict().items())


@pytest.mark.parametrize(("scale", "shift"), [(1e-6, 0.0), (1e3, 5.0), (1e6, -3.0)])
def test_units_and_origin_do_not_matter(scale, shift, monkeypatch):
    motion = datasets.unstable_spiral(3, 200)
    moved = Demonstration(scale * (motion.positions + shift), 7 * motion.dt)
    monkeypatch.setattr(Follower, "tau", motion.duration)
    here = Follower(3).fit(motion).fit_report.fidelity
    monkeypatch.setattr(Follower, "tau", moved.duration)
    there = Follower(3).fit(moved).fit_report.fidelity
    for name in ("miss", "length_ratio", "end", "nearby", "fastest", "command", "rise"):
        assert getattr(there, name) == pytest.approx(getattr(here, name), rel=1e-6), name


def test_a_float32_module_and_a_batch_of_one():
    ds = FDM(3, n_layers=60).to(torch.float32).fit(datasets.unstable_spiral(1, 300))
    assert ds.fit_report.fidelity.follows


def test_each_of_several_demonstrations_is_held_against_itself():
    base, draw = wavy_motion(2), np.random.default_rng(0)
    bend = np.sin(np.pi * np.linspace(0, 1, len(base)))[:, None]
    near = [Demonstration(base.positions.numpy() + 0.02 * draw.standard_normal(2) * bend, base.dt) for _ in range(12)]
    tube = TubeDS(2, n_layers=40, refined=False)
    fidelity = tube.fit(near).fit_report.fidelity
    assert fidelity.follows
    assert len(fidelity.shown) == 8
    apart = [Demonstration(base.positions.numpy() + side * np.array([0.0, 0.3]) * bend, base.dt) for side in (1, -1)]
    with pytest.warns(FitWarning, match="misses its demonstration by 0.1"):  # though they miss each other by more
        wide = tube.fit(apart).fit_report.fidelity
    assert wide.miss > 2 * MISS_LIMIT
    assert not wide.follows


def test_goals_that_differ_are_allowed_for_at_the_end_alone_and_not_without_bound():
    base = wavy_motion(2)
    aside = 0.2 * base.size * np.linspace(0, 1, len(base))[:, None] * np.array([0.0, 1.0])
    shown = [Demonstration(base.positions.numpy() + side * aside, base.dt) for side in (1, -1)]
    fidelity = TubeDS(2, n_layers=40, refined=False).fit(shown).fit_report.fidelity
    assert fidelity.spread == pytest.approx(0.2, rel=0.1)
    assert fidelity.end_limit == END_LIMIT + SPREAD_LIMIT < fidelity.end
    assert any("from the end when the demonstration ends" in note for note in fidelity.notes)
    assert END_LIMIT < replace(fidelity, spread=0.08).end_limit < END_LIMIT + SPREAD_LIMIT
    assert TubeDS(2, n_layers=40, refined=False).fit(shown[:1]).fit_report.fidelity.spread == 0


def test_paces_that_differ_are_allowed_for_in_the_timing_alone():
    """One hurries at first, the other at last: at equal times they are apart, and no field has both their times."""
    base, share = wavy_motion(2), np.linspace(0, 1, 400)
    shown = [Demonstration(base.at(base.duration * share**power), base.duration / 399) for power in (0.85, 1 / 0.85)]
    halves = [one.at(np.linspace(0, one.duration, 200)) for one in shown]
    apart = np.linalg.norm(halves[0] - halves[1], axis=1).mean() / 2 / shown[0].size
    fidelity = TubeDS(2, n_layers=40, refined=False).fit(shown).fit_report.fidelity
    assert fidelity.pace_spread == pytest.approx(apart, rel=1e-2)
    assert fidelity.timing_limit == pytest.approx(TIMING_LIMIT + apart, rel=1e-2)
    assert replace(fidelity, pace_spread=9.0).timing_limit == TIMING_LIMIT + SPREAD_LIMIT
    assert any("at the same time" in note for note in replace(fidelity, timing=TIMING_LIMIT + 2 * apart).notes)
    assert not any("at the same time" in note for note in replace(fidelity, timing=TIMING_LIMIT + apart / 2).notes)
    assert TubeDS(2, n_layers=40, refined=False).fit(shown[:1]).fit_report.fidelity.pace_spread == 0


@pytest.mark.parametrize("factor", [0.7, 1, 1.4, 5])
@pytest.mark.parametrize("shown", [wavy_motion(3), datasets.unstable_spiral(3, 300)], ids=["wave", "spiral"])
def test_a_motion_that_is_too_fast_or_too_slow_does_not_follow(shown, factor):
    ds = TubeDS(3, n_layers=100, refined=False).fit(shown)
    ds.dynamics.law.speeds.mul_(factor)
    fidelity = measure(ds, ds.fit_report.fidelity.shown)
    assert (fidelity.timing < TIMING_LIMIT / 5) == (factor == 1)
    assert fidelity.follows == (factor == 1), fidelity.notes
    assert certify(ds, n_samples=20).holds == (factor == 1)


def test_an_excerpt_keeps_what_it_needs():
    for motion, count in (
        (datasets.unstable_spiral(1), EXCERPT_POINTS),
        (helix(30), 938),
        (helix(60), MOST_EXCERPT_POINTS),
    ):
        kept = Excerpt.of(motion)
        assert len(kept.path) == pytest.approx(count, abs=3)
        assert kept.path[0] == tuple(motion.start.tolist())
        assert kept.path[-1] == tuple(motion.goal.tolist())
        assert kept.duration == motion.duration
        assert kept.fastest == pytest.approx(float(motion.velocities.norm(dim=-1).max()))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"path": ((0.0, 1.0), (0.0, float("nan")), (1.0, 1.0))}, "path: expected finite numbers"),
        ({"path": ()}, "path: expected shape"),
        ({"path": tuple((float(i), 0.0) for i in range(1001))}, "path: expected at most 1000 points, got 1001"),
        ({"duration": 0.0}, "duration: expected a finite number > 0"),
        ({"fastest": -1.0}, "fastest: expected a finite number > 0"),
        ({"ruler": -1.0}, "ruler: expected a number in"),
    ],
)
def test_an_excerpt_that_is_none_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        replace(Excerpt.of(decay()), **change)


def test_figures_that_are_no_numbers_do_not_pass():
    good = Follower(3).fit(decay()).fit_report.fidelity
    for name in (
        "miss",
        "length_ratio",
        "end",
        "nearby",
        "fastest",
        "rise",
        "restart_gap",
        "flow_gap",
        "timing",
        "latent_error",
        "command",
    ):
        assert not replace(good, **{name: float("nan")}).follows
    assert isinstance(good, Fidelity)
    assert "path" not in repr(good)


def test_saved_and_changed_systems_are_held_against_their_demonstration_again(tmp_path):
    ds = ChebyshevDS(3, n_layers=60).fit(datasets.unstable_spiral(1, 300))
    ds.save(tmp_path / "ds")
    loaded = latentds.load(tmp_path / "ds")
    assert loaded.fit_report == ds.fit_report
    assert certify(loaded, n_samples=20).lines[-1].verdict == "not falsified"
    trained = copy.deepcopy(loaded)
    with torch.no_grad():
        trained.diffeomorphism.strengths.mul_(0.2)
    certificate = certify(trained, n_samples=20)
    assert [line.claim for line in certificate.falsified] == ["follows its demonstration"]


def test_a_map_that_floats_lose_is_refused_or_said():
    motion = planar_spiral(5, True)
    for method in (ChebyshevDS, FDM):
        try:
            report = method(2).fit(motion).fit_report
        except ValueError as refused:
            assert "expected a motion whose map inverts in floats, got one that rounding carries" in str(refused)  # noqa: PT017
        else:
            assert not report.fidelity.follows
    with pytest.raises(ValueError, match="whose map inverts in floats, got one that rounding carries"):
        ChebyshevDS(2).fit(motion)


def test_a_certificate_tells_what_floats_lose(monkeypatch):
    monkeypatch.setattr(ChebyshevDS, "_refuse_folds", lambda *_: None)
    ds = ChebyshevDS(2).fit(planar_spiral(5, True))
    falsified = {line.claim for line in certify(ds, n_samples=40).falsified}
    assert {"encode inverts decode", "V falls along motions", "a motion is its two halves"} <= falsified


def test_unfitted_systems_have_nothing_to_follow():
    assert "follows" not in str(certify(TubeDS(2), n_samples=10))
