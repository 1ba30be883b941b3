"""Systems moved, turned, scaled and slowed: the same motion elsewhere, and systems like any other."""

from __future__ import annotations

import copy
import math
import pickle
import warnings
from dataclasses import replace

import numpy as np
import pytest
import torch

import latentds
from baselines import FDM, SDSEF
from latentds import ChebyshevDS, Demonstration, TubeDS, certify, datasets
from latentds.base import MovedDS
from latentds.fidelity import Excerpt
from latentds.testing import parametrize_stable_ds, wavy_motion

F64 = torch.float64


def turn(dim, seed=0):
    """A random rotation (or, by chance, a reflection)."""
    return torch.linalg.qr(torch.randn(dim, dim, generator=torch.Generator().manual_seed(seed), dtype=F64))[0]


KINDS = {
    "TubeDS": lambda dim: TubeDS(dim, n_layers=12, refined=False),
    "FDM": lambda dim: FDM(dim, n_layers=12),
    "SDSEF": lambda dim: SDSEF(dim, n_layers=3, n_features=20, seed=0, epochs=10),
}


@pytest.mark.slow
@parametrize_stable_ds(
    {
        "turned": lambda dim: KINDS["TubeDS"](dim).transformed(rotation=turn(dim), scale=2.0).slowed(1.5),
        "slowed": lambda dim: KINDS["SDSEF"](dim).slowed(0.5),
    },
    dims=[2, 3, 7],
)
def test_contract(check):
    check()


@parametrize_stable_ds(
    {"with another goal": lambda dim: KINDS["FDM"](dim).with_goal(torch.ones(dim))}, dims=[2], fitted=[True]
)
def test_contract_from_another_goal(check):
    check()


@pytest.fixture(params=KINDS)
def fitted(request):
    return KINDS[request.param](2).fit(wavy_motion(2))


@torch.no_grad()
def test_the_same_motion_to_another_goal(fitted, draw):
    shift = torch.tensor([3.0, -7.0], dtype=F64)
    moved = fitted.with_goal(fitted.attractor + shift)
    y, times = torch.randn(6, 2, generator=draw, dtype=F64), torch.linspace(0, 2, 5, dtype=F64)
    torch.testing.assert_close(moved.attractor, fitted.attractor + shift, rtol=0, atol=0)
    torch.testing.assert_close(moved(y + shift), fitted(y))
    torch.testing.assert_close(moved.lyapunov(y + shift), fitted.lyapunov(y))
    torch.testing.assert_close(moved.rollout(y + shift, times), fitted.rollout(y, times) + shift)


@torch.no_grad()
def test_the_same_motion_turned_scaled_shifted_and_slowed(fitted, draw):
    rotation, translation = turn(2), torch.tensor([0.5, -2.0], dtype=F64)
    moved = fitted.transformed(rotation=rotation, translation=translation, scale=3.0).slowed(2.0)
    y, times = torch.randn(2, 3, 2, generator=draw, dtype=F64), torch.linspace(0, 2, 5, dtype=F64)

    def image(z):
        return 3 * z @ rotation.T + translation

    torch.testing.assert_close(moved.attractor, image(fitted.attractor))
    torch.testing.assert_close(moved(image(y)), 3 * fitted(y) @ rotation.T / 2)
    torch.testing.assert_close(moved.lyapunov(image(y)), fitted.lyapunov(y))
    torch.testing.assert_close(moved.rollout(image(y), 2 * times), image(fitted.rollout(y, times)))


@torch.no_grad()
def test_moved_twice_is_moved_once(fitted, draw):
    y, rotation = torch.randn(4, 2, generator=draw, dtype=F64), turn(2)
    once = fitted.transformed(rotation=rotation, translation=torch.ones(2), scale=0.5)
    twice = fitted.transformed(scale=0.5).transformed(rotation=rotation).transformed(translation=[1, 1])
    torch.testing.assert_close(twice(y), once(y))
    torch.testing.assert_close(fitted.with_goal([9.0, 9.0]).with_goal(fitted.attractor)(y), fitted(y))


