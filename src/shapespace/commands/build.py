"""Command `build`: meshes in correspondence to a model file."""

from __future__ import annotations

import argparse
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from shapespace.batch.fit_records import read_record
from shapespace.batch.progress import progress, waiting
from shapespace.batch.result_folder import RECORD
from shapespace.cohort.table import names_of_file, read_labels
from shapespace.commands.inputs import SurfacesOnDisk
from shapespace.commands.look import model_facts, training_shapes_note
from shapespace.commands.outcome import Outcome
from shapespace.datasets.about import ABOUT, read_about
from shapespace.errors import InputError, ShapespaceError
from shapespace.geometry.landmark_placement import far_landmarks, landmarks_in_frame_of, place_landmarks
from shapespace.geometry.procrustes import Gauge
from shapespace.io.files import make_folder, read_error
from shapespace.io.landmarks.landmark_io import is_of_vertices, read_landmarks, read_region, read_surface_landmarks
from shapespace.model.build_model import BuildConfig, build_model, extend_model
from shapespace.model.missing import MIN_SEEN, ObservedMeshes
from shapespace.model.representation import representation_named
from shapespace.model.shape_model import ShapeModel, odd_size_notes, region_vertices
from shapespace.model.streamed import Scratch, streaming_note
from shapespace.recognise.labelled_scans import NEUTRAL
from shapespace.reprs import first_names
from shapespace.schemas import FitRecord
from shapespace.store.corresponding import provenance_with_review, review_summary, reviewed_surfaces
from shapespace.store.results import is_result
from shapespace.types import MM_PER_UNIT, Mesh, SurfaceLandmarks
from shapespace.version import __version__

if TYPE_CHECKING:
    from shapespace.model.additive import AdditiveModel

# shares of variance of identity and of expression in an additive model when the number of modes is automatic
_IDENTITY_VARIANCE, _EXPRESSION_VARIANCE = 0.995, 0.99
_SURFACES = (".dense.ply", ".fitted.ply")
_NAMED = 3  # names in a message, so that it stays short


@dataclass(frozen=True, kw_only=True)
class BuildFilesConfig:
    """Options of a model that is built from files.

    Args:
        model: options of the model; its gauge, landmarks and share of observed vertices are those below.
        gauge: `form`: size is part of the modes, and fits are rigid; `shape`: size is divided out, and fits have a free
            scale (default: shape, or that of the model added to).
        unit: unit of the meshes.
        min_seen: remove vertices that fewer than this share of the meshes show, with their triangles and landmarks;
            missing vertices are nan in the files (default: 0.5).
        landmarks: landmarks of the model: points on the first mesh in any landmark format, a CSV of name,vertex, or
            `landmarks.csv` of a correspondence (default: landmarks.csv next to the first mesh, otherwise those of the
            model of fitted surfaces).
        regions: name -> file with the vertices of this region of the meshes. The model stores the regions, and fits can
            be restricted to a region.
        labels: separate identity and expression: CSV of file, subject and label, with a neutral face of each subject;
            the number of modes then counts modes of identity (`auto`: 0.995 of the variance).
        expression_variance: share of the expression variance that the expression modes explain, for a model of identity
            and expression (default 0.99).
        keep_shapes: keep the aligned shapes next to the model (MODEL.h5.shapes), so that meshes can be added later, 4
            bytes per coordinate of a mesh.
        add: add the meshes to this model, which was built with its shapes kept; gauge, alignment and landmarks are
            those of that model.
        recursive: also search subfolders of the given folders.
        with_doubtful: include surfaces of doubtful fits and doubtful corresponding surfaces (default: excluded, and
            counted), and use a correspondence in which more than half of the surfaces need review.

    Raises:
        InputError: options that exclude each other.
    """

    model: BuildConfig = field(default_factory=BuildConfig)
    gauge: Gauge | None = None
    unit: str = "mm"
    min_seen: float | None = None
    landmarks: Path | None = None
    labels: Path | None = None
    expression_variance: float | None = None
    keep_shapes: bool = False
    add: Path | None = None
    recursive: bool = False
    with_doubtful: bool = False
    regions: Mapping[str, Path] = field(default_factory=dict[str, Path])

    def __post_init__(self) -> None:
        representation_named(self.model.representation, self.model.control_points)
        if self.labels is None and self.expression_variance is not None:
            raise InputError("--expression-variance belongs to --additive LABELS.csv; give both, or neither.")
        if self.labels is not None and self.model.representation != "vertices":
            raise InputError("A model of identity and expression contains vertices; omit --representation.")
        if self.min_seen is not None and (self.labels is not None or self.model.representation != "vertices"):
            raise InputError("--min-seen is for models of vertices without --additive; omit --min-seen.")
        if self.labels is not None and not self.model.align:
            raise InputError("A model that separates identity and expression aligns its faces itself; omit --no-align.")
        if self.streams and (self.labels is not None or self.model.representation != "vertices"):
            raise InputError(
                "--out-of-core, --keep-shapes and --add are for models of vertices without --additive; omit these "
                "options, or omit --representation and --additive."
            )
        if self.streams and self.min_seen is not None:
            raise InputError("Streamed meshes must be complete, so omit --min-seen.")
        if self.add is not None and (self.gauge is not None or not self.model.align or self.landmarks is not None):
            raise InputError(
                "--add takes gauge, alignment and landmarks from the model; omit --gauge, --no-align and --landmarks."
            )
        if self.regions and (self.keep_shapes or self.add is not None):
            raise InputError(
                "--region cannot be combined with --keep-shapes or --add; omit --region, and give the file to fit."
            )

    @property
    def streams(self) -> bool:
        """Whether the meshes are streamed even if they would fit in memory."""
        return bool(self.model.out_of_core) or self.keep_shapes or self.add is not None

    @property
    def of_vertices(self) -> bool:
        """Whether it is a model of vertices without separate expression modes; only its meshes can be streamed."""
        return self.labels is None and self.model.representation == "vertices"


