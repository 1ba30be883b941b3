"""The report that a run writes: its text, its summary and its pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from experiments import report
from latentds.plotting import SHOWN

SIMILAR = 3.0
"""Factor within which a measured figure counts as reproduced."""
UNKNOWN = "not reproducible"
NO_NUMBERS = f"{UNKNOWN}: no numbers to compare with"
REPRODUCED, IN_PART, CONTRADICTED = "reproduced", "reproduced in part", "contradicted"
DPI = 100
GOAL: dict[str, Any] = {"marker": "*", "color": "#E69F00", "mec": SHOWN, "mew": 0.6, "ms": 12, "ls": ""}
"""How the goal of a motion is drawn."""


class Finding(NamedTuple):
    """One line of the summary."""

    what: str
    paper: str
    ours: str
    verdict: str


def similar(*ratios: float) -> str:
    """The verdict on errors over the paper's: all within the factor, or on which side of it they are not."""
    if max(ratios) > SIMILAR:
        return "worse"
    return REPRODUCED if min(ratios) >= 1 / SIMILAR else "better"


def verdict(holds: Any) -> str:
    """Of a claim that holds or does not."""
    return REPRODUCED if holds else CONTRADICTED


def span(values: Iterable[float]) -> str:
    """The least and the largest, "2.5e-8 … 1.6e-5"."""
    ends = sorted(values)
    return " … ".join(np.format_float_scientific(end, 1, exp_digits=1) for end in (ends[0], ends[-1]))


@dataclass
class Document:
    """What the run has written so far; pictures go to the folder ``pictures``, two below the report's."""

    pictures: Path
    parts: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def add(self, *parts: str) -> None:
        self.parts += parts

    def table(self, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        self.add(report.table(header, list(rows)))

    def find(self, what: str, paper: str, ours: str, verdict: str) -> None:
        self.findings.append(Finding(what, paper, ours, verdict))

    def show(self, name: str, figure: Figure, caption: str) -> None:
        self.pictures.mkdir(parents=True, exist_ok=True)
        figure.savefig(self.pictures / f"{name}.png", dpi=DPI)
        self.add(f"![{caption}]({self.pictures.parent.name}/{self.pictures.name}/{name}.png)\n\n*{caption}*")

    def verdict(self) -> str:
        """How many of the findings are what, in three sentences."""
        kinds = {
            kind: [f.what for f in self.findings if f.verdict.startswith(kind)]
            for kind in (REPRODUCED, CONTRADICTED, UNKNOWN)
        }
        held = len(kinds[REPRODUCED]) - sum(f.verdict == IN_PART for f in self.findings)
        others = len(self.findings) - held - len(kinds[CONTRADICTED]) - len(kinds[UNKNOWN])
        return (
            f"Of {len(self.findings)} things that the paper shows, {held} are reproduced, and {others} in part, better,"
            f" worse, or as one reads it. Contradicted: {'; '.join(kinds[CONTRADICTED]) or 'nothing'}. Without numbers "
            f"or recordings to compare with: {'; '.join(kinds[UNKNOWN]) or 'nothing'}."
        )

    def text(self, quick: bool, recorded: bool, seconds: float) -> str:
        """The whole of it; ``recorded``: joint motions came from files."""
        where = report.environment()
        packages = ", ".join(f"{name} {version}" for name, version in where["packages"].items())
        scope = (
            "**A quick run: fewer spirals, small grids, short training of SDS-EF. Its figures are not the full run's.**"
            if quick
            else "The full run."
        )
        parts = [
            "# The paper beside what we measure",
            f"Written by `make paper{' ARGS=--quick' if quick else ''}`; do not edit. {scope}",
            f"Took {seconds:.0f} s (less what an earlier run had kept) on {where['cores']} cores ({where['cpu']}), "
            f"{where['date'][:10]}, revision {where['revision']}; {packages}."
            + (" Joint motions: recordings given by `--data`." if recorded else ""),
            "The paper is Gupta, Nayak and Billard, *Learning High Dimensional Demonstrations Using Laplacian "
            f"Eigenmaps*. A figure counts as *reproduced* within a factor {SIMILAR:g} of the paper's, beyond it as "
            "*better* or *worse*. Where the paper is silent, our readings are in [corrections](corrections.md).",
            "## Verdict",
            self.verdict(),
            report.table(["what", "paper", "ours", "verdict"], self.findings),
            *self.parts,
            "",
        ]
        return "\n\n".join(parts)
