"""Landmarks of marked specimens on all others in correspondence: positions, regions, errors of experts, suggestions."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from shapespace.correspondence.landmark_transfer import MarkedSpecimens
from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import rms_size
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob, similarity, sphere

VERTICES = 400
Marks = dict[str, dict[str, FloatArray]]


def specimens(z: FloatArray) -> list[Mesh]:
    """Return blobs with coefficients `z` (N, 5) in true correspondence, each in a pose of its own."""
    d, faces = sphere(VERTICES)
    return [Mesh(similarity(k, degrees=30.0 * k).apply(blob(d, one)), faces, name=f"s{k}") for k, one in enumerate(z)]


def centres(mesh: Mesh, triangles: Sequence[int]) -> dict[str, FloatArray]:
    """Return the centres of `triangles` as landmarks."""
    return {f"lm{t}": mesh.vertices[np.asarray(mesh.faces)[t]].mean(axis=0) for t in triangles}


def drawn(count: int, seed: int = 0) -> list[Mesh]:
    return specimens(0.5 * np.random.default_rng(seed).standard_normal((count, 5)))


def test_landmarks_in_true_correspondence_are_transferred_exactly_also_to_and_from_mirrored_scans() -> None:
    meshes = drawn(5)
    meshes[1], meshes[4] = (replace(mirror_image(meshes[k]), name=f"s{k}") for k in (1, 4))
    marked = {name: centres(meshes[k], (3, 70, 400)) for k, name in enumerate(("s0", "s1"))}
    sides = MarkedSpecimens.of(meshes, marked, mirrored=("s1", "s4"))
    for mesh in meshes:
        found = sides.transfer(mesh.name)
        truth = np.stack(list(centres(mesh, (3, 70, 400)).values()))
        np.testing.assert_allclose(found.positions, truth, atol=1e-9 * rms_size(truth))
        assert found.status == "converged"
    unsided = MarkedSpecimens.of(meshes, marked)
    assert unsided.distance[0, 1] > 3 * sides.distance[0, 1]


def test_the_nearest_marked_specimen_has_the_largest_weight_and_regions_grow_with_the_distance() -> None:
    z = np.zeros((4, 5))
    z[1], z[2], z[3] = 0.05, 1.5, 0.5
    meshes = specimens(z)
    marked = {
        "s0": centres(meshes[0], (3, 70)),
        "s2": {f"lm{a}": centres(meshes[2], (b,))[f"lm{b}"] for a, b in ((3, 90), (70, 200))},
    }
    found = MarkedSpecimens.of(meshes, marked)
    near, far = found.transfer("s1"), found.transfer("s3")
    like_s0 = [
        np.linalg.norm(t.positions[0] - centres(m, (3,))["lm3"]) for t, m in ((near, meshes[1]), (far, meshes[3]))
    ]
    assert like_s0[0] < 0.4 * like_s0[1]
    one = MarkedSpecimens.of(meshes, {"s0": marked["s0"]})
    radii = [one.transfer(f"s{k}").radius_90[0] / rms_size(meshes[k].vertices) for k in (1, 3, 2)]
    assert radii[0] < radii[1] < radii[2]


@pytest.mark.parametrize("suggested", [False, True])
def test_regions_contain_nine_tenths_of_landmarks_that_move_with_the_shape(suggested: bool) -> None:
    rng = np.random.default_rng(5)
    hits: list[float] = []
    for _ in range(12):
        z = 0.5 * rng.standard_normal((20, 5))
        meshes = specimens(z)
        # Each landmark moves with the shape in directions of its own, and by an error of the observer.
        at, moves = rng.choice(VERTICES, 10, replace=False), 0.02 * rng.standard_normal((10, 5, 3))
        points: list[dict[str, FloatArray]] = []
        for mesh, one in zip(meshes, z, strict=True):
            size = rms_size(mesh.vertices)
            pose = similarity(len(points), degrees=30.0 * len(points)).rotation
            shift = (np.einsum("lkd,k->ld", moves, one) + 0.002 * rng.standard_normal((10, 3))) @ pose.T
            points.append({f"{v}": mesh.vertices[v] + size * s for v, s in zip(at, shift, strict=True)})
        every = MarkedSpecimens.of(meshes, {mesh.name: p for mesh, p in zip(meshes, points, strict=True)})
        bare = MarkedSpecimens.of(meshes, {})
        chosen = [n for n, _ in bare.suggest(4)] if suggested else [f"s{k}" for k in rng.choice(20, 4, replace=False)]
        few = MarkedSpecimens.of(meshes, {name: points[int(name[1:])] for name in chosen})
        for k, mesh in enumerate(meshes):
            if mesh.name not in chosen:
                found = few.transfer(mesh.name)
                truth = every.landmarks[k].interpolate(mesh.vertices)
                hits += list(np.linalg.norm(found.positions - truth, axis=1) <= found.radius_90)
    assert 0.85 < np.mean(hits) < 0.97


def test_a_check_names_swapped_and_displaced_landmarks_and_no_others() -> None:
    meshes = drawn(6)
    rng = np.random.default_rng(2)
    marked: Marks = {
        mesh.name: {n: p + 0.3 * rng.standard_normal(3) for n, p in centres(mesh, (3, 70, 200, 400, 500)).items()}
        for mesh in meshes
    }
    assert not [one for one in MarkedSpecimens.of(meshes, marked).check() if one.finding]
    s1, s4 = marked["s1"], marked["s4"]
    s1["lm70"], s1["lm200"] = s1["lm200"], s1["lm70"]
    s4["lm3"] = meshes[4].vertices[np.asarray(meshes[4].faces)[100]].mean(axis=0)
    found = {
        (one.specimen, one.landmark): one.finding for one in MarkedSpecimens.of(meshes, marked).check() if one.finding
    }
    assert found == {
        ("s1", "lm70"): "swapped with lm200", ("s1", "lm200"): "swapped with lm70", ("s4", "lm3"): "outlier",
    }  # fmt: skip


def test_the_first_suggestion_is_the_medoid_and_the_next_lies_where_none_is_marked() -> None:
    z = 0.05 * np.random.default_rng(0).standard_normal((9, 5))
    z[6:] += 2.0
    meshes = specimens(z)
    bare = MarkedSpecimens.of(meshes, {})
    assert bare.suggest(1)[0][0] == f"s{bare.distance.sum(axis=0).argmin()}"
    names = [name for name, _ in MarkedSpecimens.of(meshes, {"s0": centres(meshes[0], (3,))}).suggest(20)]
    assert names[0] in {"s6", "s7", "s8"} and sorted(names) == [f"s{k}" for k in range(1, 9)]
    shares = [share for _, share in bare.suggest(9)]
    assert shares == sorted(shares, reverse=True) and shares[-1] == 0


def test_landmarks_are_doubtful_where_the_scan_shows_nothing_or_lies_elsewhere() -> None:
    meshes = drawn(3)
    marked = {"s0": centres(meshes[0], (3, 400))}
    hidden = np.ones(VERTICES, dtype=np.bool_)
    hidden[np.asarray(meshes[1].faces)[3]] = False
    meshes[1] = replace(meshes[1], observed=hidden)
    specimens = MarkedSpecimens.of(meshes, marked)
    assert specimens.transfer("s1").reasons == ("unobserved", "")
    away = meshes[2].with_vertices(meshes[2].vertices + 0.3 * rms_size(meshes[2].vertices))
    assert "off_scan" in specimens.transfer("s2", away).reasons
    finer = specimens.transfer("s2", meshes[2])
    assert finer.reasons == ("", "") and finer.on_scan.distance_mm.max() < 1e-9


def test_landmarks_of_another_specimen_or_of_none_are_refused() -> None:
    meshes = drawn(3)
    with pytest.raises(InputError, match=r"s0: landmark 'lm3' lies .* another specimen"):
        MarkedSpecimens.of(meshes, {"s0": centres(meshes[2], (3, 70))})
    with pytest.raises(InputError, match="No surface is named x"):
        MarkedSpecimens.of(meshes, {"x": {}})
    with pytest.raises(InputError, match="no other specimen is marked"):
        MarkedSpecimens.of(meshes, {"s0": centres(meshes[0], (3,))}).transfer("s0")
    with pytest.raises(InputError, match="mark at least two"):
        MarkedSpecimens.of(meshes, {"s0": centres(meshes[0], (3,))}).check()
