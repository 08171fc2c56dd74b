"""Commands `check` and `info`: facts of meshes, models, fits and correspondences."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.batch.fit_records import read_record
from shapespace.batch.fit_work import naming
from shapespace.batch.result_folder import names_for
from shapespace.commands.outcome import Outcome, exit_code_of, short
from shapespace.errors import FileError, InputError, ShapespaceError
from shapespace.geometry.doctor import Finding, examine, examine_and_repair, repair
from shapespace.geometry.grooming import NO_GROOMING, Grooming
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import faces_of
from shapespace.io.files import make_folder, remove_file
from shapespace.io.meshes.mesh_io import mesh_files, read_mesh, write_mesh
from shapespace.model.additive import load_model
from shapespace.model.foreign import looks_like_model
from shapespace.model.region import relative_pose
from shapespace.model.shape_model import ShapeModel
from shapespace.schemas import CORRESPOND_AGAIN, CorrespondenceRecord, CorrespondRecord, read, to_json
from shapespace.store.corresponding import json_of
from shapespace.store.results import Results, mesh_at, modes_of, results_at
from shapespace.types import MM_PER_UNIT, Mesh

_BY_SCAN = ("set_aside", "unreadable", "needs_review")
"""Facts of a correspondence that have a text for some scans."""
NOT_CALIBRATED = "its results are not calibrated: statuses, intervals and expected errors come from the model alone"


def check(
    files: Sequence[Path],
    *,
    recursive: bool,
    strict: bool = False,
    output: Path | None = None,
    unit: str | None = None,
    mirror: bool = False,
    symmetric: bool = False,
    grooming: Grooming = NO_GROOMING,
    say: Callable[[str], None],
) -> Outcome:
    """Return the content of each mesh file, its problems, and how fitting will handle them.

    A file that cannot be read, or takes more memory than there is, is reported with an error, and the next one read.

    Args:
        files: files and folders.
        recursive: whether to search subfolders too.
        strict: whether a mesh with triangles that use vertices with non-finite coordinates is not usable.
        output: folder in which the repaired meshes are written in mm, as NAME.ply (default: none is written).
        unit: unit of the files, a name of `MM_PER_UNIT` (default: mm).
        mirror: write mirror images, such as of left bones among right ones.
        symmetric: write symmetric meshes, for templates with left and right pairs of vertices; see `symmetrise`.
        grooming: parts that are removed or filled in the meshes that are written, before all other changes.
        say: called with each message on skipped files.

    Raises:
        InputError: `unit`, `mirror`, `symmetric` or `grooming` without `output`, or `output` contains the files.
        FileError: `output` cannot be written.
    """
    if output is None and (unit is not None or mirror or symmetric or grooming != NO_GROOMING):
        raise InputError(
            "--unit, --mirror, --symmetric, --crop, --outer, --largest and --fill-holes apply to the meshes that are "
            "written; give their folder with -o."
        )
    reports: list[dict[str, Any]] = []
    listed = mesh_files(files, recursive=recursive, apart_from=output)
    for sentence in listed.left_out:
        say(sentence)
    targets: dict[Path, Path] = {}
    if output is not None:
        targets = {
            path: output / f"{name}.ply" for path, name in zip(listed.files, names_for(listed.files), strict=True)
        }
        if {path.resolve() for path in targets.values()} & {path.resolve() for path in listed.files}:
            raise InputError(f"The meshes in {output} would be overwritten; give another folder with -o.")
        make_folder(output)
    for path in listed.files:
        if path in targets:
            remove_file(targets[path])  # one of an earlier run may contradict the report
        try:
            mesh = read_mesh(path)
            report, repaired = examine_and_repair(mesh, strict=strict)
            facts: dict[str, Any] = {}
            groomed: tuple[Finding, ...] = ()
            if repaired is not None and path in targets:
                if grooming != NO_GROOMING:
                    repaired, groomed = grooming.apply(repaired)
                    repaired, _ = repair(repaired)  # a part of a scan may be too small
                repaired = replace(repaired, vertices=MM_PER_UNIT[unit or "mm"] * repaired.vertices, landmarks={})
                if symmetric:
                    repaired, facts = _symmetrise(repaired)
        except (ShapespaceError, MemoryError) as error:
            no_memory = f"{path}: not enough memory to read it; thin the scan first, as by MeshLab."
            reason = no_memory if isinstance(error, MemoryError) else naming(path, str(error))
            reports.append({"file": str(path), "usable": False, "error": reason})
            continue
        findings = [
            {"level": finding.level, "what": finding.problem, "action": finding.action}
            for finding in (*report.findings, *groomed)
        ]
        findings += [{"level": "note", "what": note, "action": ""} for note in mesh.notes]
        usable = {"usable": repaired is not None}
        reports.append({"file": str(path), **usable, **asdict(report), **facts, "findings": findings})
        if repaired is not None and path in targets:
            write_mesh(targets[path], mirror_image(repaired) if mirror else repaired)
            reports[-1]["written"] = str(targets[path])
    lines = [line for report in reports for line in _check_lines(report)]
    errors = [f"shapespace: {report['error']}" for report in reports if "error" in report]
    bad = sum(not report["usable"] for report in reports)
    return Outcome(reports, lines, errors=errors, exit_code=exit_code_of(bad, len(reports)))


def _check_lines(report: Mapping[str, Any]) -> list[str]:
    if "error" in report:
        return [report["file"], f"  unusable: {report['error']}"]
    facts = {key: value for key, value in report.items() if key not in ("file", "usable", "findings", "name")}
    lines = [report["file"], *(f"  {key}: {short(value)}" for key, value in facts.items())]
    for finding in report["findings"]:
        problem, action = finding["what"], finding["action"]
        refused = finding["level"] == "refused"
        text = f"{problem[:-1]}; {action}" if refused else f"{problem} {action}".rstrip()
        lines.append(f"  {finding['level']}: {text}")
    return [*lines, "  usable" if report["usable"] else "  not usable for fitting"]


def _symmetrise(mesh: Mesh) -> tuple[Mesh, dict[str, Any]]:
    """Return the symmetric mesh, and its facts."""
    from shapespace.correspondence.symmetric_template import symmetrise  # compiled

    symmetric = symmetrise(mesh)
    return symmetric.mesh, {
        "asymmetry_mm": symmetric.asymmetry,
        "asymmetry_share": symmetric.asymmetry_share,
        "plane_point_mm": symmetric.point.tolist(),
        "plane_normal": symmetric.normal.tolist(),
        "midline_vertices": int(symmetric.midline.sum()),
        "vertex_pairs": int((~symmetric.midline).sum()) // 2,
    }


def info(file: Path) -> Outcome:
    """Return the facts of a model, a mesh, the record of a fit, a folder with a store, or a correspondence.

    Raises:
        FileError: it cannot be read, or is another file.
    """
    facts = _facts_of_path(file)
    lines: list[str] = []
    for key, value in facts.items():
        scans: Mapping[str, str] = value if key in _BY_SCAN else {}
        lines.append(f"{key}: {len(value) if key in _BY_SCAN else short(value)}")
        lines += [f"  {name}: {text}" for name, text in scans.items()]
    return Outcome(facts, lines)


def _facts_of_path(path: Path) -> dict[str, Any]:
    if path.is_dir() and (results := results_at(path)) is not None:
        return {"kind": "store", **store_facts(results)}
    if path.is_dir() and looks_like_model(path):
        return {"kind": "model", **model_facts(ShapeModel.load(path))}
    if path.is_dir() or path.name == CorrespondenceRecord.FILE:
        return {"kind": "correspondence", **correspondence_facts(path if path.is_dir() else path.parent)}
    if path.name.endswith(CorrespondRecord.ENDING):
        record = read(CorrespondRecord, json_of(path), path.name, CORRESPOND_AGAIN)
        return {"kind": "scan in correspondence", **to_json(record)}
    if looks_like_model(path):
        model = load_model(path)
        if isinstance(model, ShapeModel):
            return {"kind": "model", **model_facts(model)}
        parted = {"identity_modes": model.n_identity, "expression_modes": model.n_expression}
        return {"kind": "model", **model_facts(model.shape), "additive": parted}
    if path.name.endswith(".json"):
        record = read_record(path)
        return {"kind": "fit", **{key: value for key, value in record.to_json().items() if key != "history"}}
    mesh = mesh_at(path)
    return {"kind": "mesh", "file": str(path), **asdict(examine(mesh))}


def store_facts(results: Results) -> dict[str, Any]:
    """Return the facts of a folder with a store; every file of it is read and compared with its hash.

    Raises:
        FileError: the folder cannot be read.
    """
    store = results.store
    assert store is not None
    damaged: list[str] = []
    for file in (file for shard in store.manifest.shards for file in shard.files):
        try:
            file.verify(store.folder)
        except ShapespaceError as error:
            damaged.append(str(error))
    counts = results.counts()
    return {
        "folder": str(results.folder),
        "fits": sum(counts.values()),
        **dict(sorted(counts.items())),
        "modes": modes_of(results),
        "shards": len(store.shards),
        "single_files": len(results.singles),
        "bytes": sum(file.bytes for shard in store.manifest.shards for file in shard.files),
        "damaged": list(dict.fromkeys([*damaged, *results.problems])),
        "version": store.manifest.version,
    }


def correspondence_facts(folder: Path) -> dict[str, Any]:
    """Return the facts of a folder that `shapespace correspond` wrote; lengths are shares of the size of each object.

    Raises:
        FileError: the folder is no correspondence, or cannot be read.
    """
    from shapespace.report.blocks.wording import known, median
    from shapespace.report.inputs.correspondence_folder import Corresponded, concerns_of, distance_share

    if not (folder / CorrespondenceRecord.FILE).is_file():
        raise FileError(
            f"{folder} is a folder without {CorrespondenceRecord.FILE}; give a model, a mesh, a .fit.json, or a folder "
            "that shapespace correspond wrote."
        )
    result = Corresponded(folder)
    population = result.population()
    records = [result.records[name] for name in population.names]
    concerns = concerns_of(result)
    far = {
        which: median(
            [distance_share(record, which, size) for record, size in zip(records, population.sizes, strict=True)]
        )
        for which in ("mean", "p95", "p99", "max")
    }
    return {
        "folder": str(folder),
        "scans": len(result.records) + len(result.unread),
        "in_correspondence": len(records),
        "set_aside": {record.name: record.reason for record in result.set_aside},
        "unreadable": {**result.unread, **population.unread},
        "needs_review": {name: concern.text for name, concern in concerns.items() if concern.reasons},
        "vertices": len(result.mean.vertices),
        "triangles": len(faces_of(result.mean)),
        **({"parts": result.run.parts} if result.run.parts else {}),
        "template": result.run.template,
        "units_mixed": result.units_mixed,
        "distance_share_median": far,
        "seen_share_median": median([known(record.seen_share) for record in records]),
        "vertices_missing_somewhere": int((population.seen_count < len(records)).sum()),
        "scans_with_folds": sum(bool(record.folded_share) for record in records),
        "moved_share_by_round": list(result.run.rounds),
        "settled": bool(result.run.rounds) and result.run.rounds[-1] < result.settled,
        "cpu_s": sum(sum(record.cpu_s) for record in records),
        "version": result.run.version,
    }


def model_facts(model: ShapeModel) -> dict[str, Any]:
    """Return the facts of a model as plain values."""
    counts, residuals = model.coding.get("control_counts"), model.residuals
    off = model.landmarks.distance_mm.tolist()  # zero for landmarks that were given on the surface
    needed = {f"{share:g}": model.modes_for_variance(share) for share in (0.9, 0.95, 0.98, 0.985, 0.99)}
    return {
        "vertices": model.n_vertices,
        "triangles": 0 if model.faces is None else len(model.faces),
        "modes": model.n_modes,
        "training_shapes": model.n_training,
        "training_shapes_in_file": 0 if model.training is None else len(model.training),
        "training_shapes_note": training_shapes_note(model),
        "gauge": model.gauge,
        "units": "mm",
        "extent_mm": np.ptp(model.mean_vertices, axis=0).tolist(),
        "variance_held": float(model.cumulative_variance[-1]),
        "variance_of": "held-out people" if model.held_out else "training shapes",
        "modes_for_variance": {share: modes for share, modes in needed.items() if modes is not None},
        "stddev_mm": model.stddev.tolist(),
        **(
            {}
            if residuals is None
            else {
                "residuals_mm2": residuals.tolist(),
                "largest_residual_share": float(residuals.max() / model.stddev[0] ** 2),
            }
        ),
        "noise_variance_mm2": model.noise_variance,
        "landmarks": list(model.landmarks),
        **({"landmark_distances_mm": dict(zip(model.landmarks, off, strict=True))} if any(off) else {}),
        **({"regions": {name: len(vertices) for name, vertices in model.regions.items()}} if model.regions else {}),
        **_facts_of_parts(model),
        "representation": model.representation,
        **({} if counts is None else {"control_points": counts.tolist()}),
        "provenance": model.provenance,
        "licence": model.licence,
        **({"notes": list(model.notes)} if model.notes else {}),
        "hash": model.content_hash,
    }


def _facts_of_parts(model: ShapeModel) -> dict[str, Any]:
    """Return the facts of the parts of a model; standard deviations of relative poses are those of its modes."""
    if (pose := relative_pose(model)) is None:
        return {}
    joints = {
        f"{joint.part} to {joint.parent}": {
            "rotation_stddev_deg": joint.rotation_deg, "translation_stddev_mm": joint.translation_mm
        }
        for joint in pose.joints
    }  # fmt: skip
    return {"parts": model.part_counts, "relative_pose": pose.choice, **({"joints": joints} if joints else {})}


def training_shapes_note(model: ShapeModel) -> str:
    """Return a sentence on the privacy of the training shapes in a model, or on the effect of their absence."""
    if (training := model.training) is None:
        return f"The model contains no training shapes, so {NOT_CALIBRATED}."
    count = f"{len(training)} of its {model.n_training}" if len(training) < model.n_training else str(len(training))
    return (
        f"The model contains {count} training shapes, from which their surfaces can be reconstructed; if they show "
        "people, share it without them (build --without-training-shapes, or convert)."
    )
