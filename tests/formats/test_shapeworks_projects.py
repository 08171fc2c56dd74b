"""ShapeWorks projects as its Studio and its Excel writer lay them out, made here by hand."""

import io
import json
import re
import time
import zipfile
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
import pytest
from scipy.interpolate import RBFInterpolator

from shapespace.errors import InputError, ModelFileError, ShapespaceError
from shapespace.formats.shapeworks import NEIGHBOURS, interpolate_displacements, read_shapeworks, write_shapeworks
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob, sphere

TURN = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
SUBJECTS = 6
PARTICLES = 90


def shape(d: FloatArray, number: int) -> FloatArray:
    return blob(d, np.random.default_rng(number).normal(size=5))


def project(folder: Path, *, meshes: bool = True, kinds: tuple[str, ...] = ("local", "world")) -> list[dict[str, str]]:
    """Write particles in the mesh's frame and in the aligned one, and return the rows of the project."""
    (folder / "groomed").mkdir(parents=True)
    (folder / "p_particles").mkdir()
    spots, mesh = sphere(PARTICLES, 0.3), sphere(700)
    rows: list[dict[str, str]] = []
    for number in range(SUBJECTS):
        world = shape(spots[0], number)
        local = world @ TURN + (100 + number, 0, 5)
        row = {"name": f"sub {number}", "shape_1": f"../raw/{number}.nrrd"}
        if meshes:
            row["groomed_1"] = f"groomed/{number}.ply"
            write_mesh(folder / row["groomed_1"], Mesh(shape(mesh[0], number) @ TURN + (100 + number, 0, 5), mesh[1]))
        for kind, points in (("local", local), ("world", world)):
            if kind in kinds:
                row[f"{kind}_particles_1"] = f"p_particles/{number}_{kind}.particles"
                np.savetxt(folder / row[f"{kind}_particles_1"], points, "%.8f")
        row["alignment_1"] = row["procrustes_1"] = " ".join(map(str, np.eye(4).ravel()))
        row["age"] = str(number)
        rows.append(row)
    return rows


def swproj(folder: Path, rows: list[dict[str, str]]) -> Path:
    path = folder / "p.swproj"
    tree = {"data": rows, "groom": {}, "optimize": {"number_of_particles": "90"}, "landmarks": []}
    path.write_text(json.dumps(tree, indent=4))
    return path


def xlsx(folder: Path, rows: list[dict[str, str]]) -> Path:
    """A workbook as libxlnt writes it: shared strings, several sheets, the data one not the first."""
    heads = list(rows[0])
    strings = [*heads, *(value for row in rows for value in row.values())]
    cells = [heads, *(list(row.values()) for row in rows)]
    sheet = "".join(
        f'<row r="{r}">'
        + "".join(
            f'<c r="{chr(65 + c)}{r}" t="s"><v>{strings.index(text)}</v></c>'
            if c
            else f'<c r="A{r}" t="inlineStr"><is><t>{escape(text)}</t></is></c>'
            for c, text in enumerate(row)
        )
        + "</row>"
        for r, row in enumerate(cells, 1)
    )
    main = 'xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"'
    relations = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
    files = {
        "xl/workbook.xml": f'<workbook {main} xmlns:r="{relations}"><sheets>'
        '<sheet name="optimize" sheetId="1" r:id="rId1"/><sheet name="data" sheetId="2" r:id="rId2"/>'
        "</sheets></workbook>",
        "xl/_rels/workbook.xml.rels": "<Relationships>"
        '<Relationship Id="rId1" Target="worksheets/sheet1.xml"/>'
        '<Relationship Id="rId2" Target="/xl/worksheets/sheet2.xml"/></Relationships>',
        "xl/sharedStrings.xml": f"<sst {main}>" + "".join(f"<si><t>{escape(s)}</t></si>" for s in strings) + "</sst>",
        "xl/worksheets/sheet1.xml": f"<worksheet {main}><sheetData/></worksheet>",
        "xl/worksheets/sheet2.xml": f"<worksheet {main}><sheetData>{sheet}</sheetData></worksheet>",
    }
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, '<?xml version="1.0"?>' + text)
    path = folder / "p.xlsx"
    path.write_bytes(out.getvalue())
    return path


def covariance(moved: FloatArray) -> FloatArray:
    return moved @ moved.T


@pytest.mark.parametrize("kind", [swproj, xlsx])
def test_particles_are_a_point_model_with_the_covariance_of_the_subjects(kind, tmp_path: Path) -> None:  # pyright: ignore
    path = kind(tmp_path, project(tmp_path, meshes=False))
    found = read_shapeworks(path)
    data = np.stack([shape(sphere(PARTICLES, 0.3)[0], number).ravel() for number in range(SUBJECTS)])
    assert np.allclose(found.mean.ravel(), data.mean(axis=0), atol=1e-7)
    assert np.allclose(covariance(found.shape.moved), np.cov(data.T), atol=1e-5)
    assert found.faces is None and found.n_training == SUBJECTS and found.shape.moved.shape[1] == SUBJECTS - 1
    assert any("point model of 90 particles" in note for note in found.notes)
    assert ShapeModel.load(path).n_modes == 5


