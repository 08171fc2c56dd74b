"""What the build makes of documents as read: links to code lead to pages that show it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from docutils import nodes
from sphinx import addnodes
from sphinx.errors import ExtensionError

if TYPE_CHECKING:
    from sphinx.application import Sphinx

FETCHED = re.compile(r"""(?:\bsrc=|<link[^>]*\bhref=|url\(|@import)\s*["']?(?:https?:)?//[^\s"')>]*""")
LEXERS = {".py": "python", ".json": "json", ".md": "markdown", ".toml": "toml", ".txt": "text"}
"""Files that are shown, the others are downloads."""


def link_to_pages(app: Sphinx, tree: nodes.document) -> None:
    """Turn links to files of the repository into links to pages that show them."""
    root, here = Path(app.srcdir), Path(app.srcdir, app.env.docname).parent
    files = {node: (here / node["reftarget"]).resolve() for node in tree.findall(addnodes.download_reference)}
    files |= {
        node: root / f"{node['reftarget']}.md"
        for node in tree.findall(addnodes.pending_xref)
        if node["refdomain"] == "doc" and node["reftarget"] not in app.env.found_docs
    }
    for node, path in files.items():
        if path.suffix not in LEXERS or not path.is_file():
            continue
        file = path.relative_to(root)
        page = f"source/{file.as_posix()}"
        link = nodes.reference("", "", *node.children, refuri=app.builder.get_relative_uri(app.env.docname, page))
        link["internal"] = True
        node.replace_self(link)
        shown: set[str] = app.env.__dict__.setdefault("shown_sources", set())
        shown.add(file.as_posix())


def source_pages(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield a page for each file that is linked to."""
    for file in sorted(app.env.__dict__.get("shown_sources", ())):
        text = (Path(app.srcdir) / file).read_text("utf-8")
        code = app.builder.highlighter.highlight_block(text, LEXERS[Path(file).suffix], linenos="inline")
        yield f"source/{file}", {"title": file, "body": f"<h1>{file}</h1>{code}"}, "page.html"


def check_nothing_is_fetched(app: Sphinx, failure: Exception | None) -> None:
    """Fail where a page would load a font, a script, a style or a picture from elsewhere: it is read offline."""
    if failure:
        return
    for path in sorted(path for ending in ("html", "css") for path in Path(app.outdir).rglob(f"*.{ending}")):
        found = FETCHED.search(path.read_text("utf-8"))
        if found:
            raise ExtensionError(f"{path.relative_to(app.outdir)} loads something from elsewhere: {found[0]}")
