"""Shapes that do not fit into memory, prepared for PCA: read one by one, aligned by passes over one file.

The file contains each shape as its difference from a template, in single precision: first in a pose near that of the
template, then, when the poses are known, aligned and about the mean. Nothing else grows with the number of shapes but
the poses, 96 bytes each.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Generator, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from filelock import lock_descriptor

from shapespace.errors import FileError, FileFormatError, InputError
from shapespace.geometry.normals import without_estimates
from shapespace.geometry.procrustes import (
    Gauge,
    Poses,
    Streamed,
    align_streamed,
    centroid_size,
    check_alignment,
    scale_to_tangent_streamed,
)
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.containers.archives import kept_arrays, write_arrays
from shapespace.io.containers.row_spill import Spill
from shapespace.io.files import make_folder, remove_file, sha256_of_file, write_error, write_text
from shapespace.io.memory_cache import available_bytes
from shapespace.model.choose_modes import number_of_modes, rounding_mm, sample_shapes
from shapespace.model.pca import ALL_EQUAL, Modes, PrincipalComponents, checked_large_modes, principal_components
from shapespace.model.training_shapes import TrainingShapes
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, common_faces

Log: TypeAlias = Callable[[str], None]
_SHAPES, _START, _POSES, _ALIGNED = "shapes.f32", "start.npz", "poses.npz", "aligned"
_IDENTITY, _LOCK = "identity.txt", "lock"
_KEPT = "shapes.npz"
# copies of the meshes in memory during a build, the same when modes are chosen; share of the free memory to use
_COPIES, _COPIES_TO_CHOOSE, _MOST_OF_MEMORY = 2.0, 4.5, 0.8
_SAMPLE_BYTES = 256 << 20  # bytes of the rows that are read to estimate the variance
_TOLD_EVERY = 200  # meshes between two progress messages
_ROUNDING = 64 * float(np.finfo(float).eps)


class Meshes(Protocol):
    """Meshes that may be loaded on access: a list, or any object with a length and items."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Mesh: ...


@dataclass(frozen=True)
class Scratch:
    """Folder with the data from which a build that was killed continues; it is removed when the build is finished.

    Args:
        folder: working folder, used by one build only.
        identity: identity of the meshes and settings; kept data of another identity are removed.
    """

    folder: Path
    identity: str


@dataclass(frozen=True, eq=False)
class KeptShapes:
    """The aligned shapes of a model, next to its file, to which others can be added.

    Args:
        folder: folder of the shapes.
        model_hash: content hash of the model.
        digest: SHA-256 of the file of shapes.
        faces: (F, 3) triangles of the shapes, or None.
        template: (V, 3) mm; the shapes are stored as differences from it.
        reference: (V, 3) mm, whose orientation is the frame.
        sizes: (N,) centroid sizes of the given meshes, mm.
        gauge: gauge of the model.
        align: whether the shapes were aligned.
        alignment_vertices: indices of the vertices that determined the alignment, or None for all.
        rounding: rounding of the first mesh, mm.
    """

    folder: Path
    model_hash: str
    digest: str
    faces: IntArray | None
    template: FloatArray
    reference: FloatArray
    sizes: FloatArray
    gauge: Gauge
    align: bool
    alignment_vertices: IntArray | None
    rounding: float

    @staticmethod
    def load(folder: Path) -> KeptShapes:
        """Return the shapes that a build kept in `folder`.

        Raises:
            FileError: there are no shapes.
            FileFormatError: the data are damaged.
        """
        path = folder / _KEPT
        if not path.is_file():
            raise FileError(
                f"There are no shapes in {folder}, so none can be added to them; build the model again with "
                "--keep-shapes (keep_shapes), which keeps them there."
            )
        try:
            arrays = kept_arrays(path) or {}
            header = json.loads(str(arrays["header"]))
            shape = arrays["template"].shape
            if len(shape) != 2 or shape[1] != 3 or arrays["reference"].shape != shape or arrays["sizes"].ndim != 1:
                raise ValueError
            return KeptShapes(
                folder=folder,
                model_hash=str(header["model_hash"]),
                digest=str(header["digest"]),
                faces=arrays.get("faces"),
                template=arrays["template"],
                reference=arrays["reference"],
                sizes=arrays["sizes"],
                gauge=cast(Gauge, header["gauge"]),
                align=bool(header["align"]),
                alignment_vertices=arrays.get("alignment_vertices"),
                rounding=float(header["rounding"]),
            )
        except (ValueError, KeyError, TypeError) as error:
            raise FileFormatError(
                f"{path} is damaged; build the model again with --keep-shapes (keep_shapes)."
            ) from error

    def save(self) -> None:
        """Write all data except the shapes themselves to `folder`.

        Raises:
            FileError: the disk is full.
        """
        header = {name: getattr(self, name) for name in ("model_hash", "digest", "gauge", "align", "rounding")}
        arrays = {"template": self.template, "reference": self.reference, "sizes": self.sizes}
        optional = {"faces": self.faces, "alignment_vertices": self.alignment_vertices}
        there = {name: array for name, array in optional.items() if array is not None}
        write_arrays(self.folder / _KEPT, {**arrays, **there, "header": np.array(json.dumps(header))})

    def check(self) -> None:
        """Raise if the shapes have changed since they were kept.

        Raises:
            FileError: they cannot be read.
            FileFormatError: they have changed.
        """
        if sha256_of_file(self.folder / _SHAPES) != self.digest:
            raise FileFormatError(
                f"{self.folder / _SHAPES} is damaged: it does not match its checksum; copy it again, or build the "
                "model again with --keep-shapes (keep_shapes)."
            )

    def opened(self) -> Spill:
        """Return the shapes.

        Raises:
            FileError: they cannot be read.
            FileFormatError: the file is truncated.
        """
        return Spill(self.folder / _SHAPES, len(self.sizes), self.template.size, new=False)


