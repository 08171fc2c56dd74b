"""Templates of MeshMonk and others in MATLAB files, written by scipy as MATLAB has them."""

from functools import partial
from pathlib import Path

import numpy as np
from scipy.io import savemat

from refusals import refusal_of
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, NAMED_FORMATS, mesh_files, read_mesh, write_mesh
from shapespace.types import Mesh

VERTICES = np.random.default_rng(0).normal(size=(9, 3))
FACES = np.array([[0, 1, 2], [2, 3, 4], [5, 6, 8], [6, 7, 8]])


refusal = partial(refusal_of, read_mesh)


def test_the_structure_with_vertices_and_faces_is_the_mesh(tmp_path: Path) -> None:
    template = {"Vertices": VERTICES.astype(np.float32), "Faces": (FACES + 1).astype(np.uint32).T, "Tag": "face"}
    savemat(tmp_path / "t.mat", {"about": "x", "n": 3.0, "Template": template}, do_compression=True)
    found = read_mesh(tmp_path / "t.mat")
    np.testing.assert_allclose(found.vertices, VERTICES, atol=1e-6)
    np.testing.assert_array_equal(np.asarray(found.faces), FACES)


def test_files_without_a_mesh_say_how_to_save_one(tmp_path: Path) -> None:
    savemat(tmp_path / "t.mat", {"vertices": VERTICES})
    assert "struct('Vertices', T.Vertices" in refusal(tmp_path / "t.mat")
    (tmp_path / "new.mat").write_bytes(b"MATLAB 7.3 MAT-file".ljust(512) + b"\x89HDF\r\n\x1a\n")
    assert "of MATLAB 7.3" in refusal(tmp_path / "new.mat")


def test_a_file_cut_short_is_refused(tmp_path: Path) -> None:
    savemat(tmp_path / "t.mat", {"vertices": VERTICES, "faces": FACES + 1}, do_compression=True)
    whole = (tmp_path / "t.mat").read_bytes()
    (tmp_path / "t.mat").write_bytes(whole[: len(whole) // 2])
    refusal(tmp_path / "t.mat")


def test_of_a_folder_it_is_no_scan(tmp_path: Path) -> None:
    write_mesh(tmp_path / "a.ply", Mesh(VERTICES))
    savemat(tmp_path / "results.mat", {"x": VERTICES})
    assert [path.name for path in mesh_files([tmp_path]).files] == ["a.ply"]
    assert set(NAMED_FORMATS) == {".mat"} and not set(NAMED_FORMATS) & set(MESH_ENDINGS)
