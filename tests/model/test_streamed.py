"""Models of meshes that are streamed through a file are those of the same meshes in memory."""

import errno
import os
import weakref
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import CorrespondenceError, FileError, InputError
from shapespace.geometry.procrustes import (
    Poses,
    Streamed,
    align_in_place,
    align_streamed,
    centroid_size,
    scale_to_tangent,
    scale_to_tangent_streamed,
)
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.containers.row_spill import Spill
from shapespace.model import choose_modes as choosing
from shapespace.model import pca, shape_model, streamed
from shapespace.model.shape_model import ShapeModel
from shapespace.model.streamed import Scratch
from shapespace.types import FloatArray, IntArray, Mesh
from synthetic_shapes import similarity, training_meshes

SOME = np.arange(0, 200, 3, dtype=np.int32)


def posed(count: int = 24, vertices: int = 200) -> list[Mesh]:
    """Return blobs, each in a pose and of a size of its own."""
    return [
        mesh.with_vertices(similarity(i, 35.0, 0.8 + 0.01 * i).apply(mesh.vertices))
        for i, mesh in enumerate(training_meshes(count, vertices))
    ]


def furthest(a: ShapeModel, b: ShapeModel) -> float:
    """Return the largest angle, rad, between a mode of a and that of b, signs included.

    Single precision tells modes of less than a hundredth of the first one's spread less well.
    """
    told = a.stddev > 0.01 * a.stddev[0]
    return float(2 * np.arcsin(np.linalg.norm((a.basis - b.basis)[:, told], axis=0) / 2).max())


def left_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*"))


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder where temporary files go."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    return folder


@pytest.mark.parametrize("gauge", ["form", "shape"])
@pytest.mark.parametrize("carrying", [None, SOME], ids=["all", "some"])
def test_streamed_procrustes_is_that_in_memory_to_rounding(gauge: str, carrying: IntArray | None) -> None:
    shapes = np.stack([mesh.vertices for mesh in posed()])
    chosen = slice(None) if carrying is None else carrying
    template = shapes[0] - shapes[0][chosen].mean(axis=0)
    with_scale = gauge == "shape"
    near = np.stack([fit_similarity(x[chosen], template[chosen], with_scale=with_scale).apply(x) for x in shapes])
    rows = (near - template).reshape(len(near), -1)

    def blocks() -> Iterator[tuple[int, FloatArray]]:
        yield from ((start, rows[start : start + 7]) for start in range(0, len(rows), 7))

    source = Streamed(blocks, len(rows), template, np.array([centroid_size(x[chosen]) for x in near]))
    size = float(np.mean([centroid_size(x[chosen]) for x in shapes]))
    found, poses = align_streamed(source, gauge, size=size, reference=shapes[0], alignment_vertices=carrying)
    there = align_in_place(shapes, gauge, alignment_vertices=carrying)
    assert (found.iterations, found.converged) == (there.iterations, True)
    assert np.abs(found.mean - there.mean).max() < 1e-11
    assert np.abs(poses.apply(0, near) - shapes).max() < 1e-11
    if with_scale and carrying is None:
        mean = scale_to_tangent_streamed(source, found.mean, poses)
        scale_to_tangent(shapes)
        assert np.abs(poses.apply(0, near) - shapes).max() < 1e-11
        assert np.abs(mean - shapes.mean(axis=0)).max() < 1e-11


def test_poses_of_a_part_are_those_of_its_shapes() -> None:
    T = [similarity(i) for i in range(5)]
    poses = Poses(np.stack([t.scale * t.rotation for t in T]), np.stack([t.translation for t in T]))
    x = np.random.default_rng(0).standard_normal((2, 9, 3))
    assert np.allclose(poses.apply(2, x), np.stack([T[2].apply(x[0]), T[3].apply(x[1])]))


@pytest.mark.parametrize("method", ["gram", "krylov"])
@pytest.mark.parametrize(
    "options",
    [
        {"modes": 4, "gauge": "form"},
        {"modes": 4, "gauge": "shape"},
        {"modes": 0.9, "gauge": "shape"},
        {"modes": 4, "gauge": "shape", "alignment_vertices": SOME},
        {"modes": 4, "align": False},
        {"modes": "auto"},
    ],
    ids=["form", "shape", "share", "some vertices", "as they stand", "auto"],
)
def test_a_streamed_model_is_that_in_memory(
    method: str, options: dict[str, object], monkeypatch: pytest.MonkeyPatch, temporary: Path
) -> None:
    if method == "krylov":
        monkeypatch.setattr(pca, "EXACT", 10)
    meshes = posed()
    there = ShapeModel.fit(meshes, **options)
    found = ShapeModel.fit(meshes, **options, out_of_core=True)
    assert found.n_modes == there.n_modes and found.left_out == there.left_out
    assert furthest(found, there) < 1e-6
    assert np.abs(found.mean - there.mean).max() < 1e-5
    assert np.allclose(found.stddev, there.stddev, rtol=1e-6, atol=1e-7 * there.stddev[0])
    assert found.total_variance == pytest.approx(there.total_variance, rel=1e-7)
    assert found.n_training == there.n_training and np.array_equal(found.faces, there.faces)
    assert there.residuals is None and found.residuals is not None
    assert found.residuals.max() <= 1e-6 * found.stddev[0] ** 2
    assert left_in(temporary) == []


