"""The contract accepts an honest method and rejects each way of breaking it, by the right clause."""

from __future__ import annotations

import importlib
import math
import random
import sys

import numpy as np
import pytest
import torch
from torch import nn

import latentds
from latentds import LatentDS, Learned, LocallyWeightedTranslations, StableDS
from latentds.demonstration import only_one
from latentds.dynamics import RayDynamics
from latentds.testing import check_stable_ds, parametrize_stable_ds, wavy_motion
from latentds.testing.clauses import CLAUSES, FIT_CLAUSES
from latentds.time_law import KnottedLaw

pytest_plugins = ["pytester"]


class Plain(StableDS):
    """ẏ = -rate (y - y*): the smallest honest method, written as a third party would."""

    def __init__(self, dim):
        super().__init__(dim)
        self.rate = nn.Parameter(torch.ones((), dtype=torch.float64))

    def _learn(self, shown, progress):
        motion = only_one(shown, "Plain")
        self.attractor.copy_(motion.goal)
        with torch.no_grad():
            self.rate.fill_(3 / motion.duration)
            missed = self(motion.positions) - motion.velocities
        return Learned(float(missed.square().mean()), 0)

    def forward(self, y):
        points, wanted = self._points(y)
        return (-self.rate * (points - self.attractor)).to(wanted)

    def lyapunov(self, y):
        points, wanted = self._points(y)
        return ((points - self.attractor).square().sum(-1) + 0 * self.rate).to(wanted)

    def rollout(self, y0, t):
        points, wanted = self._points(y0, "y0")
        decay = torch.exp(-self.rate * self._times(t)).unsqueeze(-1)
        paths = self.attractor + decay * (points - self.attractor).unsqueeze(-2)
        start = torch.as_tensor(y0).to(wanted).unsqueeze(-2)  # not rounded to the module's dtype and back
        return torch.cat([start, paths[..., 1:, :].to(wanted)], dim=-2)


class Latent(LatentDS):
    """The smallest honest latent method: a bent space, not fitted to anything but the goal."""

    def __init__(self, dim):
        psi = LocallyWeightedTranslations(dim, 2)
        super().__init__(dim, psi, RayDynamics(KnottedLaw.uniform()))

    def _learn(self, shown, progress):
        motion = only_one(shown, "Latent")
        psi = self.diffeomorphism
        centers = torch.stack([motion.start, motion.goal])
        psi.assign(centers, torch.full_like(centers, 0.1 * motion.size), torch.full((2,), 1.5 / motion.size))
        self.attractor.copy_(motion.goal)
        self.start.copy_(motion.start)
        return Learned(0.0, 2)


def test_accepts_honest_methods():
    check_stable_ds(Plain)
    check_stable_ds(Latent, dims=[1, 3])


class RunsAway(Plain):
    def forward(self, y):
        return -super().forward(y)


class HasTwoEquilibria(Plain):
    """Looks right near the demonstration; a second equilibrium waits far out."""

    def forward(self, y):
        points, wanted = self._points(y)
        offset = points - self.attractor
        distance = offset.norm(dim=-1, keepdim=True)
        return (-self.rate * (1 - distance / 5) * offset).to(wanted)


class HasAnotherAttractor(Plain):
    def _learn(self, shown, progress):
        learned = super()._learn(shown, progress)
        self.attractor.copy_(shown[0].start)
        return learned


class MovesAtTheAttractor(Plain):
    def forward(self, y):
        return super().forward(y) + 0.1


class HasNegativeV(Plain):
    def lyapunov(self, y):
        return -super().lyapunov(y)


class NeverArrives(Plain):
    """V decreases all the way, but to a small sphere around the goal."""

    def rollout(self, y0, t):
        paths = super().rollout(y0, t)
        start, offset = paths[..., :1, :], paths - self.attractor
        distance, first = offset.norm(dim=-1, keepdim=True), (start - self.attractor).norm(dim=-1, keepdim=True)
        outside = self.attractor + offset / distance * (0.01 + (first - 0.01) * distance / first)
        return torch.cat([start, torch.where(first > 0.01, outside, start)[..., 1:, :]], dim=-2)


