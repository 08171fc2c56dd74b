"""Scans and templates as people have them: points, other windings, pieces, fins, copies, other units, other objects."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import Delaunay

import shapespace as ss
from raw_blobs import ANY_POSE, dispersion_mm, raw_blob, without_ball
from shapespace.cli import main
from shapespace.correspondence.correspondence_result import Correspondence, copies, unit_ratios
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.correspondence.template import choose_template, clean_scan, resample
from shapespace.errors import InputError, MeshError
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import faces_of
from shapespace.geometry.remesh import is_sheet
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import sphere

QUICK = ElasticSettings(harmonics=150, points=1000)
ONE_ROUND = CorrespondConfig(vertices=500, rounds=1, mirror="never", first=QUICK, next=QUICK)
BLOBS = [raw_blob(k, points=1200) for k in range(4)]
SCANS = [one.scan for one in BLOBS]
IN_ANY_POSE = [raw_blob(k, degrees=ANY_POSE, points=1200) for k in range(4)]


def scans_with(other: Mesh) -> list[Mesh]:
    return [*SCANS[:3], Mesh(other.vertices, other.faces, name="odd")]


def placed(made: Correspondence) -> list[FloatArray]:
    return [np.array(scan.vertices) for scan in made.scans]


@pytest.fixture(scope="module")
def plain() -> list[FloatArray]:
    return placed(ss.correspond(SCANS, ONE_ROUND, template=SCANS[0]))


def test_points_without_triangles_are_put_where_their_meshes_are() -> None:
    scans = [one.scan for one in IN_ANY_POSE]
    meshes = placed(ss.correspond(scans, ONE_ROUND, template=scans[0]))
    clouds = [Mesh(scan.vertices, None, name=scan.name) for scan in scans]
    made = ss.correspond(clouds, ONE_ROUND, template=scans[0])
    for mesh, cloud in zip(meshes, placed(made), strict=True):
        assert np.nanmean(np.linalg.norm(cloud - mesh, axis=1)) < 1.0
    assert dispersion_mm(IN_ANY_POSE, placed(made)) < 1.1 * dispersion_mm(IN_ANY_POSE, meshes)


def test_a_whole_object_of_another_kind_is_no_template_of_open_scans(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shapespace.correspondence.template.MODES", 15)
    cut = [one.scan for one in IN_ANY_POSE[:3]]
    scans = [without_ball(scan, scan.vertices[np.argmax(scan.vertices[:, 0])], 45.0) for scan in cut]
    directions, faces = sphere(700)
    choice = choose_template([Mesh(1e3 * directions, faces, name="ball"), *scans], 0)
    assert choice.index != 0 and np.nanargmax(choice.nearness) == 0


def turned(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices, faces_of(mesh)[:, ::-1].copy(), name=mesh.name)


def test_a_closed_scan_whose_normals_look_inward_is_put_as_the_other_is(plain: list[FloatArray]) -> None:
    made = ss.correspond([*SCANS[:3], turned(SCANS[3])], ONE_ROUND, template=SCANS[0])
    np.testing.assert_allclose(placed(made)[3], plain[3], atol=1e-6)


def sheet(k: int) -> tuple[Mesh, FloatArray]:
    """Return a sheet as much bowl as cap, and where on the plane each of its vertices lies."""
    rng = np.random.default_rng([9, k])
    uv = rng.uniform(-1, 1, (900, 2)) * [1.3, 0.9]
    a = 1 + 0.15 * rng.standard_normal(4)
    u, v = uv.T
    height = (
        0.45 * a[0] * np.sin(np.pi * u / 1.3) + 0.1 * a[3] * v**3
        + 0.25 * a[1] * np.exp(-((u - 0.5) ** 2 + (v - 0.3) ** 2) / 0.03)
        - 0.25 * a[2] * np.exp(-((u + 0.3) ** 2 + (v + 0.4) ** 2) / 0.05)
    )  # fmt: skip
    x, faces = 100 * np.column_stack([uv, height]), Delaunay(uv).simplices.astype(np.int32)
    down = np.cross(x[faces[:, 1]] - x[faces[:, 0]], x[faces[:, 2]] - x[faces[:, 0]])[:, 2] < 0
    faces[down] = faces[down][:, ::-1]
    return Mesh(x, faces, name=f"sheet{k}"), uv


def test_a_sheet_that_is_no_more_cap_than_bowl_is_put_alike_whichever_way_it_looks() -> None:
    template, (scan, _) = sheet(0)[0], sheet(1)
    both = [ss.correspond([one, sheet(2)[0]], ONE_ROUND, template=template) for one in (scan, turned(scan))]
    np.testing.assert_allclose(placed(both[1])[0], placed(both[0])[0], atol=1e-6)


def finned(mesh: Mesh) -> Mesh:
    """Return `mesh` with fins, so that edges have three triangles."""
    faces = faces_of(mesh)
    roots = faces[::40]
    tips = mesh.vertices[roots[:, 0]] + np.array([3.0, 1.0, 2.0])
    fins = np.column_stack([roots[:, 0], roots[:, 1], len(mesh.vertices) + np.arange(len(roots))])
    return Mesh(np.vstack([mesh.vertices, tips]), np.vstack([faces, fins]).astype(np.int32), name=mesh.name)


def touching(mesh: Mesh) -> Mesh:
    """Return `mesh` with holes in pairs that meet at a vertex."""
    faces = faces_of(mesh)
    at = faces[len(faces) // 2, 0]
    around = np.flatnonzero((faces == at).any(axis=1))
    opposite = [around[0], next(f for f in around[1:] if len(set(faces[f]) & set(faces[around[0]])) == 1)]
    return Mesh(mesh.vertices, np.delete(faces, opposite, axis=0), name=mesh.name)


@pytest.mark.parametrize("spoil", [finned, touching])
def test_a_scan_that_is_no_clean_sheet_can_be_the_template(spoil: Callable[[Mesh], Mesh]) -> None:
    template = resample(clean_scan(spoil(SCANS[0])), 500)
    assert is_sheet(faces_of(template)) and 450 < len(template.vertices) < 600
    made = ss.correspond([spoil(scan) for scan in SCANS[:3]], ONE_ROUND)
    assert all(not scan.reason and scan.covered > 0.95 for scan in made.scans)


def test_a_template_as_it_is_may_have_borders_that_touch() -> None:
    made = ss.correspond(SCANS[:2], ONE_ROUND, template=touching(SCANS[3]))
    assert all(not scan.reason and scan.seen > 0.99 for scan in made.scans)


def test_an_open_template_goes_on_closed_scans_and_a_closed_one_on_open_scans() -> None:
    def cut(mesh: Mesh) -> Mesh:
        return without_ball(mesh, mesh.vertices[np.argmax(mesh.vertices[:, 0])], 50.0)

    on_closed = ss.correspond(SCANS[:2], ONE_ROUND, template=cut(SCANS[3]))
    assert all(scan.seen > 0.97 for scan in on_closed.scans)
    opened = [cut(scan) for scan in SCANS[:2]]
    on_open = ss.correspond(opened, ONE_ROUND, template=SCANS[3])
    for scan, raw in zip(on_open.scans, opened, strict=True):
        assert scan.seen < 0.97
        assert scan.observed is not None
        shown = np.array(scan.observed, dtype=bool)
        assert build_engine(raw).query(np.array(scan.vertices)[shown]).distance.max() < 3.0


def test_a_template_of_another_size_and_unit_gives_the_same(plain: list[FloatArray]) -> None:
    small = SCANS[0].with_vertices(1e-3 * SCANS[0].vertices)
    made = placed(ss.correspond(SCANS, ONE_ROUND, template=small))
    assert max(np.nanmax(np.linalg.norm(a - b, axis=1)) for a, b in zip(made, plain, strict=True)) < 1e-3


def test_a_template_that_is_none_is_refused_in_a_sentence() -> None:
    few, faces = sphere(30)
    for template, said in (
        (
            Mesh(80 * few, faces, name="few"),
            "few has 30 vertices, and a template needs 100 at least; give a finer mesh",
        ),
        (Mesh(SCANS[0].vertices, None, name="points"), "points is a point cloud, and a template needs triangles"),
        (Mesh(SCANS[0].vertices, faces_of(SCANS[0])[:1], name="one"), "only one triangle"),
    ):
        with pytest.raises(MeshError, match=said):
            ss.correspond(SCANS, ONE_ROUND, template=template)


def test_points_alone_ask_for_a_template() -> None:
    with pytest.raises(MeshError, match="give --template MESH"):
        ss.correspond([Mesh(scan.vertices, None, name=scan.name) for scan in SCANS], ONE_ROUND)


def test_a_few_corners_are_no_first_template() -> None:
    corners, faces = sphere(4)
    made = ss.correspond(scans_with(Mesh(80 * corners, faces)), ONE_ROUND)
    assert not made.why.startswith("odd") and made.scans[3].reason
    assert [bool(scan.reason) for scan in made.scans] == [False, False, False, True]


def moved(mesh: Mesh, scale: float) -> Mesh:
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    return Mesh(scale * mesh.vertices @ turn.T + 7.0, mesh.faces, name="moved")


def test_copies_are_found_in_any_pose_and_size_and_nothing_else_is_one() -> None:
    assert copies([SCANS[0], SCANS[1], moved(SCANS[0], 1e-3), SCANS[0]]) == {2: 0, 3: 0}
    with pytest.raises(InputError, match="All scans are equal"):
        ss.correspond([SCANS[0], moved(SCANS[0], 2.0)], ONE_ROUND)


def test_units_are_told_by_sizes_and_sizes_beside_the_usual_one() -> None:
    scale, ratio = unit_ratios([1.0, 1.3, 0.8, 1.1e-3, 0.0394])
    np.testing.assert_allclose(ratio, [1, 1, 1, 1e-3, 1 / 25.4])
    np.testing.assert_allclose(scale, [1, 1.3, 0.8, 1.1, 1.0], rtol=0.01)
    np.testing.assert_allclose(unit_ratios([1.0, 2.6, 0.4])[1], 1.0)  # a child, a giant and one of middle size
    np.testing.assert_allclose(unit_ratios([2e-3, 2.0])[1], [1e-3, 1.0])


# What the command says


@pytest.fixture
def say(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Run `correspond` on scans, by their names, and return what it says on standard error."""

    def run(*options: object, **scans: Mesh) -> str:
        for name, mesh in scans.items():
            (tmp_path / "scans").mkdir(exist_ok=True)
            ss.write_mesh(tmp_path / "scans" / f"{name}.ply", mesh)
        capsys.readouterr()
        line = ["correspond", tmp_path / "scans", "-o", tmp_path / "same", "--vertices", "300", "--rounds", "1"]
        assert main([*map(str, line), "--jobs", "1", "--quiet", *map(str, options)]) in (0, 1)
        return capsys.readouterr().err

    return run