class Lazy:
    """Meshes made when they are asked for, which counts how many live at a time and how often each was made."""

    def __init__(self, count: int) -> None:
        self.shapes = [mesh.vertices for mesh in posed(count)]
        self.alive: weakref.WeakSet[Mesh] = weakref.WeakSet()
        self.most, self.made = 0, np.zeros(count, dtype=int)

    def __len__(self) -> int:
        return len(self.shapes)

    def __getitem__(self, index: int) -> Mesh:
        mesh = Mesh(np.array(self.shapes[index]), None, name=f"{index}.ply")
        self.alive.add(mesh)
        self.most = max(self.most, len(self.alive))
        self.made[index] += 1
        return mesh


def test_meshes_that_load_lazily_are_read_once_and_not_held(temporary: Path) -> None:
    few, many = Lazy(12), Lazy(40)
    for meshes in (few, many):
        ShapeModel.fit(meshes, modes=3, out_of_core=True)
        assert (meshes.made[1:] == 1).all()
    assert many.most == few.most <= 3


def test_meshes_that_load_lazily_are_read_once_where_they_fit() -> None:
    meshes = Lazy(12)
    found = ShapeModel.fit(meshes, modes=3)
    assert found.content_hash == ShapeModel.fit([meshes[i] for i in range(12)], modes=3).content_hash
    assert (meshes.made[1:] == 2).all()


def test_meshes_are_streamed_where_they_take_most_of_the_memory(
    monkeypatch: pytest.MonkeyPatch, temporary: Path
) -> None:
    meshes = posed()
    needed = streamed.bytes_in_memory(len(meshes), meshes[0], choose=False)
    assert needed > 2 * sum(mesh.vertices.nbytes for mesh in meshes)
    for free, streams in ((int(needed / 0.79), False), (int(needed / 0.81), True)):
        monkeypatch.setattr(streamed, "available_bytes", lambda free=free: free)
        assert (ShapeModel.fit(meshes, modes=3).residuals is not None) == streams
    monkeypatch.setattr(streamed, "available_bytes", lambda: None)
    assert ShapeModel.fit(meshes, modes=3).residuals is None


def with_hole(mesh: Mesh) -> Mesh:
    vertices = np.array(mesh.vertices)
    vertices[7] = np.nan
    return mesh.with_vertices(vertices)


def flat(mesh: Mesh) -> Mesh:
    return mesh.with_vertices(mesh.vertices * [1.0, 0.0, 0.0])


def far(mesh: Mesh) -> Mesh:
    return mesh.with_vertices(mesh.vertices * 1e200)


def other_triangles(mesh: Mesh) -> Mesh:
    assert mesh.faces is not None
    return Mesh(mesh.vertices, (mesh.faces + 1) % len(mesh.vertices), name=mesh.name)


def one_less(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices[:-1], None, name=mesh.name)


BAD = {
    with_hole: (InputError, "blob_5.ply: vertices are missing"),
    flat: (InputError, "blob_5.ply: its vertices lie on a line"),
    far: (InputError, "blob_5.ply has vertices that are not finite"),
    other_triangles: (CorrespondenceError, "blob_5.ply and .* have different triangles"),
    one_less: (CorrespondenceError, "blob_5.ply has 199 vertices but .* 200"),
}


@pytest.mark.parametrize("spoil", BAD, ids=lambda spoil: spoil.__name__)
@pytest.mark.parametrize("adding", [False, True], ids=["building", "adding"])
def test_a_bad_mesh_is_named_and_nothing_is_left(spoil: object, adding: bool, tmp_path: Path, temporary: Path) -> None:
    meshes = posed(8)
    model = ShapeModel.fit(meshes, modes=2, keep_shapes=tmp_path / "kept") if adding else None
    meshes[5] = spoil(meshes[5])
    kind, said = BAD[spoil]
    scratch = Scratch(tmp_path / "scratch", "1")
    with pytest.raises(kind, match=said):
        if model is None:
            ShapeModel.fit(meshes, modes=2, out_of_core=True, scratch=scratch)
        else:
            model.with_more(meshes, tmp_path / "kept", modes=2, scratch=scratch)
    assert not scratch.folder.exists() and left_in(temporary) == []


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_streamed_meshes_are_refused(count: int, temporary: Path) -> None:
    with pytest.raises(InputError, match="at least two"):
        ShapeModel.fit(posed()[:count], out_of_core=True)
    assert left_in(temporary) == []


