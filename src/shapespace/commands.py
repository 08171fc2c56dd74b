"""What each command of the command line does, as plain functions; `cli.py` only parses and prints."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast

import numpy as np
from tqdm import tqdm

from shapespace.batch.results import read_record
from shapespace.batch.run import fit_files, make_executor, make_jobs, naming
from shapespace.batch.workers import cores, may_tell, start_loading
from shapespace.datasets import faces as bundled
from shapespace.datasets import fetch, ict
from shapespace.errors import FileFormatError, InputError, MeshError, ShapespaceError
from shapespace.fit.fit import FitConfig
from shapespace.fit.state import IcpState
from shapespace.geometry.doctor import examine
from shapespace.geometry.procrustes import Gauge
from shapespace.io.files import make_folder, read_bytes, read_error, remove_file, write_bytes, write_text
from shapespace.io.labels import read_labels
from shapespace.io.landmarks import read_landmark_indices, read_landmarks
from shapespace.io.meshes import MESH_ENDINGS, read_mesh, write_mesh
from shapespace.model.representation import representation_named
from shapespace.model.shape_model import ShapeModel
from shapespace.recognise.scans import NEUTRAL, ScanCoefficients, from_record, labelled, one_model, read_coefficients
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh

if TYPE_CHECKING:
    from shapespace.model.additive import AdditiveModel

ABOUT = "about.json"
"""Beside simulated faces: their provenance and licence, for the models made of them."""

_RECORD = ".fit.json"
_IDENTITY_VARIANCE, _EXPRESSION_VARIANCE = 0.995, 0.99


def progress_bar(total: int | None, what: str, unit: str, *, quiet: bool) -> tqdm[Any]:
    """Return a progress bar on standard error that is silent with `quiet` or without a terminal."""
    # disable=None is tqdm's way to ask whether there is a terminal.
    return tqdm(total=total, desc=what, unit=unit, leave=False, disable=True if quiet else None)


def telling_of_compiling(*, quiet: bool) -> AbstractContextManager[None]:
    """Return a block in which a line on standard error says why the user waits while code is compiled."""
    from shapespace.batch.warm import tell_compiling
    from shapespace.compiled import on_compiling

    return on_compiling(tell_compiling) if may_tell(quiet=quiet) else nullcontext()


def expand(paths: Sequence[Path]) -> list[Path]:
    """Return `paths` with each folder replaced by the meshes in it, in the order of their names.

    Raises:
        InputError: a folder without meshes.
        FileError: a folder that cannot be read.
    """
    found: list[Path] = []
    for path in paths:
        try:
            if not path.is_dir():
                found.append(path)
                continue
            inside = sorted(
                p
                for p in path.iterdir()
                if p.is_file() and p.suffix.lower() in MESH_ENDINGS and not p.name.startswith(".")
            )
        except OSError as error:
            raise read_error(path, error) from error
        if not inside:
            raise InputError(f"{path} holds no meshes; shapespace reads {', '.join(MESH_ENDINGS)}.")
        found += inside
    return found


def check(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Return what is in each mesh file, what is wrong with it, and what fitting will do about it."""
    reports: list[dict[str, Any]] = []
    for path in expand(paths):
        try:
            report = examine(read_mesh(path))
        except ShapespaceError as error:
            reports.append({"file": str(path), "usable": False, "error": naming(path, str(error))})
            continue
        facts = asdict(report)
        usable = not any(finding["level"] == "refused" for finding in facts["findings"])
        reports.append({"file": str(path), "usable": usable, **facts})
    return reports


