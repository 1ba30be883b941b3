"""A comparison as one HTML file that needs nothing else: to sort, to switch, to turn and to play, without a network."""

from __future__ import annotations

import base64
import hashlib
import os
import platform
from collections.abc import Mapping, Sequence
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from .. import plotting
from ..demonstration import Demonstration
from ..files import atomic_write
from .comparison import Comparison
from .drawn import drawn
from .measured import findings
from .verdict import ARRIVE, percent, verdict

try:
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs
except ImportError as error:
    raise ImportError(f"reports need {error.name}: pip install 'latentds[cli]'") from error

if TYPE_CHECKING:
    import pandas as pd

__all__ = ["ARRIVE", "Comparison", "environment", "findings", "percent", "verdict", "write"]

PACKAGES = ("latentds", "torch", "numpy", "scipy", "numba", "fastdtw", "pandas", "joblib")


def write(
    path: str | os.PathLike[str],
    rows: pd.DataFrame,
    demonstrations: Demonstration | Sequence[Demonstration | Sequence[Demonstration]],
    *,
    paths: Mapping[tuple[str, str, int], Any] | None = None,
    settings: Mapping[str, Any] | None = None,
) -> None:
    """Write the result of :func:`latentds.compare` as one page of HTML. Atomic.

    The page tells which method follows best in a sentence, ranks them in a table that sorts, and shows their motions:
    to turn, to play over time, each method on or off; with distances, speeds, coordinates over time, certificates and
    settings. It loads nothing, and runs no script but its own, whatever labels and names hold.

    Args:
        path: the file, by custom ``*.html``.
        rows: of ``compare``, or of outcomes of :func:`latentds.benchmark.run`. A column "certificate" (JSON, as
            :func:`findings` gives it) is shown, too.
        demonstrations: those that were compared on, as ``compare`` takes them; they are the judges.
        paths: the rollouts, {(method, demonstration, seed): (B, T, n)}, as ``compare(…, paths=paths)`` fills them; of
            several seeds the lowest is drawn. Without them the page has no motions but the demonstrated ones.
        settings: what else to tell of how this was made, by name; versions, machine and date are added.

    Raises:
        ValueError: if an argument is none of this, or the demonstrations do not fit the rows.
    """
    comparison = Comparison(rows, demonstrations)
    colors = _colors(comparison.methods)
    data = {
        "labels": comparison.methods,
        "colors": list(colors.values()),
        "shown": plotting.SHOWN,
        "motions": [drawn(motion, comparison, paths or {}) for motion in comparison.motions],
    }
    text = _page(
        title=comparison.motions[0].name if len(comparison.motions) == 1 else f"{len(comparison.motions)} motions",
        comparison=comparison,
        verdict=verdict(comparison),
        settings=_flat({**(settings or {}), **environment()}),
        colors=colors,
        drawn=paths is not None,
        data=data,
    )
    with atomic_write(path) as file:
        file.write(text.encode())


def environment() -> dict[str, Any]:
    """Date, versions and kind of machine."""
    return {
        "date": datetime.now(timezone.utc).isoformat(timespec="seconds"),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cpu": _cpu(),
        "cores": os.cpu_count(),
        "packages": {name: metadata.version(name) for name in PACKAGES},
    }


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def _colors(labels: Sequence[str]) -> dict[str, str]:
    """A colour for each: the one that it has in every picture, unless another label here has it already."""
    free = [c for c in (*plotting.OTHERS, *plotting.COLORS.values()) if c not in map(plotting.color_of, labels)]
    colors: dict[str, str] = {}
    for label in labels:
        color = plotting.color_of(label)
        colors[label] = free.pop(0) if color in colors.values() and free else color
    return colors


def _flat(settings: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Names and texts, a line each; the innermost mappings in one."""
    lines: list[tuple[str, str]] = []
    for key, value in settings.items():
        if isinstance(value, Mapping) and any(isinstance(inside, Mapping) for inside in value.values()):
            lines += _flat(value, f"{prefix}{key} · ")
        else:
            lines.append((f"{prefix}{key}", _text(value)))
    return lines


def _text(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{part} {_text(inside)}" for part, inside in value.items())
    if isinstance(value, (list, tuple)):
        return ", ".join(map(_text, value))
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _page(**content: Any) -> str:
    here = Path(__file__).parent
    style, script = ((here / f"page.{kind}").read_text(encoding="utf-8") for kind in ("css", "js"))
    plotly = get_plotlyjs()
    hashes = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in (plotly, script)]
    pages = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    pages.policies["json.dumps_kwargs"] = {"allow_nan": False}
    pages.filters["percent"] = percent
    page = pages.from_string((here / "page.html").read_text(encoding="utf-8"))
    return page.render(
        arrive=ARRIVE,
        style=Markup(style),
        script=Markup(script),
        plotly=Markup(plotly),
        allowed=" ".join(f"'sha256-{value}'" for value in hashes),
        **content,
    )
