"""The simulated study: models of each fold, and every scan fitted with them, as files that a later run goes on from."""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from threadpoolctl import threadpool_limits

from shapespace import __version__
from shapespace.batch.workers import context, interrupts_ignored, start_loading, wait_until_loaded
from shapespace.datasets.faces import LICENSE, Expression, FaceGenerator, load_faces
from shapespace.datasets.fetch import present_folder
from shapespace.datasets.ict import IctFaces, landmark_vertices, load_ict
from shapespace.datasets.simulated_scan import SimulatedScan
from shapespace.errors import FileFormatError, FitError, InputError, ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.robust.robust_method import Robust
from shapespace.fit.robust.robust_settings import Level
from shapespace.geometry.mirror_plane import FLIP
from shapespace.io.files import make_folder, read_bytes, write_bytes, write_text
from shapespace.model.additive import AdditiveModel, FitInformation
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, IntArray, Mesh, Similarity
from study_fits import STATUSES, model_path, paper_path, person_path, stranger_path
from study_people import StudyPeople

MIRRORED = ", mirrored"
PAPER_EXPRESSIONS = ("anger", "disgust", "fear", "smile")
Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with (what, done, total)."""
Job: TypeAlias = tuple[Callable[..., None], tuple[Any, ...]]
Stage: TypeAlias = tuple[str, Sequence[Job], Sequence[Path]]

SETTINGS = Robust(
    levels=(
        Level(0, 1_500, 1_000, False, 3, 1.0),
        Level(10, 1_500, 1_000, False, 4, 1.0),
        Level(40, 2_500, 1_500, False, 2, 1.0),
        Level(None, 2_000, 800, False, 4, 0.2),
        Level(None, 4_000, 800, True, 8, 0.05),
    ),
    beyond_share=np.inf,
)
"""Of all fits: fewer matches than the defaults, for scans of 4,000 vertices; 0.004 mm behind them in vertex error."""


@dataclass(frozen=True)
class StudyConfig:
    """How the simulated study is made.

    Args:
        people: whom it is made of.
        folds: how many times the subjects are parted; models, classifiers and scaling never see those tested.
        taught_levels: of how many intensities of each expression, drawn anew for each person, classifiers learn; every
            one is tested.
        identity_modes: of the additive model: a number, or a share of the variance.
        expression_modes: the same for expressions.
        strangers: people of the bundled generator, another one than the training's, who are scanned and recognised.
        stranger_levels: intensities of their expressions.

    Raises:
        InputError: folds that leave no one to train or to test.
    """

    people: StudyPeople = field(default_factory=StudyPeople)
    folds: int = 4
    taught_levels: int = 2
    identity_modes: int | float = 0.99999
    expression_modes: int | float = 0.999
    strangers: int = 25
    stranger_levels: tuple[float, ...] = (0.75, 1.0)

    def __post_init__(self) -> None:
        if not 2 <= self.folds <= self.people.people // 2:
            raise InputError(
                f"{self.people.people} people cannot be parted into {self.folds} folds; each needs two of them."
            )

    def taught(self, person: int) -> IntArray:
        """Return (S,) the place of each scan among those of its expression that classifiers learn from, or -1.

        Neutral has 0; the weaker of two taught scans of the first expression 1, the stronger 2, and so on.
        """
        rng = np.random.default_rng((self.people.seed, 6, person))
        levels, each = len(self.people.levels), min(self.taught_levels, len(self.people.levels))
        places = np.full(len(self.people.shown), -1, dtype=np.int32)
        places[0] = 0
        for number in range(len(self.people.expressions)):
            chosen = np.sort(rng.permutation(levels)[:each])
            places[1 + number * levels + chosen] = 1 + number * each + np.arange(each)
        return places

    @property
    def digest(self) -> str:
        """SHA-256 of every setting and of the version."""
        text = json.dumps({**asdict(self), "version": __version__}, sort_keys=True, default=str)
        return sha256(text.encode()).hexdigest()

    def fold_of(self) -> IntArray:
        """Return (P,) the fold in which each person is tested."""
        order = np.random.default_rng((self.people.seed, 3)).permutation(self.people.people)
        fold = np.empty(len(order), dtype=np.int32)
        fold[order] = np.arange(len(order)) % self.folds
        return fold


def prepare_folder(folder: Path, config: StudyConfig) -> None:
    """Make `folder` a study of `config`, or see that it is one already.

    Raises:
        InputError: it holds another study.
        FileError: it cannot be written.
    """
    make_folder(folder)
    path = folder / "study.json"
    if path.is_file():
        try:
            held = json.loads(read_bytes(path))["digest"]
        except (ValueError, KeyError, TypeError) as error:
            raise FileFormatError(f"{path} is damaged; give a new folder.") from error
        if held != config.digest:
            raise InputError(
                f"{folder} holds a study with other settings or of another version; give a new folder, or its settings."
            )
        return
    text = json.dumps({"digest": config.digest, "version": __version__, "settings": asdict(config)}, indent=1)
    write_text(path, text + "\n")


def run_fits(folder: Path, config: StudyConfig, *, workers: int, on_progress: Progress | None = None) -> None:
    """Make the models and all fits of a study in `folder`, leaving out what is there already.

    Args:
        folder: from `prepare_folder`.
        config: of the study.
        workers: processes.
        on_progress: called after each model and each person.

    Raises:
        DataError: ICT-FaceKit is not here.
        FitError: a worker was stopped from outside.
        FileError: the folder cannot be written.
    """
    progress: Progress = on_progress or _no_progress
    run_jobs(
        [
            ("models", [(_make_model, (folder, config, fold)) for fold in range(config.folds)],
             [model_path(folder, fold) for fold in range(config.folds)]),
            ("paper", [(_fit_paper, (folder, config))], [paper_path(folder)]),
            ("people", [(_fit_person, (folder, config, person)) for person in range(config.people.people)],
             [person_path(folder, person) for person in range(config.people.people)]),
            ("strangers", [(_fit_stranger, (folder, config, person)) for person in range(config.strangers)],
             [stranger_path(folder, person) for person in range(config.strangers)]),
        ],
        workers=workers,
        on_progress=progress,
    )  # fmt: skip


def run_jobs(stages: Sequence[Stage], *, workers: int, on_progress: Progress) -> None:
    """Run stages one after the other, the jobs of each in worker processes, without those whose file is there.

    Args:
        stages: (what, jobs, the file that each job ends in).
        workers: processes.
        on_progress: called with each stage and after each job.

    Raises:
        FitError: a worker was stopped from outside.
        ShapespaceError: as a job does.
    """
    with ExitStack() as stack:
        pool: Executor | None = None
        for what, jobs, paths in stages:
            todo = [job for job, path in zip(jobs, paths, strict=True) if not path.is_file()]
            done = len(jobs) - len(todo)
            on_progress(what, done, len(jobs))
            if todo and pool is None:
                pool = stack.enter_context(_pool(workers))
            for _ in _run(pool, todo):
                done += 1
                on_progress(what, done, len(jobs))


def _no_progress(what: str, done: int, total: int) -> None:
    pass


def _pool(workers: int) -> Executor:
    start_loading(notify=False)
    wait_until_loaded()
    folder = present_folder("ict-facekit", "ICT-FaceKit")
    return ProcessPoolExecutor(workers, mp_context=context(), initializer=_begin, initargs=(folder,))


def _begin(folder: Path) -> None:
    """Start a worker; it receives the place of ICT-FaceKit, since its environment may be older than this process's."""
    global _ict_folder
    _ict_folder = folder
    threadpool_limits(1)


