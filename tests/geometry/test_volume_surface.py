"""The surface of labels lies where the object is, is a closed sheet, and says what was left out."""

import tracemalloc
from typing import Any

import numpy as np
import pytest
from scipy import ndimage

from shapespace.errors import InputError
from shapespace.geometry.doctor import examine
from shapespace.geometry.volume_surface import VolumeSurface, _dilate, _squared_distance, labels_in, surface_of_volume
from shapespace.types import RAS_TO_LPS, FloatArray, LabelVolume, Mesh

pytest.importorskip("skimage", reason="the extra `volumes` is not installed")


def ball(
    radius: float, voxel_mm: Any = (1, 1, 1), *, label: int = 1, shift: float = 0.3
) -> tuple[LabelVolume, FloatArray]:
    """Return a voxelised ball with room around it, and its centre in LPS mm; the first axis is -x, so it is LAS."""
    step = np.array(voxel_mm, dtype=np.float64)
    count = np.ceil(2 * radius / step).astype(int) + 6
    centre = step * ((count - 1) / 2 + shift)
    places = np.stack(np.meshgrid(*(np.arange(n) * s for n, s in zip(count, step, strict=True)), indexing="ij"), -1)
    labels = label * (np.linalg.norm(places - centre, axis=-1) <= radius)
    affine = np.diag([*step, 1.0])
    affine[:3, 3] = 50, -20, 7
    affine[0] *= -1
    return LabelVolume(labels.astype(np.int16), affine, "ball"), (centre + np.array((50, -20, 7))) * (1, -1, 1)


def is_clean(mesh: Mesh) -> None:
    report = examine(mesh)
    assert not report.findings or all(f.level == "note" for f in report.findings), report.findings
    assert report.boundary_edges == report.non_manifold_edges == report.degenerate_triangles == 0
    assert report.inconsistent_edges == report.reversed_triangles == report.duplicate_vertices == 0


def volume_of(labels: Any, affine: Any = None) -> LabelVolume:
    return LabelVolume(
        np.asarray(labels).astype(np.uint8), np.diag([*RAS_TO_LPS, 1.0]) if affine is None else affine, "made"
    )


@pytest.mark.parametrize(
    ("voxel_mm", "mean", "high"), [((1, 1, 1), 0.06, 0.16), ((1, 1, 3), 0.2, 0.55), ((0.5, 0.5, 0.5), 0.03, 0.08)]
)
@pytest.mark.parametrize("radius", [6.0, 11.3])
def test_a_voxelised_ball_becomes_that_ball(voxel_mm: Any, mean: float, high: float, radius: float) -> None:
    volume, centre = ball(radius, voxel_mm)
    made = surface_of_volume(volume)
    off = np.abs(np.linalg.norm(made.mesh.vertices - centre, axis=1) - radius)
    assert off.mean() < mean and np.quantile(off, 0.95) < high
    assert abs(made.volume_mm3 / (4 / 3 * np.pi * radius**3) - 1) < 0.04
    is_clean(made.mesh)


def test_smoothing_comes_nearer_to_the_truth_than_none() -> None:
    volume, centre = ball(9.0)
    off = [
        np.abs(np.linalg.norm(surface_of_volume(volume, smooth=s).mesh.vertices - centre, axis=1) - 9).mean()
        for s in (0, 1.3)
    ]
    assert off[1] < 0.5 * off[0]


def test_what_is_small_does_not_shrink() -> None:
    for radius in (2.0, 3.0, 4.5):
        volume, _ = ball(radius)
        made = surface_of_volume(volume)
        assert abs(made.volume_mm3 / made.voxels - 1) < 0.08


@pytest.mark.parametrize("flip", [(1, 1, 1), (-1, 1, 1), (-1, -1, 1), (-1, -1, -1)])
def test_the_surface_looks_outward_however_the_volume_is_turned(flip: Any) -> None:
    volume, _ = ball(5.0)
    turned = LabelVolume(volume.labels, np.diag([*flip, 1.0]) @ volume.affine, "turned")
    made = surface_of_volume(turned)
    is_clean(made.mesh)
    assert np.allclose(made.mesh.vertices, surface_of_volume(volume).mesh.vertices * flip)
    assert made.volume_mm3 > 0


def test_a_sheared_affine_shears_the_surface_alone() -> None:
    volume, _ = ball(5.0)
    shear = np.eye(4)
    shear[0, 2] = 0.01
    made = surface_of_volume(LabelVolume(volume.labels, shear @ volume.affine))
    plain = surface_of_volume(volume).mesh.vertices
    expected = (plain * RAS_TO_LPS) @ shear[:3, :3].T * RAS_TO_LPS
    assert np.allclose(made.mesh.vertices, expected, atol=0.01)


@pytest.mark.parametrize("step", [(1, 1, 1), (0.7, 0.7, 2.0), (3.0, 0.5, 1.0)])
def test_distances_are_those_of_scipy_up_to_the_bound(step: Any) -> None:
    side = ndimage.gaussian_filter(np.random.default_rng(3).normal(size=(17, 13, 15)), 1.2) > -0.1
    exact = ndimage.distance_transform_edt(side, sampling=step)
    found = np.sqrt(_squared_distance(side, np.array(step), 2.5))
    assert np.allclose(found, np.minimum(exact, 2.5), atol=1e-6) and (exact > 2.5).any()


