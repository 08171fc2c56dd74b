"""Each command: its arguments to what does it, and what came of it to the terminal; the exit code is returned."""

from __future__ import annotations

import argparse
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shapespace.cli.options import given
from shapespace.cli.printing import arrow, now, say, short, show, show_json, warn
from shapespace.errors import InputError

if TYPE_CHECKING:
    from shapespace.batch.execution import ExecutionConfig
    from shapespace.schemas import CorrespondenceRecord, CorrespondRecord, FitRecord, OverlapDistances, Quality

_BY_SCAN = ("set_aside", "unreadable", "needs_review")
_LISTED = 10
"""Scans that the terminal lists."""
_LONGEST = 400
"""Characters of a line on landmark data."""


def demo(arguments: argparse.Namespace) -> int:
    """Both experiments of the paper, ending in a report."""
    from shapespace.demo import run_demo

    report = run_demo(arguments.out, quick=arguments.quick, quiet=arguments.quiet)
    if arguments.json:
        show_json({"report": str(report)})
    else:
        show(f"The report is {report}")
    _open(report, arguments)
    return 0


def _open(report: Path, arguments: argparse.Namespace) -> None:
    if not arguments.no_open:
        import webbrowser

        webbrowser.open(report.absolute().as_uri())


def report(arguments: argparse.Namespace) -> int:
    """One HTML file on the results in a folder."""
    from shapespace.commands.answers import write_report

    report = write_report(
        arguments.folder, arguments.output, model=arguments.model, labels=arguments.labels, quiet=arguments.quiet
    )
    if arguments.json:
        show_json({"report": str(report), "bytes": report.stat().st_size})
    else:
        show(f"The report is {report}")
    _open(report, arguments)
    return 0


def data_list(arguments: argparse.Namespace) -> int:
    """Open data sets."""
    from shapespace.commands.data import data_list

    rows = data_list()
    if arguments.json:
        show_json(rows)
    else:
        for row in rows:
            for number, (key, value) in enumerate(row.items()):
                show(f"{'  ' if number else ''}{key}: {value}")
    return 0


def data_get(arguments: argparse.Namespace) -> int:
    """Download and verify an open data set."""
    from shapespace.commands.data import data_get

    folder = data_get(arguments.name, arguments.to, quiet=arguments.quiet)
    if arguments.json:
        show_json({"folder": str(folder)})
    else:
        show(str(folder))
    return 0


def data_faces(arguments: argparse.Namespace) -> int:
    """Write simulated faces."""
    from shapespace.commands.data import write_simulated_faces

    options = given(arguments, write_simulated_faces)
    count = write_simulated_faces(arguments.output, **options, quiet=arguments.quiet)
    return _show_written(arguments, "face", count)


def data_organs(arguments: argparse.Namespace) -> int:
    """Write simulated organs."""
    from shapespace.commands.data import write_simulated_organs

    write_simulated_organs(arguments.output, **given(arguments, write_simulated_organs), quiet=arguments.quiet)
    return _show_written(arguments, "organ", arguments.count)


def data_bones(arguments: argparse.Namespace) -> int:
    """Write simulated bones of two groups."""
    from shapespace.commands.data import write_simulated_bones

    write_simulated_bones(arguments.output, **given(arguments, write_simulated_bones), quiet=arguments.quiet)
    return _show_written(arguments, "bone", arguments.count)


def data_landmarks(arguments: argparse.Namespace) -> int:
    """Write simulated landmarks of skulls."""
    from shapespace.commands.data import write_simulated_landmarks

    write_simulated_landmarks(arguments.output, **given(arguments, write_simulated_landmarks))
    return _show_written(arguments, "skull", arguments.count)


def _show_written(arguments: argparse.Namespace, noun: str, count: int) -> int:
    """Print how many simulated shapes were written, and where."""
    if arguments.json:
        show_json({"folder": str(arguments.output), f"{noun}s": count})
    else:
        show(f"{count} {noun}{'' if count == 1 else 's'} in {arguments.output}")
    return 0