@dataclass(frozen=True, eq=False)
class AlignedShapes:
    """Aligned shapes on the disk, with their poses and settings.

    Args:
        shapes: N rows of 3V numbers about `training.template`.
        training: the other data of the shapes; its folder and model are not yet set.
        passes: folder where the passes of the PCA are kept; None keeps nothing.
    """

    shapes: Spill
    training: KeptShapes
    passes: Path | None

    def components(self, modes: Modes, seed: int, log: Log) -> PrincipalComponents:
        """Return mean and modes, as `principal_components` does of shapes in memory.

        Raises:
            InputError: see `principal_components`, or there are too few shapes to choose the number of modes.
        """
        if modes == "auto":
            log("choosing the number of modes")
            modes = number_of_modes(modes, _sample_shapes(self.shapes, seed), seed)
        pc = principal_components(
            self.shapes,
            modes,
            seed=seed,
            passes=self.passes,
            on_pass=lambda n, share: log(f"finding the modes, pass {n} (residual {share:.0e} of the first)"),
        )
        return replace(pc, mean=pc.mean + self.training.template.reshape(-1))

    def shape(self, index: int) -> FloatArray:
        """Return the vertices (V, 3), mm, of one aligned shape."""
        return self.shapes.rows_from(index, index + 1).reshape(-1, 3) + self.training.template

    def relative_sizes(self) -> FloatArray:
        """Return sizes (N,) before alignment relative to those after it; 1 for shapes not in `TrainingShapes`."""
        sizes, chosen = np.ones(self.shapes.rows), self.training.alignment_vertices
        if self.training.align and self.training.gauge == "shape":
            for i in TrainingShapes.indices(len(sizes)):
                vertices = self.shape(int(i))
                sizes[i] = self.training.sizes[i] / centroid_size(vertices if chosen is None else vertices[chosen])
        return sizes

    def keep(self, folder: Path, model_hash: str) -> None:
        """Move the shapes to `folder`, so that later shapes can be added to them.

        Raises:
            FileError: the folder cannot be written.
        """
        make_folder(folder)
        remove_file(folder / _KEPT)
        try:
            self.shapes.close()
            shutil.move(self.shapes.path, folder / _SHAPES)
        except OSError as error:
            raise write_error(folder / _SHAPES, error) from error
        digest = sha256_of_file(folder / _SHAPES)
        replace(self.training, folder=folder, model_hash=model_hash, digest=digest).save()


def bytes_in_memory(count: int, mesh: Mesh, *, choose: bool) -> int:
    """Return the approximate number of bytes to build a model of `count` such meshes in memory.

    Args:
        count: N.
        mesh: one of the meshes.
        choose: whether the number of modes is chosen by cross-validation.
    """
    vertices = (_COPIES_TO_CHOOSE if choose else _COPIES) * mesh.vertices.nbytes
    triangles = 0 if mesh.faces is None else mesh.faces.nbytes
    return int(count * (vertices + triangles) + 2 * 8 * count**2)