def build(
    meshes: Sequence[Path], output: Path, config: BuildFilesConfig, *, quiet: bool
) -> tuple[ShapeModel, list[str]]:
    """Build a model from mesh files and save it; return it with notes for the user.

    Surfaces of fits are read with their records: surfaces of doubtful fits are excluded unless they are requested, and
    the landmarks and parts of the model of the fits are used.

    Raises:
        FileError: a mesh cannot be read, or the model not written.
        FileFormatError: the record next to a surface is damaged.
        MeshError: a mesh without vertices, or with faces that point past their end.
        CorrespondenceError: the meshes differ in vertices or triangles.
        InputError: too few meshes, no variation, too many modes, or a model to which no meshes can be added.
    """
    if output.suffix.lower() not in (".h5", ".hdf5"):
        raise InputError(f"{output}: a model file is HDF5, so give it a name that ends in .h5.")
    listed, review = reviewed_surfaces(
        meshes, "--with-doubtful", recursive=config.recursive, with_doubtful=config.with_doubtful
    )
    notes = [*([f"{summary}."] if (summary := review_summary(review)) else []), *listed.notes]
    parent = None if config.add is None else _load_parent(config.add, output)
    gauge = parent.gauge if parent is not None else config.gauge or "shape"
    if gauge == "form" or not config.model.align:
        listed.refuse_mixed_units()
    files, records = _exclude_doubtful(listed.files, notes, with_doubtful=config.with_doubtful)
    make_folder(output.absolute().parent)
    on_disk = SurfacesOnDisk(files, listed, config.unit, ", so no shape model can be built from it; omit it")
    streamed = config.streams or (
        config.of_vertices
        and bool(streaming_note(on_disk, modes=config.model.modes, out_of_core=config.model.out_of_core))
    )
    loaded = [] if streamed else on_disk.read(quiet=quiet)
    first = on_disk[0] if streamed else loaded[0]
    if listed.unit_ratios:
        notes.append(listed.unit_note(config.unit))
    fitted = _model_of_fits(files, records, first)
    marks = SurfaceLandmarks() if parent is not None else _find_landmarks(files, fitted, first, config, notes)
    regions = {
        name: region_vertices(read_region(file), len(first.vertices), name) for name, file in config.regions.items()
    }
    config = _with_origin(files, config, notes)
    provenance = provenance_with_review(config.model.provenance, review)
    chosen = replace(
        config.model,
        gauge=gauge,
        landmarks=marks,
        provenance=provenance,
        min_seen=MIN_SEEN if config.min_seen is None else config.min_seen,
        parts=dict(listed.parts) or (None if isinstance(fitted, str) else fitted.part_counts or None),
    )
    config = replace(config, model=chosen)
    additive = None
    if streamed:
        model = _build_streamed(on_disk, output, config, parent, quiet=quiet)
    else:
        with waiting(f"aligning {len(files)} meshes and finding their modes", quiet=quiet):
            if config.labels is not None:
                additive, unmatched = _fit_additive(files, loaded, config.labels, config)
                notes += unmatched
                notes.append(
                    f"It parts {additive.n_identity} modes of identity and {additive.n_expression} of expression, by "
                    f"{config.labels}."
                )
                model = additive.shape
            else:
                model = build_model(loaded, replace(chosen, out_of_core=False))
    if regions:
        used = ~np.isin(np.arange(len(first.vertices)), model.dropped_vertices)
        model = replace(model, regions=ObservedMeshes(loaded, used).regions(regions))
    (model if additive is None else replace(additive, shape=model)).save(output)
    if config.keep_shapes:
        size = sum(file.stat().st_size for file in shapes_folder(output).iterdir())
        notes.append(f"The shapes are kept in {shapes_folder(output)} ({size / 1e6:.1f} MB), for --add.")
    odd = [] if config.unit == "mm" else odd_size_notes(model.mean_vertices)
    return model, [*notes, *(note for note in model.notes if note not in odd), training_shapes_note(model)]