class LeavesAgain(Plain):
    """It is at the goal at every whole duration, and away from it between them."""

    def rollout(self, y0, t):
        away = 0.3 * torch.sin(np.pi * torch.as_tensor(t) / wavy_motion(self.dim).duration) ** 2
        return super().rollout(y0, t) + away.unsqueeze(-1)


class TurnsRound(Plain):
    """Twice on its way it turns round."""

    def rollout(self, y0, t):
        t = torch.as_tensor(t)
        farther = 1 + 3 * torch.sin(3 * (t - t[0])) ** 2
        return self.attractor + farther.unsqueeze(-1) * (super().rollout(y0, t) - self.attractor)


class RollsOutFaster(Plain):
    def rollout(self, y0, t):
        return super().rollout(y0, 1.01 * torch.as_tensor(t))


class BeginsElsewhere(Plain):
    def rollout(self, y0, t):
        return super().rollout(y0, t) * (1 + 1e-12)


class SqueezesABatchOfOne(Plain):
    def forward(self, y):
        return super().forward(y).squeeze(0)


class FailsOnAnEmptyBatch(Plain):
    def forward(self, y):
        torch.as_tensor(y).max()
        return super().forward(y)


class MixesRows(Plain):
    def forward(self, y):
        return super().forward(y) * (1 + 1e-3 * torch.as_tensor(y).detach().mean().tanh())


class EncodesWrongly(Latent):
    def encode(self, y):
        return super().encode(y) + 1e-3


class Folds(Latent):
    """ψ is not injective: it folds space, so no inverse exists."""

    def decode(self, x):
        return super().decode(x).abs()


class HasAWrongJacobian(Latent):
    def jacobian(self, x):
        return super().jacobian(x).transpose(-1, -2)


class DetachesGradients(Plain):
    def forward(self, y):
        return super().forward(y).detach()


class DetachesAParameter(Plain):
    def forward(self, y):
        points, wanted = self._points(y)
        return (-self.rate.detach() * (points - self.attractor)).to(wanted)

    def lyapunov(self, y):
        points, wanted = self._points(y)
        return (points - self.attractor).square().sum(-1).to(wanted)


class AnswersInFloat64(Plain):
    def forward(self, y):
        return super().forward(y).to(torch.float64)


class KeepsAFloat64Tensor(Plain):
    def __init__(self, dim):
        super().__init__(dim)
        self.scale = torch.ones(dim, dtype=torch.float64)

    def forward(self, y):
        return (super().forward(y) * self.scale).to(torch.float64)


class DropsABuffer(Plain):
    """The rate is learned, yet neither a parameter nor a buffer."""

    def __init__(self, dim):
        super().__init__(dim)
        del self.rate
        self.rate = torch.ones((), dtype=torch.float64)


class HidesTheAttractor(Plain):
    def __init__(self, dim):
        super().__init__(dim)
        del self.attractor
        self.attractor = torch.zeros(dim, dtype=torch.float64)


class CannotBePickled(Plain):
    def __init__(self, dim):
        super().__init__(dim)
        self.shift = lambda y: y


class ReturnsNothing(Plain):
    def _learn(self, shown, progress):
        super()._learn(shown, progress)


class ReportsNoNumber(Plain):
    def _learn(self, shown, progress):
        super()._learn(shown, progress)
        return Learned(math.nan)


class RemembersTheLastFit(Plain):
    def _learn(self, shown, progress):
        before = self.rate.item()
        learned = super()._learn(shown, progress)
        with torch.no_grad():
            self.rate.add_(0.1 * before)
        return learned


class IgnoresTheSeed(Plain):
    def _learn(self, shown, progress):
        learned = super()._learn(shown, progress)
        with torch.no_grad():
            self.rate.mul_(1 + random.random())
        return learned


class DependsOnUnits(Plain):
    def forward(self, y):
        return super().forward(y).clamp(-1e3, 1e3)


