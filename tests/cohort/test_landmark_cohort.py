"""Cohorts of landmarks: from alignments, files, folders of align, and from surfaces that carry landmarks."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.landmark_cohort import landmark_cohort
from shapespace.cohort.read import CohortConfig, read_cohort
from shapespace.cohort.table import match_rows, read_table
from shapespace.commands.align import align
from shapespace.errors import InputError, ShapespaceError
from shapespace.geometry.landmark_alignment import AlignConfig, align_landmarks
from shapespace.io.landmarks.configuration_io import write_configurations
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.io.landmarks.landmark_io import write_landmark_indices
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.statistics.compare_shapes import CompareConfig, compare
from shapespace.types import FloatArray, Mesh

N, L = 12, 8
NAMES = tuple(f"IJ.{k}" for k in range(N))
SEX = tuple("fm"[k % 2] for k in range(N))


def points(D: int = 2) -> FloatArray:
    rng = np.random.default_rng(D)
    return rng.uniform(1, 3, (N, 1, 1)) * (rng.normal(size=(L, D)) + 0.05 * rng.normal(size=(N, L, D)))


def configurations(D: int = 2, **fields: Any) -> LandmarkConfigurations:
    return LandmarkConfigurations(names=NAMES, points=points(D), columns={"sex": SEX}, **fields)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A landmark file with a column of covariates."""
    write_configurations(tmp_path / "skulls.csv", configurations())
    return tmp_path / "skulls.csv"


def write_table(path: Path, names: tuple[str, ...]) -> Path:
    with path.open("w", newline="") as stream:
        csv.writer(stream).writerows([("specimen", "age"), *((name, 10 + k) for k, name in enumerate(names))])
    return path


@pytest.mark.parametrize("D", [2, 3])
def test_distances_of_coefficients_are_those_of_the_aligned_landmarks(D: int) -> None:
    aligned = align_landmarks(configurations(D, unit="mm"))
    cohort = Cohort.of_landmarks(aligned)
    assert cohort.dimensions == D and cohort.source.kind == "landmarks" and cohort.faces is None
    assert cohort.unit == "" and np.array_equal(cohort.sizes_mm, aligned.sizes)
    assert dict(cohort.landmarks or {}) == {str(k + 1): k for k in range(L)}
    flat = aligned.coords.reshape(N, -1)
    given, found = (np.linalg.norm(x[:, None] - x, axis=2) for x in (flat, cohort.coefficients))
    assert np.allclose(given, found, atol=1e-12)
    assert np.allclose(cohort.vertices(3)[:, :D], aligned.coords[3]) and not cohort.vertices(3)[:, D:].any()


def test_forms_have_the_unit_of_the_file_and_can_be_taken_as_shapes() -> None:
    form = align_landmarks(configurations(3, unit="mm"), AlignConfig(gauge="form"))
    cohort, shapes = Cohort.of_landmarks(form), Cohort.of_landmarks(form, gauge="shape")
    assert cohort.unit == "mm" and shapes.unit == ""
    assert np.linalg.norm(cohort.vertices(2)) == pytest.approx(form.sizes[2])
    own = align_landmarks(configurations(3))
    forms = Cohort.of_landmarks(own, gauge="form")
    assert np.linalg.norm(forms.vertices(2)) == pytest.approx(own.sizes[2])
    assert shapes.coefficients.var(axis=0).sum() == pytest.approx(own.coords.var(axis=0).sum(), rel=0.01)