def test_growing_takes_all_neighbours() -> None:
    mask = np.random.default_rng(4).random((9, 8, 7)) < 0.05
    assert (_dilate(mask) == ndimage.binary_dilation(mask, np.ones((3, 3, 3)))).all()


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("keep_pieces", [False, True])
@pytest.mark.parametrize("smooth", [0.0, 1.3])
def test_any_voxels_become_a_closed_sheet(seed: int, keep_pieces: bool, smooth: float) -> None:
    rng = np.random.default_rng(seed)
    made = surface_of_volume(
        volume_of(rng.random((9, 8, 7)) < rng.uniform(0.2, 0.9)), smooth=smooth, keep_pieces=keep_pieces
    )
    report = examine(made.mesh)
    assert report.boundary_edges == report.non_manifold_edges == report.degenerate_triangles == 0
    assert report.inconsistent_edges == 0
    assert keep_pieces or report.components == 1


@pytest.mark.parametrize("smooth", [1.3, 4.0])
def test_nothing_that_is_labelled_vanishes_or_parts(smooth: float) -> None:
    labels = np.zeros((40, 20, 20), dtype=np.uint8)
    labels[4:14, 5:15, 5:15] = labels[26:36, 5:15, 5:15] = 1
    labels[14:26, 10, 10] = 1
    made = surface_of_volume(volume_of(labels), smooth=smooth)
    assert examine(made.mesh).components == 1 and made.left_out == 0
    assert np.ptp(made.mesh.vertices[:, 0]) > 28
    plate = np.zeros((20, 20, 9))
    plate[3:17, 3:17, 4] = 1
    thin = surface_of_volume(volume_of(plate), smooth=smooth).mesh
    is_clean(thin)
    assert (np.ptp(thin.vertices, axis=0) > (11.5, 11.5, 0.2)).all()


def test_no_part_of_the_surface_is_farther_from_the_border_of_the_labels_than_a_voxel_or_so() -> None:
    rng = np.random.default_rng(1)
    pieces, _ = ndimage.label(ndimage.gaussian_filter(rng.normal(size=(40, 40, 40)), 2.5) > 0.02)
    labels = ndimage.binary_fill_holes(pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:]))
    made = surface_of_volume(volume_of(labels), smooth=3.0)
    inside = np.pad(labels, 1)
    away = np.where(inside, ndimage.distance_transform_edt(inside), ndimage.distance_transform_edt(~inside))
    at = ndimage.map_coordinates(away, (made.mesh.vertices + 1).T, order=1, mode="nearest")
    assert at.max() < 2.25 and np.quantile(at, 0.99) < 1.75  # the voxels at the border have 1


def _two_balls() -> LabelVolume:
    places = np.stack(np.meshgrid(*[np.arange(n) for n in (40, 20, 20)], indexing="ij"), -1)
    big = np.linalg.norm(places - (10, 10, 10), axis=-1) < 7
    return volume_of(big + 2 * (np.linalg.norm(places - (30, 10, 10), axis=-1) < 4))


def _around(made: VolumeSurface) -> FloatArray:
    return (made.mesh.vertices.max(axis=0) + made.mesh.vertices.min(axis=0)) / 2


def test_a_label_is_chosen_and_several_are_one_object() -> None:
    volume = _two_balls()
    with pytest.raises(InputError, match=r"it has the labels 1, 2; choose some"):
        surface_of_volume(volume)
    assert np.allclose(_around(surface_of_volume(volume, 1)), 10, atol=0.2)
    assert np.allclose(_around(surface_of_volume(volume, [2])), (30, 10, 10), atol=0.2)
    assert surface_of_volume(volume, np.uint8(2)).labels == (2,)
    with pytest.raises(InputError, match="it has no label both; choose from 1, 2"):
        surface_of_volume(volume, "both")
    assert surface_of_volume(volume, "all").labels == surface_of_volume(volume, (2, 1)).labels == (1, 2)
    with pytest.raises(InputError, match="it has no label 3; choose from 1, 2"):
        surface_of_volume(volume, 3)


def test_smaller_pieces_are_left_out_and_said_unless_they_are_kept() -> None:
    volume = _two_balls()
    made = surface_of_volume(volume, "all")
    small = int((volume.labels == 2).sum())
    assert made.left_out == small and made.pieces == 2
    assert made.notes == (f"1 smaller piece with {small} of {made.voxels + small} voxels is omitted.",)
    kept = surface_of_volume(volume, "all", keep_pieces=True)
    assert examine(kept.mesh).components == 2 and kept.left_out == 0 and kept.notes == ("It is in 2 pieces.",)


