"""The command line: parsing, printing and exit codes; what the commands do stands in `commands.py`.

Exit codes: 0 done; 1 some of several scans failed (or, under --strict, are doubtful); 2 wrong arguments or unusable
input; 130 stopped by Ctrl-C, files valid.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import math
import os
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from shapespace import __version__
from shapespace.errors import ShapespaceError

_UNITS = ("auto", "um", "mm", "cm", "inch", "m")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            # A file's name may hold what the terminal's encoding cannot show.
            stream.reconfigure(errors="backslashreplace")
    arguments = parser().parse_args(argv)
    try:
        code = int(arguments.run(arguments))
        sys.stdout.flush()
        return code
    except ShapespaceError as error:
        _say(f"shapespace: {error}")
        return 2
    except MemoryError:
        _say("shapespace: there is not enough memory for this; give fewer or smaller meshes, or fewer --jobs.")
        return 2
    except KeyboardInterrupt:
        _say("shapespace: stopped; the files written so far are whole.")
        return 130
    except BrokenPipeError:
        _drop_output()
        return 0
    except OSError as error:
        _drop_output()
        where = f" ({error.filename})" if error.filename else ""
        _say(f"shapespace: the system refused{where}: {error.strerror or error}; check the path and the free space.")
        return 2


def _drop_output() -> None:
    """Send what is left of the output nowhere, so that python does not complain when it flushes at exit."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def parser() -> argparse.ArgumentParser:
    """Return the parser of all commands."""
    top = argparse.ArgumentParser(
        prog="shapespace", description="Turn any raw 3-D surface into a short vector that means something."
    )
    top.add_argument("--version", action="version", version=f"shapespace {__version__}")
    commands = top.add_subparsers(required=True, metavar="COMMAND")
    _add_demo(commands)
    _add_data(commands)
    _add_check(commands)
    _add_build(commands)
    _add_info(commands)
    _add_fit(commands)
    _add_report(commands)
    _add_view(commands)
    _add_recognise(commands)
    return top


def _add(commands: Any, name: str, what: str, example: str, *, json_facts: bool = True) -> argparse.ArgumentParser:
    sub = cast(
        argparse.ArgumentParser,
        commands.add_parser(
            name,
            help=what,
            description=what[0].upper() + what[1:] + ".",
            epilog=f"example: {example}",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        ),
    )
    sub.add_argument("--quiet", action="store_true", help="no progress bar")
    if json_facts:
        sub.add_argument("--json", action="store_true", help="print facts as JSON")
    return sub


def _add_demo(commands: Any) -> None:
    sub = _add(commands, "demo", "both experiments of the paper, ending in a report", "shapespace demo --quick")
    sub.add_argument("--out", type=Path, default=Path("shapespace-demo"), metavar="DIR", help="where to write")
    sub.add_argument("--quick", action="store_true", help="coarser scans and an earlier stop, under a minute")
    sub.add_argument("--no-open", action="store_true", help="do not open the report in a browser")
    sub.set_defaults(run=_demo)


def _add_data(commands: Any) -> None:
    sub = commands.add_parser("data", help="open data sets and simulated faces").add_subparsers(
        required=True, metavar="list|get|faces"
    )
    listing = _add(sub, "list", "open data sets: licence, size, hash", "shapespace data list")
    listing.set_defaults(run=_data_list)
    get = _add(sub, "get", "download and verify an open data set", "shapespace data get ict-facekit")
    get.add_argument("name", metavar="NAME")
    get.add_argument("--to", type=Path, metavar="DIR", help="also copy it there")
    get.set_defaults(run=_data_get)
    faces = _add(
        sub, "faces", "write simulated corresponded faces (PLY) with labels.csv",
        "shapespace data faces -o faces --subjects 100 --expressions neutral",
    )  # fmt: skip
    faces.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    faces.add_argument("--subjects", type=_positive, default=100, metavar="N")
    faces.add_argument("--expressions", default="neutral", metavar="LIST", help="names with commas between them")
    faces.add_argument("--seed", type=_natural, default=0, metavar="S")
    faces.add_argument("--source", choices=("bundled", "ict-facekit"), default="bundled")
    faces.add_argument("--area", choices=("face", "face_and_head"), default="face", help="of ict-facekit")
    faces.add_argument("--raw", action="store_true",
                       help="raw scans: other triangles, any pose, noise, holes; not in correspondence")  # fmt: skip
    faces.set_defaults(run=_data_faces)