def test_a_file_a_folder_of_align_and_a_table_beside_either_are_the_same_cohort(file: Path, tmp_path: Path) -> None:
    align(file, tmp_path / "aligned")
    table = write_table(tmp_path / "people.csv", NAMES[::-1])
    cohorts = [
        read_cohort(file),
        read_cohort(tmp_path / "aligned"),
        read_cohort(table, CohortConfig(shapes=file)),
        read_cohort(table, CohortConfig(shapes=tmp_path / "aligned")),
    ]
    assert any("default options" in note for note in cohorts[0].notes) and len(cohorts[1].notes) == 1
    assert "aligned: 1 specimen to check (see align.json)." in cohorts[1].notes[0]
    for cohort in cohorts:
        assert cohort.names == cohorts[0].names
        order = [cohort.names.index(name) for name in NAMES]
        assert np.allclose(cohort.sizes_mm[order], cohorts[0].sizes_mm, rtol=1e-12)
        distances = np.linalg.norm(cohort.coefficients[order][:, None] - cohort.coefficients[order], axis=2)
        own = np.linalg.norm(cohorts[0].coefficients[:, None] - cohorts[0].coefficients, axis=2)
        # The second ends its iterations from another first specimen.
        assert np.allclose(distances, own, atol=1e-4)
        assert cohort.table.texts("sex") == tuple(SEX[NAMES.index(name)] for name in cohort.names)
    assert cohorts[2].table.numbers("age").tolist() == list(range(10, 10 + N))[::-1]


def test_rows_without_landmarks_and_landmarks_without_rows_are_left_out_with_notes(file: Path, tmp_path: Path) -> None:
    table = write_table(tmp_path / "some.csv", (*NAMES[:5], "unknown"))
    cohort = read_cohort(table, CohortConfig(shapes=file))
    assert cohort.names == NAMES[:5]
    assert "1 of 6 rows" in cohort.notes[0] and "7 of 12 specimens" in cohort.notes[1]
    with pytest.raises(InputError, match="contains no specimen of"):
        read_cohort(write_table(tmp_path / "none.csv", ("a", "b")), CohortConfig(shapes=file))
    with pytest.raises(InputError, match="1 specimen can be used, and 2 are needed"):
        read_cohort(write_table(tmp_path / "one.csv", NAMES[:1]), CohortConfig(shapes=file))


def test_estimated_landmarks_are_marked_and_read_again(tmp_path: Path) -> None:
    given = points()
    given[4, 2] = np.nan
    write_configurations(tmp_path / "gaps.csv", LandmarkConfigurations(names=NAMES, points=given))
    align(tmp_path / "gaps.csv", tmp_path / "aligned")
    for cohort in (read_cohort(tmp_path / "gaps.csv"), read_cohort(tmp_path / "aligned")):
        assert cohort.observed is not None and np.argwhere(~cohort.observed).tolist() == [[4, 2]]


@pytest.mark.parametrize("source", ["skulls.csv", "aligned"])
def test_specimens_of_a_cohort_that_are_brought_to_its_mean_are_themselves(
    file: Path, tmp_path: Path, source: str
) -> None:
    align(file, tmp_path / "aligned", AlignConfig(tolerance=1e-14, iterations=100))
    cohort = read_cohort(tmp_path / "aligned")
    table = write_table(tmp_path / "some.csv", NAMES[3:5])
    again = read_cohort(table, CohortConfig(shapes=tmp_path / source), onto=cohort)
    assert again.names == NAMES[3:5] and again.dimensions == 2 and again.unit == ""
    for k in (0, 1):
        assert np.allclose(again.vertices(k), cohort.vertices(3 + k), atol=1e-8)
    assert np.allclose(again.sizes_mm, cohort.sizes_mm[3:5])


def test_landmarks_are_compared_by_their_names_in_any_order(tmp_path: Path) -> None:
    names, given = tuple("abcdefgh"), configurations()
    for file, order, named in (("known", names, names), ("new", names[::-1], names[::-1]), ("z", names, "zbcdefgh")):
        rows = [names.index(name) for name in order]
        changed = replace(given, points=given.points[:, rows], landmarks=tuple(named))
        write_configurations(tmp_path / f"{file}.csv", changed)
    cohort = read_cohort(tmp_path / "known.csv")
    again = read_cohort(tmp_path / "new.csv", onto=cohort)
    expected = read_cohort(tmp_path / "known.csv", onto=cohort)
    np.testing.assert_allclose(again.coefficients, expected.coefficients, atol=1e-12)
    with pytest.raises(InputError, match=r"not those of the shapes to compare with \(a, z\)"):
        read_cohort(tmp_path / "z.csv", onto=cohort)
    with pytest.raises(InputError, match="Shapes of 7 landmarks cannot be compared with shapes of 8 landmarks"):
        Cohort.of_shapes(np.zeros((1, 7, 3)), {}, onto=cohort)


