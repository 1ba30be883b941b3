"""Latent dynamics beside their flows: what they promise of the rate, and when they can be written as tables."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from latentds.dynamics import Frame, LatentDynamics, RayDynamics, TubeDynamics
from latentds.time_law import ChebyshevLaw, KnottedLaw
from tests.motions import tensor

FAST = KnottedLaw([0.1, 1.0], [1.0, 10.0])
SLOW = KnottedLaw([0.1, 0.4, 1.0], [0.2, 0.05, 0.9])
DYNAMICS = {
    "ray": RayDynamics(SLOW),
    "ray, Chebyshev": RayDynamics(ChebyshevLaw(2.0)),
    "slow along": TubeDynamics(SLOW, FAST),
    "slow across": TubeDynamics(FAST, SLOW),
    "Chebyshev along": TubeDynamics(ChebyshevLaw(2.0), FAST),
}


def frame(dim, draw):
    return Frame.between(*torch.randn(2, dim, generator=draw, dtype=torch.float64))


@pytest.mark.parametrize("name", DYNAMICS)
@pytest.mark.parametrize("reach", [0.3, 2.0])
def test_the_bound_on_the_rate_is_the_least_rate(name, reach, draw):
    """Nowhere is -V̇/2V below it, and along the axis or across it comes close: the slower of both laws counts."""
    dynamics, at = DYNAMICS[name], frame(3, draw)
    across = torch.linalg.cross(at.axis, at.axis.roll(1))
    ways = [torch.randn(500, 3, generator=draw, dtype=torch.float64), at.axis.expand(500, 3), across.expand(500, 3)]
    share = torch.linspace(1e-3, 1, 500, dtype=torch.float64).repeat(3).unsqueeze(-1)
    offset = reach * at.length * share * torch.nn.functional.normalize(torch.cat(ways), dim=-1)
    x = at.attractor + offset
    rates = -(dynamics(x, x, at) * offset).sum(-1) / offset.square().sum(-1)
    bound = dynamics.convergence_rate_bound(float(reach * at.length), at)
    assert 0 < bound <= rates.min() * (1 + 1e-9)
    assert bound == pytest.approx(float(rates.min()), rel=0.05)


@pytest.mark.parametrize("name", DYNAMICS)
def test_a_frame_that_is_none_bounds_nothing(name, draw):
    dynamics, at = DYNAMICS[name], frame(3, draw)
    frames = [
        at._replace(length=-at.length),
        at._replace(length=0 * at.length),
        at._replace(length=math.nan * at.length),
    ]
    if isinstance(dynamics, TubeDynamics):
        frames += [at._replace(axis=(1 + 1e-9) * at.axis), at._replace(axis=math.nan * at.axis)]
    assert all(not dynamics.convergence_rate_bound(1.0, broken) > 0 for broken in frames)


class OtherLaw(KnottedLaw):
    pass


class OtherTube(TubeDynamics):
    pass


class SameLaw(KnottedLaw):
    """One that says its table is its parent's."""

    def table(self):
        return super().table()


def same(one, other):
    return one.kind is other.kind and (one.packed() == other.packed()).all()


@pytest.mark.parametrize("law", [FAST, ChebyshevLaw()])
def test_tables_are_of_the_dynamics_themselves_and_of_no_subclass(law, draw):
    """A subclass may move otherwise; what reads the tables would not know."""
    at, other = frame(3, draw), OtherLaw([1.0], [1.0])
    goal, along, across = TubeDynamics(law, SLOW).table(at)
    assert (goal == torch.stack([at.attractor, at.axis, at.length.expand(3)]).numpy()).all()
    assert same(along, law.table())
    assert same(across, SLOW.table())
    goal, along, across = RayDynamics(law).table(at)
    assert (goal[1] == 0).all()
    assert same(along, law.table())
    assert same(across, law.table())
    unknown = [RayDynamics(other), TubeDynamics(other, law), TubeDynamics(law, other), OtherTube(law, SLOW)]
    assert [dynamics.table(at) for dynamics in unknown] == [None] * 4
    assert same(SameLaw([1.0], [1.0]).table(), KnottedLaw([1.0], [1.0]).table())


@pytest.mark.parametrize("missing", ["forward", "flow"])
def test_dynamics_without_a_velocity_or_a_flow_are_none(missing):
    methods = {name: getattr(RayDynamics, name) for name in ("forward", "flow") if name != missing}
    with pytest.raises(TypeError, match=missing):
        type("Half", (LatentDynamics,), methods)()


@pytest.mark.parametrize("dim", [1, 2, 7])
def test_flow_agrees_with_solve_ivp(dim, draw):
    along = KnottedLaw(tensor([0.01, 0.4, 1.0]), tensor([0.3, 2.0, 0.7]))
    dynamics = TubeDynamics(along, KnottedLaw(tensor([0.2]), tensor([1.5])))
    start, goal = torch.randn(2, dim, generator=draw, dtype=torch.float64)
    frame = Frame.between(start, goal)
    x = torch.cat([start[None], goal + 3 * torch.randn(5, dim, generator=draw, dtype=torch.float64)])
    times = torch.linspace(0, 1.5, 6, dtype=torch.float64)
    path = dynamics.flow(x, times, frame)
    solved = solve_ivp(
        lambda _, flat: dynamics(tensor(flat).view(x.shape), x, frame).reshape(-1).numpy(),
        (0, 1.5), x.numpy().ravel(), "LSODA", times.numpy(), rtol=1e-10, atol=1e-12,
    )  # fmt: skip
    assert np.abs(solved.y.T.reshape(6, *x.shape).swapaxes(0, 1) - path.numpy()).max() < 1e-7
    assert (dynamics.lyapunov(path, frame).diff(dim=-1) < 0).all()
    assert (dynamics(goal, goal, frame) == 0).all()
    torch.testing.assert_close(dynamics.flow(goal, times, frame), goal.expand(6, dim), rtol=0, atol=0)


def test_progress_falls_by_the_law_from_wherever_it_starts(draw):
    law = KnottedLaw(tensor([0.01, 0.4, 1.0]), tensor([0.3, 2.0, 0.7]))
    dynamics = TubeDynamics(law, KnottedLaw(tensor([0.2]), tensor([1.5])))
    start, goal, aside = torch.randn(3, 3, generator=draw, dtype=torch.float64)
    frame = Frame.between(start, goal)
    middle = (start + goal) / 2
    torch.testing.assert_close(dynamics.phase(torch.stack([start, goal, middle]), frame), tensor([1, 0, 0.5]))
    path = dynamics.flow(goal + (start - goal) * 0.9 + 0.1 * aside, tensor([0.0, 0.1]), frame)
    s = dynamics.phase(path, frame)
    torch.testing.assert_close(law.time_to_go(s[0]) - law.time_to_go(s[1]), tensor(0.1))


def test_offset_shrinks_at_the_rate_and_no_faster_than_the_cap():
    dynamics = TubeDynamics(KnottedLaw.uniform(), KnottedLaw(tensor([0.25]), tensor([0.25 * 8])))
    frame = Frame.between(tensor([2.0, 0.0]), tensor([0.0, 0.0]))
    near = dynamics.flow(tensor([1.0, 0.2]), tensor([0.0, 0.1]), frame)[:, 1]
    torch.testing.assert_close(near[1] / near[0], tensor(math.exp(-0.8)))
    offsets = tensor([[1.0, 1.0], [1.0, 5.0], [1.0, 500.0]])
    torch.testing.assert_close(dynamics(offsets, offsets, frame)[:, 1], tensor([-4.0, -4.0, -4.0]))