def _add_check(commands: Any) -> None:
    sub = _add(commands, "check", "mesh doctor: what is in it, what is wrong, what fitting will do about it",
               "shapespace check scan.obj")  # fmt: skip
    sub.add_argument("files", nargs="+", type=Path, metavar="FILE")
    sub.set_defaults(run=_check)


def _add_build(commands: Any) -> None:
    sub = _add(commands, "build", "build a shape model from corresponding meshes: Procrustes and PCA",
               "shapespace build faces/*.ply -o model.h5 --modes auto")  # fmt: skip
    sub.add_argument("meshes", nargs="+", type=Path, metavar="MESH", help="mesh files or folders of them")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="MODEL.h5")
    how_many = sub.add_mutually_exclusive_group()
    how_many.add_argument("--variance", type=_share, metavar="SHARE", help="modes that hold this share, such as 0.98")
    how_many.add_argument("--modes", type=_modes, default="auto", metavar="K|auto|all",
                          help="a number; auto for cross-validation on held-out vertices (default); all")  # fmt: skip
    sub.add_argument("--gauge", choices=("form", "shape"), default="shape",
                     help="form: size lives in the modes; shape: size is divided out (default)")  # fmt: skip
    sub.add_argument("--representation", choices=("vertices", "bspline", "bspline-detail"), default="vertices",
                     help="what the modes move: vertices (default), or control points of a B-spline surface, without "
                          "or with the detail of the mean that it cannot hold")  # fmt: skip
    sub.add_argument("--control-points", type=_control_points, metavar="MxN", help="of a B-spline (default 24x24)")
    sub.add_argument("--additive", type=Path, metavar="LABELS.csv",
                     help="part identity and expression: CSV of file, subject and label (one is neutral); --modes or "
                          "--variance then count modes of identity (default 0.995 of the variance)")  # fmt: skip
    sub.add_argument("--expression-variance", type=_share, metavar="SHARE",
                     help="with --additive: modes of expression that hold this share (default 0.99)")  # fmt: skip
    sub.add_argument("--no-align", action="store_true", help="take the meshes as they stand")
    sub.add_argument("--unit", choices=_UNITS[1:], default="mm", help="of the meshes (default mm)")
    sub.add_argument("--landmarks", type=Path, metavar="FILE",
                     help="CSV of name,vertex, or points on the first mesh")  # fmt: skip
    sub.add_argument("--provenance", default="", metavar="TEXT", help="what the meshes are")
    sub.add_argument("--licence", default="", metavar="TEXT", help="of the meshes")
    sub.add_argument("--seed", type=_natural, default=0, metavar="S")
    sub.set_defaults(run=_build)


def _add_info(commands: Any) -> None:
    sub = _add(commands, "info", "facts of a model, a mesh or a fit", "shapespace info model.h5")
    sub.add_argument("file", type=Path, metavar="FILE")
    sub.set_defaults(run=_info)