def surface(arguments: argparse.Namespace) -> int:
    """Surfaces of labels in volumes."""
    from shapespace.commands.surface import write_surfaces

    options = given(arguments, write_surfaces)
    records = write_surfaces(arguments.volumes, arguments.output, **options, quiet=arguments.quiet, say=warn)
    made = [record for record in records if "error" not in record]
    if arguments.json:
        show_json({"folder": str(arguments.output), "volumes": len(records), "surfaces": len(made), "records": records})
    elif made:
        _print_surfaces(made, len(records), arguments.output)
    if not made:
        return 2
    return 1 if len(made) < len(records) else 0


def _print_surfaces(made: Sequence[Mapping[str, Any]], volumes: int, folder: Path) -> None:
    for record in made[:_LISTED]:
        size = " x ".join(f"{mm:.3g}" for mm in record["voxel_mm"])
        labels = f"label{'s' if len(record['labels']) > 1 else ''} {', '.join(map(str, record['labels']))}"
        show(
            f"{record['name']}.ply: {record['triangles']:,} triangles around {record['volume_mm3']:.4g} mm3 of "
            f"{labels}, voxels of {size} mm"
        )
        for note in record["notes"]:
            show(f"  {note}")
    if len(made) > _LISTED:
        show(f"and {len(made) - _LISTED} more")
    for record in made[_LISTED:]:
        for note in record["odd"]:
            show(f"{record['name']}.ply: {note}")
    show(f"{len(made)} of {volumes} {'volume' if volumes == 1 else 'volumes'} to surfaces in {folder}: LPS, mm")


def check(arguments: argparse.Namespace) -> int:
    """What is in each mesh, and what fitting will do about it."""
    from shapespace.commands.look import check

    reports = check(
        arguments.files, recursive=arguments.recursive, strict=arguments.strict, output=arguments.output,
        unit=arguments.unit, mirror=arguments.mirror, symmetric=arguments.symmetric, say=warn,
    )  # fmt: skip
    if arguments.json:
        show_json(reports)
    else:
        for report in reports:
            _print_check(report)
    bad = sum(not report["usable"] for report in reports)
    for report in reports:
        if "error" in report:
            say(f"shapespace: {report['error']}")
    if not bad:
        return 0
    return 2 if bad == len(reports) else 1


def _print_check(report: Mapping[str, Any]) -> None:
    show(report["file"])
    if "error" in report:
        show(f"  unusable: {report['error']}")
        return
    for key, value in report.items():
        if key not in ("file", "usable", "findings", "name"):
            show(f"  {key}: {short(value)}")
    for finding in report["findings"]:
        problem, action = finding["what"], finding["action"]
        show(
            f"  {finding['level']}: "
            + (f"{problem[:-1]}; {action}" if finding["level"] == "refused" else f"{problem} {action}".rstrip())
        )
    print("  usable" if report["usable"] else "  not usable for fitting")


def correspond(arguments: argparse.Namespace) -> int:
    """Bring scans into correspondence."""
    if arguments.jobs != 1 and arguments.executor == "local":
        from shapespace.batch.workers import start_loading

        start_loading(notify=not arguments.quiet)
    from shapespace.commands.correspond import CorrespondFiles, correspond_files, correspond_groups
    from shapespace.commands.correspond_changes import Change, change_correspondence
    from shapespace.correspondence.settings import CorrespondConfig
    from shapespace.schemas import to_json

    config = CorrespondConfig(**given(arguments, CorrespondConfig))
    files = CorrespondFiles(
        scans=arguments.scans,
        template=arguments.template,
        model=arguments.model,
        landmarks=arguments.landmarks,
        execution=_execution_config(arguments),
        recursive=arguments.recursive,
        strict=arguments.strict,
        subjects=arguments.subjects,
    )
    change = Change(**given(arguments, Change))
    folder, quiet = arguments.output, arguments.quiet
    if change and arguments.groups:
        raise InputError(f"--groups cannot be combined with {change.option}; leave one of them out.")
    if files.subjects and (change or arguments.groups):
        other = change.option if change else "--groups"
        raise InputError(f"--subjects cannot be combined with {other}; leave one of them out.")
    if not (change or files.scans):
        raise InputError("Give scans, or a change of a finished correspondence by --redo, --remove or --update.")
    if change:
        summary, records = change_correspondence(change, files, folder, config, quiet=quiet, say=warn)
    else:
        bring = correspond_groups if arguments.groups else correspond_files
        summary, records = bring(files, folder, config, quiet=quiet, say=warn)
    if arguments.json:
        show_json({"folder": str(arguments.output), **to_json(summary), "records": to_json(records)})
    else:
        _print_correspondence(summary, records, arguments.output)
    return 1 if summary.set_aside else 0


