"""Certificates: sound methods are not falsified; each way of being unsound is, by the right line."""

from __future__ import annotations

import copy
import dataclasses
import json
import math

import numpy as np
import pytest
import torch

from baselines import SDSEF
from latentds import Demonstration, LatentDS, Learned, LocallyWeightedTranslations, StableDS, TubeDS, certify
from latentds.dynamics import RayDynamics, TubeDynamics
from latentds.kernels.dispatch import reference
from latentds.testing import wavy_motion
from latentds.time_law import KnottedLaw


@pytest.mark.parametrize("dim", [pytest.param(1, marks=pytest.mark.slow), 2, pytest.param(7, marks=pytest.mark.slow)])
def test_sound_methods_are_not_falsified(fitted, method, dim):
    ds = fitted(method, dim)
    certificate = certify(ds, n_samples=200)
    said = ds.fit_report.fidelity.notes and method == "SDSEF"  # 50 epochs are few
    assert [line.claim for line in certificate.falsified] == ["follows its demonstration"] * bool(said), str(
        certificate
    )
    proven = [line.claim for line in certificate.lines if line.verdict == "proven"]
    assert len(proven) == 2
    assert "latent motions approach the goal" in proven[1]


class Sound(LatentDS):
    """A bent space with one ray to the goal, at (1, 0)."""

    def __init__(self, dim=2):
        super().__init__(dim, LocallyWeightedTranslations(dim, 3), RayDynamics(KnottedLaw.uniform()))
        psi, draw = self.diffeomorphism, torch.Generator().manual_seed(1)
        with torch.no_grad():
            psi.centers.normal_(generator=draw)
            psi.strengths.normal_(generator=draw)
            self.attractor[0] = 1
            self.start.copy_(-self.attractor)

    def _learn(self, shown, progress):
        return Learned(0.0)


class FlipsTheSign(Sound):
    def forward(self, y):
        return -super().forward(y)


class FlipsTheSignSomewhere(Sound):
    """Only within 0.15 of a place that few samples hit; ascent on V̇/V finds the rim."""

    place = (-0.4, 0.3)

    def forward(self, y):
        y = torch.as_tensor(y)
        near = torch.exp(-((y - y.new_tensor(self.place)).square().sum(-1, keepdim=True)) / 0.15**2)
        return super().forward(y) * (1 - 2 * near)


class RestsElsewhere(Sound):
    """A second equilibrium, a simple root of f, planted where the motion would pass."""

    place = (-0.4, 0.3)

    def forward(self, y):
        y, velocity = torch.as_tensor(y), super().forward(y)
        place = y.new_tensor(self.place)
        near = torch.exp(-((y - place).square().sum(-1, keepdim=True)) / 0.2**2)
        return velocity - near * super().forward(place)


class RestsElsewhereTangentially(Sound):
    """A double root: V decreases everywhere but at that one point."""

    place = (-0.4, 0.3)

    def forward(self, y):
        y = torch.as_tensor(y)
        far = (y - y.new_tensor(self.place)).square().sum(-1, keepdim=True)
        return super().forward(y) * far / (far + 0.05**2)


class Unbounded(LocallyWeightedTranslations):
    """μ > 1: layers reach 1.5 times as far as they may, and a class that vouches for the bound of its parent's."""

    invertibility = LocallyWeightedTranslations.invertibility

    @property
    def directions(self):
        return 1.5 * super().directions


class BreaksTheBound(Sound):
    def __init__(self):
        super().__init__()
        psi = Unbounded(2, 3)
        psi.load_state_dict(self.diffeomorphism.state_dict())
        with torch.no_grad():
            psi.strengths[1] = torch.tensor([3.0, 4.0])
        self.diffeomorphism = psi


class Folds(Sound):
    """decode(encode(y)) is y still, yet ψ has two sheets."""

    larger = 1.0

    def jacobian(self, x):
        x = torch.as_tensor(x)
        side = torch.where(x[..., :1] > 0, self.larger, -self.larger).to(x.dtype)
        return super().jacobian(x) * torch.cat([side, torch.ones_like(side)], -1).unsqueeze(-2)