def test_what_is_odd_about_a_scan_is_said_and_kept(say: Callable[..., str], tmp_path: Path) -> None:
    crumb, faces = sphere(100)
    x = SCANS[2].vertices
    crumbed = Mesh(
        np.vstack([x, 8 * crumb + x.max(axis=0)]), np.vstack([faces_of(SCANS[2]), faces + len(x)]).astype(np.int32)
    )
    said = say(a=SCANS[0], b=SCANS[1], c=crumbed, again=SCANS[0], fins=finned(SCANS[3]))
    assert "c: It has 2 separate pieces" in said and "fins: 60 edges have more than two triangles" in said
    assert "again: It is a again; exclude one of the two." in said or "a: It is again again" in said
    assert '"notes": [\n  "It has 2 separate pieces' in (tmp_path / "same" / "c.correspond.json").read_text("utf-8")


@pytest.mark.long
def test_an_object_of_another_kind_among_few_is_named(say: Callable[..., str]) -> None:
    directions, faces = sphere(1200)
    box = Mesh(80 * np.sign(directions) * np.abs(directions) ** 0.2, faces)
    said = say(a=SCANS[0], b=SCANS[1], c=SCANS[2], box=box)
    assert "box: It differs from the others by" in said or "box is excluded" in said
    assert not any(line.startswith(("shapespace: a:", "shapespace: b:")) for line in said.splitlines())