def build(arguments: argparse.Namespace) -> int:
    """Build a shape model."""
    from shapespace.commands.build import BuildFilesConfig, build
    from shapespace.commands.look import model_facts
    from shapespace.model.build_config import BuildConfig

    modes = arguments.modes if arguments.variance is None else arguments.variance
    model_options = given(arguments, BuildConfig, modes=modes)
    file_options = given(arguments, BuildFilesConfig, regions=dict(arguments.region))
    config = BuildFilesConfig(model=BuildConfig(**model_options), **file_options)
    if config.streams:
        arguments.goes_on = "; the same command goes on from there"
    model, notes = build(arguments.meshes, arguments.output, config, quiet=arguments.quiet)
    for note in notes:
        say(note)
    facts = model_facts(model)
    if arguments.json:
        show_json({"model": str(arguments.output), **facts})
    else:
        show(
            f"{arguments.output}: {facts['modes']} modes of {facts['vertices']} vertices from "
            f"{facts['training_shapes']} meshes, {100 * facts['variance_held']:.2f} % of "
            f"{'the variance of subjects left out' if model.held_out else 'their variance'}, "
            f"gauge {facts['gauge']}"
        )
    return 0


def quality(arguments: argparse.Namespace) -> int:
    """How good a shape space is."""
    from shapespace.commands.quality import QualityOptions, quality
    from shapespace.model.model_quality import QualityConfig
    from shapespace.schemas import to_json

    config = QualityConfig(**given(arguments, QualityConfig))
    options = QualityOptions(config, **given(arguments, QualityOptions))
    result, notes = quality(
        arguments.targets, arguments.output, options, _execution_config(arguments), quiet=arguments.quiet
    )
    for note in notes:
        say(note)
    if arguments.json:
        show_json({"folder": str(arguments.output), **to_json(result)})
        return 0
    for one in (result, *result.others):
        for line in quality_lines(one):
            show(line)
    for sentence in result.sentences:
        show(sentence)
    show(f"All numbers are in {arguments.output / 'quality.json'}")
    return 0


def quality_lines(quality: Quality) -> list[str]:
    """Return the measures with most modes, in words."""
    out: list[str] = [quality.name]
    for key, unit in (
        ("compactness", "of the variance"),
        ("generalisation", "mm, surface to surface, on shapes left out"),
        ("generalisation_vertices", "mm, vertex to vertex, on shapes left out"),
        ("specificity", "mm, surface to surface, from random shapes to the nearest one"),
        ("specificity_vertices", "mm, vertex to vertex, from random shapes to the nearest one"),
        ("reconstruction", "mm, surface to surface, on unseen shapes"),
        ("reconstruction_vertices", "mm, vertex to vertex, on unseen shapes"),
    ):
        measure = getattr(quality, key)
        if measure is not None:
            band = f" (95 %: {measure.low[-1]:.3f} to {measure.high[-1]:.3f})" if measure.low != measure.mean else ""
            out.append(f"  {key.split('_')[0]}, {measure.modes[-1]:g} modes: {measure.mean[-1]:.3f}{band} {unit}")
    return out


def info(arguments: argparse.Namespace) -> int:
    """Facts of a model, a mesh, a fit or a folder in correspondence."""
    from shapespace.commands.look import info

    facts = info(arguments.file)
    if arguments.json:
        show_json(facts)
    else:
        for key, value in facts.items():
            if key in _BY_SCAN:
                show(f"{key}: {len(value)}")
                for name, text in value.items():
                    show(f"  {name}: {text}")
            else:
                show(f"{key}: {short(value)}")
    return 0


