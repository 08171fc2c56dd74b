"""Content of result files, for writers and readers: NAME.fit.json, demo.json, recognition.json, quality.json.

Each file is a frozen `Struct` of msgspec, which is created ten times as fast as a dataclass and checks its content.
`to_json` converts an object to plain JSON; `from_json`, or `read` for a part of a file, checks the content and raises
an error with one sentence. Unknown keys are ignored, so that files of later versions with additional keys can be read.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar, Literal, Self, TypeAlias, TypeVar, cast, get_args

import msgspec
from msgspec import Struct

from shapespace.errors import FileFormatError

Status = Literal["converged", "max_iterations", "doubtful", "failed"]
FIT_AGAIN, STUDY_AGAIN, DEMO_AGAIN = "fit the scan again", "run shapespace recognise study again", "run the demo again"
CORRESPOND_AGAIN, ANALYSIS_AGAIN = "run shapespace correspond again", "run the analysis again"
_LONGEST_REASON = 200  # characters of the error of a library in a message
_T = TypeVar("_T")


def read(kind: type[_T], content: object, where: str, again: str) -> _T:
    """Return JSON content as an object of `kind`, a class of this module or a plain type.

    Args:
        kind: class of the result.
        content: JSON content as from `json.loads`.
        where: name of the file or of its part, used in the message.
        again: advice for the user, as the end of the message.

    Raises:
        FileFormatError: the content is not of this class.
    """
    try:
        return msgspec.convert(content, kind)
    except (msgspec.ValidationError, UnicodeEncodeError, OverflowError, RecursionError) as error:
        message = str(error)[:_LONGEST_REASON].replace("`", "").replace("$.", "").replace("Object missing", "missing")
        raise FileFormatError(f"{where} is damaged: {message[:1].lower()}{message[1:]}; {again}.") from error


def to_json(content: object) -> Any:
    """Return an object of this module, or of plain values, as JSON content.

    Numbers that are not finite become None, and numbers of numpy become plain numbers.
    """
    return _replace_non_finite(msgspec.to_builtins(content, enc_hook=lambda value: value.item()))


def json_text(content: object) -> str:
    """Return the result of `to_json` as the text of a file."""
    return json.dumps(to_json(content), indent=1, allow_nan=False) + "\n"


def _replace_non_finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _replace_non_finite(item) for key, item in cast(dict[Any, Any], value).items()}
    if isinstance(value, list | tuple):
        return [_replace_non_finite(item) for item in cast(Sequence[Any], value)]
    return value


def check_format(
    content: object, kind: type[FitRecord] | type[CorrespondenceRecord] | type[Recognition], where: str, again: str
) -> None:
    """Check the format and version of the content of a file; a file without a version has the first version.

    Raises:
        FileFormatError: the content has another format or version.
    """
    known: Mapping[str, Any] = cast(dict[str, Any], content) if isinstance(content, dict) else {}
    if known.get("format") != kind.FORMAT:
        raise FileFormatError(f"{where} is not {kind.CALLED} ({kind.FORMAT!r}); {again}.")
    version = known.get("format_version", 1)
    if version != kind.VERSION:
        raise FileFormatError(
            f"{where} has the format version {str(version)[:40]}, but this version of shapespace supports only "
            f"{kind.VERSION}; update shapespace, or {again}."
        )


# NAME.fit.json


class File(Struct, frozen=True, kw_only=True):
    """Reference to an input file: its name, the SHA-256 of its content, and its path; empty if unknown.

    Args:
        size_bytes: size of a scan, bytes.
        modified_ns: modification time of a scan, ns since 1970; with the size it identifies an unchanged scan.
        remote_version: version of a remote scan at the address `path`, which changes with its content.
    """

    name: str = ""
    hash: str = ""
    path: str = ""
    size_bytes: int | None = None
    modified_ns: int | None = None
    remote_version: str = ""


class Distances(Struct, frozen=True, kw_only=True):
    """Statistics of closest distances, mm (None without distances), their count, and the fraction of used points."""

    mean: float | None = None
    median: float | None = None
    rms: float | None = None
    p95: float | None = None
    max: float | None = None
    count: int | float | None = None
    fraction: float | None = None


class BothWays(Struct, frozen=True, kw_only=True):
    """Distances from the vertices of the model to the scan, and from the points of the scan to the model."""

    model_to_scan: Distances = Distances()
    scan_to_model: Distances = Distances()


class OverlapRecord(BothWays, frozen=True, kw_only=True):
    """Distances over the parts that scan and model both contain.

    Args:
        model_seen_share: share of the vertices of the model that the scan shows, 0 to 1.
        scan_covered_share: share of the points of the scan within the model, 0 to 1.
    """

    model_seen_share: float | None = None
    scan_covered_share: float | None = None


class PoseRecord(Struct, frozen=True, kw_only=True):
    """A similarity x -> scale · rotation · x + translation."""

    scale: float
    rotation: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    translation: tuple[float, float, float]


class Iteration(Struct, frozen=True, kw_only=True):
    """One iteration of a fit; lengths in mm of the scan."""

    phase: int
    iteration: int
    rms_mm: float | None = None
    motion_mm: float | None = None
    scale: float | None = None


class FoundLandmark(Struct, frozen=True, kw_only=True):
    """A landmark of the model on the fitted surface.

    Args:
        at: position in the frame and unit of the scan.
        stddev_mm: standard deviations along the axes of that frame, mm of the scan; None if the method does not
            estimate these.
    """

    at: tuple[float, float, float]
    stddev_mm: tuple[float, float, float] | None = None


class ReasonRecord(Struct, frozen=True, kw_only=True):
    """One reason for the status of a fit.

    Args:
        code: a value of `fit.reasons.ReasonCode`, or one of a later version.
        data: numbers of the reason by name.
    """

    code: str
    data: Mapping[str, Any] = {}


class FitRecord(Struct, frozen=True, kw_only=True):
    """A NAME.fit.json; the fields are in the order of its keys.

    Lengths are in mm of the scan, except coefficients, which are in mm of the model's frame.

    Args:
        id: SHA-256 of scan, model, landmarks, settings and version, also contained in the header of the fitted surface.
            Empty for a scan that could not be fitted.
        metadata: metadata of the scan, by the columns of the list of scans.
        given_up: identifier of the run that gave up the scan because its workers crashed; otherwise empty.
        status: status of the fit; `unreadable` represents a record that cannot be read, and is never in a file.
        reason: sentence that explains the status.
        reasons: reasons for the status as codes with data; empty for a scan that could not be fitted.
        scan: reference to the file of the scan.
        model: reference to the file of the model.
        landmarks: reference to the file of the initial landmarks.
        T_scan_model: pose of the model in the frame and unit of the scan. This and the following fields are None for a
            scan that could not be fitted.
        b: (K,) coefficients, mm in the frame of the model. They are norms over all vertices: b divided by the root of
            `n_vertices` is the RMS displacement of a vertex by a mode.
        z: (K,) coefficients in standard deviations.
        b_stddev: (K,) standard deviations of `b`, mm in the frame of the model.
        shrinkage: (K,) shrinkage of the coefficients, 0 to 1.
        found_landmarks: landmarks of the model by name, on the dense surface if there is one.
        distances_mm: distances by stage, over all vertices of the model and all scan points within its rim.
        size_mm: root mean square distance of the vertices of the fitted surface from their centroid, mm.
        n_vertices: number of vertices of the fitted surface, V.
        centroid_size_mm: centroid size of the fitted surface, `size_mm` times the root of V, mm.
        extents_mm: extents of the fitted surface along its principal axes, the longest first, mm.
        area_mm2: area of the fitted surface, mm^2; None without triangles.
        shown: overlap distances of the final stage.
        shown_dense: overlap distances of the dense surface, if there is one.
    """

    CALLED: ClassVar = "the record of a fit"
    FORMAT: ClassVar = "shapespace fit"
    LIST: ClassVar = "scans.csv"
    VERSION: ClassVar = 1

    format: str = FORMAT
    format_version: int = VERSION
    id: str = ""
    scan: File = File()
    model: File = File()
    landmarks: File | None = None
    metadata: Mapping[str, str | int | float | None] = {}
    status: Status | Literal["unreadable"]
    reason: str = ""
    reasons: tuple[ReasonRecord, ...] = ()
    shown: OverlapRecord | None = None
    shown_dense: OverlapRecord | None = None
    method: str = ""
    config: Mapping[str, Any] = {}
    start: str | None = None
    notes: tuple[str, ...] = ()
    T_scan_model: PoseRecord | None = None
    mm_per_scan_unit: float | None = None
    size_mm: float | None = None
    n_vertices: int | None = None
    centroid_size_mm: float | None = None
    extents_mm: tuple[float, float, float] | None = None
    area_mm2: float | None = None
    b: tuple[float, ...] = ()
    z: tuple[float, ...] = ()
    b_stddev: tuple[float, ...] = ()
    b_stddev_calibrated: bool = False
    shrinkage: tuple[float, ...] = ()
    evidence: Mapping[str, Any] = {}
    chirality: Literal["as scanned", "mirrored", "undecidable"] | None = None
    found_landmarks: Mapping[str, FoundLandmark] = {}
    distances_mm: Mapping[str, BothWays] = {}
    history: tuple[Iteration, ...] = ()
    iterations: Mapping[str, int] = {}
    seconds: Mapping[str, float] = {}
    version: str = ""
    given_up: str = ""

    @property
    def is_fitted(self) -> bool:
        """Whether there is a result, doubtful or not."""
        return self.status not in ("failed", "unreadable")

    def to_json(self) -> dict[str, Any]:
        """Return the content of the file; a failed scan has no keys of a fit, and a fit has only keys that apply."""
        content: dict[str, Any] = to_json(self)
        for key in ("scan", "model", "landmarks"):
            if content[key]:
                file: dict[str, Any] = content[key]
                content[key] = {k: value for k, value in file.items() if value not in ("", None) or k in _OF_FILES}
        left_out = _NOT_ALWAYS if self.is_fitted else content.keys() - _OF_FAILED
        return {key: value for key, value in content.items() if value or key not in left_out}

    @staticmethod
    def from_json(content: object, where: str, again: str = FIT_AGAIN) -> FitRecord:
        """Return a checked record.

        Raises:
            FileFormatError: it is not the record of a fit, has another version, or is damaged.
        """
        check_format(content, FitRecord, where, again)
        return read(FitRecord, content, where, again)


_OF_FILES = frozenset(("name", "hash"))
_OF_FAILED = frozenset(("reason", "config"))
_NOT_ALWAYS = frozenset(("metadata", "shown_dense", "area_mm2", "found_landmarks", "given_up"))
"""Keys of a fit that are omitted if they are empty."""


# demo.json


class VertexErrors(Struct, frozen=True, kw_only=True):
    """Distances between corresponding vertices, mm."""

    mean: float
    rms: float
    max: float


class FitEntry(Struct, frozen=True, kw_only=True):
    """A fit of the demo: its subject, and the paths of its files relative to the folder of the results.

    Args:
        intensity: intensity of the expression, 0 to 1; None if unknown.
        subject: name of the person in the scan; empty if unknown.
        json: path of the record.
        vertex_error_mm: distances of the vertices from the true positions, mm, if these are known.
        floor_mm: distances of the best reconstruction by the model from the true positions, mm.
    """

    name: str
    expression: str = ""
    intensity: float | None = None
    subject: str = ""
    status: str = ""
    reason: str = ""
    scan: str | None = None
    json: str | None = None
    stages: str | None = None
    fitted: str | None = None
    dense: str | None = None
    vertex_error_mm: VertexErrors | None = None
    floor_mm: VertexErrors | None = None


class Example(Struct, frozen=True, kw_only=True):
    """A mesh of the training set for the report."""

    file: str
    label: str = ""


class DemoModel(Struct, frozen=True, kw_only=True):
    """The model of an experiment."""

    title: str = ""
    model: str = ""
    model_hash: str = ""
    n_training: int | None = None
    n_modes: int | None = None
    modes_for_98_5: int | None = None
    cumulative_variance: tuple[float, ...] = ()


class ExpressionsOfOne(DemoModel, frozen=True, kw_only=True):
    """Experiment 1: a model of the expressions of one person, fitted to new expressions.

    Args:
        population_z: (N, K) coefficients of the training set in standard deviations.
        scores: recognition scores by name.
    """

    folder: str = ""
    training_examples: tuple[Example, ...] = ()
    population_z: tuple[tuple[float, ...], ...] = ()
    fits: tuple[FitEntry, ...] = ()
    scores: Mapping[str, Any] = {}


class Case(DemoModel, frozen=True, kw_only=True):
    """A scan of experiment 2, fitted with a model of other people.

    Args:
        fit: fit with the method of the paper.
        robust: fit with the robust method.
    """

    short: str = ""
    simulated: bool = False
    note: str = ""
    fit: FitEntry
    robust: FitEntry | None = None


class ManyPeople(Struct, frozen=True, kw_only=True):
    """Experiment 2: models of many people, fitted to scans of other people."""

    folder: str = ""
    cases: tuple[Case, ...] = ()


class Claim(Struct, frozen=True, kw_only=True):
    """A quantity: its value in the paper, its value in the demo, the true error, and the reason for differences."""

    quantity: str
    paper: str
    measured: str
    truth: str | None = None
    why: str | None = None


class Demo(Struct, frozen=True, kw_only=True):
    """A demo.json; times in seconds."""

    version: str = ""
    quick: bool = False
    created: str = ""
    machine: str = ""
    versions: Mapping[str, str] = {}
    seed: int | None = None
    settings: Mapping[str, Any] = {}
    seconds: Mapping[str, float] = {}
    experiment1: ExpressionsOfOne = ExpressionsOfOne()
    experiment2: ManyPeople = ManyPeople()
    paper_table: tuple[Claim, ...] = ()


# NAME.correspond.json and correspondence.json

ReviewCode: TypeAlias = Literal["doubtful", "folded", "not_settled", "missing", "unreached", "distance", "area_change"]
"""Reason to review a surface in correspondence: its status is doubtful; it is far from its scan; triangles are folded;
vertices are missing; parts of the scan are not reached; triangles change their area; the last round moved it."""


class ReviewReason(Struct, frozen=True, kw_only=True):
    """A measure of a surface in correspondence that is unusual among those of all scans, or beyond a limit.

    Args:
        code: the measure.
        value: value of the measure: a share from 0 to 1 (`distance` and `not_settled`: of the size of the object), or
            for `area_change` the factor by which triangles grow or shrink.
        usual: median of all surfaces.
        excess: robust standard deviations by which the value is above the median; reasons are sorted by it.
    """

    code: ReviewCode
    value: float
    usual: float
    excess: float


class SurfaceReview(Struct, frozen=True, kw_only=True):
    """Number of surfaces of a collection that need review.

    Args:
        surfaces: number of all surfaces.
        needs_review: number of those with a reason to review them.
        reasons: number of surfaces with each reason; a surface can have several.
    """

    surfaces: int = 0
    needs_review: int = 0
    reasons: Mapping[ReviewCode, int] = {}

    @staticmethod
    def of(codes: Iterable[Sequence[ReviewCode]]) -> SurfaceReview:
        """Count surfaces from the codes of the reasons of each; a surface that needs no review has none."""
        every = [set(own) for own in codes]
        counts: Counter[ReviewCode] = Counter(code for own in every for code in own)
        return SurfaceReview(surfaces=len(every), needs_review=sum(map(bool, every)), reasons=_sort_counts(counts))

    def __add__(self, other: SurfaceReview) -> SurfaceReview:
        return SurfaceReview(
            surfaces=self.surfaces + other.surfaces,
            needs_review=self.needs_review + other.needs_review,
            reasons=_sort_counts(Counter(self.reasons) + Counter(other.reasons)),
        )

    @property
    def is_majority(self) -> bool:
        """Whether more than half of the surfaces need review."""
        return 2 * self.needs_review > self.surfaces


def _sort_counts(counts: Mapping[ReviewCode, int]) -> dict[ReviewCode, int]:
    return {code: counts[code] for code in get_args(ReviewCode) if code in counts}


class CorrespondRecord(Struct, frozen=True, kw_only=True):
    """A NAME.correspond.json: registration result for a scan; lengths are in the unit of the scan, shares from 0 to 1.

    Args:
        name: NAME of the result files.
        path: path of the scan, relative to the folder if possible.
        hash: SHA-256 of the content of the scan.
        status: `converged`, `doubtful` or `excluded`.
        reason: reason why the scan is excluded.
        probability: probability that the surface is correct, estimated from the other scans.
        doubt: reason why the surface is doubtful.
        review: further reasons to review the surface, the most unusual first.
        seen_share: share of the vertices of the template that the scan shows; the other vertices are estimates.
        covered_share: share of the points of the scan that the template reaches, without those beyond its rim.
        area_share: ratio of the area of the surface in correspondence to that of the scan; well below 1 if the template
            lacks parts that the scan shows.
        distance_mean, distance_p95, distance_p99, distance_max: overlap distances in both directions.
        scale: ratio of the size of the scan to the typical size, with a correction for its unit.
        size: ratio of the RMS distance of the surface from its centroid to that of the mean shape.
        unit_ratio: factor of the coordinates relative to the unit of most scans, such as 0.001 for metres among
            millimetres.
        notes: sentences for the user about the registration.
        folded_share: share of the triangles that fold over their neighbours, unlike on the mean shape.
        area_factor: factor of growth or shrinkage relative to the mean shape that 95 % of the triangles do not exceed,
            without the change of size.
        moved_share: RMS movement of the vertices in each round, as a share of the size.
        cpu_s: CPU time of each round, s.
        landmark_rms: RMS distance of the landmarks of the scan from their positions on the surface.
        landmark_distances: name -> distance of each given landmark from the surface of the scan, in its unit.
        mirrored: whether the scan is a mirror image of the majority. Its surface is in its own frame, with triangles
            whose corners are in reverse order, so that their normals point outwards.
        metadata: metadata of the scan, by the columns of the list of scans.
    """

    CALLED: ClassVar = "a record of correspondence"
    FORMAT: ClassVar = "shapespace corresponding"
    VERSION: ClassVar = 1
    ENDING: ClassVar = ".correspond.json"
    SURFACE: ClassVar = ".corresponding.ply"

    name: str
    path: str
    hash: str
    status: Literal["converged", "doubtful", "excluded"]
    reason: str = ""
    probability: float | None = None
    doubt: str = ""
    review: list[ReviewReason] = []
    seen_share: float | None = None
    covered_share: float | None = None
    area_share: float | None = None
    distance_mean: float | None = None
    distance_p95: float | None = None
    distance_p99: float | None = None
    distance_max: float | None = None
    scale: float | None = None
    size: float | None = None
    unit_ratio: float = 1.0
    notes: list[str] = []
    folded_share: float | None = None
    area_factor: float | None = None
    moved_share: list[float] = []
    cpu_s: list[float] = []
    landmark_rms: float | None = None
    landmark_distances: Mapping[str, float] = {}
    mirrored: bool = False
    metadata: Mapping[str, str | int | float | None] = {}
    format: str = FORMAT
    format_version: int = VERSION

    @property
    def is_excluded(self) -> bool:
        """Whether the scan has no surface."""
        return self.status == "excluded"

    @property
    def review_codes(self) -> list[ReviewCode]:
        """Codes of the reasons to review the surface; empty if there are none."""
        codes: list[ReviewCode] = ["doubtful"] if self.doubt else []
        return codes + [reason.code for reason in self.review]


class CorrespondenceRecord(Struct, frozen=True, kw_only=True):
    """A correspondence.json: result of a run of correspondence.

    Args:
        template: sentence on the source of the first template, with the reason.
        vertices: number of vertices of the template.
        rounds: RMS movement of the vertices in each round, as a share of the size.
        corresponding: NAMEs in correspondence.
        set_aside: NAME to reason of the excluded scans.
        doubtful: NAMEs in correspondence whose surfaces are probably wrong.
        needs_review: NAME to the codes of the reasons (`CorrespondRecord.review_codes`), for surfaces that need review.
        other_units: NAME to `unit_ratio`, for scans whose unit differs from the majority.
        mirrored: NAMEs of the scans that are mirror images of the majority.
        sides_decided: whether scans could be distinguished from their mirror images.
        groups: NAMEs in correspondence, then those of each other object class; empty if there is only one class.
        settings: settings of the run.
        version: version of shapespace.
        inputs_hash: SHA-256 of the scans, landmarks, template, model, settings and version; a run with the same inputs
            reuses the results.
        results_hash: SHA-256 of the files that the run wrote, except this one.
        added: NAMEs of scans that were registered to the mean after the run, and did not affect the mean.
        parts: name -> number of vertices of each part, in the order of the vertices; empty for objects of one part.
    """

    CALLED: ClassVar = "a correspondence"
    FORMAT: ClassVar = "shapespace correspondence"
    VERSION: ClassVar = 1
    FILE: ClassVar = "correspondence.json"
    MEAN: ClassVar = "template/mean.ply"

    template: str
    vertices: int
    rounds: list[float]
    corresponding: list[str]
    set_aside: dict[str, str]
    settings: dict[str, Any]
    version: str
    other_units: dict[str, float] = {}
    mirrored: list[str] = []
    sides_decided: bool = False
    groups: list[list[str]] = []
    inputs_hash: str = ""
    results_hash: str = ""
    added: list[str] = []
    doubtful: list[str] = []
    needs_review: dict[str, list[ReviewCode]] = {}
    parts: dict[str, int] = {}
    format: str = FORMAT
    format_version: int = VERSION

    @staticmethod
    def from_json(content: object, where: str = "correspondence.json") -> CorrespondenceRecord:
        """Return the checked record of a run.

        Raises:
            FileFormatError: it is not a correspondence, has another version, or is damaged.
        """
        check_format(content, CorrespondenceRecord, where, CORRESPOND_AGAIN)
        return read(CorrespondenceRecord, content, where, CORRESPOND_AGAIN)


# quality.json


class Measured(Struct, frozen=True, kw_only=True):
    """A measure for each number of modes; without `modes`, these numbers are 1, 2, 3 and so on."""

    mean: tuple[float, ...]
    modes: tuple[float, ...] | None = None
    stddev: tuple[float, ...] | None = None
    low: tuple[float, ...] | None = None
    high: tuple[float, ...] | None = None


class BySize(Struct, frozen=True, kw_only=True):
    """A measure by the number of training shapes, with its 95 % interval."""

    shapes: tuple[int, ...]
    mean: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]


class Quality(Struct, frozen=True, kw_only=True):
    """A quality.json: measured shares of the variance (0 to 1), and measured errors in mm.

    Names without a suffix are measured from surface to surface; `..._vertices` between corresponding vertices. `others`
    were measured on the same shapes and folds; their `differences` are relative to this model.
    """

    FILE: ClassVar = "quality.json"

    name: str = ""
    compactness: tuple[float, ...] | Measured | None = None
    generalisation: tuple[float, ...] | Measured | None = None
    specificity: tuple[float, ...] | Measured | None = None
    generalisation_vertices: Measured | None = None
    specificity_vertices: Measured | None = None
    reconstruction: Measured | None = None
    reconstruction_vertices: Measured | None = None
    generalisation_by_shapes: BySize | None = None
    supported_modes: int | None = None
    sentences: tuple[str, ...] = ()
    settings: Mapping[str, Any] = {}
    others: tuple[Quality, ...] = ()
    differences: Mapping[str, Measured] = {}


# recognition.json


class Target(Struct, frozen=True, kw_only=True):
    """A target of a study and the result; `met` is None if the target was not assessed."""

    what: str = ""
    target: str = ""
    reached: str = ""
    met: bool | None = None
    note: str | None = ""


class Part(Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="kind"):
    """Common fields of the parts of a study; the class is `kind` in JSON. A part of `level` 2 begins a chapter."""

    title: str | None = ""
    note: str | None = ""
    level: int | None = None


class TextPart(Part, frozen=True, kw_only=True, tag="text"):
    """Paragraphs."""

    text: str | tuple[str, ...]


class TableColumn(Struct, frozen=True):
    """A column of a table; shares are 0 to 1, an interval consists of two shares."""

    name: str = ""
    kind: Literal["text", "percent", "interval", "number", "mm", "p", "count"] = "text"


class TablePart(Part, frozen=True, kw_only=True, tag="table"):
    """A table; the cells depend on the kinds of their columns, and are None if unknown."""

    columns: tuple[TableColumn, ...]
    rows: tuple[tuple[Any, ...], ...]

    @staticmethod
    def of(
        title: str, columns: Sequence[str], rows: Sequence[tuple[Any, ...]], *, percent: Sequence[str] = (),
        note: str = "", level: int | None = None,
    ) -> TablePart:  # fmt: skip
        """Return a table; the kind of a column is that of its first cell that is not None.

        Args:
            title: title of the table.
            columns: names of the columns; `p` is the column of p values.
            rows: rows of texts, integers, numbers and intervals.
            percent: names of the columns of shares.
            note: note below the table.
            level: heading level of the title.
        """
        kinds: dict[str, Any] = {"p": "p", **dict.fromkeys(percent, "percent")}
        types: tuple[tuple[type, Any], ...] = ((str, "text"), (int, "count"), (tuple, "interval"), (object, "number"))
        made: list[TableColumn] = []
        for k, name in enumerate(columns):
            cell = next((row[k] for row in rows if row[k] is not None), 0.0)
            kind: Any = kinds.get(name) or next(label for own, label in types if isinstance(cell, own))
            made.append(TableColumn(name=name, kind=kind))
        return TablePart(title=title, columns=tuple(made), rows=tuple(rows), note=note, level=level)


class ConfusionPart(Part, frozen=True, kw_only=True, tag="confusion"):
    """Number of scans of each true class (rows) that were assigned to each class (columns)."""

    classes: tuple[str, ...]
    counts: tuple[tuple[float, ...], ...]


class Bin(Struct, frozen=True, kw_only=True):
    """Predictions with a probability from `low` to `high`: mean probability, share of correct ones, and count."""

    low: float
    high: float
    confidence: float | None = None
    accuracy: float | None = None
    count: float = 0


class CalibrationPart(Part, frozen=True, kw_only=True, tag="calibration"):
    """Share of correct predictions against the predicted probability."""

    bins: tuple[Bin, ...]
    ece: float | None = None
    brier: float | None = None


class LearningCurvePart(Part, frozen=True, kw_only=True, tag="learning_curve"):
    """Accuracy against the number of training subjects; `band` describes `low` and `high`."""

    subjects: tuple[float, ...]
    mean: tuple[float, ...]
    low: tuple[float | None, ...] | None = None
    high: tuple[float | None, ...] | None = None
    band: str | None = None
    ceiling: float | None = None


class Series(Struct, frozen=True, kw_only=True):
    """One line of a curve, optionally with a band; drawn as dots without a line if `points` is true.

    Series with the same `group`, a number from 0, have the same colour and marker.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    label: str = ""
    low: tuple[float | None, ...] | None = None
    high: tuple[float | None, ...] | None = None
    points: bool = False
    group: int | None = None


