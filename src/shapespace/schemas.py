"""What the result files hold, for writers and readers: NAME.fit.json, demo.json, recognition.json, quality.json.

Each file is a frozen `Struct`: what a dataclass is, made in a tenth of the time, checked by msgspec. `to_json` turns
one into plain JSON; `from_json`, or `read` for a part of a file, checks what was found and says in one sentence what is
wrong with it. Keys that a version does not know are passed over, so that what later versions add can be read.
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
_TOLD = 200  # characters of a library's error that a message repeats
_T = TypeVar("_T")


def read(kind: type[_T], content: object, where: str, again: str) -> _T:
    """Return JSON content as an object of `kind`, a class of this module or a plain type.

    Args:
        kind: what it is to be.
        content: as `json.loads` gives it.
        where: the file, or the part of it, for the sentence.
        again: what a reader can do about it.

    Raises:
        FileFormatError: it is something else.
    """
    try:
        return msgspec.convert(content, kind)
    except (msgspec.ValidationError, UnicodeEncodeError, OverflowError, RecursionError) as error:
        message = str(error)[:_TOLD].replace("`", "").replace("$.", "").replace("Object missing", "missing")
        raise FileFormatError(f"{where} is damaged: {message[:1].lower()}{message[1:]}; {again}.") from error


def to_json(content: object) -> Any:
    """Return a class of this module, or anything made of plain values, as JSON has it.

    Numbers that are not finite become null, and numbers of numpy plain ones.
    """
    return _finite(msgspec.to_builtins(content, enc_hook=lambda value: value.item()))


def json_text(content: object) -> str:
    """Return what `to_json` gives as the text of a file."""
    return json.dumps(to_json(content), indent=1, allow_nan=False) + "\n"


def _finite(value: Any) -> Any:
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in cast(dict[Any, Any], value).items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in cast(Sequence[Any], value)]
    return value


def check_format(
    content: object, kind: type[FitRecord] | type[CorrespondenceRecord] | type[Recognition], where: str, again: str
) -> None:
    """Refuse what is not a file of the format of `kind` and its version; a file without a version is of the first.

    Raises:
        FileFormatError: it is not.
    """
    known: Mapping[str, Any] = cast(dict[str, Any], content) if isinstance(content, dict) else {}
    if known.get("format") != kind.FORMAT:
        raise FileFormatError(f"{where} is not {kind.CALLED} ({kind.FORMAT!r}); {again}.")
    version = known.get("format_version", 1)
    if version != kind.VERSION:
        raise FileFormatError(
            f"{where} has the format version {str(version)[:40]}, of which this version of shapespace knows only "
            f"{kind.VERSION}; update shapespace, or {again}."
        )


# NAME.fit.json


class File(Struct, frozen=True, kw_only=True):
    """A file that took part: its name, the SHA-256 of its content, and where it was, empty where that is not known.

    Args:
        size_bytes: of a scan, and
        modified_ns: when it was last written (ns since 1970), by which it is known again without reading it.
        remote_version: of a scan that lies elsewhere, at the address `path`, a word that changes with it.
    """

    name: str = ""
    hash: str = ""
    path: str = ""
    size_bytes: int | None = None
    modified_ns: int | None = None
    remote_version: str = ""


class Distances(Struct, frozen=True, kw_only=True):
    """Closest distances in mm, None where there is none, how many they are and which share of the points counted."""

    mean: float | None = None
    median: float | None = None
    rms: float | None = None
    p95: float | None = None
    max: float | None = None
    count: int | float | None = None
    fraction: float | None = None


class BothWays(Struct, frozen=True, kw_only=True):
    """Distances from the model's vertices to the scan, and from the scan's points to the model."""

    model_to_scan: Distances = Distances()
    scan_to_model: Distances = Distances()


class OverlapDistances(BothWays, frozen=True, kw_only=True):
    """Distances over the parts that scan and model both contain.

    Args:
        model_seen_share: share of the model's vertices that the scan shows, 0 to 1.
        scan_covered_share: share of the scan's points that lie within the model, 0 to 1.
    """

    model_seen_share: float | None = None
    scan_covered_share: float | None = None


class Pose(Struct, frozen=True, kw_only=True):
    """A similarity x -> scale · rotation · x + translation."""

    scale: float
    rotation: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    translation: tuple[float, float, float]


class Iteration(Struct, frozen=True, kw_only=True):
    """One step of a fit; lengths in mm of the scan."""

    phase: int
    iteration: int
    rms_mm: float | None = None
    motion_mm: float | None = None
    scale: float | None = None


class FoundLandmark(Struct, frozen=True, kw_only=True):
    """A landmark of the model on the fitted surface.

    Args:
        at: in the scan's own frame and unit.
        stddev_mm: along the axes of that frame, mm of the scan; None where the method finds none.
    """

    at: tuple[float, float, float]
    stddev_mm: tuple[float, float, float] | None = None


class ReasonRecord(Struct, frozen=True, kw_only=True):
    """One reason for the status of a fit.

    Args:
        code: a value of `fit.reasons.ReasonCode`, or one of a later version.
        data: its numbers by name.
    """

    code: str
    data: Mapping[str, Any] = {}


class FitRecord(Struct, frozen=True, kw_only=True):
    """A NAME.fit.json; the fields are in the order of its keys.

    Lengths are in mm of the scan, except coefficients, which are in mm of the model's frame.

    Args:
        id: SHA-256 of scan, model, landmarks, settings and version; the fitted surface's header has it too. Empty for a
            scan that could not be fitted.
        metadata: of the scan, by the columns of the list that named it.
        given_up: of a scan that its workers did not survive, the run that gave it up; else empty.
        status: the verdict; `unreadable` stands in place of a record that cannot be read, and in no file.
        reason: one sentence on why.
        reasons: the same as codes with data; empty for a scan that could not be fitted.
        scan: the scan.
        model: the model.
        landmarks: the landmarks from which the fit started.
        T_scan_model: pose, in the scan's own frame and unit; None for a scan that could not be fitted, as are the rest.
        b: (K,) coefficients in mm of the model's frame: norms over all vertices, so that b over the root of
            `n_vertices` is the RMS by which a mode moves a vertex,
        z: and in standard deviations.
        b_stddev: (K,) mm of the model's frame.
        shrinkage: (K,) in [0, 1].
        found_landmarks: the model's landmarks, on the dense surface where there is one, by name.
        distances_mm: by stage, over the whole model and every scan point within its rim.
        size_mm: root mean square distance of the fitted surface's vertices from their middle.
        n_vertices: of that surface, V.
        centroid_size_mm: root of the sum of those squares, which is size_mm times the root of V.
        extents_mm: of that surface along its principal axes, the longest first,
        area_mm2: and its area; None without triangles.
        shown: distances of the final stage over what the scan shows.
        shown_dense: of the dense surface, where there is one.
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
    shown: OverlapDistances | None = None
    shown_dense: OverlapDistances | None = None
    method: str = ""
    config: Mapping[str, Any] = {}
    start: str | None = None
    notes: tuple[str, ...] = ()
    T_scan_model: Pose | None = None
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
        """Return the content of the file; a failed scan has no keys of a fit, and a fit none that do not apply."""
        content: dict[str, Any] = to_json(self)
        for key in ("scan", "model", "landmarks"):
            if content[key]:
                file: dict[str, Any] = content[key]
                content[key] = {k: value for k, value in file.items() if value not in ("", None) or k in _OF_FILES}
        left_out = _NOT_ALWAYS if self.is_fitted else content.keys() - _OF_FAILED
        return {key: value for key, value in content.items() if value or key not in left_out}

    @staticmethod
    def from_json(content: object, where: str, again: str = FIT_AGAIN) -> FitRecord:
        """Return a record, checked.

        Raises:
            FileFormatError: it is no record of a fit, of another version, or damaged.
        """
        check_format(content, FitRecord, where, again)
        return read(FitRecord, content, where, again)


