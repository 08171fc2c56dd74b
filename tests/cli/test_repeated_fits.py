"""A folder of fits contains the list of its scans, and its report quotes a command that fits these and no others."""

import re
import shlex
import shutil
from pathlib import Path

import pytest

from conftest import Run, World
from shapespace.io.landmarks.landmark_io import write_landmarks
from shapespace.io.tables.table_io import table_rows
from shapespace.model.shape_model import ShapeModel
from shapespace.report.inputs.saved_fits import command_with_stages
from shapespace.schemas import FitRecord
from shapespace.store.results import Results

QUICK = ("--set", "max_iterations=6", "--unit", "mm")


@pytest.fixture
def scans(world: World, tmp_path: Path) -> Path:
    """A folder with a space in its name, four scans of which two are fitted, and a list of scans elsewhere."""
    folder = tmp_path / "my scans"
    folder.mkdir()
    for name, source in zip(("a 1", "a 2", "b", "it's"), (*world.scans, world.scans[0]), strict=True):
        shutil.copy(source, folder / f"{name}.ply")
    shutil.copy(world.model, tmp_path / "model.h5")
    return folder


def quoted_command(out: Path) -> list[str]:
    """Return the words of the command that the report of a folder quotes."""
    results = Results(out)
    return shlex.split(command_with_stages(out, {name: results.fit(name) for name in results.names()}))


def fitted(out: Path) -> dict[str, str]:
    """Return NAME -> identity of each fit in a folder."""
    records = {file.name.removesuffix(".fit.json"): file.read_text() for file in sorted(out.glob("*.fit.json"))}
    return {name: re.findall(r'"id": ?"(\w+)"', text)[0] for name, text in records.items()}


@pytest.mark.parametrize(
    ("given", "names"),
    [
        (["my scans/a*.ply"], ["a 1", "a 2"]),
        (["my scans/a 2.ply"], ["a 2"]),
        (["my scans/it's.ply", "my scans/b.ply"], ["b", "it's"]),
        (["list.csv"], ["first", "second"]),
        (["list.txt"], ["a 1", "b"]),
    ],
    ids=["pattern", "scan", "files", "table", "list"],
)
def test_the_quoted_command_fits_the_shown_scans_and_no_others(
    run: Run, scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: list[str], names: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("list.csv").write_text("id,file,sex\nfirst,my scans/a 1.ply,f\nsecond,my scans/it's.ply,m\n")
    Path("list.txt").write_text("my scans/a 1.ply\nmy scans/b.ply\n")
    assert run("fit", "model.h5", *given, "-o", "out", *QUICK, "--set", "seed=3", "--quiet").code == 0
    before = fitted(tmp_path / "out")
    assert sorted(before) == names
    monkeypatch.chdir(tmp_path / "out")
    words = quoted_command(tmp_path / "out")
    assert words[:3] == ["shapespace", "fit", "../model.h5"] and "--stages" in words
    shutil.copytree(tmp_path / "out", tmp_path / "again")
    for file in (tmp_path / "again").glob("*.fi*"):
        file.unlink()
    monkeypatch.chdir(tmp_path / "again")
    assert run(*words[1:], "--quiet").code == 0
    assert fitted(tmp_path / "again") == before  # the same scans, names and settings
    assert sorted(file.name for file in Path().glob("*.stages.npz")) == [f"{name}.stages.npz" for name in names]


def test_landmarks_of_the_fits_are_quoted_and_listed(
    run: Run, world: World, scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    model = ShapeModel.load(world.model)
    Path("marks").mkdir()
    for name in ("a 1", "b"):
        write_landmarks(Path(f"marks/{name}.csv"), model.landmarks.positions(model.mean_vertices))
    chosen = ["my scans/a 1.ply", "my scans/b.ply"]
    run("fit", "model.h5", *chosen, "-o", "two", "--landmarks", "marks", *QUICK, "--quiet")
    header, *rows = table_rows(Path("two", FitRecord.LIST).read_bytes())
    assert header == ["id", "scan", "landmarks"]
    assert rows == [[name, f"../my scans/{name}.ply", f"../marks/{name}.csv"] for name in ("a 1", "b")]
    run("fit", "model.h5", chosen[0], "-o", "one", "--landmarks", "marks/a 1.csv", *QUICK, "--quiet")
    assert quoted_command(tmp_path / "one")[3] == FitRecord.LIST


def test_the_list_follows_later_runs_and_without_it_scans_are_named(
    run: Run, scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    chosen = [f"my scans/{scan}.ply" for scan in ("a 1", "b", "it's")]
    assert run("fit", "model.h5", *chosen, "-o", "out", *QUICK, "--quiet").code == 0
    for file in Path("out").glob("b.*"):
        file.unlink()
    assert run("fit", "model.h5", "my scans/a 2.ply", "-o", "out", *QUICK, "--quiet").code == 0
    listed = [row[0] for row in table_rows(Path("out", FitRecord.LIST).read_bytes())][1:]
    assert listed == ["a 1", "it's", "a 2"]
    assert FitRecord.LIST in quoted_command(tmp_path / "out")
    for change in ("id,scan\na 1,../my scans/a 1.ply\n", "nothing\n"):
        Path("out", FitRecord.LIST).write_text(change)
        words = quoted_command(tmp_path / "out")
        assert sorted(word for word in words if word.endswith(".ply")) == [
            f"../my scans/{name}.ply" for name in ("a 1", "a 2", "it's")
        ]


def test_a_store_has_the_list_of_its_scans(
    run: Run, scans: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("pyarrow", reason="the extra `store` is not installed")
    monkeypatch.chdir(tmp_path)
    for chosen in (["my scans/a 1.ply", "my scans/b.ply"], ["my scans/b.ply"]):
        assert run("fit", "model.h5", *chosen, "-o", "out", *QUICK, "--store", "--quiet").code == 0
    listed = [row[0] for row in table_rows(Path("out", FitRecord.LIST).read_bytes())][1:]
    assert listed == ["a 1", "b"]
    assert FitRecord.LIST in quoted_command(tmp_path / "out")