@pytest.mark.long
def test_a_scan_of_quite_another_size_is_named(say: Callable[..., str]) -> None:
    large = SCANS[2].with_vertices(2.6 * SCANS[2].vertices)
    said = say(a=SCANS[0], b=SCANS[1], large=large, d=SCANS[3])
    assert re.search(r"large: It is 2\.\d times as large as most; check whether it is the same kind of object", said)
    assert said.count("times as large") == 1 and "another unit" not in said


@pytest.mark.long
def test_a_scan_that_its_surface_hardly_follows_is_named_whatever_its_unit(say: Callable[..., str]) -> None:
    rough = raw_blob(2, points=1200, noise_mm=4.0).scan
    metres = SCANS[1].with_vertices(1e-3 * SCANS[1].vertices)
    said = say(a=SCANS[0], b=metres, rough=rough, d=SCANS[3])
    assert re.search(r"rough: Its surface lies \d\S* times the usual distance from it; inspect it", said)
    assert said.count("times the usual distance") == 1


@pytest.mark.long
def test_point_clouds_among_meshes_are_registered_as_their_meshes_are(say: Callable[..., str], tmp_path: Path) -> None:
    names = "abcd"
    said = say("--template", mesh_file(tmp_path, SCANS[3]), **dict(zip(names, SCANS, strict=True)))
    meshes = [ss.read_mesh(tmp_path / "same" / f"{name}.corresponding.ply").vertices for name in names]
    assert "times the usual distance" not in said
    (tmp_path / "scans" / "a.ply").unlink()
    np.savetxt(tmp_path / "scans" / "a.xyz", SCANS[0].vertices)
    said = say("--template", tmp_path / "template.ply", b=Mesh(SCANS[1].vertices, None))
    assert said.count("It has no triangles: a point cloud") == 2 and "times the usual distance" not in said
    for name, mesh in zip(names, meshes, strict=True):
        surface = ss.read_mesh(tmp_path / "same" / f"{name}.corresponding.ply").vertices
        assert np.linalg.norm(surface - mesh, axis=1).mean() < 1.0