_OF_FILES = frozenset(("name", "hash"))
_OF_FAILED = frozenset(("reason", "config"))
_NOT_ALWAYS = frozenset(("metadata", "shown_dense", "area_mm2", "found_landmarks", "given_up"))
"""Keys of a fit that are left out where they are empty."""


# demo.json


class VertexErrors(Struct, frozen=True, kw_only=True):
    """Distances between vertices that correspond, mm."""

    mean: float
    rms: float
    max: float


class FitEntry(Struct, frozen=True, kw_only=True):
    """One fit beside its record: what was fitted, and the files it left, relative to the folder of the results.

    Args:
        intensity: of the expression, 0 to 1; None where it is not known.
        subject: whom the scan shows; empty where that is not known.
        json: the record.
        vertex_error_mm: to the truth, where it is known,
        floor_mm: and of the model's best reconstruction of it.
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
    """A mesh of the training set, kept to be shown."""

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
    """Experiment 1: a model of one person's expressions, fitted to unseen ones.

    Args:
        population_z: (N, K) coefficients of the training set in standard deviations.
        scores: of recognition, by name.
    """

    folder: str = ""
    training_examples: tuple[Example, ...] = ()
    population_z: tuple[tuple[float, ...], ...] = ()
    fits: tuple[FitEntry, ...] = ()
    scores: Mapping[str, Any] = {}


class Case(DemoModel, frozen=True, kw_only=True):
    """One scan of experiment 2, fitted by a model of other people.

    Args:
        fit: by the method of the paper.
        robust: by the robust method.
    """

    short: str = ""
    simulated: bool = False
    note: str = ""
    fit: FitEntry
    robust: FitEntry | None = None


class ManyPeople(Struct, frozen=True, kw_only=True):
    """Experiment 2: models of many people, fitted to scans of somebody else."""

    folder: str = ""
    cases: tuple[Case, ...] = ()


class Claim(Struct, frozen=True, kw_only=True):
    """What the paper states of a quantity, what the demo measured, the true error, and why they differ."""

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
"""Why a surface in correspondence needs review: its status is doubtful; it is far from its scan; triangles are folded;
vertices are missing; parts of the scan are not reached; triangles change their area; the last round moved it."""


class ReviewReason(Struct, frozen=True, kw_only=True):
    """A measure of a surface in correspondence that is unusual among those of all scans, or beyond a limit.

    Args:
        code: the measure.
        value: of the surface: a share from 0 to 1 (`distance` and `not_settled`: of the size of the object), or for
            `area_change` the factor by which triangles grow or shrink.
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
        """Count surfaces by the `codes` of their reasons, which are empty for a surface that needs no review."""
        every = [set(own) for own in codes]
        counts: Counter[ReviewCode] = Counter(code for own in every for code in own)
        return SurfaceReview(surfaces=len(every), needs_review=sum(map(bool, every)), reasons=_in_order(counts))

    def __add__(self, other: SurfaceReview) -> SurfaceReview:
        return SurfaceReview(
            surfaces=self.surfaces + other.surfaces,
            needs_review=self.needs_review + other.needs_review,
            reasons=_in_order(Counter(self.reasons) + Counter(other.reasons)),
        )

    @property
    def is_majority(self) -> bool:
        """Whether more than half of the surfaces need review."""
        return 2 * self.needs_review > self.surfaces


