"""`shapespace surface` makes a surface of each volume, says what it made, and sets aside what it cannot use by name."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from conftest import Run, leftovers
from shapespace.geometry.doctor import examine
from shapespace.io.meshes.mesh_io import read_mesh

nib = pytest.importorskip("nibabel", reason="the extra `volumes` is not installed")
nrrd = pytest.importorskip("nrrd", reason="the extra `volumes` is not installed")

SHAPE, CENTRE = (24, 26, 20), np.array([11.0, 12, 9])
AFFINE = np.array([[-1.0, 0, 0, 40], [0, 1, 0, -60], [0, 0, 1.5, 5], [0, 0, 0, 1]])


def labels(radius: float = 6.0, label: int = 1) -> Any:
    places = np.stack(np.meshgrid(*map(np.arange, SHAPE), indexing="ij"), -1)
    return (label * (np.linalg.norm((places - CENTRE) * (1, 1, 1.5), axis=-1) < radius)).astype(np.uint8)


def nifti(path: Path, voxels: Any = None, affine: Any = AFFINE) -> Path:
    path.parent.mkdir(exist_ok=True)
    nib.save(nib.Nifti1Image(labels() if voxels is None else voxels, affine), path)
    return path


def test_nifti_and_nrrd_of_one_mask_give_one_surface_in_lps_mm(run: Run, tmp_path: Path) -> None:
    lps = np.diag([-1.0, -1, 1, 1]) @ AFFINE
    fields = {"space": "LPS", "space directions": lps[:3, :3].T, "space origin": lps[:3, 3]}
    nrrd.write(str(tmp_path / "two.seg.nrrd"), labels(), fields, index_order="F")
    outcome = run("surface", nifti(tmp_path / "one.nii.gz"), tmp_path / "two.seg.nrrd", "-o", tmp_path / "out")
    assert outcome.code == 0 and outcome.err == ""
    one, two = read_mesh(tmp_path / "out" / "one.ply"), read_mesh(tmp_path / "out" / "two.ply")
    assert np.allclose(one.vertices, two.vertices, atol=1e-4)
    middle = (lps @ [*CENTRE, 1])[:3]
    off = np.abs(np.linalg.norm(one.vertices - middle, axis=1) - 6)
    assert off.mean() < 0.15
    report = examine(one)
    assert report.findings == () and report.boundary_edges == 0
    assert outcome.out.splitlines()[-1] == f"2 of 2 volumes to surfaces in {tmp_path / 'out'}: LPS, mm"
    assert outcome.out.startswith(f"one.ply: {report.triangles:,} triangles around")
    assert "voxels of 1 x 1 x 1.5 mm" in outcome.out


def test_facts_are_json_with_frame_unit_and_voxels(run: Run, tmp_path: Path) -> None:
    outcome = run("surface", nifti(tmp_path / "a.nii"), "-o", tmp_path / "out", "--json")
    assert outcome.facts["volumes"] == outcome.facts["surfaces"] == 1
    (record,) = outcome.facts["records"]
    assert record["frame"] == "LPS" and record["unit"] == "mm" and np.allclose(record["voxel_mm"], (1, 1, 1.5))
    assert record["labels"] == [1] and record["voxels"] == int(labels().sum()) and record["notes"] == []
    assert record["triangles"] == len(read_mesh(Path(record["surface"])).faces)


def test_a_folder_stands_for_its_volumes_and_names_are_told_apart(run: Run, tmp_path: Path) -> None:
    for name in ("masks/a.nii", "masks/a.nii.gz", "masks/b.nii.gz", "others/b.nii"):
        nifti(tmp_path / name)
    (tmp_path / "masks" / "readme.txt").write_text("no volume")
    assert run("surface", tmp_path / "masks", tmp_path / "others", "-o", tmp_path / "out").code == 0
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["a.nii.gz.ply", "a.nii.ply", "masks_b.ply", "others_b.ply"]
    outcome = run("surface", tmp_path / "out", "-o", tmp_path / "out2")
    assert outcome.code == 2 and "contains no volumes" in outcome.sentence()


def test_a_bad_volume_among_others_is_set_aside_by_name(run: Run, tmp_path: Path) -> None:
    good, bad = nifti(tmp_path / "good.nii.gz"), tmp_path / "bad.nii.gz"
    bad.write_bytes(good.read_bytes()[:-30])
    empty = nifti(tmp_path / "empty.nii.gz", np.zeros(SHAPE, dtype=np.uint8))
    nifti(tmp_path / "out" / "bad.ply.nii").rename(tmp_path / "out" / "bad.ply")
    outcome = run("surface", good, bad, empty, "-o", tmp_path / "out", "--json")
    assert outcome.code == 1
    assert outcome.facts["volumes"] == 3 and outcome.facts["surfaces"] == 1
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["good.ply"]
    lines = outcome.err.splitlines()
    assert len(lines) == 2 and str(bad) in lines[0] and str(empty) in lines[1]
    assert [f"shapespace: {r['error']}" for r in outcome.facts["records"][1:]] == lines
    assert not leftovers(tmp_path)


def test_memory_is_limited_as_asked(run: Run, tmp_path: Path) -> None:
    path = nifti(tmp_path / "a.nii.gz")
    outcome = run("surface", path, "-o", tmp_path / "out", "--max-memory", "100M")
    assert outcome.code == 2 and "over the limit of 0.098 GiB" in outcome.sentence()
    assert run("surface", path, "-o", tmp_path / "out", "--max-memory", "0.3GiB").code == 0
    for wrong in ("4", "G", "-1G", "0G", "1e9G", "4 gigabytes"):
        outcome = run("surface", path, "-o", tmp_path / "out", f"--max-memory={wrong}")
        assert outcome.code == 2 and "must be a size such as 8G or 500M" in outcome.err


@pytest.mark.parametrize(
    ("voxels", "said"),
    [
        (np.zeros(SHAPE, dtype=np.uint8), "all its voxels are 0"),
        (labels() + 2 * np.roll(labels(2.5), 6, axis=2), "it has the labels 1, 2; choose some (--label)"),
        (np.pad([[[1]]], 3).astype(np.uint8), "only 1 voxel"),
        (labels() * np.float32(0.3), "not integers"),
        (np.stack([labels()] * 2, axis=-1), "more than one volume"),
    ],
)  # fmt: skip
def test_a_volume_that_is_no_mask_is_refused_in_a_sentence(voxels: Any, said: str, run: Run, tmp_path: Path) -> None:
    path = nifti(tmp_path / "a.nii.gz", voxels)
    outcome = run("surface", path, "-o", tmp_path / "out")
    sentence = outcome.sentence()
    assert outcome.code == 2 and str(path) in sentence and said in sentence and ";" in sentence
    assert outcome.out == "" and not list((tmp_path / "out").iterdir())


def test_labels_with_the_rounding_of_a_slope_are_whole(run: Run, tmp_path: Path) -> None:
    stored = nib.Nifti1Image(labels(), AFFINE)
    stored.header.set_slope_inter(np.float32(1 + 3e-6), 0)
    nib.save(stored, tmp_path / "slope.nii.gz")
    nifti(tmp_path / "float.nii.gz", labels() * np.float32(1 + 3e-6))
    assert run("surface", nifti(tmp_path / "whole.nii.gz"), *tmp_path.glob("[sf]*.nii.gz"), "-o", tmp_path).code == 0
    for name in ("slope", "float"):
        assert (tmp_path / f"{name}.ply").read_bytes() == (tmp_path / "whole.ply").read_bytes()


def test_labels_pieces_and_smoothing_are_as_asked(run: Run, tmp_path: Path) -> None:
    path = nifti(tmp_path / "a.nii.gz", labels(5.0) + 4 * np.roll(labels(3.0), 10, axis=0))

    def record(*options: object) -> Any:
        outcome = run("surface", path, "-o", tmp_path / "out", "--json", *options)
        assert outcome.code == 0, outcome.err
        return outcome.facts["records"][0]

    assert record("--label", "4")["voxels"] < record("--label", "1")["voxels"]
    assert record("--label", "all")["labels"] == record("--label", "4,1")["labels"] == [1, 4]
    assert record("--label", "all")["left_out_voxels"] > 0
    assert record("--label", "all", "--keep-pieces")["left_out_voxels"] == 0
    assert record("--label", "1", "--smooth", "0")["vertices"] > 0
    absent = run("surface", path, "-o", tmp_path / "out", "--label", "3")
    assert absent.code == 2 and "it has no label 3; choose from 1, 4" in absent.sentence()
    for option, value in (("--label", "0"), ("--label", "one"), ("--smooth", "-1"), ("--smooth", "nan")):
        assert run("surface", path, "-o", tmp_path / "out", option, value).code == 2


def test_the_odd_ones_among_many_are_named(run: Run, tmp_path: Path) -> None:
    for k in range(4):
        nifti(tmp_path / "masks" / f"{k}.nii", labels(6.0 + 0.4 * k))
    nifti(tmp_path / "masks" / "twice.nii.gz", labels(6.4))
    nifti(tmp_path / "masks" / "other.nii", affine=np.diag([3.0, 3, 3, 1]))
    outcome = run("surface", tmp_path / "masks", "-o", tmp_path / "out")
    assert "Most of the others have voxels of 1 x 1 x 1.5 mm." in outcome.out
    assert re.search("Its volume is 1[0-9] times that in the middle of all", outcome.out)
    assert outcome.out.count("It is the same surface as 1.ply.") == 1


def test_what_is_missing_is_said_once(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    paths = [nifti(tmp_path / f"{k}.nii") for k in range(2)]
    monkeypatch.setattr("shapespace.io.volume_io.find_spec", lambda name: None)
    outcome = run("surface", *paths, "-o", tmp_path / "out")
    assert outcome.code == 2 and "pip install 'shapespace[volumes]'" in outcome.sentence()


def test_all_hippocampi_become_clean_surfaces_and_the_odd_one_is_named(
    run: Run, tmp_path: Path, shared_data: Path
) -> None:
    folder = shared_data / "hippocampus"
    if not folder.is_dir():
        pytest.skip("no hippocampi there")
    masks = sorted(folder.glob("*.nii.gz"))
    some = [*masks[:8], folder / "hippocampus_281.nii.gz"]
    outcome = run("surface", *some, "-o", tmp_path / "out", "--label", "all", "--json")
    assert outcome.code == 0
    for record in outcome.facts["records"]:
        report = examine(read_mesh(Path(record["surface"])))
        assert report.components == 1 and report.boundary_edges == report.non_manifold_edges == 0
        assert report.degenerate_triangles == report.inconsistent_edges == report.reversed_triangles == 0
    assert [record["name"] for record in outcome.facts["records"] if record["odd"]] == [
        "hippocampus_011",
        "hippocampus_281",
    ]
