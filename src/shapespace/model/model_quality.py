"""Quality of a shape model: compactness, generalisation and specificity over the number of modes, with intervals.

Compactness is the share of the variance of the first modes. Generalisation is the error on shapes that the model
did not see: in each fold poses, mean and modes are computed without the held-out shapes, and each of these is
reconstructed from the first modes in its best pose. Specificity is the distance of random shapes of the model from the
nearest training shape. Davies, Twining, Cootes, Waterton and Taylor, TMI 21(5), 2002; Styner et al., IPMI 2003.
Distances are computed in two ways and never mixed: `vertices`, from each vertex to its corresponding vertex, and
`surface`, from vertices to the nearest point of the other surface, the mean of both directions: the first is too small
for shapes whose vertices slid (Ericsson and Karlsson, 2007), the second does not detect sliding at all. `floor_mm` is
the error of a model if every correspondence is known: the lower bound for every fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from shapespace.errors import CorrespondenceError, InputError
from shapespace.geometry.closest import ClosestPointEngine, build_engine, on_boundary
from shapespace.geometry.normals import boundary_vertices, part_of, without_estimates
from shapespace.geometry.procrustes import Gauge
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.interop import MeshLike, as_meshes
from shapespace.lazy import lazy_import
from shapespace.model.build_model import BuildConfig, build_model
from shapespace.model.choose_modes import FEWEST_SHAPES
from shapespace.model.missing import MIN_SEEN, ObservedMeshes
from shapespace.model.pca import Modes
from shapespace.model.representation import REPRESENTATIONS
from shapespace.model.shape_model import ShapeModel
from shapespace.reprs import short_repr
from shapespace.step_counter import StepCounter
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh, Similarity, common_faces, require_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_FEWEST = 3  # shapes; without one of these two are left, and fewer have no mode
_MOST_COUNTS, _MOST_SPECIFIC = 12, 6
"""Largest number of compared numbers of modes, and the same for the specificity, which takes longest."""
_POINTS = 1000
"""Largest number of vertices at which distances between surfaces are measured, spread evenly over their indices."""
_POSE_ROUNDS = 3  # alternations of pose and coefficients
_NEAREST = 2
"""Number of training shapes nearest by vertices that are compared by surface."""
_RESAMPLES = 2000  # bootstrap samples, enough for percentiles 2.5 and 97.5
_PARTS = (0.25, 0.5, 0.75, 1.0)  # shares of the training shapes at which the learning curve is measured
_ANY = 1e-9
"""Share of the meshes that show a vertex of a measured model; with it, two meshes are enough."""
_LEAST_NOISE = 1e-6
"""Share of the variance that counts as noise if the modes contain the complete variance."""
_DRAWN_AT_ONCE = 5
"""Number of random shapes of one part of the work."""
_FAR = 0.05
"""Median distance of a surface from its scan, as a share of its size, above which the two do not belong together."""


OnStep: TypeAlias = Callable[[int, int], None]
"""Function that is called with the number of finished steps and the number of all steps."""


@dataclass(frozen=True, eq=False)
class Curve:
    """A measure by the number of modes, or of training shapes.

    Args:
        counts: (n,) numbers of modes or shapes.
        mean: (n,) mm, or a share.
        low: (n,) lower ends of the 95 % intervals.
        high: (n,) upper ends of the intervals.
        each: (S, n) values of each shape or sample, if the mean is over them.

    Example:
        >>> quality = ss.model.measure_quality(meshes, config=ss.model.QualityConfig(folds=2, samples=2))
        >>> len(quality.compactness.mean) == len(quality.compactness.counts)
        True
    """

    counts: IntArray
    mean: FloatArray
    low: FloatArray
    high: FloatArray
    each: FloatArray | None = None

    __repr__ = short_repr

    @staticmethod
    def over(each: FloatArray, counts: Sequence[int] | IntArray, seed: int) -> Curve:
        """Return the mean over the rows of `each` (S, n) with its interval by bootstrap over rows (percentiles)."""
        draws = np.random.default_rng(seed).integers(len(each), size=(_RESAMPLES, len(each)))
        weights = np.stack([np.bincount(draw, minlength=len(each)) for draw in draws]) / len(each)
        low, high = np.percentile(weights @ each, [2.5, 97.5], axis=0)
        return Curve(np.asarray(counts, dtype=np.int32), each.mean(axis=0), np.asarray(low), np.asarray(high), each)


@dataclass(frozen=True, eq=False)
class ModelQuality:
    """Quality measures of a shape model; None if the shapes or the model do not determine a measure.

    Args:
        compactness: shares of the variance. The interval is from a jackknife over shapes, so a model alone has none.
        generalisation: errors of held-out shapes, mm, surface to surface.
        generalisation_vertices: errors of held-out shapes, mm, vertex to vertex.
        specificity: distances of random shapes, mm, surface to surface.
        specificity_vertices: distances of random shapes, mm, vertex to vertex.
        reconstruction: errors of the given unseen shapes, mm, surface to surface.
        reconstruction_vertices: errors of the given unseen shapes, mm, vertex to vertex.
        by_shapes: generalisation (vertices) with all modes by the number of training shapes.
        supported_modes: number of modes that `build --modes auto` keeps.
        shapes: number of shapes.
        folds: number of folds of the cross-validation.
        points: number of vertices at which distances between surfaces were measured.
        seed: seed of all random choices.
        missing_share: share of the vertices, over all shapes, that are missing and were not measured.
        left_out_vertices: number of vertices that less than half of the shapes show, so that they were not measured.

    Example:
        >>> quality = ss.model.measure_quality(meshes, config=ss.model.QualityConfig(folds=2, samples=2))
        >>> quality.shapes
        6
    """

    compactness: Curve
    generalisation: Curve | None = None
    generalisation_vertices: Curve | None = None
    specificity: Curve | None = None
    specificity_vertices: Curve | None = None
    reconstruction: Curve | None = None
    reconstruction_vertices: Curve | None = None
    by_shapes: Curve | None = None
    supported_modes: int | None = None
    shapes: int = 0
    folds: int = 0
    points: int = 0
    seed: int = 0
    missing_share: float = 0.0
    left_out_vertices: int = 0

    def __repr__(self) -> str:
        parts = [f"compactness {self.compactness.mean[-1]:.3f} with {self.compactness.counts[-1]} modes"]
        for name, curve in (("generalisation", self.generalisation), ("specificity", self.specificity)):
            parts += [] if curve is None else [f"{name} {curve.mean[-1]:.3g} mm with {curve.counts[-1]}"]
        return f"<ModelQuality of {self.shapes} shapes: {', '.join(parts)}>"

    def plot(self, **options: Any) -> Figure:
        """Return a matplotlib figure of all available measures over the number of modes.

        Args:
            options: options of `shapespace.report.figures.quality_figure`.

        Raises:
            ShapespaceError: the extra `report` is not installed.
        """
        return lazy_import("plot_quality")(self, **options)

    def _repr_html_(self) -> str:
        return lazy_import("html_of_quality")(self)

    def sentences(self) -> tuple[str, ...]:
        """Return the number of modes that the shapes support, and whether more shapes would help."""
        sentences: list[str] = []
        if self.supported_modes is not None:
            modes = "1 mode" if self.supported_modes == 1 else f"{self.supported_modes} modes"
            sentences.append(
                f"These {self.shapes} shapes support {modes}: with more, hidden vertices of unseen shapes are "
                "predicted no better."
            )
        if self.by_shapes is not None and len(self.by_shapes.counts) > 1:
            sentences.append(_more_shapes(self.by_shapes, self.seed))
        return tuple(sentences)

    def differences(self, other: ModelQuality) -> dict[str, Curve]:
        """Return the values of `other` minus those of this measurement, shape by shape, by the names of the measures.

        Raises:
            InputError: the measurements are not of the same shapes in the same folds.
        """
        same_shapes = self.shapes and other.shapes
        if same_shapes and (self.shapes, self.folds, self.seed) != (other.shapes, other.folds, other.seed):
            raise InputError(
                f"Only measurements of the same shapes in the same folds can be compared, not {self.shapes} "
                f"shapes in {self.folds} folds with {other.shapes} in {other.folds}."
            )
        out: dict[str, Curve] = {}
        for name in ("generalisation", "generalisation_vertices", "reconstruction", "reconstruction_vertices"):
            a, b = getattr(self, name), getattr(other, name)
            if isinstance(a, Curve) and isinstance(b, Curve) and a.each is not None and b.each is not None:
                counts, own, others = np.intersect1d(a.counts, b.counts, return_indices=True)
                if len(a.each) == len(b.each) and len(counts):
                    out[name] = Curve.over(b.each[:, others] - a.each[:, own], counts.astype(np.int32), self.seed)
        return out


@dataclass(frozen=True, kw_only=True)
class QualityConfig:
    """Settings of a quality measurement.

    Args:
        folds: number of folds of the cross-validation, at most one per shape; with `loo` (in Python None) one shape
            is held out at a time.
        modes: largest number of modes (default: all that the folds allow).
        samples: number of random shapes for the specificity.
        seed: seed of folds and random shapes.
        gauge: `form` keeps size, `shape` removes size.
        align: whether to align the shapes.
        representation: representation of the shapes, see `BuildConfig`, or `articulated`: several parts with modelled
            relative pose.
        control_points: control points of a B-spline along each side, 4 to 64 (default 24x24).
        parts: number of vertices of each part by its name, in order; only for the representation `articulated`.

    Raises:
        InputError: a number has an impossible value, or `articulated` shapes have no parts.
    """

    folds: int | None = 10
    modes: int | None = None
    samples: int = 100
    seed: int = 0
    gauge: Gauge = "shape"
    align: bool = True
    representation: str = "vertices"
    control_points: tuple[int, int] | None = None
    parts: Mapping[str, int] | None = None

    def __post_init__(self) -> None:
        require_whole(self.folds, "folds")
        if (self.representation == "articulated") != bool(self.parts):
            raise InputError(
                "The representation articulated is that of surfaces of several parts, as correspond --parts writes "
                "them; give such surfaces, or another representation."
            )
        if self.folds is not None and self.folds < 2:
            raise InputError(f"Shapes are held out in at least two folds, not in {self.folds}.")
        if self.samples < 2 or (self.modes is not None and self.modes < 1):
            raise InputError("Quality needs at least two samples, and at least one mode.")

    def space(self, meshes: Sequence[Mesh], modes: Modes = "all") -> ShapeModel:
        """Return the shape model of `meshes`, with the vertices that at least two of the meshes show."""
        representation = "vertices" if self.parts else self.representation
        return build_model(meshes, BuildConfig(
            modes=modes, gauge=self.gauge, align=self.align, representation=representation, parts=self.parts,
            control_points=self.control_points, min_seen=_ANY, seed=self.seed,
        ))  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Target:
    """A shape in correspondence, and its reference surface: its own, or the scan that it was made from.

    Args:
        shape: mesh with not-a-number at missing vertices.
        seen: indices of the observed vertices.
        surface: observed part of the shape, or its scan.
        engine: search structure of the surface.
        is_scan: whether the surface is a scan, which may show more than the shape covers.
    """

    shape: Mesh
    seen: IntArray
    surface: Mesh
    engine: ClosestPointEngine
    is_scan: bool

    @staticmethod
    def of(shape: Mesh, scan: Mesh | None) -> _Target:
        seen = np.flatnonzero(np.isfinite(shape.vertices).all(axis=1)).astype(np.int32)
        surface = scan if scan is not None else _observed_part(shape, seen)
        engine = build_engine(surface)
        if scan is not None:
            there = shape.vertices[seen]
            far = float(np.median(engine.query(there[_spread_indices(len(there))]).distance))
            if far > _FAR * float(np.linalg.norm(np.ptp(there, axis=0))):
                raise InputError(
                    f"{shape.name} lies {far:.1f} mm from its scan {scan.name}, so they do not belong together; give "
                    "the scans in the pose and unit of the surfaces."
                )
        return _Target(shape, seen, surface, engine, scan is not None)

    def cut_to(self, space: ShapeModel) -> _Target:
        """Return the target with only those vertices that the training shapes of `space` show."""
        if len(self.shape.vertices) == space.n_vertices:
            return self
        used = ~np.isin(np.arange(len(self.shape.vertices)), space.dropped_vertices)
        shape = part_of(self.shape, used)
        seen = np.flatnonzero(np.isfinite(shape.vertices).all(axis=1)).astype(np.int32)
        if self.is_scan:
            return _Target(shape, seen, self.surface, self.engine, True)
        surface = _observed_part(shape, seen)
        return _Target(shape, seen, surface, build_engine(surface), False)


def _observed_part(shape: Mesh, seen: IntArray) -> Mesh:
    """Return the observed part of a shape."""
    if len(seen) == len(shape.vertices):
        return shape
    used = np.zeros(len(shape.vertices), dtype=np.bool_)
    used[seen] = True
    return part_of(shape, used)


@dataclass(frozen=True)
class QualityTask:
    """An independent part of a measurement: a fold, or some random shapes.

    Args:
        held: indices of the held-out shapes.
        order: indices of all other shapes, in random order; models of fewer shapes are built from the first shapes.
        drawn: indices of the random shapes.
    """

    held: tuple[int, ...] = ()
    order: tuple[int, ...] = ()
    drawn: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Shapes:
    """Input and shared results of all parts of a measurement.

    Args:
        meshes: three or more meshes in correspondence.
        scans: one scan per mesh, or None for the meshes themselves.
        config: settings of the measurement.
    """

    meshes: Sequence[Mesh]
    scans: Sequence[Mesh] | None
    config: QualityConfig

    @cached_property
    def folds(self) -> list[IntArray]:
        """Indices of the shapes in each fold."""
        return _split_folds(len(self.meshes), self.config)

    @cached_property
    def counts(self) -> IntArray:
        """Numbers of modes that are compared."""
        most = len(self.meshes) - max(len(fold) for fold in self.folds) - 1
        return _choose_counts(min(self.config.modes or most, most))

    @cached_property
    def few_counts(self) -> IntArray:
        """Numbers of modes for the specificity."""
        counts = self.counts
        picked = np.linspace(0, len(counts) - 1, min(len(counts), _MOST_SPECIFIC))
        return counts[np.unique(picked.round().astype(int))]

    @cached_property
    def sizes(self) -> list[int]:
        """Numbers of training shapes of the smaller models."""
        least = len(self.meshes) - max(len(fold) for fold in self.folds)
        return sorted({max(2, round(share * least)) for share in _PARTS})

    @cached_property
    def space(self) -> ShapeModel:
        """Shape model of all meshes."""
        return self.config.space(self.meshes)

    @cached_property
    def targets(self) -> list[_Target]:
        """Target of each shape."""
        return [_Target.of(mesh, None if self.scans is None else self.scans[i]) for i, mesh in enumerate(self.meshes)]

    @cached_property
    def trained(self) -> list[_Target]:
        """Target of each shape, with the vertices of the shape model."""
        return [target.cut_to(self.space) for target in self.targets]

    @cached_property
    def drawn(self) -> FloatArray:
        """(S, K) coefficients of the random shapes."""
        return self.space.sample(self.config.samples, np.random.default_rng(self.config.seed + 2))

    @cached_property
    def nearest(self) -> _Nearest:
        """Training shapes in the pose of the model."""
        return _Nearest.of(_pose_shapes(self.space, self.trained, self.config), self.space.n_vertices)

    def parts(self) -> list[QualityTask]:
        """Return all parts of the work, in the order of the output."""
        n, rng = len(self.meshes), np.random.default_rng(self.config.seed + 1)
        folds: list[QualityTask] = []
        for fold in self.folds:
            order = tuple(int(i) for i in rng.permutation(n) if i not in fold)
            folds.append(QualityTask(tuple(fold.tolist()), order))
        samples = range(self.config.samples)
        return folds + [
            QualityTask(drawn=tuple(samples[start : start + _DRAWN_AT_ONCE])) for start in samples[::_DRAWN_AT_ONCE]
        ]

    def do(self, part: QualityTask) -> FloatArray:
        """Return errors, mm: of held-out shapes (H, n + m, 2), the last m for fewer training shapes; or of random ones.

        Raises:
            InputError: the scans are not those of the shapes.
        """
        return self._measure_held_out(part) if part.held else self._measure_drawn(part)

    def _measure_held_out(self, part: QualityTask) -> FloatArray:
        held = [self.targets[i] for i in part.held]
        space = self.config.space([self.meshes[i] for i in sorted(part.order)])
        out = np.zeros((len(held), len(self.counts) + len(self.sizes), 2))
        for row, target in enumerate(held):
            out[row, : len(self.counts)] = _errors_by_modes(space, target.cut_to(space), self.counts)
        for column, size in enumerate(self.sizes, len(self.counts)):
            fewer = self.config.space([self.meshes[i] for i in sorted(part.order[:size])])
            only = np.array([min(self.config.modes or size - 1, size - 1)], dtype=np.int32)
            for row, target in enumerate(held):
                out[row, column] = _errors_by_modes(fewer, target.cut_to(fewer), only, surface=False)[0]
        return out

    def _measure_drawn(self, part: QualityTask) -> FloatArray:
        """Return the distances (S, n, 2), mm, of random shapes from the nearest training shape."""
        model, counts = self.space, self.few_counts
        mean, modes = model.mean_vertices, np.ascontiguousarray(model.vertex_basis.T)
        out = np.zeros((len(part.drawn), len(counts), 2))
        for row, b in enumerate(self.drawn[list(part.drawn)]):
            for column, k in enumerate(counts):
                shape = mean + (b[:k] @ modes[:k]).reshape(-1, 3) if model.is_linear else model.reconstruct(b[:k])
                out[row, column] = self.nearest.off(shape)
        return out


Runner: TypeAlias = Callable[[Shapes, Sequence[QualityTask]], Iterable[tuple[QualityTask, FloatArray]]]
"""Function that does the parts of a measurement, in any process, and yields each with its errors, in any order."""


def run_here(shapes: Shapes, parts: Sequence[QualityTask]) -> Iterable[tuple[QualityTask, FloatArray]]:
    """Do one part after the other in this process."""
    return ((part, shapes.do(part)) for part in parts)


def measure_quality(
    target: Sequence[MeshLike] | ShapeModel,
    config: QualityConfig | None = None,
    *,
    scans: Sequence[MeshLike] | None = None,
    unseen: Sequence[MeshLike] = (),
    progress: OnStep | None = None,
    run: Runner = run_here,
) -> ModelQuality:
    """Measure the quality of the shape model of corresponding meshes; for a model, the measures from its spectrum.

    Args:
        target: three or more meshes, mm, or other inputs of `as_mesh`; or a model, of which only compactness and
            the measures on `unseen` are available, since not every model contains its training shapes.
        config: folds, modes, samples, seed, and settings of the model; None for the defaults.
        scans: one scan per mesh, in its pose and unit, as the reference of surfaces; None for the meshes themselves.
        unseen: meshes in correspondence that no model was trained on.
        progress: function called with (finished steps, all steps).
        run: function that does folds and random shapes, in this process or in others.

    Raises:
        CorrespondenceError: meshes differ in vertices or triangles.
        InputError: too few meshes, all equal, coordinates that are infinite, or scans of other shapes.
    """
    config = config or QualityConfig()
    meshes: Sequence[Mesh] = []
    if not isinstance(target, ShapeModel):
        meshes = _check_meshes([without_estimates(mesh) for mesh in as_meshes(target, "measure_quality")])
    scans = None if scans is None else as_meshes(scans, "measure_quality")
    new: list[Mesh] = [without_estimates(mesh) for mesh in as_meshes(unseen, "measure_quality")]
    vertices = target.n_vertices if isinstance(target, ShapeModel) else len(meshes[0].vertices)
    if scans is not None and len(scans) != len(meshes):
        raise InputError(f"There must be one scan per mesh, but there are {len(scans)} scans of {len(meshes)} meshes.")
    for mesh in new:
        _check_vertex_count(mesh, vertices)
    if isinstance(target, ShapeModel):
        return _measure_model(target, new, config, progress)
    takes_holes = REPRESENTATIONS[config.representation].takes_holes
    included = np.ones(vertices, dtype=np.bool_) if takes_holes else ObservedMeshes.of(meshes, MIN_SEEN).vertices
    if not included.all():
        meshes, new = [part_of(mesh, included) for mesh in meshes], [part_of(mesh, included) for mesh in new]
        if config.parts:
            masks = zip(config.parts, np.split(included, np.cumsum(list(config.parts.values()))[:-1]), strict=True)
            config = replace(config, parts={name: int(mask.sum()) for name, mask in masks})
    shapes = Shapes(meshes, scans, config)
    return _measure_meshes(shapes, new, progress, run, left_out=int((~included).sum()))


def _measure_model(
    model: ShapeModel, unseen: Sequence[Mesh], config: QualityConfig, progress: OnStep | None
) -> ModelQuality:
    counts = _choose_counts(min(config.modes or model.n_modes, model.n_modes))
    share = model.cumulative_variance[counts - 1]
    of_unseen = _measure_unseen(model, unseen, counts, config, StepCounter(len(unseen), progress))
    return ModelQuality(
        Curve(counts, share, share, share),
        reconstruction=of_unseen[0],
        reconstruction_vertices=of_unseen[1],
        points=_count_points(model.n_vertices),
        seed=config.seed,
    )


def _measure_meshes(
    shapes: Shapes, unseen: Sequence[Mesh], progress: OnStep | None, run: Runner, *, left_out: int
) -> ModelQuality:
    meshes, config, counts, few = shapes.meshes, shapes.config, shapes.counts, shapes.few_counts
    steps = StepCounter(len(meshes) + len(unseen) + config.samples, progress)
    errors = np.zeros((len(meshes), len(counts) + len(shapes.sizes), 2))
    drawn = np.zeros((config.samples, len(few), 2))
    for part, part_result in run(shapes, shapes.parts()):
        (errors if part.held else drawn)[list(part.held or part.drawn)] = part_result
        steps.add(len(part_result))
    general = _curves(errors[:, : len(counts)], counts, config.seed)
    specific = _curves(drawn, few, config.seed)
    space = shapes.space
    of_unseen = _measure_unseen(space, unseen, counts, config, steps)
    there = np.mean([len(target.seen) for target in shapes.targets]) / len(meshes[0].vertices)
    return ModelQuality(
        _compactness(space, counts, len(meshes)),
        generalisation=general[0],
        generalisation_vertices=general[1],
        specificity=specific[0],
        specificity_vertices=specific[1],
        reconstruction=of_unseen[0],
        reconstruction_vertices=of_unseen[1],
        by_shapes=Curve.over(errors[:, len(counts) :, 0], shapes.sizes, config.seed),
        supported_modes=config.space(meshes, "auto").n_modes if len(meshes) >= FEWEST_SHAPES else None,
        shapes=len(meshes),
        folds=len(shapes.folds),
        points=_count_points(space.n_vertices),
        seed=config.seed,
        missing_share=1.0 - float(there),
        left_out_vertices=left_out,
    )


def _check_meshes(meshes: list[Mesh]) -> list[Mesh]:
    if len(meshes) < _FEWEST:
        raise InputError(
            f"Quality is measured on held-out shapes, which takes at least three meshes, not {len(meshes)}."
        )
    common_faces(meshes)
    for mesh in meshes:
        if np.isinf(mesh.vertices).any():
            raise InputError(f"{mesh.name}: it has vertices that are infinite; mark them as missing, or exclude it.")
    return meshes


def _check_vertex_count(mesh: Mesh, vertices: int) -> None:
    if len(mesh.vertices) != vertices:
        raise CorrespondenceError(
            f"{mesh.name} has {len(mesh.vertices)} vertices but the model has {vertices}; unseen shapes must be in "
            "correspondence with it, so fit the model to them by shapespace fit with --dense."
        )


def _curves(errors: FloatArray, counts: IntArray, seed: int) -> tuple[Curve, Curve]:
    """Return the curves of errors (S, n, 2): of surfaces, and of vertices."""
    return Curve.over(errors[:, :, 1], counts, seed), Curve.over(errors[:, :, 0], counts, seed)


def _measure_unseen(
    space: ShapeModel, unseen: Sequence[Mesh], counts: IntArray, config: QualityConfig, steps: StepCounter
) -> tuple[Curve, Curve] | tuple[None, None]:
    if not unseen:
        return None, None
    errors = np.zeros((len(unseen), len(counts), 2))
    for row, mesh in enumerate(unseen):
        errors[row] = _errors_by_modes(space, _Target.of(mesh, None).cut_to(space), counts)
        steps.add()
    return _curves(errors, counts, config.seed)


def _choose_counts(most: int) -> IntArray:
    """Return numbers of modes from 1 to `most`, denser at the start."""
    spaced = {round(most ** (step / max(_MOST_COUNTS - 1, 1))) for step in range(_MOST_COUNTS)}
    return np.array(sorted(spaced), dtype=np.int32)


def _split_folds(n: int, config: QualityConfig) -> list[IntArray]:
    folds = n if config.folds is None else min(config.folds, n)
    order = np.random.default_rng(config.seed).permutation(n).astype(np.int32)
    return [np.asarray(part, dtype=np.int32) for part in np.array_split(order, folds)]


def _count_points(vertices: int) -> int:
    return min(vertices, _POINTS)


def _spread_indices(vertices: int) -> IntArray:
    return np.unique(np.linspace(0, vertices - 1, _count_points(vertices)).round().astype(np.int32))


def _errors_by_modes(model: ShapeModel, target: _Target, counts: IntArray, *, surface: bool = True) -> FloatArray:
    """Return the distances (n, 2), mm, of a shape from its reconstructions by the first `counts` (n,) modes.

    The columns are the mean distance between corresponding vertices and the distance from surface to surface; the
    second is 0 without `surface`.
    """
    there, out = target.shape.vertices[target.seen], np.zeros((len(counts), 2))
    T_model_shape = _onto_mean(model, target)
    for column, k in enumerate(counts):
        reconstructed, T_model_shape = _in_best_pose(model, target, int(k), T_model_shape)
        fitted = T_model_shape.inverse().apply(reconstructed)
        out[column, 0] = np.linalg.norm(fitted[target.seen] - there, axis=1).mean()
        if surface:
            out[column, 1] = _surface_distance(target.shape.with_vertices(fitted), target)
    return out


def _onto_mean(model: ShapeModel, target: _Target) -> Similarity:
    """Return T_model_target, the pose of the target in the frame of the model."""
    if not model.is_linear:
        # The mean shape in another relative pose determines neither pose nor size.
        return _in_best_pose(model, target, model.n_modes, Similarity.identity())[1]
    there, mean = target.shape.vertices[target.seen], model.mean_vertices[target.seen]
    return fit_similarity(there, mean, with_scale=model.gauge == "shape")


def _in_best_pose(model: ShapeModel, target: _Target, k: int, T: Similarity) -> tuple[FloatArray, Similarity]:
    """Return the shape (V, 3) of the first `k` modes that fits the observed vertices, and T_model_target, from `T` on.

    The noise of shapes with missing parts is the variance outside these modes.
    """
    shape, seen, total = target.shape.vertices, target.seen, model.total_variance
    left = max(total - float((model.stddev[:k] ** 2).sum()), _LEAST_NOISE * total)
    if not model.is_linear:
        noise, scaled = left / shape.size if len(seen) < len(shape) else 0.0, model.gauge == "shape"
        b, T = model.nearest_in_any_pose(shape, with_scale=scaled, noise=noise, stddev=model.stddev[:k])
        return model.reconstruct(b), T.inverse()
    reconstructed = model.mean_vertices
    for _ in range(_POSE_ROUNDS):
        reconstructed = model.reconstruct(model.nearest(T.apply(shape), k, left / shape.size))
        T = fit_similarity(shape[seen], reconstructed[seen], with_scale=model.gauge == "shape")
    return reconstructed, T


def _surface_distance(fitted: Mesh, target: _Target) -> float:
    """Return the mean of both mean distances between two surfaces, mm, each at points spread over the observed part."""
    seen = target.seen[_spread_indices(len(target.seen))]
    there = target.engine.query(fitted.vertices[seen]).distance.mean()
    back = build_engine(fitted).query(target.surface.vertices[_spread_indices(len(target.surface.vertices))])
    counted: BoolArray = np.ones(len(back.distance), dtype=np.bool_)
    if target.is_scan:
        # A scan may show more than the surface covers.
        counted = ~on_boundary(back, fitted, boundary_vertices(fitted))
    return float(0.5 * (there + (back.distance[counted].mean() if counted.any() else there)))


@dataclass(frozen=True, eq=False)
class _Nearest:
    """Training shapes in the pose of the model, to find the distance of other shapes from the nearest one.

    Args:
        targets: targets of the training shapes, with their surfaces.
        meshes: training shapes.
        picked: indices of the vertices by which shapes are compared.
        vertices: (N, P, 3) these vertices of the training shapes.
    """

    targets: Sequence[_Target]
    meshes: Sequence[Mesh]
    picked: IntArray
    vertices: FloatArray

    @staticmethod
    def of(posed: Sequence[Mesh], vertices: int) -> _Nearest:
        picked = _spread_indices(vertices)
        compared = np.stack([mesh.vertices[picked] for mesh in posed])
        return _Nearest([_Target.of(mesh, None) for mesh in posed], posed, picked, compared)

    def off(self, shape: FloatArray) -> tuple[float, float]:
        """Return the distances of `shape` (V, 3), mm, from the nearest training shape: by vertices, and by surface."""
        mean_of = np.nanmean if np.isnan(self.vertices).any() else np.mean
        off = mean_of(np.linalg.norm(self.vertices - shape[self.picked], axis=2), axis=1)
        drawn, nearest = self.meshes[0].with_vertices(shape), np.argsort(off, kind="stable")[:_NEAREST]
        return float(off.min()), min(_surface_distance(drawn, self.targets[int(i)]) for i in nearest)


def _pose_shapes(model: ShapeModel, targets: Sequence[_Target], config: QualityConfig) -> list[Mesh]:
    """Return the shapes in the pose and size of the model, aligned by their observed vertices."""
    if not config.align:
        return [target.shape for target in targets]
    return [target.shape.with_vertices(_onto_mean(model, target).apply(target.shape.vertices)) for target in targets]


def _compactness(model: ShapeModel, counts: IntArray, shapes: int) -> Curve:
    """Return the share of the variance of the first modes, with an interval by jackknife over the training shapes.

    Args:
        model: a model with its training shapes.
        counts: (n,) numbers of modes.
        shapes: number of all training shapes; of many shapes the model keeps a sample.
    """
    assert model.training is not None
    gram = model.training.coefficients @ model.training.coefficients.T
    share = model.cumulative_variance[np.minimum(counts, model.n_modes) - 1]
    n, count = len(gram), min(model.vertex_basis.shape[1], model.n_modes)
    rest = [np.flatnonzero(np.arange(n) != i) for i in range(n)]
    without = np.stack([_variance_shares(gram[np.ix_(some, some)], counts, count) for some in rest])
    spread = 1.96 * np.sqrt((n - 1) / shapes * ((without - without.mean(axis=0)) ** 2).sum(axis=0))
    return Curve(counts, share, np.maximum(share - spread, 0.0), np.minimum(share + spread, 1.0))


def _variance_shares(gram: FloatArray, counts: IntArray, count: int) -> FloatArray:
    centred = gram - gram.mean(axis=0) - gram.mean(axis=1)[:, None] + gram.mean()
    values = np.maximum(np.linalg.eigvalsh(centred)[::-1], 0.0)
    return np.cumsum(values)[np.minimum(counts, min(count, len(values))) - 1] / values.sum()


def _more_shapes(by_shapes: Curve, seed: int) -> str:
    """Return the effect of more training shapes on the error, measured and expected, in a sentence."""
    each, counts = by_shapes.each, by_shapes.counts
    if each is None:
        return ""
    few = int(np.argmin(np.abs(counts - counts[-1] / 2)))
    few = min(few, len(counts) - 2)
    draws = np.random.default_rng(seed).integers(len(each), size=(_RESAMPLES, len(each)))
    fell = 1 - each[draws, -1].mean(axis=1) / each[draws, few].mean(axis=1)
    now = 100 * float(1 - each[:, -1].mean() / each[:, few].mean())
    low, high = 100 * np.percentile(fell, [2.5, 97.5])
    changed = f"fell by {now:.0f} %" if now >= 0 else f"rose by {-now:.0f} %"
    sentence = f"From {counts[few]} to {counts[-1]} training shapes the error on unseen shapes {changed} "
    sentence += f"(95 %: {low:.0f} to {high:.0f} %), "
    if low > 0 and now >= 5:
        return sentence + "so more shapes would help."
    return sentence + (
        "so more shapes would help little." if high < 10 else "so these shapes do not show whether more would help."
    )


_STEPS, _REACHED_MM = 20, 1e-4  # limit of Gauss-Newton steps, and the vertex motion in mm that ends them


def floor_mm(model: ShapeModel, truth: FloatArray) -> float:
    """Return the mean error, mm, of the shape of `model` in the pose that is nearest to `truth` (V, 3).

    Pose and coefficients are solved for together: alternating between them is slow if modes contain pose or size.
    """
    b, T = model.project(truth, align=False), Similarity.identity()
    for _ in range(_STEPS):
        shape, modes = T.apply(model.reconstruct(b)), model.directions(b).reshape(-1, 3, model.n_modes)
        arm = shape - T.translation
        turn = np.cross(np.eye(3), arm[:, None]).transpose(0, 2, 1)
        move = np.broadcast_to(np.eye(3), turn.shape)
        reach = T.scale * (T.rotation @ modes)
        J = np.concatenate([turn, move, arm[:, :, None], reach], axis=2).reshape(-1, 7 + model.n_modes)
        # Slight damping, since modes may contain a pose completely.
        H = J.T @ J
        H[np.diag_indices_from(H)] *= 1.0 + 1e-9
        step = np.linalg.solve(H, J.T @ (truth - shape).ravel())
        turned = Rotation.from_rotvec(step[:3]).as_matrix() @ T.rotation
        T = Similarity(T.scale * np.exp(step[6]), turned, T.translation + step[3:6])
        b = b + step[7:]
        if np.abs(J @ step).max() < _REACHED_MM:
            break
    return float(np.linalg.norm(T.apply(model.reconstruct(b)) - truth, axis=1).mean())
