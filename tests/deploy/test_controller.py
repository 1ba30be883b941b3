"""The real-time handle against the system that it was made of."""

from __future__ import annotations

import tracemalloc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from baselines import FDM, SDSEF
from latentds import ChebyshevDS, LatentDS, LocallyWeightedTranslations
from latentds.dynamics import TubeDynamics
from latentds.testing import wavy_motion
from latentds.time_law import ChebyshevLaw, PiecewiseLinearLaw


class Tube(LatentDS):
    """Every law of the package: a demonstrated one along the axis and a pull to it across."""

    def __init__(self, dim):
        along = PiecewiseLinearLaw(torch.tensor([0.1, 0.4, 0.7, 1.0]), torch.tensor([0.2, 0.5, 0.3, 1.0]))
        super().__init__(dim, LocallyWeightedTranslations(dim, 30), TubeDynamics(along, ChebyshevLaw(0.2)))

    def fit(self, demonstration, *, progress=False):
        donor = ChebyshevDS(self.dim, n_layers=30, pinned=False).fit(demonstration)
        self.diffeomorphism.load_state_dict(donor.diffeomorphism.state_dict())
        self.attractor.copy_(demonstration.goal)
        self.start.copy_(demonstration.start)
        return self


class Scaled(ChebyshevDS):
    """A system whose velocity the kernel does not know."""

    def forward(self, y):
        return 2 * super().forward(y)


COMPILED = {
    "Chebyshev": lambda dim: ChebyshevDS(dim, n_layers=30),
    "FDM": lambda dim: FDM(dim, n_layers=30),
    "Tube": Tube,
}
OTHER = {
    "SDSEF": lambda dim: SDSEF(dim, n_layers=2, n_features=10, seed=0),
    "Scaled": lambda dim: Scaled(dim, n_layers=30),
}


def fitted(make, dim):
    shown = wavy_motion(dim)
    ds = make(dim)
    with torch.no_grad():
        return (ds if isinstance(ds, SDSEF) else ds.fit(shown)), shown


def around(shown, count=200):
    """Points on the motion, at its goal, near it and far away."""
    positions = shown.positions.numpy()
    rng = np.random.default_rng(0)
    picked = positions[rng.integers(len(positions), size=count)]
    away = 10.0 ** rng.uniform(-6, 1, (count, 1)) * rng.standard_normal(picked.shape)
    return np.concatenate([positions[-1:], positions[:1], picked, picked + away])


@pytest.mark.parametrize("dim", [1, 2, 3, 7])
@pytest.mark.parametrize("make", (COMPILED | OTHER).values(), ids=(COMPILED | OTHER).keys())
def test_velocity_of_the_system(make, dim):
    ds, shown = fitted(make, dim)
    points, controller = around(shown), ds.controller()
    with torch.no_grad():
        expected = ds(torch.from_numpy(points)).numpy()
    assert controller.compiled == (make in COMPILED.values())
    scale = np.abs(expected).max()
    np.testing.assert_allclose(controller(points), expected, rtol=1e-9, atol=1e-10 * scale)
    np.testing.assert_allclose([controller(p) for p in points[:9]], expected[:9], rtol=1e-9, atol=1e-10 * scale)
    assert controller(points[:0]).shape == (0, dim)
    assert controller(points[:6].reshape(2, 3, dim)).shape == (2, 3, dim)


@pytest.mark.parametrize("make", [ChebyshevDS, SDSEF])
def test_any_real_numbers_in(make):
    controller = make(3).controller()
    expected = controller(np.array([1.0, 2.0, 3.0]))
    assert expected.dtype == np.float64
    for y in ([1, 2, 3], (1.0, 2.0, 3.0), np.array([1, 2, 3], np.int32), torch.tensor([1.0, 2.0, 3.0])):
        np.testing.assert_array_equal(controller(y), expected)
    strided = np.zeros(6)
    strided[::2] = 1, 2, 3
    np.testing.assert_array_equal(controller(strided[::2]), expected)


@pytest.mark.parametrize("make", [ChebyshevDS, SDSEF])
@pytest.mark.parametrize(
    ("y", "message"),
    [
        (np.zeros(2), "y: expected shape"),
        (np.zeros((3, 1)), "y: expected shape"),
        (1.0, "y: expected shape"),
        ("here", "y: expected real numbers"),
        ([[1.0], [1.0, 2.0]], "y: expected real numbers"),
        (None, "y: expected real numbers"),
        (np.zeros(3, complex), "y: expected real numbers"),
        ([0.0, np.nan, 0.0], "y: expected finite numbers"),
        ([0.0, np.inf, 0.0], "y: expected finite numbers"),
    ],
)
def test_bad_points(make, y, message):
    with pytest.raises(ValueError, match=message):
        make(3).controller()(y)


@pytest.mark.parametrize("out", [np.zeros(2), np.zeros(3, np.float32), np.zeros((3, 3)), np.zeros(6)[::2], None])
def test_given_room_is_used_or_refused(out):
    controller, y = ChebyshevDS(3).controller(), np.ones(3)
    if out is None:
        out = np.zeros(3)
        assert controller(y, out) is out
        np.testing.assert_array_equal(out, controller(y))
    else:
        with pytest.raises(ValueError, match="out: expected"):
            controller(y, out)


def test_point_and_velocity_may_share_memory():
    ds, shown = fitted(COMPILED["Tube"], 3)
    controller, y = ds.controller(), shown.positions.numpy()[5].copy()
    expected = controller(y)
    np.testing.assert_array_equal(controller(y, y), expected)


def test_it_keeps_the_system_as_it_was():
    for make in (COMPILED["Chebyshev"], OTHER["Scaled"]):
        ds, shown = fitted(make, 2)
        controller, y = ds.controller(), shown.positions.numpy()[3]
        before = controller(y)
        with torch.no_grad():
            ds.diffeomorphism.centers.mul_(1.5)
            ds.start.add_(0.1)
        np.testing.assert_array_equal(controller(y), before)
        assert not np.allclose(ds.controller()(y), before)


def test_threads_do_not_disturb_each_other():
    ds, shown = fitted(COMPILED["Tube"], 3)
    controller, points = ds.controller(), around(shown)
    expected = controller(points)
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(controller, np.tile(points, (20, 1))))
    np.testing.assert_array_equal(found, np.tile(expected, (20, 1)))


def test_nothing_piles_up():
    controller, y, out = ChebyshevDS(3).controller(), np.ones(3), np.empty(3)
    controller(y, out)
    tracemalloc.start()
    try:
        for _ in range(1000):
            controller(y, out)
        assert tracemalloc.get_traced_memory()[1] < 5000
    finally:
        tracemalloc.stop()


def test_a_system_in_single_precision():
    ds, shown = fitted(COMPILED["Tube"], 3)
    points = shown.positions.numpy()[::10]
    exact = ds.controller()(points)
    np.testing.assert_allclose(ds.float().controller()(points), exact, atol=1e-3 * np.abs(exact).max())
