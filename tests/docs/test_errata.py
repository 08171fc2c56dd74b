import ast
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "paper-map.md").read_text(encoding="utf-8")
MISPRINTS = PAGE.split("\n## Misprints\n")[1].split("\n## ")[0]
NAMED = re.findall(r"`(tests/[\w/]+\.py)::(\w+)`", MISPRINTS)


def test_every_test_that_the_errata_name_exists() -> None:
    assert len(NAMED) >= 18
    for file, name in NAMED:
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, f"{file}::{name}"


def test_every_correction_names_a_test() -> None:
    rows = [line for line in MISPRINTS.splitlines() if line[:2] == "| "]
    headings = [row for row in rows if row.endswith("shown by |")]
    assert len(headings) == 3
    for row in rows:
        assert row in headings or "::test_" in row, row