def _in_order(counts: Mapping[ReviewCode, int]) -> dict[ReviewCode, int]:
    return {code: counts[code] for code in get_args(ReviewCode) if code in counts}


class CorrespondRecord(Struct, frozen=True, kw_only=True):
    """A NAME.correspond.json: what came of one scan; lengths are in the scan's own unit, shares from 0 to 1.

    Args:
        name: NAME of the result files.
        path: of the scan, relative to the folder where there is such a path.
        hash: SHA-256 of its content.
        status: `converged`, `doubtful` or `excluded`.
        reason: why it is excluded.
        probability: that its surface is right, as far as the other scans show.
        doubt: why it is doubtful.
        review: further reasons to review the surface, the most unusual first.
        seen_share: share of the template's vertices that it shows; the others are estimates.
        covered_share: share of its points that the template reaches, leaving out those beyond the template's rim.
        area_share: area of its surface in correspondence beside that of the scan; well below 1 where the template lacks
            parts that the scan shows.
        distance_mean, distance_p95, distance_p99, distance_max: both ways, over what is seen and reached.
        scale: its size beside the usual one, units distinguished.
        size: RMS distance of the surface from its centroid, by that of the mean shape.
        unit_ratio: how many times as large as in the unit of most scans its coordinates are, such as 0.001 for metres
            among millimetres.
        notes: sentences on what should be known.
        folded_share: share of the triangles that turn back over their neighbours, as they do not on the mean shape.
        area_factor: 95 % of the triangles grow or shrink by less than this factor beside those of the mean shape, the
            change of size divided out.
        moved_share: RMS by which vertices moved in each round, as a share of its size.
        cpu_s: of each round.
        landmark_rms: distance of its landmarks from their places on the surface.
        landmark_distances: name -> distance of each given landmark from the surface of the scan, in its unit.
        mirrored: whether the scan is a mirror image of the majority. Its surface is in its own frame, with triangles
            whose corners are in reverse order, so that their normals point outwards.
        metadata: by the columns of the list that named it.
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
        """Why the surface needs review; empty if it does not."""
        codes: list[ReviewCode] = ["doubtful"] if self.doubt else []
        return codes + [reason.code for reason in self.review]


class CorrespondenceRecord(Struct, frozen=True, kw_only=True):
    """A correspondence.json: the run as a whole.

    Args:
        template: where the first template came from, and why, in a sentence.
        vertices: of the template.
        rounds: RMS by which vertices moved in each, as a share of the size.
        corresponding: NAMEs in correspondence.
        set_aside: NAME to reason of the others.
        doubtful: NAMEs in correspondence whose surfaces are probably wrong.
        needs_review: NAME to the codes of the reasons (`CorrespondRecord.review_codes`), of those that need review.
        other_units: NAME to `unit_ratio` of those that are in another unit than most.
        mirrored: NAMEs of those that are mirror images of the majority.
        sides_decided: whether scans could be distinguished from their mirror images.
        groups: NAMEs in correspondence, then those of each other kind of object; empty where all are of one kind.
        settings: of the run.
        version: of shapespace.
        inputs_hash: SHA-256 of the scans, landmarks, template, model, settings and version; a run with the same inputs
            reuses the results.
        results_hash: SHA-256 of the files that the run wrote, except this one.
        added: NAMEs that were registered to the mean after the run, and are not part of it.
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
    format: str = FORMAT
    format_version: int = VERSION

    @staticmethod
    def from_json(content: object, where: str = "correspondence.json") -> CorrespondenceRecord:
        """Return what a run says of itself, checked.

        Raises:
            FileFormatError: it is no correspondence, of another version, or damaged.
        """
        check_format(content, CorrespondenceRecord, where, CORRESPOND_AGAIN)
        return read(CorrespondenceRecord, content, where, CORRESPOND_AGAIN)