def _add_fit(commands: Any) -> None:
    sub = _add(commands, "fit", "fit a model to raw scans: coefficients, pose and fitted surfaces",
               "shapespace fit model.h5 scan.obj -o out\n"
               "         shapespace fit model.h5 scans -o out --dense\n"
               "         shapespace build out/*.dense.ply -o new.h5")  # fmt: skip
    sub.add_argument("model", type=Path, metavar="MODEL.h5")
    sub.add_argument("scans", nargs="+", type=Path, metavar="SCAN", help="scans, or folders of them")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    sub.add_argument(
        "--method",
        default="robust",
        metavar="NAME",
        help="robust (default): pose and shape together, from both directions; paper: the paper's modified ICP",
    )
    sub.add_argument("--unit", choices=_UNITS, default="auto", help="of the scans (default: found)")
    sub.add_argument("--search", choices=("auto", "vertices", "surface"), default="auto",
                     help="for --method paper: among the scan's vertices (auto) or on its triangles")  # fmt: skip
    sub.add_argument("--scale", choices=("auto", "free", "fixed"), default="auto",
                     help="fit the scale or hold it; auto goes by the model's gauge")  # fmt: skip
    sub.add_argument("--max-iterations", type=_positive, default=500, metavar="N", help="cap of each phase")
    sub.add_argument("--landmarks", type=Path, metavar="FILE", help="to start from, named as in the model")
    sub.add_argument("--jobs", type=_natural, default=0, metavar="N", help="scans at a time (default: one a core)")
    sub.add_argument("--resume", action="store_true", help="keep results of an earlier run that still hold")
    sub.add_argument("--dense", action="store_true",
                     help="also write NAME.dense.ply: the surface taken the rest of the way to the scan")  # fmt: skip
    sub.add_argument("--stages", action="store_true", help="also write NAME.stages.npz, for figures")
    sub.add_argument("--strict", action="store_true", help="exit with 1 when a fit is doubtful")
    sub.add_argument("--seed", type=_natural, default=0, metavar="S")
    sub.set_defaults(run=_fit)


def _add_view(commands: Any) -> None:
    sub = _add(commands, "view", "shape model and fits in the browser, and scans dropped there fitted",
               "shapespace view model.h5", json_facts=False)  # fmt: skip
    sub.add_argument("path", type=Path, metavar="MODEL.h5|DIR", help="a model, or a folder that fit wrote")
    sub.add_argument("--model", type=Path, metavar="MODEL.h5", help="of the fits in DIR (default: named in them)")
    sub.add_argument("--host", default="127.0.0.1", metavar="H", help="address to listen at (default 127.0.0.1)")
    sub.add_argument("--port", type=_natural, metavar="N", help="default: the first free one from 7860")
    sub.add_argument("--no-open", action="store_true", help="do not open a browser")
    sub.add_argument("--max-upload-mb", type=_positive, default=200, metavar="N", help="largest scan (default 200)")
    sub.set_defaults(run=_view)


def _add_report(commands: Any) -> None:
    sub = _add(commands, "report", "one HTML file on the results in a folder: summary, model, fits, settings",
               "shapespace fit model.h5 scans -o out --stages\n         shapespace report out")  # fmt: skip
    sub.add_argument("folder", type=Path, metavar="DIR", help="written by shapespace fit or shapespace demo")
    sub.add_argument("-o", "--output", type=Path, metavar="FILE.html", help="the report (default DIR/report.html)")
    sub.add_argument("--model", type=Path, metavar="MODEL.h5", help="where the model is now, if it was moved")
    sub.add_argument("--labels", type=Path, metavar="FILE",
                     help="CSV of file and label (default: labels.csv in DIR or beside the scans)")  # fmt: skip
    sub.add_argument("--no-open", action="store_true", help="do not open the report in a browser")
    sub.set_defaults(run=_report)


def _add_recognise(commands: Any) -> None:
    sub = commands.add_parser("recognise", help="tell expressions or other classes apart by fitted coefficients")
    sub = sub.add_subparsers(required=True, metavar="train|predict|transfer|study")
    _add_recognise_train(sub)
    _add_recognise_predict(sub)
    _add_recognise_transfer(sub)
    _add_recognise_study(sub)


