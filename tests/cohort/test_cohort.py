"""Cohorts: coefficients stand for shapes exactly, and who cannot be compared is left out, counted or refused."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from shapespace.batch.fit_records import coefficient_row, read_record, write_coefficients
from shapespace.cohort.cohort import Cohort, FitDiagnostics, ShapeSource, with_columns
from shapespace.cohort.read import CohortConfig, read_cohort
from shapespace.cohort.table import Table
from shapespace.errors import CorrespondenceError, FileError, FileFormatError, InputError
from shapespace.geometry.procrustes import Gauge, centroid_size
from shapespace.io.files import write_text
from shapespace.io.meshes.mesh_io import read_mesh, write_mesh
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh
from stored_fits import MODES, VERTICES, model, write_fit
from synthetic_shapes import blob, blob_model, similarity, sphere, training_meshes

COUNT = 8


def pairwise(shapes: FloatArray) -> FloatArray:
    flat = shapes.reshape(len(shapes), -1)
    return np.array([np.linalg.norm(flat[i] - flat[k]) for i, k in combinations(range(len(flat)), 2)])


def all_vertices(cohort: Cohort) -> FloatArray:
    return np.stack([cohort.vertices(k) for k in range(len(cohort))])


def apart(mine: FloatArray, other: FloatArray) -> float:
    return float(np.abs(pairwise(mine) - pairwise(other)).max())


def fitted_of(given: ShapeModel, n: int = COUNT, seed: int = 0, modes: int | None = None) -> FitDiagnostics:
    b = (
        np.random.default_rng(seed).standard_normal((n, modes or given.n_modes))
        * given.stddev[: modes or given.n_modes]
    )
    return FitDiagnostics(given, b, np.full(b.shape, 0.1), ("converged",) * n, "fits")


def blank(n: int) -> tuple[tuple[str, ...], Table]:
    names = tuple(f"scan{k}" for k in range(n))
    return names, Table({}, names)


@pytest.fixture(scope="module")
def spline() -> ShapeModel:
    d, faces = sphere(300)
    used, faces = np.unique(faces[(d[faces, 2] > -0.4).all(axis=1)], return_inverse=True)
    draws = np.random.default_rng(0).standard_normal((12, 5))
    meshes = [Mesh(blob(d[used], z), faces.reshape(-1, 3), name=f"open_{k}") for k, z in enumerate(draws)]
    return ShapeModel.fit(meshes, modes=4, representation="bspline", control_points=(9, 9))


@pytest.fixture
def fits(tmp_path: Path) -> Path:
    """Ten fits by hand: two doubtful, one failed, with metadata and sizes."""
    model().save(tmp_path / "model.h5")
    statuses = {3: "doubtful", 4: "doubtful", 7: "failed"}
    for k in range(10):
        known = {"sex": "fm"[k % 2], "age": 20 + k}
        write_fit(
            tmp_path / "out", f"scan{k}", k, status=statuses.get(k, "converged"), metadata=known,
            centroid_size_mm=600.0 + 10 * k,
        )  # fmt: skip
    return tmp_path / "out"


# Shapes and coefficients


def test_distances_of_coefficients_are_those_of_shapes() -> None:
    shapes = np.stack([mesh.vertices for mesh in training_meshes(12, vertices=200)])
    cohort = Cohort.of_shapes(shapes, {}, align=False)
    assert apart(cohort.coefficients, shapes) < 1e-10
    assert np.abs(all_vertices(cohort) - shapes).max() < 1e-10
    assert np.abs(cohort.basis @ cohort.basis.T - np.eye(len(cohort.basis))).max() < 1e-12


@pytest.mark.parametrize("modes", [MODES, 2])
def test_fits_have_the_vertices_that_their_model_reconstructs(modes: int) -> None:
    given = model()
    fitted = fitted_of(given, modes=modes)
    cohort = Cohort.of_fits(fitted, *blank(COUNT), np.full(COUNT, np.nan))
    shapes = np.stack([given.reconstruct(b) for b in fitted.b])
    assert np.abs(all_vertices(cohort) - shapes).max() < 1e-10
    assert apart(cohort.coefficients, shapes) < 1e-10
    assert np.abs(fitted.z * given.stddev[:modes] - fitted.b).max() < 1e-12


def test_fits_of_splines_have_the_vertices_that_their_model_reconstructs(spline: ShapeModel) -> None:
    fitted = fitted_of(spline)
    cohort = Cohort.of_fits(fitted, *blank(COUNT), np.full(COUNT, np.nan))
    shapes = np.stack([spline.reconstruct(b) for b in fitted.b])
    assert np.abs(all_vertices(cohort) - shapes).max() < 1e-9
    assert apart(cohort.coefficients, shapes) < 1e-9


def test_a_basis_that_is_not_orthonormal_is_made_so_and_keeps_every_shape() -> None:
    given = model()
    skew = given.basis * np.array([1.0, 2.0, 0.5, 3.0])
    skew[:, 1] += 0.3 * skew[:, 0]
    bent = replace(given, basis=given.basis)
    bent.__dict__["vertex_basis"] = skew
    fitted = replace(fitted_of(given), model=bent)
    cohort = Cohort.of_fits(fitted, *blank(COUNT), np.full(COUNT, np.nan))
    shapes = given.mean_vertices + (fitted.b @ skew.T).reshape(COUNT, -1, 3)
    assert np.abs(all_vertices(cohort) - shapes).max() < 1e-10 and apart(cohort.coefficients, shapes) < 1e-10


@pytest.mark.parametrize("gauge", ["shape", "form"])
def test_in_the_form_gauge_each_shape_has_its_own_size_and_its_own_shape(gauge: str) -> None:
    given = blob_model(VERTICES, MODES, gauge)
    # A frame far from the middle of the object must not turn sizes into places.
    given = replace(given, mean=given.mean + np.array([500.0, -200.0, 50.0]))
    fitted, sizes = fitted_of(given), np.linspace(400.0, 900.0, COUNT)
    cohort = Cohort.of_fits(fitted, *blank(COUNT), sizes, "form")
    shapes = np.stack([given.reconstruct(b) for b in fitted.b])
    found = all_vertices(cohort)
    assert np.abs([centroid_size(shape) for shape in found] - sizes).max() < 1e-9
    assert np.abs(found.mean(axis=1) - given.mean_vertices.mean(axis=0)).max() < 1
    for one, other, size in zip(found, shapes, sizes, strict=True):
        scaled = (other - other.mean(axis=0)) * size / centroid_size(other)
        assert np.abs(one - one.mean(axis=0) - scaled).max() < 1e-9
    assert apart(cohort.coefficients, found) < 1e-9


def test_the_shape_gauge_divides_out_what_a_model_of_forms_holds_of_size() -> None:
    given = blob_model(VERTICES, MODES, "form")
    fitted = fitted_of(given)
    cohort = Cohort.of_fits(fitted, *blank(COUNT), np.full(COUNT, np.nan))
    shapes = np.stack([given.reconstruct(b) for b in fitted.b])
    found = all_vertices(cohort)
    middle = given.mean_vertices - given.mean_vertices.mean(axis=0)
    along = (found - found.mean(axis=1, keepdims=True)).reshape(COUNT, -1) @ middle.ravel()
    assert np.ptp(along) < 1e-6 * along.mean()
    ratios = [centroid_size(one) / centroid_size(other) for one, other in zip(found, shapes, strict=True)]
    for one, other, ratio in zip(found, shapes, ratios, strict=True):
        assert np.abs((one - one.mean(axis=0)) - ratio * (other - other.mean(axis=0))).max() < 1e-9
    assert np.ptp(ratios) > 1e-3


def test_shapes_in_any_pose_become_the_same_cohort() -> None:
    shapes = np.stack([mesh.vertices for mesh in training_meshes(10, vertices=120)])
    posed = np.stack([similarity(k, degrees=90.0, scale=1.0 + 0.1 * k).apply(shape) for k, shape in enumerate(shapes)])
    sizes = [centroid_size(shape) for shape in posed]
    plain, turned = Cohort.of_shapes(shapes, {}), Cohort.of_shapes(posed, {})
    ratio = np.mean(sizes) / np.mean([centroid_size(shape) for shape in shapes])
    assert np.abs(pairwise(turned.coefficients) / ratio - pairwise(plain.coefficients)).max() < 1e-6
    assert np.abs(turned.sizes_mm - sizes).max() < 1e-9
    form = Cohort.of_shapes(posed, {}, gauge="form")
    assert np.abs([centroid_size(form.vertices(k)) for k in range(10)] - np.array(sizes)).max() < 1e-9


def test_displacements_of_some_vertices_are_those_of_the_whole() -> None:
    cohort = Cohort.of_fits(fitted_of(model()), *blank(COUNT), np.full(COUNT, np.nan))
    moved = all_vertices(cohort) - cohort.reference
    assert np.abs(cohort.displacements(slice(10, 25)) - moved[:, 10:25]).max() < 1e-12
    assert np.array_equal(cohort.vertices(cohort.coefficients[2]), cohort.vertices(2))


def test_a_part_of_a_cohort_is_that_of_the_shapes_taken() -> None:
    names, table = blank(COUNT)
    cohort = Cohort.of_fits(fitted_of(model()), names, table, np.arange(COUNT, dtype=float))
    cohort = with_columns(cohort, {"age": np.arange(COUNT) + 0.5})
    part = cohort.take([5, 1], "Two are kept.")
    assert part.names == ("scan5", "scan1") and part.notes == ("Two are kept.",) and len(part) == 2
    assert np.array_equal(part.coefficients, cohort.coefficients[[5, 1]]) and list(part.sizes_mm) == [5, 1]
    assert part.fitted is not None and np.array_equal(part.fitted.b, cohort.fitted.b[[5, 1]])  # type: ignore[union-attr]
    assert list(part.table.numbers("age")) == [5.5, 1.5]


# What is refused


def test_shapes_that_make_no_cohort_are_refused() -> None:
    shapes = np.stack([mesh.vertices for mesh in training_meshes(3, vertices=60)])
    for wrong in (shapes[:1], shapes[0], np.where(shapes > 50, np.inf, shapes)):
        with pytest.raises(InputError, match="two or more finite shapes"):
            Cohort.of_shapes(wrong, {})
    with pytest.raises(InputError, match="cells for 3 rows"):
        Cohort.of_shapes(shapes, {"age": [1, 2]})
    cohort = Cohort.of_shapes(shapes, {})
    with pytest.raises(InputError, match="row of coefficients"):
        replace(cohort, names=("a",))


def test_a_scan_that_was_copied_is_refused_by_both_its_names() -> None:
    fitted = fitted_of(model())
    twice = np.array(fitted.b)
    twice[6] = twice[2]
    with pytest.raises(InputError, match="scan2 and scan6 are the same shape up to rounding"):
        Cohort.of_fits(replace(fitted, b=twice), *blank(COUNT), np.full(COUNT, np.nan))


def test_forms_without_a_size_are_refused() -> None:
    sizes = np.full(COUNT, 500.0)
    sizes[3] = np.nan
    with pytest.raises(InputError, match="size of scan3 is not known in mm"):
        Cohort.of_fits(fitted_of(model()), *blank(COUNT), sizes, "form")


def test_who_lacks_a_value_is_refused_by_name_or_left_out_and_counted() -> None:
    names, _ = blank(COUNT)
    cells = {"age": ("1", "", "3", "4", "5", "", "7", "8"), "none": ("",) * COUNT}
    cohort = Cohort.of_fits(fitted_of(model()), names, Table(cells, names, "data.csv"), np.full(COUNT, np.nan))
    with pytest.raises(InputError, match=r"age of 2 of 8 shapes is missing \(scan1, scan5\).*--set missing=drop"):
        cohort.complete(["age"])
    kept = cohort.complete(["age"], drop_missing=True)
    assert len(kept) == 6 and "2 of 8 shapes are excluded" in kept.notes[-1] and "scan1, scan5" in kept.notes[-1]
    assert kept.complete(["age"]) is kept
    with pytest.raises(InputError, match="no shape has all"):
        cohort.complete(["none"], drop_missing=True)


# From files


def test_a_folder_of_fits_is_a_cohort_without_doubtful_and_failed_ones(fits: Path) -> None:
    cohort = read_cohort(fits)
    assert cohort.names == ("scan0", "scan1", "scan2", "scan5", "scan6", "scan8", "scan9")
    assert cohort.table.texts("sex")[:3] == ("f", "m", "f") and list(cohort.table.numbers("age"))[-1] == 29
    told = " ".join(cohort.notes)
    assert "2 of 10 fits are excluded, which are doubtful (scan3, scan4)" in told and "1 of 10" in told
    assert cohort.fitted is not None and set(cohort.fitted.status) == {"converged"}
    with_doubtful = read_cohort(fits, CohortConfig(doubtful=True))
    assert len(with_doubtful) == 9 and "doubtful" not in " ".join(with_doubtful.notes)
    for k, name in enumerate(cohort.names):
        b = np.array(read_record(fits / f"{name}.fit.json").b)
        assert np.abs(cohort.vertices(k) - model().reconstruct(b)).max() < 1e-10
        assert cohort.sizes_mm[k] == read_record(fits / f"{name}.fit.json").centroid_size_mm
    form = read_cohort(fits, CohortConfig(gauge="form"))
    assert np.abs([centroid_size(form.vertices(k)) for k in range(7)] - cohort.sizes_mm).max() < 1e-9


def test_surfaces_of_fits_are_the_same_shapes_in_another_frame(fits: Path) -> None:
    steps: list[tuple[int, int]] = []
    fitted = read_cohort(fits, CohortConfig(surfaces="fitted"), on_shape=lambda *step: steps.append(step))
    plain = read_cohort(fits)
    # The surfaces are in float32, and aligned anew.
    assert np.abs(pairwise(fitted.coefficients) - pairwise(plain.coefficients)).max() < 0.3
    assert steps[-1] == (7, 7) and fitted.fitted is not None and fitted.landmarks == dict(model().landmarks)
    with pytest.raises(InputError, match=r"contains no dense surface of scan0.*with --dense"):
        read_cohort(fits, CohortConfig(surfaces="dense"))


def test_dense_surfaces_are_the_default_where_all_fits_have_one(fits: Path) -> None:
    share = read_cohort(fits).source.explained_variance_ratio
    assert read_cohort(fits).source == ShapeSource("coefficients", MODES, share)
    assert read_cohort(fits, CohortConfig(surfaces="fitted")).source == ShapeSource("fitted", MODES, share)
    rng = np.random.default_rng(0)
    for k in (0, 1, 2, 3, 4, 5, 6, 8):  # the fit of scan7 failed
        mesh = read_mesh(fits / f"scan{k}.fitted.ply")
        detailed = mesh.with_vertices(mesh.vertices + 0.5 * rng.standard_normal(mesh.vertices.shape))
        write_mesh(fits / f"scan{k}.dense.ply", detailed)
    assert read_cohort(fits).source.kind == "coefficients"  # scan9 has none
    write_mesh(fits / "scan9.dense.ply", read_mesh(fits / "scan9.fitted.ply"))
    dense = read_cohort(fits)
    assert dense.source == ShapeSource("dense") and dense.fitted is not None
    assert read_cohort(fits, CohortConfig(surfaces="coefficients")).source.kind == "coefficients"


def test_surfaces_of_an_unknown_unit_have_no_size_to_compare(fits: Path) -> None:
    for k in range(10):
        write_fit(fits, f"scan{k}", k, mm_per_scan_unit=None)
    assert np.isnan(read_cohort(fits, CohortConfig(surfaces="fitted")).sizes_mm).all()
    for surfaces in ("fitted", "coefficients"):
        with pytest.raises(InputError, match="not known in mm"):
            read_cohort(fits, CohortConfig(surfaces=surfaces, gauge="form"))  # type: ignore[arg-type]


@pytest.mark.parametrize("column", ["file", "scan", "id"])
def test_a_table_names_fits_by_their_scans_and_tells_whom_it_lacks(fits: Path, tmp_path: Path, column: str) -> None:
    rows = "".join(f"../scans/scan{k}.ply,{k}\n" for k in (9, 0, 3)) + "stranger.ply,7\n"
    write_text(tmp_path / "data.csv", f"{column},age\n{rows}")
    cohort = read_cohort(tmp_path / "data.csv", CohortConfig(shapes=fits))
    assert cohort.names == ("scan0", "scan9") and list(cohort.table.numbers("age")) == [0, 9]
    told = " ".join(cohort.notes)
    assert "1 of 4 rows" in told and "stranger" in told
    assert "1 of 3 fits are excluded, which are doubtful (scan3)" in told
    assert "7 of 10 specimens" in told and "have no row" in told


def test_coefficients_csv_is_a_table_of_its_own_folder(fits: Path) -> None:
    rows = [coefficient_row(f"scan{k}", read_record(fits / f"scan{k}.fit.json")) for k in range(10)]
    write_coefficients(fits / "coefficients.csv", rows, MODES)
    table, folder = read_cohort(fits / "coefficients.csv"), read_cohort(fits)
    assert table.names == folder.names and np.array_equal(table.coefficients, folder.coefficients)
    assert table.table.texts("sex") == folder.table.texts("sex")
    text = (fits / "coefficients.csv").read_text()
    (fits / "coefficients.csv").write_text(text.replace("scan1,converged", "scan0,converged"))
    with pytest.raises(FileFormatError, match="was changed in row 2"):
        read_cohort(fits / "coefficients.csv")


def test_a_store_is_the_same_cohort_as_its_single_files(fits: Path) -> None:
    pytest.importorskip("pyarrow", reason="the extra `store` is not installed")
    pytest.importorskip("zarr", reason="the extra `store` is not installed")
    from shapespace.batch.store import Store

    singles = read_cohort(fits)
    assert Store(fits).compact().left == {} and not list(fits.glob("*.fit.json"))
    stored = read_cohort(fits)
    assert stored.names == singles.names and stored.notes == singles.notes
    assert np.array_equal(stored.coefficients, singles.coefficients)
    assert stored.table.texts("age") == singles.table.texts("age")


def test_fits_of_different_models_are_refused(fits: Path) -> None:
    write_fit(fits, "scan0", 0, model={"name": "other.h5", "hash": "f" * 64, "path": "../other.h5"})
    with pytest.raises(InputError, match="fits of 2 different models"):
        read_cohort(fits)


def test_a_model_that_moved_or_is_another_is_told(fits: Path) -> None:
    kept = (fits.parent / "model.h5").rename(fits.parent / "moved.h5")
    with pytest.raises(InputError, match=r"no longer at.*give it with --set model="):
        read_cohort(fits)
    assert len(read_cohort(fits, CohortConfig(model=kept))) == 7
    blob_model(VERTICES, 3).save(fits.parent / "other.h5")
    with pytest.raises(InputError, match="is not the model of the fits"):
        read_cohort(fits, CohortConfig(model=fits.parent / "other.h5"))


def test_two_fits_of_one_scan_are_refused(fits: Path) -> None:
    write_fit(fits, "again", 30, scan={"name": "scan0.ply", "hash": f"{0:064x}", "path": "../scans/scan0.ply"})
    with pytest.raises(InputError, match="again and scan0 are fits of the same scan"):
        read_cohort(fits)


def test_too_few_fits_say_why(fits: Path, tmp_path: Path) -> None:
    write_text(tmp_path / "data.csv", "file\nscan0\nscan3\nscan4\n")
    with pytest.raises(InputError, match=r"1 of its fits can be used.*doubtful \(scan3, scan4\)"):
        read_cohort(tmp_path / "data.csv", CohortConfig(shapes=fits))
    write_text(tmp_path / "data.csv", "file\nx\ny\n")
    with pytest.raises(InputError, match=r"contains no specimen of .*such as x, y; specimens scan0, scan1"):
        read_cohort(tmp_path / "data.csv", CohortConfig(shapes=fits))


def test_what_is_no_folder_or_holds_nothing_is_refused(fits: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="contains neither results of fits nor landmark files"):
        read_cohort(tmp_path / "empty")
    write_text(tmp_path / "data.csv", "file\na\n")
    with pytest.raises(InputError, match="is neither a folder nor a landmark file"):
        read_cohort(tmp_path / "data.csv", CohortConfig(shapes=tmp_path / "gone"))
    with pytest.raises((FileError, InputError)):
        read_cohort(tmp_path / "gone.csv")


def test_a_damaged_record_is_told_and_the_others_are_used(fits: Path) -> None:
    (fits / "scan1.fit.json").write_text('{"format": "shapespace fit", "b": [')
    cohort = read_cohort(fits)
    assert "scan1" not in cohort.names and len(cohort) == 6 and any("scan1" in note for note in cohort.notes)


@pytest.fixture
def meshes(tmp_path: Path) -> Callable[..., Path]:
    def write(count: int = 5, change: Callable[[int, Mesh], Mesh] = lambda _, mesh: mesh) -> Path:
        folder = tmp_path / "meshes"
        folder.mkdir()
        for k, mesh in enumerate(training_meshes(count, vertices=80)):
            write_mesh(folder / f"m{k}.ply", change(k, mesh))
        write_text(tmp_path / "data.csv", "name,age\n" + "".join(f"m{k},{k}\n" for k in range(count)))
        return tmp_path / "data.csv"

    return write


def test_meshes_in_correspondence_are_a_cohort(meshes: Callable[..., Path], tmp_path: Path) -> None:
    table = meshes()
    cohort = read_cohort(table, CohortConfig(shapes=tmp_path / "meshes"))
    shapes = np.stack([mesh.vertices for mesh in training_meshes(5, vertices=80)])
    known = Cohort.of_shapes(shapes.astype(np.float32), {})
    assert cohort.names == ("m0", "m1", "m2", "m3", "m4") and cohort.fitted is None and cohort.faces is not None
    # They were written in single precision.
    assert np.abs(pairwise(cohort.coefficients) - pairwise(known.coefficients)).max() < 1e-4
    assert list(cohort.table.numbers("age")) == [0, 1, 2, 3, 4]


def test_meshes_that_are_not_in_correspondence_are_refused(meshes: Callable[..., Path], tmp_path: Path) -> None:
    table = meshes(change=lambda k, mesh: Mesh(mesh.vertices, (mesh.faces + 1) % 80) if k == 3 else mesh)
    with pytest.raises(CorrespondenceError, match="m3 and m0 have different triangles on the same number of vertices"):
        read_cohort(table, CohortConfig(shapes=tmp_path / "meshes"))


def test_meshes_with_the_triangles_of_the_first_in_another_order_are_the_same_cohort() -> None:
    plain = training_meshes(5, vertices=80)
    turned = [Mesh(mesh.vertices, mesh.faces[::-1, ::-1]) if k else mesh for k, mesh in enumerate(plain)]
    known, cohort = (Cohort.of_meshes(own, blank(5)[1]) for own in (plain, turned))
    assert np.array_equal(cohort.coefficients, known.coefficients) and np.array_equal(cohort.faces, plain[0].faces)
    new = Cohort.of_meshes(turned[3:], blank(2)[1], onto=known)
    assert np.array_equal(new.faces, plain[0].faces)
    other = Mesh(plain[4].vertices, (plain[4].faces + 1) % 80, name="other.ply")
    with pytest.raises(CorrespondenceError, match=r"other\.ply and blob_0\.ply have different triangles"):
        Cohort.of_meshes([other], blank(1)[1], onto=known)


def cut(meshes: Sequence[Mesh], seed: int = 0, share: float = 0.15) -> list[Mesh]:
    """Return meshes of which every second lacks the vertices around one of its own."""
    rng, out = np.random.default_rng(seed), []
    for k, mesh in enumerate(meshes):
        far = np.linalg.norm(mesh.vertices - mesh.vertices[rng.integers(len(mesh.vertices))], axis=1)
        there = (far > np.quantile(far, share)) | (k % 2 == 0)
        out.append(mesh.with_vertices(np.where(there[:, None], mesh.vertices, np.nan)))
    return out


def masked(mesh: Mesh) -> Mesh:
    """Return a mesh with missing vertices as a complete one, with the mask of observed vertices."""
    whole = np.nan_to_num(mesh.vertices, nan=3.0)
    return replace(mesh, vertices=whole, observed=np.isfinite(mesh.vertices).all(axis=1))


@pytest.mark.parametrize("gauge", ["shape", "form"])
def test_missing_vertices_are_estimated_and_the_others_are_those_of_whole_shapes(gauge: Gauge) -> None:
    plain = [
        m.with_vertices(similarity(k, scale=1.0).apply(m.vertices))
        for k, m in enumerate(training_meshes(24, vertices=200))
    ]
    whole = Cohort.of_meshes(plain, blank(24)[1], gauge)
    cohort = Cohort.of_meshes(cut(plain), blank(24)[1], gauge)
    assert cohort.observed is not None and cohort.analysed is None
    assert np.allclose(cohort.estimated_share, np.where(np.arange(24) % 2, 0.15, 0.0))
    assert np.abs(cohort.sizes_mm / whole.sizes_mm - 1).max() < 0.01
    spread = np.sqrt(((all_vertices(whole) - whole.reference) ** 2).sum(axis=2).mean())
    off = np.linalg.norm(all_vertices(cohort) - all_vertices(whole), axis=2)
    assert off[cohort.observed].mean() < 0.05 * spread and off[~cohort.observed].mean() < 0.35 * spread
    part = cohort.take([1, 3, 5])
    assert part.observed.shape == (3, 200) and np.allclose(part.estimated_share, 0.15)


def test_meshes_with_a_mask_are_those_with_missing_vertices() -> None:
    holed = cut(training_meshes(12, vertices=120))
    one, other = (Cohort.of_meshes(given, blank(12)[1]) for given in (holed, [masked(mesh) for mesh in holed]))
    np.testing.assert_array_equal(one.observed, other.observed)
    np.testing.assert_array_equal(one.coefficients, other.coefficients)


def test_vertices_that_few_shapes_observe_carry_no_variation() -> None:
    plain = training_meshes(12, vertices=200)
    seldom = plain[0].vertices[:, 0] > np.quantile(plain[0].vertices[:, 0], 0.9)
    holed = [m.with_vertices(np.where((seldom & (k > 4))[:, None], np.nan, m.vertices)) for k, m in enumerate(plain)]
    for meshes in (holed, [masked(mesh) for mesh in holed]):
        cohort = Cohort.of_meshes(meshes, blank(12)[1])
        assert cohort.analysed is not None
        np.testing.assert_array_equal(cohort.analysed, ~seldom)
        assert np.abs(cohort.displacements(slice(0, 200))[:, seldom]).max() < 1e-9
        assert (cohort.observed_share[seldom] == 0).all() and (cohort.observed_share[~seldom] >= 0.5).all()
        near = np.linalg.norm(cohort.reference[seldom] - cohort.reference[~seldom].mean(axis=0), axis=1)
        assert near.max() < 3 * np.linalg.norm(cohort.reference - cohort.reference.mean(axis=0), axis=1).mean()


def test_a_vertex_that_nobody_observes_lies_between_its_neighbours() -> None:
    plain = training_meshes(6, vertices=200)
    shapes = np.stack([mesh.vertices for mesh in plain])
    shapes[:, 17] = np.nan
    cohort = Cohort.of_shapes(shapes, {}, faces=plain[0].faces)
    around = np.unique(plain[0].faces[(plain[0].faces == 17).any(axis=1)])
    np.testing.assert_allclose(
        cohort.reference[17], cohort.reference[around[around != 17]].mean(axis=0), rtol=0, atol=1e-3
    )


def test_a_new_shape_with_missing_vertices_is_completed_by_the_population() -> None:
    plain = training_meshes(30, vertices=200)
    population = Cohort.of_meshes(plain[:25], blank(25)[1])
    new = [m.with_vertices(similarity(k, degrees=60.0).apply(m.vertices)) for k, m in enumerate(plain[25:])]
    whole = Cohort.of_meshes(new, blank(5)[1], onto=population)
    holed = Cohort.of_meshes(cut(new), blank(5)[1], onto=population)
    spread = np.sqrt(((all_vertices(whole) - population.reference) ** 2).sum(axis=2).mean())
    off = np.linalg.norm(all_vertices(holed) - all_vertices(whole), axis=2)
    assert off[~holed.observed].mean() < 0.35 * spread and off[holed.observed].mean() < 0.1 * spread
    assert np.abs(holed.sizes_mm / whole.sizes_mm - 1).max() < 0.01


def test_shapes_of_which_hardly_a_vertex_is_observed_are_refused_by_name() -> None:
    plain = training_meshes(4, vertices=60)
    bare = plain[2].with_vertices(np.full((60, 3), np.nan))
    with pytest.raises(InputError, match=r"blob_2\.ply: too few vertices are observed"):
        Cohort.of_meshes([*plain[:2], bare, plain[3]], blank(4)[1])
    with pytest.raises(InputError, match="No vertex is observed by 50 % of the shapes"):
        Cohort.of_meshes([bare, bare, bare, plain[3]], blank(4)[1])


def test_a_mesh_that_was_copied_is_refused(meshes: Callable[..., Path], tmp_path: Path) -> None:
    first = training_meshes(5, vertices=80)[0]
    elsewhere = similarity(3, degrees=70.0, scale=1.0)
    table = meshes(change=lambda k, mesh: first.with_vertices(elsewhere.apply(first.vertices)) if k == 4 else mesh)
    with pytest.raises(InputError, match="m0 and m4 are the same shape up to rounding"):
        read_cohort(table, CohortConfig(shapes=tmp_path / "meshes"))


def test_a_table_with_one_mesh_is_too_few(meshes: Callable[..., Path], tmp_path: Path) -> None:
    meshes()
    write_text(tmp_path / "one.csv", "name\nm0\n")
    with pytest.raises(InputError, match=r"1 of its meshes are in .*two are the least"):
        read_cohort(tmp_path / "one.csv", CohortConfig(shapes=tmp_path / "meshes"))
    with pytest.raises(InputError, match="give a CSV table of its meshes"):
        read_cohort(tmp_path / "meshes")


# Sources of shapes


@pytest.mark.parametrize("modes", [MODES, 2])
def test_coefficients_state_their_modes_and_share_of_the_variance(modes: int) -> None:
    given = model()
    cohort = Cohort.of_fits(fitted_of(given, modes=modes), *blank(COUNT), np.full(COUNT, np.nan))
    share = float((given.stddev[:modes] ** 2).sum() / given.total_variance)
    assert cohort.source == ShapeSource("coefficients", modes, share)
    assert str(cohort.source) == f"coefficients, {modes} modes, {100 * share:.0f} % of the variance"
    assert cohort.take([0, 1]).source == cohort.source


def test_the_order_of_the_rows_of_a_table_does_not_change_a_cohort(meshes: Callable[..., Path], tmp_path: Path) -> None:
    table = meshes(12)
    heads, *rows = table.read_text().splitlines()
    cohorts: list[Cohort] = []
    for order in (rows, rows[::-1], [*rows[5:], *rows[:5]]):
        write_text(table, "\n".join([heads, *order, ""]))
        cohorts.append(read_cohort(table, CohortConfig(shapes=tmp_path / "meshes")))
    assert cohorts[0].names == tuple(f"m{k}" for k in range(12))
    for cohort in cohorts[1:]:
        assert cohort.names == cohorts[0].names and list(cohort.table.numbers("age")) == list(range(12))
        assert np.array_equal(cohort.coefficients, cohorts[0].coefficients)
