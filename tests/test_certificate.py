"""Certificates: sound methods are not falsified; each way of being unsound is, by the right line."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch

import baselines.sdsef
from baselines import FDM, SDSEF
from latentds import ChebyshevDS, LatentDS, LocallyWeightedTranslations, TubeDS, certify
from latentds.dynamics import RayDynamics
from latentds.testing import wavy_motion
from latentds.time_law import PiecewiseLinearLaw

METHODS = {
    "ChebyshevDS": lambda dim: ChebyshevDS(dim, n_layers=60),
    "FDM": lambda dim: FDM(dim, n_layers=60),
    "TubeDS": lambda dim: TubeDS(dim, n_layers=60, refined=False),
    "SDSEF": lambda dim: SDSEF(dim, n_layers=4, n_features=30, seed=0),
}


@pytest.fixture(autouse=True)
def _short_training(monkeypatch):
    plan = baselines.sdsef.PLANS["tuned"]
    monkeypatch.setitem(baselines.sdsef.PLANS, "tuned", dataclasses.replace(plan, epochs=50))


@pytest.mark.parametrize("dim", [1, 2, 7])
@pytest.mark.parametrize("method", METHODS)
def test_sound_methods_are_not_falsified(method, dim):
    ds = METHODS[method](dim).fit(wavy_motion(dim))
    certificate = certify(ds, n_samples=200)
    assert certificate.holds, str(certificate)
    proven = [line.claim for line in certificate.lines if line.verdict == "proven"]
    assert len(proven) == 2
    assert "latent motions approach the goal" in proven[1]


class Sound(LatentDS):
    """A bent space with one ray to the goal, at (1, 0)."""

    def __init__(self, dim=2):
        super().__init__(dim, LocallyWeightedTranslations(dim, 3), RayDynamics(PiecewiseLinearLaw.uniform()))
        psi, draw = self.diffeomorphism, torch.Generator().manual_seed(1)
        with torch.no_grad():
            psi.centers.normal_(generator=draw)
            psi.strengths.normal_(generator=draw)
            self.attractor[0] = 1
            self.start.copy_(-self.attractor)

    def fit(self, demonstration, *, progress=False):
        return self


class FlipsTheSign(Sound):
    def forward(self, y):
        return -super().forward(y)


class FlipsTheSignSomewhere(Sound):
    """Only within .15 of a place that few samples hit; ascent on V̇/V finds the rim."""

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
    """μ > 1: layers reach 1.5 times as far as they may."""

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

    def jacobian(self, x):
        x = torch.as_tensor(x)
        side = torch.where(x[..., :1] > 0, 1.0, -1.0).to(x.dtype)
        return super().jacobian(x) * torch.cat([side, torch.ones_like(side)], -1).unsqueeze(-2)


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


class DividesByZero(Sound):
    def forward(self, y):
        return super().forward(y) / (torch.as_tensor(y)[..., :1] > 0)


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
    HasAWrongJacobian: "Jacobian is autograd's",
    EncodesWrongly: "decode inverts encode",
    MovesAtTheGoal: "the attractor rests",
    NeverArrives: "every motion arrives",
    DividesByZero: "velocities are finite",
    RunsBackwards: "latent motions approach",
}
ALONE = {RestsElsewhereTangentially, HasAWrongJacobian, EncodesWrongly, NeverArrives}


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


def test_counterexample_of_the_bound_is_where_space_folds():
    ds = BreaksTheBound()
    (line,) = [line for line in certify(ds).falsified if "layer" in line.claim]
    assert line.worst < 0
    assert np.isfinite(line.counterexample).all()


@pytest.mark.slow
def test_floats_can_falsify_what_the_proof_promises():
    """Couplings are invertible whatever their parameters, on paper; here exp overflows what a float holds."""
    ds = SDSEF(2, n_layers=4, n_features=10, seed=0)
    with torch.no_grad():
        for layer in ds.diffeomorphism.layers:
            layer.amplitudes.fill_(30.0)
    certificate = certify(ds, [[-1, -1], [1, 1]])
    verdicts = {line.claim: line.verdict for line in certificate.lines}
    assert verdicts["every coupling has a positive determinant"] == "proven"
    assert not certificate.holds
    with torch.no_grad():
        ds.diffeomorphism.layers[0].amplitudes[0, 0, 0] = torch.nan
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


def test_same_seed_same_certificate_and_nothing_changes():
    ds = TubeDS(3, n_layers=30, refined=False).fit(wavy_motion(3))
    state = {name: value.clone() for name, value in ds.state_dict().items()}
    before = torch.get_rng_state()
    assert certify(ds, n_samples=50, seed=4) == certify(ds, n_samples=50, seed=4)
    assert certify(ds, n_samples=50, seed=4) != certify(ds, n_samples=50, seed=5)
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(value, state[name]) for name, value in ds.state_dict().items())
    assert all(parameter.grad is None for parameter in ds.parameters())


def test_float32_is_judged_by_its_own_rounding():
    ds = FDM(3, n_layers=30).fit(wavy_motion(3)).to(torch.float32)
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