def fit(arguments: argparse.Namespace) -> int:
    """Fit a model to scans."""
    several = len(arguments.scans) > 1 or not Path(arguments.scans[0]).is_file()
    if several and arguments.jobs != 1 and arguments.executor == "local":
        from shapespace.batch.workers import start_loading

        # While this process loads its own code; half of the time that many scans take to start.
        start_loading(notify=not arguments.quiet)
    from shapespace.commands.fit import BatchSettings, fit_scans
    from shapespace.fit.fit_scan import FitConfig
    from shapespace.fit.method_choices import method_named

    search = {} if arguments.search == "auto" else {"search": arguments.search}
    method = method_named(arguments.method, **search)
    config = FitConfig(**given(arguments, FitConfig, method=method, region=_region(arguments.region)))
    settings = BatchSettings(
        config=config,
        landmarks=arguments.landmarks,
        execution=_execution_config(arguments),
        again=arguments.again,
        stages=arguments.stages,
        recursive=arguments.recursive,
        store=arguments.store,
    )
    counts, records = fit_scans(
        arguments.model, arguments.scans, arguments.output, settings, quiet=arguments.quiet, say=warn
    )
    every = sum(counts.values())
    if arguments.json:
        contents = [{"name": name, **_without_history(record)} for name, record in records.items()]
        show_json({"folder": str(arguments.output), "scans": every, **counts, "records": contents})
    elif counts["failed"] < every:
        _print_fits(records, counts, arguments.output)
    if counts["failed"] == every:
        return 2
    return 1 if counts["failed"] or (arguments.strict and counts["doubtful"]) else 0


def _region(region: str | None) -> str | tuple[int, ...] | None:
    if region is None or not Path(region).is_file():
        return region
    from shapespace.io.meshes.region_files import read_region

    return read_region(region)


def _execution_config(arguments: argparse.Namespace) -> ExecutionConfig:
    from shapespace.batch.execution import ExecutionConfig

    return ExecutionConfig(**given(arguments, ExecutionConfig))


def landmarks_transfer(arguments: argparse.Namespace) -> int:
    """Transfer landmarks."""
    from shapespace.commands.landmarks import TPS, transfer_landmarks

    folder = arguments.output
    options = given(arguments, transfer_landmarks)
    records = transfer_landmarks(arguments.marked, arguments.scans, folder, **options, quiet=arguments.quiet, say=warn)
    if arguments.json:
        show_json({"folder": str(folder), "records": records})
        return 0
    doubtful = [record for record in records if record["status"] == "doubtful"]
    for record in doubtful[:_LISTED]:
        reasons = ", ".join(f"{one['name']} ({one['reason']})" for one in record["landmarks"] if one["reason"])
        show(f"{record['name']}: doubtful landmarks: {reasons}")
    if len(doubtful) > _LISTED:
        show(f"and {len(doubtful) - _LISTED} more scans with doubtful landmarks")
    show(f"landmarks of {len(records)} scans in {folder} and in {folder / TPS}")
    return 0


def landmarks_check(arguments: argparse.Namespace) -> int:
    """Check given landmarks."""
    from dataclasses import asdict
    from statistics import fmean

    if arguments.scans is None:
        return _check_landmark_data(arguments)
    from shapespace.commands.landmarks import check_landmarks

    checks = check_landmarks(arguments.marked, arguments.scans, arguments.output, say=warn)
    findings = sum(bool(one.finding) for one in checks)
    if arguments.json:
        show_json([asdict(one) for one in checks])
        return 1 if findings else 0
    for kind in ("landmark", "specimen"):
        errors: dict[str, list[float]] = {}
        for one in checks:
            errors.setdefault(getattr(one, kind), []).append(100 * one.error_share)
        means = sorted(((fmean(shares), name) for name, shares in errors.items()), reverse=True)
        listed = ", ".join(f"{name} {share:.1f} %" for share, name in means[:_LISTED])
        show(f"mean leave-one-out error by {kind}, largest first, of the size: {listed}")
    show(f"{len(checks)} landmarks compared, {findings} with a finding")
    return 1 if findings else 0


def _check_landmark_data(arguments: argparse.Namespace) -> int:
    from shapespace.commands.landmark_data import check_configurations
    from shapespace.report.blocks.wording import counted

    if arguments.output is not None:
        raise InputError("-o goes with SAME, the folder that correspond wrote; leave it out.")
    facts = check_configurations(arguments.marked, arguments.sliders)
    if arguments.json:
        show_json(facts)
    else:
        for sentence in (*facts["notes"], *facts["findings"]):
            say(sentence)
        for key, value in facts.items():
            if key not in ("notes", "findings") and value not in ([], {}):
                text = short(value)
                show(f"{key.replace('_', ' ')}: {text if len(text) < _LONGEST else f'{text[:_LONGEST]}, ...'}")
        found = len(facts["findings"])
        show(counted(found, "finding") if found else "no problems found")
    return 1 if facts["findings"] else 0


