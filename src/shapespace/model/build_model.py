"""A shape model of meshes in correspondence: alignment, principal components, and the modes among them (P1-P5)."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, get_args

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.bspline import SplineSquare
from shapespace.geometry.flatten import disc_map
from shapespace.geometry.mirror_plane import mirrored_note
from shapespace.geometry.normals import without_estimates
from shapespace.geometry.procrustes import Gauge, align_shapes, centroid_size
from shapespace.io.interop import MeshLike, as_meshes
from shapespace.model.choose_modes import below_precision, made_by_alignment, modes_notes, number_of_modes, rounding_mm
from shapespace.model.missing import MIN_SEEN, CompletedShapes, ObservedMeshes, complete, missing_notes, pose_on_shared
from shapespace.model.pca import Modes, PrincipalComponents, plain_modes, principal_components
from shapespace.model.representation import Representation, Vertices, representation_named
from shapespace.model.shape_model import ShapeModel, odd_size_notes
from shapespace.model.streamed import (
    Aligned,
    KeptShapes,
    Meshes,
    Scratch,
    Tell,
    aligned_on_disk,
    refuse_without_extent,
    streaming_note,
)
from shapespace.model.training_shapes import TrainingShapes
from shapespace.types import (
    BoolArray,
    FloatArray,
    IntArray,
    Mesh,
    SurfaceLandmarks,
    common_faces,
    generator_of,
    require,
)


@dataclass(frozen=True, kw_only=True, eq=False)
class BuildConfig:
    """Options of a shape model.

    Args:
        modes: number of modes (in Python also a float below 1, a share of the variance), fewer if the meshes determine
            fewer; `all`; `auto`: cross-validation on held-out vertices, of a random sample of 2,000 meshes if there are
            more, and `all` of fewer than four.
        gauge: `form`: size is part of the modes, and fits are rigid; `shape`: size is divided out, and fits have a free
            scale.
        align: whether to align the meshes.
        alignment_vertices: indices of the vertices that determine the alignment, such as forehead and nose where
            expressions vary; None for all.
        landmarks: landmarks of the model: named points on the surface (`place_landmarks`), or name -> vertex.
        representation: what the modes move: `vertices`; `bspline`, control points of a smooth surface;
            `bspline-detail`, the same with the detail of the mean that the B-spline cannot represent.
        control_points: control points of a B-spline along each side, 4 to 64 (default 24x24).
        min_seen: remove vertices that fewer than this share of the meshes show, with their triangles and landmarks,
            from a model of vertices.
        provenance: description of the meshes, kept in the model file.
        licence: licence of the meshes, kept in the model file.
        seed: seed of the cross-validation, and of the first directions of streamed modes.
        out_of_core: stream the meshes, each loaded once and not held, through a file of single precision as large as
            they are: the same model but for that rounding, with `ShapeModel.residuals`. None does so where a model of
            vertices would need more than four fifths of the free memory.
        without_training_shapes: omit the training shapes, from which their surfaces can be reconstructed, from the
            model, for example before you share a model of people; its results are then not calibrated.

    Example:
        >>> ss.build_model(meshes, ss.BuildConfig(modes=0.9, gauge="form")).gauge
        'form'
    """

    modes: Modes = "all"
    gauge: Gauge = "shape"
    align: bool = True
    alignment_vertices: IntArray | None = None
    landmarks: Mapping[str, int] | None = None
    representation: str = "vertices"
    control_points: tuple[int, int] | None = None
    min_seen: float = MIN_SEEN
    provenance: str = ""
    licence: str = ""
    seed: int = 0
    out_of_core: bool | None = None
    without_training_shapes: bool = False

    def __post_init__(self) -> None:
        """Check each option.

        Raises:
            InputError: an option cannot be.
        """
        if self.modes != "auto":
            object.__setattr__(self, "modes", plain_modes(self.modes) or "all")
        if self.gauge not in get_args(Gauge):
            raise InputError(f"There is no gauge {self.gauge!r}; choose form (rigid) or shape (with scale).")
        representation_named(self.representation, self.control_points)
        if not isinstance(self.min_seen, Real) or not 0 <= self.min_seen <= 1:
            raise InputError(f"min_seen is a share of the meshes from 0 to 1, not {self.min_seen!r}.")
        generator_of(self.seed, "BuildConfig.seed")


def build_model(
    meshes: Meshes | Sequence[MeshLike] | str | PathLike[str],
    config: BuildConfig | None = None,
    *,
    scratch: Scratch | None = None,
    keep_shapes: Path | None = None,
    log: Tell | None = None,
) -> ShapeModel:
    """Build a shape model of meshes in correspondence, in mm (P1-P5).

    Args:
        meshes: at least two, same vertices in the same order, same triangles: a list, or anything with a length
            and items that loads a mesh when it is accessed. Items are anything that `as_mesh` takes: meshes, paths,
            arrays (V, 3) of points, or objects of other tools. A folder of meshes does too. Vertices that are
            not-a-number or not observed are missing: a model of vertices learns from the others, one of B-splines from
            filled ones.
        config: options; None for the defaults.
        scratch: for the file of streamed meshes, and for what a build that is killed goes on with; None takes the
            system's folder for temporary files and does not go on.
        keep_shapes: a folder to keep that file in, for `extend_model`; the meshes are then streamed.
        log: called with the name of each step while meshes are streamed.

    Raises:
        CorrespondenceError: the meshes differ in vertices or triangles.
        MeshError: for B-splines: the surface cannot be spread out on a square.
        InputError: too few meshes, values that are not finite, no variation, an unknown representation,
            control points that cannot be; streamed meshes with missing vertices, or for B-splines.
        FileError: the disk has no room for the file.

    Example:
        >>> ss.build_model(meshes, ss.BuildConfig(modes=3)).n_modes
        3
    """
    config, log = config or BuildConfig(), log or _silent
    require(config, BuildConfig, "build_model", "give the options as BuildConfig(...)")
    align, alignment_vertices = config.align, config.alignment_vertices
    landmarks: Mapping[str, int] = config.landmarks or {}
    meshes = as_meshes(meshes, "build_model")
    kind = representation_named(config.representation, config.control_points)
    if kind is not Vertices and (config.out_of_core or keep_shapes is not None):
        raise InputError("Only models of vertices can be made of streamed meshes; leave --representation out.")
    streaming = ""
    if kind is Vertices and keep_shapes is None:
        streaming = streaming_note(meshes, modes=config.modes, out_of_core=config.out_of_core)
    if config.out_of_core or keep_shapes is not None or streaming:
        stream = aligned_on_disk(
            meshes,
            config.gauge,
            align=align,
            alignment_vertices=alignment_vertices,
            scratch=scratch,
            onto=None,
            modes=config.modes,
            tell=log,
        )
        if len(meshes):
            SurfaceLandmarks.of(landmarks).check(len(meshes[0].vertices))
        model = _of_streamed(stream, meshes, config, landmarks, keep_shapes, log)
        return replace(model, notes=[streaming, *model.notes]) if streaming else model
    meshes = [without_estimates(meshes[index]) for index in range(len(meshes))]
    faces, dropped = common_faces(meshes), np.zeros(0, dtype=np.int32)
    notes = missing_notes(meshes)
    if not kind.takes_holes and len(meshes) > 1:
        observed, given = ObservedMeshes.of(meshes, config.min_seen), landmarks
        meshes, landmarks = observed.meshes, observed.landmarks(given)
        notes += observed.notes(config.min_seen, given)
        faces, alignment_vertices = meshes[0].faces, observed.indices(alignment_vertices)
        dropped = np.flatnonzero(~observed.vertices).astype(np.int32)
    shapes, names = _training_shapes(meshes, faces, fill=kind.takes_holes), [mesh.name for mesh in meshes]
    rounding = rounding_mm(np.nan_to_num(meshes[0].vertices, posinf=0.0, neginf=0.0))
    observed = np.asarray(np.isfinite(shapes).all(axis=2), dtype=np.bool_)
    sizes = _sizes(shapes, observed)
    shapes, completed = _aligned(shapes, names, config.gauge, align=align, alignment_vertices=alignment_vertices)
    sizes = sizes / _sizes(shapes, observed)
    # Coding overwrites the shapes of B-splines.
    aligned = shapes if kind is Vertices or config.without_training_shapes else shapes.copy()
    coder = kind.of(Mesh(shapes.mean(axis=0), faces, name="The mean of the meshes"), config.control_points)
    if completed is not None:
        pc = completed.components(config.modes, config.seed)
    elif isinstance(coder, Vertices):
        data = coder.encode(shapes)
        pc = principal_components(data, number_of_modes(config.modes, data, config.seed))
    else:
        pc = _components_of_codes(coder, shapes, config.modes, config.seed)
    model = _of_components(
        pc,
        coder,
        modes=config.modes,
        rounding=rounding,
        align=align,
        alignment_vertices=alignment_vertices,
        faces=faces,
        gauge=config.gauge,
        landmarks=landmarks,
        representation=config.representation,
        provenance=config.provenance,
        licence=config.licence,
        dropped_vertices=dropped,
    )
    model = _finished(model, aligned.__getitem__, names.__getitem__, sizes, config)
    return replace(model, notes=[*notes, *model.notes])


def extend_model(
    model: ShapeModel,
    meshes: Meshes,
    shapes: Path,
    config: BuildConfig | None = None,
    *,
    scratch: Scratch | None = None,
    keep_shapes: Path | None = None,
    log: Tell | None = None,
) -> ShapeModel:
    """Return the model of the shapes that `model` was made of and of `meshes`, without the first ones' meshes.

    It is the model that `build_model` makes of all of them, but for rounding to single precision: all shapes are
    aligned anew, beginning from the poses that are known.

    Args:
        model: a model that was built with its shapes kept.
        meshes: at least one, corresponding to the model.
        shapes: the folder that `build_model` was given as `keep_shapes`.
        config: modes and seed; provenance and licence of the new model, empty for those of `model`. Everything else
            is that of `model`.
        scratch: as of `build_model`.
        keep_shapes: a folder to keep all shapes in, other than `shapes`.
        log: as of `build_model`.

    Raises:
        CorrespondenceError: a mesh differs from the model in vertices or triangles.
        InputError: shapes of another model, or what `build_model` refuses.
        FileError: there are no shapes, or the disk is full.
    """
    config, log = config or BuildConfig(), log or _silent
    training = KeptShapes.load(shapes)
    if training.model_hash != model.content_hash:
        raise InputError(f"The shapes in {shapes} are those of another model; give the model that was built with them.")
    if not len(meshes):
        raise InputError("There are no meshes to be added; give at least one.")
    training.check()
    stream = aligned_on_disk(
        meshes,
        training.gauge,
        align=training.align,
        alignment_vertices=training.alignment_vertices,
        scratch=scratch,
        onto=training,
        modes=config.modes,
        tell=log,
    )
    config = replace(config, provenance=config.provenance or model.provenance, licence=config.licence or model.licence)
    return _of_streamed(stream, meshes, config, model.landmarks, keep_shapes, log)


def _silent(_: str) -> None:
    pass


def _of_streamed(
    stream: AbstractContextManager[Aligned],
    meshes: Meshes,
    config: BuildConfig,
    landmarks: Mapping[str, int],
    keep_shapes: Path | None,
    log: Tell,
) -> ShapeModel:
    with stream as aligned:
        training = aligned.training
        model = _of_components(
            aligned.components(config.modes, config.seed, log),
            Vertices(),
            modes=config.modes,
            rounding=training.rounding,
            align=training.align,
            alignment_vertices=training.alignment_vertices,
            faces=training.faces,
            gauge=training.gauge,
            landmarks=landmarks,
            provenance=config.provenance,
            licence=config.licence,
        )
        sizes = np.ones(len(training.sizes)) if config.without_training_shapes else aligned.relative_sizes()
        before = training.sizes.size - len(meshes)
        model = _finished(
            model,
            aligned.shape,
            lambda i: f"shape {i + 1} of the model" if i < before else meshes[i - before].name,
            sizes,
            config,
        )
        if keep_shapes is not None:
            aligned.keep(keep_shapes, model.content_hash)
    return model


def _sizes(shapes: FloatArray, observed: BoolArray) -> FloatArray:
    """Return the centroid sizes (N,) of the observed vertices of shapes (N, V, 3)."""
    return np.array([centroid_size(shapes[i, observed[i]]) for i in range(len(shapes))])


def _finished(
    model: ShapeModel,
    shape: Callable[[int], FloatArray],
    name: Callable[[int], str],
    sizes: FloatArray,
    config: BuildConfig,
) -> ShapeModel:
    """Return the model with a note on mirrored shapes, and with its training shapes, unless `config` omits them.

    Args:
        model: without them.
        shape: returns the vertices (V, 3) of an aligned shape by its index.
        name: returns the name of a shape by its index.
        sizes: (N,) before alignment, relative to those after it.
        config: options.
    """
    odd = odd_size_notes(model.mean_vertices)
    model = replace(model, notes=[*mirrored_note(shape, name, len(sizes)), *model.notes, *odd])
    if config.without_training_shapes:
        return model
    sizes = sizes if model.gauge == "shape" else np.ones(len(sizes))
    training = TrainingShapes.of(shape, sizes, model.mean_vertices, model.vertex_basis)
    return replace(model, training=training)


def _of_components(
    pc: PrincipalComponents,
    coder: Representation,
    *,
    modes: Modes,
    rounding: float,
    align: bool,
    alignment_vertices: IntArray | None,
    gauge: Gauge,
    **about: Any,
) -> ShapeModel:
    """Return the model of these components, without modes that no shape made."""
    mean = coder.decode(pc.mean)
    spurious = below_precision(pc.variance, pc.n_samples, mean.size, rounding)
    if align:
        spurious |= made_by_alignment(mean, coder.directions(pc.basis), gauge, alignment_vertices)
    if spurious.all():
        raise InputError(
            "The training meshes differ by no more than their alignment and their rounding make of them, so there "
            "is no variation to model; give different ones."
        )
    kept, left_out = int((~spurious).sum()), int(spurious.sum())
    notes = modes_notes(modes, kept, pc.n_samples)
    if left_out:
        count_text = "1 mode is" if left_out == 1 else f"{left_out} modes are"
        notes.append(f"{count_text} left out, since alignment or rounding made them and no shape did.")
    return ShapeModel(
        mean=pc.mean,
        basis=pc.basis[:, ~spurious],
        stddev=np.sqrt(pc.variance[~spurious]),
        residuals=None if pc.residuals is None else pc.residuals[~spurious],
        left_out=left_out,
        notes=notes,
        total_variance=pc.total_variance,
        n_training=pc.n_samples,
        gauge=gauge,
        coding=coder.arrays(),
        **about,
    )


def _aligned(
    shapes: FloatArray, names: Sequence[str], gauge: Gauge, *, align: bool, alignment_vertices: IntArray | None
) -> tuple[FloatArray, CompletedShapes | None]:
    """Return the training shapes (N, V, 3) aligned and complete, and how they were completed; `shapes` is overwritten.

    Raises:
        InputError: a shape has no extent, or too little of it is observed.
    """
    if align:
        for shape, name in zip(shapes, names, strict=True):
            refuse_without_extent(shape, name)
    if np.isnan(shapes).any():
        completed = complete(shapes, names, gauge, align=align, alignment_vertices=alignment_vertices)
        return completed.shapes, completed
    return align_shapes(shapes, gauge, alignment_vertices) if align else shapes, None


def _components_of_codes(coder: Representation, shapes: FloatArray, modes: Modes, seed: int) -> PrincipalComponents:
    """Return mean and basis in codes, orthonormal in the vertices that they decode to; `shapes` is overwritten.

    What coding loses counts as variance that the modes leave over.
    """
    centre = shapes.mean(axis=0)
    total = sum(float(((shape - centre) ** 2).sum()) for shape in shapes) / (len(shapes) - 1)
    codes = coder.encode(shapes)
    for shape, code in zip(shapes, codes, strict=True):
        shape[:] = coder.decode(code)
    data = shapes.reshape(len(shapes), -1)
    pc = principal_components(data, number_of_modes(modes, data, seed))
    # Modes are sums of the training shapes, and the same sums of their codes decode to them.
    shares = (data @ pc.basis - pc.mean @ pc.basis) / (pc.variance * (len(data) - 1))
    mean = codes.mean(axis=0)
    return PrincipalComponents(mean, (codes - mean).T @ shares, pc.variance, total, pc.n_samples)


def _training_shapes(meshes: Sequence[Mesh], faces: IntArray | None, *, fill: bool) -> FloatArray:
    """Return the vertices of training meshes, (N, V, 3), checked; `fill` says whether what is missing is filled."""
    if len(meshes) < 2:
        raise InputError(
            f"A shape model needs at least two meshes, not {len(meshes)}; with one there is nothing that varies."
        )
    shapes = np.stack([mesh.vertices for mesh in meshes])
    names = [mesh.name for mesh in meshes]
    if fill and np.isnan(shapes).any():
        _refuse_not_finite(np.where(np.isnan(shapes), 0.0, shapes), names)
        fill_holes(shapes, faces, names)
    _refuse_not_finite(np.nan_to_num(shapes, nan=0.0, posinf=np.inf, neginf=-np.inf) if not fill else shapes, names)
    _refuse_equal(shapes)
    return shapes


def _refuse_not_finite(values: FloatArray, names: Sequence[str]) -> None:
    finite = np.isfinite(values).all(axis=(1, 2))
    if not finite.all():
        raise InputError(
            f"{names[int(np.argmin(finite))]} holds vertices that are not finite; see shapespace check, and repair it "
            "or leave it out."
        )


def _refuse_equal(shapes: FloatArray) -> None:
    """Refuse training shapes without extent or variation before alignment turns rounding into modes."""
    spread = float((np.nanmax(shapes, axis=0) - np.nanmin(shapes, axis=0)).max())
    if spread <= 64 * np.finfo(float).eps * float(np.nanmax(np.abs(shapes))):
        raise InputError("The training meshes are all equal, so there is no variation to model; give different ones.")


_ROUNDS = 5  # iterations of spline and alignment to fill holes
_COUNTS = (16, 16)  # control points along each side, since fill-ins are to be smooth
_SMOOTHNESS = 4e-7
"""With this, vertices of ICT-FaceKit are filled best: 1.7 mm off, where the mean alone is 3.6 mm off."""
_PULL = 1e-3
"""Weight with which a missing vertex stays at the mean, beside 1 of one that is there."""


def fill_holes(shapes: FloatArray, faces: IntArray | None, names: Sequence[str]) -> None:
    """Fill the vertices of `shapes` (N, V, 3) that are not-a-number, in place; each shape stays in its own pose.

    A filled vertex lies where the mean of all shapes has it, moved as the seen vertices around it differ from that
    mean: by the B-spline of least thin-plate energy. What is filled varies less than what was measured.

    Args:
        shapes: mm, in any poses; a vertex is missing where one of its coordinates is not-a-number.
        faces: (F, 3) of all shapes.
        names: of the shapes, for messages.

    Raises:
        InputError: a vertex that no shape has, or a shape of which too little is there.
        MeshError: the surface cannot be spread out on a square.
    """
    seen: BoolArray = np.logical_and.reduce(np.isfinite(shapes), axis=2)
    nowhere = np.flatnonzero(~seen.any(axis=0))
    if len(nowhere):
        raise InputError(
            f"Vertex {nowhere[0]} is missing in every mesh, so nothing is known of it; take it out of all."
        )
    first = int(seen.sum(axis=1).argmax())
    T_mean_shape = [
        pose_on_shared(shapes[i], shapes[first], seen[i] & seen[first], names[i]) for i in range(len(shapes))
    ]
    mean = np.zeros_like(shapes[0])
    for shape, there, T in zip(shapes, seen, T_mean_shape, strict=True):
        mean[there] += T.apply(shape[there])
    mean /= seen.sum(axis=0)[:, None]
    spline = SplineSquare(disc_map(Mesh(mean, faces, name=names[first])), _COUNTS, _SMOOTHNESS)
    for _ in range(_ROUNDS):
        previous, mean = mean, np.zeros_like(mean)
        for i, (shape, there) in enumerate(zip(shapes, seen, strict=True)):
            T = pose_on_shared(shape, previous, there, names[i])
            change = np.zeros_like(mean)
            change[there] = T.apply(shape[there]) - previous[there]
            if not there.all():
                moved = spline.values(spline.fit(change, np.where(there, 1.0, _PULL)))
                change[~there] = moved[~there]
                shape[~there] = T.inverse().apply(previous[~there] + moved[~there])
            mean += (previous + change) / len(shapes)
