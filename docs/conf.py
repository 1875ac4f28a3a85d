"""Sphinx: the site, from docstrings, notebooks, scenes and the pages of this folder."""

import sys
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent
sys.path[:0] = [str(HERE), str(ROOT)]

import vmri_jax  # noqa: E402

vmri_jax.configure()

from extensions import docstrings, effects, gallery, public  # noqa: E402

project, author, copyright = "vmri_jax", "the vmri_jax developers", "the vmri_jax developers"
version = release = vmri_jax.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx.ext.mathjax",
    "sphinx_copybutton",
    "sphinx_design",
    "sphinx_gallery.gen_gallery",
    "myst_nb",
]
exclude_patterns = [
    "_build",
    "extensions",
    "gallery_sources",
    *(f"gallery/*.{kind}" for kind in ("ipynb", "py", "md5", "zip", "json")),
]
myst_enable_extensions = ["dollarmath", "colon_fence", "deflist", "attrs_inline"]
myst_heading_anchors = 3
nb_execution_mode = "off"  # the tests run the notebooks, and compare what they show
suppress_warnings = [
    "config.cache",  # of the function that makes the pictures of the gallery
    "ref.python",  # a word in single backticks that several classes have as an attribute
]
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
napoleon_use_ivar = True
default_role = "py:obj"  # a name in single backticks is a link where it is a public one, else as it stands
nitpicky = True
nitpick_ignore_regex = [
    (r"py:.*", r".*")
]  # names in docstrings that are not public; links between pages are all checked

html_theme = "pydata_sphinx_theme"
html_title = "vmri_jax"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_context = {"default_mode": "auto"}
html_theme_options = {
    "show_toc_level": 2,
    "navigation_with_keys": False,
    "secondary_sidebar_items": ["page-toc"],
    "footer_start": ["copyright"],
    "footer_end": [],
}
html_sidebars = {"index": [], "nutshell": [], "changelog": [], "limitations": []}

sphinx_gallery_conf = gallery.settings(ROOT / "notebooks" / "scenes", HERE)


def setup(app):
    """Copies what the site shows of the rest of the project, and hooks docstrings."""
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        text = path.read_text(encoding="utf-8").replace("(scenes/README.md)", "(../gallery/index.rst)")
        (HERE / "tutorials" / path.name).write_text(text, encoding="utf-8")
    public.write(HERE / "reference")
    effects.write(HERE / "reference")
    app.connect("autodoc-process-docstring", docstrings.as_rest, priority=1)  # before napoleon