class FoldsTheOtherWay(Folds):
    """Most of space is turned over, and the rest is not."""

    larger = -1.0


class HasAWrongJacobian(Sound):
    def jacobian(self, x):
        return super().jacobian(x).mT


class EncodesWrongly(Sound):
    def encode(self, y):
        return super().encode(y) * (1 + 1e-4)


class MovesAtTheGoal(Sound):
    def forward(self, y):
        return super().forward(y) + 1e-3


class NeverArrives(Sound):
    def rollout(self, y0, t):
        paths = super().rollout(y0, t)
        start = paths[..., :1, :]
        ball = 0.1 * torch.nn.functional.normalize(start - self.attractor, dim=-1)
        keeps = (start - self.attractor).norm(dim=-1, keepdim=True) > 0.1
        return torch.where(keeps, self.attractor + ball + 0.9 * (paths - self.attractor - ball), start)


class Drifts(Sound):
    """Its velocity at the attractor is 0, but its motions do not know."""

    def rollout(self, y0, t):
        return super().rollout(y0, t) + 1e-3 * (t - t[0]).unsqueeze(-1)


class DividesByZero(Sound):
    def forward(self, y):
        return super().forward(y) / (torch.as_tensor(y)[..., :1] > 0)


class Circles(Sound):
    """V̇ = 0 somewhere: there the motion goes around the attractor, as it may without ever coming nearer."""

    def forward(self, y):
        velocity, x = super().forward(y), self.encode(y) - self.frame().attractor
        around = torch.stack([-x[..., 1], x[..., 0]], -1)
        slide = torch.linalg.solve(self.jacobian(self.encode(y)).inverse(), around)
        return torch.where((torch.as_tensor(y)[..., :1] < 0.5), slide, velocity)


class IsFlat(Sound):
    """V is constant, so that V̇ = 0 wherever the motion goes."""

    def lyapunov(self, y):
        return torch.ones_like(torch.as_tensor(y)[..., 0])


class Jumps(Sound):
    """V falls along every motion, and to no 0 at the attractor, where it jumps."""

    def lyapunov(self, y):
        energy = super().lyapunov(y)
        return torch.where(energy > 0, 1 + energy, energy)


class Ages(Sound):
    """Where a motion is depends on when it began."""

    def rollout(self, y0, t):
        return super().rollout(y0, t - t[0] + 0.3 * (1 - torch.exp(t[0] - t)))


class Rises(Sound):
    """A hump in V that the slope at a point does not show: ∇V is told without it."""

    def lyapunov(self, y):
        hump = torch.exp(-((y[..., 0] - 0.3).square()) / 0.05**2)
        return super().lyapunov(y) * (1 + 0.5 * hump.detach())


class Stalls(Sound):
    """A plateau so slow that to cross it takes a million durations, which is legal."""

    def __init__(self):
        super().__init__()
        knots, speeds = torch.tensor([0.3, 0.45, 0.5, 0.6, 0.65, 0.8]), torch.tensor([0.3, *[1e-6] * 4, 1.0])
        self.dynamics.law = KnottedLaw(knots, speeds)


class RunsBackwards(Sound):
    """Its law's speeds turned negative after they were checked."""

    def __init__(self):
        super().__init__()
        self.dynamics.law.speeds.neg_()


BROKEN = {
    FlipsTheSign: "V decreases",
    FlipsTheSignSomewhere: "V decreases",
    RestsElsewhere: "no equilibrium",
    RestsElsewhereTangentially: "no equilibrium",
    BreaksTheBound: "every layer is invertible",
    Folds: "neither folds nor flattens",
    FoldsTheOtherWay: "neither folds nor flattens",
    Drifts: "the attractor rests",
    HasAWrongJacobian: "Jacobian is autograd's",
    EncodesWrongly: "decode inverts encode",
    MovesAtTheGoal: "the attractor rests",
    NeverArrives: "every motion arrives",
    Circles: "V decreases",
    IsFlat: "V decreases",
    Jumps: "V is above 0, and falls to 0",
    Ages: "a motion is its two halves",
    Rises: "V falls along motions",
    Stalls: "every motion arrives within 100 durations",
    DividesByZero: "parameters and velocities are finite",
    RunsBackwards: "latent motions approach",
}
ALONE = {RestsElsewhereTangentially, HasAWrongJacobian, EncodesWrongly, Jumps, Rises, Stalls}