def build(
    meshes: Sequence[Path],
    output: Path,
    *,
    modes: int | float | Literal["auto"] | None,
    gauge: Gauge,
    align: bool,
    unit: str,
    landmarks: Path | None,
    provenance: str,
    licence: str,
    seed: int,
    quiet: bool,
    representation: str = "vertices",
    control_points: tuple[int, int] | None = None,
    labels: Path | None = None,
    expression_variance: float | None = None,
) -> tuple[ShapeModel, list[str]]:
    """Build a model from mesh files and save it; return it and what the user should know.

    With `labels`, a table of subjects and expressions, it is one that parts identity and expression.

    Raises:
        FileError: a mesh cannot be read, or the model not written.
        MeshError: a mesh without vertices, or with faces that point past their end.
        CorrespondenceError: the meshes differ in vertices or triangles.
        InputError: too few meshes, no variation, too many modes asked for.
    """
    files = expand(meshes)
    notes: list[str] = []
    if output.suffix.lower() not in (".h5", ".hdf5"):
        raise InputError(f"{output}: a model file is HDF5, so give it a name that ends in .h5.")
    representation_named(representation, control_points)
    make_folder(output.absolute().parent)
    loaded: list[Mesh] = []
    with progress_bar(len(files), "reading", "mesh", quiet=quiet) as bar:
        for file in files:
            mesh = _training_mesh(file)
            loaded.append(mesh if unit == "mm" else mesh.with_vertices(mesh.vertices * MM_PER_UNIT[unit]))
            bar.update()
    marks = _landmark_indices(landmarks, loaded[0], MM_PER_UNIT[unit]) if landmarks else {}
    beside = files[0].parent / "landmarks.csv"
    if landmarks is None and beside.is_file():
        try:
            marks = _landmark_indices(beside, loaded[0], MM_PER_UNIT[unit])
            notes.append(f"Landmarks are taken from {beside}.")
        except ShapespaceError as error:
            notes.append(f"The model has no landmarks, since {beside} cannot be used: {error}")
    abouts = {folder: _about(folder / ABOUT) for folder in dict.fromkeys(file.parent for file in files)}
    about = abouts[files[0].parent]
    if about and not (provenance or licence):
        if len(set(abouts.values())) == 1:
            provenance, licence = f"{len(files)} meshes of: {about[0]}", about[1]
            notes.append(f"Provenance and licence are taken from {files[0].parent / ABOUT}.")
        else:
            notes.append("The meshes come from folders of different origin, so give --provenance and --licence.")
    if modes == "auto" and len(files) < 4:
        modes = None
        notes.append(f"With {len(files)} meshes the number of modes cannot be cross-validated, so all modes are kept.")
    said = provenance or f"{len(files)} meshes, {files[0].name} to {files[-1].name}"
    if labels is not None:
        if representation != "vertices":
            raise InputError("A model that parts identity and expression holds vertices; leave --representation out.")
        if not align:
            raise InputError(
                "A model that parts identity and expression aligns its faces itself; leave --no-align out."
            )
        additive = _additive(files, loaded, labels, modes, gauge, marks, expression_variance, said, licence)
        additive.save(output)
        notes.append(
            f"It parts {additive.n_identity} modes of identity and {additive.n_expression} of expression, by {labels}."
        )
        return additive.shape, notes
    if expression_variance is not None:
        raise InputError("--expression-variance belongs to --additive LABELS.csv; give both, or neither.")
    model = ShapeModel.fit(
        loaded,
        modes=modes,
        gauge=gauge,
        align=align,
        landmarks=marks,
        representation=representation,
        control_points=control_points,
        provenance=said,
        licence=licence,
        seed=seed,
    )
    model.save(output)
    return model, notes


def _additive(
    files: Sequence[Path],
    meshes: Sequence[Mesh],
    labels: Path,
    modes: int | float | Literal["auto"] | None,
    gauge: Gauge,
    landmarks: Mapping[str, int],
    expression_variance: float | None,
    provenance: str,
    licence: str,
) -> AdditiveModel:
    from shapespace.model.additive import AdditiveModel

    known = read_labels(labels)
    lacking = [file.name for file in files if file.stem not in known or not known[file.stem].subject]
    if lacking:
        raise InputError(
            f"{labels} has no subject for {', '.join(lacking[:3])}; each mesh needs a label and a subject."
        )
    own = [known[file.stem] for file in files]
    return AdditiveModel.fit(
        meshes,
        [label.subject for label in own],
        [label.text == NEUTRAL for label in own],
        identity_modes=_IDENTITY_VARIANCE if modes == "auto" else modes,
        expression_modes=_EXPRESSION_VARIANCE if expression_variance is None else expression_variance,
        gauge=gauge,
        landmarks=landmarks,
        provenance=provenance,
        licence=licence,
    )


def _about(path: Path) -> tuple[str, str] | None:
    """Return the provenance and licence that `data faces` left beside its meshes, or None."""
    if not path.is_file():
        return None
    try:
        stored = json.loads(read_bytes(path))
        return str(stored["provenance"]), str(stored["licence"])
    except (ValueError, KeyError, TypeError):
        return None


def _training_mesh(path: Path) -> Mesh:
    try:
        mesh = read_mesh(path)
    except MeshError as error:
        raise MeshError(naming(path, str(error))) from error
    if not len(mesh.vertices):
        raise MeshError(f"{path}: it has no vertices, so no shape model can be made of it; leave it out.")
    return mesh