def streaming_note(meshes: Meshes, *, modes: Modes, out_of_core: bool | None) -> str:
    """Return why meshes must be streamed, although not requested, in a sentence; empty if they fit into memory."""
    if out_of_core is not None or len(meshes) < 2:
        return ""
    needed, free = bytes_in_memory(len(meshes), meshes[0], choose=modes == "auto"), available_bytes()
    if free is None or needed <= _MOST_OF_MEMORY * free:
        return ""
    return (
        f"{len(meshes)} meshes would take {needed / 1e9:.1f} GB of memory, more than four fifths of the free "
        "memory, so they are streamed through a file (--out-of-core)."
    )


@contextlib.contextmanager
def aligned_on_disk(
    meshes: Meshes,
    gauge: Gauge,
    *,
    align: bool,
    alignment_vertices: IntArray | None,
    scratch: Scratch | None,
    onto: KeptShapes | None,
    modes: Modes,
    log: Log,
) -> Generator[AlignedShapes]:
    """Yield the shapes of `meshes`, and before them those of `onto`, aligned in a file that is removed with the block.

    Args:
        meshes: complete meshes in correspondence.
        gauge: whether size is kept or removed, see `align_in_place`.
        align: whether to align the meshes; False uses their given poses.
        alignment_vertices: vertices that determine the alignment, see `align_in_place`.
        scratch: folder for the data from which a build that was killed continues; None takes a temporary folder and
            keeps nothing.
        onto: shapes to which the new shapes are added.
        modes: modes that will be computed; an impossible number raises before any mesh is read.
        log: function called with the current step.

    Raises:
        CorrespondenceError: the meshes differ in vertices or triangles.
        InputError: missing vertices, values that are not finite, no variation, or too few meshes.
        FileError: a mesh cannot be read, the disk is full, or another build uses the folder.
    """
    with _open_folder(scratch) as folder:
        work = _Work(folder, meshes, gauge, align, alignment_vertices, onto=onto, log=log)
        if modes != "auto":
            checked_large_modes(modes, work.count, work.first.vertices.size)
        path = folder / _SHAPES
        try:
            with work.aligned() as (shapes, training):
                yield AlignedShapes(shapes, training, None if scratch is None else folder)
        finally:
            path.unlink(missing_ok=True)


@contextlib.contextmanager
def _open_folder(scratch: Scratch | None) -> Generator[Path]:
    if scratch is None:
        with tempfile.TemporaryDirectory(prefix="shapespace-") as name:
            yield Path(name)
        return
    folder = make_folder(scratch.folder)
    with _lock_folder(folder):
        identity = folder / _IDENTITY
        if not identity.is_file() or identity.read_text("utf-8", "replace") != scratch.identity:
            _empty_folder(folder)
            write_text(identity, scratch.identity)
        try:
            yield folder
        except InputError:
            _remove_folder(folder)
            raise
        except BaseException:
            # Without a pose or a pass there is nothing to continue with.
            if not (folder / _POSES).is_file():
                _remove_folder(folder)
            raise
        _remove_folder(folder)


def _remove_folder(folder: Path) -> None:
    _empty_folder(folder)
    with contextlib.suppress(OSError):
        (folder / _LOCK).unlink()
        folder.rmdir()


def _empty_folder(folder: Path) -> None:
    for file in folder.iterdir():
        if file.name != _LOCK:
            file.unlink(missing_ok=True)


@contextlib.contextmanager
def _lock_folder(folder: Path) -> Generator[None]:
    """Lock the folder for this process; the system releases the lock even if the process is killed."""
    if os.name == "nt":  # Windows does not remove open files, which has the same effect
        yield
        return
    with (folder / _LOCK).open("w") as stream:
        is_free = True
        with contextlib.suppress(OSError):  # a file system without locks
            is_free = lock_descriptor(stream.fileno(), blocking=False)
        if not is_free:
            raise FileError(f"Another build is running in {folder}; wait for it, or give another name for the model.")
        yield