class CurvePart(Part, frozen=True, kw_only=True, tag="curve"):
    """A curve of one measure against another; `x` and `y` are their names.

    On a `probit` scale shares are plotted at their normal deviates, as in a DET curve; `diagonal` draws y = x.
    """

    series: tuple[Series, ...]
    x: str = "x"
    y: str = "y"
    x_scale: Literal["linear", "log", "probit"] = "linear"
    y_scale: Literal["linear", "log", "probit"] = "linear"
    diagonal: bool = False


class SurfaceMapPart(Part, frozen=True, kw_only=True, tag="surface_map"):
    """A surface in an .npz file with a value per vertex, drawn in several views.

    Args:
        arrays: path of the file.
        vertices: name of the array (V, 3) of positions, mm.
        faces: name of the array (F, 3) of triangles; empty without triangles.
        values: name of the array (V,) of values; NaN for missing values.
        mask: name of a (V,) boolean array, outside which the colour is pale; empty for none.
        unit: unit of the values.
        signed: whether the colour map is diverging, with its centre at zero.
        limit: upper limit of the colour map, in `unit`; None for the 98 % quantile of the values.
    """

    arrays: str
    vertices: str = "vertices"
    faces: str = "faces"
    values: str = "values"
    mask: str = ""
    unit: str = "mm"
    signed: bool = True
    limit: float | None = None


