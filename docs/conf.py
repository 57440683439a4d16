"""Sphinx configuration of the site. `make docs` builds it into build/site, without access to a network."""

from __future__ import annotations

import os
import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
sys.path.insert(0, str(HERE / "_extension"))

import femsense  # noqa: E402

project = "femsense"
author = "the femsense developers"
copyright = "the femsense developers, MIT licence"
version = release = femsense.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx_design",
    "sphinx_copybutton",
    "femsense_site",
]
if os.environ.get("FEMSENSE_DOCS_INTERSPHINX") == "1":  # links to other projects need their inventories from the network
    extensions.append("sphinx.ext.intersphinx")
    intersphinx_mapping = {
        "python": ("https://docs.python.org/3", None),
        "numpy": ("https://numpy.org/doc/stable", None),
        "scipy": ("https://docs.scipy.org/doc/scipy", None),
    }

exclude_patterns = ["_build", "_extension", "tutorials/*.py"]
myst_enable_extensions = ["colon_fence", "deflist", "dollarmath", "amsmath", "attrs_inline", "attrs_block"]
myst_heading_anchors = 4
suppress_warnings = ["myst.header"]

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
autodoc_type_aliases = {name: name.removeprefix("npt.") for name in ("npt.ArrayLike", "FloatArray", "IntArray", "BoolArray")}
toc_object_entries_show_parents = "hide"
autoclass_content = "both"
python_use_unqualified_type_names = True
python_maximum_signature_line_length = 88
napoleon_numpy_docstring = False
napoleon_use_rtype = False
default_role = "code"  # docstrings quote names as `name`

html_math_renderer = "mathml"
html_theme = "pydata_sphinx_theme"
html_title = "femsense"
html_static_path = ["_static"]
html_css_files = ["femsense.css"]
html_logo = "_static/logo.svg"
html_favicon = "_static/logo.svg"
html_show_sourcelink = False
html_copy_source = True
html_theme_options = {
    "header_links_before_dropdown": 7,
    "navbar_align": "left",
    "navbar_end": ["theme-switcher"],
    "logo": {"text": "femsense"},
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "footer_start": ["copyright"],
    "footer_end": [],
    "secondary_sidebar_items": ["page-toc"],
    "pygments_light_style": "github-light",
    "pygments_dark_style": "github-dark",
}
html_sidebars = {"index": [], "appendix/changelog": []}
copybutton_prompt_text = r">>> |\.\.\. |\$ "
copybutton_prompt_is_regexp = True
