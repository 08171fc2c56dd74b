"""Steps that fit together, tables and first lines, as reports of users had them, from the command line."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest

import shapespace as ss
from shapespace.io.meshes.mesh_io import write_mesh
from synthetic_shapes import training_meshes

Run = Callable[..., str]
COUNT = 20


@pytest.fixture(scope="module")
def shapes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twenty surfaces in correspondence; every second one has its triangles in another order and orientation."""
    folder = tmp_path_factory.mktemp("same")
    for k, mesh in enumerate(training_meshes(COUNT, 200)):
        assert mesh.faces is not None
        faces = mesh.faces if k % 2 else np.roll(mesh.faces[::-1, ::-1], k % 3, axis=1)
        write_mesh(folder / f"s{k:02d}.ply", ss.Mesh(mesh.vertices, faces))
    return folder


def table(path: Path, columns: Mapping[str, Sequence[object]], order: Sequence[int] = range(COUNT)) -> Path:
    """Write a table of the shapes with these columns, its rows in `order`."""
    lines = [",".join(["file", *columns])]
    lines += [",".join([f"s{k:02d}", *(str(column[k]) for column in columns.values())]) for k in order]
    path.write_text("\n".join([*lines, ""]))
    return path


SEX, AGE = ["f", "m"] * (COUNT // 2), [20 + 3 * k % 41 for k in range(COUNT)]


def rows(folder: Path) -> str:
    """Return the table of terms, with F and p in all digits."""
    return (folder / "terms.csv").read_text()


def test_p_does_not_depend_on_the_order_of_rows_and_triangles(shapes: Path, run: Run, tmp_path: Path) -> None:
    found: list[str] = []
    for name, order in (("a", range(COUNT)), ("b", [*range(7, COUNT), *range(7)])):
        path = table(tmp_path / f"{name}.csv", {"sex": SEX, "age": AGE}, order)
        run("compare", path, "~ sex", "--shapes", shapes, "-o", tmp_path / name, "--permutations", 99)
        found.append(rows(tmp_path / name))
    assert found[0] == found[1]


@pytest.mark.parametrize("twice", ["s03", "S03", "s03.ply"])
def test_two_rows_of_one_specimen_are_refused(twice: str, shapes: Path, run: Run, tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", {"sex": SEX})
    path.write_text(f"{path.read_text()}{twice},m\n")
    told = run("compare", path, "~ sex", "--shapes", shapes, "-o", tmp_path / "out", code=2)
    assert f"'s03') and 21 ('{twice}') are of one specimen" in told


def test_rows_and_specimens_without_the_other_are_counted(shapes: Path, run: Run, tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", {"sex": SEX}, range(2, COUNT))
    path.write_text(f"{path.read_text()}stranger,m\n")
    told = run("compare", path, "~ sex", "--shapes", shapes, "-o", tmp_path / "out", "--permutations", 20)
    assert "1 of 19 rows" in told and "stranger" in told and "2 of 20 specimens" in told and "s00, s01" in told


def test_codes_used_as_numbers_and_columns_with_signs(shapes: Path, run: Run, tmp_path: Path) -> None:
    path = table(tmp_path / "a.csv", {"Group #": SEX, "family": [13 + k % 4 for k in range(COUNT)]})
    told = run(
        "compare",
        path,
        "~ `Group #` + family",
        "--shapes",
        shapes,
        "-o",
        tmp_path / "out",
        "--permutations",
        20,
    )
    lines = [line for line in told.splitlines() if line]
    assert any("write C(family), with 3." in line for line in lines[:3]), told
    assert "`Group #` with its backticks" in run(
        "compare", path, "~ Group #", "--shapes", shapes, "-o", tmp_path / "out", code=2
    )


@pytest.mark.parametrize("formula", ["~ C(family)", "~ log(age)", "~ poly(age, 2)", "~ sex * age"])
def test_every_formula_counts_missing_cells(formula: str, shapes: Path, run: Run, tmp_path: Path) -> None:
    columns = {"sex": SEX, "age": AGE, "family": [13 + k % 2 for k in range(COUNT)]}
    lacking = {name: ["NA" if k == 4 else cell for k, cell in enumerate(cells)] for name, cells in columns.items()}
    options = (table(tmp_path / "a.csv", lacking), formula, "--shapes", shapes, "-o", tmp_path / "out")
    told = run("compare", *options, code=2)
    assert "s04" in told and "missing=drop" in told
    if formula == "~ sex * age":
        assert "19 shapes" in run("compare", *options, "--permutations", 20, "--set", "missing=drop")


def test_surfaces_of_check_and_others_are_one_cohort(shapes: Path, run: Run, tmp_path: Path) -> None:
    mirrored = tmp_path / "right"
    mirrored.mkdir()
    same = tmp_path / "same"
    same.mkdir()
    for k, path in enumerate(sorted(shapes.glob("*.ply"))):
        mesh = ss.read_mesh(path)
        sign = np.array([-1.0 if k % 2 else 1.0, 1.0, 1.0])
        write_mesh((mirrored if k % 2 else same) / path.name, mesh.with_vertices(mesh.vertices * sign))
    run("check", mirrored, "-o", same, "--mirror")
    path = table(tmp_path / "a.csv", {"sex": SEX})
    run("compare", path, "~ sex", "--shapes", same, "-o", tmp_path / "out", "--permutations", 20)
    run("compare", path, "~ sex", "--shapes", shapes, "-o", tmp_path / "known", "--permutations", 20)
    assert rows(tmp_path / "out") == rows(tmp_path / "known")