def landmarks_convert(arguments: argparse.Namespace) -> int:
    """Convert landmarks of many specimens."""
    from shapespace.commands.landmark_data import convert_landmarks
    from shapespace.report.blocks.wording import counted

    output = arguments.output
    found, notes = convert_landmarks(arguments.data, output, **given(arguments, convert_landmarks))
    for note in notes:
        say(note)
    if arguments.json:
        show_json({"output": str(output), "specimens": len(found), "landmarks": len(found.landmarks),
                   "dimensions": found.dimensions, "notes": notes})  # fmt: skip
    else:
        specimens, landmarks = counted(len(found), "specimen"), counted(len(found.landmarks), "landmark")
        show(f"{specimens} with {landmarks} in {output}")
    return 0


def landmarks_plot(arguments: argparse.Namespace) -> int:
    """Draw superimposed landmarks."""
    from shapespace.commands.landmark_data import plot_configurations

    notes = plot_configurations(arguments.data, arguments.output, arguments.links, arguments.sliders)
    for note in notes:
        say(note)
    if arguments.json:
        show_json({"figure": str(arguments.output), "notes": notes})
    else:
        show(f"The figure is {arguments.output}")
    return 0


def landmarks_suggest(arguments: argparse.Namespace) -> int:
    """Suggest specimens to mark."""
    from shapespace.commands.landmarks import suggest_specimens

    options = given(arguments, suggest_specimens)
    found = suggest_specimens(arguments.scans, **options, say=warn)
    if arguments.json:
        show_json([{"name": name, "mean_distance_share": share} for name, share in found])
        return 0
    for rank, (name, share) in enumerate(found, start=1):
        show(f"{rank}. {name}: mean shape distance to the nearest marked specimen {100 * share:.1f} % of the size")
    return 0


def recognise_train(arguments: argparse.Namespace) -> int:
    """Train a classifier."""
    from shapespace.commands.recognise import recognise_train

    options = given(arguments, recognise_train)
    facts, notes = recognise_train(arguments.results, arguments.labels, arguments.output, **options)
    for note in notes:
        say(note)
    if arguments.json:
        show_json({"file": str(arguments.output), **facts})
        return 0
    training, checked = facts["training"], facts["cross_validation"]
    show(
        f"{arguments.output}: {facts['classifier']} of {len(facts['classes'])} classes from {training['scans']} scans"
        + (f" of {training['subjects']} subjects" if training["subjects"] else "")
        + f", {facts['modes']} modes"
        + (", relative to neutral" if facts["relative_to_neutral"] else "")
    )
    for note in facts["notes_on_classes"]:
        show(note)
    if checked["macro_accuracy"] is not None:
        left_out = "subjects" if checked["by"] == "subject" else "scans"
        show(f"macro accuracy on {left_out} left out: {100 * checked['macro_accuracy']:.1f} %")
    return 0


def recognise_predict(arguments: argparse.Namespace) -> int:
    """Answer for fitted scans."""
    from shapespace.commands.recognise import recognise_predict

    rows, counts = recognise_predict(
        arguments.classifier, arguments.results, arguments.output, labels=arguments.labels, say=warn
    )
    if arguments.json:
        show_json({"file": str(arguments.output), **counts, "answers": rows})
    else:
        for row in rows[:_LISTED]:
            p = max(row["probabilities"].values(), default=None)
            show(
                f"{row['scan']}: {row['prediction'] or 'no answer'}"
                + (f" ({p:.2f})" if p is not None and not row["reason"] else "")
                + (f"; {row['reason']}" if row["reason"] else "")
            )
        if len(rows) > _LISTED:
            show(f"and {len(rows) - _LISTED} more; all are in {arguments.output}")
        counts_text = ", ".join(f"{count} {outcome}" for outcome, count in counts.items() if count)
        show(f"{len(rows)} {'scan' if len(rows) == 1 else 'scans'}: {counts_text}; answers in {arguments.output}")
    asked = len(rows) - counts["neutral"]
    if counts["failed"] == asked:
        say("shapespace: no scan could be answered for; the reasons stand in the table.")
        return 2
    return 1 if counts["failed"] or (arguments.strict and counts["doubtful"] + counts["unsure"]) else 0