def _landmark_indices(path: Path, first: Mesh, mm: float) -> dict[str, int]:
    """Return name -> vertex from a file of indices, or of points on the first mesh in the meshes' own unit."""
    if path.suffix.lower() == ".csv":
        try:
            return read_landmark_indices(path)
        except FileFormatError:
            pass  # a CSV of points, not of indices
    points = read_landmarks(path)
    # argmin takes a vertex that is missing, and so not-a-number, for the least.
    there = np.where(np.isnan(first.vertices), np.inf, first.vertices)
    return {name: int(np.linalg.norm(there - mm * point, axis=1).argmin()) for name, point in points.items()}


def info(path: Path) -> dict[str, Any]:
    """Return the facts of a model, a mesh or the record of a fit.

    Raises:
        FileError: it cannot be read, or is none of these.
    """
    if path.name.endswith(".json"):
        record = read_record(path)
        return {"kind": "fit", **{key: value for key, value in record.items() if key != "history"}}
    if path.suffix.lower() in (".h5", ".hdf5"):
        return {"kind": "model", **model_facts(ShapeModel.load(path))}
    mesh = read_mesh(path)
    return {"kind": "mesh", "file": str(path), **asdict(examine(mesh))}


def model_facts(model: ShapeModel) -> dict[str, Any]:
    """Return the facts of a model as plain values."""
    counts = model.coding.get("control_counts")
    needed = {f"{share:g}": model.modes_for_variance(share) for share in (0.9, 0.95, 0.98, 0.985, 0.99)}
    return {
        "vertices": model.n_vertices,
        "triangles": 0 if model.faces is None else len(model.faces),
        "modes": model.n_modes,
        "training_shapes": model.n_training,
        "gauge": model.gauge,
        "units": "mm",
        "extent_mm": np.ptp(model.mean_vertices, axis=0).tolist(),
        "variance_held": float(model.cumulative_variance[-1]),
        "variance_of": "people left out" if model.held_out else "training shapes",
        "modes_for_variance": {share: modes for share, modes in needed.items() if modes is not None},
        "stddev_mm": model.stddev.tolist(),
        "noise_variance_mm2": model.noise_variance,
        "landmarks": list(model.landmarks),
        "representation": model.representation,
        **({} if counts is None else {"control_points": counts.tolist()}),
        "provenance": model.provenance,
        "licence": model.licence,
        "hash": model.content_hash,
    }


def _without_results(scans: Sequence[Path], folder: Path) -> list[Path]:
    """Return `scans` without the surfaces that an earlier run left in `folder`, where scans and results mix."""
    here = folder.resolve()

    def is_result(scan: Path) -> bool:
        name = scan.name.removesuffix(".fitted.ply").removesuffix(".dense.ply")
        return name != scan.name and scan.parent.resolve() == here and scan.with_name(f"{name}.fit.json").is_file()

    left = [scan for scan in scans if not is_result(scan)]
    if not left:
        raise InputError(f"{folder} holds only results of earlier fits; give the scans, or another folder for results.")
    return left


def fit_scans(
    model_path: Path,
    scans: Sequence[Path],
    folder: Path,
    config: FitConfig,
    *,
    landmarks: Path | None,
    jobs: int,
    resume: bool,
    stages: bool,
    quiet: bool,
    say: Callable[[str], None],
) -> list[dict[str, Any]]:
    """Fit scans from files into `folder`, and return their records in order.

    Raises:
        FileError: the model cannot be read, or the results not written.
        InputError: landmarks for more than one scan.
    """
    files = _without_results(expand(scans), folder)
    if landmarks is not None and len(files) > 1:
        raise InputError("--landmarks belongs to one scan, but several were given; fit them one at a time.")
    model = ShapeModel.load(model_path)
    make_folder(folder)
    write_bytes(folder / ".writable", b"")
    remove_file(folder / ".writable")
    work = make_jobs(files, landmarks)
    workers = min(jobs or cores(), len(work))
    bar = progress_bar(len(work), "fitting", "scan", quiet=quiet)

    def show_state(state: IcpState) -> None:
        bar.set_postfix_str(f"phase {state.phase}, iteration {state.iteration}, RMS {state.rms_mm:.2f} mm")

    def done(job: Any, record: Mapping[str, Any]) -> None:
        bar.update()
        if record["status"] == "converged":
            return
        bar.clear()
        # The reason of a failure names the file already.
        say(record["reason"] if record["status"] == "failed" else f"{job.scan}: {record['status']}: {record['reason']}")

    with bar:
        if workers <= 1:
            with telling_of_compiling(quiet=quiet):
                return fit_files(
                    work, model, model_path, folder, config,
                    resume=resume, stages=stages, on_done=done, on_state=show_state,
                )  # fmt: skip
        start_loading(tell=may_tell(quiet=quiet))
        with make_executor(model_path, workers) as executor:
            return fit_files(
                work, model, model_path, folder, config,
                executor=executor, resume=resume, stages=stages, on_done=done,
            )  # fmt: skip


