"""Cohorts from files: fit results, or surfaces in correspondence, with a table of covariates."""

from __future__ import annotations

import contextlib
import json
import os
import tomllib
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast, get_args

import numpy as np

from shapespace.cohort.cohort import SUBJECT, Cohort, FitDiagnostics, ShapeSource, parts_of_model
from shapespace.cohort.landmark_cohort import has_landmarks, landmark_cohort, read_landmark_cohort
from shapespace.cohort.orientation import find_orientation
from shapespace.cohort.shape_samples import ENDING, SampleFile, find_samples
from shapespace.cohort.table import Table, list_names, match_rows, name_key, names_of_file, read_table
from shapespace.errors import FileFormatError, InputError
from shapespace.geometry.procrustes import Gauge
from shapespace.io.files import read_bytes, write_text
from shapespace.io.landmarks.landmark_io import read_surface_landmarks
from shapespace.model.additive import AdditiveModel, load_model
from shapespace.model.shape_model import ShapeModel
from shapespace.store.corresponding import SURFACE, SurfaceFiles, review_summary, surface_files, surface_stem
from shapespace.store.results import Results, modes_of
from shapespace.store.rows import META
from shapespace.types import FloatArray, Mesh, SurfaceLandmarks, read_only

Geometry: TypeAlias = Literal["surface", "landmarks"]
Surfaces: TypeAlias = Literal["auto", "coefficients", "fitted", "dense"]
SURFACES: tuple[Surfaces, ...] = ("auto", "coefficients", "fitted", "dense")
"""Shapes of fits: the model's coefficients, or a surface stored with the record. `auto` is dense if all have one."""

PATHS = ("shapes", "model", "landmarks", "orientation")
"""Fields of `CohortConfig` that are paths."""
COHORT_ENDING = ".toml"
"""Ending of cohort files."""
_LONGEST_FILE = 1_000_000  # bytes of a cohort file
_KINDS = {"a text": str, "a whole number": int, "true or false": bool}  # of values in a cohort file
_OF_QUESTIONS = ("least", "accept_review")
"""Fields of `CohortConfig` that an analysis sets."""
_USED = ("converged", "max_iterations")
_LANDMARKS = "landmarks.csv"
"""Landmarks of all meshes of a folder, as `correspond` writes them."""


@dataclass(frozen=True, kw_only=True)
class CohortConfig:
    """Options for the selection and comparison of shapes.

    Args:
        shapes: folder of results of fits, of meshes in correspondence, or of the output of align; or a landmark file
            (default: the folder of the table).
        model: model file of the fits, if it was moved.
        surfaces: shapes of fits: `coefficients` of the model, its `fitted` surface, or the `dense` surface on the scan;
            `auto` uses dense surfaces if all fits have one, otherwise coefficients.
        gauge: size handling: `form` keeps size, `shape` divides size out.
        doubtful: whether to include doubtful fits and corresponding surfaces (default: excluded, and counted), and to
            use a correspondence in which more than half of the surfaces need review.
        accept_review: whether to use such a correspondence, without its doubtful surfaces (default: the value of
            `doubtful`).
        geometry: analysed part of surfaces with landmarks: the `surface`, or the `landmarks` alone.
        least: smallest number of shapes; a single shape suffices if it is compared with an existing cohort.
        imputations: number of samples of each completed shape (NAME.samples.npz next to NAME.ply) that
            comparisons, regression, asymmetry and scores combine by Rubin's rules; 0 or 1 ignores samples.
        unit: unit of the lengths; `none` for coordinates without a unit, as those of digitised landmarks.
        missing: treatment of shapes with missing values in the table: `drop` excludes them (default: an error).
        subject: column of the subjects (default: subject).
        landmarks: CSV of name,vertex, or landmarks.csv of a correspondence (default: those of the model or the folder).
        orientation: JSON file with named views of the object, such as dorsal, and links between landmarks (default:
            orientation.json and links.csv next to the shapes).
    """

    shapes: Path | str | None = None
    model: Path | str | None = None
    surfaces: Surfaces = "auto"
    gauge: Gauge = "shape"
    doubtful: bool = False
    accept_review: bool | None = None
    geometry: Geometry = "surface"
    least: int = 2
    imputations: int = 20
    unit: Literal["mm", "none"] = "mm"
    missing: Literal["refuse", "drop"] = "refuse"
    subject: str | None = None
    landmarks: Path | str | None = None
    orientation: Path | str | None = None

    def __post_init__(self) -> None:
        if self.imputations < 0:
            raise InputError("CohortConfig: the number of imputations must be 0 or more.")
        for name in PATHS:
            path = getattr(self, name)
            if path is not None and not isinstance(path, str | PathLike):  # pyright: ignore[reportUnnecessaryIsInstance]
                raise InputError(f"CohortConfig: {name} is a path, not {type(path).__name__}; give a str or a Path.")
        for name, value, choices in (
            ("surfaces", self.surfaces, SURFACES),
            ("gauge", self.gauge, get_args(Gauge)),
            ("geometry", self.geometry, get_args(Geometry)),
            ("unit", self.unit, ("mm", "none")),
            ("missing", self.missing, ("refuse", "drop")),
        ):
            if value not in choices:
                raise InputError(f"CohortConfig: there is no {name} {value!r}; choose one of {', '.join(choices)}.")