def test_the_system_inside_is_the_same_and_is_trained(fitted):
    moved = fitted.with_goal([1.0, 2.0]).slowed(2.0)
    assert moved.ds.ds is fitted
    assert [id(p) for p in moved.parameters()] == [id(p) for p in fitted.parameters()]
    before = {name: value.clone() for name, value in fitted.state_dict().items()}
    moved.rollout(torch.zeros(2), torch.tensor([0.0, 0.5])).square().sum().backward()
    torch.optim.SGD(moved.parameters(), 1e-3).step()
    assert any(not torch.equal(before[name], value) for name, value in fitted.state_dict().items())
    with torch.no_grad():
        assert moved(torch.tensor([1.0, 2.0])).abs().max() < 1e-9
    assert not moved.fit_report_is_current
    assert moved.fit_report is fitted.fit_report


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
def test_the_same_shape_between_another_start_and_goal(dim, draw):
    ds = FDM(dim, n_layers=12).fit(wavy_motion(dim))
    begun, ended = ds.start, ds.attractor
    begin, end = torch.randn(2, dim, generator=draw, dtype=F64)
    end = begin + (end - begin) * (ended - begun).norm() / (end - begin).norm() * 1.5
    moved, times = ds.with_start_and_goal(begin, end), torch.linspace(0, 2, 50, dtype=F64)
    with torch.no_grad():
        there, here = moved.rollout(begin, times), ds.rollout(begun, times)
    torch.testing.assert_close(torch.cdist(there, there), 1.5 * torch.cdist(here, here))  # its shape
    torch.testing.assert_close(moved.attractor, end, rtol=0, atol=0)
    rotation, a, b = (
        moved.similarity.rotation,
        (ended - begun) / (ended - begun).norm(),
        (end - begin) / (end - begin).norm(),
    )
    torch.testing.assert_close(rotation @ a, b)
    plane = torch.linalg.qr(torch.stack([a, b], dim=1))[0]
    aside = torch.randn(dim, generator=draw, dtype=F64)
    aside -= plane @ (plane.T @ aside)
    torch.testing.assert_close(rotation @ aside, aside)  # what is across both is left alone: no shorter turn
    same = ds.with_start_and_goal(begun, ended)
    torch.testing.assert_close(same.similarity.rotation, torch.eye(dim, dtype=F64))
    twice = moved.slowed(2.0).with_start_and_goal(begun, ended)
    torch.testing.assert_close(twice(begin), ds(begin) / 2)


def test_a_way_back_has_one_turn_in_the_plane_and_is_asked_about_in_space():
    for dim in (1, 2):
        ds = FDM(dim, n_layers=12).fit(wavy_motion(dim))
        back = ds.with_start_and_goal(ds.attractor, ds.start)
        torch.testing.assert_close(back.similarity.rotation, -torch.eye(dim, dtype=F64))
    ds = FDM(3, n_layers=12).fit(wavy_motion(3)).float()
    with pytest.raises(ValueError, match=r"^start, goal: expected a way that is not the opposite .*transformed"):
        ds.with_start_and_goal(ds.attractor, ds.start)
    with pytest.raises(ValueError, match=r"^start, goal: expected two points, got one"):
        ds.with_start_and_goal(ds.attractor, ds.attractor)
    with pytest.raises(ValueError, match=r"^ds: expected a system that keeps what it was shown"):
        FDM(3).with_start_and_goal([0, 0, 0], [1, 1, 1])
    with pytest.raises(ValueError, match=r"^start: expected \(3,\) finite numbers"):
        ds.with_start_and_goal([0, 0], [1, 1, 1])