def test_the_stubs_would_be_sound():
    assert certify(Sound()).holds


@pytest.mark.parametrize("stub", BROKEN, ids=lambda stub: stub.__name__)
def test_unsound_methods_are_falsified(stub):
    certificate = certify(stub())
    falsified = {line.claim: line for line in certificate.falsified}
    (found,) = [line for claim, line in falsified.items() if BROKEN[stub] in claim]
    assert not certificate.holds
    assert stub not in ALONE or len(falsified) == 1, falsified.keys()
    if stub is not RunsBackwards:
        assert len(found.counterexample) == 2
        assert f"at y = [{found.counterexample[0]:.6g}" in str(certificate)


@pytest.mark.parametrize("stub", [RestsElsewhere, RestsElsewhereTangentially])
def test_counterexample_is_the_planted_equilibrium(stub):
    (line,) = [line for line in certify(stub()).falsified if "equilibrium" in line.claim]
    assert line.counterexample == pytest.approx(stub.place, abs=1e-4)


@pytest.mark.parametrize("seed", range(8))
def test_ascent_finds_what_few_samples_miss(seed):
    """Samples alone find the place where V rises with three of these seeds."""
    certificate = certify(FlipsTheSignSomewhere(), n_samples=80, seed=seed)
    (line,) = [line for line in certificate.falsified if "V decreases" in line.claim]
    assert np.linalg.norm(np.subtract(line.counterexample, FlipsTheSignSomewhere.place)) < 0.15


@pytest.mark.parametrize("scale", [1e-9, 1e9])
def test_units_change_no_verdict(scale):
    shown = wavy_motion(2)
    ds = TubeDS(2, n_layers=30, refined=False).fit(Demonstration(scale * shown.positions, shown.dt))
    certificate = certify(ds, n_samples=40)
    assert certificate.holds, str(certificate)


def test_the_region_is_the_one_that_was_asked_for():
    assert certify(Sound(), [[-1, -2], [3, 4]], n_samples=20).region == ((-1, -2), (3, 4))


def test_counterexample_of_the_bound_is_where_space_folds():
    ds = BreaksTheBound()
    (line,) = [line for line in certify(ds).falsified if "layer" in line.claim]
    assert line.worst < 0
    assert np.isfinite(line.counterexample).all()


class Vinograd(StableDS):
    """Attractive and unstable (Vinograd 1957; Hahn, Stability of Motion, section 40): all motions end at 0, and from
    as near as one likes some go far first. No V proves it stable; this one does not even try.
    """

    def __init__(self, energy):
        super().__init__(2)
        self.energy = energy

    def _learn(self, shown, progress):
        return Learned(0.0)

    def forward(self, y):
        a, b = torch.as_tensor(y).unbind(-1)
        squared = a.square() + b.square()
        slope = torch.stack([a.square() * (b - a) + b**5, b.square() * (b - 2 * a)], -1)
        return slope / (squared * (1 + squared.square())).clamp(min=1e-300).unsqueeze(-1)

    def lyapunov(self, y):
        return self.energy(torch.as_tensor(y))


ENERGIES = {
    "constant": lambda y: torch.ones_like(y[..., 0]),
    "constant, with a gradient": lambda y: 1 + 0 * y.sum(-1),
    "0 at the attractor alone": lambda y: (y.square().sum(-1) > 0).to(y) + 0 * y.sum(-1),
    "distance": lambda y: y.square().sum(-1),
    "tilted": lambda y: y.square().sum(-1) + y.prod(-1),
}


@pytest.mark.parametrize("energy", ENERGIES)
def test_an_attractive_but_unstable_system_is_falsified(energy):
    certificate = certify(Vinograd(ENERGIES[energy]), [[-1, -1], [1, 1]], n_samples=100)
    verdicts = {line.claim: line.verdict for line in certificate.lines}
    assert verdicts["V decreases, V̇ < 0"] == "falsified"
    assert "proven" not in verdicts.values()


