"""What a report needs to know of each fit beside its scores. Apart from the page, so that it makes no cell stale."""

from __future__ import annotations

from typing import Any

from ..cell import Cell
from ..certificate import certify


def findings(ds: Any, cell: Cell) -> dict[str, str]:
    """For :class:`~latentds.benchmark.Cell`'s ``measure``: the certificate as JSON, and the notes of the fit."""
    notes = ds.fit_report.notes if ds.fit_report else ()
    return {"certificate": certify(ds).to_json(), "notes": "; ".join(notes)}
