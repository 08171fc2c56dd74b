"""Equations as MathML, made when the site is built: it loads no script and no font from elsewhere."""

from __future__ import annotations

import html
import re
from typing import TYPE_CHECKING

from latex2mathml.converter import convert
from sphinx.errors import ExtensionError

if TYPE_CHECKING:
    from docutils import nodes
    from sphinx.application import Sphinx
    from sphinx.writers.html5 import HTML5Translator

TAG = re.compile(r"\\tag\{(\w+)\}")


def mathml(tex: str, display: str) -> str:
    """Return an equation as MathML, with its TeX as the label of the element.

    Raises:
        ExtensionError: a command that the converter does not know, which would be shown as TeX.
    """
    shown = convert(TAG.sub("", tex).strip(), display=display)
    if "\\" in re.sub(r"<[^>]*>", "", shown):
        raise ExtensionError(f"This equation has a command that cannot be typeset: {tex}")
    return shown.replace("<math ", f'<math aria-label="{html.escape(tex, quote=True)}" ', 1)


def visit_inline(translator: HTML5Translator, node: nodes.math) -> None:
    """Write an equation within a line."""
    translator.body.append(mathml(node.astext(), "inline"))


def visit_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write an equation on a line of its own, with the number of its `\\tag` at the right and as its anchor."""
    tex = node.astext()
    tag = TAG.search(tex)
    anchor = f' id="eq-{tag[1].lower()}"' if tag else ""
    number = f'<span class="eqno">({tag[1]})</span>' if tag else ""
    translator.body.append(f'<div class="math"{anchor}>{mathml(tex, "block")}{number}</div>\n')


def leave(translator: HTML5Translator, node: nodes.Node) -> None:
    """Do nothing: an equation has no children to write."""


def setup(app: Sphinx) -> None:
    """Register the renderer."""
    from docutils import nodes

    def skip(translator: HTML5Translator, node: nodes.Node) -> None:
        (visit_block if isinstance(node, nodes.math_block) else visit_inline)(translator, node)  # type: ignore[arg-type]
        raise nodes.SkipNode

    app.add_html_math_renderer("mathml", inline_renderers=(skip, None), block_renderers=(skip, None))