class ChangesTheDefaultDtype(Plain):
    def _learn(self, shown, progress):
        torch.set_default_dtype(torch.float64)
        return super()._learn(shown, progress)


class ChangesThreads(Plain):
    def _learn(self, shown, progress):
        torch.set_num_threads(torch.get_num_threads() + 1)
        return super()._learn(shown, progress)


class SeedsTorch(Plain):
    def _learn(self, shown, progress):
        torch.manual_seed(0)
        return super()._learn(shown, progress)


class SeedsNumPy(Plain):
    def _learn(self, shown, progress):
        np.random.seed(0)  # noqa: NPY002
        return super()._learn(shown, progress)


class DrawsFromEntropy(Plain):
    def _learn(self, shown, progress):
        learned = super()._learn(shown, progress)
        with torch.no_grad():
            self.rate.mul_(1 + random.SystemRandom().random())
        return learned


class DrawsWhenEvaluated(Plain):
    def forward(self, y):
        torch.rand(1)
        return super().forward(y)


class ChangesTheDefaultDtypeWhenEvaluated(Plain):
    def rollout(self, y0, t):
        torch.set_default_dtype(torch.float64)
        return super().rollout(y0, t)


class HasNoVelocitySomewhere(Plain):
    """NaN on a shell that no probe hits, but every motion crosses."""

    def forward(self, y):
        velocity = super().forward(y)
        distance = (torch.as_tensor(y) - self.attractor).norm(dim=-1, keepdim=True)
        return torch.where((distance > 0.3) & (distance < 0.31), torch.nan, velocity)


class KeepsAFloat32Attractor(Plain):
    def __init__(self, dim):
        super().__init__(dim)
        self.register_buffer("attractor", self.attractor.float())


class AnswersAnyDimension(Plain):
    def lyapunov(self, y):
        try:
            return super().lyapunov(y)
        except ValueError:
            return torch.zeros(())


class RemembersItsLatentAttractor(Latent):
    """What its frame was at first, whatever the map has become."""

    def __init__(self, dim):
        super().__init__(dim)
        self.known = super().frame()

    def _learn(self, shown, progress):
        learned = super()._learn(shown, progress)
        with torch.no_grad():
            self.known = super().frame()
        return learned

    def _linearize(self, y):
        return *super()._linearize(y)[:2], self.known


class KeepsAView(Plain):
    """The attractor lies in the demonstration's memory."""

    def _learn(self, shown, progress):
        learned = super()._learn(shown, progress)
        self.register_buffer("attractor", shown[0].goal)
        return learned


class ChangesTheDemonstration(Plain):
    def _learn(self, shown, progress):
        learned = super()._learn(shown, progress)
        shown[0].positions.sub_(shown[0].goal.clone())
        return learned


class ReadsTheClock(Plain):
    """Right for times that begin at 0."""

    def rollout(self, y0, t):
        times = torch.as_tensor(t)
        return super().rollout(y0, torch.cat([times[:1] * 0, times[1:]]))


class BeginsAtZero(Plain):
    """The state at 0 s is y0, not the state at t[0]."""

    def rollout(self, y0, t):
        return super().rollout(y0, torch.cat([torch.zeros(1), torch.as_tensor(t)]))[..., 1:, :]


class DividesByTheStep(Plain):
    def rollout(self, y0, t):
        times = torch.as_tensor(t)
        return super().rollout(y0, times[:1] + torch.cat([times[:1] * 0, (times[1:] / times.diff() * times.diff())]))


class NeedsTwoTimes(Plain):
    def rollout(self, y0, t):
        t[1]
        return super().rollout(y0, t)


class AnswersInTheTimesDtype(Plain):
    def rollout(self, y0, t):
        return super().rollout(y0, t).to(torch.as_tensor(t).dtype)


class AnswersIntegersInFloat32(Plain):
    def forward(self, y):
        y = torch.as_tensor(y)
        return super().forward(y if y.is_floating_point() else y.float())


class RefusesArrays(Plain):
    def forward(self, y):
        return super().forward(y.clone())


