"""What the public entry points say to bad input: the argument's name, what was expected, what came."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from baselines import FDM, SDSEF
from latentds import ChebyshevDS, Demonstration
from latentds.arguments import number_in, point_array, positive, real_array, whole_number
from latentds.testing import check_stable_ds, wavy_motion

METHODS = [ChebyshevDS, FDM, SDSEF]
NAN, INF = math.nan, math.inf


@pytest.mark.parametrize("value", [0, -3, 1.0, "2", None, True, [1], np.float64(2)])
def test_whole_number_refuses(value):
    with pytest.raises(ValueError, match="n: expected a whole number >= 1, got "):
        whole_number(value, "n", at_least=1)


def test_whole_number_takes_every_integer_type():
    assert [whole_number(v, "n", at_least=1) for v in (3, np.int32(3), np.uint8(3), torch.tensor(3))] == [3] * 4


@pytest.mark.parametrize("value", [0, 1.0001, NAN, INF, -INF, "x", None, [1, 2]])
def test_number_in_refuses(value):
    with pytest.raises(ValueError, match=r"b: expected a number in \(0, 1\], got "):
        number_in(value, "b", 0, 1, ends="(]")


def test_number_in_respects_its_brackets():
    assert number_in(1, "b", 0, 1, ends="(]") == 1.0
    assert number_in(np.float32(0), "b", 0, 1, ends="[)") == 0.0
    for value, ends in ((0, "()"), (1, "()"), (0, "(]"), (1, "[)")):
        with pytest.raises(ValueError, match="b: expected a number in"):
            number_in(value, "b", 0, 1, ends=ends)


@pytest.mark.parametrize("value", [0, -1, NAN, INF, "soon", None, [1.0, 2.0], 1j])
def test_positive_refuses(value):
    with pytest.raises(ValueError, match=r"dt: expected a (finite )?number > 0, got "):
        positive(value, "dt")


@pytest.mark.parametrize(
    ("values", "found"),
    [
        (["a", "b"], "'a'"),
        ([[1, 2], [3]], r"\[\[1, 2\], \[3\]\]"),
        (np.array([1j]), "1.j"),
        (np.array([object()]), "object"),
        (np.array([True]), "True"),
        (np.array(["2020-01-01"], dtype="datetime64[D]"), "2020"),
        (None, "None"),
        (torch.ones(2, dtype=torch.complex64), r"1\.\+0\.j"),
    ],
)
def test_real_array_refuses(values, found):
    with pytest.raises(ValueError, match=f"y: expected an array of real numbers, got .*({found})"):
        real_array(values, "y")


def test_real_array_copies():
    values = np.ones(3)
    real_array(values, "y")[0] = 7
    assert values[0] == 1
    tensor = torch.ones(3, dtype=torch.float64, requires_grad=True)
    real_array(tensor, "y")[0] = 7
    assert tensor[0] == 1


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.int8, np.uint64, ">f8"])
def test_real_array_takes_every_real_type(dtype):
    array = real_array(np.array([1, 2, 3], dtype=dtype), "y")
    assert array.dtype == np.float64
    assert array.tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.zeros(5), r"expected shape \(N, n\) with n >= 1, got \(5,\)"),
        (np.zeros((5, 2, 2)), r"expected shape \(N, n\) with n >= 1, got \(5, 2, 2\)"),
        (np.zeros((5, 0)), r"expected shape \(N, n\) with n >= 1, got \(5, 0\)"),
        (np.eye(2), "expected at least 3 points, got 2"),
        (np.zeros((0, 3)), "expected at least 3 points, got 0"),
        ([[0, 0], [1, NAN], [2, 2]], "expected finite numbers, got NaN or inf in row 1"),
        ([[0, 0], [1, 1], [-INF, 2]], "expected finite numbers, got NaN or inf in row 2"),
        (np.full((4, 2), 3.5), "expected a motion, got 4 equal points"),
    ],
)
def test_point_array_refuses(values, message):
    with pytest.raises(ValueError, match=f"positions: {message}"):
        point_array(values, "positions")


@pytest.fixture(params=METHODS, ids=lambda method: method.__name__)
def ds(request):
    return request.param(3)


@pytest.mark.parametrize(
    "value",
    [torch.zeros(2), torch.zeros(3, 4), 1.0, [[1.0, 2.0]], torch.zeros(0), "a", None, [1j, 0, 0], [[1], [2, 3]]],
)
def test_points_of_the_wrong_kind(ds, value):
    for name, call in {
        "y": ds,
        "y0": lambda y: ds.rollout(y, [0.0, 1.0]),
        "x": ds.decode,
    }.items():
        with pytest.raises(ValueError, match=rf"^{name}: expected "):
            call(value)
    for call in (ds.lyapunov, ds.encode):
        with pytest.raises(ValueError, match=r"^y: expected "):
            call(value)
    with pytest.raises(ValueError, match=r"^x: expected "):
        ds.jacobian(value)


@pytest.mark.parametrize(
    ("times", "message"),
    [
        ([], r"expected shape \(T,\) with T >= 1, got \(0,\)"),
        (1.0, r"expected shape \(T,\) with T >= 1, got \(\)"),
        ([[0.0, 1.0]], r"expected shape \(T,\) with T >= 1, got \(1, 2\)"),
        ([0.0, NAN], "expected finite seconds, got NaN or inf"),
        ([0.0, INF], "expected finite seconds, got NaN or inf"),
        ([0.0, 2.0, 1.0], "expected times that do not decrease, got a step back"),
        ("soon", "expected "),
        (None, "expected "),
    ],
)
def test_bad_times(ds, times, message):
    with pytest.raises(ValueError, match=f"^t: {message}"):
        ds.rollout(torch.zeros(3), times)


def test_arrays_and_lists_are_points_too(ds):
    wanted = ds(torch.tensor([[1.0, 2.0, 3.0]]))
    for value in ([[1.0, 2.0, 3.0]], np.array([[1.0, 2.0, 3.0]]), np.array([[1, 2, 3]]), torch.tensor([[1, 2, 3]])):
        torch.testing.assert_close(ds(value), wanted, check_dtype=False, rtol=1e-6, atol=0)


@pytest.mark.parametrize("order", [">f8", ">f4", "<f8"])
def test_arrays_in_any_order_of_rows_and_bytes_are_points_too(ds, order):
    values = np.arange(12.0).reshape(4, 3)
    wanted = ds(torch.from_numpy(values))
    turned = np.ascontiguousarray(values[::-1]).astype(order)[::-1]
    torch.testing.assert_close(ds(turned), wanted, check_dtype=False, rtol=1e-6, atol=0)
    assert ds.rollout(turned, np.array([0.0, 1.0])[::1]).shape == (4, 2, 3)


def test_sparse_points_are_refused(ds):
    with pytest.raises(ValueError, match=r"^y: expected an array of real numbers"):
        ds(torch.eye(3).to_sparse())


@pytest.mark.parametrize("size", [1e-300, 1e-41, 1e41, 1e200])
def test_a_size_beyond_what_sums_of_squares_hold_is_refused_by_name(ds, size):
    shown = wavy_motion(3)
    with pytest.raises(ValueError, match=r"^demonstration: expected a size of 1e-40 to 1e\+40, got .*use another unit"):
        ds.fit(Demonstration(shown.positions / shown.size * size, shown.dt))


@pytest.mark.parametrize("recipe", ["best", None, 3, ["tuned"]])
def test_unknown_recipe(recipe):
    with pytest.raises(ValueError, match=r"recipe: expected one of \['official', 'tuned'\], got "):
        SDSEF(3, recipe=recipe)


@pytest.mark.parametrize("name", ["n_layers", "n_features"])
@pytest.mark.parametrize("value", [0, -1, 1.5, "many"])
def test_bad_sizes_of_sdsef(name, value):
    with pytest.raises(ValueError, match=f"{name}: expected a whole number >= 1, got "):
        SDSEF(3, **{name: value})


def test_dimension_mismatch_names_both(ds):
    with pytest.raises(ValueError, match="demonstration: expected dimension 3, got 2"):
        ds.fit(wavy_motion(2))


def test_contract_names_what_it_cannot_use():
    with pytest.raises(AssertionError, match="the factory"):
        check_stable_ds(lambda dim: None)
    with pytest.raises(AssertionError, match=r"raised ValueError: dim: expected a whole number >= 1, got 0"):
        check_stable_ds(ChebyshevDS, dims=[0])