def is_cohort_file(data: object) -> bool:
    """Return whether data are a path with the ending of cohort files, .toml."""
    return isinstance(data, str | PathLike) and Path(cast("str", data)).suffix.lower() == COHORT_ENDING


def read_cohort_file(path: Path) -> tuple[Path, dict[str, Any]]:
    """Return the data of a cohort file, and the fields of `CohortConfig` that it states.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: the file is not TOML, has no data, or has an unknown setting.
        InputError: a setting has a value that is not allowed.
    """
    again = "write it again with shapespace cohort"
    try:
        stated = tomllib.loads(read_bytes(path, _LONGEST_FILE).decode("utf-8-sig"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError) as error:
        raise FileFormatError(f"{path} is not a TOML file ({str(error)[:100]}); {again}.") from error
    defaults: dict[str, Any] = {field.name: field.default for field in fields(CohortConfig)}
    defaults = {name: value for name, value in defaults.items() if name not in _OF_QUESTIONS}
    for name in ("data", *defaults):
        default = defaults.get(name)
        expected = "true or false" if isinstance(default, bool) else "a whole number"
        expected = "a text" if default is None or isinstance(default, str) else expected
        if (name in stated or name == "data") and type(stated.get(name)) is not _KINDS[expected]:
            raise FileFormatError(f"{path} needs {expected} as its {name}; {again}.")
    if unknown := sorted(stated.keys() - defaults.keys() - {"data"}):
        raise FileFormatError(f"{path} has a setting {unknown[0][:40]!r}, which cohorts do not have; {again}.")
    stated |= {name: path.parent / stated[name] for name in ("data", *PATHS) if name in stated}
    return cast(Path, stated.pop("data")), stated


def write_cohort_file(path: Path | str, data: Path | str, **settings: Any) -> None:
    """Write a cohort file: the data and the settings of a cohort, which all analyses of its shapes read.

    Args:
        path: path of the file, NAME.toml.
        data: table, folder or landmark file.
        settings: fields of `CohortConfig`; fields that are not given keep their default.

    Raises:
        InputError: another ending, or an unknown setting.
        FileError: the file cannot be written.

    Example:
        >>> ss.write_cohort_file("bones.toml", "people.csv", shapes="same", gauge="form")
        >>> from pathlib import Path
        >>> Path("bones.toml").read_text().splitlines()
        ['data = "people.csv"', 'shapes = "same"', 'gauge = "form"']
    """
    path = Path(path)
    if not is_cohort_file(path):
        raise InputError(f"{path} needs the ending {COHORT_ENDING}; give the name of a cohort file.")
    write_text(path, cohort_file_text(path.absolute().parent, data, **settings))


def cohort_file_text(folder: Path, data: Path | str, **settings: Any) -> str:
    """Return the content of a cohort file in `folder`; see `write_cohort_file`."""
    CohortConfig(**settings)
    stated = {"data": data, **{name: value for name, value in settings.items() if value is not None}}
    for name in ("data", *PATHS):
        if name in stated:
            with contextlib.suppress(ValueError):  # another drive: an absolute path
                stated[name] = os.path.relpath(stated[name], folder)
            stated[name] = Path(stated[name]).as_posix()
    return "".join(f"{name} = {json.dumps(value, ensure_ascii=False)}\n" for name, value in stated.items())


def read_cohort(
    data: Path | str | Any,
    config: CohortConfig | None = None,
    *,
    onto: Cohort | None = None,
    on_shape: Callable[[int, int], None] | None = None,
) -> Cohort:
    """Return the shapes of the rows of a table, or of all fits in a folder with the metadata of their records.

    Landmarks are read from a folder that `align` wrote, or from a landmark file, and are then aligned by its defaults.

    Doubtful and failed fits are excluded, counted and reported in the notes, as are rows without a shape and shapes
    without a row.

    Args:
        data: a table whose column `file`, `scan`, `specimen`, `name` or `id` names a shape in each row
            (coefficients.csv is one), as a file or a DataFrame; a folder of results of fits, whose metadata are the
            table; landmarks; or a cohort file (`write_cohort_file`).
        config: selection of the shapes; None for the defaults, or those of the cohort file.
        onto: cohort with which these shapes are to be compared; there may then be a single shape.
        on_shape: function called with (done, total) as surfaces are read.

    Raises:
        FileError: a file cannot be read.
        FileFormatError: a file is damaged, or the table is none.
        InputError: no row has a shape, fits of different models, the same scan twice, fewer than two shapes, or
            settings in addition to those of a cohort file.
        CorrespondenceError: meshes that are not in correspondence.
    """
    if is_cohort_file(data):
        if config is not None:
            raise InputError(f"{data} contains the settings of the cohort; omit config, or give its table.")
        data, stated = read_cohort_file(Path(data))
        config = CohortConfig(**stated)
    config = config or CohortConfig()
    cohort = _read_shapes(data, config, onto, on_shape)
    if config.landmarks is not None and config.geometry != "landmarks":
        cohort = replace(cohort, landmarks=_landmarks_of(Path(config.landmarks), cohort.n_vertices))
    if config.subject is not None:
        columns = {**cohort.table.columns, SUBJECT: cohort.table.texts(config.subject)}
        cohort = replace(cohort, table=replace(cohort.table, columns=columns))
    given: list[Any] = [place for place in (config.shapes, data) if isinstance(place, str | PathLike)]
    places = list(map(Path, given))
    orientation = find_orientation(
        None if config.orientation is None else Path(config.orientation),
        [place if place.is_dir() else place.parent for place in places],
    )
    unit = "" if config.unit == "none" else cohort.unit
    return replace(cohort, unit=unit, drop_missing=config.missing == "drop", orientation=orientation)


def _landmarks_of(path: Path, n_vertices: int) -> SurfaceLandmarks:
    found = read_surface_landmarks(path)
    for name, vertex in zip(found.names, found.corners.max(axis=1).tolist(), strict=True):
        if vertex >= n_vertices:
            raise InputError(
                f"{path}: landmark {name[:40]!r} is at vertex {vertex}, but the surfaces have {n_vertices}; give "
                "landmarks of these surfaces."
            )
    return found


def _read_shapes(
    data: Path | str | Any, config: CohortConfig, onto: Cohort | None, on_shape: Callable[[int, int], None] | None
) -> Cohort:
    given: Table | None = None
    if not isinstance(data, str | PathLike):
        given = data if isinstance(data, Table) else Table.of(data)
        if not config.shapes:
            raise InputError("A table in memory needs the folder of its shapes; give it as CohortConfig(shapes=...).")
        data = config.shapes
    data = Path(cast("str | PathLike[str]", data))
    source = Path(config.shapes) if config.shapes else data
    results = Results(source) if source.is_dir() else None
    if source.exists() and not (results is not None and len(results)) and has_landmarks(source):
        table = given or (data if config.shapes and source != data else None)
        return read_landmark_cohort(source, table, config.gauge, onto, config.least)
    if config.geometry == "landmarks":
        least = 1 if onto is not None else config.least
        surfaces = _read_shapes(given or data, replace(config, geometry="surface", least=least), None, on_shape)
        if surfaces.samples:
            note = (
                "The samples of completed shapes are not used for landmarks, so p does not contain their uncertainty."
            )
            surfaces = replace(surfaces, notes=(*surfaces.notes, note))
        listed = (source if source.is_dir() else source.parent) / _LANDMARKS
        if config.landmarks is not None:
            surfaces = replace(surfaces, landmarks=_landmarks_of(Path(config.landmarks), surfaces.n_vertices))
        elif surfaces.landmarks is None and listed.is_file():
            surfaces = replace(surfaces, landmarks=read_surface_landmarks(listed))
        return replace(landmark_cohort(surfaces, onto), review=surfaces.review)
    table = given or (None if data.is_dir() else read_table(data))
    folder = Path(config.shapes) if config.shapes else (data if table is None else data.parent)
    if not folder.is_dir():
        raise InputError(
            f"{folder} is neither a folder nor a landmark file; give the results of fits, meshes in correspondence, or "
            "landmarks with --shapes."
        )
    results = Results(folder) if folder != source or results is None else results
    if len(results):
        return _cohort_of_results(results, table, config, onto, on_shape)
    if table is None:
        raise InputError(
            f"{folder} contains neither results of fits nor landmark files; give a CSV table of its meshes, and the "
            "folder as --shapes."
        )
    return _cohort_of_surfaces(folder, table, config, onto, on_shape)


@dataclass(frozen=True, eq=False)
class _Row:
    name: str
    status: str
    scan_name: str
    scan_hash: str
    model_hash: str
    b: FloatArray
    b_stddev: FloatArray
    size_mm: float
    mm_per_unit: float
    beyond_mm: float
    known: Mapping[str, str]


def _rows(results: Results) -> list[_Row]:
    modes = range(1, modes_of(results) + 1)
    known = sorted(column for column in results.column_names() if column.startswith(META))
    texts = ("scan", "status", "scan_name", "scan_hash", "model_hash")
    columns = (*texts, "centroid_size_mm", "mm_per_scan_unit", "beyond_model_mm", "modes", *known)
    numbers = [*(f"b{k}" for k in modes), *(f"b{k}_stddev" for k in modes)]
    rows: list[_Row] = []
    for part in results.iter_rows((*columns, *numbers)):
        values = np.array([part[column] for column in numbers], dtype=np.float64).reshape(2, len(modes), -1)
        for index in range(len(part["scan"])):
            n_modes = int(part["modes"][index] or 0)
            rows.append(
                _Row(
                    name=str(part["scan"][index] or ""),
                    status=str(part["status"][index] or ""),
                    scan_name=str(part["scan_name"][index] or ""),
                    scan_hash=str(part["scan_hash"][index] or ""),
                    model_hash=str(part["model_hash"][index] or ""),
                    b=values[0, :n_modes, index],
                    b_stddev=values[1, :n_modes, index],
                    size_mm=_number(part["centroid_size_mm"][index]),
                    mm_per_unit=_number(part["mm_per_scan_unit"][index]),
                    beyond_mm=_number(part["beyond_model_mm"][index]),
                    known={column.removeprefix(META): str(part[column][index] or "").strip() for column in known},
                )
            )
    return sorted(rows, key=lambda row: name_key(row.name))


def _cohort_of_results(
    results: Results,
    table: Table | None,
    config: CohortConfig,
    onto: Cohort | None,
    on_shape: Callable[[int, int], None] | None,
) -> Cohort:
    rows = _rows(results)
    notes = list(results.problems)
    used = (*_USED, "doubtful") if config.doubtful else _USED
    if table is None:
        heads = dict.fromkeys(head for row in rows for head in row.known)
        cells = {head: tuple(row.known.get(head, "") for row in rows) for head in heads}
        table = Table(cells, tuple(row.name for row in rows), str(results.folder))
        pairs = [(row, index) for index, row in enumerate(rows)]
    else:
        matched, unmatched = match_rows(
            table, [(row.name, *names_of_file(row.scan_name)) for row in rows], results.folder
        )
        pairs = [(rows[k], index) for index, k in matched.items()]
        notes += unmatched
    accepted = [(row, index) for row, index in pairs if row.status in used]
    for status, count in Counter(row.status for row, _ in pairs if row.status not in used).items():
        excluded_names = list_names([row.name for row, _ in pairs if row.status == status])
        notes.append(f"{count} of {len(pairs)} fits are excluded, which are {status} ({excluded_names}).")
    least = config.least if onto is None else 1
    if len(accepted) < least:
        raise InputError(
            f"{results.folder}: {len(accepted)} of its fits can be used, and {_count_words(least)} the least; "
            + (notes[-1] if notes else "fit more scans.")
        )
    fits = [row for row, _ in accepted]
    _check_same_model(fits, results.folder)
    model, additive = _model_of(results, fits[0], None if config.model is None else Path(config.model))
    names = tuple(row.name for row in fits)
    stated = replace(table.take([index for _, index in accepted]), rows=names)
    sizes = read_only([row.size_mm for row in fits])
    width = max(len(row.b) for row in fits)
    fitted = FitDiagnostics(
        model=model,
        b=read_only([np.pad(row.b, (0, width - len(row.b))) for row in fits]),
        b_stddev=read_only([np.pad(row.b_stddev, (0, width - len(row.b_stddev))) for row in fits]),
        status=tuple(row.status for row in fits),
        folder=str(results.folder),
        beyond_mm=read_only([row.beyond_mm for row in fits]),
        additive=additive,
    )
    kind = _choose_kind(config.surfaces, results, names, config.gauge, fits, onto)
    if kind == "coefficients":
        cohort = Cohort.of_fits(fitted, names, stated, sizes, config.gauge)
    else:
        without_surface = [name for name in names if not results.has(name, kind)]
        if without_surface:
            dense = " with --dense" if kind == "dense" else ""
            raise InputError(
                f"{results.folder} contains no {kind} surface of {list_names(without_surface)}; fit them again{dense}."
            )
        unknown = [row.name for row in fits if not np.isfinite(row.mm_per_unit)]
        if unknown and config.gauge == "form":
            raise InputError(
                f"The size of {list_names(unknown)} is not known in mm, so forms cannot be compared; fit with --unit, "
                "or compare shapes with --set gauge=shape."
            )
        meshes: list[Mesh] = []
        for index, row in enumerate(fits):
            mesh = results.surface(row.name, kind)
            ratio = row.mm_per_unit if np.isfinite(row.mm_per_unit) else 1.0
            meshes.append(replace(mesh.with_vertices(mesh.vertices * ratio), name=row.name))
            if on_shape is not None:
                on_shape(index + 1, len(fits))
        cohort = replace(
            Cohort.of_meshes(meshes, stated, config.gauge, onto, config.least, parts=parts_of_model(model)),
            fitted=fitted,
            landmarks=model.landmarks,
            sizes_mm=sizes,
            source=fitted.source(kind),
        )
    return replace(cohort, notes=(*notes, *cohort.notes))


def _choose_kind(
    surfaces: Surfaces, results: Results, names: Sequence[str], gauge: Gauge, fits: Sequence[_Row], onto: Cohort | None
) -> Literal["coefficients", "fitted", "dense"]:
    """Return the kind of shapes of fits to read: the requested one, or for `auto` the most complete one."""
    if surfaces != "auto":
        return surfaces
    if onto is not None and onto.fitted is not None and onto.source.kind in ("coefficients", "fitted", "dense"):
        return onto.source.kind
    sized = gauge == "shape" or all(np.isfinite(row.mm_per_unit) for row in fits)
    return "dense" if sized and all(results.has(name, "dense") for name in names) else "coefficients"


def _cohort_of_surfaces(
    folder: Path,
    table: Table,
    config: CohortConfig,
    onto: Cohort | None,
    on_shape: Callable[[int, int], None] | None,
) -> Cohort:
    listing = surface_files([folder])
    matched, _ = _match_files(table, listing, folder)
    review = listing.review(
        [file for file, _ in matched], "--set doubtful=yes",
        accept=config.doubtful if config.accept_review is None else config.accept_review,
    )  # fmt: skip
    listing = listing if config.doubtful else listing.without_doubtful("--set doubtful=yes")
    notes = [*([f"{summary}."] if (summary := review_summary(review)) else []), *listing.notes]
    if config.gauge == "form":
        listing.refuse_mixed_units()
    matched, unmatched = _match_files(table, listing, folder)
    notes += unmatched
    least = config.least if onto is None else 1
    if len(matched) < least:
        raise InputError(
            f"{folder}: {len(matched)} of its meshes are in {table.where}, and {_count_words(least)} the least."
        )
    meshes: list[Mesh] = []
    samples: list[SampleFile | None] = []
    for n_read, (file, _) in enumerate(matched, 1):
        meshes.append(replace(listing.mesh(file), name=surface_stem(file)))
        samples.append(find_samples(file, meshes[-1], max(config.imputations, 1)))
        if on_shape is not None:
            on_shape(n_read, len(matched))
    cohort = Cohort.of_meshes(
        meshes, replace(table.take([row for _, row in matched]), rows=tuple(mesh.name for mesh in meshes)),
        config.gauge, onto, config.least, samples, listing.parts,
    )  # fmt: skip
    if 1 < cohort.imputations < config.imputations:
        notes.append(
            f"A completed shape has {cohort.imputations} samples, so there are as many imputations, not "
            f"{config.imputations}."
        )
    corresponding = all(file.name.endswith(SURFACE) for file, _ in matched)
    source = ShapeSource("corresponding" if corresponding else "surfaces")
    return replace(cohort, notes=(*notes, *cohort.notes), source=source, review=review)


def _match_files(table: Table, listing: SurfaceFiles, folder: Path) -> tuple[list[tuple[Path, int]], list[str]]:
    """Return the surface and the number of each row that has a surface, and the notes of `match_rows`."""
    # A completion may be written in several formats; its samples are of the vertices of the PLY file.
    files = {
        surface_stem(file): file
        for file in listing.files
        if file.suffix.lower() == ".ply" or not (file.suffix.lower() == ".csv" or file.with_suffix(ENDING).is_file())
    }
    rows, notes = match_rows(table, [(name, file.name) for name, file in files.items()], folder)
    return [(list(files.values())[k], row) for row, k in rows.items()], notes


def _check_same_model(fits: Sequence[_Row], folder: Path) -> None:
    hashes = sorted({row.model_hash for row in fits})
    if len(hashes) > 1:
        raise InputError(
            f"{folder} contains fits of {len(hashes)} different models ({', '.join(h[:12] for h in hashes[:3])}), "
            "whose coefficients cannot be compared; fit all scans with one model."
        )
    first_names: dict[str, str] = {}
    for row in fits:
        first_name = first_names.setdefault(row.scan_hash or row.name, row.name)
        if first_name != row.name:
            raise InputError(f"{first_name} and {row.name} are fits of the same scan; remove one from the table.")


def _model_of(results: Results, fit: _Row, given: Path | None) -> tuple[ShapeModel, AdditiveModel | None]:
    source = results.fit(fit.name).model
    path = given or results.folder / (source.path or source.name)
    if given is None and not path.is_file():
        raise InputError(
            f"{results.folder}: the model {path.name} is no longer at {path}; give it with --set model=MODEL.h5."
        )
    read_model = load_model(path)
    model, additive = (read_model.shape, read_model) if isinstance(read_model, AdditiveModel) else (read_model, None)
    if model.content_hash != fit.model_hash:
        raise InputError(
            f"{path} is not the model of the fits in {results.folder}; give the right one with --set model=MODEL.h5."
        )
    return model, additive


def _count_words(count: int) -> str:
    return {1: "one is", 2: "two are"}.get(count, f"{count} are")


def _number(value: Any) -> float:
    return float("nan") if value is None else float(value)