def _run(pool: Executor | None, jobs: Sequence[Job]) -> Iterator[None]:
    if pool is None:
        return
    with ExitStack() as stack:
        with interrupts_ignored():
            futures = [pool.submit(job, *arguments) for job, arguments in jobs]
        stack.callback(lambda: [future.cancel() for future in futures])
        for future in as_completed(futures):
            try:
                future.result()
            except BrokenExecutor as error:
                raise FitError(
                    "A worker was stopped from outside, most likely for lack of memory; run again with fewer --jobs."
                ) from error
            yield


_ict_folder: Path | None = None
_ict: IctFaces | None = None
_models: dict[Path, AdditiveModel] = {}


def faces_of_ict() -> IctFaces:
    """Return ICT-FaceKit, read once in each process."""
    global _ict
    if _ict is None:
        _ict = load_ict(_ict_folder)
    return _ict


def _model(path: Path) -> AdditiveModel:
    if path not in _models:
        _models[path] = AdditiveModel.load(path)
    return _models[path]


def training_meshes(
    config: StudyConfig, ict: IctFaces, people: Sequence[int]
) -> tuple[list[Mesh], list[str], list[bool]]:
    """Return corresponding meshes of `people`, neutral and each expression at its strongest, with subject and neutral.

    Each stands beside its mirror image, which is a face as likely as the other and doubles the people.
    """
    strongest = max(config.people.levels)
    meshes: list[Mesh] = []
    subjects: list[str] = []
    neutral: list[bool] = []
    other = ict.mirror
    for person in people:
        faces = config.people.faces(ict, person)
        for face, (_, level) in zip(faces, config.people.shown, strict=True):
            if level in (0.0, strongest):
                meshes += [face, face.with_vertices(face.vertices[..., other, :] * FLIP)]
                subjects += [config.people.subject(person), config.people.subject(person) + MIRRORED]
                neutral += 2 * [level == 0.0]
    return meshes, subjects, neutral