class ShapeChangePart(Part, frozen=True, kw_only=True):
    """Two shapes in correspondence in an .npz file, such as both ends of a change.

    Args:
        arrays: path of the file.
        low: name of the array (V, 3) of the first shape, mm.
        high: name of the array (V, 3) of the second shape, mm.
        low_label: description of `low`.
        high_label: description of `high`.
        times: factor of the difference between the shapes: 1 for the true difference, below 1 for a reduced one.
    """

    arrays: str
    low: str = "low"
    high: str = "high"
    low_label: str = "low"
    high_label: str = "high"
    times: float = 1.0


class MorphPart(ShapeChangePart, frozen=True, kw_only=True, tag="morph"):
    """Two surfaces with a slider between the shapes.

    The slider moves on a line, or through the shapes low + weights[k] modes, at equal steps of a variable.

    Args:
        faces: name of an array (F, 3).
        modes: name of an array (q, V, 3), mm; empty for a line.
        weights: name of an array (B, q), 0 in the first row.
        variable: name of the variable.
        range: values of the variable at `low` and `high`.
    """

    faces: str = "faces"
    modes: str = ""
    weights: str = ""
    variable: str = ""
    range: tuple[float, float] = (0.0, 1.0)


class DeformationPart(ShapeChangePart, frozen=True, kw_only=True, tag="deformation"):
    """Two configurations of landmarks: a deformation grid, or a vector for each landmark; z is 0 for planar landmarks.

    Args:
        drawing: `grid` for a thin-plate spline of planar landmarks, `vectors` for any landmarks.
    """

    drawing: Literal["grid", "vectors"] = "vectors"