def test_the_mesh_of_the_most_average_subject_is_carried_by_the_particles(tmp_path: Path) -> None:
    path = swproj(tmp_path, project(tmp_path))
    found = read_shapeworks(path)
    d, faces = sphere(700)
    assert np.array_equal(np.asarray(found.faces), faces)
    truth = np.stack([shape(d, number) for number in range(SUBJECTS)])
    # 90 particles lie about 20 mm apart, and the nose is narrower.
    assert np.sqrt(((found.mean - truth.mean(axis=0)) ** 2).sum(axis=1).mean()) < 0.5
    spread = np.sqrt((found.shape.moved**2).sum() / np.var(truth, axis=0, ddof=1).sum())
    assert abs(spread - 1) < 0.1
    nearest = ((truth - truth.mean(axis=0)) ** 2).sum(axis=(1, 2)).argmin()
    assert any(f"mesh of sub {nearest}, the most average" in note for note in found.notes)


def test_local_splines_are_those_of_scipy_and_near_the_dense_one() -> None:
    particles, others = (shape(sphere(700, 0.3)[0], number) for number in (0, 1))
    points, truth = (shape(sphere(500)[0], number) for number in (0, 1))
    steps = others - particles
    found = interpolate_displacements(particles, steps, points, most_dense=0)
    design, at = (np.column_stack([np.ones(len(x)), x]) for x in (particles, points))
    affine = np.linalg.lstsq(design, steps, rcond=None)[0]
    local = RBFInterpolator(particles, steps - design @ affine, kernel="linear", degree=0, neighbors=NEIGHBOURS)
    assert np.allclose(found, local(points) + at @ affine, atol=1e-9)
    dense = interpolate_displacements(particles, steps, points)
    apart, signal, error = (np.sqrt((d**2).mean()) for d in (found - dense, dense, dense - (truth - points)))
    assert apart < 1e-3 * signal and apart < 0.5 * error


def test_many_particles_carry_a_mesh_soon(tmp_path: Path) -> None:
    spots, mesh = sphere(8_000, 0.3)[0], sphere(300)
    rows: list[dict[str, str]] = []
    for number in range(3):
        np.savetxt(tmp_path / f"{number}.particles", shape(spots, number), "%.6f")
        write_mesh(tmp_path / f"{number}.ply", Mesh(shape(mesh[0], number), mesh[1]))
        rows.append({"world_particles_1": f"{number}.particles", "groomed_1": f"{number}.ply"})
    path = swproj(tmp_path, rows)
    start = time.process_time()
    found = read_shapeworks(path)
    # One dense spline takes 512 MB for its matrix alone, and some 15 s.
    assert time.process_time() - start < 4.0
    truth = np.mean([shape(mesh[0], number) for number in range(3)], axis=0)
    assert np.abs(found.mean - truth).max() < 0.05


