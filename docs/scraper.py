"""How the gallery finds pictures: every Figure that a script names, without pyplot."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure
from sphinx_gallery.scrapers import figure_rst


def pictures(_: Any, names: dict[str, Any], conf: dict[str, Any]) -> str:
    """Save the figures among a script's variables that are new since its last block, and show them."""
    known, paths = names.setdefault("_saved", set()), []
    for figure in names["example_globals"].values():
        if isinstance(figure, Figure) and id(figure) not in known:
            known.add(id(figure))
            paths.append(names["image_path_iterator"].next())
            figure.savefig(paths[-1], dpi=110)
    return figure_rst(paths, conf["src_dir"])