@pytest.mark.parametrize("corner", [0.0, 1.0])
@pytest.mark.parametrize("method", ["ChebyshevDS", "FDM", "TubeDS"])
@pytest.mark.parametrize("dim", [2, 7])
def test_the_rate_that_is_proven_holds_in_all_of_the_region(fitted, method, dim, corner):
    """At its corners, too, where samples hardly come; the oracle is ẋ itself."""
    ds = fitted(method, dim)
    certificate = certify(ds, n_samples=20)
    low, high = torch.tensor(certificate.region, dtype=torch.float64)
    share = torch.rand(4000, dim, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    share = share.round() if corner else share
    with torch.no_grad():
        x, frame = ds.encode(low + share * (high - low)), ds.frame()
        offset = x - frame.attractor
        rates = -(ds.dynamics(x, ds.decode(x), frame) * offset).sum(-1) / offset.square().sum(-1)
    (line,) = [line for line in certificate.lines if "latent motions" in line.claim]
    assert line.verdict == "proven"
    assert "in the region" in line.detail
    assert 0 < line.worst <= rates.min() + 1e-12


def test_a_map_without_a_bound_says_that_the_rate_is_of_samples():
    (line,) = [
        line
        for line in certify(SDSEF(2, n_layers=2, n_features=5, seed=0), n_samples=20).lines
        if "latent motions" in line.claim
    ]
    assert "where samples lie" in line.detail


def test_an_axis_that_is_too_long_proves_nothing(monkeypatch):
    """By 1e-4: what lies along it then counts a little as across, is pushed away, and outweighs a slow stretch."""
    ds = TubeDS(2, n_layers=30, refined=False).fit(wavy_motion(2))
    ds.fit_report = None
    ds.dynamics.law = KnottedLaw([0.001, 0.5, 0.6, 0.7, 1.0], [0.5, 0.5, 1e-4, 1e-4, 0.5])
    lines = {line.claim: line.verdict for line in certify(ds, n_samples=100).lines}
    rate = "latent motions approach the goal, -V̇/2V >= rate > 0"
    assert lines[rate] == "proven"
    with torch.no_grad():  # it does stop, and far away
        frame = ds.frame()
        frame = frame._replace(axis=(1 + 1e-4) * frame.axis)
        share = torch.linspace(0.4, 0.8, 400, dtype=torch.float64).unsqueeze(-1)
        x = frame.attractor + share * frame.length * frame.axis
        along = -(ds.dynamics(x, x, frame) * frame.axis).sum(-1)
    monkeypatch.setattr(TubeDS, "_kept_frame", lambda self: frame)  # no state can hold such an axis
    assert along.min() < 0 < along.max()
    lines = {line.claim: line.verdict for line in certify(ds, n_samples=100).lines}
    assert lines[rate] != "proven"
    assert lines["no equilibrium but the attractor"] == "falsified"


NUMBERS = {
    "start": ("start", (math.nan, math.inf)),
    "knots": ("dynamics.law.knots", (0.0, -1.0, math.nan, math.inf)),
    "speeds": ("dynamics.law.speeds", (0.0, -1.0, math.nan, math.inf)),
    "speeds across": ("dynamics.transverse_law.speeds", (0.0, -1.0, math.nan, math.inf)),
    "strengths": ("diffeomorphism.strengths", (math.nan, math.inf)),
}


@pytest.mark.parametrize("name", NUMBERS)
def test_numbers_that_make_no_system_are_not_believed(fitted, name):
    """As a file, a hand or an optimiser may leave them behind the constructors' backs."""
    path, factors = NUMBERS[name]
    for factor in factors:
        ds = fitted("TubeDS", 2)
        with torch.no_grad():
            ds.state_dict()[path].mul_(factor)
        lines = certify(ds, [[-2, -2], [2, 2]], n_samples=20).lines
        assert [line.verdict for line in lines if "latent motions" in line.claim] != ["proven"], factor
    ds = fitted("ChebyshevDS", 2)
    ds.dynamics.law.omega.neg_()
    assert not certify(ds, n_samples=20).holds


def test_a_region_that_nothing_spans_is_asked_for(fitted):
    ds = fitted("ChebyshevDS", 2)
    ds.start.fill_(math.nan)
    assert not certify(ds, n_samples=20).holds  # looked at where it was shown
    ds = TubeDS(2)
    ds.start.fill_(math.nan)
    with pytest.raises(ValueError, match=r"region: expected .* corners, as \w+ implies none"):
        certify(ds)
    assert not certify(ds, [[-2, -2], [2, 2]], n_samples=20).holds


def test_demonstrations_of_another_dimension_are_refused(fitted):
    ds = fitted("ChebyshevDS", 2)
    ds.fit_report = fitted("ChebyshevDS", 3).fit_report
    with pytest.raises(ValueError, match="ds: expected a fit_report that keeps demonstrations of dimension 2"):
        certify(ds)


@pytest.mark.slow
def test_floats_can_falsify_what_the_proof_promises():
    """Couplings are invertible whatever their parameters, on paper; here exp overflows what a float holds."""
    ds = SDSEF(2, n_layers=4, n_features=10, seed=0)
    with torch.no_grad():
        ds.diffeomorphism.amplitudes.fill_(30.0)
    certificate = certify(ds, [[-1, -1], [1, 1]])
    verdicts = {line.claim: line.verdict for line in certificate.lines}
    assert verdicts["every coupling has a positive determinant"] == "proven"
    assert not certificate.holds
    with torch.no_grad():
        ds.diffeomorphism.amplitudes[0] = torch.nan
    assert {line.claim: line.verdict for line in certify(ds, [[-1, -1], [1, 1]]).lines}[
        "every coupling has a positive determinant"
    ] == "falsified"


def test_reading_and_json():
    certificate = certify(Sound(), n_samples=50)
    text = str(certificate)
    assert text.startswith("Sound, 2-D, searched in [")
    assert "proven " in text
    assert "not falsified in " in text
    data = json.loads(certificate.to_json())
    assert data["holds"] is True
    assert len(data["lines"]) == len(certificate.lines)
    assert json.loads(certify(DividesByZero(), n_samples=50).to_json())["holds"] is False
    with pytest.raises(dataclasses.FrozenInstanceError):
        certificate.seed = 3


def test_same_seed_same_certificate_and_nothing_changes(fitted):
    ds = fitted("TubeDS", 3)
    state = {name: value.clone() for name, value in ds.state_dict().items()}
    before = torch.get_rng_state()
    assert certify(ds, n_samples=50, seed=4) == certify(ds, n_samples=50, seed=4)
    assert certify(ds, n_samples=50, seed=4) != certify(ds, n_samples=50, seed=5)
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(value, state[name]) for name, value in ds.state_dict().items())
    assert all(parameter.grad is None for parameter in ds.parameters())


