"""The public contract: what every method promises, clause by clause, checked by trying it. Needs no test runner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache, partial
from itertools import product
from typing import TYPE_CHECKING

from .case import Case, Clause, Factory, state_of, wavy_motion
from .clauses import CLAUSES, FIT_CLAUSES

if TYPE_CHECKING:
    import pytest

__all__ = ["check_stable_ds", "parametrize_stable_ds", "wavy_motion"]


def check_stable_ds(
    factory: Factory,
    *,
    dims: Sequence[int] = (2, 3, 7),
    fitted: Sequence[bool] = (False, True),
    seed: int = 0,
    expected_failures: Mapping[str, str] | None = None,
) -> None:
    """Hold a method to every clause of the contract of :class:`~latentds.StableDS`, on small motions.

    Give a factory with small budgets (few layers, few epochs): a method that keeps the contract is fitted four times
    in each dimension. It may draw from torch's generator, which is in one state before each call of the factory and
    of fit, or from a seed that the factory gives it.

    The clauses are the functions of :mod:`latentds.testing.clauses`, by name.

    Args:
        factory: n -> a new, unfitted system of that dimension.
        dims: the dimensions to try, each >= 1.
        fitted: whether to try the system before a fit, after one, or both.
        seed: of the demonstrations and probe points.
        expected_failures: {clause: reason}, such as {"check_flow": "…"}, where the method's theory promises less. Each
            must fail wherever it is tried: narrow ``dims`` or ``fitted`` if it holds in one dimension, or before a fit.

    Raises:
        AssertionError: naming the method, every clause that it breaks and what was found, for each dimension, before
            and after a fit; and every clause that was expected to fail and holds.
        ValueError: if ``expected_failures`` names no clause or gives no reason.
    """
    reasons = _reasons(expected_failures)
    broken: list[str] = []
    cause: AssertionError | None = None
    for dim, after_fit in product(dims, fitted):
        try:
            case = Case.of(factory, dim, after_fit, seed)
        except AssertionError as error:
            broken.append(str(error))
            cause = cause or error
            continue
        for clause in _clauses(after_fit):
            reason = reasons.get(clause.__name__)
            try:
                case.hold(clause)
            except AssertionError as error:
                if reason is None:
                    broken.append(str(error))
                    cause = cause or error
            else:
                if reason is not None:
                    broken.append(f"{case} keeps {clause.__name__}, which was expected to fail: {reason}")
    if broken:
        raise AssertionError("\n".join(broken)) from cause


def parametrize_stable_ds(
    factories: Mapping[str, Factory],
    *,
    dims: Sequence[int] = (2, 3, 7),
    fitted: Sequence[bool] = (False, True),
    expected_failures: Mapping[str, Mapping[str, str]] | None = None,
) -> pytest.MarkDecorator:
    """:func:`check_stable_ds` as a pytest decorator: one test for each method, dimension, state and clause. ::

        @parametrize_stable_ds({"Mine": lambda dim: Mine(dim, n_layers=30)})
        def test_contract(check):
            check()

    All tests of one fitted system share one fit.

    Args:
        factories: {label: factory}; the label begins the name of each test.
        dims: as for :func:`check_stable_ds`.
        fitted: as for :func:`check_stable_ds`.
        expected_failures: {label: {clause: reason}}. These tests are strict xfails: one that passes is a failure.

    Raises:
        ValueError: if ``expected_failures`` names no label or clause, or gives no reason.
    """
    import pytest

    expected = {label: _reasons(reasons) for label, reasons in (expected_failures or {}).items()}
    if unknown := set(expected) - set(factories):
        raise ValueError(f"expected_failures: expected labels among {sorted(factories)}, got {sorted(unknown)}")
    shared = cache(lambda label, dim, after_fit: Case.of(factories[label], dim, after_fit, 0))

    def check(label: str, dim: int, after_fit: bool, clause: Clause) -> None:
        shared(label, dim, after_fit).hold(clause)

    items = []
    for label, dim, after_fit in product(factories, dims, fitted):
        for clause in _clauses(after_fit):
            reason = expected.get(label, {}).get(clause.__name__)
            items.append(
                pytest.param(
                    partial(check, label, dim, after_fit, clause),
                    id=f"{label}-{dim}-{state_of(after_fit)}-{clause.__name__}",
                    marks=[pytest.mark.xfail(reason=reason, strict=True)] if reason else [],
                )
            )
    return pytest.mark.parametrize("check", items)


def _clauses(after_fit: bool) -> tuple[Clause, ...]:
    return (*FIT_CLAUSES, *CLAUSES) if after_fit else CLAUSES


def _reasons(expected_failures: Mapping[str, str] | None) -> dict[str, str]:
    reasons = dict(expected_failures or {})
    known = [clause.__name__ for clause in _clauses(True)]
    for clause, reason in reasons.items():
        if clause not in known:
            raise ValueError(f"expected_failures: expected clauses among {known}, got {clause!r}")
        if not (isinstance(reason, str) and reason):
            raise ValueError(f"expected_failures: expected a reason for {clause}, got {reason!r}")
    return reasons
