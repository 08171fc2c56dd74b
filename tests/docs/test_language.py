"""Names, help texts and documents use the terms of the field (docs/glossary.md), and none of the words ruled out."""

import ast
import re
import runpy
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from shapespace import cli
from shapespace.cli.command_table import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
RULED_OUT = (
    "told", "tell", "tells", "said", "somebody", "nobody", "set aside", "goes by", "what came of", "of the kind",
    "as it stands", "by itself",
)  # fmt: skip
ANY_RULED_OUT = re.compile("|".join(r"\s+".join(map(re.escape, words.split())) for words in RULED_OUT), re.IGNORECASE)
"""Finds each text with one of the words, and some others, in one pass."""
NAMES_RULED_OUT = {"told", "tell", "tells", "said", "somebody", "nobody"}
NAMES_KEPT = {
    # Released names: a rename would break programs that use them.
    "AdditiveModel.tie": {"told"},
    # The callback of a build, an argument with this name since 1.0.
    "ShapeModel.fit": {"tell"},
    "ShapeModel.with_more": {"tell"},
}
"""Public names, each with the words in its signature that stay, and the reason."""
STATUSES_KEPT = {"set aside"}
"""Values in result files, which programs read; they are printed as other words."""
NOT_YET_CLEAN: tuple[str, ...] = ()
"""File names of pages in docs that still have such words; every other page, also a new one, is checked."""
GLOSSARY = ROOT / "docs" / "glossary.md"
PAGES = [ROOT / "README.md", *sorted(p for p in (ROOT / "docs").glob("*.md") if p.name not in NOT_YET_CLEAN)]
SHORTEST_GLOSSARY = 40


def ruled_out_in(text: str) -> list[str]:
    """Return the lines of `text`, joined over line breaks, that have one of the words ruled out."""
    found: list[str] = []
    if not ANY_RULED_OUT.search(text):
        return found
    for word in RULED_OUT:
        pattern = r"\b" + r"\s+".join(map(re.escape, word.split())) + r"\b"
        for match in re.finditer(pattern, text, re.IGNORECASE):
            found.append(" ".join(text[max(0, match.start() - 40) : match.end() + 40].split()))
    return found