def test_cavities_are_filled_and_said_unless_all_is_kept() -> None:
    volume, _ = ball(9.0)
    labels = np.array(volume.labels)
    middle = tuple(n // 2 for n in labels.shape)
    labels[tuple(slice(m - 2, m + 3) for m in middle)] = 0
    made = surface_of_volume(volume_of(labels))
    assert made.filled == 125 and "Cavities of 125 voxels" in made.notes[0]
    assert examine(made.mesh).components == 1
    kept = surface_of_volume(volume_of(labels), keep_pieces=True)
    assert examine(kept.mesh).components == 2 and kept.volume_mm3 < made.volume_mm3 - 80


def test_what_touches_the_border_is_closed_there_and_said() -> None:
    made = surface_of_volume(volume_of(np.ones((8, 9, 10))))
    is_clean(made.mesh)
    assert made.at_border > 0 and made.notes[0].startswith("It touches the border")
    assert abs(made.volume_mm3 / 720 - 1) < 0.03


def test_the_border_counts_where_what_is_kept_touches_it() -> None:
    labels = np.zeros((12, 12, 12))
    labels[3:9, 3:9, 3:9] = labels[0, 0, :3] = 1
    assert surface_of_volume(volume_of(labels)).at_border == 0
    assert surface_of_volume(volume_of(labels), keep_pieces=True).at_border == 3
    labels[9:, 3:9, 3:9] = 1
    assert surface_of_volume(volume_of(labels)).at_border == 36
    assert surface_of_volume(volume_of(np.pad(labels, ((20, 0), (9, 30), (0, 1))))).at_border == 36
    assert surface_of_volume(volume_of(np.pad(labels, 1))).at_border == 0
    assert surface_of_volume(volume_of(np.pad(labels, 20))).at_border == 0


def test_long_voxels_are_said() -> None:
    volume, _ = ball(9.0, (1, 1, 4))
    assert "4 times as long as wide" in surface_of_volume(volume).notes[-1]


@pytest.mark.parametrize(
    ("labels", "what"),
    [(np.zeros((5, 5, 5)), "all its voxels are 0"), (np.pad([[[1]]], 2), "only 1 voxel;"),
     (np.pad(np.ones((7, 1, 1)), 2), "only 7 connected voxels")],
)  # fmt: skip
def test_too_few_voxels_are_refused(labels: Any, what: str) -> None:
    with pytest.raises(InputError, match=what):
        surface_of_volume(volume_of(labels))


@pytest.mark.parametrize("smooth", [-1.0, np.nan, 11.0])
def test_smoothing_that_makes_no_sense_is_refused(smooth: float) -> None:
    with pytest.raises(InputError, match="smoothing must be"):
        surface_of_volume(ball(5.0)[0], smooth=smooth)


@pytest.mark.parametrize("kind", [np.uint8, np.int16, np.int64])
def test_labels_are_found_whatever_their_range(kind: Any) -> None:
    labels = np.zeros((3, 4, 5), dtype=kind)
    wanted = (3, 100) if kind == np.uint8 else (-7, 3, 100) if kind == np.int16 else (-(10**12), 3, 10**12)
    for at, label in enumerate(wanted):
        labels[at, 0, 0] = label
    assert labels_in(labels) == wanted


def _sheets(side: int) -> LabelVolume:
    """Thin sheets one above the other, joined in the middle: much surface for their voxels."""
    labels = np.zeros((side, side, side), dtype=np.uint8, order="F")
    for begin in (4, 5):
        labels[4:-4, 4:-4, begin:-4:4] = 1
    labels[side // 2 : side // 2 + 3, side // 2 : side // 2 + 3, 4:-4] = 1
    return LabelVolume(labels, np.eye(4), "sheets.nrrd")


def test_memory_is_estimated_from_the_box_and_the_border_and_refused_before_it_is_taken() -> None:
    ball = LabelVolume(np.asfortranarray(np.ones((120, 120, 120), dtype=np.uint8)), np.eye(4), "ball.nrrd")
    # A box of 130 voxels a side takes 70 MB and 134 MB besides, and its border of 86,000 vertices 35 MB.
    assert surface_of_volume(_sheets(40), smooth=0, max_memory_bytes=200_000_000).voxels
    for volume, limit, most in ((ball, 190_000_000, 10_000_000), (_sheets(100), 250_000_000, 120_000_000)):
        tracemalloc.start()
        try:
            with pytest.raises(InputError, match=r"takes about 0\.\d+ GiB of memory, over the limit .*--max-memory"):
                surface_of_volume(volume, max_memory_bytes=limit)
            assert tracemalloc.get_traced_memory()[1] < most
        finally:
            tracemalloc.stop()


def test_shapes_of_volumes_that_are_long_in_one_direction_are_looked_at_in_parts() -> None:
    for shape in ((2_000_003, 1, 1), (1, 1, 2_000_003), (3, 700_001, 1)):
        labels = np.zeros(shape, dtype=np.int64)
        labels[-1, -1, -1], labels[0, 0, 0] = -7, 2**62
        tracemalloc.start()
        try:
            assert labels_in(labels) == (-7, 2**62)
            assert tracemalloc.get_traced_memory()[1] < 40_000_000
        finally:
            tracemalloc.stop()
    with pytest.raises(InputError, match="it is an image, not a segmentation"):
        labels_in(np.arange(200_000).reshape(200, 1000, 1) * 70_000)
