"""What every system keeps through training, edits, copies and moves: its attractor, its report, its dtype."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import replace

import pytest
import torch

import latentds
from baselines import FDM, SDSEF
from latentds import ChebyshevDS, TubeDS, datasets
from latentds.dynamics import TubeDynamics
from latentds.kernels.dispatch import reference
from latentds.testing import wavy_motion
from latentds.time_law import KnottedLaw


@pytest.fixture
def ds(fitted, method):
    return fitted(method, 2)


@torch.no_grad()
def shake(system, size=0.05, seed=0):
    draw = torch.Generator().manual_seed(seed)
    for parameter in system.parameters():
        noise = torch.randn(parameter.shape, generator=draw, dtype=torch.float64)
        parameter += size * (1 + parameter.abs().mean()) * noise.to(parameter)


@torch.no_grad()
def rests_at(system, goal, tolerance=1e-9):
    times = torch.tensor([0.0, 1e3], dtype=torch.float64)
    starts = goal + torch.tensor([[0.3, 0.1], [-0.2, 0.4]], dtype=torch.float64)
    assert system(goal).abs().max() < tolerance
    assert system.lyapunov(goal).abs() < tolerance
    assert (system.rollout(starts, times)[:, -1] - goal).abs().max() < tolerance


def train(system, steps=20):
    shown = wavy_motion(2)
    optimiser = torch.optim.Adam(system.parameters(), lr=0.01)
    for _ in range(steps):
        optimiser.zero_grad()
        (system.rollout(shown.start, shown.times[::20]) - shown.positions[::20] - 0.1).square().mean().backward()
        optimiser.step()


# --- the attractor ----------------------------------------------------------------------------------------------------


def test_training_through_rollouts_leaves_the_attractor_where_it_was(ds):
    goal, before = ds.attractor.clone(), ds.diffeomorphism.state_dict()
    before = {name: value.clone() for name, value in before.items()}
    train(ds)
    assert any(not torch.equal(before[name], value) for name, value in ds.diffeomorphism.state_dict().items())
    assert torch.equal(ds.attractor, goal)
    rests_at(ds, goal)
    for twin in (copy.deepcopy(ds), pickle.loads(pickle.dumps(ds))):
        rests_at(twin, goal)
    speed = float(ds(goal + 0.1).detach().abs().max())
    assert abs(ds.controller()(goal.numpy())).max() < 1e-9 * speed


def edit_in_place(ds, state):
    for parameter, value in zip(ds.diffeomorphism.parameters(), state, strict=True):
        parameter.data.copy_(value)


def load_psi(ds, state):
    names = [name for name, _ in ds.diffeomorphism.named_parameters()]
    ds.diffeomorphism.load_state_dict(dict(zip(names, state, strict=True)), strict=False)


def replace_parameters(ds, state):
    for (name, _), value in zip(list(ds.diffeomorphism.named_parameters()), state, strict=True):
        path, _, leaf = name.rpartition(".")
        setattr(ds.diffeomorphism.get_submodule(path), leaf, torch.nn.Parameter(value.clone()))


@pytest.mark.parametrize("change", [edit_in_place, load_psi, replace_parameters])
def test_whoever_changes_the_map_and_however(ds, change):
    goal, y = ds.attractor.clone(), torch.randn(5, 2, dtype=torch.float64)
    other = copy.deepcopy(ds)
    shake(other)
    with torch.no_grad():
        before = ds(y)
        change(ds, list(other.diffeomorphism.parameters()))
        assert not torch.allclose(ds(y), before)
    rests_at(ds, goal)


def test_nothing_is_recomputed_while_nothing_changed(ds, monkeypatch):
    psi, calls = ds.diffeomorphism, []
    inverse = type(psi).inverse
    monkeypatch.setattr(type(psi), "inverse", lambda self, y: calls.append(y) or inverse(self, y))
    with torch.no_grad():
        ds(ds.start), ds.frame(), ds.lyapunov(ds.start)
        calls.clear()
        first = ds.frame()
        assert ds.frame() is first
        assert not calls
        ds.start.add_(0.1)
        assert ds.frame() is not first
        assert len(calls) == 1


def test_the_frame_carries_gradients(ds):
    """Of the velocity by every parameter of ψ, x*, axis and length among what depends on it: against differences."""
    y = ds.start + 0.1
    parameter = next(iter(ds.diffeomorphism.parameters()))
    ds(y).sum().backward()
    for index in (0, parameter.numel() // 2):
        at = parameter.data.view(-1)
        step, values = 1e-6, []
        for side in (1, -1):
            at[index] += side * step
            values.append(float(ds(y).sum().detach()))
            at[index] -= side * step
        found = float(parameter.grad.view(-1)[index])
        assert found == pytest.approx((values[0] - values[1]) / (2 * step), rel=1e-4, abs=1e-6)


def test_every_way_to_compute_gives_the_same(ds):
    y, times = torch.randn(2, 3, 2, dtype=torch.float64), torch.tensor([0.0, 0.3, 1.0])
    for call in (ds, ds.lyapunov, lambda y: ds.rollout(y, times)):
        with torch.no_grad():
            kept = call(y)
            with reference():
                slow = call(y)
        found = [call(y).detach(), slow]
        if not isinstance(ds, SDSEF):  # whose rollout reads how far away its starts lie
            found.append(torch.func.vmap(torch.func.vmap(call))(y).detach())
        for one in found:
            torch.testing.assert_close(one, kept, rtol=1e-7, atol=1e-9)


def test_functional_call_with_other_parameters_rests_too(ds):
    other = copy.deepcopy(ds)
    shake(other)
    state, goal = dict(other.named_parameters()), ds.attractor
    with torch.no_grad():
        assert torch.func.functional_call(ds, state, goal).abs().max() < 1e-9
        torch.testing.assert_close(torch.func.functional_call(ds, state, ds.start), other(ds.start))
        assert ds(goal).abs().max() < 1e-9

    def energy(parameters, y):
        return torch.func.functional_call(ds, parameters, y).square().sum()

    slopes = torch.func.grad(energy)(state, ds.start)
    other(ds.start).square().sum().backward()
    for name, parameter in other.named_parameters():
        torch.testing.assert_close(slopes[name], parameter.grad, rtol=1e-6, atol=1e-9)


def test_an_attractor_that_is_assigned_to_is_written_in_place(ds):
    buffer, goal = ds.attractor, ds.attractor.clone()
    ds.attractor = (goal + 0.1).float()
    assert ds.attractor is buffer
    rests_at(ds, (goal + 0.1).float().double())
    ds.attractor += 0.1
    rests_at(ds, (goal + 0.1).float().double() + 0.1)
    for wrong in ([1.0], [0.0, math.nan], "here"):
        with pytest.raises(ValueError, match=r"^attractor: expected"):
            ds.attractor = wrong
    with pytest.raises(ValueError, match=r"^attractor: .*with_goal"):  # a gradient would be lost
        ds.attractor = goal.clone().requires_grad_()


def test_an_attractor_moved_in_place_moves_the_motion(ds):
    goal = ds.attractor + torch.tensor([0.2, -0.1], dtype=torch.float64)
    ds.attractor.copy_(goal)
    rests_at(ds, goal)


def test_an_attractor_at_the_very_start_is_still_one(ds):
    ds.attractor.copy_(ds.start)
    rests_at(ds, ds.start.clone())


@pytest.mark.parametrize("assign", [False, True])
def test_a_state_loads_with_its_attractor(ds, assign):
    fresh = copy.deepcopy(ds)
    shake(fresh)
    fresh.attractor.zero_()
    fresh.load_state_dict(ds.state_dict(), assign=assign)
    assert torch.equal(fresh.attractor, ds.attractor)
    assert torch.equal(fresh(ds.start), ds(ds.start))
    fresh.attractor = ds.start
    rests_at(fresh, ds.start)


def test_float32_follows_and_comes_back(ds):
    goal = ds.attractor.clone()
    y, wanted = ds.start + 0.1, ds(ds.start + 0.1).detach()
    ds.float()
    with torch.no_grad():
        assert ds.frame().attractor.dtype == torch.float32
        assert (ds(y) - wanted).abs().max() < 1e-3 * wanted.abs().max()
        ds.double()
        assert ds.frame().attractor.dtype == torch.float64
    rests_at(ds, goal.float().double())


# --- the report -------------------------------------------------------------------------------------------------------


def test_the_report_says_when_it_is_older_than_the_system(ds):
    assert ds.fit_report_is_current
    for twin in (copy.deepcopy(ds), pickle.loads(pickle.dumps(ds)), copy.deepcopy(ds).float().double()):
        assert twin.fit_report_is_current
    report = ds.fit_report
    train(ds, steps=1)
    assert ds.fit_report is report
    assert not ds.fit_report_is_current
    assert not pickle.loads(pickle.dumps(ds)).fit_report_is_current
    ds.fit(wavy_motion(2))
    assert ds.fit_report_is_current


def test_no_report_is_not_current():
    assert not FDM(2).fit_report_is_current


# --- dtypes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_refused_and_answered(ds, dtype):
    y = ds.start.to(dtype)
    wanted = ds(y.double()).to(dtype)
    with pytest.raises(ValueError, match=f"dtype: expected .* got {dtype}"):
        ds.to(dtype)
    with pytest.raises(ValueError, match="dtype: expected"):
        torch.nn.Sequential(ds).half()
    assert torch.equal(ds(y), wanted)


NAMED = replace(datasets.archimedean_spiral(60), columns=("shoulder", "elbow"))


@pytest.mark.parametrize("make", [lambda: ChebyshevDS(2, n_layers=5), lambda: ChebyshevDS(2, n_layers=5).slowed(2.0)])
@pytest.mark.filterwarnings("ignore::latentds.FitWarning")
def test_a_fit_keeps_the_names_of_the_coordinates(make, tmp_path):
    ds = make()
    assert ds.fit(NAMED).fit_report.columns == NAMED.columns
    ds.save(tmp_path / "named")
    assert latentds.load(tmp_path / "named").fit_report.columns == NAMED.columns
    assert ds.fit(replace(NAMED, columns=())).fit_report.columns == ()


def test_names_of_coordinates_change_no_number():
    assert NAMED.fingerprint == replace(NAMED, columns=()).fingerprint


def test_demonstrations_of_other_columns_are_not_fitted_together():
    swapped = replace(NAMED, columns=("elbow", "shoulder"))
    with pytest.raises(ValueError, match=r"^demonstration: expected the same columns in all, got"):
        TubeDS(2).fit([NAMED, swapped])


def write_through_data(ds):
    next(ds.parameters()).data[0] += 0.05  # no version counter moves


def slow_the_law(ds):
    ds.dynamics.law.speeds.mul_(0.5)


def replace_the_law(ds):
    ds.dynamics.law = KnottedLaw.uniform(7.0)


def hook(ds):
    ds.dynamics.register_forward_hook(lambda module, given, result: 2 * result)


def set_a_method(ds):
    ds.dynamics.forward = lambda x, y, frame: torch.ones_like(x)


def set_a_private_method(ds):
    ds._linearize = lambda y: (y, lambda tangent: -tangent, ds.frame())


def move_the_attractor(ds):
    ds.attractor += 0.1


def parametrize(ds):
    torch.nn.utils.parametrize.register_parametrization(ds.diffeomorphism, "strengths", Halved())


def not_a_number(ds):
    next(ds.parameters()).data[0] = torch.nan


class Halved(torch.nn.Module):
    def forward(self, strengths):
        return strengths / 2


CHANGES = [write_through_data, slow_the_law, replace_the_law, hook, set_a_method, set_a_private_method]
CHANGES += [move_the_attractor, parametrize]


@pytest.mark.parametrize("change", [*CHANGES, not_a_number])
def test_the_velocity_of_one_point_sees_every_change(change):
    shown = wavy_motion(2)
    ds = TubeDS(2, n_layers=20).fit(shown).requires_grad_(False)
    y = shown.start + 0.05
    before = ds(y)
    with reference():
        torch.testing.assert_close(before, ds(y), rtol=1e-9, atol=1e-12)
    change(ds)
    after = ds(y)
    with reference():
        torch.testing.assert_close(after, ds(y), rtol=1e-9, atol=1e-12, equal_nan=True)
    assert not torch.equal(before, after)


class Scaled(TubeDynamics):
    """Dynamics whose table is made of an array that is no buffer."""

    def __init__(self, dynamics):
        super().__init__(dynamics.law, dynamics.transverse_law)
        self.factor = torch.ones(1, dtype=torch.float64)

    def forward(self, x, y, frame):
        return self.factor * super().forward(x, y, frame)

    def table(self, frame):
        goal, *laws = TubeDynamics.table(self, frame)
        return goal, *(law.faster(float(self.factor)) for law in laws)


def test_the_velocity_of_one_point_sees_what_an_array_became():
    shown = wavy_motion(2)
    ds = TubeDS(2, n_layers=20).fit(shown).requires_grad_(False)
    y = shown.start + 0.05
    before = ds(y)
    ds.dynamics = Scaled(ds.dynamics)
    torch.testing.assert_close(ds(y), before, rtol=1e-9, atol=1e-12)
    ds.dynamics.factor *= 2
    torch.testing.assert_close(ds(y), 2 * before, rtol=1e-9, atol=1e-12)


def test_the_velocity_of_one_point_has_every_shape_dtype_and_derivative():
    shown = wavy_motion(3)
    ds = TubeDS(3, n_layers=20).fit(shown)
    y = shown.start + 0.05
    assert ds(y).requires_grad
    with torch.no_grad():
        for shape in [(3,), (1, 3), (1, 1, 3)]:
            assert ds(y.view(shape)).shape == shape
        assert ds(y.float()).dtype == torch.float32
        assert ds(torch.full((3,), torch.nan)).isnan().all()
        assert torch.equal(copy.deepcopy(ds)(y), ds(y))
        wanted = ds(y)
        torch.testing.assert_close(torch.func.vmap(ds)(y[None])[0], wanted)
        torch.testing.assert_close(ds.float()(y), wanted, rtol=1e-4, atol=1e-5)
    frozen = pickle.loads(pickle.dumps(ds)).double().requires_grad_(False)
    point = y.clone().requires_grad_()
    frozen(point).sum().backward()
    assert point.grad is not None
