"""The README's picture of the methods is what the methods do now; those of report and viewer come from their tests."""

import importlib.util
import os
from pathlib import Path

import pytest
from pictures import IMAGES, same_as_kept

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.long
def test_the_picture_of_the_methods_is_what_they_do(
    shared_data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SHAPESPACE_DATA", os.environ.get("SHAPESPACE_DATA") or str(shared_data))
    spec = importlib.util.spec_from_file_location("make_methods_picture", ROOT / "tools" / "make_methods_picture.py")
    assert spec is not None
    assert spec.loader is not None
    tool = importlib.util.module_from_spec(spec)
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    spec.loader.exec_module(tool)
    tool.draw().save(tmp_path / "methods.png")
    same_as_kept("methods.png", tmp_path / "methods.png", width=1200, fonts=False)


def test_every_picture_of_the_readme_is_made_by_a_test() -> None:
    shown = {p.split(")")[0] for p in (ROOT / "README.md").read_text(encoding="utf-8").split("(docs/images/")[1:]}
    tests = "".join(path.read_text(encoding="utf-8") for path in Path(__file__).parent.glob("test_*.py"))
    assert shown
    assert {name for name in shown if f'same_as_kept("{name}"' not in tests} == set()
    documents = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").glob("*.md"))
    in_documents = {part.split(")")[0] for part in documents.split("(images/")[1:]}
    assert {path.name for path in IMAGES.iterdir()} == shown | in_documents