def _add_recognise_train(commands: Any) -> None:
    sub = _add(commands, "train", "train a classifier on fitted scans with labels",
               "shapespace recognise train out --labels labels.csv -o expressions.skops\n"
               "         shapespace recognise train out --labels labels.csv -o expressions.skops --relative "
               "--classifier mean-direction")  # fmt: skip
    sub.add_argument("results", type=Path, metavar="RESULTS", help="a folder that fit wrote, or its coefficients.csv")
    sub.add_argument("--labels", type=Path, required=True, metavar="FILE",
                     help="CSV of file and label, and of subject if known")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.skops")
    sub.add_argument("--classifier", default="lda", metavar="NAME",
                     help="mean-direction, knn, lda (default), qda, logistic or svm")  # fmt: skip
    sub.add_argument("--relative", action="store_true", help="compare each scan with its subject's neutral face")
    sub.add_argument("--neutral", default="neutral", metavar="LABEL", help="label of neutral faces (default neutral)")
    sub.add_argument("--confidence", type=_probability, default=0.5, metavar="P",
                     help="answer unsure below this probability (default 0.5)")  # fmt: skip
    sub.add_argument("--modes", type=_positive, metavar="K", help="leading coefficients to see (default: all)")
    sub.add_argument("--expression-of", type=Path, metavar="MODEL.h5",
                     help="see the expression alone, as parted by this model of build --additive")  # fmt: skip
    sub.add_argument("--seed", type=_natural, default=0, metavar="S")
    sub.set_defaults(run=_recognise_train)


def _add_recognise_predict(commands: Any) -> None:
    sub = _add(commands, "predict", "answer for fitted scans by a trained classifier, as a CSV table",
               "shapespace recognise predict expressions.skops out -o predictions.csv")  # fmt: skip
    sub.add_argument("classifier", type=Path, metavar="FILE.skops")
    sub.add_argument("results", type=Path, metavar="RESULTS", help="a folder that fit wrote, or its coefficients.csv")
    sub.add_argument("--labels", type=Path, metavar="FILE",
                     help="CSV of file, label and subject: says which scans are neutral faces, and whose")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.csv")
    sub.add_argument("--strict", action="store_true", help="exit with 1 when a fit is doubtful or an answer unsure")
    sub.set_defaults(run=_recognise_predict)


def _add_recognise_transfer(commands: Any) -> None:
    sub = _add(commands, "transfer", "put one person's expression on another, from fits by an additive model",
               "shapespace recognise transfer model.h5 out/anna.fit.json out/ben.fit.json -o anna.ply")  # fmt: skip
    sub.add_argument("model", type=Path, metavar="MODEL.h5", help="made by build --additive LABELS.csv")
    sub.add_argument("person", type=Path, metavar="PERSON.fit.json", help="fit of who is to be shown")
    sub.add_argument("expression", type=Path, metavar="EXPRESSION.fit.json", help="fit of what they shall do")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.ply")
    sub.set_defaults(run=_recognise_transfer)


def _add_recognise_study(commands: Any) -> None:
    sub = _add(commands, "study", "recognition measured on unseen people, ending in a report",
               "shapespace recognise study --data BU-3DFE --model model.h5 -o study")  # fmt: skip
    sub.add_argument("-o", "--output", type=Path, default=Path("shapespace-study"), metavar="DIR",
                     help="where to write; a study that was interrupted goes on")  # fmt: skip
    sub.add_argument("--data", type=Path, metavar="DIR",
                     help="labelled scans: BU-3DFE, Bosphorus, or a folder with labels.csv")  # fmt: skip
    sub.add_argument("--model", type=Path, metavar="MODEL.h5", help="shape model that fits them")
    sub.add_argument("--folds", type=_positive, default=10, metavar="N", help="folds by subject (default 10)")
    sub.add_argument("--seed", type=_natural, default=0, metavar="S", help="of everything that is drawn")
    sub.add_argument("--jobs", type=_natural, default=0, metavar="N", help="fits at a time (default: one a core)")
    sub.add_argument("--no-open", action="store_true", help="do not open the report in a browser")
    sub.set_defaults(run=_recognise_study)


def _demo(arguments: argparse.Namespace) -> int:
    from shapespace.demo import run_demo

    report = run_demo(arguments.out, quick=arguments.quick, quiet=arguments.quiet)
    if arguments.json:
        _print_json({"report": str(report)})
    else:
        _print(f"The report is {report}")
    if not arguments.no_open:
        import webbrowser

        webbrowser.open(report.absolute().as_uri())
    return 0


