"""Quality of shape spaces: known models give known values, equal ones no difference, and the rest is refused."""

import json
from pathlib import Path

import numpy as np
import pytest

from shapespace import cli
from shapespace.errors import CorrespondenceError, InputError
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.model_quality import Curve, ModelQuality, QualityConfig, measure_quality
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import Quality
from shapespace.types import Mesh
from synthetic_shapes import blob, sphere, training_meshes

FEW = QualityConfig(folds=4, samples=6)


def blobs(count: int = 12, noise_mm: float = 0.0, vertices: int = 200, turn: float = 0.0) -> list[Mesh]:
    """The same `count` blobs, on other vertices for another `turn`."""
    d, faces = sphere(vertices, turn)
    rng = np.random.default_rng(0)
    z = rng.standard_normal((count, 5))
    return [
        Mesh(blob(d, one) + noise_mm * rng.standard_normal(d.shape), faces, name=f"blob_{i}.ply")
        for i, one in enumerate(z)
    ]


def write(meshes: list[Mesh], folder: Path) -> Path:
    folder.mkdir()
    for mesh in meshes:
        write_mesh(folder / mesh.name, mesh)
    return folder


def curve(found: Curve | None) -> Curve:
    assert found is not None
    return found


@pytest.fixture(scope="module")
def measured() -> ModelQuality:
    return measure_quality(blobs(30, noise_mm=0.1), FEW)


def test_five_modes_are_told_apart_from_noise(measured: ModelQuality) -> None:
    held, whole = curve(measured.generalisation_vertices), curve(measured.compactness)
    at_five = int(np.searchsorted(held.counts, 5))
    # The noise of three coordinates is 0.1 * sqrt(8 / pi) mm long in the mean.
    assert held.mean[at_five] == pytest.approx(0.16, abs=0.05)
    assert held.mean[0] > 1.0
    # What is left out is in no mode: noise of its own is never told, however many there are.
    assert held.mean[-1] > 0.12
    assert whole.mean[at_five] > 0.98
    assert measured.supported_modes in (4, 5, 6, 7)
    assert f"support {measured.supported_modes} modes" in measured.sentences()[0]


def test_intervals_hold_the_mean_and_narrow_with_shapes(measured: ModelQuality) -> None:
    for name in ("generalisation", "generalisation_vertices", "specificity", "specificity_vertices"):
        found = curve(getattr(measured, name))
        assert (found.low <= found.mean).all() and (found.mean <= found.high).all()
    wide = curve(measure_quality(blobs(8, noise_mm=0.1), FEW).generalisation)
    narrow = curve(measured.generalisation)
    assert narrow.high[0] - narrow.low[0] < wide.high[0] - wide.low[0]


def test_the_interval_of_a_mean_covers_it_as_often_as_it_says() -> None:
    rng, hits = np.random.default_rng(3), 0
    for seed in range(200):
        found = Curve.over(rng.standard_normal((40, 1)) + 2.0, [1], seed)
        hits += bool(found.low[0] <= 2.0 <= found.high[0])
    assert 180 <= hits <= 198


def test_compactness_of_a_normal_model_approaches_that_of_the_model() -> None:
    rng = np.random.default_rng(1)
    basis = np.linalg.qr(rng.standard_normal((600, 3)))[0]
    stddev = np.array([30.0, 20.0, 10.0])
    base = 50 * rng.standard_normal((200, 3))
    meshes = [Mesh(base + (basis @ (stddev * rng.standard_normal(3))).reshape(-1, 3)) for _ in range(120)]
    found = measure_quality(meshes, QualityConfig(folds=2, samples=40, align=False, modes=3))
    assert np.allclose(curve(found.compactness).mean, np.cumsum(stddev**2) / (stddev**2).sum(), atol=0.06)
    assert (curve(found.compactness).low < np.cumsum(stddev**2) / (stddev**2).sum() + 1e-9).all()
    assert curve(found.generalisation_vertices).mean[-1] < 1e-5
    # One mode left out: what the second and third have is an error of this root mean square.
    one = curve(found.generalisation_vertices).mean[0]
    assert one == pytest.approx(np.sqrt(500 / 200) * 0.92, rel=0.2)


def test_a_wider_model_is_less_specific_and_surfaces_are_nearer_than_vertices(measured: ModelQuality) -> None:
    by_surface, by_vertices = curve(measured.specificity), curve(measured.specificity_vertices)
    assert by_vertices.mean[-1] > by_vertices.mean[0]
    assert (by_surface.mean <= by_vertices.mean).all()
    assert (curve(measured.generalisation).mean < curve(measured.generalisation_vertices).mean).all()


