"""Check the prose of the source, docstrings, comments and messages, against the patterns that readers stumble over.

Usage: python tools/check_language.py [PATH ...]      (default: src); exit code 1 if a pattern occurs
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

PATTERNS = {
    r"\bholds?\b(?!:)": "contains, stores, constrains, is true",
    r"\b(?:left|leav(?:e|es|ing)) out\b|\bleft-out\b": "excluded, omitted, held out",
    r"\bwhole\b": "complete, intact, entire",
    r"\brefus": "reject, raise, check",
    r"\bstands?\b(?! (?:alone|for)\b)": "is",
    r"\bbeside\b": "next to, in addition to, compared with",
    r"\b(?:says?|said|tells?|told)\b(?!:)": "reports, states, distinguishes",
    r"\b[Aa]s of `|: as of ": "see `x`",
    r"\bwhere (?:there (?:is|are) (?:none|no\b)|none (?:is|are))": "None if there is no ..., if ... is unknown",
    r"\bgoes (?:by|on)\b": "depends on, continues",
    r"\bof (?:them|it|these)\b(?=[.;,)]|$)": "name the noun",
    r"(?:^|[.:;] )What (?!(?:is|are|does|do|to)\b[^.]*\?)|\b(?:of|by|with|from|than|and|for) what\b": "name the thing",
    r"\bfrom nowhere\b|\bby itself\b|\bof the kind\b|\bsomebody\b": "a plain term",
}
"""Pattern -> the words to write instead."""
ARGUMENT = re.compile(
    r"^\s{4,}[\w*, ]+: (?:of|by|that|which|whose|to|for|with|in|from|as|at|and|their|its|where|when)\b"
)
"""An entry that continues the name of the argument; each is a noun phrase of its own, with shape and unit."""


def faults(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the line of each pattern in a file, and what to write."""
    source = path.read_text("utf-8")
    for line, text in prose(source):
        for pattern, advice in PATTERNS.items():
            for found in re.finditer(pattern, text, re.MULTILINE):
                yield line + text[: found.start()].count("\n"), f"{found[0].strip()!r}: write {advice}"
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.For | ast.comprehension):
            targets = [name for name in ast.walk(node.target) if isinstance(name, ast.Name) and name.id == "one"]
            yield from ((name.lineno, "'one' as a variable: write its noun") for name in targets)
    inside = False
    for line, text in enumerate(source.splitlines(), 1):
        heading = re.fullmatch(r"\s+(\w+):", text)
        inside = heading[1] == "Args" if heading else inside and '"""' not in text
        if inside and ARGUMENT.search(text):
            yield line, f"{text.strip()!r} continues its name: write a noun phrase"


def prose(source: str) -> Iterator[tuple[int, str]]:
    """Yield each comment, and each string of at least four words, with its line."""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string.lstrip("# ")
        elif token.type in (tokenize.STRING, getattr(tokenize, "FSTRING_MIDDLE", -1)) and len(token.string.split()) > 3:
            yield token.start[0], token.string


if __name__ == "__main__":
    roots = [Path(name) for name in sys.argv[1:]] or [Path("src")]
    files = sorted(file for root in roots for file in ([root] if root.is_file() else root.rglob("*.py")))
    lines = [f"{file}:{line}: {fault}" for file in files for line, fault in faults(file)]
    sys.stdout.writelines(f"{line}\n" for line in lines)
    sys.exit(bool(lines))
