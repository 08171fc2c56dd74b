"""`__all__` is a promise: what changes in it is named in the changelog."""

import re
import runpy
from pathlib import Path
from types import ModuleType

import pytest

import shapespace as ss

ROOT = Path(__file__).resolve().parents[2]
API = runpy.run_path(str(ROOT / "tools" / "public_api.py"))
PACKAGES = [ss, *(getattr(ss, name) for name in ss._PACKAGES)]  # pyright: ignore[reportPrivateUsage]
CHANGELOG = (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_a_change_of_a_public_signature_is_named_in_the_changelog() -> None:
    released = API["RELEASED"].read_text("utf-8").splitlines()
    unnamed = API["unnamed"](released, API["lines"](), CHANGELOG)
    assert not unnamed, f"name these in CHANGELOG.md, below Unreleased: {', '.join(unnamed)}"


def test_the_check_finds_what_is_new_gone_and_different_and_is_content_with_names() -> None:
    released = ["Model(a)", "Model.load(path)", "Gone(x)", "Gone.member()", "fit(a)"]
    now = ["Model(a)", "Model.load(path, strict=True)", "New()", "New.member()", "fit(a)"]
    said = "# Changelog\n\n## Unreleased\n\n- {}\n\n## 1.0.0\n\n- Model.load, Gone, New\n"
    assert API["unnamed"](released, now, said.format("nothing")) == ["Gone", "Model.load", "New"]
    assert (
        API["unnamed"](released, now, said.format("`Model.load(strict=...)`, `Gone` went, `New`; `Model.loader`")) == []
    )
    assert API["unnamed"](released, now, said.format("`Model.loader`, Goner, News")) == ["Gone", "Model.load", "New"]
    assert API["unnamed"](now, now, said.format("nothing")) == []


def test_the_snapshot_sees_constructors_methods_properties_and_tables() -> None:
    lines = "\n".join(API["lines"]())
    for part in (
        r"^fit_scan\(model: ", r"^Mesh\(vertices: ", r"^FitResult\.save\(self, folder",
        r"^FitResult\.overlap_distances -> ",
        r"^ShapeModel\.load\(cls, path", r"^CLASSIFIERS knn, ", r"^ShapeSpace\.transform\(self, X",
    ):  # fmt: skip
        assert re.search(part, lines, re.MULTILINE), part
    assert " at 0x" not in lines and "._" not in lines.replace("...", "")


def test_every_public_name_has_a_docstring_and_a_line_in_the_reference() -> None:
    named = set(re.findall(r"^- `(\w+)`", (ROOT / "docs" / "api.md").read_text("utf-8"), re.MULTILINE))
    assert set(API["names"]()) - {"__version__"} <= named
    for name, of in API["names"]().items():
        assert not (callable(of) and not (of.__doc__ or "").strip()), name


@pytest.mark.parametrize("package", PACKAGES, ids=lambda package: package.__name__)
def test_every_name_of_a_package_is_there_and_listed_once(package: ModuleType) -> None:
    assert len(package.__all__) == len(set(package.__all__))
    assert set(package.__all__) <= set(dir(package))
    for name in package.__all__:
        assert not isinstance(getattr(package, name), ModuleType), name
    with pytest.raises(AttributeError, match="nonsense"):
        _ = package.nonsense


def test_the_top_level_has_the_main_path_alone() -> None:
    assert len(ss.__all__) <= 25
