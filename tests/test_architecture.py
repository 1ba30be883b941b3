"""Imports run one way, lazy ones included, and in no circle."""

from __future__ import annotations

import ast
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
ROOMS = (
    "arguments", "curves", "resizing", "tabulated", "memo", "files", "recordings", "findings", "demonstration",
    "datasets", "kernels", "time_law", "diffeomorphism", "translations", "transform", "dynamics", "deploy",
    "integrate", "metrics", "probes", "fidelity", "fitting", "similarity", "base", "modulation", "poses", "methods",
    "storage", "cache", "certificate", "testing", "cell", "benchmark", "plotting", "report", "cli", "__main__",
)  # fmt: skip
"""Of latentds; each may import itself and those before it."""
PACKAGES = ("latentds", "baselines", "experiments")
"""Each may import itself and those before it."""


def modules() -> dict[str, Path]:
    """{dotted name: file} of the three packages."""
    files = [file for package in PACKAGES for file in (ROOT / package).rglob("*.py")]
    return {".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): file for file in files}


MODULES = modules()


def imports(name: str) -> set[str]:
    """Our modules that a module names in any import statement, wherever in the file it stands."""
    found = set()
    for node in ast.walk(ast.parse(MODULES[name].read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            parts = name.split(".") if MODULES[name].name == "__init__.py" else name.split(".")[:-1]
            base = ".".join([*parts[: len(parts) - node.level + 1], *filter(None, [node.module])])
            base = base if node.level else str(node.module)
            for alias in node.names:
                inside = f"{base}.{alias.name}"
                found.add(inside if inside in MODULES else base)
    return (found & set(MODULES)) - {name}


def test_imports_are_seen_wherever_they_stand():
    assert {"latentds.kernels.compiling", "latentds.tabulated"} <= imports("latentds.kernels.velocity")
    assert "latentds.base" in imports("latentds")
    assert "latentds.plotting" in imports("experiments.spirals")


@pytest.mark.parametrize("name", sorted(MODULES))
def test_imports_run_one_way(name):
    package, _, room = name.partition(".")
    for target in imports(name):
        owner, _, inside = target.partition(".")
        assert PACKAGES.index(owner) <= PACKAGES.index(package), f"{name} imports {target}"
        if package == "latentds" and room:
            here, there = room.split(".")[0], inside.split(".")[0]
            assert there, f"{name} imports the whole library"
            assert ROOMS.index(there) <= ROOMS.index(here), f"{name} imports {target}"


def test_no_circles():
    list(TopologicalSorter({name: imports(name) for name in MODULES}).static_order())
