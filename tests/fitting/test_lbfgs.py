"""L-BFGS against SciPy's, and what losses may do to it."""

import numpy as np
import pytest
import scipy.optimize

from latentds.fitting.lbfgs import minimize


def with_gradient(loss, gradient):
    return lambda x: (float(loss(x)), gradient(x))


def calls_of(loss):
    """The loss, and the list of its values as it is called."""
    values = []

    def counted(x):
        value, gradient = loss(x)
        values.append(value)
        return value, gradient

    return counted, values


def stretched(x):
    return float(np.arange(1, len(x) + 1) @ x**2), 2 * np.arange(1, len(x) + 1) * x


@pytest.mark.parametrize(
    ("loss", "size"),
    [(with_gradient(scipy.optimize.rosen, scipy.optimize.rosen_der), 30), (stretched, 1), (stretched, 500)],
)
def test_as_few_evaluations_as_scipys(loss, size):
    start = np.full(size, 1.3)
    counted, values = calls_of(loss)
    found = minimize(counted, start, steps=300)
    options = {"maxcor": 20, "ftol": 1e-12, "gtol": 1e-10, "maxiter": 300}
    scipys = scipy.optimize.minimize(loss, start, jac=True, method="L-BFGS-B", options=options)
    assert found.history[-1] == pytest.approx(loss(found.at)[0])
    assert found.history[-1] < 1e-10 * loss(start)[0]
    assert len(values) <= 1.1 * scipys.nfev + 3


def test_history_never_rises_and_steps_are_bounded():
    loss = with_gradient(scipy.optimize.rosen, scipy.optimize.rosen_der)
    counted, values = calls_of(loss)
    start = np.linspace(-2, 2, 9)
    history = minimize(counted, start, steps=12).history
    assert len(history) == 12
    assert len(values) <= 24
    assert (np.diff([loss(start)[0], *history]) <= 0).all()


def test_a_minimum_is_left_alone():
    found = minimize(stretched, np.zeros(5), steps=10)
    np.testing.assert_array_equal(found.at, 0)
    assert found.history == ()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_loss_without_a_value_beyond_a_wall(bad):
    def loss(x):
        return (stretched(x - 1.0)) if np.abs(x).max() < 1.5 else (bad, np.full_like(x, bad))

    found = minimize(loss, np.full(7, -1.4), steps=100)
    np.testing.assert_allclose(found.at, 1, atol=1e-5)


def test_the_gradient_given_is_not_written_over():
    held = np.full(4, 2.0)
    minimize(lambda x: (float((2 * x).sum()), held), np.ones(4), steps=3)
    np.testing.assert_array_equal(held, 2.0)


def test_slopes_whose_squares_are_no_numbers_end_no_search():
    """A loss that is huge beyond where it begins: the squares of its slopes exceed the largest float."""

    def loss(x):
        wall = max(0.0, x[0] - 0.1)
        return float((x[0] - 0.05) ** 2 + 1e170 * wall), np.array([2 * (x[0] - 0.05) + 1e170 * (wall > 0)])

    found = minimize(loss, np.array([-0.05]), steps=50)
    assert found.at[0] == pytest.approx(0.05, abs=1e-4)
