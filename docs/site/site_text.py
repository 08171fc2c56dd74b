"""Where each document stands in the navigation, and what the build adds to its text."""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import shapespace
import site_plots

if TYPE_CHECKING:
    from docutils.nodes import Element, TextElement
    from sphinx.addnodes import pending_xref
    from sphinx.application import Sphinx
    from sphinx.environment import BuildEnvironment

FIRST, REFERENCE, COMMANDS = "docs/index", "docs/api", "docs/cli"
HOMES = {
    name: package.__name__
    for package in (*(getattr(shapespace, name) for name in shapespace._PACKAGES), shapespace)
    for name in package.__all__
    if name != "__version__"
}
"""Public name -> its package; the top level for those that both have."""
DATA = {"CLASSIFIERS": "shapespace.recognise.classifiers"}
"""Public data -> the module that has their text."""
LONGEST = 600
"""Characters of a signature that is shown."""
NAVIGATION = {
    "Tutorials": [
        "docs/tutorial-faces",
        "docs/tutorial-spleens",
        "docs/tutorial-volumes",
        "docs/tutorial-bones",
        "docs/tutorial-recognition",
        "docs/tutorial-groups",
        "docs/tutorial-identity",
        "docs/tutorial-*",
    ],
    "How-to: models": [
        "docs/correspondence",
        "docs/howto-own-model",
        "docs/volumes",
        "docs/missing",
        "docs/quality",
    ],
    "How-to: fits": [
        "docs/howto-difficult-scans",
        "docs/landmarks",
        "docs/dense",
        "docs/scale",
        "docs/interop",
        "docs/report",
        "docs/viewer",
        "docs/howto-*",
    ],
    "How-to: questions": [
        "docs/recognise",
        "docs/statistics",
        "docs/identity",
        "docs/compare",
        "docs/change",
        "docs/asymmetry",
        "docs/regress",
        "docs/score",
    ],
    "Reference": [
        "docs/cli",
        "docs/fit-results",
        "docs/api",
        "docs/glossary",
        "docs/symbols",
        "docs/mesh-formats",
        "docs/model-file",
        "docs/data",
        "docs/benchmarks",
        "docs/api-stability",
    ],
    "Explanation": [
        "docs/how-it-works",
        "docs/robust",
        "docs/paper-map",
        "docs/uncertainty",
        "docs/what-can-go-wrong",
        "docs/bspline",
        "docs/other-tools",
    ],
    "Development": [
        "docs/architecture",
        "docs/extending",
        "docs/dependencies",
        "docs/releasing",
        "benchmarks/README",
        "studies/README",
        "CONTRIBUTING",
        "CHANGELOG",
    ],
}
"""Caption -> pages, a pattern or the names of documents without `.md`; `LATER` takes those that are nowhere here."""
LATER = "Reference"


def documents(root: Path) -> list[str]:
    """Return the documents of the site, without `.md`."""
    beside = [page for pages in NAVIGATION.values() for page in pages if not page.startswith("docs/")]
    return [*sorted(f"docs/{path.stem}" for path in (root / "docs").glob("*.md")), *beside]


def navigation(found: list[str]) -> dict[str, list[str]]:
    """Return caption -> documents with each of `found` once; those that no caption names come last under `LATER`."""
    chosen: dict[str, list[str]] = {}
    left = [page for page in found if page != FIRST]
    for caption, wanted in NAVIGATION.items():
        chosen[caption] = []
        for name in wanted:
            fitting = [page for page in left if Path(page).match(name)] if "*" in name else [name]
            chosen[caption] += fitting
            left = [page for page in left if page not in fitting]
    chosen[LATER] += left
    return chosen


def trees(found: list[str]) -> str:
    """Return the navigation as Sphinx has it, for the end of the first page."""
    return "".join(
        "\n```{toctree}\n:hidden:\n:caption: " + caption + "\n\n" + "\n".join(f"/{page}" for page in pages) + "\n```\n"
        for caption, pages in navigation(found).items()
    )


def reference(text: str) -> str:
    """Return the text of docs/api.md with what the docstring says in place of each name's line.

    Public names that the text does not have come at its end.
    """
    listed = re.findall(r"^- `(\w+)`:", text, flags=re.MULTILINE)
    rest = [name for name in HOMES if name not in listed]
    if rest:
        text += "\n## Others\n\n" + "".join(f"- `{name}`:\n" for name in rest)
    return re.sub(r"^- `(\w+)`:.*\n", lambda match: directive(match[1]), text, flags=re.MULTILINE)


def directive(name: str) -> str:
    """Return what has Sphinx show the docstring of a public name."""
    if name not in HOMES:
        raise AttributeError(f"shapespace has no public name {name!r}")
    home, shown, options = HOMES[name], name, ""
    thing = getattr(import_module(home), name)
    if isinstance(thing, type):
        kind, options = "autoclass", "   :members:\n"
        # Settings and results have dozens of arguments, which the list below tells one by one.
        if len(str(inspect.signature(thing.__init__))) > LONGEST:
            shown += "(...)"
    elif callable(thing):
        kind = "autofunction"
    else:
        kind, home, options = "autodata", DATA[name], "   :no-value:\n"
    return f"\n```{{eval-rst}}\n.. {kind}:: {home}.{shown}\n{options}```\n"


def complete(app: Sphinx, name: str, source: list[str]) -> None:
    """Add navigation, reference and plots to the text of a document as it is read."""
    if name == FIRST:
        source[0] += trees(documents(Path(app.srcdir)))
    elif name == REFERENCE:
        source[0] = reference(source[0])
    elif name == COMMANDS:
        source[0] += "\n```{toctree}\n:hidden:\n:glob:\n\ncli/*\n```\n"
    source[0] = site_plots.add(name, source[0])


def markup(app: Sphinx, what: str, name: str, thing: object, options: object, lines: list[str]) -> None:
    """Make of a docstring as it is written here what reStructuredText takes for the same."""
    lines[:] = [re.sub(r"(`[^`]+`)(?=\w)", r"\1\\ ", line.replace("|", r"\|")) for line in lines]


def public_name(app: Sphinx, env: BuildEnvironment, node: pending_xref, shown: TextElement) -> Element | None:
    """Lead from a class as its module has it to where the reference has it."""
    name: Any = node.get("reftarget", "").rpartition(".")[2]
    if node.get("refdomain") != "py" or name not in HOMES:
        return None
    return env.domains["py"].resolve_xref(env, node["refdoc"], app.builder, "obj", f"{HOMES[name]}.{name}", node, shown)
