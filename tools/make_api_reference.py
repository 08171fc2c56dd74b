"""Write the entries of docs/api.md: first sentence of the docstring, source, signature and example of each public name.

The order and the texts between the entries are those of the page. A test compares the page, and asks for this command:

    python tools/make_api_reference.py
"""

from __future__ import annotations

import inspect
import re
import runpy
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PAGE = DOCS / "api.md"
ENTRY = re.compile(r"^- `(\w+)`: (.*)\n(?:  .*\n)*", re.MULTILINE)
CODE = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def signature(name: str, of: Any) -> str:
    """Return how a public name is called, without types, or the keys of a table of choices."""
    if isinstance(of, dict):
        return f"{name}: {', '.join(sorted(map(str, of)))}"
    if inspect.isclass(of) and issubclass(of, Exception):
        return name
    plain = [one.replace(annotation=one.empty) for one in inspect.signature(of).parameters.values()]
    text = str(inspect.Signature(plain))
    return f"{name}{re.sub(r' at 0x[0-9a-f]+', '', text)}"


def sentence(of: Any, written: str) -> str:
    """Return the first sentence of a docstring; for values, which have none, `written` on the page."""
    if not callable(of):
        return written.partition(" [")[0].rstrip(".")
    paragraph = " ".join((inspect.getdoc(of) or "").partition("\n\n")[0].split())
    return re.split(r"(?<=[.:;])\s", paragraph)[0].rstrip(".:;")


def example(name: str, pages: dict[str, str]) -> str:
    """Return the page whose code uses a name most; empty if none does."""
    counts = {page: len(re.findall(rf"\b{name}\b", code)) for page, code in pages.items()}
    most = max(sorted(counts), key=counts.__getitem__)
    return most if counts[most] else ""


def own_example(of: Any) -> list[str]:
    """Return the lines of the example in a docstring; none if there is none."""
    found = re.search(r"^Example:\n((?:    .*\n?)+)", inspect.getdoc(of) or "", re.MULTILINE)
    return [line.removeprefix("    ") for line in found[1].splitlines()] if found else []


def page() -> str:
    """Return the page with its entries written anew."""
    names = runpy.run_path(str(ROOT / "tools" / "public_api.py"))["names"]()
    pages = {file.name: "\n".join(CODE.findall(file.read_text("utf-8"))) for file in DOCS.glob("*.md") if file != PAGE}

    def entry(match: re.Match[str]) -> str:
        name, of = match[1], names[match[1]]
        file = inspect.getsourcefile(inspect.unwrap(of)) if callable(of) else None
        links = [f"[source](../{Path(file).relative_to(ROOT).as_posix()})"] if file else []
        shown_on, own = example(name, pages), own_example(of)
        links += [f"[example]({shown_on})"] if shown_on else []
        lines = [f"- `{name}`: {sentence(of, match[2])}. {', '.join(links)}".rstrip(), f"  `{signature(name, of)}`"]
        if own:
            lines += ["  ```pycon", *(f"  {line}" for line in own), "  ```"]
        return "\n".join(lines) + "\n"

    return ENTRY.sub(entry, PAGE.read_text("utf-8"))


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