def test_float32_is_judged_by_its_own_rounding(fitted):
    ds = fitted("FDM", 3).to(torch.float32)
    assert certify(ds, n_samples=50).holds


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"region": [[0, 0]]}, r"region: expected \(2, 2\) finite corners, low below high, got "),
        ({"region": [[0, 0], [1, 0]]}, r"region: expected \(2, 2\) finite corners, low below high, got "),
        ({"region": [[0, 0], [1, np.nan]]}, r"region: expected \(2, 2\) finite corners, low below high, got "),
        ({"region": "here"}, "region: expected an array of real numbers, got 'here'"),
        ({"n_samples": 5}, "n_samples: expected a whole number >= 10, got 5"),
        ({"seed": -1}, "seed: expected a whole number >= 0, got -1"),
        ({"seed": 0.5}, "seed: expected a whole number >= 0, got 0.5"),
    ],
)
def test_bad_input(arguments, message):
    with pytest.raises(ValueError, match=message):
        certify(Sound(), **arguments)


def test_bad_system():
    with pytest.raises(ValueError, match="ds: expected a StableDS, got str"):
        certify("system")


class StandsStillOnALine(StableDS):
    """f = -y |y₀ - c|^p: every motion from beyond the line y₀ = c ends on it, though a rollout steps over it."""

    def __init__(self, dim=2, power=1.0, place=0.3):
        super().__init__(dim)
        self.power, self.place = power, place

    def _learn(self, shown, progress):
        return Learned(0.0)

    def forward(self, y):
        points, wanted = self._points(y)
        return (-points * (points[..., :1] - self.place).abs() ** self.power).to(wanted)

    def lyapunov(self, y):
        points, wanted = self._points(y)
        return points.square().sum(-1).to(wanted)


