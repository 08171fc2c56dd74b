"""Equations as MathML, made when the site is built: pages load no script and no font from elsewhere."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING
from xml.etree import ElementTree

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.errors import ExtensionError

if TYPE_CHECKING:
    from sphinx.application import Sphinx
    from sphinx.writers.html5 import HTML5Translator

TAG = re.compile(r"\\tag\{(\w+)\}")
FENCES = {r"\lvert": r"\left|", r"\rvert": r"\right|", r"\lVert": r"\left\Vert", r"\rVert": r"\right\Vert"}
"""Bars that the converter takes for operators, which stand apart from what they enclose."""
NAMESPACE = "http://www.w3.org/1998/Math/MathML"
PRIME, TRANSPOSE = "\u2032", "\u22a4"


def mathml(tex: str, display: str) -> str:
    """Return an equation as MathML, with its TeX as the label of the element.

    Raises:
        ExtensionError: a command that the converter does not know, which would be shown as TeX.
    """
    shown = TAG.sub("", tex).strip()
    for bar, fence in FENCES.items():
        shown = shown.replace(bar, fence)
    tree = ElementTree.fromstring(convert(shown, display=display))
    if any("\\" in text for text in tree.itertext()):
        raise ExtensionError(f"This equation has a command that cannot be typeset: {tex}")
    tidy(tree)
    tree.set("aria-label", tex)
    ElementTree.register_namespace("", NAMESPACE)
    return ElementTree.tostring(tree, encoding="unicode")


def tidy(element: ElementTree.Element) -> None:
    """Set primes, transposes and names of functions as in print, whatever font the browser has."""
    for child in element:
        tidy(child)
    kind, parts = element.tag.rpartition("}")[2], list(element)
    if kind == "mo" and element.text == TRANSPOSE:
        element.tag, element.text = f"{{{NAMESPACE}}}mi", "T"
        element.set("mathvariant", "normal")
    elif kind == "mo" and (element.text or "").isalpha():
        element.attrib |= {"lspace": "0.17em", "rspace": "0.1em"}
    elif kind in ("msup", "msubsup") and parts[-1].text == PRIME:
        # A prime is raised by itself; as a superscript it would be raised twice.
        element[:] = [primed(parts[0]), *parts[1:-1]]
        element.tag = f"{{{NAMESPACE}}}{'msub' if kind == 'msubsup' else 'mrow'}"
    elif kind == "msup" and len(parts[1]) and parts[1][0].text == PRIME:
        parts[1].remove(parts[1][0])
        element[:] = [primed(parts[0]), parts[1]]


def primed(base: ElementTree.Element) -> ElementTree.Element:
    """Return a base followed by a prime."""
    row = ElementTree.Element(f"{{{NAMESPACE}}}mrow")
    prime = ElementTree.Element(f"{{{NAMESPACE}}}mo", {"lspace": "0", "rspace": "0"})
    prime.text = PRIME
    row.extend([base, prime])
    return row


def visit_inline(translator: HTML5Translator, node: nodes.math) -> None:
    """Write an equation within a line."""
    translator.body.append(mathml(node.astext(), "inline"))
    raise nodes.SkipNode


def visit_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    """Write an equation on a line of its own, with the number of its `\\tag` at the right and as its anchor."""
    tex = node.astext()
    tag = TAG.search(tex)
    anchor = f' id="eq-{tag[1].lower()}"' if tag else ""
    number = f'<span class="eqno">({tag[1]})</span>' if tag else ""
    translator.body.append(f'<div class="math"{anchor}><div>{mathml(tex, "block")}</div>{number}</div>\n')
    raise nodes.SkipNode


def setup(app: Sphinx) -> None:
    """Register the renderer."""
    app.add_html_math_renderer("mathml", inline_renderers=(visit_inline, None), block_renderers=(visit_block, None))
