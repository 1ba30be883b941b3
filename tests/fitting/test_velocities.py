"""Wide layers that bring velocities beside the path nearer to those that were shown."""

import copy

import numpy as np
import pytest
import torch

from latentds import Demonstration, TubeDS
from latentds.fitting import search
from latentds.fitting.velocities import WIDE_LAYERS, Shown, learned, with_wide_layers
from latentds.translations import Layers


def arcs(radii=(0.8, 1.0, 1.2)):
    """Half circles about one point that close in on one goal, all walked at speed 1: the outer ones take longer."""
    found = []
    for radius in radii:
        angle = np.linspace(0, np.pi, 2000)
        r = radius + (1 - radius) * (angle / np.pi) ** 2
        path = np.stack([-r * np.cos(angle), r * np.sin(angle)], 1)
        way = np.insert(np.linalg.norm(np.diff(path, axis=0), axis=1).cumsum(), 0, 0)
        even = np.arange(0, way[-1], 0.01)
        found.append(Demonstration(np.stack([np.interp(even, way, part) for part in path.T], 1), 0.01))
    return found


def missed(ds, shown):
    with torch.no_grad():
        return float(torch.cat([(ds(one.positions) - one.velocities).norm(dim=-1) for one in shown]).mean())


@pytest.fixture(scope="module")
def with_and_without():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(search.Search, "_with_velocities", lambda self, best, law, *rest: (best, law))
        without = TubeDS(2).fit(arcs())
    return TubeDS(2).fit(arcs()), without


@pytest.mark.slow
def test_speeds_beside_a_bend_are_nearer_to_those_shown(with_and_without):
    """On the way between the arcs that were shown, too."""
    ds, without = with_and_without
    assert missed(ds, arcs()) < 0.8 * missed(without, arcs())
    assert missed(ds, arcs((0.9, 1.1))) < 0.9 * missed(without, arcs((0.9, 1.1)))
    assert ds.diffeomorphism.n_layers == without.diffeomorphism.n_layers + WIDE_LAYERS


@pytest.mark.slow
def test_the_layers_of_the_match_stay(with_and_without):
    ds, without = with_and_without
    for name in ("centers", "log_widths", "strengths"):
        mine, its = (getattr(one.diffeomorphism, name) for one in (ds, without))
        assert torch.allclose(mine[:-WIDE_LAYERS], its, rtol=1e-12, atol=0)


def test_layers_that_are_added_do_nothing_yet():
    draw = np.random.default_rng(0)
    layers = Layers(draw.standard_normal((5, 2)), 0.1 * draw.standard_normal((5, 2)), np.ones(5))
    points = torch.from_numpy(draw.standard_normal((300, 2)))
    more = with_wide_layers(layers, Shown(points, points), 2.0)
    assert len(more.widths) == 5 + WIDE_LAYERS
    assert not more.directions[5:].any()
    chosen = more.centers[5:]
    away = np.linalg.norm(chosen[:, None] - chosen, axis=2)[np.triu_indices(WIDE_LAYERS, 1)].min()
    assert np.linalg.norm(points.numpy()[:, None] - chosen, axis=2).min(1).max() <= away  # none is far from all


def test_velocities_are_taken_once_a_motion_is_under_way():
    """Of a circle at an even pace: perpendicular to the way to its middle, as long as the pace, none near the start."""
    angle = np.linspace(0, np.pi, 600)
    strands = np.stack([np.cos(angle), np.sin(angle)], 1)[None]
    shown = Shown.of(strands, np.linspace(0, 2, 600)[None], 100)
    assert torch.allclose((shown.points * shown.velocities).sum(1), torch.zeros(()).double(), atol=1e-2)
    assert torch.allclose(shown.velocities.norm(dim=1), torch.tensor(np.pi / 2).double(), rtol=1e-3)
    assert shown.points[:, 0].max() < np.cos(0.06 * np.pi)


@pytest.mark.slow
def test_less_is_tried_after_all_that_can_be_learned(with_and_without):
    trial, shown = with_and_without[0], Shown(*(torch.cat(part) for part in zip(*map(moving, arcs()), strict=True)))
    found = [layers.directions[-WIDE_LAYERS:] for layers, _ in learned(copy.deepcopy(trial), shown, WIDE_LAYERS)]
    longest = [np.linalg.norm(directions, axis=1).max() for directions in found]
    assert longest[0] > longest[1] > longest[2] > 0


def moving(shown):
    return shown.positions, shown.velocities


@pytest.mark.slow
def test_units_and_origin_of_several_do_not_matter(with_and_without):
    here, y = with_and_without[0], 1.03 * arcs()[1].positions[::8]
    there = TubeDS(2).fit([Demonstration(1000 * one.positions + 17.3, one.dt) for one in arcs()])
    with torch.no_grad():
        assert (there(1000 * y + 17.3) / 1000 - here(y)).norm(dim=-1).max() < 1e-9


@pytest.mark.slow
def test_several_are_learned_alike_in_inference_mode(with_and_without):
    with torch.inference_mode():
        ds = TubeDS(2).fit(arcs())
    for name, part in with_and_without[0].state_dict().items():
        assert torch.equal(part, ds.state_dict()[name]), name