class MorphospacePart(Part, frozen=True, kw_only=True, tag="morphospace"):
    """Shapes as points in the plane of two axes of an ordination; a click draws the shape at a point next to the mean.

    Args:
        arrays: an .npz file with `scores` (N, A), `mean` (V, 3), `shape_axes` (A, V, 3), the change of shape per unit
            of score, and `faces` (F, 3), empty for landmarks; perhaps with `groups` (N,) codes, `cross_validated`
            (N, A) scores, and `nodes` (M, A) and `edges` (E, 2) of a phylogeny, whose tips are the shapes.
        names: N names of the shapes.
        axes: A names of the axes.
        shares: (A,) share of the variance of each axis.
        first: numbers of the axes drawn across and up, from 0.
        groups: names of the groups.
        variable: name of the variable with these groups.
        unit: unit of the scores; empty for none.
    """

    arrays: str
    names: tuple[str, ...]
    axes: tuple[str, ...]
    shares: tuple[float, ...]
    first: tuple[int, int] = (0, 1)
    groups: tuple[str, ...] = ()
    variable: str = ""
    unit: str = ""


class Counts(Struct, frozen=True, kw_only=True):
    """Number of values in each bin between the `edges` of a histogram."""

    counts: tuple[float, ...]
    label: str = ""


