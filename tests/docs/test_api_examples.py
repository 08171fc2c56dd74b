"""Each public name has an example that runs: in its docstring, or on a page whose code the tests run."""

import doctest
import re
import runpy
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "api.md").read_text("utf-8")
TOOL = runpy.run_path(str(ROOT / "tools" / "make_api_reference.py"))
NAMES: dict[str, Any] = runpy.run_path(str(ROOT / "tools" / "public_api.py"))["names"]()
EXAMPLES = {name: example for name, of in NAMES.items() if (example := TOOL["own_example"](of))}
ENTRIES = {match[1]: match[0] for match in re.finditer(r"^- `(\w+)`: .*\n(?:  .*\n)*", PAGE, re.MULTILINE)}


def test_every_public_name_has_an_example() -> None:
    assert [
        name for name, text in ENTRIES.items() if name in NAMES and "example]" not in text and ">>> " not in text
    ] == []


@pytest.fixture(scope="module")
def objects(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The objects that the page makes before the examples."""
    pytest.importorskip("sklearn", reason="the extra `statistics` is not installed")
    [setup] = re.findall(r"^```python\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)
    made: dict[str, Any] = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path_factory.mktemp("examples"))
        exec(setup, made)  # code of the page
        yield made


@pytest.mark.parametrize("name", EXAMPLES)
def test_the_example_of_a_docstring_gives_what_it_shows(name: str, objects: dict[str, Any]) -> None:
    example = doctest.DocTestParser().get_doctest("\n".join(EXAMPLES[name]) + "\n", dict(objects), name, None, None)
    assert 0 < len(example.examples) <= 4
    printed: list[str] = []
    assert doctest.DocTestRunner(verbose=False).run(example, out=printed.append).failed == 0, "".join(printed)
