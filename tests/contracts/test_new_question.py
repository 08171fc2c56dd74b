"""A question about shapes is one module and one row of SHAPE_TESTS: the example of docs/extending.md."""

import json
import pkgutil
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from shapespace.cli import options
from shapespace.cli.arguments import CommandParser
from shapespace.cli.command_table import _shape_test  # pyright: ignore[reportPrivateUsage]
from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.statistics.shape_tests import test_table
from shapespace.types import Mesh
from synthetic_shapes import blob, sphere

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "extending.md"
HOME = "shapespace.statistics.shape_tests.spread"


@pytest.fixture
def spread(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module of the document, in its place, and its row in the table."""
    found = re.search(r"```python\n(# spread\.py.*?)```", DOCUMENT.read_text("utf-8"), re.S)
    assert found is not None
    code, read = found[1], pkgutil.get_data
    module: Any = ModuleType(HOME)
    exec(compile(code, "spread.py", "exec"), vars(module))
    monkeypatch.setitem(sys.modules, HOME, module)
    monkeypatch.setattr("shapespace.statistics.shape_tests.spread", module, raising=False)
    monkeypatch.setattr(test_table, "SHAPE_TESTS", (*test_table.SHAPE_TESTS, module.ROW))
    own = "statistics/shape_tests/spread.py"
    monkeypatch.setattr(
        options.pkgutil, "get_data", lambda name, path: code.encode() if path == own else read(name, path)
    )
    yield module


def cohort(factor: float, seed: int) -> Cohort:
    rng = np.random.default_rng(seed)
    shapes = rng.standard_normal((24, 12, 3)) * np.repeat([1.0, factor], 12)[:, None, None]
    shapes += 20 * np.random.default_rng(5).standard_normal((12, 3))
    return Cohort.of_shapes(shapes, {"group": np.repeat(["a", "b"], 12)}, gauge="form")


def test_it_finds_a_difference_and_keeps_its_level(spread: Any) -> None:
    found = spread.compare_spread(cohort(3.0, 0), group=("group",), permutations=200)
    assert found.statistics[0].p <= 0.01
    null = [spread.compare_spread(cohort(1.0, k), group=("group",), permutations=60).statistics[0].p for k in range(60)]
    assert np.mean(np.array(null) <= 0.05) <= 0.15
    with pytest.raises(InputError, match="no column"):
        spread.compare_spread(cohort(1.0, 0), group=("sex",))


def test_its_command_has_the_options_of_the_function_and_writes_the_report(
    spread: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("shapespace.commands.answers.write_report", lambda folder, *_, **__: folder / "report.html")
    d, faces = sphere(200)
    for k in range(8):
        write_mesh(tmp_path / f"s{k}.ply", Mesh(blob(d, np.random.default_rng(k).standard_normal(5)), faces))
    (tmp_path / "people.csv").write_text("name,sex\n" + "".join(f"s{k},{'fm'[k % 2]}\n" for k in range(8)))
    command = _shape_test(spread.ROW)
    parser = CommandParser(prog="shapespace test spread", command=command)
    assert "columns whose classes are the groups" in parser.format_help()
    out = tmp_path / "out"
    given = [tmp_path / "people.csv", "--group", "sex", "--permutations", 20, "-o", out, "--json", "--quiet"]
    arguments = parser.parse_args(list(map(str, given)))
    assert arguments.run(arguments) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["question"] == "test spread" and "ifference of medians" in told["summary"][0]
    assert {"statistics.csv", "median_distances.csv", "methods.txt"} <= {path.name for path in out.iterdir()}
