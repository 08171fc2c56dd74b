"""What the tests of readers ask of a refusal."""

from collections.abc import Callable
from pathlib import Path

import pytest

from shapespace.errors import FileFormatError


def refusal_of(read: Callable[[Path], object], path: Path) -> str:
    """Return the sentence with which `read` refuses `path`, which is one, and names it."""
    with pytest.raises(FileFormatError) as caught:
        read(path)
    text = str(caught.value)
    assert path.name in text, text
    assert text.endswith("."), text
    assert "\n" not in text, text
    return text