# quality.json


class Measured(Struct, frozen=True, kw_only=True):
    """A measure by the number of modes; without `modes`, of 1, 2, 3 and so on."""

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
    """A quality.json: shares of the variance (0 to 1), and errors in mm, those that were measured.

    Names without a suffix are measured from surface to surface; `..._vertices` from each vertex to its own place.
    `others` were measured on the same shapes and folds, and each has what it has more than this in `differences`.
    """

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
    """What a study aimed at, and what it reached; `met` is None where there is no verdict."""

    what: str = ""
    target: str = ""
    reached: str = ""
    met: bool | None = None
    note: str | None = ""


class Part(Struct, frozen=True, kw_only=True, omit_defaults=True, tag_field="kind"):
    """What each part of a study has; its class is its `kind` in JSON. One of `level` 2 begins a chapter."""

    title: str | None = ""
    note: str | None = ""
    level: int | None = None


class TextPart(Part, frozen=True, kw_only=True, tag="text"):
    """Paragraphs."""

    text: str | tuple[str, ...]


class TableColumn(Struct, frozen=True):
    """A column of a table; shares are 0 to 1, an interval is two of them."""

    name: str = ""
    kind: Literal["text", "percent", "interval", "number", "mm", "p", "count"] = "text"


class TablePart(Part, frozen=True, kw_only=True, tag="table"):
    """A table, its cells by the kinds of their columns; null where nothing is known."""

    columns: tuple[TableColumn, ...]
    rows: tuple[tuple[Any, ...], ...]

    @staticmethod
    def of(
        title: str, columns: Sequence[str], rows: Sequence[tuple[Any, ...]], *, percent: Sequence[str] = (),
        note: str = "", level: int | None = None,
    ) -> TablePart:  # fmt: skip
        """Return a table; the kind of a column is that of its first cell that is not None.

        Args:
            title: of the table.
            columns: their names; `p` is the one of p values.
            rows: of texts, integers, numbers and intervals.
            percent: columns of shares.
            note: of the table.
            level: of the title.
        """
        kinds: dict[str, Any] = {"p": "p", **dict.fromkeys(percent, "percent")}
        types: tuple[tuple[type, Any], ...] = ((str, "text"), (int, "count"), (tuple, "interval"), (object, "number"))
        made: list[TableColumn] = []
        for k, name in enumerate(columns):
            cell = next((row[k] for row in rows if row[k] is not None), 0.0)
            kind: Any = kinds.get(name) or next(one for own, one in types if isinstance(cell, own))
            made.append(TableColumn(name=name, kind=kind))
        return TablePart(title=title, columns=tuple(made), rows=tuple(rows), note=note, level=level)