def test_two_equal_folders_have_differences_of_zero_and_noise_is_found_out() -> None:
    a, b = measure_quality(blobs(), FEW), measure_quality(blobs(), FEW)
    for found in a.differences(b).values():
        assert not found.mean.any() and not found.low.any() and not found.high.any()
    noisy = measure_quality(blobs(noise_mm=1.0), FEW)
    assert (a.differences(noisy)["generalisation_vertices"].low[-1:] > 0).all()
    with pytest.raises(InputError, match="same shapes in the same folds"):
        a.differences(measure_quality(blobs(10), FEW))


def test_more_shapes_help_where_they_do_and_not_where_all_is_known() -> None:
    few = measure_quality(blobs(6), QualityConfig(folds=3, samples=2))
    assert few.sentences()[-1].endswith("so more shapes would help.")
    many = measure_quality(blobs(40, noise_mm=0.1), QualityConfig(folds=2, samples=2, modes=1))
    assert "would help little" in many.sentences()[-1]


def test_correspondences_of_other_vertices_are_judged_against_the_same_scans() -> None:
    scans = blobs(10, vertices=900, turn=0.5)
    a = measure_quality(blobs(10), FEW, scans=scans)
    b = measure_quality(blobs(10, vertices=300, turn=0.3), FEW, scans=scans)
    difference = a.differences(b)["generalisation"]
    # Finer triangles lie nearer to the scans.
    assert (difference.high < 0).all()
    far = [m.with_vertices(m.vertices + 100.0) for m in scans]
    with pytest.raises(InputError, match=r"lies .* mm from its scan"):
        measure_quality(blobs(10), FEW, scans=far)
    with pytest.raises(InputError, match="one scan per mesh"):
        measure_quality(blobs(10), FEW, scans=scans[:3])


def test_a_model_alone_tells_compactness_and_what_it_makes_of_unseen_shapes() -> None:
    model = ShapeModel.fit(training_meshes(vertices=200))
    found = measure_quality(model, unseen=blobs(6))
    assert found.generalisation is None and found.specificity is None
    assert curve(found.compactness).mean[-1] == pytest.approx(1.0)
    assert curve(found.reconstruction_vertices).mean[-1] < 0.05
    with pytest.raises(CorrespondenceError, match="in correspondence with it"):
        measure_quality(model, unseen=blobs(1, vertices=150))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_too_few_meshes_are_refused(count: int) -> None:
    with pytest.raises(InputError, match=f"at least three meshes, not {count}"):
        measure_quality(blobs(3)[:count])


def test_three_meshes_are_enough_and_other_input_is_refused() -> None:
    assert measure_quality(blobs(3), QualityConfig(folds=None, samples=2)).supported_modes is None
    same = [blobs(1)[0]] * 5
    with pytest.raises(InputError, match="all equal"):
        measure_quality(same, FEW)
    with pytest.raises(CorrespondenceError):
        measure_quality([*blobs(3), blobs(1, vertices=150)[0]], FEW)
    torn = np.array(blobs(1)[0].vertices)
    torn[3] = np.inf
    with pytest.raises(InputError, match="infinite"):
        measure_quality([*blobs(4)[1:], blobs(1)[0].with_vertices(torn)], FEW)
    for wrong in ({"folds": 1}, {"samples": 1}, {"modes": 0}):
        with pytest.raises(InputError):
            QualityConfig(**wrong)


def holed(mesh: Mesh, share: float, seed: int) -> Mesh:
    """Return `mesh` with the vertices nearest to one of them missing."""
    x = mesh.vertices
    apart = np.linalg.norm(x - x[np.random.default_rng(seed).integers(len(x))], axis=1)
    return mesh.with_vertices(np.where((apart < np.quantile(apart, share))[:, None], np.nan, x))


@pytest.mark.long
def test_missing_vertices_leave_the_measures_what_they_are(measured: ModelQuality) -> None:
    found = measure_quality([holed(m, 0.15, k) for k, m in enumerate(blobs(30, noise_mm=0.1))], FEW)
    assert found.missing_share == pytest.approx(0.15, abs=0.01) and found.left_out_vertices == 0
    whole, held = curve(measured.generalisation_vertices), curve(found.generalisation_vertices)
    at_five = int(np.searchsorted(held.counts, 5))
    np.testing.assert_allclose(held.mean[: at_five + 1], whole.mean[: at_five + 1], rtol=0.3)
    specific = curve(found.specificity).mean / curve(measured.specificity).mean
    assert ((specific > 0.8) & (specific < 1.2)).all()
    assert curve(found.compactness).mean[at_five] == pytest.approx(curve(measured.compactness).mean[at_five], abs=0.03)
    assert found.supported_modes in (4, 5, 6, 7)