def test_equal_streamed_meshes_are_refused(temporary: Path) -> None:
    with pytest.raises(InputError, match="all equal"):
        ShapeModel.fit(posed()[:1] * 5, out_of_core=True)
    assert left_in(temporary) == []


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"modes": 1.5}, "A share of the variance"),
        ({"landmarks": {"tip": 200}}, "'tip' is at vertex 200"),
        ({"alignment_vertices": np.array([0, 1, 200])}, "counted from 0 to 199"),
        ({"gauge": "size"}, "no gauge 'size'"),
    ],
    ids=["share", "landmark", "vertex", "gauge"],
)
def test_what_cannot_be_had_is_refused_before_the_meshes_are_read(options: dict[str, object], said: str) -> None:
    meshes = Lazy(24)
    with pytest.raises(InputError, match=said):
        ShapeModel.fit(meshes, out_of_core=True, **options)
    assert not meshes.made[1:].any()


def test_only_models_of_vertices_are_streamed() -> None:
    with pytest.raises(InputError, match="Only models of vertices"):
        ShapeModel.fit(posed(), representation="bspline", out_of_core=True)


@pytest.mark.parametrize("where", ["when it is made", "when it is written"])
def test_a_full_disk_is_one_sentence_and_the_file_is_gone(
    where: str, tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    if where == "when it is made":
        monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    else:
        monkeypatch.setattr(Spill, "_seek", full)
    with pytest.raises(FileError, match=r"shapes.f32: the disk is full; free some space and run again\.$"):
        ShapeModel.fit(posed(), out_of_core=True, scratch=Scratch(tmp_path / "scratch", "1"))
    assert left_in(tmp_path) == ["temporary"]


def interrupted(meshes: Sequence[Mesh], folder: Path, at: str) -> None:
    def stop(what: str) -> None:
        if what.startswith(at):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ShapeModel.fit(meshes, modes=4, out_of_core=True, scratch=Scratch(folder, "1"), tell=stop)


def test_after_ctrl_c_the_file_is_gone_and_the_passes_go_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pca, "EXACT", 10)
    meshes, folder = posed(60), tmp_path / "scratch"
    undisturbed = ShapeModel.fit(meshes, modes=4, out_of_core=True)
    interrupted(meshes, folder, "reading mesh 1 ")
    assert not folder.exists()
    interrupted(meshes, folder, "finding the modes, pass 2")
    assert not list(folder.glob("*.f32")) and len(list(folder.glob("pass-*"))) == 2
    told: list[str] = []

    def noted(what: str) -> None:
        told.append(what)
        # Killed now, the file would have its size and not its content.
        assert not what.startswith("reading") or not (folder / "aligned").exists()

    again = ShapeModel.fit(meshes, modes=4, out_of_core=True, scratch=Scratch(folder, "1"), tell=noted)
    assert again.content_hash == undisturbed.content_hash
    assert any(what.startswith("reading") for what in told) and not any(what.startswith("aligning") for what in told)
    assert not folder.exists()


def test_what_another_build_kept_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pca, "EXACT", 10)
    meshes, folder = posed(60), tmp_path / "scratch"
    interrupted(meshes, folder, "finding the modes, pass 2")
    others = meshes[::-1]
    found = ShapeModel.fit(others, modes=4, out_of_core=True, scratch=Scratch(folder, "2"))
    assert found.content_hash == ShapeModel.fit(others, modes=4, out_of_core=True).content_hash


@pytest.mark.skipif(os.name == "nt", reason="Windows has no flock")
def test_two_builds_do_not_share_a_folder(tmp_path: Path) -> None:
    scratch = Scratch(tmp_path / "scratch", "1")
    second: list[str] = []

    def begin(what: str) -> None:
        if not second:
            with pytest.raises(FileError, match="Another build is running") as refused:
                ShapeModel.fit(posed(), modes=2, out_of_core=True, scratch=scratch)
            second.append(str(refused.value))

    ShapeModel.fit(posed(), modes=2, out_of_core=True, scratch=scratch, tell=begin)
    assert second and not scratch.folder.exists()