class HistogramPart(Part, frozen=True, kw_only=True, tag="histogram"):
    """A histogram; `observed` is a value marked by a line, such as a statistic among its permutations."""

    edges: tuple[float, ...]
    series: tuple[Counts, ...]
    x: str = "value"
    y: str = "count"
    observed: float | None = None
    observed_label: str = ""


_PARTS = (
    TextPart | TablePart | ConfusionPart | CalibrationPart | LearningCurvePart | CurvePart | SurfaceMapPart | MorphPart
    | HistogramPart | MorphospacePart | DeformationPart
)  # fmt: skip
PARTS: Mapping[str, type[Part]] = {str(kind.__struct_config__.tag): kind for kind in get_args(_PARTS)}
"""Class of a part by its kind."""


def read_part(content: object, where: str, again: str = STUDY_AGAIN) -> Part:
    """Return one part of a study by its kind.

    Raises:
        FileFormatError: it is damaged, or this version does not support its kind.
    """
    return read(cast(type[Part], _PARTS), content, where, again)


class Recognition(Struct, frozen=True, kw_only=True):
    """A recognition.json; each part is read with `read_part`, so that a damaged part does not affect the others."""

    CALLED: ClassVar = "the result of a study of recognition"
    FORMAT: ClassVar = "shapespace recognition"
    VERSION: ClassVar = 1

    format: str = FORMAT
    format_version: int = VERSION
    version: str = ""
    created: str = ""
    title: str = ""
    summary: str | tuple[str, ...] = ()
    targets: tuple[Target, ...] = ()
    parts: tuple[Any, ...] = ()
    settings: Mapping[str, Any] = {}
    versions: Mapping[str, Any] = {}
    model_hashes: tuple[str, ...] = ()

    @classmethod
    def from_json(cls, content: object, where: str = "recognition.json", again: str = STUDY_AGAIN) -> Self:
        """Return a study with checked parts.

        Raises:
            FileFormatError: it is not a study of recognition, has another version, or is damaged.
        """
        check_format(content, cls, where, again)
        study = read(cls, content, where, again)
        for part in study.parts:
            read_part(part, where, again)
        return study