class _Work:
    """One build: the data read from the meshes, its progress, and the resulting poses."""

    def __init__(
        self,
        folder: Path,
        meshes: Meshes,
        gauge: Gauge,
        align: bool,
        alignment_vertices: IntArray | None,
        onto: KeptShapes | None,
        log: Log,
    ) -> None:
        if len(meshes) + (0 if onto is None else len(onto.sizes)) < 2:
            raise InputError(f"A shape model needs at least two meshes, not {len(meshes)}; one mesh has no variation.")
        self.folder, self.meshes, self.onto, self.log = folder, meshes, onto, log
        self.before = 0 if onto is None else len(onto.sizes)
        self.count = self.before + len(meshes)
        self.first = meshes[0] if onto is None else Mesh(onto.template, onto.faces, name="the model")
        x = self.first.vertices
        rounding = rounding_mm(np.nan_to_num(x, posinf=0.0, neginf=0.0))
        self.training = onto or KeptShapes(
            folder, "", "", self.first.faces, template=np.empty((0, 3)), reference=x, sizes=np.empty(0), gauge=gauge,
            align=align, alignment_vertices=alignment_vertices, rounding=rounding,
        )  # fmt: skip
        self.chosen = check_alignment(gauge, alignment_vertices, len(x))

    @contextlib.contextmanager
    def aligned(self) -> Generator[tuple[Spill, KeptShapes]]:
        """Yield the file of aligned shapes, and the data of the shapes: left by a killed build, or computed."""
        path, start, done = (self.folder / name for name in (_SHAPES, _START, _ALIGNED))
        poses = kept_arrays(self.folder / _POSES)
        complete = path.is_file() and path.stat().st_size == 4 * self.count * self.first.vertices.size
        near = kept_arrays(start) if complete else None
        if complete and done.is_file() and poses is not None:
            with Spill(path, self.count, self.first.vertices.size, new=False) as shapes:
                yield shapes, self._kept_shapes(poses)
            return
        remove_file(done)
        with Spill(path, self.count, self.first.vertices.size, new=near is None) as shapes:
            if near is None:
                remove_file(start)
                near = self._read_shapes(shapes)
                shapes.to_disk()
                write_arrays(start, near)
            if poses is None:
                poses = self._find_poses(shapes, near)
                write_arrays(self.folder / _POSES, poses)
            # Until the alignment is finished, the file is neither as read nor aligned.
            remove_file(start)
            self._move_shapes(shapes, near["template"], poses)
            shapes.to_disk()
            write_text(done, "")
            yield shapes, self._kept_shapes(poses)

    def _kept_shapes(self, poses: dict[str, npt.NDArray[Any]]) -> KeptShapes:
        return replace(
            self.training, folder=self.folder, model_hash="", digest="", template=poses["template"],
            sizes=poses["sizes"],
        )  # fmt: skip

    def _read_shapes(self, shapes: Spill) -> dict[str, npt.NDArray[Any]]:
        """Fill the file with shapes in poses near the template's, and return their poses and sizes."""
        if self.onto is None:
            x = self.first.vertices
            template = x - x[self.chosen].mean(axis=0) if self.training.align else x
        else:
            template = self.onto.template
        sizes, posed, bounds = np.empty(self.count), np.empty(self.count), list[FloatArray]()

        def near(index: int, vertices: FloatArray) -> FloatArray:
            sizes[index] = centroid_size(vertices[self.chosen])
            if index >= self.before:
                low, high = bounds or (vertices, vertices)
                bounds[:] = np.minimum(low, vertices), np.maximum(high, vertices)
                if self.training.align:
                    with_scale = self.training.gauge == "shape"
                    T = fit_similarity(vertices[self.chosen], template[self.chosen], with_scale=with_scale)
                    vertices = T.apply(vertices)
            posed[index] = centroid_size(vertices[self.chosen])
            return vertices - template

        self._fill_rows(shapes, near)
        largest = max((float(np.abs(bound).max()) for bound in bounds), default=0.0)
        if self.onto is None and (not bounds or float((bounds[1] - bounds[0]).max()) <= _ROUNDING * largest):
            raise InputError(ALL_EQUAL)
        if self.onto is not None:
            sizes[: self.before] = self.onto.sizes
        return {"template": template, "sizes": sizes, "posed": posed}

    def _fill_rows(self, shapes: Spill, row: Callable[[int, FloatArray], FloatArray]) -> None:
        block = np.empty((shapes.block_rows, shapes.columns))
        for start in range(0, self.count, len(block)):
            stop = min(start + len(block), self.count)
            for index, vertices in self._load_shapes(start, stop):
                block[index - start] = row(index, vertices).reshape(-1)
            shapes.write_rows(start, block[: stop - start])

    def _load_shapes(self, start: int, stop: int) -> Iterator[tuple[int, FloatArray]]:
        """Yield (index, vertices (V, 3)) of shapes, checked."""
        if self.onto is not None and start < self.before:
            with self.onto.opened() as old:
                rows = old.rows_from(start, min(stop, self.before))
            yield from enumerate(rows.reshape(len(rows), -1, 3) + self.onto.template, start)
        for index in range(max(start, self.before), stop):
            if index % _TOLD_EVERY == 0:
                self.log(f"reading mesh {index - self.before + 1} of {len(self.meshes)}")
            mesh = without_estimates(self.meshes[index - self.before])
            common_faces((self.first, mesh))
            _check_complete(mesh)
            if self.training.align:
                check_extent(mesh.vertices, mesh.name)
            yield index, mesh.vertices

    def _find_poses(self, shapes: Spill, near: dict[str, npt.NDArray[Any]]) -> dict[str, npt.NDArray[Any]]:
        """Return the poses of the shapes in the file, and their mean."""
        template: FloatArray = near["template"]
        poses = Poses(np.broadcast_to(np.eye(3), (self.count, 3, 3)).copy(), np.zeros((self.count, 3)))
        if self.training.align:
            source = Streamed(shapes.row_blocks, self.count, template, near["posed"])
            alignment, poses = align_streamed(
                source,
                self.training.gauge,
                size=float(near["sizes"].mean()),
                reference=self.training.reference,
                alignment_vertices=self.training.alignment_vertices,
                on_iteration=lambda n, moved: self.log(f"aligning, round {n} (the mean moved by {moved:.1e} mm)"),
            )
            mean = alignment.mean
            if self.training.gauge == "shape" and self.training.alignment_vertices is None:
                self.log("scaling to the tangent")
                mean = scale_to_tangent_streamed(source, mean, poses)
        else:
            summed = np.zeros(shapes.columns)
            for _, block in shapes.row_blocks():
                summed += block.sum(axis=0)
            mean = template + summed.reshape(-1, 3) / self.count
        return {"template": mean, "sizes": near["sizes"], "linear": poses.linear, "offset": poses.offset}

    def _move_shapes(self, shapes: Spill, near: FloatArray, poses: dict[str, npt.NDArray[Any]]) -> None:
        """Turn differences from the template `near` in the file into those of the posed shapes from their mean."""
        T = Poses(poses["linear"], poses["offset"])
        for start, block in shapes.row_blocks():
            vertices = block.reshape(len(block), -1, 3) + near
            shapes.write_rows(start, (T.apply(start, vertices) - poses["template"]).reshape(len(block), -1))