def test_landmarks_of_surfaces_are_a_cohort_beside_that_of_the_surfaces(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    base = 50 * rng.normal(size=(40, 3))
    faces = rng.permuted(np.tile(np.arange(40), (60, 1)), axis=1)[:, :3].astype(np.int32)
    shapes = base + 2 * rng.normal(size=(N, 40, 3))
    for name, x in zip(NAMES, shapes, strict=True):
        write_mesh(tmp_path / f"{name.replace('.', '')}.ply", Mesh(x, faces))
    write_table(tmp_path / "people.csv", tuple(name.replace(".", "") for name in NAMES))
    write_landmark_indices(tmp_path / "landmarks.csv", {f"lm{k}": 5 * k for k in range(6)})
    surfaces = read_cohort(tmp_path / "people.csv")
    cohort = read_cohort(tmp_path / "people.csv", CohortConfig(geometry="landmarks"))
    assert surfaces.n_vertices == 40 and cohort.n_vertices == 6 and cohort.source.kind == "landmarks"
    own = [np.linalg.norm(x[::5][:6] - x[::5][:6].mean(axis=0)) for x in shapes]
    assert np.allclose(cohort.sizes_mm, own, rtol=1e-6)
    again = landmark_cohort(
        replace(surfaces, landmarks=cohort.landmarks and {n: 5 * k for k, n in enumerate(cohort.landmarks)})
    )
    assert np.allclose(again.coefficients, cohort.coefficients)
    with pytest.raises(InputError, match="no landmarks are known on these surfaces"):
        landmark_cohort(surfaces)
    write_landmark_indices(tmp_path / "others.csv", {f"m{k}": 39 - k for k in range(4)})
    others = CohortConfig(geometry="landmarks", landmarks=tmp_path / "others.csv")
    own = [np.linalg.norm(x[36:] - x[36:].mean(axis=0)) for x in shapes]
    assert np.allclose(read_cohort(tmp_path / "people.csv", others).sizes_mm, own, rtol=1e-6)
    onto = read_cohort(tmp_path / "people.csv", CohortConfig(geometry="landmarks"), onto=cohort)
    assert np.allclose(onto.vertices(2), cohort.vertices(2), atol=1e-4)


def test_analyses_take_landmarks_and_write_no_millimetres(file: Path) -> None:
    result = compare(read_cohort(file), "~ sex", CompareConfig(permutations=20, maps=False))
    assert 0 < result.test("sex").r2 < 1 and result.methods.unit == "" and result.methods.source == "landmarks"


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("align.json", "{}", "align.json is damaged"),
        ("aligned.csv", "name,1.X,1.Y,2.X,2.Y\na,1,2,3,4\n", "centroid_size"),
        ("estimated.csv", "specimen,landmark\nIJ.0,x\n", "estimated.csv is damaged"),
    ],
)
def test_damaged_folders_are_refused_in_one_sentence(
    file: Path, tmp_path: Path, name: str, change: str, words: str
) -> None:
    align(file, tmp_path / "aligned")
    (tmp_path / "aligned" / name).write_text(change)
    with pytest.raises(ShapespaceError, match=words) as caught:
        read_cohort(tmp_path / "aligned")
    assert str(caught.value).count(". ") == 0


def test_a_table_of_scans_and_one_of_specimens_both_name_the_landmarks(tmp_path: Path) -> None:
    table = tmp_path / "table.csv"
    table.write_text("file,sex\na.1,f\nscans/b.ply,m\nc.2,f\nc.3,m\n")
    assert match_rows(read_table(table), [["a.1"], ["b"]], "x")[0] == {0: 0, 1: 1}