def prose_of(page: Path) -> str:
    """Return the text of a page without Python blocks and code spans, whose names the first test checks.

    Consoles and printed output stay.
    """
    text = re.sub(r"^```python$.*?^```$", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    return re.sub(r"`[^`\n]+`", "", text)


def test_the_check_finds_words_over_line_breaks_and_no_parts_of_words() -> None:
    assert len(ruled_out_in("It is Told.\nThe scan is set\naside by itself.")) == 3
    assert ruled_out_in("A storyteller; set the table aside; retold") == []


def test_public_names_have_none_of_the_words() -> None:
    for line in runpy.run_path(str(ROOT / "tools" / "public_api.py"))["lines"]():
        name = re.split(r"[ (]", line, maxsplit=1)[0]
        arguments = re.findall(r"[(,] ?\*{0,2}(\w+)(?=[:=,)])", line)
        words = {word for of in (*name.split("."), *arguments) for word in of.lower().split("_")}
        assert words & NAMES_RULED_OUT <= NAMES_KEPT.get(name, set()), line


def test_no_public_name_is_kept_that_is_gone() -> None:
    lines = runpy.run_path(str(ROOT / "tools" / "public_api.py"))["lines"]()
    assert set(NAMES_KEPT) <= {re.split(r"[ (]", line, maxsplit=1)[0] for line in lines}


@pytest.mark.parametrize("command", ["", "data", "recognise", *(f"{c.name} --help-all" for c in COMMANDS)])
def test_the_help_of_a_command_has_none_of_the_words(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main([*command.split(), "--help"])
    assert ruled_out_in(capsys.readouterr().out) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_a_document_has_none_of_the_words(page: Path) -> None:
    assert ruled_out_in(prose_of(page)) == []


def sentences() -> Iterator[tuple[str, str]]:
    """Yield (place, text) of the strings in src that are no docstrings and have several words."""
    for file in sorted((ROOT / "src").rglob("*.py")):
        tree = ast.parse(file.read_text("utf-8"))
        docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
        for node in ast.walk(tree):
            if not isinstance(node, ast.Constant) or not isinstance(node.value, str) or id(node) in docs:
                continue
            if " " in node.value.strip() and node.value not in STATUSES_KEPT:
                yield f"{file.relative_to(ROOT)}:{node.lineno}", node.value


def test_messages_have_none_of_the_words() -> None:
    found = {place: words for place, text in sentences() if (words := ruled_out_in(text))}
    assert not found


def test_pages_not_yet_clean_exist_and_have_such_words() -> None:
    for name in NOT_YET_CLEAN:
        assert ruled_out_in(prose_of(ROOT / "docs" / name)), f"{name} is clean: take it out of NOT_YET_CLEAN"


# The glossary


def entries() -> list[list[str]]:
    """Return the cells of each row of the glossary."""
    lines = [line for line in GLOSSARY.read_text("utf-8").splitlines() if line.startswith("|")]
    table = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return [row for row in table if row[0] != "term" and not set(row[0]) <= set("-")]


@cache
def definitions() -> tuple[frozenset[str], dict[str, set[str]]]:
    """Return the names that src defines or imports, and the members of each class by its name."""
    names: set[str] = set()
    members: dict[str, set[str]] = {}
    for file in (ROOT / "src").rglob("*.py"):
        names.add(file.stem)
        for node in ast.walk(ast.parse(file.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.ClassDef):
                names.add(node.name)
            elif isinstance(node, ast.AnnAssign | ast.Assign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                names.update(target.id for target in targets if isinstance(target, ast.Name))
            elif isinstance(node, ast.ImportFrom):
                names.update(alias.name for alias in node.names)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier():
                names.add(node.value)  # a key of the evidence
            if isinstance(node, ast.ClassDef):
                members.setdefault(node.name, set()).update(
                    part.name if isinstance(part, ast.FunctionDef) else part.target.id
                    for part in node.body
                    if isinstance(part, ast.FunctionDef)
                    or (isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name))
                )
    return frozenset(names), members


def is_defined(name: str) -> bool:
    """Return whether src defines a name, a member of a class as `Class.member`, or an option or a command."""
    names, members = definitions()
    if name.startswith("--"):
        return any(name in option.spellings for command in COMMANDS for option in command.options)
    if " " in name:
        return name in {f"shapespace {command.name}" for command in COMMANDS}
    owner, _, member = name.rpartition(".")
    return member in members.get(owner, set()) if owner else name in names


def test_names_in_the_glossary_are_those_of_the_code() -> None:
    for term, _, _, code, _ in entries():
        wanted = re.findall(r"`([^`]+)`", code)
        assert wanted, f"{term} has no name in code"
        for name in wanted:
            assert is_defined(name), f"{term}: src has no {name}"


def test_a_name_that_is_not_in_the_code_is_found() -> None:
    assert is_defined("ShapeModel.mean") and is_defined("--dense") and is_defined("shapespace fit")
    assert (
        not is_defined("ShapeModel.nonsense")
        and not is_defined("--nonsense")
        and not is_defined("no_such_thing_at_all")
    )


def test_each_entry_of_the_glossary_is_complete_and_there_once() -> None:
    rows = entries()
    assert len(rows) >= SHORTEST_GLOSSARY
    assert all(len(row) == 5 and row[0] and row[2].endswith(".") and row[4] for row in rows)
    terms = [row[0] for row in rows]
    assert len(set(terms)) == len(terms)


def test_the_glossary_is_linked_from_readme_and_first_page() -> None:
    assert "(docs/glossary.md)" in (ROOT / "README.md").read_text("utf-8")
    assert "(glossary.md)" in (ROOT / "docs" / "index.md").read_text("utf-8")