def test_gradients_and_batches_reach_start_and_goal(fitted, draw):
    times = torch.linspace(0, 1, 3, dtype=F64)

    def midway(ends):
        return fitted.with_start_and_goal(*ends).rollout(ends[0], times)[1]

    ends = torch.tensor([[0.3, 2.0], [1.0, -1.0]], dtype=F64, requires_grad=True)
    assert torch.autograd.gradcheck(midway, ends, atol=1e-4, rtol=1e-3)
    if isinstance(fitted, FDM):
        several = torch.randn(4, 2, 2, generator=draw, dtype=F64)
        with torch.no_grad():
            torch.testing.assert_close(torch.func.vmap(midway)(several), torch.stack([midway(one) for one in several]))


def test_a_robot_that_would_lunge_is_told_of():
    shown = datasets.unstable_spiral(1, n_points=200)
    ds = TubeDS(3, n_layers=50, refined=False).fit(shown)
    goal = shown.goal + torch.tensor([0.2, 0.0, -0.1])
    with pytest.warns(
        UserWarning, match=r"with_goal: .*the first command is now (.*) times .* with_start_and_goal"
    ) as told:
        moved = ds.with_goal(goal)
    with torch.no_grad():
        lunge = float(moved(shown.start).norm() / shown.velocities.norm(dim=-1).max())
    assert f"now {lunge:.3g} times" in str(told[0].message)
    assert told[0].filename == __file__
    with pytest.warns(UserWarning, match=r"with_start_and_goal: the motion is now 3 times as long .* slowed"):
        ds.with_start_and_goal(shown.goal + 3 * (shown.start - shown.goal), shown.goal)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        kept = ds.with_start_and_goal(shown.start, goal)
        ds.with_goal(shown.goal + 0.001)
        ds.with_goal(goal.clone().requires_grad_())
        TubeDS(3).with_goal(goal)  # nothing was shown to it
    with torch.no_grad():
        assert kept(shown.start).norm() < 1.2 * ds(shown.start).norm()


def test_gradients_reach_the_goal(fitted):
    goal, times = torch.tensor([1.0, 2.0], dtype=F64, requires_grad=True), torch.linspace(0, 9, 3, dtype=F64)
    net = torch.nn.Linear(3, 2, dtype=F64)
    fitted.with_goal(goal).rollout(torch.zeros(2, dtype=F64), times)[-1].sum().backward()
    step, ends = 1e-5, []
    for side in (1, -1):
        with torch.no_grad():
            ends.append(fitted.with_goal(goal + side * step).rollout(torch.zeros(2, dtype=F64), times)[-1].sum())
    assert float(goal.grad.sum()) == pytest.approx(float(ends[0] - ends[1]) / (2 * step), rel=1e-5)
    fitted.requires_grad_(False).with_goal(net(torch.ones(3, dtype=F64)))(torch.zeros(2)).sum().backward()
    assert net.weight.grad.abs().max() > 0


@torch.no_grad()
def test_goals_in_a_batch():
    fitted = KINDS["FDM"](2).fit(wavy_motion(2))
    goals, y = torch.randn(4, 2, dtype=F64), torch.randn(2, dtype=F64)
    found = torch.func.vmap(lambda goal: fitted.with_goal(goal)(y))(goals)
    torch.testing.assert_close(found, torch.stack([fitted.with_goal(goal)(y) for goal in goals]))


def test_it_learns_what_it_is_shown():
    shown = wavy_motion(2)
    moved = KINDS["TubeDS"](2).transformed(rotation=turn(2), translation=[3.0, 1.0], scale=0.2).slowed(4.0).fit(shown)
    torch.testing.assert_close(moved.attractor, shown.goal)
    with torch.no_grad():
        path = moved.rollout(shown.start, shown.times)
    assert (path - shown.positions).norm(dim=-1).max() < 0.1 * shown.size
    assert moved.fit_report_is_current
    several = Demonstration(shown.positions + 0.1 * (1 - torch.linspace(0, 1, len(shown)).unsqueeze(1)), shown.dt)
    assert torch.allclose(moved.fit([shown, several]).attractor, shown.goal)