def recognise_transfer(arguments: argparse.Namespace) -> int:
    """Put one person's expression on another."""
    from shapespace.commands.recognise import recognise_transfer

    recognise_transfer(arguments.model, arguments.person, arguments.expression, arguments.output)
    if arguments.json:
        show_json({"file": str(arguments.output)})
    else:
        show(f"{arguments.output}: {arguments.person.name} with the expression of {arguments.expression.name}")
    return 0


def recognise_study(arguments: argparse.Namespace) -> int:
    """Measure recognition on unseen people."""
    from shapespace.commands.recognise import recognise_study

    report, targets, holds = recognise_study(
        arguments.output,
        arguments.data,
        arguments.model,
        folds=arguments.folds,
        seed=arguments.seed,
        execution=_execution_config(arguments),
        quiet=arguments.quiet,
    )
    if arguments.json:
        show_json({"report": str(report), "targets": targets})
    else:
        for line in holds.splitlines():
            show(line)
        for one in targets:
            show(f"{one['what']}: {one['reached']} ({one['target']}{'' if one['met'] else '; missed'})")
        show(f"The report is {report}")
    _open(report, arguments)
    return 0


def view(arguments: argparse.Namespace) -> int:
    """Show a model, fits, or surfaces in correspondence in the browser."""
    from shapespace.viewer.serve import serve

    options = given(arguments, serve)
    serve(arguments.path, **options, open_browser=not arguments.no_open, quiet=arguments.quiet, say=now)
    return 0


def studio(arguments: argparse.Namespace) -> int:
    """Do the whole work in the browser."""
    from shapespace.cli.forms import forms
    from shapespace.viewer.serve import serve_studio

    options = given(arguments, serve_studio)
    serve_studio(arguments.project, forms(arguments.commands()), **options, open_browser=not arguments.no_open, say=now)
    return 0


def export(arguments: argparse.Namespace) -> int:
    """Write fits of a store as single files, or all of them as a table."""
    from shapespace.commands.export import export

    if arguments.to is not None or arguments.formula is not None:
        return _export_cohort(arguments)
    written, failed = export(
        arguments.store,
        arguments.names,
        arguments.output,
        every=arguments.all,
        table=arguments.table,
        quiet=arguments.quiet,
        say=warn,
    )
    if arguments.json:
        table = None if arguments.table is None else str(arguments.table)
        show_json({"folder": str(arguments.output), "written": len(written), "failed": failed, "table": table})
    else:
        if written:
            show(f"{len(written)} {'fit' if len(written) == 1 else 'fits'} in {arguments.output}")
        if arguments.table is not None:
            show(f"The table is {arguments.table}")
    return 0 if not failed else 1 if written else 2


def _export_cohort(arguments: argparse.Namespace) -> int:
    from shapespace.cli.answers import cohort_of
    from shapespace.commands.export import export_cohort

    if arguments.names or arguments.all or arguments.table is not None:
        raise InputError("--to exports all shapes of DATA; leave out names, --all and --table.")
    if arguments.formula is not None and arguments.to != "geomorph":
        raise InputError("--formula is the model of the script for geomorph; give --to geomorph too.")
    arguments.data = arguments.store
    cohort = cohort_of(arguments)
    files, notes = export_cohort(cohort, arguments.output, **given(arguments, export_cohort))
    for note in (*cohort.notes, *notes):
        say(note)
    if arguments.json:
        show_json({"files": [str(file) for file in files], "shapes": len(cohort), "notes": notes})
    else:
        show(f"{len(cohort)} shapes in {', '.join(map(str, files))}")
    return 0


def cache(arguments: argparse.Namespace) -> int:
    """Folder and size of the cache on disk; empties it."""
    from shapespace.io import disk_cache

    if arguments.clear:
        disk_cache.clear()
    folder, entries = disk_cache.entries_folder(), disk_cache.entries()
    size = sum(file.stat().st_size for file in entries)
    if arguments.json:
        show_json({"folder": None if folder is None else str(folder), "entries": len(entries), "bytes": size})
    elif folder is None:
        show("The cache is off (SHAPESPACE_KEEP).")
    else:
        show(f"{folder}: {len(entries)} entries, {size / 1e6:.1f} MB")
    return 0


