"""Modules are named after their content, once."""

from collections import Counter
from pathlib import Path

import shapespace

ROOT = Path(shapespace.__file__).parent
# A command is a module of its own, named as the user types it.
NAMED_AFTER_COMMANDS = {"commands", "cli"}


def test_no_two_modules_have_the_same_name() -> None:
    names = Counter(
        path.stem
        for path in ROOT.rglob("*.py")
        if not path.stem.startswith("__") and path.relative_to(ROOT).parts[0] not in NAMED_AFTER_COMMANDS
    )
    assert [name for name, count in names.items() if count > 1] == []