def test_nothing_is_measured_where_a_shape_shows_nothing() -> None:
    d, faces = sphere(200)
    model = ShapeModel.fit([Mesh(x.vertices, faces) for x in blobs(12)], modes=5)
    whole, bent = blobs(13)[-1], np.array(blobs(13)[-1].vertices)
    patch = np.linalg.norm(d - d[0], axis=1) < 0.5
    bent[patch] += 20.0
    hidden = whole.with_vertices(np.where(patch[:, None], np.nan, bent))
    told = curve(measure_quality(model, unseen=[hidden]).reconstruction_vertices).mean[-1]
    assert told < 0.01 and curve(measure_quality(model, unseen=[whole.with_vertices(bent)]).reconstruction).mean[-1] > 1


def test_vertices_that_hardly_any_shape_shows_are_left_out_and_counted() -> None:
    shapes = blobs(10)
    for k in range(8):
        x = np.array(shapes[k].vertices)
        x[:7] = np.nan
        shapes[k] = shapes[k].with_vertices(x)
    found = measure_quality(shapes, FEW, unseen=[blobs(11)[-1]])
    assert found.left_out_vertices == 7 and found.missing_share == 0.0
    assert curve(found.reconstruction_vertices).mean[-1] < 1.0


def test_the_command_writes_what_the_report_reads_and_curves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = write(blobs(), tmp_path / "a"), tmp_path / "out"
    line = ["quality", str(folder), "-o", str(out), "--folds", "3", "--samples", "4", "--quiet"]
    assert cli.main(line) == 0
    said = capsys.readouterr().out
    assert "support" in said and "mm, surface to surface, on held-out shapes" in said
    content = json.loads((out / "quality.json").read_text())
    assert content["settings"]["shapes"] == 12 and content["settings"]["folds"] == 3
    assert (out / "quality.png").read_bytes()[:4] == b"\x89PNG" and b"<svg" in (out / "quality.svg").read_bytes()
    first = (out / "quality.svg").read_bytes()
    assert cli.main([*line, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["generalisation"] == content["generalisation"]
    assert (out / "quality.svg").read_bytes() == first


def test_meshes_of_a_folder_are_one_target_as_their_folder_is(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write(blobs(), tmp_path / "a")
    options = ["-o", str(tmp_path / "out"), "--folds", "3", "--samples", "4", "--quiet", "--json"]
    measured: list[object] = []
    for targets in ([folder], sorted(folder.glob("*.ply")), sorted(folder.glob("*.ply"))[:8]):
        assert cli.main(["quality", *map(str, targets), *options]) == 0
        content = json.loads(capsys.readouterr().out)
        measured.append([content[name] for name in ("settings", "compactness", "generalisation", "specificity")])
    assert measured[0] == measured[1] != measured[2]


def test_two_folders_and_a_model_stand_side_by_side(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from shapespace.schemas import read

    a, b = write(blobs(), tmp_path / "a"), write(blobs(vertices=300, turn=0.3), tmp_path / "b")
    scans = write(blobs(vertices=600, turn=0.5), tmp_path / "scans")
    options = ["-o", str(tmp_path / "out"), "--folds", "3", "--samples", "3", "--quiet"]
    assert cli.main(["quality", str(a), str(b), "--scans", str(scans), *options]) == 0
    assert f"{b} is better" in capsys.readouterr().out
    found = read(Quality, json.loads((tmp_path / "out" / "quality.json").read_text()), "it", "again")
    assert len(found.others) == 1 and set(found.differences) == {"generalisation", "generalisation_vertices"}
    model = tmp_path / "m.h5"
    ShapeModel.fit(blobs()[:8]).save(model)
    assert cli.main(["quality", str(model), "--unseen", str(a), *options]) == 0
    told = capsys.readouterr()
    assert "only compactness is computed" in told.err and "on unseen shapes" in told.out
    (scans / "blob_3.ply").unlink()
    assert cli.main(["quality", str(a), "--scans", str(scans), *options]) == 2
    assert "has no scan of blob_3" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("targets", "said"),
    [
        (["empty"], "contains no meshes"),
        (["two"], "at least three meshes"),
        (["a", "two"], "compared shape by shape"),
        (["a", "a", "a"], "At most two"),
        (["nowhere.h5"], "nowhere.h5"),
    ],
)
def test_bad_targets_end_with_2_and_one_sentence(
    targets: list[str], said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    write(blobs(4), tmp_path / "a")
    write(blobs(2), tmp_path / "two")
    paths = [str(tmp_path / name) for name in targets]
    assert cli.main(["quality", *paths, "-o", str(tmp_path / "out"), "--samples", "2", "--quiet"]) == 2
    assert said in capsys.readouterr().err