class ComputesInTheInputsDtype(Plain):
    def forward(self, y):
        points, wanted = self._points(y)
        return -self.rate.to(wanted) * (points.to(wanted) - self.attractor.to(wanted))


class RoundsTheStart(Plain):
    """y0, but in the module's dtype, which may be narrower than its own."""

    def rollout(self, y0, t):
        paths = super().rollout(y0, t)
        return paths.to(self.attractor.dtype).to(paths.dtype)


class IsNoStableDS(nn.Module):
    def __init__(self, dim):
        super().__init__()


BROKEN = {
    RunsAway: "check_descent: V̇ = ",
    HasTwoEquilibria: "check_descent: V̇ = ",
    HasAnotherAttractor: "check_attractor: attractor",
    MovesAtTheAttractor: "check_equilibrium: at the attractor",
    HasNegativeV: "check_descent: V = ",
    NeverArrives: "check_convergence: still",
    LeavesAgain: "check_convergence: still",
    TurnsRound: "check_fall: V rises",
    RollsOutFaster: "check_flow: off the integral",
    HasNoVelocitySomewhere: "check_flow: not finite",
    BeginsElsewhere: "check_times: begin at y0",
    ReadsTheClock: "check_times: begin at 7 s",
    BeginsAtZero: "check_times: begin at 7 s",
    DividesByTheStep: "check_times: finite",
    NeedsTwoTimes: "check_times: raised IndexError",
    SqueezesABatchOfOne: "check_batches: velocity of batch",
    FailsOnAnEmptyBatch: "check_batches: raised",
    MixesRows: "check_batches: velocity of batch",
    EncodesWrongly: "check_inverse: decode",
    Folds: "check_inverse: decode",
    HasAWrongJacobian: "check_jacobian: jacobian",
    DetachesGradients: "check_gradients: no gradient leaves velocity",
    DetachesAParameter: "check_gradients: no gradient of velocity or V reaches rate",
    AnswersInFloat64: "check_dtypes: float32 input is torch.float64",
    KeepsAFloat64Tensor: "check_dtypes: float32 input is torch.float64",
    AnswersInTheTimesDtype: "check_dtypes: rollout of torch.float32 input is torch.float64",
    AnswersIntegersInFloat32: "check_dtypes: velocity of torch.int64 input is torch.float32",
    RefusesArrays: "check_dtypes: raised AttributeError",
    ComputesInTheInputsDtype: "check_dtypes: velocity of torch.float32 input: off by",
    RoundsTheStart: "check_dtypes: rollout of torch.float64 input does not begin at y0",
    KeepsAFloat32Attractor: "check_attractor: expected float64",
    AnswersAnyDimension: "check_dimensions: V of shape .* got an answer",
    DropsABuffer: "check_serialization: after state_dict",
    HidesTheAttractor: "check_attractor: no buffer",
    CannotBePickled: "check_serialization: pickle",
    ReturnsNothing: "the factory: expected _learn to return a Learned, got NoneType",
    ReportsNoNumber: "check_report: mse is nan",
    RemembersItsLatentAttractor: "check_training: speed",
    KeepsAView: "check_memory: attractor after the demonstration was changed",
    ChangesTheDemonstration: "check_memory: the demonstration after fit",
    RemembersTheLastFit: "check_repeatability: refit",
    DrawsFromEntropy: "check_repeatability: same fit",
    DependsOnUnits: "check_scale_equivariance: other units",
    ChangesTheDefaultDtype: "check_global_state: default dtype",
    ChangesTheDefaultDtypeWhenEvaluated: "check_global_state: rollout sets the default dtype",
    ChangesThreads: "check_global_state: thread count",
    SeedsTorch: "check_global_state: seeds torch",
    SeedsNumPy: "check_global_state: NumPy",
    IgnoresTheSeed: "check_global_state: Python's random",
    DrawsWhenEvaluated: "check_global_state: velocity draws",
    IsNoStableDS: "the factory: expected a StableDS",
}
"""Each with the clause that rejects it, and with what words."""