def build_from_files(
    meshes: Sequence[Path],
    output: Path,
    model: BuildConfig,
    config: BuildFilesConfig,
    *,
    variance: float | None,
    region: Sequence[tuple[str, Path]],
    arguments: argparse.Namespace,
    quiet: bool,
) -> Outcome:
    """Build a model from mesh files and save it.

    Args:
        meshes: files and folders.
        output: the model file.
        model: options of the model.
        config: other options.
        variance: share of the variance that determines the number of modes, or None.
        region: names of regions and files of their vertices.
        arguments: arguments of the command line; `goes_on`, the end of the message on an interruption, is set.
        quiet: no progress.

    Raises:
        FileError, FileFormatError, MeshError, CorrespondenceError, InputError: as for `build`.
    """
    model = model if variance is None else replace(model, modes=variance)
    config = replace(config, model=model, regions=dict(region))
    if config.streams:
        arguments.goes_on = "; the same command continues from there"
    built, notes = build(meshes, output, config, quiet=quiet)
    facts = model_facts(built)
    line = (
        f"{output}: {facts['modes']} modes of {facts['vertices']} vertices from {facts['training_shapes']} meshes, "
        f"{100 * facts['variance_held']:.2f} % of "
        f"{'the variance of held-out subjects' if built.held_out else 'their variance'}, gauge {facts['gauge']}"
    )
    return Outcome({"model": str(output), **facts}, [line], notes)


def shapes_folder(model: Path) -> Path:
    """Return the folder where --keep-shapes keeps the shapes of the model in that file."""
    return model.with_name(f"{model.name}.shapes")


def _load_parent(path: Path, output: Path) -> ShapeModel:
    """Return the model that meshes are added to.

    Raises:
        InputError: no meshes can be added to the model.
    """
    if path.absolute() == output.absolute():
        raise InputError(f"{output} is the model that meshes are added to; give another name for the new model.")
    model = ShapeModel.load(path)
    if model.held_out or model.representation != "vertices":
        reason = (
            "separates identity and expression" if model.held_out
            else "is of B-spline surfaces" if model.is_linear else "is of shapes and relative poses"
        )  # fmt: skip
        raise InputError(f"{path} {reason}, and meshes can be added only to plain models of vertices; build it again.")
    return model


