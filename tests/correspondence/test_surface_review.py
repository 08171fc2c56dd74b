"""Surfaces in correspondence that need review, and settings that do not suffice for a correspondence."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import shapespace as ss
from raw_blobs import raw_blob
from shapespace.correspondence import first_template, groupwise
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.scan_status import SurfaceMeasures, find_review_reasons
from shapespace.correspondence.template import TemplateChoice
from shapespace.errors import InputError
from shapespace.schemas import SurfaceReview
from shapespace.store.corresponding import provenance_with_review, review_of_provenance, review_summary
from shapespace.types import Mesh

USUAL = SurfaceMeasures(
    distance=0.02, folded=0.0, missing=0.02, unreached=0.01, area_change=1.3, not_settled=0.001
)  # fmt: skip
SETTLED = 0.002
QUICK = ElasticSettings(harmonics=100, points=500, iterations=10)
CONFIG = ss.CorrespondConfig(vertices=300, rounds=1, mirror="never", first=QUICK, next=QUICK)


@pytest.mark.parametrize(
    ("code", "value"),
    [("distance", 0.08), ("folded", 0.003), ("missing", 0.4), ("unreached", 0.2), ("area_change", 3.0),
     ("not_settled", 0.03)],
)  # fmt: skip
def test_an_unusual_surface_needs_review_and_the_others_do_not(code: str, value: float) -> None:
    surfaces = [USUAL, USUAL, replace(USUAL, **{code: value}), USUAL, USUAL]
    reasons = find_review_reasons(surfaces, SETTLED)
    assert [[reason.code for reason in own] for own in reasons] == [[], [], [code], [], []]
    [reason] = reasons[2]
    assert reason.value == pytest.approx(value) and reason.usual == pytest.approx(getattr(USUAL, code))
    assert reason.excess > 4.0


@pytest.mark.parametrize(("code", "value"), [("folded", 0.02), ("distance", 0.2), ("unreached", 0.4)])
def test_surfaces_that_are_all_beyond_a_limit_need_review(code: str, value: float) -> None:
    reasons = find_review_reasons([replace(USUAL, **{code: value})] * 4, SETTLED)
    assert all([reason.code for reason in own] == [code] for own in reasons)


def test_unknown_measures_and_a_settled_movement_are_no_reason() -> None:
    unknown = SurfaceMeasures(**dict.fromkeys(SurfaceMeasures.__dataclass_fields__, np.nan))
    settled = replace(USUAL, not_settled=0.9 * SETTLED)
    assert find_review_reasons([unknown, settled, *[replace(USUAL, not_settled=1e-4)] * 4], SETTLED) == [[]] * 6


def test_a_review_counts_surfaces_once_and_every_reason() -> None:
    review = SurfaceReview.of([["folded", "not_settled"], [], ["folded"], [], []])
    clause = "2 of 5 surfaces need review in the correspondence (2 with folded triangles, 1 not settled)"
    assert review_summary(review) == clause and not review.is_majority
    assert review_of_provenance(provenance_with_review("5 meshes", review)) == clause
    assert review_of_provenance("5 meshes") == "" == review_summary(SurfaceReview.of([[], []]))
    assert (review + review).needs_review == 4 and SurfaceReview.of([["missing"], ["missing"], []]).is_majority


def test_settings_with_which_the_median_surface_is_folded_are_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("shapespace.correspondence.template.MODES", 15)
    scans = [raw_blob(k, points=600).scan for k in range(3)]
    made = ss.correspond(scans, CONFIG, template=scans[0])
    assert [scan.measures.folded for scan in made.scans if scan.measures] == [0.0] * 3
    monkeypatch.setattr(groupwise, "MOST_FOLDED", -1.0)
    with pytest.raises(InputError, match=r"1 rounds with 600 vertices.*more vertices .--vertices, 300 now"):
        ss.correspond(scans, CONFIG, template=scans[0])


def perforated_plate(cells: int) -> Mesh:
    """Return the surface of a plate of `cells` x `cells` cubes, without every other one in every other row."""
    there = np.ones((cells + 2, cells + 2, 3), dtype=np.bool_)
    there[2:-1:2, 2:-1:2] = False
    there[[0, -1]], there[:, [0, -1]], there[:, :, [0, -1]] = False, False, False
    quads: list[np.ndarray] = []
    for axis, sign in itertools.product(range(3), (-1, 1)):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        cubes = np.argwhere(there & ~np.roll(there, -sign, axis=axis))
        corners = np.repeat(cubes[:, None], 4, axis=1)
        corners[:, :, axis] += sign > 0
        corners[:, [1, 2], u] += 1
        corners[:, [2, 3], v] += 1
        quads.append(corners if sign > 0 else corners[:, ::-1])
    points, index = np.unique(np.concatenate(quads).reshape(-1, 3), axis=0, return_inverse=True)
    index = index.reshape(-1, 4)
    faces = np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]]).astype(np.int32)
    return Mesh(points.astype(np.float64), faces, name=f"plate{cells}")


def test_a_template_that_loses_vertices_to_handles_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(first_template, "choose_template", lambda *_: TemplateChoice(0, (0.01, 0.01)))
    plates = [perforated_plate(21), perforated_plate(23)]
    with pytest.raises(
        InputError, match=r"plate21 .* --vertices 500 .* only 324 vertices.* 100 handles.*give --vertices 600"
    ):
        first_template.first_template(plates, None, replace(CONFIG, vertices=500))
    enough = first_template.first_template(plates, None, replace(CONFIG, vertices=600))
    assert len(enough.mesh.vertices) > 400
