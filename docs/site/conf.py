"""The documentation site: Sphinx over the Markdown files as they stand in the repository (`make docs`)."""

import sys
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE))

import pages  # noqa: E402
import plots  # noqa: E402
import sources  # noqa: E402

from shapespace import __version__  # noqa: E402

project, author, version, release = "shapespace", "The shapespace authors", __version__, __version__
project_copyright = "The shapespace authors, MIT licence"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

# The repository is the source, so that links between its files hold here as they do on a forge.
root_doc = pages.FIRST
include_patterns = [f"{page}.md" for page in pages.documents(ROOT)]
_folders = {page.partition("/")[0] for page in pages.documents(ROOT)}
exclude_patterns = [path.name for path in ROOT.iterdir() if path.is_dir() and path.name not in _folders]
myst_heading_anchors = 4
default_role = "literal"

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_type_aliases = {name: name for name in ("FloatArray", "IntArray", "BoolArray", "Status", "Gauge")}
autodoc_member_order = "bysource"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False

html_theme = "furo"
html_title = f"shapespace {__version__}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_extra_path = ["extra"]
html_copy_source = False
html_show_sphinx = False
pygments_style, pygments_dark_style = "friendly", "github-dark"


def setup(app: Sphinx) -> None:
    """Add what the documents need beside the extensions."""
    app.add_lexer("layers", TextLexer)
    app.connect("builder-inited", plots.draw_all)
    app.connect("source-read", pages.complete)
    app.connect("autodoc-process-docstring", pages.markup)
    app.connect("missing-reference", pages.public_name)
    # Before Sphinx collects the files to download, at 500.
    app.connect("doctree-read", sources.link_to_pages, priority=400)
    app.connect("html-collect-pages", sources.source_pages)