def _report(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    report = commands.report(
        arguments.folder, arguments.output, model=arguments.model, labels=arguments.labels, quiet=arguments.quiet
    )
    if arguments.json:
        _print_json({"report": str(report), "bytes": report.stat().st_size})
    else:
        _print(f"The report is {report}")
    if not arguments.no_open:
        import webbrowser

        webbrowser.open(report.absolute().as_uri())
    return 0


def _data_list(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    rows = commands.data_list()
    if arguments.json:
        _print_json(rows)
    else:
        for row in rows:
            for number, (key, value) in enumerate(row.items()):
                _print(f"{'  ' if number else ''}{key}: {value}")
    return 0


def _data_get(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    folder = commands.data_get(arguments.name, arguments.to, quiet=arguments.quiet)
    if arguments.json:
        _print_json({"folder": str(folder)})
    else:
        _print(str(folder))
    return 0


def _data_faces(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    names = [name.strip() for name in arguments.expressions.split(",") if name.strip()]
    count = commands.write_simulated_faces(
        arguments.output,
        source=arguments.source,
        subjects=arguments.subjects,
        expressions=names,
        seed=arguments.seed,
        area=arguments.area,
        quiet=arguments.quiet,
        raw=arguments.raw,
    )
    if arguments.json:
        _print_json({"folder": str(arguments.output), "faces": count})
    else:
        _print(f"{count} {'face' if count == 1 else 'faces'} in {arguments.output}")
    return 0


def _check(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    reports = commands.check(arguments.files)
    if arguments.json:
        _print_json(reports)
    else:
        for report in reports:
            _print_check(report)
    bad = sum(not report["usable"] for report in reports)
    for report in reports:
        if "error" in report:
            _say(f"shapespace: {report['error']}")
    if not bad:
        return 0
    return 2 if bad == len(reports) else 1


def _print_check(report: Mapping[str, Any]) -> None:
    _print(report["file"])
    if "error" in report:
        _print(f"  unusable: {report['error']}")
        return
    for key, value in report.items():
        if key not in ("file", "usable", "findings", "name"):
            _print(f"  {key}: {_short(value)}")
    for finding in report["findings"]:
        what, action = finding["what"], finding["action"]
        _print(
            f"  {finding['level']}: "
            + (f"{what[:-1]}; {action}" if finding["level"] == "refused" else f"{what} {action}")
        )
    print("  usable" if report["usable"] else "  not usable for fitting")


def _build(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    modes = arguments.variance if arguments.variance is not None else arguments.modes
    model, notes = commands.build(
        arguments.meshes,
        arguments.output,
        modes=None if modes == "all" else modes,
        gauge=arguments.gauge,
        align=not arguments.no_align,
        unit=arguments.unit,
        landmarks=arguments.landmarks,
        representation=arguments.representation,
        control_points=arguments.control_points,
        labels=arguments.additive,
        expression_variance=arguments.expression_variance,
        provenance=arguments.provenance,
        licence=arguments.licence,
        seed=arguments.seed,
        quiet=arguments.quiet,
    )
    for note in notes:
        _say(note)
    facts = commands.model_facts(model)
    if arguments.json:
        _print_json({"model": str(arguments.output), **facts})
    else:
        _print(
            f"{arguments.output}: {facts['modes']} modes of {facts['vertices']} vertices from "
            f"{facts['training_shapes']} meshes, {100 * facts['variance_held']:.2f} % of "
            f"{'the variance of people left out' if model.held_out else 'their variance'}, "
            f"gauge {facts['gauge']}"
        )
    return 0


def _info(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    facts = commands.info(arguments.file)
    if arguments.json:
        _print_json(facts)
    else:
        for key, value in facts.items():
            _print(f"{key}: {_short(value)}")
    return 0


def _fit(arguments: argparse.Namespace) -> int:
    if arguments.jobs != 1 and (len(arguments.scans) > 1 or arguments.scans[0].is_dir()):
        from shapespace.batch.workers import may_tell, start_loading

        # While this process loads its own code; half of the time that many scans take to start.
        start_loading(tell=may_tell(quiet=arguments.quiet))
    from shapespace import commands
    from shapespace.fit.fit import FitConfig

    config = FitConfig(
        method=arguments.method,
        unit=arguments.unit,
        search=arguments.search,
        scale=arguments.scale,
        max_iterations=arguments.max_iterations,
        seed=arguments.seed,
        dense=arguments.dense,
    )
    records = commands.fit_scans(
        arguments.model,
        arguments.scans,
        arguments.output,
        config,
        landmarks=arguments.landmarks,
        jobs=arguments.jobs,
        resume=arguments.resume,
        stages=arguments.stages,
        quiet=arguments.quiet,
        say=lambda sentence: _say(f"shapespace: {sentence}"),
    )
    counts = dict.fromkeys(("converged", "max_iterations", "doubtful", "failed"), 0)
    for record in records:
        counts[record["status"]] += 1
    if arguments.json:
        _print_json({"folder": str(arguments.output), "scans": len(records), **counts})
    elif counts["failed"] < len(records):
        for record in records[:10]:
            _print_fit(record)
        _print(
            f"{len(records)} {'scan' if len(records) == 1 else 'scans'}: "
            + ", ".join(f"{count} {status}" for status, count in counts.items() if count)
            + f"; results in {arguments.output}"
        )
    if counts["failed"] == len(records):
        return 2
    return 1 if counts["failed"] or (arguments.strict and counts["doubtful"]) else 0


def _recognise_train(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    facts, notes = commands.recognise_train(
        arguments.results,
        arguments.labels,
        arguments.output,
        classifier=arguments.classifier,
        relative=arguments.relative,
        neutral=arguments.neutral,
        confidence=arguments.confidence,
        modes=arguments.modes,
        expression_of=arguments.expression_of,
        seed=arguments.seed,
    )
    for note in notes:
        _say(note)
    if arguments.json:
        _print_json({"file": str(arguments.output), **facts})
        return 0
    training, checked = facts["training"], facts["cross_validation"]
    _print(
        f"{arguments.output}: {facts['classifier']} of {len(facts['classes'])} classes from {training['scans']} scans"
        + (f" of {training['subjects']} people" if training["subjects"] else "")
        + f", {facts['modes']} modes"
        + (", relative to neutral" if facts["relative_to_neutral"] else "")
    )
    if checked["macro_accuracy"] is not None:
        left_out = "people" if checked["by"] == "subject" else "scans"
        _print(f"macro accuracy on {left_out} left out: {100 * checked['macro_accuracy']:.1f} %")
    return 0


def _recognise_predict(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    rows, counts = commands.recognise_predict(
        arguments.classifier, arguments.results, arguments.output, labels=arguments.labels
    )
    if arguments.json:
        _print_json({"file": str(arguments.output), **counts, "answers": rows})
    else:
        for row in rows[:10]:
            p = max(row["probabilities"].values(), default=None)
            _print(
                f"{row['scan']}: {row['prediction'] or 'no answer'}"
                + (f" ({p:.2f})" if p is not None and not row["reason"] else "")
                + (f"; {row['reason']}" if row["reason"] else "")
            )
        told = ", ".join(f"{count} {what}" for what, count in counts.items() if count)
        _print(f"{len(rows)} {'scan' if len(rows) == 1 else 'scans'}: {told}; answers in {arguments.output}")
    asked = len(rows) - counts["neutral"]
    if counts["failed"] == asked:
        _say("shapespace: no scan could be answered for; the reasons stand in the table.")
        return 2
    return 1 if counts["failed"] or (arguments.strict and counts["doubtful"] + counts["unsure"]) else 0


def _recognise_transfer(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    commands.recognise_transfer(arguments.model, arguments.person, arguments.expression, arguments.output)
    if arguments.json:
        _print_json({"file": str(arguments.output)})
    else:
        _print(f"{arguments.output}: {arguments.person.name} with the expression of {arguments.expression.name}")
    return 0


def _recognise_study(arguments: argparse.Namespace) -> int:
    from shapespace import commands

    report, targets, holds = commands.recognise_study(
        arguments.output,
        arguments.data,
        arguments.model,
        folds=arguments.folds,
        seed=arguments.seed,
        jobs=arguments.jobs,
        quiet=arguments.quiet,
    )
    if arguments.json:
        _print_json({"report": str(report), "targets": targets})
    else:
        for line in holds.splitlines():
            _print(line)
        for one in targets:
            _print(f"{one['what']}: {one['reached']} ({one['target']}{'' if one['met'] else '; missed'})")
        _print(f"The report is {report}")
    if not arguments.no_open:
        import webbrowser

        webbrowser.open(report.absolute().as_uri())
    return 0


def _view(arguments: argparse.Namespace) -> int:
    from shapespace.viewer.serve import serve

    serve(
        arguments.path,
        model=arguments.model,
        host=arguments.host,
        port=arguments.port,
        open_browser=not arguments.no_open,
        max_upload_mb=arguments.max_upload_mb,
        quiet=arguments.quiet,
        say=_now,
    )
    return 0


def _now(line: str) -> None:
    _print(line)
    sys.stdout.flush()


def _print_fit(record: Mapping[str, Any]) -> None:
    if record["status"] == "failed":
        return
    final = record["distances_mm"]["final"]
    _print(
        f"{record['scan']['name']}: {record['status']}; model to scan {final['model_to_scan']['mean']:.2f} mm mean, "
        f"scan to model {final['scan_to_model']['mean']:.2f} mm mean over "
        f"{100 * final['scan_to_model']['fraction']:.0f} % of the scan"
    )
    if "dense" in record["distances_mm"]:
        dense = record["distances_mm"]["dense"]["model_to_scan"]
        _print(f"  dense surface to scan: {dense['median']:.2f} mm median, {dense['mean']:.2f} mm mean")
    for note in record["notes"]:
        print(f"  {note}")


def _say(sentence: str) -> None:
    print(_visible(sentence), file=sys.stderr)


def _print(line: str) -> None:
    print(_visible(line))


def _print_json(facts: Any) -> None:
    print(json.dumps(_plain(facts), indent=1, allow_nan=False))


def _visible(line: str) -> str:
    """Return `line` with control characters as escapes: a file's name may hold line breaks and terminal codes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line)


def _short(value: Any) -> str:
    plain = _plain(value)
    if isinstance(plain, list):
        items = cast(list[Any], plain)
        shown = ", ".join(_short(item) for item in items[:8])
        return f"[{shown}{', ...' if len(items) > 8 else ''}]" + (f" ({len(items)})" if len(items) > 8 else "")
    if isinstance(plain, dict):
        return ", ".join(f"{key} {_short(item)}" for key, item in cast(dict[str, Any], plain).items())
    return f"{plain:.6g}" if isinstance(plain, float) else str(plain)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in cast(Mapping[Any, Any], value).items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in cast(Sequence[Any], value)]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, (str, int, float, type(None))) else str(value)


def _positive(text: str) -> int:
    value = _natural(text)
    if value == 0:
        raise argparse.ArgumentTypeError("must be at least 1")
    return value


def _natural(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number") from None
    if value < 0:
        raise argparse.ArgumentTypeError("must not be negative")
    return value


def _share(text: str) -> float:
    value = _probability(text)
    if value == 0:
        raise argparse.ArgumentTypeError("must lie above 0 and at most at 1")
    return value


def _probability(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number") from None
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError("must lie from 0 to 1")
    return value


def _control_points(text: str) -> tuple[int, int]:
    counts = text.lower().split("x")
    if len(counts) != 2 or not all(count.isascii() and count.isdigit() and len(count) < 4 for count in counts):
        raise argparse.ArgumentTypeError(f"must be two whole numbers such as 24x24, not {text!r}")
    return int(counts[0]), int(counts[1])


def _modes(text: str) -> int | str:
    return text if text in ("auto", "all") else _positive(text)


if __name__ == "__main__":
    sys.exit(main())
