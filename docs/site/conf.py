"""The documentation site: Sphinx over the Markdown files of the repository (`make docs`)."""

import sys
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx
from sphinx.util.inspect import TypeAliasForwardRef

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE))

import site_math  # noqa: E402
import site_plots  # noqa: E402
import site_text  # noqa: E402
import site_trees  # noqa: E402
from shapespace import __version__  # noqa: E402

project, author, version, release = "shapespace", "The shapespace authors", __version__, __version__
project_copyright = "The shapespace authors, MIT licence"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]

# The repository is the source, so that links between its files hold here as they do on a forge.
root_doc = site_text.FIRST
include_patterns = [*(f"{page}.md" for page in site_text.documents(ROOT)), "docs/cli/*.md"]
_folders = {page.partition("/")[0] for page in site_text.documents(ROOT)}
exclude_patterns = [path.name for path in ROOT.iterdir() if path.is_dir() and path.name not in _folders]
myst_heading_anchors = 4
# The forms that GitHub typesets too: $...$ in a line, a fence ```math for a block.
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]
html_math_renderer = "mathml"
default_role = "literal"

autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
autodoc_type_aliases = {name: name for name in ("FloatArray", "IntArray", "BoolArray", "Status", "Gauge")}
# Within other types Sphinx shows an alias as the code that makes it.
TypeAliasForwardRef.__repr__ = lambda self: self.name
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
    site_math.setup(app)
    app.connect("builder-inited", site_plots.draw_all)
    app.connect("source-read", site_text.complete)
    app.connect("autodoc-process-docstring", site_text.markup)
    app.connect("missing-reference", site_text.public_name)
    # Before Sphinx collects the files to download, at 500.
    app.connect("doctree-read", site_trees.link_to_pages, priority=400)
    app.connect("html-collect-pages", site_trees.source_pages)
    app.connect("build-finished", site_trees.check_nothing_is_fetched)