def convert(arguments: argparse.Namespace) -> int:
    """Write a model in another format."""
    from shapespace.commands.convert import convert
    from shapespace.types import MM_PER_UNIT

    mm = None if arguments.unit is None else MM_PER_UNIT[arguments.unit]
    source, target, notes = convert(
        arguments.source,
        arguments.output,
        to=arguments.to,
        mm=mm,
        expressions=arguments.expressions,
        quiet=arguments.quiet,
    )
    if arguments.json:
        show_json({"source": source, "target": target, "output": str(arguments.output), "notes": notes})
    else:
        show(f"{arguments.output} ({target}) holds the model of {arguments.source} ({source}).")
        for note in notes:
            show(f"  {note}")
    return 0


def _print_fits(records: Mapping[str, FitRecord], counts: Mapping[str, int], folder: Path) -> None:
    fitted = {name: record for name, record in records.items() if record.is_fitted}
    for name, record in list(fitted.items())[:_LISTED]:
        _print_fit(name, record)
    if len(fitted) > _LISTED:
        more = len(fitted) - _LISTED
        show(f"and {more} more {'scan' if more == 1 else 'scans'}; all are in {folder / 'coefficients.csv'}")
    every = sum(counts.values())
    show(
        f"{every} {'scan' if every == 1 else 'scans'}: "
        + ", ".join(f"{count} {status}" for status, count in counts.items() if count)
        + f"; results in {folder}"
    )


def _print_correspondence(summary: CorrespondenceRecord, records: Sequence[CorrespondRecord], folder: Path) -> None:
    from shapespace.schemas import SurfaceReview
    from shapespace.store.review_text import describe_review, review_summary

    show(summary.template)
    for number, moved in enumerate(summary.rounds, 1):
        show(f"round {number}: vertices moved by {100 * moved:.2f} % of the size (RMS)")
    for record in records:
        if record.reason:
            warn(f"{record.name} is excluded: {record.reason}")
        elif record.doubt:
            warn(f"{record.name} is doubtful: {record.doubt}")
    there = [record for record in records if not record.reason]
    seen = sum(record.seen_share or 0.0 for record in there) / len(there)
    unusual = [record for record in there if record.review and not record.doubt]
    for record in unusual[:_LISTED]:
        warn(f"{record.name} needs review: {'; '.join(describe_review(record))}")
    if len(unusual) > _LISTED:
        warn(f"and {len(unusual) - _LISTED} more surfaces need review")
    doubtful = sum(bool(record.doubt) for record in there)
    show(
        f"{len(there)} of {len(records)} scans in correspondence{f' ({doubtful} doubtful)' if doubtful else ''}, "
        f"{summary.vertices} vertices, of which a scan shows "
        f"{100 * seen:.1f} % on average; results in {folder}"
    )
    if review := review_summary(SurfaceReview.of(record.review_codes for record in there)):
        show(f"{review}; inspect them with shapespace report {folder}")
    show(f"next: shapespace build {folder} -o model.h5")


def _print_fit(name: str, record: FitRecord) -> None:
    from shapespace.io.meshes.mesh_io import stem_of

    file = record.scan.name
    # A scan that shares its file's name with others goes by the name of its results.
    called = file if stem_of(file) == name else f"{name} ({file})"
    distances = _distances(record.shown)
    show(f"{called}: {record.status}" + (f": {distances}" if distances else ""))
    if distances := _distances(record.shown_dense, measure="median"):
        show(f"  dense surface: {distances}")
    for note in record.notes:
        show(f"  {note}")


def _distances(overlap: OverlapDistances | None, measure: str = "mean") -> str:
    """Return the overlap distances as text; empty if the record has none."""
    if overlap is None:
        return ""
    distances = [getattr(way, measure) for way in (overlap.model_to_scan, overlap.scan_to_model)]
    if any(value is None or not math.isfinite(value) for value in distances):
        return "scan and model do not overlap"
    shares = [
        f"{100 * (share or 0.0):.0f} % overlap" for share in (overlap.model_seen_share, overlap.scan_covered_share)
    ]
    to = arrow()
    return (
        f"{measure} distance model{to}scan {distances[0]:.2f} mm ({shares[0]}), "
        f"scan{to}model {distances[1]:.2f} mm ({shares[1]})"
    )


def _without_history(record: FitRecord) -> dict[str, Any]:
    return {key: value for key, value in record.to_json().items() if key != "history"}
