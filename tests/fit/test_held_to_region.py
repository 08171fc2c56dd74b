"""Fits that are held to a part: of the scan by a crop, of the model by a region; what lies beyond has no say."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import FileFormatError, FitError, InputError, ModelFileError
from shapespace.fit.fit_scan import FitConfig, FitResult, fit_scan
from shapespace.fit.iteration_state import UNSEEN
from shapespace.io.landmarks.landmark_io import read_region
from shapespace.model.region import ModelRegion
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import Raw, blob_model, raw_scan, similarity

MM = FitConfig(unit="mm")
MODEL = blob_model(1500)
FRONT = tuple(np.flatnonzero(MODEL.mean_vertices[:, 2] > -10.0).tolist())
Z = np.random.default_rng(8).uniform(-1.2, 1.2, (3, 5))


def scanned(k: int) -> Raw:
    return raw_scan(Z[k], similarity(k, 15.0, 1.0), vertices=4000, model_vertices=1500, noise_mm=0.2)


def swollen_behind(raw: Raw) -> Mesh:
    """Return the scan with another back: pushed out by up to 30 mm, smoothly, as a hood would be."""
    x = raw.T_scan_model.inverse().apply(raw.scan.vertices)
    out = np.clip((-25.0 - x[:, 2]) / 30.0, 0.0, 1.0)[:, None]
    return raw.scan.with_vertices(raw.T_scan_model.apply(x + 30.0 * out * x / np.linalg.norm(x, axis=1)[:, None]))


def rms_mm(result: FitResult, truth: FloatArray, vertices: object = slice(None)) -> float:
    return float(np.sqrt(((result.surface().vertices - truth)[vertices] ** 2).sum(axis=1).mean()))


def test_a_back_of_something_else_does_not_bend_the_front_of_a_fit_that_is_held_to_it() -> None:
    front = list(FRONT)
    held_mm, free_mm = [], []
    for k in range(2):
        raw = scanned(k)
        scan = swollen_behind(raw)
        held = fit_scan(MODEL, scan, replace(MM, region=FRONT))
        held_mm.append(rms_mm(held, raw.truth, front))
        free_mm.append(rms_mm(fit_scan(MODEL, scan, MM), raw.truth, front))
        assert held.status == "converged", held.reason
        assert held.distances.model_to_scan.count == len(FRONT)
        assert held.overlap_distances.model_to_scan.mean < 0.5
    assert max(held_mm) < 0.8 and min(free_mm) > 2.0 * max(held_mm), (held_mm, free_mm)


def test_the_region_of_all_vertices_gives_the_fit_of_the_whole() -> None:
    raw = scanned(2)
    whole = fit_scan(MODEL, raw.scan, MM, T_scan_model=raw.T_scan_model)
    part = fit_scan(MODEL, raw.scan, replace(MM, region=tuple(range(1500))), T_scan_model=raw.T_scan_model)
    # Modes are those of the model up to their signs; products of single precision differ by a rounding.
    np.testing.assert_allclose(part.z, whole.z, atol=2e-3)
    np.testing.assert_allclose(part.b_stddev, whole.b_stddev, rtol=0.02)
    np.testing.assert_allclose(part.surface().vertices, whole.surface().vertices, atol=0.02)
    assert part.evidence.expected_error_mm == pytest.approx(whole.evidence.expected_error_mm, rel=0.02)
    assert part.distances.model_to_scan.mean == pytest.approx(whole.distances.model_to_scan.mean, rel=0.01)


def test_what_the_region_does_not_tell_is_as_uncertain_as_before() -> None:
    raw = scanned(0)
    whole = fit_scan(MODEL, raw.scan, MM, T_scan_model=raw.T_scan_model)
    small = tuple(np.flatnonzero(MODEL.mean_vertices[:, 2] > 70.0).tolist())
    part = fit_scan(MODEL, raw.scan, replace(MM, region=small), T_scan_model=raw.T_scan_model)
    assert (part.b_stddev >= whole.b_stddev).all() and part.b_stddev.max() > 3 * whole.b_stddev.max()
    outside = np.setdiff1d(np.arange(1500), small)
    assert (part.regions[outside] == UNSEEN).all() and (part.regions[list(small)] != UNSEEN).any()
    assert part.landmark_stddev_mm is not None and set(part.landmark_stddev_mm) == {"tip"}
    assert any(note.startswith("Restricted to the region of") for note in part.notes)


def test_one_coefficient_vector_stands_for_the_same_shape_in_part_and_whole() -> None:
    part = ModelRegion.of(MODEL, FRONT)
    z = np.array([0.5, -1.0, 0.7, 0.2, -0.4])
    np.testing.assert_allclose(
        part.model.reconstruct(z * part.model.stddev),
        MODEL.reconstruct(part.to_b(z * part.model.stddev, MODEL))[list(FRONT)],
        atol=1e-9,
    )


def test_the_papers_method_is_held_too() -> None:
    raw = scanned(1)
    result = fit_scan(MODEL, raw.scan, FitConfig("paper", unit="mm", region=FRONT, max_iterations=30))
    assert len(result.b) == MODEL.n_modes and result.distances.model_to_scan.count == len(FRONT)


def test_fewer_coefficients_are_reported_where_asked_for() -> None:
    raw = scanned(1)
    result = fit_scan(MODEL, raw.scan, replace(MM, region=FRONT, modes=3))
    assert len(result.b) == len(result.b_stddev) == len(result.z) == 3


@pytest.mark.parametrize(
    ("region", "said"),
    [("nose", "no region 'nose' \\(it has front\\)"), ((0, 1500), "from 0 to 1499"), ((0,), "No triangle")],
)
def test_a_region_that_cannot_be_is_refused(region: str | tuple[int, ...], said: str) -> None:
    model = replace(MODEL, regions={"front": np.array(FRONT)})
    with pytest.raises(InputError, match=said):
        fit_scan(model, scanned(0).scan, replace(MM, region=region))


def test_a_dense_stage_is_not_held_to_a_region() -> None:
    with pytest.raises(InputError, match="omit dense, or the region"):
        FitConfig(dense=True, region="face")


def test_regions_are_kept_in_the_file_and_old_files_have_none(tmp_path: Path) -> None:
    model = replace(MODEL, regions={"front": np.array(FRONT)[::-1], "one": [7, 7, 3]})
    model.save(tmp_path / "new.h5")
    loaded = ShapeModel.load(tmp_path / "new.h5")
    assert {name: at.tolist() for name, at in loaded.regions.items()} == {"front": list(FRONT), "one": [3, 7]}
    assert loaded.content_hash == model.content_hash != MODEL.content_hash
    MODEL.save(tmp_path / "old.h5")
    assert ShapeModel.load(tmp_path / "old.h5").regions == {}
    assert replace(model, regions={}).content_hash == MODEL.content_hash


def test_regions_that_do_not_belong_to_their_names_are_refused(tmp_path: Path) -> None:
    from shapespace.io.containers.hdf5 import read_hdf5, write_hdf5

    replace(MODEL, regions={"front": np.array(FRONT)}).save(tmp_path / "m.h5")
    arrays, attributes = read_hdf5(tmp_path / "m.h5")
    for wrong in ('{"front": 3}', '{"front": -1}', "[1]", "{}", '{"a": 0}'):
        write_hdf5(tmp_path / "bad.h5", {k: a.copy() for k, a in arrays.items()}, {**attributes, "regions": wrong})
        with pytest.raises(ModelFileError):
            ShapeModel.load(tmp_path / "bad.h5")


def test_lists_of_vertices_are_read_or_refused(tmp_path: Path) -> None:
    file = tmp_path / "r.csv"
    for text in ("vertex\n3\n5\n", "3\n# a comment\n5\n", "name,vertex\nx,3\ny,5\n"):
        file.write_text(text)
        assert read_region(file) == (3, 5)
    for text in ("", "vertex\n", "name,vertex\nx\n", "3.5\n", "-1\n", "99999999999\n"):
        file.write_text(text)
        with pytest.raises(FileFormatError, match="not a list of vertices"):
            read_region(file)


def with_clutter(raw: Raw) -> Mesh:
    """Return the scan with a chair behind it: a large slanting plate, and points far away."""
    rng = np.random.default_rng(1)
    i, j = np.meshgrid(np.arange(40), np.arange(40), indexing="ij")
    plate = np.stack([8.0 * i - 160.0, 8.0 * j - 160.0, -110.0 + 1.5 * i + rng.normal(0, 0.3, i.shape)], axis=-1)
    corner = (i * 40 + j)[:-1, :-1].ravel()
    squares = np.stack([corner, corner + 40, corner + 41, corner, corner + 41, corner + 1], axis=1).reshape(-1, 3)
    points = np.concatenate([raw.scan.vertices, raw.T_scan_model.apply(plate.reshape(-1, 3))])
    faces = np.concatenate([np.asarray(raw.scan.faces), squares + len(raw.scan.vertices)])
    return Mesh(points, faces.astype(np.int32), name="cluttered.ply")


@pytest.mark.parametrize("kind", ["sphere", "box", "landmarks"])
def test_a_crop_takes_what_stands_behind_out_of_the_fit(kind: str) -> None:
    raw = scanned(1)
    scan = with_clutter(raw)
    centre, low, high = raw.truth.mean(axis=0), raw.truth.min(axis=0) - 5.0, raw.truth.max(axis=0) + 5.0
    told = {
        "sphere": f"sphere:{','.join(map(str, centre))},{np.linalg.norm(raw.truth - centre, axis=1).max() + 3}",
        "box": f"box:{','.join(map(str, [*high, *low]))}",
        "landmarks": "landmarks:75",
    }[kind]
    marks = {name: raw.truth[at] for name, at in MODEL.landmarks.items()} if kind == "landmarks" else None
    result = fit_scan(MODEL, scan, replace(MM, crop=told, unit="auto"), landmarks=marks)
    assert result.status == "converged", result.reason
    assert rms_mm(result, raw.truth) < 1.2
    assert len(result.scan.vertices) < len(scan.vertices) and result.notes[0].startswith("Cropped to ")


def test_a_cropped_scan_keeps_its_colours_and_what_its_reader_said() -> None:
    scan = scanned(0).scan
    painted = replace(scan, colours=np.full(scan.vertices.shape, 200, np.uint8), notes=("A picture is missing.",))
    low, high = scan.vertices.min(axis=0), scan.vertices.max(axis=0) - [0.0, 0.0, 3.0]
    crop = f"box:{','.join(map(str, [*low, *high]))}"
    result = fit_scan(MODEL, painted, replace(MM, crop=crop, max_iterations=1))
    assert len(result.scan.vertices) < len(scan.vertices)
    assert result.scan.colours is not None and (result.scan.colours == 200).all()
    assert "A picture is missing." in result.notes


def test_crops_go_by_the_scans_own_unit_and_landmarks_by_millimetres() -> None:
    raw = scanned(0)
    metres = raw.scan.with_vertices(0.001 * raw.scan.vertices)
    marks = {name: 0.001 * raw.truth[at] for name, at in MODEL.landmarks.items()}
    kept = [
        len(fit_scan(MODEL, metres, FitConfig(crop=crop, max_iterations=1), landmarks=marks).scan.vertices)
        for crop in ("landmarks:40", "landmarks:60")
    ]
    off = [np.linalg.norm(raw.scan.vertices - 1000 * point, axis=1) for point in marks.values()]
    near = [int((np.min(off, axis=0) <= mm).sum()) for mm in (40, 60)]
    assert np.abs(np.array(kept) - near).max() <= 40  # corners that no triangle has any more


@pytest.mark.parametrize(
    "crop", ["ball:1,2,3,4", "sphere:1,2,3", "sphere:0,0,0,-1", "box:1,2,3,4,5,x", "landmarks:0", "sphere:0,0,0,nan"]
)
def test_a_crop_that_is_none_is_refused(crop: str) -> None:
    with pytest.raises(InputError, match="crop"):
        FitConfig(crop=crop)


def test_a_crop_that_leaves_nothing_says_where_the_scan_lies() -> None:
    raw = scanned(0)
    with pytest.raises(FitError, match="leaves 0 of its 4000 vertices, which lie between"):
        fit_scan(MODEL, raw.scan, replace(MM, crop="sphere:9999,0,0,5"))
    with pytest.raises(FitError, match="needs landmarks, and none are given"):
        fit_scan(MODEL, raw.scan, replace(MM, crop="landmarks:50"))
