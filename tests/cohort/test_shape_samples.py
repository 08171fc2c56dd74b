"""Completed shapes in files: NAME.ply with NAME.samples.npz."""

from pathlib import Path

import numpy as np
import pytest

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.read import CohortConfig, read_cohort
from shapespace.errors import InputError, ShapespaceError
from shapespace.io.containers.archives import read_row
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.report.analyses.compare_report import compare_report
from shapespace.report.analyses.morphospace_report import morphospace_report
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.statistics.shape_tests.ordination import ordinate
from shapespace.types import Mesh
from synthetic_shapes import training_meshes

N, V, S = 6, 50, 5


def folder(path: Path) -> Path:
    """Write six meshes and a table; the second is completed, with five samples."""
    mask = np.arange(V) >= 10
    for k, mesh in enumerate(training_meshes(N, vertices=V)):
        write_mesh(path / f"s{k}.ply", Mesh(mesh.vertices, mesh.faces, observed=mask if k == 1 else None))
    (path / "table.csv").write_text("file,group\n" + "".join(f"s{k},{'ab'[k % 2]}\n" for k in range(N)))
    write_samples(path, completed(path))
    return path


def completed(path: Path) -> np.ndarray:
    vertices = training_meshes(N, vertices=V)[1].vertices
    own = np.repeat(vertices[None], S, axis=0).astype(np.float32)
    own[:, :10] += np.random.default_rng(0).standard_normal((S, 10, 3)).astype(np.float32)
    return own


def write_samples(path: Path, vertices: np.ndarray, **others: np.ndarray) -> None:
    np.savez(path / "s1.samples.npz", vertices=vertices, **others)


def read(path: Path, imputations: int = 20) -> Cohort:
    return read_cohort(path / "table.csv", CohortConfig(gauge="form", imputations=imputations))


def test_samples_are_read_one_at_a_time_and_the_shape_is_not_estimated_again(tmp_path: Path) -> None:
    made = read(folder(tmp_path))
    own = training_meshes(N, vertices=V)[1].vertices
    distances = np.linalg.norm(made.vertices(1)[:10] - made.vertices(1)[40], axis=1)
    np.testing.assert_allclose(distances, np.linalg.norm(own[:10] - own[40], axis=1), rtol=1e-5)
    assert made.imputations == S and made.estimated_share[1] == pytest.approx(0.2)
    assert any("has 5 samples" in note for note in made.notes)
    row, count = read_row(tmp_path / "s1.samples.npz", "vertices", 3, "")
    np.testing.assert_array_equal(row, completed(tmp_path)[3])
    assert count == S
    first = made.imputation(3).vertices(1)
    apart = np.linalg.norm(first[:10] - first[40], axis=1)
    np.testing.assert_allclose(apart, np.linalg.norm(row[:10] - row[40], axis=1), rtol=1e-5)


@pytest.mark.parametrize(("asked", "used"), [(0, 1), (1, 1), (3, 3)])
def test_the_number_of_imputations_is_an_option(tmp_path: Path, asked: int, used: int) -> None:
    made = read(folder(tmp_path), asked)
    assert made.imputations == used
    assert any("are not used" in note for note in morphospace_report(ordinate(made)).notes)
    found = compare(made, "~ group", CompareConfig(permutations=20, maps=False))
    assert (found.imputations is None) == (used == 1)
    assert any("are not used" in note for note in compare_report(found).notes) == (used == 1)


def test_compressed_samples_and_other_arrays_are_read(tmp_path: Path) -> None:
    folder(tmp_path)
    np.savez_compressed(tmp_path / "s1.samples.npz", knowledge=np.zeros(V, np.int32), vertices=completed(tmp_path))
    assert read(tmp_path).imputation(4).imputations == 0


def test_the_surface_of_a_completion_for_cad_is_not_another_shape(tmp_path: Path) -> None:
    folder(tmp_path)
    (tmp_path / "s1.stl").write_bytes(b"not read")
    assert len(read(tmp_path)) == N


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda own: own[:, :-1], "its samples have 49 vertices and s1.ply has 50"),
        (lambda own: own[:1], "one sample does not show any uncertainty"),
        (lambda own: own + 500, "of another mesh"),
        (lambda own: own * 10, "of another mesh"),
        (lambda own: own.astype(np.int32), "is not the array of floats"),
        (lambda own: own[0, 0, 0], "has 0 rows"),
        (lambda own: own[:0], "has 0 rows"),
        (lambda own: np.where(np.arange(V)[:, None] == 3, np.nan, own), "is not finite"),
    ],
)
def test_samples_that_cannot_be_used_are_refused(tmp_path: Path, change: object, words: str) -> None:
    folder(tmp_path)
    assert callable(change)
    write_samples(tmp_path, change(completed(tmp_path)))
    with pytest.raises(ShapespaceError, match=words) as caught:
        read(tmp_path)
    assert "s1.samples.npz" in str(caught.value) and str(caught.value).count("\n") == 0


@pytest.mark.parametrize("end", [0, 100, 2000, -40])
def test_damaged_samples_are_refused_in_one_sentence(tmp_path: Path, end: int) -> None:
    file = folder(tmp_path) / "s1.samples.npz"
    file.write_bytes(file.read_bytes()[:end])
    with pytest.raises(ShapespaceError, match=r"s1\.samples\.npz is not an \.npz file"):
        read(tmp_path)


def test_samples_without_vertices_are_refused(tmp_path: Path) -> None:
    np.savez(folder(tmp_path) / "s1.samples.npz", other=np.zeros(3))
    with pytest.raises(ShapespaceError, match="it has no vertices"):
        read(tmp_path)


def test_a_negative_number_of_imputations_is_refused() -> None:
    with pytest.raises(InputError, match="0 or more"):
        CohortConfig(imputations=-1)
