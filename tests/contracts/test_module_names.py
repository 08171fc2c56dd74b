"""Modules are named after their content, once."""

import ast
import re
from collections import Counter
from pathlib import Path

import shapespace

ROOT = Path(shapespace.__file__).parent
# A command is a module of its own, named as the user types it.
NAMED_AFTER_COMMANDS = {"commands", "cli"}
# Names of the public interface and of the templates: a cohort's covariates and a page's table, numbers and classes.
NAMESAKES = {"Predictions": {"predictions", "predictor"}, "Table": {"table", "blocks"}}


def test_no_two_modules_have_the_same_name() -> None:
    names = Counter(
        path.stem
        for path in ROOT.rglob("*.py")
        if not path.stem.startswith("__") and path.relative_to(ROOT).parts[0] not in NAMED_AFTER_COMMANDS
    )
    assert [name for name, count in names.items() if count > 1] == []


def test_the_architecture_page_names_every_module_in_the_row_of_its_folder() -> None:
    page = (ROOT.parents[1] / "docs" / "architecture.md").read_text("utf-8")
    rows = re.findall(
        r"^\| (`[^|]*`|top) \| (.*) \|$", page.partition("## Modules")[2].partition("| change |")[0], re.MULTILINE
    )
    described: set[Path] = set()
    # Modules of the top with a row of their own.
    with_row = {name for folders, _ in rows for name in re.findall(r"`(\w+)`", folders)}
    for folders, modules in rows:
        places = [ROOT / folder.replace(".", "/") for folder in re.findall(r"`([\w.]+)`", folders)] or [ROOT]
        files = {path for place in places for path in [*place.glob("*.py"), place.with_suffix(".py")] if path.is_file()}
        here = {path.stem for path in files if not path.stem.startswith("__")}
        names = set(re.findall(r"`(\w+)`", re.sub(r"\([^)]*\)", "", modules)))
        assert names - here - {"check", "info", "figures"} == set(), folders
        elsewhere = with_row if ROOT in places else here & with_row & {place.stem for place in places}
        assert here - set(re.findall(r"`(\w+)`", modules)) - elsewhere == set(), folders
        described |= files
    assert {path for path in ROOT.rglob("*.py") if not path.stem.startswith("__")} <= described


def test_no_two_classes_have_the_same_name() -> None:
    places: dict[str, set[str]] = {}
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef):
                places.setdefault(node.name, set()).add(path.stem)
    assert {name: found for name, found in places.items() if len(found) > 1} == NAMESAKES
