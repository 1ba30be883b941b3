"""A comparison in sentences."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from scipy import stats

from ..cell import CONVERGED_AFTER, CONVERGED_WITHIN
from .comparison import Comparison

BY_WHEN = f"within {CONVERGED_AFTER:g} durations"
ARRIVE = f"A motion arrives if it comes to {100 * CONVERGED_WITHIN:g} % of the size from the system's goal {BY_WHEN}."
"""What the column "arrive" counts."""
SURE = 0.01
"""p from which on a difference between methods is called one that chance may make."""


def percent(share: float) -> str:
    """Two figures; a dash for none."""
    if not math.isfinite(share):
        return "—"
    return f"{100 * share:.0f} %" if 0.995 <= share < 100 else f"{100 * share:.2g} %"


def verdict(comparison: Comparison) -> list[str]:
    """Which method follows best, by how much, and whether that may be chance; then what is off."""
    return [_best(comparison), *_remarks(comparison)]


def _best(comparison: Comparison) -> str:
    best, *others = comparison.ranking()
    what = comparison.motions[0].name if len(comparison.motions) == 1 else f"{len(comparison.motions)} motions"
    count = comparison.n_starts
    where = f"from {count} starts around the demonstrated one" if count else "from the demonstrated start"
    if not math.isfinite(best["level"]):
        return f"No method moves through all of {what}: rollouts fail or diverge."
    if others:
        return (
            f"{best['method']} stays nearest to {what}: {percent(best['level'])} of the motion's size away on the mean "
            f"{where}, before {others[0]['method']} with {percent(others[0]['level'])}"
            f"{_certainty(best, others[0], comparison)}."
        )
    follows = best["follows"][0] == best["follows"][1]
    said = f"{best['method']} follows {what}" if follows else f"{best['method']} does not follow {what} as it should"
    more = f", {percent(best['level'])} {where}" if count else ""
    far = f"{percent(best['own'])} of the motion's size from the demonstrated start{more}"
    return f"{said}: it stays at a mean distance of {far}."


def _certainty(best: Mapping[str, Any], second: Mapping[str, Any], comparison: Comparison) -> str:
    """Of one motion, whether chance may make the difference; of several, on how many it is the nearest."""
    pairs = [[comparison.distances(line["method"], motion) for line in (best, second)] for motion in comparison.motions]
    known = [(one, other) for one, other in pairs if one is not None and other is not None]
    if not math.isfinite(second["level"]) or not known:
        return ""
    if len(comparison.motions) > 1:
        return f", and nearer than that on {sum(one.level < other.level for one, other in known)} of {len(known)}"
    ((first, other),) = ((one.judged, other.judged) for one, other in known)
    if np.array_equal(first, other):
        return ", the same from every start"
    if len(first) < 3 or len(first) != len(other):
        return ""
    p = float(stats.ttest_rel(first, other).pvalue)
    test = f"p = {p:.1g}, paired t-test over the {len(first)} starts"
    return f" ({test})" if p < SURE else f", a difference that chance may make ({test})"


def _remarks(comparison: Comparison) -> Iterator[str]:
    lines = comparison.ranking()
    notes = [
        note for text in comparison.rows.get("notes", []) if isinstance(text, str) for note in text.split("; ") if note
    ]
    if len(lines) == 1 and notes:
        yield f"Noted: {'; '.join(dict.fromkeys(notes))}."
    for line in lines:
        arrived, of = line["arrives"]
        if line["motions"] < len(comparison.motions):
            yield f"{line['method']} was tried on {line['motions']} of {len(comparison.motions)} motions."
        if line["failed"]:
            yield f"{line['method']}: {line['failed']} of {of} motions fail or diverge."
        elif arrived < of:
            yield f"{line['method']}: {of - arrived} of {of} motions do not arrive at the goal {BY_WHEN}."
        followed, fits = line["follows"]
        if followed < fits and len(lines) > 1:
            yield f"{line['method']} does not follow in {fits - followed} of {fits} fits, by its own measurement."
    false = [(one["method"], claim) for one in comparison.certificates() for claim in one["false"]]
    for method in dict.fromkeys(method for method, _ in false):
        claims = dict.fromkeys(claim for one, claim in false if one == method)
        yield f"{method}: falsified in its certificate: {'; '.join(claims)}."
    late = {method for method, claim in false if claim.startswith("every motion arrives")}
    for line in lines:
        arrived, of = line["arrives"]
        if line["method"] in late and arrived == of:
            yield f"{line['method']}: all {of} motions arrive, but not all from farther off, in its certificate."