# analysis.json


class SampleSize(Struct, frozen=True, kw_only=True):
    """Number of subjects and shapes in a class of a variable, or in a combination of classes of several variables."""

    variables: tuple[str, ...]
    classes: tuple[str, ...]
    subjects: int
    shapes: int


class TestScheme(Struct, frozen=True, kw_only=True):
    """Method of the p values of one or more terms.

    Args:
        tested: names of the terms, or of other quantities.
        stratum: stratum of the tests; empty if there is only one.
        statistic: name of the statistic, such as `F`, `Welch t` or `R2`; empty for p values of a distribution.
        resampling: method: permutations of rows, sign flips of rows, bootstrap draws, leave-one-out, or none.
        unit: unit that is permuted or flipped, such as `subject`; `scan of a subject`: values are permuted within
            subjects, and between subjects with the same number of scans.
        reduced_model: terms of the model whose residuals are resampled; empty for the mean; None where values
            themselves are.
        arrangements: number of resamples, including the observed data.
        exhaustive: whether these are all possible resamples.
        unequal_variances: whether the test allows groups of unequal dispersion.
    """

    __test__: ClassVar = False  # not a test class of pytest

    tested: tuple[str, ...]
    statistic: str = "F"
    stratum: str = ""
    resampling: Literal["permutation", "sign flips", "bootstrap", "leave-one-out", "none"] = "permutation"
    unit: str = "subject"
    reduced_model: tuple[str, ...] | None = ()
    arrangements: int = 0
    exhaustive: bool = False
    unequal_variances: bool = False