def _build_streamed(
    meshes: SurfacesOnDisk, output: Path, config: BuildFilesConfig, parent: ShapeModel | None, *, quiet: bool
) -> ShapeModel:
    """Build a model of meshes that are not held in memory."""
    scratch = Scratch(output.with_name(f"{output.name}.build"), _hash_inputs(meshes, config, parent))
    shapes_kept_in = shapes_folder(output) if config.keep_shapes else None
    with progress(None, "streaming", "mesh", quiet=quiet) as bar:
        log = bar.set_description_str
        if parent is None or config.add is None:
            chosen = replace(config.model, out_of_core=config.model.out_of_core or config.keep_shapes or None)
            return build_model(meshes, chosen, scratch=scratch, keep_shapes=shapes_kept_in, log=log)
        chosen = replace(
            config.model,
            provenance=_join_texts(parent.provenance, config.model.provenance),
            licence=_join_texts(parent.licence, config.model.licence),
        )
        shapes = shapes_folder(config.add)
        return extend_model(parent, meshes, shapes, chosen, scratch=scratch, keep_shapes=shapes_kept_in, log=log)


def _join_texts(old: str, new: str) -> str:
    return old if new in ("", old) else f"{old}; {new}" if old else new


def _hash_inputs(meshes: SurfacesOnDisk, config: BuildFilesConfig, parent: ShapeModel | None) -> str:
    """Return a hash of all inputs of a streamed build."""
    digest = hashlib.sha256(
        repr((__version__, replace(config, model=replace(config.model, provenance="", licence="")))).encode()
    )
    digest.update(repr(None if parent is None else parent.content_hash).encode())
    for file in meshes.files:
        try:
            about = file.stat()
        except OSError as error:
            raise read_error(file, error) from error
        digest.update(repr((str(file.absolute()), about.st_size, about.st_mtime_ns)).encode())
    return digest.hexdigest()


def _exclude_doubtful(
    files: Sequence[Path], notes: list[str], *, with_doubtful: bool
) -> tuple[list[Path], dict[Path, FitRecord]]:
    """Return `files` without surfaces of doubtful fits, and the records of those that are surfaces of fits."""
    records: dict[Path, FitRecord] = {}
    for file in files:
        name = next((file.name.removesuffix(ending) for ending in _SURFACES if file.name.endswith(ending)), None)
        if name is not None and is_result(record_file := file.with_name(f"{name}{RECORD}")):
            record = read_record(record_file)
            records[file] = FitRecord(status=record.status, model=record.model)  # all of each would be large
    doubtful = [file for file in files if file in records and records[file].status == "doubtful"]
    if not doubtful:
        return list(files), records
    named = first_names([file.name for file in doubtful], _NAMED)
    count_text = (
        "1 surface of a doubtful fit is" if len(doubtful) == 1 else f"{len(doubtful)} surfaces of doubtful fits are"
    )
    if with_doubtful:
        notes.append(f"{count_text} taken too ({named}).")
        return list(files), records
    left = [file for file in files if file not in set(doubtful)]
    if not left:
        raise InputError(
            f"All meshes are surfaces of doubtful fits ({named}); --with-doubtful takes them all the same."
        )
    notes.append(f"{count_text} excluded ({named}); --with-doubtful includes them.")
    return left, {file: records[file] for file in left if file in records}


def _find_landmarks(
    files: Sequence[Path],
    fitted: ShapeModel | str,
    first: Mesh,
    config: BuildFilesConfig,
    notes: list[str],
) -> SurfaceLandmarks:
    """Return the landmarks: the given ones, those next to the first mesh, or those of the model of the fits."""
    mm = MM_PER_UNIT[config.unit]
    if config.landmarks is not None:
        return _read_landmarks(config.landmarks, first, mm, notes)
    landmark_file = files[0].parent / "landmarks.csv"
    if landmark_file.is_file():
        try:
            marks = _read_landmarks(landmark_file, first, mm, placed := list[str]())
        except ShapespaceError as error:
            notes.append(f"The model has no landmarks, since {landmark_file} cannot be used: {error}")
            return SurfaceLandmarks()
        notes += [f"Landmarks are taken from {landmark_file}.", *placed]
        return marks
    if isinstance(fitted, str):
        notes += [f"The model has no landmarks, since {fitted}."] if fitted else []
        return SurfaceLandmarks()
    if fitted.landmarks:
        notes.append(f"Landmarks are those of {fitted.file}, which fitted these meshes.")
    return fitted.landmarks