def test_its_report_names_what_it_was_shown_not_what_the_system_inside_was():
    several = [wavy_motion(2), replace(wavy_motion(2, seed=1), name="another")]
    moved = KINDS["TubeDS"](2).transformed(rotation=turn(2), translation=[3.0, 1.0], scale=0.2).slowed(4.0)
    for shown in (several[:1], several):
        learned = moved.fit(shown).fit_report.learned_from
        assert learned == tuple(one.fingerprint for one in shown)


def test_its_excerpts_are_those_of_the_motion_moved():
    """As if the motion itself had been turned, scaled and slowed before it was looked at."""
    shown, rotation, translation = wavy_motion(2), turn(2), torch.tensor([3.0, 1.0], dtype=F64)
    inside = KINDS["FDM"](2).fit(shown)
    moved = inside.transformed(rotation=rotation, translation=translation, scale=0.2).slowed(4.0)
    expected = Excerpt.of(Demonstration(0.2 * shown.positions @ rotation.T + translation, 4 * shown.dt))
    (found,) = moved.excerpts()
    np.testing.assert_allclose(found.path, expected.path, atol=1e-12)
    for name in ("duration", "fastest", "ruler"):
        assert getattr(found, name) == pytest.approx(getattr(expected, name), rel=1e-6)
    assert FDM(2).slowed(2.0).excerpts() == ()


@torch.no_grad()
def test_its_latent_error_is_that_of_the_motion_inside(draw):
    """Where and when the system inside is asked, told by an answer that depends on both."""

    class Telling(FDM):
        def latent_error(self, y0, t):
            return torch.linalg.vector_norm(self.latent_motion(y0, t), dim=-1)

    inside, rotation, translation = Telling(2, n_layers=12).fit(wavy_motion(2)), turn(2), torch.tensor([3.0, 1.0])
    moved = inside.transformed(rotation=rotation, translation=translation, scale=2.0).slowed(4.0)
    y, times = torch.randn(5, 2, generator=draw, dtype=F64), torch.linspace(0, 2, 7, dtype=F64)
    found = moved.latent_error(2 * y @ rotation.T + translation, 4 * times)
    assert found.std() > 0.01
    torch.testing.assert_close(found, inside.latent_error(y, times))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_saved_and_loaded_with_what_is_inside(fitted, tmp_path, dtype):
    moved = fitted.with_goal([1.0, 2.0]).transformed(rotation=turn(2), scale=2.0).slowed(3.0).to(dtype)
    moved.save(tmp_path / "a")
    back = latentds.load(tmp_path / "a", classes=[FDM, SDSEF])
    y = torch.randn(5, 2)
    with torch.no_grad():
        for twin in (back, pickle.loads(pickle.dumps(moved)), copy.deepcopy(moved)):
            assert torch.equal(twin(y), moved(y))
            assert torch.equal(twin.attractor, moved.attractor)
    assert back.fit_report == moved.fit_report
    assert type(back.ds.ds.ds) is type(fitted)
    assert back.fit_report_is_current


@pytest.mark.parametrize(
    ("name", "value"), [("rotation", 1.1 * torch.eye(2)), ("scale", torch.tensor(-1.0)), ("speed", torch.tensor(0.0))]
)
def test_a_state_that_makes_no_stable_system_does_not_load(name, value):
    moved = FDM(2).slowed(2.0)
    with pytest.raises(RuntimeError, match=f"{name}: expected"):
        moved.load_state_dict(moved.state_dict() | {f"similarity.{name}": value})


@pytest.mark.slow
def test_certified_where_the_motion_is_shown(fitted):
    here, moved = certify(fitted, n_samples=200), fitted.with_goal([50.0, 2.0]).transformed(scale=2.0)
    there = certify(moved, n_samples=200)
    off = [{line.claim: line.worst for line in found.falsified} for found in (here, there)]
    assert off[0].keys() <= {"follows its demonstration"}  # of ten epochs
    assert off[1] == pytest.approx(off[0])
    low, high = np.array(there.region)
    assert (low < moved.attractor.numpy()).all()
    assert (moved.attractor.numpy() < high).all()
    spans = [np.ptp(np.array(found.region), axis=0) for found in (here, there)]
    np.testing.assert_allclose(spans[1], 2 * spans[0], rtol=1e-6)
    proven = [line.claim for line in there.lines if line.verdict == "proven"]
    assert len(proven) == 1
    assert "layer" in proven[0] or "coupling" in proven[0]