class Dispersion(Struct, frozen=True, kw_only=True):
    """A test of equal dispersion of groups.

    Args:
        variable: name of the variable whose classes are the groups.
        stratum: stratum of the residuals; empty if there is only one.
        groups: names of the classes with two or more members.
        counts: number of members of each group.
        stddev: standard deviation of each group about its mean, RMS over the vertices, in `Methods.unit`.
        f: F of the distances to the group mean.
        p: p value from permutations of these distances.
        arrangements: number of permutations, including the observed data.
        equal: whether p is above the level of significance.
        smaller_is_more_variable: whether smaller groups have the larger dispersion; None without such a trend.
    """

    variable: str
    groups: tuple[str, ...]
    counts: tuple[int, ...]
    stddev: tuple[float, ...]
    f: float | None
    p: float
    arrangements: int
    equal: bool
    stratum: str = ""
    smaller_is_more_variable: bool | None = None


class Methods(Struct, frozen=True, kw_only=True):
    """The content of a methods section on an analysis.

    Args:
        subjects: number of subjects.
        shapes: number of shapes.
        vertices: number of vertices, or landmarks, of a shape.
        coordinates: number of coordinates of a vertex, 2 or 3.
        gauge: size handling: `shape` (size divided out) or `form` (size kept).
        tangent: whether the shapes are in the tangent space at their mean.
        source: source of the shapes: coefficients, fitted, dense, corresponding, other surfaces, or landmarks.
        review: number of surfaces in correspondence that need review.
        modes: number of modes of the model that represents the shapes; None if shapes are not limited to modes.
        explained_variance_ratio: share of the training variance of the model in these modes; None as for `modes`.
        dimensions: dimension of the analysed space; None for the analysis of vertex maps.
        analysed_variance_ratio: share of the variance of the cohort in these dimensions.
        unit: unit of lengths: `mm`, or empty for coordinates without a unit.
        level: level of significance.
        sizes: numbers of subjects and shapes of each class, and of each combination of classes.
        tests: methods of the p values.
        dispersions: tests of equal dispersion.
        unequal_variances: whether tests allow unequal dispersion; None if no groups are compared.
        effect_size: transformation before Z is standardised, `box-cox` or `log`; empty without Z.
        r2_strata: strata whose total sums of squares are the reference of R²; an empty name means all shapes. None
            without R².
        corrected_over: sets over which p values are corrected for multiple testing; there is no other correction.
        assumptions: sentences on further assumptions of the tests.
    """

    subjects: int
    shapes: int
    vertices: int
    coordinates: Literal[2, 3] = 3
    gauge: str = "shape"
    tangent: bool = False
    source: str = "surfaces"
    review: SurfaceReview = SurfaceReview()
    modes: int | None = None
    explained_variance_ratio: float | None = None
    dimensions: int | None = None
    analysed_variance_ratio: float = 1.0
    unit: Literal["mm", ""] = "mm"
    level: float = 0.05
    sizes: tuple[SampleSize, ...] = ()
    tests: tuple[TestScheme, ...] = ()
    dispersions: tuple[Dispersion, ...] = ()
    unequal_variances: bool | None = None
    effect_size: Literal["box-cox", "log", ""] = ""
    r2_strata: tuple[str, ...] | None = None
    corrected_over: tuple[str, ...] = ()
    assumptions: tuple[str, ...] = ()


