"""Command `quality`: compactness, generalisation and specificity of a model, a folder in correspondence, or two."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
from msgspec import structs

from shapespace.batch.executors import ExecutionConfig, Serial, Shared
from shapespace.batch.progress import progress, steps, waiting
from shapespace.commands.inputs import SurfacesOnDisk
from shapespace.commands.outcome import Outcome
from shapespace.errors import FitError, InputError, MeshError
from shapespace.geometry.procrustes import Gauge
from shapespace.io.files import make_folder, write_text
from shapespace.io.meshes.mesh_io import mesh_files, read_mesh
from shapespace.model.foreign import looks_like_model
from shapespace.model.model_quality import (
    Curve,
    ModelQuality,
    QualityConfig,
    QualityTask,
    Runner,
    Shapes,
    measure_quality,
)
from shapespace.model.representation import representation_named
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import BySize, Measured, Quality, json_text, to_json
from shapespace.store.corresponding import SURFACE, review_summary, reviewed_surfaces, surface_stem
from shapespace.types import FloatArray, Mesh

_SURFACES = (".dense.ply", ".fitted.ply", SURFACE)
_UNITS = {
    "compactness": "of the variance",
    "generalisation": "mm, surface to surface, on held-out shapes",
    "generalisation_vertices": "mm, vertex to vertex, on held-out shapes",
    "specificity": "mm, surface to surface, from random shapes to the nearest one",
    "specificity_vertices": "mm, vertex to vertex, from random shapes to the nearest one",
    "reconstruction": "mm, surface to surface, on unseen shapes",
    "reconstruction_vertices": "mm, vertex to vertex, on unseen shapes",
}
"""Measures, and the meaning of their numbers."""
_MOST_TARGETS = 2  # differences are computed between two targets


_FEW_VERTICES = 200_000
"""Vertices of all shapes below which a measurement takes less time than starting workers."""


@dataclass(frozen=True)
class QualityOptions:
    """Measures of quality, and the data that they refer to.

    Args:
        representations: vertices, control points, or shapes and relative poses of several parts (articulated) that the
            modes change, one choice for all targets or one for each; with two choices, one target is compared with
            itself (default: articulated for surfaces of several parts, otherwise vertices).
        scans: folder of the scans that the surfaces were made from, with the same names, pose and unit: distances are
            measured to these.
        unseen: folder of corresponding shapes that no model was trained on: also measure the error on these.
        with_doubtful: include doubtful corresponding surfaces (default: excluded, and counted), and use a
            correspondence in which more than half of the surfaces need review.

    Raises:
        InputError: representations that do not exist.
    """

    representations: Sequence[str] = ()
    scans: Path | None = None
    unseen: Path | None = None
    with_doubtful: bool = False

    def __post_init__(self) -> None:
        for name in self.representations:
            representation_named(name, None)


@dataclass(frozen=True, eq=False)
class _QualityInput:
    """A model or meshes in correspondence, with a name that distinguishes it from the other target."""

    name: str
    data: ShapeModel | Sequence[Mesh]
    config: QualityConfig
    unit_ratios: Mapping[str, float] = field(default_factory=dict[str, float])
    """Unit ratios of meshes by their names without endings, see `CorrespondRecord`."""

    @property
    def names(self) -> list[str]:
        """Names of its meshes, without endings."""
        return [] if isinstance(self.data, ShapeModel) else [surface_stem(Path(mesh.name)) for mesh in self.data]


def quality(
    targets: Sequence[Path],
    output: Path,
    config: QualityConfig,
    options: QualityOptions,
    execution: ExecutionConfig,
    *,
    quiet: bool,
) -> Outcome:
    """Measure one target or two, and write `quality.json` and the curves.

    Args:
        targets: models, or folders of meshes in correspondence; all meshes that are given are one target.
        output: the folder to write to.
        config: folds, modes, samples, seed and gauge.
        options: measures and the data that they need.
        execution: executor of the folds and of the random shapes.
        quiet: no progress.

    Raises:
        FileError: something cannot be read or written.
        CorrespondenceError: meshes of one target differ in vertices or triangles.
        InputError: targets that do not exist, too few meshes, or two targets with different shapes.
    """
    notes: list[str] = []
    loaded = _load_targets(targets, config, options, notes, quiet=quiet)
    make_folder(output)
    run = QualityRunner(execution, output, quiet)
    measured = [_measure(target, options, run, quiet=quiet) for target in loaded]
    parts = [_as_quality(t, m, options) for t, m in zip(loaded, measured, strict=True)]
    notes += [
        _missing_sentence(t, m) for t, m in zip(loaded, measured, strict=True) if m.missing_share or m.left_out_vertices
    ]
    result = parts[0]
    if len(parts) > 1:
        differences = {name: _measured_curve(c) for name, c in measured[0].differences(measured[1]).items()}
        comparison = _comparison_sentences(loaded, measured[0].differences(measured[1]))
        result = structs.replace(
            result, others=(parts[1],), differences=differences, sentences=(*result.sentences, *comparison)
        )
    notes += [
        f"{target.name} is a model file: only compactness is computed; generalisation and specificity need the folder "
        "of its meshes" + ("." if options.unseen else "; --unseen FOLDER measures it on shapes that it did not see.")
        for target in loaded
        if isinstance(target.data, ShapeModel)
    ]
    write_text(output / "quality.json", json_text(result))
    with waiting("drawing the curves", quiet=quiet):
        _draw(result, output, notes)
    lines = [line for item in (result, *result.others) for line in quality_lines(item)]
    lines += [*result.sentences, f"All numbers are in {output / 'quality.json'}"]
    return Outcome({"folder": str(output), **to_json(result)}, lines, notes)


def quality_lines(quality: Quality) -> list[str]:
    """Return one line for each measure at its largest number of modes."""
    out: list[str] = [quality.name]
    for key, unit in _UNITS.items():
        measure = getattr(quality, key)
        if measure is not None:
            band = f" (95 %: {measure.low[-1]:.3f} to {measure.high[-1]:.3f})" if measure.low != measure.mean else ""
            out.append(f"  {key.split('_')[0]}, {measure.modes[-1]:g} modes: {measure.mean[-1]:.3f}{band} {unit}")
    return out


def _load_targets(
    paths: Sequence[Path], config: QualityConfig, options: QualityOptions, notes: list[str], *, quiet: bool
) -> list[_QualityInput]:
    names = list(options.representations)
    meshes = [path for path in paths if path.is_file() and not looks_like_model(path)]
    targets = [*([path] for path in paths if path not in meshes), *([meshes] if meshes else [])]
    if len(targets) > _MOST_TARGETS or len(names) > _MOST_TARGETS:
        raise InputError("At most two targets or representations are compared; give one or two.")
    gauge = config.gauge if config.align else "form"
    loaded: list[tuple[ShapeModel | list[Mesh], dict[str, float], Mapping[str, int]]] = [
        (ShapeModel.load(target[0]), {}, {})
        if not target[0].is_dir() and looks_like_model(target[0])
        else _read_meshes(target, notes, gauge, options, quiet=quiet)
        for target in targets
    ]
    names = names or ["articulated" if parts else "vertices" for _, _, parts in loaded]
    pairs = [(k, names[min(k, len(names) - 1)]) for k in range(len(targets))]
    if len(targets) == 1 and len(names) == _MOST_TARGETS:
        pairs = [(0, name) for name in names]
    several = len({name for _, name in pairs}) > 1
    out: list[_QualityInput] = []
    for k, name in pairs:
        called = f"{_name(targets[k])}, {name}" if several else _name(targets[k])
        data, unit_ratios, parts = loaded[k]
        out.append(_QualityInput(called, data, _config_of_representation(config, name, names, parts), unit_ratios))
    if len(out) == _MOST_TARGETS and not any(isinstance(target.data, ShapeModel) for target in out):
        _check_same_shapes(out)
    return out


def _config_of_representation(
    config: QualityConfig, name: str, names: Sequence[str], parts: Mapping[str, int]
) -> QualityConfig:
    """Return the configuration of one representation; `vertices`, compared with B-splines, has no control points."""
    return replace(
        config,
        representation=name,
        control_points=config.control_points if name != "vertices" or set(names) == {"vertices"} else None,
        parts=dict(parts) if name == "articulated" else None,
    )


def _check_same_shapes(targets: Sequence[_QualityInput]) -> None:
    first, second = (target.names for target in targets)
    if len(first) != len(second) or (first != second and set(first) & set(second)):
        lacking = sorted(set(first) ^ set(second))
        names_text = f" ({', '.join(lacking[:3])})" if lacking else ""
        raise InputError(
            f"{targets[0].name} has {len(first)} shapes and {targets[1].name} {len(second)}, and they are compared "
            f"shape by shape; give the same ones in both{names_text}."
        )


def _name(target: Sequence[Path]) -> str:
    return str(target[0]) if len(target) == 1 else f"{len(target)} meshes of {target[0].parent}"


def _read_meshes(
    target: Sequence[Path], notes: list[str], gauge: Gauge, options: QualityOptions, *, quiet: bool
) -> tuple[list[Mesh], dict[str, float], Mapping[str, int]]:
    """Return the meshes of a target in the unit of most meshes, the unit ratios of the others, and their parts."""
    listed, review = reviewed_surfaces(target, "--with-doubtful", with_doubtful=options.with_doubtful)
    if summary := review_summary(review):
        notes.append(f"{_name(target)}: {summary}.")
    notes += listed.notes
    if gauge == "form":
        listed.refuse_mixed_units()
    if listed.unit_ratios:
        notes.append(listed.unit_note("mm"))
    files = list(listed.files)
    for ending in _SURFACES:
        if surfaces := [file for file in files if file.name.endswith(ending)]:
            if len(surfaces) < len(files):
                count = len(surfaces)
                notes.append(f"{_name(target)}: of {len(files)} meshes the {count} that end in {ending} are taken.")
            files = surfaces
            break
    meshes = SurfacesOnDisk(files, listed).read(quiet=quiet)
    return meshes, {surface_stem(file): ratio for file, ratio in listed.unit_ratios.items()}, listed.parts


def _read_scans(target: _QualityInput, folder: Path | None, *, quiet: bool) -> list[Mesh] | None:
    """Return the scans of the meshes of a target, in their order; None if no scans are given or needed."""
    if folder is None or isinstance(target.data, ShapeModel):
        return None
    by_name = {surface_stem(file): file for file in mesh_files([folder]).files}
    lacking = [name for name in target.names if name not in by_name]
    if lacking:
        raise InputError(f"{folder} has no scan of {', '.join(lacking[:3])}; scans are named as the surfaces are.")
    with progress(len(target.names), "reading", "scan", quiet=quiet) as bar:
        out: list[Mesh] = []
        for name in target.names:
            scan, ratio = read_mesh(by_name[name]), target.unit_ratios.get(name, 1.0)
            vertices = scan.vertices if ratio == 1.0 else scan.vertices / ratio  # in the unit of most
            out.append(replace(scan, vertices=vertices, name=by_name[name].name))
            bar.update()
    for scan in out:
        if not len(scan.vertices) or not np.isfinite(scan.vertices).all():
            raise MeshError(
                f"{scan.name}: its vertices are missing or not finite, so it cannot evaluate a model; "
                "repair or remove it."
            )
    return out


def _measure(target: _QualityInput, options: QualityOptions, run: Runner, *, quiet: bool) -> ModelQuality:
    unseen = [] if options.unseen is None else _read_meshes([options.unseen], [], "shape", options, quiet=quiet)[0]
    scans = _read_scans(target, options.scans, quiet=quiet)
    with steps(None, f"measuring {target.name}, in", "step", quiet=quiet) as step:
        return measure_quality(target.data, target.config, scans=scans, unseen=unseen, progress=step, run=run)


def _missing_sentence(target: _QualityInput, result: ModelQuality) -> str:
    text = (
        f"{target.name}: {100 * result.missing_share:.1f} % of the vertices are missing, and nothing is measured there"
    )
    if not result.left_out_vertices:
        return f"{text}."
    number = "1 vertex" if result.left_out_vertices == 1 else f"{result.left_out_vertices} vertices"
    return f"{text}; {number} that fewer than half of the meshes show {'is' if number[:2] == '1 ' else 'are'} excluded."


def _measured_curve(curve: Curve) -> Measured:
    low, high = tuple(curve.low.tolist()), tuple(curve.high.tolist())
    return Measured(mean=tuple(curve.mean.tolist()), modes=tuple(curve.counts.tolist()), low=low, high=high)


def _as_quality(target: _QualityInput, result: ModelQuality, options: QualityOptions) -> Quality:
    curves: dict[str, Curve | None] = {name: getattr(result, name) for name in _UNITS}
    size, by_shapes = result.by_shapes, None
    if size is not None:
        mean, low, high = (tuple(values.tolist()) for values in (size.mean, size.low, size.high))
        by_shapes = BySize(shapes=tuple(size.counts.tolist()), mean=mean, low=low, high=high)
    quality = Quality(
        name=target.name,
        generalisation_by_shapes=by_shapes,
        supported_modes=result.supported_modes,
        sentences=result.sentences(),
        settings={
            **asdict(target.config),
            "folds": result.folds,
            "shapes": result.shapes,
            "points": result.points,
            "missing_share": result.missing_share,
            "left_out_vertices": result.left_out_vertices,
            "scans": None if options.scans is None else str(options.scans),
            "unseen": None if options.unseen is None else str(options.unseen),
        },
    )
    measured = {name: _measured_curve(curve) for name, curve in curves.items() if curve is not None}
    return structs.replace(quality, **measured)


def _comparison_sentences(targets: Sequence[_QualityInput], differences: dict[str, Curve]) -> list[str]:
    """Return in a sentence which of two generalises better, with all modes."""
    curve = differences.get("generalisation", differences.get("reconstruction"))
    if curve is None:
        return []
    off, low, high = (float(values[-1]) for values in (curve.mean, curve.low, curve.high))
    difference = (
        f"the surfaces of {targets[1].name} are off by {off:+.3f} mm (95 %: {low:+.3f} to {high:+.3f}) against "
        f"{targets[0].name}"
    )
    verdict = "no difference shows" if low <= 0 <= high else f"{targets[0 if off > 0 else 1].name} is better"
    return [f"On unseen shapes with {curve.counts[-1]} modes {difference}: {verdict}."]


def _draw(result: Quality, output: Path, notes: list[str]) -> None:
    """Write the curves as PNG and SVG, if the extra `report` is installed."""
    if importlib.util.find_spec("matplotlib") is None or importlib.util.find_spec("PIL") is None:
        notes.append('The curves are not drawn; install the drawing packages with pip install "shapespace[report]".')
        return
    from shapespace.report import figures

    figures.save_figure(figures.quality_figure(result), output / "quality", ("png", "svg"))


@dataclass(frozen=True)
class QualityRunner:
    """Runs the parts of a measurement by an executor.

    Args:
        execution: Executor of the parts; a small measurement runs in this process unless another executor is requested.
        folder: folder that all workers see, for a file with the shapes during the measurement; made if absent.
        quiet: whether workers do not report that code is compiled.
    """

    execution: ExecutionConfig
    folder: Path
    quiet: bool

    def __call__(self, shapes: Shapes, parts: Sequence[QualityTask]) -> Iterator[tuple[QualityTask, FloatArray]]:
        """Yield each of `parts` with its errors, in any order.

        Raises:
            FileError: the shapes cannot be written.
            FitError: no workers are left, or a part was given up.
        """
        small = sum(len(mesh.vertices) for mesh in shapes.meshes) < _FEW_VERTICES
        serial = small and self.execution.kind == "local" and not self.execution.jobs
        executor = Serial() if serial else self.execution.executor(len(parts), quiet=self.quiet)
        with (
            Shared.by(executor, shapes, self.folder) as shared,
            executor.run(QualityWork(shared), parts) as results,
        ):
            for part, (errors, reason) in results:
                if errors is None:
                    raise FitError(f"A part of the measurement could not be done: {reason}; run it with fewer --jobs.")
                yield part, errors


@dataclass(frozen=True)
class QualityWork:
    """Measures parts, for an executor.

    Args:
        shapes: shapes and models that all parts share.
    """

    shapes: Shared[Shapes]

    def do(self, part: QualityTask) -> tuple[FloatArray | None, str]:
        """Return the errors of one part.

        Raises:
            InputError: the scans do not belong to the surfaces.
        """
        return self.shapes.value().do(part), ""

    def give_up(self, _part: QualityTask, reason: str) -> tuple[FloatArray | None, str]:
        """Return no errors and the reason."""
        return None, reason
