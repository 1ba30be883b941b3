"""What every study leaves behind: Markdown tables, and where and with what its numbers were measured."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from latentds import report
from latentds.files import atomic_write


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table: the first column to the left, the others to the right."""
    rule = [":--", *["--:"] * (len(header) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *rows))


def environment() -> dict[str, Any]:
    """Versions, machine, date and, in a git checkout, revision."""
    return {"revision": _revision(), **report.environment()}


def write(path: Path, content: str | dict[str, Any]) -> None:
    """Text, or a mapping as JSON; the file is there whole or not at all."""
    text = content if isinstance(content, str) else json.dumps(content, indent=2) + "\n"
    with atomic_write(path) as file:
        file.write(text.encode())


def _revision() -> str | None:
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None
