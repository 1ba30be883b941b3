"""How the site is built: `make docs`, without a network, warnings being errors."""

from __future__ import annotations

import sys
from pathlib import Path

import latentds

sys.path.insert(0, str(Path(__file__).parent))  # for what this folder adds to Sphinx

project, author, release = "latentds", "the latentds authors", latentds.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_gallery.gen_gallery"]
extensions += ["linked_terms", "offline_formulas"]
exclude_patterns = ["_build", "gallery/*", "**/*.ipynb"]
myst_enable_extensions = ["dollarmath", "deflist"]
myst_heading_anchors = 3
html_math_renderer = "mathml"
html_theme = "furo"
html_title = "latentds"
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_format = "short"
python_use_unqualified_type_names = True
napoleon_use_ivar = True
sphinx_gallery_conf = {
    "examples_dirs": "gallery",
    "gallery_dirs": "examples",
    "filename_pattern": r"\.py$",
    "image_scrapers": ("scraper.pictures",),
    "abort_on_example_error": True,
    "download_all_examples": False,
    "show_memory": False,
    "min_reported_time": 3600,
}
