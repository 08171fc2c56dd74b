"""The package only gets lighter: statements and modules of each package, options and settings, only ever sink.

After a change that makes it lighter, write the lower numbers to size.json and commit them:

    python tests/contracts/test_size.py
"""

import ast
import json
from collections import Counter
from pathlib import Path

import pytest

import shapespace
from shapespace.cli.command_table import COMMANDS, JSON, QUIET

ROOT = Path(shapespace.__file__).parent
LIMITS = Path(__file__).with_name("size.json")
AGAIN = "python tests/contracts/test_size.py"

OF_ALL = (JSON, QUIET)
"""Options of all commands, which count once."""
Sizes = dict[str, dict[str, int]]


def statements(code: str) -> int:
    """Return the number of statements, without docstrings and other lone texts; layout and comments do not count."""
    return sum(
        isinstance(node, ast.stmt)
        and not (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        )
        for node in ast.walk(ast.parse(code))
    )


def measure(root: Path) -> Sizes:
    """Return statements and modules by package, the options of all commands, and the settings that differ."""
    count: Counter[str] = Counter()
    modules: Counter[str] = Counter()
    for path in root.rglob("*.py"):
        parts = path.relative_to(root).parts
        package = parts[0] if len(parts) > 1 else "(top)"
        count[package] += statements(path.read_text("utf-8"))
        modules[package] += 1
    given = [option for command in COMMANDS for option in command.options if option not in OF_ALL]
    options = len(OF_ALL) + sum(not option.is_positional for option in given)
    settings = len({option for command in COMMANDS for option in command.settings})
    kinds = {"options": {"commands": options}, "settings": {"commands": settings}}
    sizes = {"statements": count, "modules": modules, **kinds}
    return {kind: {package: numbers[package] for package in sorted(numbers)} for kind, numbers in sizes.items()}


def differences(now: Sizes, limits: Sizes) -> list[str]:
    """Return a sentence for each number that differs from its limit."""
    found: list[str] = []
    for kind in limits:
        for package in sorted(now[kind].keys() | limits[kind].keys()):
            size, limit = now[kind].get(package, 0), limits[kind].get(package, 0)
            if size > limit:
                found.append(
                    f"{package} has {size} {kind} but may have {limit}: remove {size - limit} of what is dead or twice."
                )
            elif size < limit:
                found.append(f"{package} has {size} {kind}, fewer than {limit}: commit the lower number ({AGAIN}).")
    return found


def test_statements_modules_and_options_only_sink() -> None:
    assert differences(measure(ROOT), json.loads(LIMITS.read_text("utf-8"))) == []


@pytest.mark.parametrize(
    ("size", "sentence"),
    [
        (5, []),
        (6, ["io has 6 statements but may have 5: remove 1 of what is dead or twice."]),
        (4, [f"io has 4 statements, fewer than 5: commit the lower number ({AGAIN})."]),
    ],
)
def test_a_higher_and_a_lower_number_are_named(size: int, sentence: list[str]) -> None:
    assert differences({"statements": {"io": size}}, {"statements": {"io": 5}}) == sentence
    assert differences({"statements": {"io": 5, "new": 1}}, {"statements": {"io": 5}}) != []


def test_layout_comments_and_docstrings_do_not_count() -> None:
    spread = '"""A module."""\n\n# why\nx = (\n    1\n)\n"""What x is."""\n\n\ndef f():\n    """Do."""\n    return x\n'
    assert statements(spread) == statements("x = 1\ndef f(): return x\n") == 3


if __name__ == "__main__":
    LIMITS.write_text(json.dumps(measure(ROOT), indent=2) + "\n", "utf-8")