class NamedView(Struct, frozen=True, kw_only=True):
    """A view of an object, in the frame of its mean shape.

    Args:
        name: name of the view, such as `dorsal`.
        toward_viewer: direction from the object to the viewer.
        up: direction that is up in the figure.
    """

    name: str
    toward_viewer: tuple[float, float, float]
    up: tuple[float, float, float]


class Orientation(Struct, frozen=True, kw_only=True):
    """An orientation.json: settings of the figures of an object.

    Args:
        views: named views in the order of the figures; empty for views that depend on the shape of the object.
        links: pairs of landmarks, numbered from 1, that are connected by lines in figures.
    """

    FILE: ClassVar = "orientation.json"

    views: tuple[NamedView, ...] = ()
    links: tuple[tuple[int, int], ...] = ()


class AlignFinding(Struct, frozen=True, kw_only=True):
    """A specimen to check after the alignment of landmarks; the fields are those of `LandmarkFinding`."""

    specimen: str
    reason: Literal["outlier", "swapped", "mirrored"]
    value: float
    landmarks: tuple[str, ...] = ()


class AlignRecord(Struct, frozen=True, kw_only=True):
    """An align.json: the alignment of landmarks whose coordinates are in aligned.csv next to it.

    Args:
        source: path of the landmark file or folder.
        specimens: number of specimens.
        landmarks: number of landmarks.
        dimensions: dimension of the space, 2 or 3.
        unit: unit of centroid sizes: `mm`, or empty if unknown.
        gauge: `shape` (unit centroid size) or `form`.
        tangent: whether shapes are projected onto the tangent space at their mean, as one structure.
        settings: further options, and numbers of semilandmarks.
        estimated: number of landmarks that are estimates.
        iterations: number of iterations of generalised Procrustes analysis.
        converged: whether the convergence criterion was met.
        findings: specimens to check.
        notes: sentences about the data and the alignment.
        version: version of shapespace.
    """

    source: str = ""
    specimens: int
    landmarks: int
    dimensions: Literal[2, 3]
    unit: Literal["mm", ""] = ""
    gauge: Literal["form", "shape"]
    tangent: bool = False
    settings: Mapping[str, Any] = {}
    estimated: int = 0
    iterations: int = 0
    converged: bool = True
    findings: tuple[AlignFinding, ...] = ()
    notes: tuple[str, ...] = ()
    version: str = ""


class Analysis(Recognition, frozen=True, kw_only=True):
    """An analysis.json: result for a cohort by the command in `question`, in parts like those of a study."""

    CALLED: ClassVar = "the result of an analysis"
    FORMAT: ClassVar = "shapespace analysis"
    VERSION: ClassVar = 1
    FILE: ClassVar = "analysis.json"

    format: str = FORMAT
    question: str = ""
    notes: tuple[str, ...] = ()
    methods: Methods | None = None
    citations: tuple[str, ...] = ()
    orientation: Orientation | None = None

    @classmethod
    def from_json(cls, content: object, where: str = "analysis.json", again: str = ANALYSIS_AGAIN) -> Self:
        """Return an analysis with checked parts; see `Recognition.from_json` for errors."""
        return super().from_json(content, where, again)