def _make_model(folder: Path, config: StudyConfig, fold: int) -> None:
    training = np.flatnonzero(config.fold_of() != fold)
    meshes, subjects, neutral = training_meshes(config, faces_of_ict(), training.tolist())
    kin = [subject.removesuffix(MIRRORED) for subject in subjects]
    AdditiveModel.fit(
        meshes,
        subjects,
        neutral,
        identity_modes=config.identity_modes,
        expression_modes=config.expression_modes,
        kin=kin,
        landmarks=landmark_vertices("face"),
        provenance=f"{len(training)} simulated people of ICT-FaceKit with {len(config.people.expressions)} expressions",
        licence="MIT",
    ).save(model_path(folder, fold))


def _fit_person(folder: Path, config: StudyConfig, person: int) -> None:
    people, ict = config.people, faces_of_ict()
    own = int(config.fold_of()[person])
    order = [own, *(fold for fold in range(config.folds) if fold != own)]
    scans = [(face, people.scan(face, person, k)) for k, face in enumerate(people.faces(ict, person))]
    taught = config.taught(person) >= 0
    _fit_all(folder, person_path(folder, person), [scan for _, scan in scans], order, config.folds, taught)


def _fit_stranger(folder: Path, config: StudyConfig, person: int) -> None:
    generator = load_faces()
    scans = [stranger_scan(generator, config, person, k) for k in range(len(stranger_shown(config)))]
    _fit_all(folder, stranger_path(folder, person), scans, [0], config.folds, None)


def paper_shown() -> tuple[tuple[str, float], ...]:
    """What is tested in the paper's experiment 1: neutral, then four expressions at four intensities, 16 faces."""
    return (("neutral", 0.0), *((name, level) for name in PAPER_EXPRESSIONS for level in (0.25, 0.5, 0.75, 1.0)))


def _fit_paper(folder: Path, config: StudyConfig) -> None:
    """One person of the bundled generator: 100 mixed expressions make the model, raw scans of 17 others are fitted."""
    generator, people = load_faces(), config.people
    rng = np.random.default_rng((people.seed, 7))
    person = generator.draw_person(rng)
    training = [generator.face(person, generator.mixed_expression(rng), name=f"{k:03d}") for k in range(100)]
    whole = ShapeModel.fit(
        training,
        alignment_vertices=generator.regions["semi_rigid"],
        landmarks=generator.landmarks,
        provenance="100 mixed expressions of one simulated person",
        licence=LICENSE,
    )
    model = whole.truncate(whole.modes_for_variance(0.985) or whole.n_modes)
    b: list[FloatArray] = []
    status: list[int] = []
    for name, level in paper_shown():
        face = generator.face(person, generator.draw_expression(name, level, rng) if level else None)
        scan = people.raw_scan(face, rng, f"{name} {round(100 * level)}")
        try:
            fitted = fit_scan(model, scan.scan, FitConfig(unit="mm"))
        except ShapespaceError:
            b.append(np.full(model.n_modes, np.nan))
            status.append(STATUSES.index("failed"))
            continue
        b.append(fitted.b)
        status.append(STATUSES.index(fitted.status))
    memory = io.BytesIO()
    np.savez(memory, b=np.stack(b), stddev=model.stddev, status=np.array(status, dtype=np.int32))
    make_folder(paper_path(folder).parent)
    write_bytes(paper_path(folder), memory.getvalue())


def stranger_shown(config: StudyConfig) -> tuple[tuple[str, float], ...]:
    """What each stranger shows: neutral, then the paper's expressions at each level."""
    return (
        ("neutral", 0.0),
        *((name, level) for name in PAPER_EXPRESSIONS for level in config.stranger_levels),
    )