def write_simulated_faces(
    folder: Path,
    *,
    source: str,
    subjects: int,
    expressions: Sequence[str],
    seed: int,
    area: str,
    quiet: bool,
    raw: bool = False,
) -> int:
    """Write corresponded faces of the bundled or of the ICT generator, or raw scans of them, and return how many.

    Raises:
        InputError: an unknown expression or area.
        DataError: ICT-FaceKit is asked for and absent.
        FileError: the folder cannot be written.
    """
    make_folder(folder)
    total = subjects * len(expressions)
    with progress_bar(total, "writing", "face", quiet=quiet) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        if source == "ict-facekit":
            if area not in ("face", "face_and_head"):
                raise InputError(f"The area must be face or face_and_head, not {area!r}.")
            ict.write_people(
                folder, subjects=subjects, seed=seed, area=area, expressions=expressions, raw=raw, progress=progress
            )
        else:
            bundled.write_faces(
                folder, subjects=subjects, expressions=expressions, seed=seed, raw=raw, progress=progress
            )
    licence, of = ("MIT", f"ICT-FaceKit, area {area}") if source == "ict-facekit" else (bundled.LICENSE, "shapespace")
    about = {
        "provenance": f"{subjects} simulated people of {of}, seed {seed}, expressions: {', '.join(expressions)}",
        "licence": licence,
    }
    write_text(folder / ABOUT, json.dumps(about, indent=1) + "\n")
    return total


def report(folder: Path, output: Path | None, *, model: Path | None, labels: Path | None, quiet: bool) -> Path:
    """Write the report on the results in `folder`, and return its path.

    Raises:
        FileError: something in it cannot be read, or the report not written.
        InputError: the folder holds no results, or `model` is not of its fits.
        ShapespaceError: the extra `report` is not installed.
    """
    from shapespace.report.html import write_report

    with progress_bar(None, "drawing", "picture", quiet=quiet) as bar:

        def step(what: str, planned: int) -> None:
            bar.total = max(planned, bar.n + 1)
            bar.update()

        return write_report(folder, output, model=model, labels=labels, on_step=step)


def read_scans(path: Path) -> list[ScanCoefficients]:
    """Return the fits in a folder that `fit` wrote, or in a coefficients.csv, in the order of their names or rows.

    Raises:
        FileError: it cannot be read.
        FileFormatError: a record or the table is damaged.
        InputError: the folder holds no records of fits.
    """
    if not path.is_dir():
        return read_coefficients(path)
    try:
        files = sorted(p for p in path.iterdir() if p.name.endswith(_RECORD) and p.is_file())
    except OSError as error:
        raise read_error(path, error) from error
    if not files:
        raise InputError(f"{path} holds no results of fits; give a folder that shapespace fit wrote.")
    return [from_record(file.name.removesuffix(_RECORD), read_record(file)) for file in files]


def recognise_train(
    results: Path,
    labels: Path,
    output: Path,
    *,
    classifier: str,
    relative: bool,
    neutral: str,
    confidence: float,
    modes: int | None,
    expression_of: Path | None,
    seed: int,
) -> tuple[dict[str, Any], list[str]]:
    """Train a classifier on the fits in `results` and save it; return its facts and what the user should know.

    Raises:
        FileError: something cannot be read, or the classifier not written.
        FileFormatError: results or labels are damaged.
        InputError: what `train_classifier` refuses, fits of another model than `expression_of`, or a name that does
            not end in .skops.
        ModelFileError: `expression_of` does not part identity and expression.
        ShapespaceError: the extra `recognise` is not installed.
    """
    from shapespace.model.additive import AdditiveModel
    from shapespace.recognise.predict import train_classifier

    scans = labelled(read_scans(results), read_labels(labels, of_subjects=False))
    projection: FloatArray | None = None
    if expression_of is not None:
        model, fitted_with = AdditiveModel.load(expression_of), one_model(scans)
        if model.shape.content_hash != fitted_with:
            raise InputError(
                f"{results} holds fits of the model {fitted_with[:12]}, and {expression_of} is "
                f"{model.shape.content_hash[:12]}; give the model that the scans were fitted with."
            )
        projection = model.rotation[model.n_identity :]
    saved, notes = train_classifier(
        scans, classifier=classifier, relative=relative, neutral=neutral, confidence=confidence, modes=modes,
        projection=projection, seed=seed,
    )  # fmt: skip
    make_folder(output.absolute().parent)
    saved.save(output)
    return saved.facts(), notes


