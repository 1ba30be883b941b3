"""The summary of the hard curves."""

from __future__ import annotations

import pandas as pd

from experiments.hard_curves import KINDS, by_kind, curves, kind_of


def test_every_curve_is_of_a_kind_and_no_kind_is_empty():
    names = [curve.shown.name for curve in curves()]
    assert {kind_of(name) for name in names} == set(KINDS)
    assert kind_of("unstable c=7, 1.0% noise") == "noise"
    assert kind_of("wave in 3-D, quantised to 1%") == "steps"


def test_every_curve_is_counted_once_by_what_became_of_it():
    rows = [
        ("helix", True, 1.0, ""),
        ("helix", True, 2.0, "moves 74 times as fast beside it"),
        ("helix", False, 6.0, "misses"),
        ("knot", False, 3.0, ""),
        ("knot", False, 0.1, "refused: demonstration: expected a path that does not meet itself"),
    ]
    found = by_kind(pd.DataFrame(rows, columns=["kind", "follows", "seconds", "note"]))
    assert found.index.tolist() == ["helix", "knot"]
    assert found["follow"].tolist() == [2, 0]
    assert found["miss, noted"].tolist() == [1, 0]
    assert found["miss silently"].tolist() == [0, 1]
    assert found["refused"].tolist() == [0, 1]
    assert found["median seconds"].tolist() == [2.0, 1.55]