def test_one_without_surroundings_is_searched_where_it_was_shown(fitted):
    class Bare(type(fitted)):
        def surroundings(self, ball):
            return None

    fitted.__class__ = Bare
    shift = torch.tensor([1.0, 1.0], dtype=F64)
    low, high = np.array(certify(fitted.with_goal(fitted.attractor + shift), n_samples=20).region)
    path = np.array(fitted.excerpts()[0].path) + 1
    np.testing.assert_allclose(low, path.min(0) - np.ptp(path, axis=0) / 4)
    np.testing.assert_allclose(high, path.max(0) + np.ptp(path, axis=0) / 4)
    fitted.fit_report = None
    with pytest.raises(ValueError, match="region: expected"):
        certify(fitted)


@pytest.mark.parametrize("kind", ["FDM", "TubeDS"])
def test_the_controller_stays_compiled(kind, draw):
    for dim in (1, 3):
        fitted = KINDS[kind](dim).fit(wavy_motion(dim))
        moved = fitted.with_goal(torch.ones(dim)).transformed(rotation=turn(dim), scale=0.3).slowed(2.0)
        controller, y = moved.controller(), torch.randn(50, dim, generator=draw, dtype=F64)
        assert controller.compiled
        with torch.no_grad():
            np.testing.assert_allclose(controller(y.numpy()), moved(y).numpy(), rtol=1e-9, atol=1e-12)
    assert not SDSEF(2).slowed(2.0).controller().compiled


def test_moved_in_place_it_takes_the_motion_along(fitted):
    moved, y = fitted.slowed(1.0), torch.randn(5, 2, dtype=F64)
    with torch.no_grad():
        moved.attractor.add_(2.0)
        torch.testing.assert_close(moved(y + 2.0), fitted(y))
        fitted.attractor.sub_(0.5)  # the goal is the outer system's own
        assert moved(moved.attractor).abs().max() < 1e-9


BAD = {
    "goal": [[1.0], [1.0, math.nan], "there", torch.zeros(2, 2)],
    "rotation": [torch.eye(3), 2 * torch.eye(2), torch.full((2, 2), math.nan), "left", torch.zeros(2)],
    "translation": [[1.0], [math.inf, 0.0]],
    "scale": [0.0, -1.0, math.nan, "large", math.inf],
    "factor": [0.0, -1.0, math.nan, None],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in BAD.items() for value in values])
def test_bad_arguments(name, value):
    ds = FDM(2)
    move = {"goal": ds.with_goal, "factor": ds.slowed}.get(name, lambda value: ds.transformed(**{name: value}))
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        move(value)


def test_a_rotation_typed_in_is_made_one():
    moved = MovedDS(FDM(2)).transformed(rotation=[[0.8660254, -0.5], [0.5, 0.8660254]])
    rotation = moved.similarity.rotation
    torch.testing.assert_close(rotation.T @ rotation, torch.eye(2, dtype=F64), rtol=0, atol=1e-15)


def test_a_moved_system_learns_where_it_is_also_for_one_that_holds_it():
    shown = wavy_motion(2)
    moved = ChebyshevDS(2, n_layers=20).with_goal([3.0, -2.0]).slowed(2.0)
    moved._learn([shown], False)  # as a method does that lets another one learn
    torch.testing.assert_close(moved.attractor, shown.goal)
    twin = ChebyshevDS(2, n_layers=20).with_goal([3.0, -2.0]).slowed(2.0).fit(shown)
    assert torch.equal(moved(shown.positions), twin(shown.positions))