def globals_now():
    return torch.get_default_dtype(), torch.get_num_threads(), random.getstate(), torch.get_rng_state().tolist()


@pytest.mark.parametrize("stub", BROKEN, ids=lambda stub: stub.__name__)
def test_rejects(stub):
    before = globals_now()
    clause, words = BROKEN[stub].split(": ", 1)
    with pytest.raises(AssertionError, match=rf"{clause}[^\n]*{words}") as caught:
        check_stable_ds(stub, dims=[2])
    assert stub.__name__ in str(caught.value) or "factory" in str(caught.value)
    assert "2-D" in str(caught.value)
    assert globals_now() == before  # a broken method harms nobody else


def test_every_clause_rejects_something():
    clauses = {clause.__name__ for clause in (*CLAUSES, *FIT_CLAUSES)}
    assert clauses == {words.split(": ", 1)[0] for words in BROKEN.values()} - {"the factory"}


@pytest.mark.parametrize(
    ("name", "called"),
    [("forward", "velocity"), ("lyapunov", "V")]
    + [(name,) * 2 for name in ("rollout", "encode", "decode", "jacobian")],
)
def test_rejects_another_error_than_a_value_error(name, called, monkeypatch):
    honest = getattr(Latent, name)

    def careless(self, *given):
        try:
            return honest(self, *given)
        except ValueError as error:
            raise RuntimeError("mat1 and mat2 cannot be multiplied") from error

    monkeypatch.setattr(Latent, name, careless)
    with pytest.raises(AssertionError, match=rf"check_dimensions.* {called} of shape .*raised RuntimeError: mat1"):
        check_stable_ds(Latent, dims=[2], fitted=[False])


class HasTwoFaults(MovesAtTheAttractor, ReportsNoNumber):
    pass


def test_tells_all_failures_at_once():
    with pytest.raises(AssertionError) as caught:
        check_stable_ds(HasTwoFaults, dims=[1, 2])
    lines = str(caught.value).splitlines()
    for dim in (1, 2):
        assert sum(f"({dim}-D, fitted) breaks check_report" in line for line in lines) == 1
        for state in ("fitted", "unfitted"):
            assert sum(f"({dim}-D, {state}) breaks check_equilibrium" in line for line in lines) == 1
    assert all(line.startswith("HasTwoFaults (") for line in lines)


def test_a_factory_that_fails_in_one_dimension_does_not_hide_the_others():
    def factory(dim):
        if dim == 2:
            raise RuntimeError("not in the plane")
        return ReportsNoNumber(dim)

    with pytest.raises(AssertionError, match=r"the factory \(2-D, unfitted\).* not in the plane") as caught:
        check_stable_ds(factory, dims=[1, 2, 3])
    assert [f"{dim}-D, fitted) breaks check_report" in str(caught.value) for dim in (1, 3)] == [True, True]


def test_expected_failures():
    reason = {"check_report": "has none by design"}
    check_stable_ds(ReportsNoNumber, dims=[1, 2], expected_failures=reason)
    with pytest.raises(AssertionError, match="check_equilibrium") as caught:
        check_stable_ds(HasTwoFaults, dims=[2], expected_failures=reason)
    assert "check_report" not in str(caught.value)
    with pytest.raises(AssertionError, match=r"^Plain \(2-D, fitted\) keeps check_report.* has none by design$"):
        check_stable_ds(Plain, dims=[2], expected_failures=reason)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"report": "why"}, "expected clauses among .*'check_report'.*, got 'report'"),
        ({"check_report": ""}, "expected a reason for check_report, got ''"),
        ({"check_report": True}, "expected a reason for check_report, got True"),
    ],
)
def test_expected_failures_are_clauses_with_reasons(given, message):
    with pytest.raises(ValueError, match=f"expected_failures: {message}"):
        check_stable_ds(Plain, expected_failures=given)
    with pytest.raises(ValueError, match=f"expected_failures: {message}"):
        parametrize_stable_ds({"Plain": Plain}, expected_failures={"Plain": given})


