"""People of the recognition study: the same whatever is made first, each in a way of their own."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from shapespace.datasets.ict import IctFaces, load_ict
from shapespace.errors import InputError

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "studies"))
from study_people import SIX_EXPRESSIONS, StudyPeople, holes_of


@pytest.fixture(scope="module")
def ict(shared_data: Path) -> IctFaces:
    return load_ict(shared_data / "ict-facekit")


def test_everybody_shows_neutral_and_each_expression_at_each_level() -> None:
    shown = StudyPeople().shown
    assert shown[0] == ("neutral", 0.0) and len(shown) == 1 + 6 * 4
    assert {name for name, _ in shown[1:]} == set(SIX_EXPRESSIONS)


def test_a_person_does_not_depend_on_how_many_there_are(ict: IctFaces) -> None:
    few, many = StudyPeople(people=2), StudyPeople(people=90)
    assert np.array_equal(few.unit_weights(ict, 1), many.unit_weights(ict, 1))
    assert np.array_equal(few.faces(ict, 1)[7].vertices, many.faces(ict, 1)[7].vertices)


def test_people_make_the_same_expression_in_ways_of_their_own(ict: IctFaces) -> None:
    people = StudyPeople()
    strongest = np.stack([people.unit_weights(ict, p)[4] for p in range(12)])
    used = strongest.mean(axis=0) > 0.1
    assert (strongest[:, used].std(axis=0) / strongest[:, used].mean(axis=0)).min() > 0.15
    plain = StudyPeople(style=0.0, blend=0.0, take=0.0, resting=0.0)
    alike = np.stack([plain.unit_weights(ict, p)[4] for p in range(3)])
    assert np.allclose(alike, alike[0])


def test_a_stronger_expression_moves_the_face_further(ict: IctFaces) -> None:
    faces = StudyPeople(take=0.0, resting=0.0).faces(ict, 0)
    moved = [np.linalg.norm(face.vertices - faces[0].vertices, axis=1).mean() for face in faces[1:5]]
    assert np.all(np.diff(moved) > 0)


def test_a_scan_is_of_other_triangles_and_lacks_what_it_should(ict: IctFaces) -> None:
    people = StudyPeople(noise_mm=0.0)
    face = people.faces(ict, 0)[3]
    made = people.scan(face, 0, 3)
    again = people.scan(face, 0, 3)
    assert np.array_equal(made.scan.vertices, again.scan.vertices)
    assert abs(len(made.scan.faces) / people.triangles - 1) < 0.3
    on_face = made.T_scan_model.inverse().apply(made.scan.vertices)
    assert (cKDTree(face.vertices).query(on_face)[0] < 1e-3).mean() < 0.02
    far = cKDTree(on_face).query(face.vertices)[0]
    assert 0.05 < (far > 4.0).mean() < 0.15
    whole = replace(people, missing=0.0).scan(face, 0, 3)
    assert (
        cKDTree(whole.T_scan_model.inverse().apply(whole.scan.vertices)).query(face.vertices)[0] > 4.0
    ).mean() < 0.01


@pytest.mark.parametrize("missing", [0.0, 0.03, 0.1, 0.3])
def test_holes_cut_the_share_that_is_asked_for(ict: IctFaces, missing: float) -> None:
    face = ict.mesh()
    gone = np.zeros(len(face.vertices), dtype=bool)
    for hole in holes_of(face, missing, np.random.default_rng(1)):
        gone |= np.linalg.norm(face.vertices - hole.center, axis=1) <= hole.radius_mm
    assert abs(gone.mean() - missing) < 0.002


def test_studies_that_cannot_be_are_refused() -> None:
    with pytest.raises(InputError, match="different names"):
        StudyPeople(expressions=("smile", "smile"))
    with pytest.raises(InputError, match="different names"):
        StudyPeople(expressions=("neutral",))
    with pytest.raises(InputError, match="intensities"):
        StudyPeople(levels=(0.0,))
    with pytest.raises(InputError, match="half of each scan"):
        StudyPeople(missing=0.6)