def mesh_file(folder: Path, mesh: Mesh) -> Path:
    ss.write_mesh(folder / "template.ply", mesh)
    return folder / "template.ply"


def test_a_template_of_another_kind_is_named(say: Callable[..., str], tmp_path: Path) -> None:
    directions, faces = sphere(400)
    ss.write_mesh(tmp_path / "rod.ply", Mesh(directions * np.array([10.0, 10.0, 200.0]), faces))
    said = say("--template", tmp_path / "rod.ply", a=SCANS[0], b=SCANS[1])
    assert "rod.ply had to change by" in said and "probably another kind of object" in said


@pytest.mark.long
def test_mixed_units_are_said_and_build_brings_them_together(
    say: Callable[..., str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    metres = SCANS[2].with_vertices(1e-3 * SCANS[2].vertices)
    said = say(a=SCANS[0], b=SCANS[1], c=metres, d=SCANS[3])
    assert "1 of 4 scans is in another unit than the majority, judging by size (c)" in said
    assert '"other_units": {\n  "c": 0.001\n }' in (tmp_path / "same" / "correspondence.json").read_text("utf-8")
    model = tmp_path / "model.h5"
    build = ["build", str(tmp_path / "same"), "-o", str(model), "--quiet"]
    assert main(build) == 0
    assert "1 of 4 meshes is in another unit than most (c.corresponding.ply)" in capsys.readouterr().err
    extent = np.ptp(ss.ShapeModel.load(model).mean_vertices, axis=0).max()
    assert extent == pytest.approx(np.ptp(SCANS[0].vertices, axis=0).max(), rel=0.2)
    for options in (["--gauge", "form"], ["--no-align"]):
        assert main([*build, *options]) == 2
        assert "sizes cannot be compared; bring the scans to one unit, or use --gauge shape" in capsys.readouterr().err
    assert main(["quality", str(tmp_path / "same"), "-o", str(tmp_path / "q"), "--samples", "2", "--quiet"]) == 0
    assert "in another unit than most (c.corresponding.ply)" in capsys.readouterr().err


def test_a_mean_that_is_too_small_for_its_unit_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    directions, faces = sphere(200)
    for k in range(4):
        bent = 1e-4 * directions * np.array([70.0 + 9 * k, 100.0, 85.0 + k**2])
        ss.write_mesh(tmp_path / f"{k}.ply", Mesh(bent, faces))
    line = ["build", str(tmp_path), "-o", str(tmp_path / "model.h5"), "--quiet"]
    assert main(line) == 0
    assert "mm large, which is unusual for mm; set the unit of the meshes with --unit" in capsys.readouterr().err
    assert main([*line, "--unit", "m"]) == 0
    assert "unusual for mm" not in capsys.readouterr().err