@pytest.mark.parametrize("place", [0.3, 0.1234567, -0.71])
@pytest.mark.parametrize("power", [1.0, 2.0])
def test_a_line_of_equilibria_is_found_though_rollouts_step_over_it(power, place):
    certificate = certify(StandsStillOnALine(2, power, place), [[-1, -1], [1, 1]])
    assert "no equilibrium but the attractor" in {line.claim for line in certificate.falsified}


class StopsOnTheWay(TubeDynamics):
    def forward(self, x, y, frame):
        beside = (self.phase(x, frame) - 0.6).abs().unsqueeze(-1) < 1e-3
        return torch.where(beside, -1.0, 1.0) * super().forward(x, y, frame)


class RunsBack(KnottedLaw):
    def speed(self, s):
        return torch.where((s > 0.7) & (s < 0.7002), -1.0, 1.0) * super().speed(s)


def with_other_dynamics(ds):
    ds.dynamics = StopsOnTheWay(ds.dynamics.law, ds.dynamics.transverse_law)


def with_another_law(ds):
    ds.dynamics.law = RunsBack(ds.dynamics.law.knots, ds.dynamics.law.speeds)


def with_a_hook(ds):
    ds.dynamics.register_forward_hook(lambda module, inputs, slope: 1.0 * slope)


def with_a_method_of_its_own(ds):
    honest = ds.dynamics.law.speed
    ds.dynamics.law.speed = lambda s: honest(s)


@pytest.mark.parametrize("change", [with_other_dynamics, with_another_law, with_a_hook, with_a_method_of_its_own])
def test_nothing_is_proven_of_what_is_not_the_code_that_the_proof_is_about(change):
    ds = TubeDS(2, n_layers=40, refined=False, homotopy="linear").fit(wavy_motion(2))
    assert "approach the goal" in " ".join(
        line.claim for line in certify(ds, n_samples=50).lines if line.verdict == "proven"
    )
    change(ds)
    assert not [
        line for line in certify(ds, n_samples=50).lines if line.verdict == "proven" and "approach" in line.claim
    ]
    assert ds.tables() is None or change is with_other_dynamics


class Bent(LocallyWeightedTranslations):
    """A map of which its parent's margins and bounds say nothing."""

    def forward(self, x):
        return super().forward(x) + 0.1 * torch.sin(x)


def with_another_map(ds):
    psi = Bent(ds.dim, ds.diffeomorphism.n_layers)
    psi.load_state_dict(ds.diffeomorphism.state_dict())
    ds.diffeomorphism = psi


def with_a_hook_on_the_map(ds):
    ds.diffeomorphism.register_forward_hook(lambda module, inputs, y: 1.0 * y)


@pytest.mark.parametrize("change", [with_another_map, with_a_hook_on_the_map])
def test_no_map_is_proven_invertible_that_is_not_the_code_that_the_proof_is_about(change):
    ds = TubeDS(2, n_layers=40, refined=False, homotopy="linear").fit(wavy_motion(2))
    assert sum("invertible" in line.claim for line in certify(ds, n_samples=50).lines) == 1
    change(ds)
    assert not [line for line in certify(ds, n_samples=50).lines if "invertible" in line.claim]


def with_a_hook_on_the_velocity(ds):
    ds.register_forward_hook(lambda module, inputs, velocity: 0.5 * velocity)


def with_a_velocity_of_its_own(ds):
    honest = ds.forward
    ds.forward = lambda y: 0.5 * honest(y)