def stranger_scan(generator: FaceGenerator, config: StudyConfig, person: int, shown: int) -> SimulatedScan:
    """Return a raw scan of a face by the bundled generator, made as those of the study are."""
    people = config.people
    who = generator.draw_person(np.random.default_rng((people.seed, 4, person)), f"stranger_{person:03d}")
    name, level = stranger_shown(config)[shown]
    rng = np.random.default_rng((people.seed, 5, person, shown))
    expression: Expression | None = generator.draw_expression(name, level, rng) if level else None
    face = generator.face(who, expression)
    return people.raw_scan(face, rng, f"{who.name}_{name}_{round(100 * level):03d}")


def _fit_all(
    folder: Path,
    path: Path,
    scans: Sequence[SimulatedScan],
    order: Sequence[int],
    folds: int,
    taught: npt.NDArray[np.bool_] | None,
) -> None:
    """Fit each scan with the first model of `order`, and those that are taught with the others, into one file.

    Without `taught` the model's vertices are not those of the truth, and there is nothing to compare.
    """
    models = {fold: _model(model_path(folder, fold)) for fold in order}
    k, n = max(model.shape.n_modes for model in models.values()), len(scans)
    z, stddev = np.full((folds, n, k), np.nan), np.full((folds, n, k), np.nan)
    status = np.full((folds, n), -1, dtype=np.int32)
    error_mm, seconds = np.full(n, np.nan), np.full(n, np.nan)
    information: dict[int, dict[int, FitInformation]] = {fold: {} for fold in order}
    for row, scan in enumerate(scans):
        T: Similarity | None = None
        for fold in order if taught is None or taught[row] else order[:1]:
            shape = models[fold].shape
            config = FitConfig(SETTINGS, unit="mm")
            since = time.perf_counter()
            # Fits with the models of other folds start at the pose found first; shape and pose are then found anew.
            try:
                fitted = fit_scan(shape, scan.scan, config, T_scan_model=T)
            except ShapespaceError:
                status[fold, row] = STATUSES.index("failed")  # counted as such, and never guessed
                continue
            z[fold, row, : shape.n_modes] = fitted.z
            stddev[fold, row, : shape.n_modes] = fitted.b_stddev / shape.stddev
            z[fold, row, shape.n_modes :], stddev[fold, row, shape.n_modes :] = 0.0, 1.0
            status[fold, row] = STATUSES.index(fitted.status)
            assert fitted.z_covariance is not None
            information[fold][row] = models[fold].information(fitted.z, fitted.z_covariance)
            if T is None:
                T = fitted.T_scan_model
                seconds[row] = time.perf_counter() - since
                if taught is not None:
                    away = T.apply(shape.reconstruct(fitted.b)) - scan.truth_vertices
                    error_mm[row] = float(np.linalg.norm(away, axis=1).mean()) / scan.T_scan_model.scale
    tied = _tied(models, information, folds, n)
    memory = io.BytesIO()
    np.savez(
        memory,
        e_beside=tied["e_beside"].astype(np.float32),
        e_together=tied["e_together"].astype(np.float32),
        a_together=tied["a_together"].astype(np.float32),
        z=z.astype(np.float32),
        z_stddev=stddev.astype(np.float32),
        status=status,
        error_mm=error_mm,
        seconds=seconds,
    )
    make_folder(path.parent)
    write_bytes(path, memory.getvalue())


def _tied(
    models: Mapping[int, AdditiveModel], information: Mapping[int, Mapping[int, FitInformation]], folds: int, scans: int
) -> dict[str, FloatArray]:
    """Return e beside the neutral scan, which is row 0, and e and a of all others together, by fold."""
    most_e = max(model.n_expression for model in models.values())
    most_a = max(model.n_identity for model in models.values())
    beside, together = np.full((folds, scans, most_e), np.nan), np.full((folds, scans, most_e), np.nan)
    identity = np.full((folds, 1, most_a), np.nan)
    for fold, model in models.items():
        known = information[fold]
        rows = [row for row in known if row != 0]
        if not rows:
            continue
        a, e = model.tie([known[row] for row in rows])
        together[fold, rows], identity[fold] = 0.0, 0.0
        together[fold, rows, : model.n_expression], identity[fold, 0, : model.n_identity] = e, a
        if 0 in known:
            beside[fold, rows] = 0.0
            for row in rows:
                # The difference takes out what identity outside the model leaves in both.
                _, e = model.tie([known[0], known[row]])
                beside[fold, row, : model.n_expression] = e[1] - e[0]
    return {"e_beside": beside, "e_together": together, "a_together": identity}
