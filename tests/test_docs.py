"""The Python in README and docs runs as printed."""

from __future__ import annotations

import pkgutil
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks():
    for page in [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]:
        for number, block in enumerate(BLOCK.findall(page.read_text(encoding="utf-8"))):
            yield pytest.param(block, id=f"{page.relative_to(ROOT)}-{number}")


@pytest.mark.slow
@pytest.mark.parametrize("block", list(blocks()))
def test_code_runs_as_printed(block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(block, "<docs>", "exec"), {"__name__": "docs"})


def test_readme_opens_with_an_example_of_25_lines_at_most():
    first = BLOCK.search((ROOT / "README.md").read_text(encoding="utf-8"))
    assert first is not None
    assert len(first.group(1).splitlines()) <= 25


def test_links_lead_somewhere():
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        for target in re.findall(r"\]\(([^)#]+?)\)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_named_files_and_modules_exist():
    for page in [*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")]:
        text = page.read_text(encoding="utf-8")
        for path in re.findall(r"\b(?:latentds|baselines|experiments|tests)/[\w/]+\.py\b", text):
            assert (ROOT / path).is_file(), f"{page.name}: {path}"
        for name in re.findall(r"`((?:latentds|baselines|experiments)(?:\.\w+)+)\b", text):
            assert resolves(name), f"{page.name}: {name}"


def resolves(name):
    """Whether a dotted name is a module of ours, or something in one."""
    try:
        return pkgutil.resolve_name(name) is not None
    except (ImportError, AttributeError):
        return False


def test_names_that_lead_nowhere_are_seen():
    assert resolves("latentds.testing.check_stable_ds")
    assert not resolves("latentds.kernels.serves")