@pytest.mark.parametrize("change", [with_a_hook_on_the_velocity, with_a_velocity_of_its_own])
def test_no_rate_is_proven_of_another_velocity_field(change):
    ds = TubeDS(2, n_layers=40, refined=False, homotopy="linear").fit(wavy_motion(2))
    change(ds)
    certificate = certify(ds, n_samples=50)
    assert not [line for line in certificate.lines if line.verdict == "proven" and "rate" in line.claim]
    assert "motions are the field's integral" in {line.claim for line in certificate.falsified}


@pytest.mark.parametrize("speed", [0.0, -1.0])
def test_a_moved_system_that_stands_still_or_runs_back_is_falsified(speed):
    moved = TubeDS(2, n_layers=40, refined=False, homotopy="linear").fit(wavy_motion(2)).slowed(2.0)
    moved.similarity.speed.fill_(speed)
    assert not certify(moved, n_samples=50).holds


class CannotMove(StandsStillOnALine):
    def rollout(self, y0, t):
        raise RuntimeError("out of order")


def test_a_system_whose_motions_raise_is_falsified_and_says_what():
    certificate = certify(CannotMove(2, 1, 0.5), [[-1, -1], [1, 1]], n_samples=50)
    (line,) = certificate.falsified
    assert line.claim == "motions can be computed"
    assert "RuntimeError: out of order" in str(line)


class Creeps(StandsStillOnALine):
    """So slow that it is nowhere near when the demonstration ends, and nowhere at rest."""

    def _learn(self, shown, progress):
        with torch.no_grad():
            self.attractor.copy_(shown[0].goal)
        return Learned(0.0)

    def forward(self, y):
        return 1e-13 * (self.attractor - y)

    def lyapunov(self, y):
        return (y - self.attractor).square().sum(-1)


@pytest.mark.filterwarnings("ignore::latentds.FitWarning")
def test_a_field_that_is_slow_everywhere_is_not_said_to_rest_somewhere():
    certificate = certify(Creeps().fit(wavy_motion(2)), [[-1, -1], [1, 1]], n_samples=50)
    broken = {line.claim for line in certificate.falsified}
    assert "no equilibrium but the attractor" not in broken
    assert {"every motion arrives within 100 durations", "follows its demonstration"} <= broken


@pytest.mark.parametrize("method", ["TubeDS", "ChebyshevDS", "FDM", "SDSEF"])
def test_no_number_that_is_none_hides_from_the_certificate(fitted, method):
    """Wherever it stands: some velocities may not show it, such as beyond the last knot of a law."""
    for number in (math.nan, math.inf):
        for name in fitted(method, 2).state_dict():
            ds = copy.deepcopy(fitted(method, 2))
            ds.state_dict()[name].view(-1)[-1].fill_(number)
            certificate = certify(ds, n_samples=20)
            assert certificate.falsified[0].claim == "parameters and velocities are finite", name
            with pytest.raises(ValueError, match=r"^ds: expected finite parameters"):
                ds.controller()


@pytest.mark.parametrize("number", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["centers", "log_widths", "strengths"])
def test_a_parameter_that_is_no_number_is_nowhere_left_out(name, number, tmp_path):
    shown = wavy_motion(3)
    ds = TubeDS(3, n_layers=40, refined=False).fit(shown)
    y = shown.positions[::20].clone().requires_grad_()
    with torch.no_grad():
        getattr(ds.diffeomorphism, name)[5] = number
    for answer in (ds(y), ds.lyapunov(y), ds.rollout(y, torch.tensor([0.0, 1.0]))[:, 1]):
        assert bool(torch.isnan(answer).all())
    with reference():
        assert bool(torch.isnan(ds(y)).all())
    certificate = certify(ds, n_samples=50)
    assert certificate.falsified[0].claim == "parameters and velocities are finite"
    assert not [line for line in certificate.lines if line.verdict == "proven"]
    with pytest.raises(ValueError, match=r"^ds: expected finite parameters"):
        ds.controller()
    with pytest.raises(ValueError, match=rf"^ds: expected finite numbers, got NaN or inf in diffeomorphism\.{name}"):
        ds.save(tmp_path / "never")
    assert not (tmp_path / "never").exists()