def test_particles_in_a_plane_are_a_point_model(tmp_path: Path) -> None:
    spots = np.column_stack([np.random.default_rng(0).random((40, 2)) * 50, np.zeros(40)])
    square = Mesh(np.array([[0.0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    rows: list[dict[str, str]] = []
    for number in range(3):
        np.savetxt(tmp_path / f"{number}.particles", spots * (1 + 0.01 * number), "%.6f")
        write_mesh(tmp_path / f"{number}.ply", square)
        rows.append({"world_particles_1": f"{number}.particles", "groomed_1": f"{number}.ply"})
    found = read_shapeworks(swproj(tmp_path, rows))
    assert found.faces is None and any("lie in a plane" in note for note in found.notes)


def test_particles_that_are_the_vertices_need_no_splines(tmp_path: Path) -> None:
    rows = project(tmp_path)
    d, faces = sphere(PARTICLES, 0.3)
    for number, row in enumerate(rows):
        write_mesh(tmp_path / row["groomed_1"], Mesh(shape(d, number) @ TURN + (100 + number, 0, 5), faces))
    found = read_shapeworks(swproj(tmp_path, rows))
    data = np.stack([shape(d, number) for number in range(SUBJECTS)])
    assert np.allclose(found.mean, data.mean(axis=0), atol=1e-7) and np.array_equal(np.asarray(found.faces), faces)


def test_local_particles_alone_are_aligned(tmp_path: Path) -> None:
    found = read_shapeworks(swproj(tmp_path, project(tmp_path, meshes=False, kinds=("local",))))
    world = np.stack([shape(sphere(PARTICLES, 0.3)[0], number) for number in range(SUBJECTS)])
    assert any("aligned rigidly" in note for note in found.notes)
    assert (found.shape.moved**2).sum() < 1.01 * np.var(world, axis=0, ddof=1).sum()


def test_domains_vary_together(tmp_path: Path) -> None:
    rows = project(tmp_path, meshes=False)
    for row in rows:
        row["world_particles_left"] = row["world_particles_1"]
    found = read_shapeworks(swproj(tmp_path, rows))
    assert len(found.mean) == 2 * PARTICLES and any("2 domains" in note for note in found.notes)
    assert found.parts == {"1": PARTICLES, "left": PARTICLES}


def test_a_mesh_that_lies_elsewhere_is_not_taken_for_the_surface(tmp_path: Path) -> None:
    rows = project(tmp_path)
    for row in rows:
        row["groomed_1"] = "groomed/0.ply"
        row["local_particles_1"] = row["world_particles_1"]
    found = read_shapeworks(swproj(tmp_path, rows))
    assert found.faces is None and any("does not match its particles" in note for note in found.notes)


def test_written_shapes_have_the_mean_and_covariance_and_are_near(tmp_path: Path) -> None:
    model = read_shapeworks(swproj(tmp_path / "a", project(tmp_path / "a", meshes=False)))
    said = write_shapeworks(model, tmp_path / "b.swproj")
    assert "they are no subjects" in said[0]
    tree = json.loads((tmp_path / "b.swproj").read_text())
    assert all(isinstance(value, str) for row in tree["data"] for value in row.values())  # as ShapeWorks demands
    data = np.stack([np.loadtxt(tmp_path / row["world_particles_1"]).ravel() for row in tree["data"]])
    assert len(data) == SUBJECTS and np.allclose(data.mean(axis=0), model.mean.ravel(), atol=1e-9)
    assert np.allclose(np.cov(data.T), covariance(model.shape.moved), atol=1e-8)
    z = np.linalg.lstsq(model.shape.moved, (data - model.mean.ravel()).T, rcond=None)[0]
    assert np.abs(z).max() < 1.42
    with pytest.raises(InputError, match=r"ends in \.swproj"):
        write_shapeworks(model, tmp_path / "b.xlsx")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("missing", "does not exist"), ("long", "invalid name|does not exist"), ("zero", "invalid name|does not exist"),
        ("outside", "outside its folder"), ("text", "no number|text where"),
        ("cut", "different numbers of particles"), ("none", "contains no paths of particles"), ("one", "of 1 subjects"),
        ("ragged", "rows of three"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_sentence(change: str, said: str, tmp_path: Path) -> None:
    rows = project(tmp_path, meshes=False)
    first = tmp_path / rows[0]["world_particles_1"]
    if change == "missing":
        first.unlink()
    elif change in ("long", "zero"):
        rows[0]["world_particles_1"] = "a" * 5000 if change == "long" else "a\0b"
    elif change == "outside":
        rows[0]["world_particles_1"] = "../../etc/passwd"
    elif change == "text":
        first.write_text("a b c\n")
    elif change == "cut":
        first.write_bytes(b"\n".join(first.read_bytes().splitlines()[:40]))
    elif change == "ragged":
        first.write_bytes(first.read_bytes().rsplit(b" ", 1)[0])
    elif change == "one":
        rows = rows[:1]
    else:
        rows = [{"name": "a", "shape_1": "b.ply"}]
    with pytest.raises(ShapespaceError, match=said) as refused:
        read_shapeworks(swproj(tmp_path, rows))
    assert str(refused.value).endswith(".") and "\n" not in str(refused.value)


def test_a_project_that_names_one_file_many_times_is_refused_before_it_fills_the_memory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("shapespace.io.read_limits.SPARE_BYTES", 2**20)
    np.savetxt(tmp_path / "big.particles", np.zeros((10_000, 3)), "%d")
    rows = [{"world_particles_1": "big.particles"}] * 4_000
    with pytest.raises(ShapespaceError, match="expand to more than"):
        read_shapeworks(swproj(tmp_path, rows))


def test_a_shared_string_of_five_thousand_digits_is_a_damaged_workbook(tmp_path: Path) -> None:
    path = xlsx(tmp_path, project(tmp_path, meshes=False))
    with zipfile.ZipFile(path) as archive:
        parts = {name: archive.read(name) for name in archive.namelist()}
    sheet = max((name for name in parts if "worksheets/" in name), key=lambda name: len(parts[name]))
    parts[sheet] = re.sub(rb"<v>[0-9]+</v>", b"<v>" + b"9" * 5000 + b"</v>", parts[sheet])
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in parts.items():
            archive.writestr(name, content)
    with pytest.raises(ModelFileError, match=r"there is no shared string '9+'.*not a project of ShapeWorks"):
        read_shapeworks(path)


def test_a_workbook_without_data_is_no_project(tmp_path: Path) -> None:
    path = xlsx(tmp_path, project(tmp_path, meshes=False))
    good = path.read_bytes()
    path.write_bytes(good[: len(good) // 2])
    with pytest.raises(ModelFileError, match="cut short"):
        read_shapeworks(path)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    with pytest.raises(ModelFileError, match="no sheet called data"):
        read_shapeworks(path)