def test_expected_failures_are_of_given_labels():
    with pytest.raises(ValueError, match=r"expected_failures: expected labels among \['Plain'\], got \['Plane'\]"):
        parametrize_stable_ds({"Plain": Plain}, expected_failures={"Plane": {"check_report": "why"}})


class CountsFits(Latent):
    fits = 0

    def _learn(self, shown, progress):
        learned = super()._learn(shown, progress)
        CountsFits.fits += 1
        return learned


def items(factories, **chosen):
    """Every test of the decorator: {name: call}."""
    _, params = parametrize_stable_ds(factories, **chosen).mark.args
    return {param.id: param.values[0] for param in params}


def test_fits_four_times_in_each_dimension(monkeypatch):
    monkeypatch.setattr(CountsFits, "fits", 0)
    check_stable_ds(CountsFits, dims=[1, 2])
    assert CountsFits.fits == 8
    check_stable_ds(CountsFits, dims=[1, 2], fitted=[False])
    assert CountsFits.fits == 8


def test_items_share_one_case_which_none_changes(monkeypatch):
    monkeypatch.setattr(CountsFits, "fits", 0)
    made = []

    def factory(dim):
        made.append(CountsFits(dim))
        return made[-1]

    checks = items({"it": factory}, dims=[2], fitted=[True])
    assert list(checks) == [f"it-2-fitted-{clause.__name__}" for clause in (*FIT_CLAUSES, *CLAUSES)]
    checks["it-2-fitted-check_report"]()
    assert CountsFits.fits == 1
    before = {name: tensor.clone() for name, tensor in made[0].state_dict().items()}
    for check in (*checks.values(), *reversed(checks.values())):
        check()
    assert CountsFits.fits == 1 + 2 * 3  # one is shared; three are made by the clauses about refits and units
    after = made[0].state_dict()
    assert all(torch.equal(tensor, after[name]) for name, tensor in before.items())


def test_one_pytest_item_per_clause(pytester):
    pytester.makepyfile(
        f"""
        import sys
        from latentds.testing import parametrize_stable_ds

        stubs = sys.modules[{__name__!r}]

        @parametrize_stable_ds(
            {{"honest": stubs.Plain, "silent": stubs.ReportsNoNumber, "runaway": stubs.RunsAway}},
            dims=[2],
            expected_failures={{
                "honest": {{"check_flow": "a lie"}},
                "silent": {{"check_report": "by design"}},
            }},
        )
        def test_contract(check):
            check()
        """
    )
    result = pytester.runpytest_inprocess("-p", "no:cacheprovider", "-p", "no:xdist")
    per_method = 2 * len(CLAUSES) + len(FIT_CLAUSES)
    runaway = 2 * 2  # in two states, two clauses: descent and flow
    result.assert_outcomes(xfailed=1, failed=2 + runaway, passed=3 * per_method - 1 - 2 - runaway)
    result.stdout.fnmatch_lines(["*FAILED*test_contract?honest-2-unfitted-check_flow?*"])
    result.stdout.fnmatch_lines(["*FAILED*test_contract?runaway-2-fitted-check_descent?*"])
    assert "XPASS(strict)" in result.stdout.str()


def test_needs_no_pytest(monkeypatch):
    monkeypatch.setitem(sys.modules, "pytest", None)
    monkeypatch.setattr(latentds, "testing", latentds.testing)
    for name in [name for name in sys.modules if name.startswith("latentds.testing")]:
        monkeypatch.delitem(sys.modules, name)
    fresh = importlib.import_module("latentds.testing")
    assert fresh.check_stable_ds is not check_stable_ds
    fresh.check_stable_ds(Plain, dims=[1])
    with pytest.raises(ImportError, match="pytest"):
        fresh.parametrize_stable_ds({"Plain": Plain})


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_wavy_motion_never_meets_itself(dim):
    shown = wavy_motion(dim)
    apart = torch.cdist(shown.positions, shown.positions).fill_diagonal_(1)
    assert apart.min() > 1e-4
    assert shown.dim == dim