def _model_of_fits(files: Sequence[Path], records: Mapping[Path, FitRecord], first: Mesh) -> ShapeModel | str:
    """Return the one model that fitted all `files`, whose vertices have the order of the model.

    Without such a model, return the reason as a clause; it is empty if the files are not surfaces of fits.
    """
    models = [record.model for record in records.values()]
    if len(records) < len(files) or not all(model.hash for model in models):
        return ""
    if len({model.hash for model in models}) > 1:
        return "the meshes were fitted by different models; give --landmarks"
    path = files[0].parent / (models[0].path or models[0].name)
    try:
        parent = ShapeModel.load(path)
    except ShapespaceError:
        return f"the model that fitted these meshes is no longer at {path}"
    if parent.content_hash != models[0].hash or parent.n_vertices != len(first.vertices):
        return f"{path} is not the model that fitted these meshes"
    return parent


def _read_landmarks(path: Path, first: Mesh, mm: float, notes: list[str]) -> SurfaceLandmarks:
    """Return landmarks from a file of vertices or triangles, or of points on the first mesh in the meshes' own unit.

    For points, the notes state their distances from the surface.
    """
    if path.suffix.lower() == ".csv" and is_of_vertices(path):
        return read_surface_landmarks(path)
    points, turned = landmarks_in_frame_of(first, {name: mm * point for name, point in read_landmarks(path).items()})
    placed = place_landmarks(first, points)
    distance, worst = placed.distance_mm, int(placed.distance_mm.argmax())
    notes += [f"{path.name}: {sentence}" for sentence in turned]
    notes.append(
        f"Landmarks were placed on the surface of {first.name}; the given points are {distance.mean():.2g} mm from it "
        f"on average, at most {distance[worst]:.2g} mm ({placed.names[worst]})."
    )
    notes += far_landmarks(first, placed)
    return placed


def _with_origin(files: Sequence[Path], config: BuildFilesConfig, notes: list[str]) -> BuildFilesConfig:
    """Return the configuration with provenance and licence, read from the folder of the meshes if none was given."""
    abouts = {folder: read_about(folder) for folder in dict.fromkeys(file.parent for file in files)}
    about = abouts[files[0].parent]
    if about and not (config.model.provenance or config.model.licence):
        if len(set(abouts.values())) == 1:
            notes.append(f"Provenance and licence are taken from {files[0].parent / ABOUT}.")
            return _with_provenance(config, f"{len(files)} meshes of: {about[0]}", about[1])
        notes.append("The meshes come from folders of different origin, so give --provenance and --licence.")
    provenance = config.model.provenance or f"{len(files)} meshes, {files[0].name} to {files[-1].name}"
    return _with_provenance(config, provenance, config.model.licence)


def _with_provenance(config: BuildFilesConfig, provenance: str, licence: str) -> BuildFilesConfig:
    return replace(config, model=replace(config.model, provenance=provenance, licence=licence))


def _fit_additive(
    files: Sequence[Path],
    meshes: Sequence[Mesh],
    labels: Path,
    config: BuildFilesConfig,
) -> tuple[AdditiveModel, list[str]]:
    from shapespace.model.additive import AdditiveModel

    mesh_labels, notes = read_labels(labels).match([names_of_file(file.resolve()) for file in files], "the meshes")
    own = [label for label in mesh_labels if label is not None and label.subject]
    if len(own) < len(files):
        lacking = [
            file.name for file, label in zip(files, mesh_labels, strict=True) if label is None or not label.subject
        ]
        raise InputError(
            f"{labels} has no subject for {', '.join(lacking[:3])}; each mesh needs a label and a subject."
        )
    expression_modes = config.expression_variance
    model = AdditiveModel.fit(
        meshes,
        [label.subject for label in own],
        [label.text == NEUTRAL for label in own],
        identity_modes=_IDENTITY_VARIANCE if config.model.modes == "auto" else config.model.modes,
        expression_modes=_EXPRESSION_VARIANCE if expression_modes is None else expression_modes,
        gauge=config.model.gauge,
        landmarks=config.model.landmarks,
        provenance=config.model.provenance,
        licence=config.model.licence,
    )
    return model, notes
