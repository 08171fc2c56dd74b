"""`correspond --parts`: several structures of one subject, in a folder that other commands take as any other."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from conftest import Run
from raw_blobs import raw_blob
from shapespace.cli import main
from shapespace.commands import correspond
from shapespace.commands.inputs import Given, given_scans, scans_of_parts
from shapespace.correspondence import CorrespondConfig, Correspondence, Corresponding
from shapespace.correspondence.scan_status import SurfaceMeasures
from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import FLIP
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.store.corresponding import surface_files
from shapespace.types import Mesh, Similarity
from synthetic_shapes import sphere

pytestmark = pytest.mark.usefixtures("few_modes")
PARTS = ("ball", "cup")
SPECIMENS = 5
LACKS = "s4"
"""The specimen without a cup."""
OPTIONS = ("--vertices", "200", "--rounds", "1", "--mirror", "never", "--jobs", "1", "--quiet")


def specimen(k: int) -> dict[str, Mesh]:
    """Return two blobs in one frame, the cup below the ball, rotated a little at their joint."""
    rng = np.random.default_rng([9, k])
    T = Similarity(1.0, Rotation.random(random_state=rng).as_matrix(), rng.normal(0, 100, 3))
    ball = raw_blob(k, T=Similarity.identity(), points=500).scan
    bent = Rotation.from_rotvec(0.1 * rng.standard_normal(3)).as_matrix()
    height = float(np.ptp(ball.vertices[:, 2]))
    cup = raw_blob(k + 50, T=Similarity(0.6, bent, np.array([0.0, 0.0, -height])), points=500).scan
    return {part: mesh.with_vertices(T.apply(mesh.vertices)) for part, mesh in zip(PARTS, (ball, cup), strict=True)}


def write_specimens(folder: Path, names: dict[str, int]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, k in names.items():
        for part, mesh in specimen(k).items():
            if (name, part) != (LACKS, "cup"):
                write_mesh(folder / f"{name}_{part}.ply", mesh)
    return folder


@pytest.fixture(scope="module")
def raw(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_specimens(tmp_path_factory.mktemp("raw"), {f"s{k}": k for k in range(SPECIMENS)})


@pytest.fixture(scope="module")
def same(raw: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results") / "same"
    assert main(["correspond", str(raw), "--parts", *PARTS, "-o", str(folder), *OPTIONS]) == 0
    return folder


def summary(folder: Path) -> dict[str, object]:
    return json.loads((folder / "correspondence.json").read_text("utf-8"))


def test_the_folder_has_joined_surfaces_in_the_frame_of_the_scans(raw: Path, same: Path) -> None:
    found = summary(same)
    counts = {part: summary(same / part)["vertices"] for part in PARTS}
    assert found["parts"] == counts and list(found["parts"]) == list(PARTS)
    assert found["corresponding"] == [f"s{k}" for k in range(SPECIMENS)]
    mesh = read_mesh(same / "s1.corresponding.ply")
    for part, own in zip(PARTS, np.split(mesh.vertices, [counts[PARTS[0]]]), strict=True):
        assert np.array_equal(own, read_mesh(same / part / "s1.corresponding.ply").vertices)
        assert np.linalg.norm(own.mean(axis=0) - read_mesh(raw / f"s1_{part}.ply").vertices.mean(axis=0)) < 10.0
    lacking = read_mesh(same / f"{LACKS}.corresponding.ply")
    assert lacking.observed is not None and not lacking.observed[counts[PARTS[0]] :].any()
    record = json.loads((same / f"{LACKS}.correspond.json").read_text("utf-8"))
    assert record["notes"] == ["It has no scan of cup."]


def test_other_commands_take_the_folder_as_any_other(run: Run, same: Path, tmp_path: Path) -> None:
    assert surface_files([same]).parts == summary(same)["parts"]
    assert run("info", same, "--json").facts["in_correspondence"] == SPECIMENS
    assert run("build", same, "-o", tmp_path / "m.h5", "--quiet").code == 0
    assert ShapeModel.load(tmp_path / "m.h5").n_vertices == summary(same)["vertices"]
    pytest.importorskip("matplotlib", reason="the extra `report` is not installed")
    assert run("report", same, "-o", tmp_path / "r.html", "--no-open", "--quiet").code == 0
    assert "each part has a scan of its own" in (tmp_path / "r.html").read_text(encoding="utf-8")


def test_a_part_with_wrong_sides_is_brought_into_correspondence_again_with_those_of_its_specimens(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    directions, faces = sphere(40, 0.0)
    measures = SurfaceMeasures(distance=0.01, folded=0, missing=0, unreached=0, area_change=1, not_settled=0)
    rng, given = np.random.default_rng(0), list[list[Mesh]]()
    scans = {(k, part): Mesh(directions * (1 + 0.1 * rng.random(3)), faces) for k in range(4) for part in PARTS}
    (tmp_path / "raw").mkdir()
    for (k, part), mesh in scans.items():
        write_mesh(tmp_path / "raw" / f"s{k}_{part}.ply", mesh)

    def as_given(meshes: list[Mesh], config: CorrespondConfig, **_: object) -> Correspondence:
        """Return the vertices of the scans; the second part is unsure of the side of s1 while it decides itself."""
        given.append(meshes)
        is_unsure = len(given) == 2
        same = [
            Corresponding(
                mesh.name, "", mesh.vertices, Similarity.identity(), 1.0, 1.0, (0.0, 0.0, 0.0, 0.0), (0.01,), (1.0,),
                mirrored=config.mirror == "auto" and mesh.name == "s1" and not is_unsure, status="converged",
                doubt="odd" if is_unsure and mesh.name == "s1" else "", measures=measures,
            )
            for mesh in meshes
        ]  # fmt: skip
        return Correspondence(meshes[0], tuple(same), "s0.", (0.01,), sides_decided=config.mirror == "auto")

    monkeypatch.setattr(correspond, "first_template", lambda *_: None)
    monkeypatch.setattr(correspond, "correspond", as_given)
    folder = tmp_path / "same"
    assert run("correspond", tmp_path / "raw", "--parts", *PARTS, "-o", folder, "--quiet").code == 0
    assert len(given) == 3 and np.allclose(given[2][1].vertices, given[1][1].vertices * FLIP)
    assert summary(folder)["mirrored"] == ["s1"]
    assert not (folder / "s1.correspond.json").read_text("utf-8").count("mirror image")
    found = read_mesh(folder / "s1.corresponding.ply").vertices
    assert np.allclose(found, np.concatenate([scans[1, part].vertices for part in PARTS]), atol=1e-5)
    assert run("correspond", tmp_path / "raw", "--parts", *PARTS, "-o", folder, "--quiet").code == 0
    assert len(given) == 3, "a second run computes nothing"


def test_folders_with_other_parts_are_not_mixed(run: Run, same: Path, tmp_path: Path) -> None:
    outcome = run("build", same, same / "ball", "-o", tmp_path / "m.h5", "--quiet")
    assert outcome.code == 2 and "different parts" in outcome.sentence()


def test_a_second_run_computes_nothing_and_changes_go_to_each_part(
    run: Run, raw: Path, same: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(same, tmp_path / "same")
    before = {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}
    assert run("correspond", raw, "--parts", *PARTS, "-o", folder, *OPTIONS).code == 0
    assert {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()} == before
    outcome = run("correspond", "--remove", "s2", "-o", folder, "--quiet")
    assert outcome.code == 0 and "s2" not in summary(folder)["corresponding"]
    assert not list(folder.rglob("s2.*"))
    assert (folder / "s1.corresponding.ply").read_bytes() == before[folder / "s1.corresponding.ply"]
    new = write_specimens(tmp_path / "new", {"n0": 8})
    assert run("correspond", new, "--add", "-o", folder, "--quiet", "--jobs", "1").code == 0
    assert "n0" in summary(folder)["corresponding"] and (folder / "cup" / "n0.corresponding.ply").is_file()
    outcome = run("correspond", "--remove", "nobody", "-o", folder, "--quiet")
    assert outcome.code == 2 and "has no scan of that name" in outcome.sentence()


def names(given: list[Given], parts: tuple[str, ...] = ("femur", "tibia")) -> dict[str, list[str]]:
    return {part: [scan.called for scan in scans] for part, scans in scans_of_parts(given, parts).items()}


def test_parts_are_found_by_file_name_folder_or_column(tmp_path: Path) -> None:
    files = ("anna_femur.ply", "anna-TIBIA.ply", "bert.femur.ply", "tibia/bert.ply", "carl_patella.ply")
    given = [Given(Path("x") / file) for file in files]
    assert names(given) == {"femur": ["anna", "bert"], "tibia": ["anna", "bert"]}
    (tmp_path / "list.csv").write_text("file,id,Part\n1.ply,anna,femur\n2.ply,anna,tibia\n3.ply,bert,femur\n")
    for name in "123":
        (tmp_path / f"{name}.ply").touch()
    listed = given_scans([tmp_path / "list.csv"], tmp_path, recursive=False, say=lambda _: None)
    assert names(list(listed)) == {"femur": ["anna", "bert"], "tibia": ["anna"]}
    with pytest.raises(InputError, match="are both the femur of anna; omit or rename one"):
        names([*given, Given(Path("y/anna_femur.stl"))])


@pytest.mark.parametrize(
    ("parts", "sentence"),
    [
        (("ball",), "--parts needs two or more different names"),
        (("ball", "Ball"), "--parts needs two or more different names"),
        (("ball", "tibia"), "0 of 9 scans are of the part tibia"),
        (("ball", "../cup"), "is that of a folder"),
    ],
)
def test_wrong_parts_are_one_sentence(
    run: Run, raw: Path, tmp_path: Path, parts: tuple[str, ...], sentence: str
) -> None:
    outcome = run("correspond", raw, "--parts", *parts, "-o", tmp_path / "same", "--quiet")
    assert outcome.code == 2 and sentence in outcome.sentence()


def test_specimens_with_no_part_in_common_are_one_sentence(run: Run, tmp_path: Path) -> None:
    for k in range(2):
        for part, mesh in specimen(k).items():
            write_mesh(tmp_path / f"{part}{k}_{part}.ply", mesh)
    outcome = run("correspond", tmp_path, "--parts", *PARTS, "-o", tmp_path / "same", "--quiet")
    assert outcome.code == 2 and "Fewer than 2 specimens have scans of all parts" in outcome.sentence()
