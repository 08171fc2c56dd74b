"""Models of B-spline surfaces: what they refuse, holes, their file, and the command that builds them."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import Delaunay

from shapespace import cli
from shapespace.errors import InputError, MeshError, ModelFileError
from shapespace.io.containers.hdf5 import read_hdf5, write_hdf5
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.build_model import fill_holes
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, IntArray, Mesh
from synthetic_shapes import similarity, training_meshes


def sheets(count: int = 12, vertices: int = 500) -> tuple[FloatArray, IntArray]:
    """Smooth sheets (N, V, 3), mm, that vary in two ways, and their triangles."""
    rng = np.random.default_rng(0)
    u = rng.random((vertices, 2))
    faces = Delaunay(u).simplices.astype(np.int32)
    p, q = u[faces[:, 1]] - u[faces[:, 0]], u[faces[:, 2]] - u[faces[:, 0]]
    turned = p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] < 0
    faces[turned] = faces[turned][:, ::-1]
    x, y = u.T
    z = rng.standard_normal((count, 2))
    height = 40 * np.exp(-4 * ((x - 0.5) ** 2 + (y - 0.5) ** 2))
    heights = height + 6 * z[:, :1] * np.sin(2 * x + y) + 4 * z[:, 1:] * np.cos(3 * y)
    shapes = np.stack(
        [np.broadcast_to(100 * x, heights.shape), np.broadcast_to(120 * y, heights.shape), heights], axis=2
    )
    return shapes, faces


def meshes(count: int = 12) -> list[Mesh]:
    shapes, faces = sheets(count)
    return [Mesh(shape, faces, name=f"sheet_{i}.ply") for i, shape in enumerate(shapes)]


def with_holes(radius: float = 25.0) -> tuple[FloatArray, FloatArray, IntArray]:
    """Return sheets in random poses with a hole each, the same without holes, and their triangles."""
    shapes, faces = sheets()
    rng = np.random.default_rng(1)
    whole = np.stack([similarity(i, 30.0, 1.0, 50.0).apply(shape) for i, shape in enumerate(shapes)])
    holed = whole.copy()
    for i in range(len(shapes)):
        at = shapes[i][rng.integers(len(shapes[i]))]
        holed[i][np.linalg.norm(shapes[i] - at, axis=1) < radius] = np.nan
    return holed, whole, faces


def build(**options: object) -> ShapeModel:
    return ShapeModel.fit(meshes(), modes=2, representation="bspline", control_points=(8, 8), **options)


def test_holes_are_filled_near_the_truth_and_what_was_there_stays() -> None:
    holed, whole, faces = with_holes()
    filled = holed.copy()
    fill_holes(filled, faces, [f"sheet {i}" for i in range(len(holed))])
    missing = np.isnan(holed).any(axis=2)
    assert missing.mean() > 0.08
    np.testing.assert_array_equal(filled[~missing], holed[~missing])
    assert np.linalg.norm(filled - whole, axis=2)[missing].mean() < 0.5


def test_a_model_of_shapes_with_holes_is_nearly_that_of_the_whole_shapes() -> None:
    holed, whole, faces = with_holes()
    a, b = (
        ShapeModel.fit(
            [Mesh(x, faces, name=f"{i}") for i, x in enumerate(shapes)],
            modes=2,
            representation="bspline",
            control_points=(10, 10),
        )
        for shapes in (holed, whole)
    )
    assert np.linalg.norm(a.mean_vertices - b.mean_vertices, axis=1).mean() < 0.5
    np.testing.assert_allclose(a.stddev, b.stddev, rtol=0.05)
    cosines = np.linalg.svd(a.vertex_basis.T @ b.vertex_basis, compute_uv=False)
    assert cosines.min() > 0.98


def test_a_vertex_that_nobody_has_and_a_shape_of_which_little_is_there_are_refused() -> None:
    holed, _, faces = with_holes()
    nowhere = holed.copy()
    nowhere[:, 17] = np.nan
    with pytest.raises(InputError, match="Vertex 17 is missing in every mesh"):
        fill_holes(nowhere, faces, ["x"] * len(holed))
    holed[3, 2:] = np.nan
    with pytest.raises(InputError, match="third: too few of its vertices are observed"):
        fill_holes(holed, faces, ["a", "b", "c", "third", *["d"] * 8])


def test_infinite_vertices_are_refused() -> None:
    given = meshes()
    x = np.array(given[2].vertices)
    x[5, 1] = np.inf
    given[2] = given[2].with_vertices(x)
    for representation in ("vertices", "bspline"):
        with pytest.raises(InputError, match=r"sheet_2\.ply has vertices that are not finite"):
            ShapeModel.fit(given, representation=representation)


def test_what_cannot_be_had_is_refused_in_one_sentence() -> None:
    with pytest.raises(InputError, match="no representation 'splines'; choose one of vertices, bspline"):
        ShapeModel.fit(meshes(), representation="splines")
    with pytest.raises(InputError, match="Only B-spline surfaces have control points"):
        ShapeModel.fit(meshes(), control_points=(8, 8))
    with pytest.raises(InputError, match="more than the 500 vertices"):
        ShapeModel.fit(meshes(), representation="bspline")
    with pytest.raises(InputError, match="4 to 64 control points"):
        ShapeModel.fit(meshes(), representation="bspline", control_points=(2, 2))
    with pytest.raises(MeshError, match="no faces"):
        ShapeModel.fit([Mesh(m.vertices) for m in meshes()], representation="bspline", control_points=(8, 8))
    with pytest.raises(MeshError, match="closed"):
        ShapeModel.fit(training_meshes(), representation="bspline", control_points=(8, 8))


@pytest.mark.parametrize("modes", ["auto", 0.98, None])
def test_modes_are_chosen_as_for_vertices(modes: object) -> None:
    rng = np.random.default_rng(2)
    noisy = [m.with_vertices(m.vertices + 0.5 * rng.standard_normal(m.vertices.shape)) for m in meshes()]
    model = ShapeModel.fit(noisy, modes=modes, representation="bspline", control_points=(8, 8))
    assert model.n_modes == {"auto": 2, None: 11}.get(modes, model.n_modes)
    assert model.cumulative_variance[-1] < 1.0


def test_detail_of_the_mean_is_kept_where_asked_for() -> None:
    shapes, faces = sheets()
    rough = 2.0 * np.random.default_rng(3).standard_normal(shapes.shape[1:])
    given = [Mesh(shape + rough, faces) for shape in shapes]
    smooth, detailed = (
        ShapeModel.fit(given, modes=2, align=False, representation=name, control_points=(8, 8))
        for name in ("bspline", "bspline-detail")
    )
    mean = np.mean([m.vertices for m in given], axis=0)
    assert np.linalg.norm(smooth.mean_vertices - mean, axis=1).mean() > 1.0
    assert np.linalg.norm(detailed.mean_vertices - mean, axis=1).max() < 1e-9
    np.testing.assert_allclose(smooth.vertex_basis, detailed.vertex_basis, atol=1e-6)


def test_the_file_holds_control_points_that_scipy_can_evaluate(tmp_path: Path) -> None:
    from scipy.interpolate import BSpline

    model = build()
    model.save(tmp_path / "model.h5")
    arrays, attributes = read_hdf5(tmp_path / "model.h5")
    assert attributes["representation"] == "bspline"
    told = (Path(__file__).resolve().parents[2] / "docs" / "model-file.md").read_text("utf-8")
    assert all(f"| `{name}` |" in told for name in arrays)
    m, n = arrays["control_counts"]
    assert (m, n, arrays["degree"]) == (8, 8, 3)
    knots = np.concatenate([np.zeros(3), np.linspace(0, 1, 8 - 2), np.ones(3)])
    B = [BSpline.design_matrix(arrays["uv"][:, k], knots, 3).toarray() for k in range(2)]
    b = 2.0 * model.stddev
    net = (arrays["mean"] + arrays["basis"] @ b).reshape(m, n, 3)
    np.testing.assert_allclose(np.einsum("vi,vj,ijc->vc", *B, net), model.reconstruct(b), atol=1e-9)


@pytest.mark.parametrize(
    "change",
    [
        {"uv": None},
        {"uv": np.full((500, 2), 2.0)},
        {"control_counts": np.array([8, 9])},
        {"control_counts": np.array([8])},
        {"degree": np.array(2)},
        {"uv": np.zeros((3, 2))},
    ],
    ids=str,
)
def test_a_file_whose_parts_do_not_belong_together_is_refused(change: dict, tmp_path: Path) -> None:
    build().save(tmp_path / "model.h5")
    arrays, attributes = read_hdf5(tmp_path / "model.h5")
    del attributes["content_hash"]
    kept = {k: v for k, v in {**arrays, **change}.items() if v is not None}
    write_hdf5(tmp_path / "other.h5", kept, attributes)
    with pytest.raises(ModelFileError, match=r"other\.h5"):
        ShapeModel.load(tmp_path / "other.h5")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    holed, _, faces = with_holes()
    (tmp_path / "sheets").mkdir()
    for i, shape in enumerate(holed):
        write_mesh(tmp_path / "sheets" / f"sheet_{i:02d}.ply", Mesh(shape, faces))
    return tmp_path


def test_build_makes_a_model_of_meshes_with_holes_and_info_tells_it(
    folder: Path, capsys: pytest.CaptureFixture
) -> None:
    model = str(folder / "model.h5")
    argv = ["build", str(folder / "sheets"), "-o", model, "--representation", "bspline", "--control-points", "10x8"]
    assert cli.main([*argv, "--modes", "2", "--json", "--quiet"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["representation"], facts["control_points"]) == ("bspline", [10, 8])
    assert cli.main(["info", model]) == 0
    assert "control_points: " in capsys.readouterr().out
    assert ShapeModel.load(model).n_modes == 2


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--representation", "bspline", "--control-points", "24"], "must be two integers such as 24x24"),
        (["--representation", "bspline", "--control-points", "8x8x8"], "must be two integers such as 24x24"),
        (["--representation", "bspline", "--control-points", "-8x8"], "expected one argument|two integers"),
        (["--representation", "bspline", "--control-points", "2x2"], "4 to 64 control points along each"),
        (["--representation", "bspline", "--control-points", "64x64"], "more than the 500 vertices"),
        (["--control-points", "8x8"], "Only B-spline surfaces have control points"),
        (["--representation", "spline"], "invalid choice: 'spline'"),
        (["--representation", "bspline", "--min-seen", "0.5"], "--min-seen is for models of vertices"),
    ],
    ids=lambda x: " ".join(x) if isinstance(x, list) else "",
)
def test_wrong_arguments_end_with_2_and_one_sentence(
    folder: Path, capsys: pytest.CaptureFixture, options: list[str], said: str
) -> None:
    argv = ["build", str(folder / "sheets"), "-o", str(folder / "model.h5"), "--quiet", *options]
    try:
        code = cli.main(argv)
    except SystemExit as stopped:
        code = stopped.code
    assert code == 2
    assert re.search(said, capsys.readouterr().err)
    assert not (folder / "model.h5").exists()