@pytest.mark.parametrize("options", [{"gauge": "form"}, {"gauge": "shape"}, {"align": False}], ids=str)
@pytest.mark.parametrize("modes", [4, 0.95])
def test_adding_shapes_gives_the_model_of_all(options: dict[str, object], modes: float, tmp_path: Path) -> None:
    meshes = posed(30)
    kept, again = tmp_path / "kept", tmp_path / "again"
    old = ShapeModel.fit(meshes[:18], modes=2, keep_shapes=kept, provenance="18", licence="CC0", **options)
    some = old.with_more(meshes[18:25], kept, modes=2, keep_shapes=again)
    found = some.with_more(meshes[25:], again, modes=modes, provenance="30")
    there = ShapeModel.fit(meshes, modes=modes, **options)
    assert found.n_training == 30 and found.gauge == there.gauge
    assert (found.provenance, found.licence) == ("30", "CC0")
    assert furthest(found, there) < 1e-6
    assert np.abs(found.mean - there.mean).max() < 1e-5
    assert np.allclose(found.stddev, there.stddev, rtol=1e-6)


def test_one_shape_can_be_added(tmp_path: Path) -> None:
    meshes = posed(9)
    old = ShapeModel.fit(meshes[:8], modes=2, keep_shapes=tmp_path / "kept")
    assert furthest(old.with_more(meshes[8:], tmp_path / "kept", modes=2), ShapeModel.fit(meshes, modes=2)) < 1e-6
    with pytest.raises(InputError, match="no meshes to add"):
        old.with_more([], tmp_path / "kept")


def test_shapes_of_another_model_or_that_changed_are_not_added_to(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    old = ShapeModel.fit(posed(8), modes=2, keep_shapes=kept)
    with pytest.raises(InputError, match="those of another model"):
        old.truncate(1).with_more(posed(2), kept)
    with pytest.raises(FileError, match=r"no shapes in .*--keep-shapes"):
        old.with_more(posed(2), tmp_path / "none")
    data = bytearray((kept / "shapes.f32").read_bytes())
    data[100] ^= 1
    (kept / "shapes.f32").write_bytes(data)
    with pytest.raises(FileError, match=r"shapes\.f32 is damaged"):
        old.with_more(posed(2), kept)
    (kept / "shapes.npz").write_bytes((kept / "shapes.npz").read_bytes()[:-50])
    with pytest.raises(FileError, match=r"shapes\.npz is damaged"):
        old.with_more(posed(2), kept)


def test_the_kept_shapes_take_four_bytes_a_coordinate(tmp_path: Path) -> None:
    ShapeModel.fit(posed(8), modes=2, keep_shapes=tmp_path / "kept")
    assert left_in(tmp_path / "kept") == ["shapes.f32", "shapes.npz"]
    assert (tmp_path / "kept" / "shapes.f32").stat().st_size == 4 * 8 * 600


def test_residuals_go_with_the_model(tmp_path: Path) -> None:
    model = ShapeModel.fit(posed(), modes=4, out_of_core=True)
    model.save(tmp_path / "m.h5")
    loaded = ShapeModel.load(tmp_path / "m.h5")
    assert model.residuals is not None and loaded.residuals is not None
    assert np.array_equal(loaded.residuals, model.residuals) and loaded.content_hash == model.content_hash
    cut = loaded.truncate(2).residuals
    assert cut is not None and np.array_equal(cut, model.residuals[:2])
    with pytest.raises(InputError, match="residuals of 4 modes"):
        shape_model.dataclasses.replace(model, residuals=model.residuals[:3])


def test_the_number_of_modes_is_chosen_by_a_bounded_number_of_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    data = rng.standard_normal((60, 3)) * [9, 7, 5] @ rng.standard_normal((3, 90)) + 0.1 * rng.standard_normal((60, 90))
    whole = choosing.choose_modes(data)
    monkeypatch.setattr(choosing, "MOST_SHAPES", 40)
    rows = choosing.sample_shapes(60, 0)
    assert len(rows) == len(set(rows)) == 40 and (np.diff(rows) > 0).all()
    some = choosing.choose_modes(data)
    assert len(some.error_mm) <= len(whole.error_mm) and some.modes == whole.modes == 3
    assert np.array_equal(some.error_mm, choosing.choose_modes(data[rows]).error_mm)
    assert not np.array_equal(choosing.sample_shapes(60, 1), rows)


def test_a_streamed_choice_of_modes_looks_at_a_bounded_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Spill(tmp_path / "t.f32", 50, 90, new=True) as table:
        table.write_rows(0, np.arange(4500.0).reshape(50, 90))
        assert np.array_equal(streamed._sample_shapes(table, 0), np.arange(4500.0).reshape(50, 90))
        monkeypatch.setattr(streamed, "_SAMPLE_BYTES", 8 * 50 * 30)
        part = streamed._sample_shapes(table, 0)
    assert part.shape == (50, 30) and np.array_equal(part[0, :6], [0, 1, 2, 9, 10, 11])
