"""What is released: versions that agree, bounds that are those tried, extras for users alone."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

import shapespace as ss

ROOT = Path(__file__).resolve().parents[2]
PROJECT: dict[str, Any] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
EXTRAS: dict[str, list[str]] = PROJECT["project"]["optional-dependencies"]
GROUPS: dict[str, list[Any]] = PROJECT["dependency-groups"]


def pinned(name: str) -> dict[str, str]:
    lines = (ROOT / "constraints" / f"{name}.txt").read_text("utf-8").splitlines()
    return dict(line.split("==") for line in lines if not line.startswith("#"))


def bounds() -> dict[str, str]:
    """Return the oldest version that is allowed of each package that runs or tests need."""
    needed = [*PROJECT["project"]["dependencies"], *GROUPS["test"]]
    needed += [one for name, extra in EXTRAS.items() if name != "all" for one in extra]
    found = [re.fullmatch(r"([\w.-]+)(?:\[\w+\])?>=([\d.]+)", one) for one in needed]
    return {match[1]: match[2] for match in found if match}


def number(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in re.findall(r"\d+", version)[:3])


def test_the_oldest_versions_that_are_tried_are_those_that_are_allowed() -> None:
    assert pinned("oldest") == bounds()


def test_the_newest_versions_that_are_tried_are_of_the_same_packages_and_newer() -> None:
    oldest, newest = pinned("oldest"), pinned("newest")
    assert oldest.keys() <= newest.keys()
    assert all(number(newest[name]) >= number(version) for name, version in oldest.items())


def test_the_extra_for_users_is_all_others_and_holds_no_tools_of_developers() -> None:
    [everything] = EXTRAS["all"]
    asked = set(re.fullmatch(r"shapespace\[(.*)\]", everything)[1].split(","))  # type: ignore[index]
    assert asked == EXTRAS.keys() - {"all"}
    tools = {re.split(r"[\[<>=~]", one)[0] for group in ("test", "lint") for one in GROUPS[group]}
    of_users = {re.split(r"[\[<>=~]", one)[0] for extra in asked for one in EXTRAS[extra]}
    assert not tools & of_users


def test_what_tests_need_brings_no_node_of_pyright() -> None:
    assert not any(one.startswith("pyright") for one in GROUPS["test"])
    makefile = (ROOT / "Makefile").read_text("utf-8")
    assert "\ntest: $(READY)\n" in makefile and "\ntypes: $(READY_TO_LINT)\n" in makefile


def test_one_version_stands_in_every_file_of_a_release() -> None:
    version = re.escape(ss.__version__)
    assert PROJECT["project"]["version"] == ss.__version__
    assert json.loads((ROOT / ".zenodo.json").read_text("utf-8"))["version"] == ss.__version__
    assert re.search(rf"^version: {version}$", (ROOT / "CITATION.cff").read_text("utf-8"), re.M)
    assert re.search(rf'^  version: "{version}"$', (ROOT / "conda" / "recipe.yaml").read_text("utf-8"), re.M)


def test_the_conda_recipe_needs_what_the_wheel_needs() -> None:
    wanted = {re.sub(r"^libigl\b", "igl", one) for one in PROJECT["project"]["dependencies"]}
    recipe = (ROOT / "conda" / "recipe.yaml").read_text("utf-8").partition("  run:\n")[2].partition("\ntests:")[0]
    found = {line.removeprefix("    - ").replace(" ", "") for line in recipe.splitlines()}
    assert found == wanted | {f"python{PROJECT['project']['requires-python']}"}


@pytest.mark.parametrize("file", sorted((ROOT / ".github").rglob("*.yml")), ids=lambda file: file.name)
def test_the_forge_s_files_are_yaml_and_run_what_there_is(file: Path) -> None:
    yaml = pytest.importorskip("yaml")
    content = yaml.safe_load(file.read_text("utf-8"))
    assert content
    for path in re.findall(r"\b(?:tests|tools)/[\w/.]+", file.read_text("utf-8")):
        assert (ROOT / path).exists(), path