class ConfusionPart(Part, frozen=True, kw_only=True, tag="confusion"):
    """How many scans of each true class (rows) were taken for each class (columns)."""

    classes: tuple[str, ...]
    counts: tuple[tuple[float, ...], ...]


class Bin(Struct, frozen=True, kw_only=True):
    """Answers that state a probability from `low` to `high`: the mean of it, the share that is right, how many."""

    low: float
    high: float
    confidence: float | None = None
    accuracy: float | None = None
    count: float = 0


class CalibrationPart(Part, frozen=True, kw_only=True, tag="calibration"):
    """How often answers are right against the probability stated."""

    bins: tuple[Bin, ...]
    ece: float | None = None
    brier: float | None = None


class LearningCurvePart(Part, frozen=True, kw_only=True, tag="learning_curve"):
    """Accuracy against the number of people learned from; `band` says what `low` and `high` are."""

    subjects: tuple[float, ...]
    mean: tuple[float, ...]
    low: tuple[float | None, ...] | None = None
    high: tuple[float | None, ...] | None = None
    band: str | None = None
    ceiling: float | None = None


class Series(Struct, frozen=True, kw_only=True):
    """One line of a curve, with a band around it where there is one; `points` are dots without a line.

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
    """One measure against another; `x` and `y` say what they are.

    On a `probit` scale shares stand at their normal deviates, as in a DET curve; `diagonal` draws y = x.
    """

    series: tuple[Series, ...]
    x: str = "x"
    y: str = "y"
    x_scale: Literal["linear", "log", "probit"] = "linear"
    y_scale: Literal["linear", "log", "probit"] = "linear"
    diagonal: bool = False


class SurfaceMapPart(Part, frozen=True, kw_only=True, tag="surface_map"):
    """A surface in an .npz file with a number a vertex, seen from several sides.

    Args:
        arrays: the file; the next three are names of arrays in it.
        vertices: (V, 3) mm.
        faces: (F, 3); empty where the surface has none.
        values: (V,); NaN where there is none.
        mask: name of a (V,) boolean array, outside which the colour is pale; empty for none.
        unit: of the numbers.
        signed: whether two colours part at zero.
        limit: where the colours end, in `unit`; None for what 98 % of the numbers stay below.
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
        arrays: the file; the next two are names of arrays in it.
        low: (V, 3) mm.
        high: (V, 3) mm.
        low_label: what `low` is.
        high_label: what `high` is.
        times: factor of the difference in both; 1 is the true difference, below 1 it is drawn smaller.
    """

    arrays: str
    low: str = "low"
    high: str = "high"
    low_label: str = "low"
    high_label: str = "high"
    times: float = 1.0


class MorphPart(ShapeChangePart, frozen=True, kw_only=True, tag="morph"):
    """Two surfaces, between which a slider moves.

    The slider moves on a line, or through the shapes low + weights[k] modes, at equal steps of a variable.

    Args:
        faces: name of an array (F, 3).
        modes: name of an array (q, V, 3), mm; empty for a line.
        weights: name of an array (B, q), 0 in the first row.
        variable: name of the variable.
        range: its values at `low` and `high`.
    """

    faces: str = "faces"
    modes: str = ""
    weights: str = ""
    variable: str = ""
    range: tuple[float, float] = (0.0, 1.0)


class DeformationPart(ShapeChangePart, frozen=True, kw_only=True, tag="deformation"):
    """Two configurations of landmarks: a deformation grid, or a vector for each landmark; z is 0 for planar ones.

    Args:
        drawing: `grid` for a thin-plate spline of planar landmarks, `vectors` for any.
    """

    drawing: Literal["grid", "vectors"] = "vectors"


class MorphospacePart(Part, frozen=True, kw_only=True, tag="morphospace"):
    """Shapes as points in the plane of two axes of an ordination; a click draws the shape there next to the mean.

    Args:
        arrays: an .npz file with `scores` (N, A), `mean` (V, 3), `shape_axes` (A, V, 3), the change of shape per unit
            of score, and `faces` (F, 3), empty for landmarks; perhaps with `groups` (N,) codes, `cross_validated`
            (N, A) scores, and `nodes` (M, A) and `edges` (E, 2) of a phylogeny, whose tips are the shapes.
        names: of the N shapes.
        axes: names of the A axes.
        shares: (A,) share of the variance of each axis.
        first: numbers of the axes drawn across and up, from 0.
        groups: names of the groups.
        variable: whose classes they are.
        unit: of the scores; empty for none.
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
    """How many values fall between each pair of `edges` of a histogram."""

    counts: tuple[float, ...]
    label: str = ""