def recognise_predict(
    classifier: Path, results: Path, output: Path, *, labels: Path | None
) -> tuple[list[dict[str, Any]], dict[str, int]]:
    """Write the classifier's answer for each fit in `results`; return the rows, and counts of what came out.

    The counts are `answered`, `unsure`, `doubtful` (unsure for the fit's sake), `failed` (the fit failed, or its
    neutral face is missing) and `neutral` (faces that others are compared with).

    Raises:
        FileError: something cannot be read, or the answers not written.
        FileFormatError: the classifier, results or labels are damaged.
        InputError: the fits are of another model than the classifier, or labels are needed.
        ShapespaceError: the extra `recognise` is not installed.
    """
    from shapespace.recognise.predict import UNSURE, predict_scans, write_answers
    from shapespace.recognise.saved import load_classifier

    saved = load_classifier(classifier)
    if saved.relative_to_neutral and labels is None:
        raise InputError(
            f"{classifier} compares with each subject's neutral face; give --labels with the columns file, label and "
            "subject."
        )
    scans = read_scans(results)
    answers = predict_scans(saved, labelled(scans, read_labels(labels)) if labels is not None else scans)
    make_folder(output.absolute().parent)
    write_answers(output, answers, saved.classes)
    counts: dict[str, int] = dict.fromkeys(("answered", "unsure", "doubtful", "failed", "neutral"), 0)
    rows: list[dict[str, Any]] = []
    for answer in answers:
        if answer.neutral:
            kind = "neutral"
        elif answer.probabilities is None:
            kind = "doubtful" if answer.status == "doubtful" else "failed"
        else:
            kind = "unsure" if answer.prediction == UNSURE else "answered"
        counts[kind] += 1
        p = answer.probabilities
        rows.append({
            "scan": answer.scan,
            "status": answer.status,
            "prediction": answer.prediction,
            "probabilities": {} if p is None else dict(zip(saved.classes, p.tolist(), strict=True)),
            "reason": answer.reason,
        })  # fmt: skip
    return rows, counts


def data_list() -> list[dict[str, object]]:
    """Return the open data sets with licence, size, hash, and whether they are here already."""
    return fetch.data_list()


def data_get(name: str, to: Path | None, *, quiet: bool) -> Path:
    """Return the folder of a data set, downloaded and verified if it is not here yet.

    Raises:
        DataError: no such data set, no network, or content that does not match its hash.
    """
    return fetch.data_get(name, to=to, progress=False if quiet else None)


def recognise_transfer(model: Path, person: Path, expression: Path, output: Path) -> None:
    """Write the person of one fit with the expression of another, as a mesh.

    Raises:
        FileError: something cannot be read, or the mesh not written.
        FileFormatError: a record is damaged.
        InputError: the model does not part identity and expression, or a fit is of another one.
    """
    from shapespace.model.additive import AdditiveModel

    additive = AdditiveModel.load(model)
    z: list[FloatArray] = []
    for path in (person, expression):
        record = read_record(path)
        if record.get("status") == "failed":
            raise InputError(f"{path} is the record of a fit that failed, so there is nothing to transfer.")
        source = record.get("model")
        if not isinstance(source, dict) or cast(dict[str, Any], source).get("hash") != additive.shape.content_hash:
            raise InputError(f"{path} is a fit by another model than {model.name}; fit the scan with this one.")
        values = np.asarray(record.get("z", []), dtype=np.float64)
        if values.shape != (additive.shape.n_modes,):
            raise InputError(
                f"{path} holds {len(values)} coefficients of {additive.shape.n_modes}; fit the scan with all modes."
            )
        z.append(values)
    write_mesh(output, additive.transfer(z[0], z[1]))


def recognise_study(
    output: Path, data: Path | None, model: Path | None, *, folds: int, seed: int, jobs: int, quiet: bool
) -> tuple[Path, list[dict[str, Any]], str]:
    """Run the recognition study on labelled scans; return its report, its targets and what the scans are, in words.

    Raises:
        FileError: something cannot be read or written.
        InputError: no scans or no model, or too few people.
        ShapespaceError: the extras `recognise` and `report` are not installed.
    """
    if data is None or model is None:
        raise InputError(
            "A study of scans of your own needs both --data DIR and --model MODEL.h5; the one on simulated people is "
            "python studies/recognition.py in the source of shapespace."
        )
    from shapespace.study.own_scans import run_own_study  # needs the extras

    with telling_of_compiling(quiet=quiet):
        report, holds = run_own_study(output, data, model, folds=folds, workers=jobs or cores(), seed=seed, quiet=quiet)
    content = json.loads(read_bytes(output / "recognition.json"))
    return report, content["targets"], holds
