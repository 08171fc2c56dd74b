"""Equations have the same numbers on pages and in code.

P paper, R robust, E completion, C correspondence, S statistics, M morphometrics.

On a page a number is the tag of an equation, in the code it stands in a comment or a docstring.
"""

import ast
import io
import re
import sys
import tokenize
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / "src" / "shapespace"
PAGES = sorted((ROOT / "docs").glob("*.md"))
HOMES = {
    "P": ("geometry", "model", "fit"),
    "R": ("fit",),
    "E": ("fit",),
    "C": ("correspondence", "model", "geometry", "batch"),
    "S": ("statistics",),
    "M": ("statistics", "geometry", "report"),
}
"""Folders of the code whose comments have the numbers of a prefix; elsewhere R2 and the like are other things."""
NUMBER = r"[PRECSM]\d+[a-z]?"
RANGE = re.compile(rf"(?<![\w.^*])({NUMBER})(?:\s?[-–]\s?({NUMBER}))?(?![\w.*])")
MATH = re.compile(r"^```math\n(.*?)^```$", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"(?<![\\$])\$([^$\n]+)\$")
sys.path.insert(0, str(ROOT / "docs" / "site"))


@cache
def tags(page: Path) -> tuple[str, ...]:
    """Return the numbers of the equations of a page, in its order."""
    text = page.read_text("utf-8")
    blocks = [*MATH.findall(text), *re.findall(r"^```text\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)]
    found = re.findall(rf"\\tag\{{({NUMBER})\}}", text)
    found += [tag for block in blocks for tag in re.findall(rf"\(({NUMBER})\)\s*$", block, re.MULTILINE)]
    return tuple(found)


@cache
def on_pages() -> frozenset[str]:
    return frozenset(tag for page in PAGES for tag in tags(page))


def ordered(tag: str) -> tuple[str, int, str]:
    match = re.fullmatch(r"([PRECSM])(\d+)([a-z]?)", tag)
    assert match
    return match[1], int(match[2]), match[3]


def numbers_in(text: str, *, ranges: bool = True) -> set[str]:
    """Return the numbers that a text names; a range stands for the numbers of the pages between its ends."""
    found: set[str] = set()
    for first, last in RANGE.findall(text):
        if ranges or not last:
            found |= {first, last} - {""}
        if ranges and last:
            found |= {tag for tag in on_pages() if ordered(first) <= ordered(tag) <= ordered(last)}
    return found


@cache
def prose_of_code(file: Path) -> str:
    """Return the comments and docstrings of a file."""
    text = file.read_text("utf-8")
    comments = [t.string for t in tokenize.generate_tokens(io.StringIO(text).readline) if t.type == tokenize.COMMENT]
    strings = [
        node.value.value
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
    ]
    return "\n".join([*comments, *strings])


@cache
def in_code(prefix: str, *, ranges: bool = True) -> dict[str, str]:
    """Return number -> file of the code, for a prefix; without ranges only where a comment is on that equation."""
    found: dict[str, str] = {}
    for file in sorted(SOURCE.rglob("*.py")):
        if file.relative_to(SOURCE).parts[0] in HOMES[prefix]:
            found |= {n: file.name for n in numbers_in(prose_of_code(file), ranges=ranges) if n.startswith(prefix)}
    return found


@pytest.mark.parametrize("prefix", HOMES)
def test_every_equation_of_the_pages_is_named_in_the_code(prefix: str) -> None:
    missing = {tag for tag in on_pages() if tag.startswith(prefix)} - set(in_code(prefix, ranges=False))
    assert not missing, f"no comment in the code names {sorted(missing, key=ordered)}"


@pytest.mark.parametrize("prefix", HOMES)
def test_every_equation_that_the_code_names_is_on_a_page(prefix: str) -> None:
    missing = {tag: file for tag, file in in_code(prefix).items() if tag not in on_pages()}
    assert not missing, f"no page has {missing}"


@pytest.mark.parametrize("prefix", ["P", "R", "S"])
def test_there_are_equations_of_each_prefix(prefix: str) -> None:
    assert sum(tag.startswith(prefix) for tag in on_pages()) > 10


def test_a_number_belongs_to_one_equation() -> None:
    every = [tag for page in PAGES for tag in tags(page)]
    assert len(every) == len(set(every))


@pytest.mark.parametrize("page", [page for page in PAGES if tags(page)], ids=lambda page: page.name)
def test_the_numbers_of_a_page_rise(page: Path) -> None:
    own = [ordered(tag) for tag in tags(page)]
    for prefix in HOMES:
        numbers = [one for one in own if one[0] == prefix]
        assert numbers == sorted(numbers), page.name


@pytest.mark.parametrize("page", [page for page in PAGES if tags(page)], ids=lambda page: page.name)
def test_numbers_in_the_text_of_a_page_exist(page: Path) -> None:
    prefixes = {tag[0] for tag in tags(page)}
    text = re.sub(r"`[^`\n]*`|\]\([^)]*\)", "", MATH.sub("", page.read_text("utf-8")))
    named = {number for number in numbers_in(text) if number[0] in prefixes}
    assert named <= on_pages(), named - on_pages()


def test_the_code_names_no_equation_without_its_prefix() -> None:
    for file in sorted(SOURCE.rglob("*.py")):
        assert not re.search(r"\beqs?\.? \(?\d", prose_of_code(file)), f"{file.name}: write P, R, C or S"


def test_ranges_of_numbers_are_understood() -> None:
    assert {"R4", "R5", "R6", "R6a"} <= numbers_in("matches (R4-R6a) of R2² and x.R3")
    assert "R3" not in numbers_in("x.R3")


@pytest.mark.parametrize("page", [page for page in PAGES if "$" in page.read_text("utf-8")], ids=lambda p: p.name)
def test_equations_become_mathml_without_rests_of_tex(page: Path) -> None:
    pytest.importorskip("latex2mathml", reason="the group `docs` is not installed")
    import site_math

    text = page.read_text("utf-8")
    prose = re.sub(r"`[^`\n]*`", "", re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL))
    for tex in [*MATH.findall(text), *INLINE.findall(prose)]:
        assert "&amp;" not in re.sub(r"<[^>]*>", "", site_math.mathml(tex, "block")), tex


# Symbols


def symbols() -> list[list[str]]:
    """Return the cells of the tables of symbols: symbol, meaning, names in the code, equations."""
    text = (ROOT / "docs" / "symbols.md").read_text("utf-8")
    rows = [line.strip("|").split(" | ") for line in text.splitlines() if line.startswith("| $")]
    return [[cell.strip() for cell in row] for row in rows]


def test_every_symbol_has_a_name_in_the_code() -> None:
    names: set[str] = set()
    for file in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.Name):
                names.add(node.id)
            elif isinstance(node, ast.arg):
                names.add(node.arg)
            elif isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.Attribute):
                names.add(node.attr)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier():
                names.add(node.value)  # a key of the evidence
    rows = symbols()
    assert len(rows) > 30
    for symbol, _, code, equations in rows:
        wanted = re.findall(r"`([^`]+)`", code)
        assert wanted, symbol
        assert numbers_in(equations) and numbers_in(equations) <= on_pages(), symbol
        for name in wanted:
            assert set(name.split(".")) <= names, f"{symbol}: the code has no {name}"
