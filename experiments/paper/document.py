"""The report that a run writes: its text, its summary and its pictures."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from matplotlib.figure import Figure

from experiments import report
from experiments.paper import figures
from experiments.paper.verdicts import SIMILAR, Finding


@dataclass
class Document:
    """What the run found so far; pictures go to the folder ``pictures``, two below the report's."""

    pictures: Path
    parts: list[str] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)

    def add(self, *parts: str) -> None:
        self.parts += parts

    def table(self, header: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
        self.add(report.table(header, list(rows)))

    def find(self, *findings: Finding) -> None:
        self.findings += findings

    def show(self, name: str, figure: Figure, caption: str) -> None:
        self.pictures.mkdir(parents=True, exist_ok=True)
        figure.savefig(self.pictures / f"{name}.png", dpi=figures.DPI)
        self.add(f"![{caption}]({self.pictures.parent.name}/{self.pictures.name}/{name}.png)\n\n*{caption}*")

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
            "## Summary",
            report.table(["what", "paper", "ours", "verdict"], self.findings),
            *self.parts,
            "",
        ]
        return "\n\n".join(parts)