def check_extent(vertices: FloatArray, name: str) -> None:
    """Raise if a shape (V, 3), of which vertices may be missing, does not determine a rotation.

    Raises:
        InputError: its vertices lie on a line or coincide.
    """
    shape = vertices[~np.isnan(vertices).any(axis=1)]
    centred = shape - shape.mean(axis=0)
    extent = np.linalg.eigvalsh(centred.T @ centred)
    if extent[1] <= 1e-9 * extent[2]:
        raise InputError(f"{name}: its vertices lie on a line or coincide, so it cannot be aligned; exclude this mesh.")


def _check_complete(mesh: Mesh) -> None:
    missing: BoolArray = np.isnan(mesh.vertices)
    if missing.any():
        raise InputError(
            f"{mesh.name}: vertices are missing, and meshes that are streamed from the disk must be complete; exclude "
            "it, or build from fewer meshes in memory."
        )
    if not (np.abs(mesh.vertices) < np.finfo(np.float32).max).all():
        raise InputError(
            f"{mesh.name} has vertices that are not finite; see shapespace check, and repair or exclude this mesh."
        )


def _sample_shapes(shapes: Spill, seed: int) -> FloatArray:
    """Return shapes (N, 3V) on which the number of modes is chosen: all, or a sample of bounded size."""
    rows = sample_shapes(shapes.rows, seed)
    every = max(1, -(-8 * len(rows) * shapes.columns // _SAMPLE_BYTES))
    return np.stack([shapes.rows_from(row, row + 1).reshape(-1, 3)[::every].reshape(-1) for row in rows])