class HistogramPart(Part, frozen=True, kw_only=True, tag="histogram"):
    """How values are spread; `observed` is a line at one of them, such as a statistic among its permutations."""

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
"""What a part is, by its kind."""


def read_part(content: object, where: str, again: str = STUDY_AGAIN) -> Part:
    """Return one part of a study by its kind.

    Raises:
        FileFormatError: it is damaged, or of a kind that this version does not know.
    """
    return read(cast(type[Part], _PARTS), content, where, again)


class Recognition(Struct, frozen=True, kw_only=True):
    """A recognition.json; `parts` are read one by one with `read_part`, so that one that is damaged costs no other."""

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
        """Return a study, with all of its parts checked.

        Raises:
            FileFormatError: it is no study of recognition, of another version, or damaged.
        """
        check_format(content, cls, where, again)
        study = read(cls, content, where, again)
        for part in study.parts:
            read_part(part, where, again)
        return study


# analysis.json


class SampleSize(Struct, frozen=True, kw_only=True):
    """Number of subjects and of shapes in a class of one variable, or in a combination of classes of several."""

    variables: tuple[str, ...]
    classes: tuple[str, ...]
    subjects: int
    shapes: int


class TestScheme(Struct, frozen=True, kw_only=True):
    """How the p values of one or more terms were computed.

    Args:
        tested: terms, or other quantities.
        stratum: in which they are tested; empty where there is one.
        statistic: such as `F`, `Welch t` or `R2`; empty for p values of a distribution.
        resampling: permutations of rows, sign flips of rows, bootstrap draws, leaving out each unit, or none.
        unit: what is permuted or flipped, such as `subject`; `scan of a subject`: values are permuted within subjects,
            and between subjects with the same number of scans.
        reduced_model: terms of the model whose residuals are resampled; empty for the mean; None where values
            themselves are.
        arrangements: number of them, the observed data among them.
        exhaustive: whether these are all there are.
        unequal_variances: whether the test allows groups of unequal dispersion.
    """

    __test__: ClassVar = False  # no test class of pytest

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
        variable: whose classes are the groups.
        stratum: in which residuals are taken; empty where there is one.
        groups: classes with two or more members.
        counts: members of each.
        stddev: standard deviation of each about its mean, RMS over the vertices, in `Methods.unit`.
        f: F of the distances to the group mean.
        p: by permutation of these distances.
        arrangements: number of permutations, the observed data among them.
        equal: whether p is above the level of significance.
        smaller_is_more_variable: whether smaller groups have the larger dispersion; None where neither is so.
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
        coordinates: of a vertex: 2 or 3.
        gauge: `shape` divides size out, `form` keeps it.
        tangent: whether the shapes lie in the tangent space at their mean.
        source: of the shapes: coefficients, fitted, dense, corresponding, other surfaces, or landmarks.
        review: number of the surfaces in correspondence that need review.
        modes: of the model that the shapes are combinations of; None where they are not limited to modes.
        explained_variance_ratio: share of the model's training variance in these modes; None as for `modes`.
        dimensions: of the space that is analysed; None where maps of vertices are.
        analysed_variance_ratio: share of the variance of the cohort in these dimensions.
        unit: of lengths: `mm`, or empty for coordinates without a unit.
        level: of significance.
        sizes: subjects and shapes of each class, and of each combination of classes.
        tests: how p values were computed.
        dispersions: tests of equal dispersion.
        unequal_variances: whether tests allow unequal dispersion; None where no groups are compared.
        effect_size: transformation before Z is standardised, `box-cox` or `log`; empty where no Z is given.
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
        name: such as `dorsal`.
        toward_viewer: direction from the object to the viewer.
        up: direction that points up in the figure.
    """

    name: str
    toward_viewer: tuple[float, float, float]
    up: tuple[float, float, float]


class Orientation(Struct, frozen=True, kw_only=True):
    """An orientation.json: how the figures of an object are drawn.

    Args:
        views: named views in the order of the figures; empty for views that are chosen by the form of the object.
        links: pairs of landmarks, numbers from 1, between which figures have a line.
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
        source: the landmark file or folder.
        specimens: their number.
        landmarks: their number.
        dimensions: 2 or 3.
        unit: of centroid sizes: `mm`, or empty.
        gauge: `shape` (unit centroid size) or `form`.
        tangent: whether shapes are projected onto the tangent space at their mean, as one structure.
        settings: further options, and the numbers of semilandmarks.
        estimated: number of landmarks that are estimates.
        iterations: of generalised Procrustes analysis.
        converged: whether its criterion was met.
        findings: specimens to check.
        notes: a sentence each.
        version: of shapespace.
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
    """An analysis.json: an answer about a cohort, by the command in `question`, as parts like those of a study."""

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
        """Return an analysis, with all of its parts checked; errors as of a study."""
        return super().from_json(content, where, again)
