"""The Python in README and docs runs as printed."""

from __future__ import annotations

import pkgutil
import re
import runpy
from pathlib import Path

import pytest

from latentds import fidelity

ROOT = Path(__file__).parent.parent
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
RELIABILITY = (ROOT / "docs" / "reliability.md").read_text(encoding="utf-8")
TEST_NAMED = re.compile(r"`(test_\w+)::(test_\w+)`")


def programs():
    """Of each page its blocks of Python, which go on from one another."""
    for page in [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]:
        if found := BLOCK.findall(page.read_text(encoding="utf-8")):
            yield pytest.param(found, id=str(page.relative_to(ROOT)))


@pytest.mark.slow
@pytest.mark.parametrize("blocks", list(programs()))
def test_code_runs_as_printed(blocks, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = {"__name__": "docs"}
    for block in blocks:
        exec(compile(block, "<docs>", "exec"), names)


@pytest.mark.slow
def test_the_template_keeps_the_contract():
    runpy.run_path(str(ROOT / "docs" / "template.py"), run_name="__main__")


def test_gallery_scripts_are_short_and_draw():
    scripts = sorted((ROOT / "docs" / "gallery").glob("plot_*.py"))
    assert len(scripts) >= 10
    for script in scripts:
        text = script.read_text(encoding="utf-8")
        assert len(text.splitlines()) <= 45, script.name
        assert "figure = " in text, script.name


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


def test_every_test_that_reliability_names_exists():
    named, found = set(TEST_NAMED.findall(RELIABILITY)), set()
    for file in (ROOT / "tests").rglob("test_*.py"):
        tests = re.findall(r"^ *def (test_\w+)\(", file.read_text(encoding="utf-8"), re.MULTILINE)
        found.update((file.stem, name) for name in tests)
    assert named
    assert named <= found, sorted(named - found)


def unheld(page):
    """Paragraphs, list items and rows below the first "##" that name no test and do not say so.

    What ends with a colon only leads to a list, a table or a program.
    """
    page = re.sub(r"^```.*?^```$", "", page, flags=re.MULTILINE | re.DOTALL)
    page = re.sub(r"^\|.*\|\n\|[-:|]+\|$", "", page, flags=re.MULTILINE)  # heads of tables
    for section in re.split(r"^## .*$", page, flags=re.MULTILINE)[1:]:
        for block in re.split(r"\n\n+|\n(?=\||\* )", section):
            text = block.strip()
            told = TEST_NAMED.search(text) or re.search(r"\bno\s+test\b", text)
            if text and not text.endswith(":") and not told:
                yield text


def test_every_promise_of_reliability_names_its_test():
    assert list(unheld(RELIABILITY)) == []


def test_a_promise_without_a_test_is_seen():
    held = "Held (`test_a::test_b`)."
    page = f"# Page\n\nIntroduces.\n\n## Section\n\nIs a lead:\n\n```sh\ncode\n```\n\n{held} And\nmore.\n\nBare.\n\n"
    page += f"* {held}\n* An item (no\n  test).\n* A bare item.\n\n|a|b|\n|---|---|\n|row|{held}|\n|bare|row|\n"
    assert list(unheld(page)) == ["Bare.", "* A bare item.", "|bare|row|"]


def test_limits_of_fidelity_are_the_ones_that_are_told():
    rows = re.findall(r"^\|`(\w+)`\|[^|]*\|((?:above|outside) [^|]*)\|", RELIABILITY, re.MULTILINE)
    told = {figure: [float(number) for number in re.findall(r"[\d.]+", limit)] for figure, limit in rows}
    assert told == {
        "miss": [fidelity.MISS_LIMIT],
        "length_ratio": [fidelity.LEAST_LENGTH_RATIO, fidelity.LARGEST_LENGTH_RATIO],
        "end": [fidelity.END_LIMIT],
        "nearby": [fidelity.NEARBY_LIMIT],
        "fastest": [fidelity.SPEED_LIMIT],
        "rise": [fidelity.ROUNDING_LIMIT],
        "restart_gap": [fidelity.ROUNDING_LIMIT],
        "timing": [fidelity.TIMING_LIMIT],
        "flow_gap": [fidelity.FLOW_GAP_LIMIT],
        "coordinate": [fidelity.COORDINATE_LIMIT],
        "command": [fidelity.COMMAND_LIMIT],
        "latent_error": [fidelity.ROUNDING_LIMIT],
    }
    assert told.keys() == fidelity.Fidelity.__dataclass_fields__.keys() - {"spread", "pace_spread", "shown"}
