"""The commands that answer questions about cohorts: they read the cohort, analyse it, and write the results."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import partial
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from shapespace.cli.options import given
from shapespace.cli.printing import warn
from shapespace.commands.outcome import Outcome
from shapespace.errors import InputError, ShapespaceError

if TYPE_CHECKING:
    from shapespace.cohort.cohort import Cohort
    from shapespace.cohort.read import Surfaces
    from shapespace.report.analyses.analysis_report import AnalysisReport
    from shapespace.statistics.identity.trial import IdentityConfig
    from shapespace.step_counter import Progress


_Result = TypeVar("_Result")


class InputAccepted(Exception):  # noqa: N818 - no error
    """Ends a question whose input is only checked, as it begins to compute."""


def reason_of_rejection(words: Sequence[str], folders: Sequence[Path]) -> str:
    """Return why the command of a question would reject its input; empty if it begins to compute. `align`
    computes its result, which questions about landmarks on scans read.

    Args:
        words: arguments of the command.
        folders: folders of its files, the first one first; paths that none of them has are of the last one. Without
            folders only the options are checked.
    """
    from shapespace.cli.arguments import CommandParser, parser

    class RaisingParser(CommandParser):
        def error(self, message: str) -> NoReturn:
            raise InputError(f"{self.prog}: error: {message}")

    try:
        arguments = parser(RaisingParser).parse_args([*words, "--quiet"])
        if not folders:
            return ""
        for name, value in vars(arguments).items():
            if isinstance(value, Path):
                there = (folder / value for folder in folders if (folder / value).exists())
                setattr(arguments, name, next(there, folders[-1] / value))
        arguments.only_check = True
        arguments.run(arguments)
    except ShapespaceError as error:
        return str(error)
    except InputAccepted:
        pass
    return ""


def _end_check(done: int, total: int) -> None:
    raise InputAccepted


def _steps(arguments: argparse.Namespace, count: int | None, doing: str, what: str) -> AbstractContextManager[Progress]:
    """Return a context with the function of a progress bar; that of a question that is only checked ends it."""
    from shapespace.batch.progress import steps

    is_checked = hasattr(arguments, "only_check")
    return nullcontext(_end_check) if is_checked else steps(count, doing, what, quiet=arguments.quiet)


def column_value(text: str, option: str) -> tuple[str, str]:
    """Return the column and the value of COLUMN=VALUE.

    Raises:
        InputError: the text has another form.
    """
    column, _, value = (part.strip() for part in text.partition("="))
    if not (column and value):
        raise InputError(f"{option} is {text!r}; write COLUMN=VALUE, such as group=control.")
    return column, value


def cohort_of(
    arguments: argparse.Namespace, data: Path | None = None, *, onto: Cohort | None = None, least: int = 2,
    accept_review: bool | None = None, surfaces: Surfaces | None = None, **fixed: Any,
) -> Cohort:  # fmt: skip
    """Return a cohort from the arguments, with the settings of its file and of --set.

    Args:
        arguments: parsed arguments of a command that reads a cohort.
        data: path of the data; None for the data of the arguments.
        onto: a cohort that this one is compared with.
        least: smallest number of shapes, if `onto` is None.
        accept_review: whether surfaces that need review are accepted, see `CohortConfig`.
        surfaces: surfaces for the question, if neither the file nor --set chooses them.
        fixed: settings that are fixed for the question.
    """
    from shapespace.batch.progress import steps
    from shapespace.cohort.read import CohortConfig, is_cohort_file, read_cohort, read_cohort_file

    place, stated = (data or arguments.data), dict[str, Any]()
    if is_cohort_file(place):
        place, stated = read_cohort_file(place)
    if surfaces is not None:
        stated.setdefault("surfaces", surfaces)
    known = given(arguments, CohortConfig)
    chosen = {name: known[name] for name in arguments.chosen if name in known}
    if data is None and arguments.shapes is not None:
        chosen["shapes"] = arguments.shapes
    stated |= {"least": least, "accept_review": accept_review, **chosen, **fixed}
    config = CohortConfig(**stated)
    with steps(None, "reading", "shape", quiet=arguments.quiet) as step:
        return read_cohort(place, config, onto=onto, on_shape=step)


def answer_cohort(arguments: argparse.Namespace) -> Outcome:
    """Write a cohort file, and summarise the cohort."""
    from shapespace.batch.progress import steps
    from shapespace.cohort.read import CohortConfig, read_cohort, write_cohort_file

    settings = {name: value for name, value in given(arguments, CohortConfig).items() if value is not None}
    config = CohortConfig(**settings, least=1)
    initial = CohortConfig()
    with steps(None, "reading", "shape", quiet=arguments.quiet) as step:
        cohort = read_cohort(arguments.data, config, on_shape=step)
    stated = {name: value for name, value in settings.items() if value != getattr(initial, name)}
    write_cohort_file(arguments.output, arguments.data, **stated)
    facts = {"cohort": str(arguments.output), "shapes": len(cohort), "vertices": cohort.n_vertices}
    facts |= {"gauge": cohort.gauge, "source": cohort.source.kind, "columns": list(cohort.table.columns)}
    return Outcome(facts, [f"{arguments.output}: {repr(cohort)[1:-1]}"], cohort.notes)


def result_figures(arguments: argparse.Namespace) -> Outcome:
    """Draw the figures of results as files."""
    from shapespace.commands.answers import drawing
    from shapespace.report.pages.write_html import FigureConfig, write_figures

    config = FigureConfig(**given(arguments, FigureConfig))
    with drawing(quiet=arguments.quiet) as step:
        paths, notes = write_figures(arguments.folder, config, model=arguments.model, on_step=step)
    facts = {"folder": str(arguments.folder), "figures": list(map(str, paths)), "notes": notes}
    line = f"{len(paths)} files in {paths[0].parent}" if paths else f"{arguments.folder} has nothing to draw."
    return Outcome(facts, [line], notes)


def _compute_and_report(
    arguments: argparse.Namespace, doing: str, what: str, compute: Callable[..., _Result],
    report: Callable[[_Result], AnalysisReport], count: int | None = None,
) -> Outcome:  # fmt: skip
    """Compute a result with a progress bar, and write its report.

    Args:
        arguments: parsed arguments.
        doing: text of the progress bar, such as `permuting`.
        what: name of one step, such as `shape`.
        compute: function of `progress` that returns the result.
        report: function that makes the report of the result.
        count: number of steps, if it is known.
    """
    with _steps(arguments, count, doing, what) as step:
        result = compute(progress=step)
    return _write_report(report(result), arguments)


def _write_report(report: AnalysisReport, arguments: argparse.Namespace) -> Outcome:
    from shapespace.commands.answers import write_answer

    if hasattr(arguments, "only_check"):
        raise InputAccepted
    return write_answer(report, arguments.output, quiet=arguments.quiet)


def answer_align(arguments: argparse.Namespace) -> Outcome:
    """Align landmarks, and name the specimens to check."""
    from shapespace.commands.align import align
    from shapespace.geometry.landmark_alignment import AlignConfig
    from shapespace.report.blocks.wording import counted
    from shapespace.schemas import to_json

    config = AlignConfig(**given(arguments, AlignConfig))
    reflect = column_value(arguments.reflect, "--reflect") if arguments.reflect else None
    _, record = align(arguments.data, arguments.output, config, **given(arguments, align, reflect=reflect))
    if hasattr(arguments, "only_check"):
        raise InputAccepted
    check = len({finding.specimen for finding in record.findings})
    lines = [
        f"{record.specimens} specimens with {record.landmarks} landmarks ({record.dimensions}-D) are aligned.",
        f"{counted(check, 'specimen')} to check." if check else "No outliers, swaps or mirrored specimens.",
        f"Results are in {arguments.output}",
    ]
    return Outcome({"folder": str(arguments.output), **to_json(record)}, lines, record.notes)


def answer_asymmetry(arguments: argparse.Namespace) -> Outcome:
    """Measure the asymmetry of a cohort, and write its report."""
    from shapespace.report.analyses.asymmetry_report import asymmetry_report
    from shapespace.statistics.asymmetry import measure_asymmetry
    from shapespace.statistics.sides import read_pairs

    reference = column_value(arguments.reference, "--reference") if arguments.reference else None
    cohort = cohort_of(arguments)
    pairs = None if arguments.pairs is None else read_pairs(arguments.pairs, cohort)
    options = given(arguments, measure_asymmetry, pairs=pairs, reference=reference)
    compute = partial(measure_asymmetry, cohort, **options, where=str(arguments.pairs))
    return _compute_and_report(arguments, "permuting", "shape", compute, asymmetry_report)


def answer_change(arguments: argparse.Namespace) -> Outcome:
    """Measure the changes, and write the report."""
    from shapespace.io.landmarks.landmark_io import read_region
    from shapespace.report.analyses.change_report import change_report
    from shapespace.statistics.change_result import ChangeConfig
    from shapespace.statistics.measure_change import change

    cohort = cohort_of(arguments, gauge="form")
    regions = {name: read_region(path) for name, path in arguments.region} or None
    config = ChangeConfig(**given(arguments, ChangeConfig, regions=regions))
    return _compute_and_report(arguments, "comparing", "subject", partial(change, cohort, config), change_report)


def answer_compare(arguments: argparse.Namespace) -> Outcome:
    """Compare the shapes of a cohort."""
    from shapespace.report.analyses.compare_report import compare_report
    from shapespace.statistics.compare_shapes import CompareConfig, compare

    config = CompareConfig(**given(arguments, CompareConfig, errors=dict(arguments.error)))
    cohort = cohort_of(arguments)
    compute = partial(compare, cohort, arguments.formula, config)
    return _compute_and_report(arguments, "permuting", "step", compute, compare_report)


def answer_complete(arguments: argparse.Namespace) -> Outcome | int:
    """Complete scans; 1 if some failed, 2 if all did."""
    from shapespace.commands.complete import CompletionFiles, complete_scans
    from shapespace.fit.completion.complete import CompletionConfig
    from shapespace.fit.fit_scan import FitConfig
    from shapespace.io.files import write_text
    from shapespace.report.analyses.analysis_report import METHODS_FILE
    from shapespace.report.analyses.completion_report import CompletionReport

    fit = FitConfig(**given(arguments, FitConfig))
    config = CompletionConfig(**given(arguments, CompletionConfig), fit=fit)
    files = CompletionFiles(**given(arguments, CompletionFiles))
    collected = CompletionReport(config)
    failed = complete_scans(
        arguments.model, arguments.scans, arguments.output, config, files, quiet=arguments.quiet, say=warn,
        on_completion=collected.add,
    )  # fmt: skip
    if not collected.count:
        return 2
    outcome = _write_report(collected.report(len(failed)), arguments)
    write_text(arguments.output / METHODS_FILE, collected.methods_text())
    return replace(outcome, exit_code=int(bool(failed)))


def answer_verify(arguments: argparse.Namespace) -> Outcome:
    """Verify whether two scans are of one subject."""
    from shapespace.report.analyses.identity_report import verify_report
    from shapespace.statistics.identity.verify import verify

    cohort, config = _cohort_and_config(arguments)
    return _compute_and_report(arguments, "comparing", "draw", partial(verify, cohort, config), verify_report)


def answer_identify(arguments: argparse.Namespace) -> Outcome:
    """Identify the subject of a scan among the enrolled ones."""
    from shapespace.report.analyses.identity_report import identify_report
    from shapespace.statistics.identity.identify import identify

    cohort, config = _cohort_and_config(arguments)
    return _compute_and_report(arguments, "searching", "score", partial(identify, cohort, config), identify_report)


def _cohort_and_config(arguments: argparse.Namespace) -> tuple[Cohort, IdentityConfig]:
    from shapespace.statistics.identity.trial import IdentityConfig

    cohort = cohort_of(arguments, surfaces="coefficients", gauge="shape")
    if cohort.source.kind != "coefficients":
        cohort = replace(cohort, fitted=None)
    return cohort, IdentityConfig(**given(arguments, IdentityConfig))


def answer_morphospace(arguments: argparse.Namespace) -> Outcome:
    """Compute an ordination of a cohort, and write its report."""
    from shapespace.report.analyses.morphospace_report import morphospace_report
    from shapespace.statistics.shape_tests.ordination import ordinate

    result = ordinate(cohort_of(arguments), **given(arguments, ordinate))
    return _write_report(morphospace_report(result, arguments.axes), arguments)


def answer_regress(arguments: argparse.Namespace) -> Outcome:
    """Fit a regression on shape, predict with it, and write the report."""
    from shapespace.io.files import make_folder
    from shapespace.report.analyses.regression_report import (
        prediction_report,
        regression_report,
        shape_prediction_report,
    )
    from shapespace.statistics.predictor import Predictor, refuse_known
    from shapespace.statistics.regression import regress
    from shapespace.statistics.shape_prediction import predict_shapes

    others = ("at", "curve", "covariates", "hold", "length") if arguments.along is None else ("predict",)
    for name in others:
        if getattr(arguments, name):
            needed = "--along" if arguments.along is None else "--target"
            option = f"--set {name}" if name in arguments.chosen else f"--{name}"
            raise InputError(f"{option} needs {needed}; name the column of the number with it.")
    names = ("seed", "permutations", "confidence")
    shared = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    if arguments.predictor is not None:
        learned = Predictor.load(arguments.predictor)
        surfaces: Surfaces | None = "coefficients" if learned.model_hash else None
        cohort = cohort_of(arguments, least=1, surfaces=surfaces, gauge=learned.gauge)
        return _write_report(prediction_report(learned, cohort, learned.predict(cohort)), arguments)
    cohort = cohort_of(arguments)
    if arguments.along is not None:
        hold = dict(column_value(word, "--set hold") for word in arguments.hold or ())
        options = {**given(arguments, predict_shapes, hold=hold), **shared}
        options = {name: value for name, value in options.items() if value is not None}
        compute = partial(predict_shapes, cohort, **options)
        return _compute_and_report(arguments, "flipping signs", "step", compute, shape_prediction_report)
    with _steps(arguments, None, "learning", "fold") as step:
        result = regress(cohort, arguments.target, folds=arguments.folds, **shared, progress=step)
    new = None
    if arguments.predict is not None:
        fresh = cohort_of(arguments, arguments.predict, onto=result.cohort, least=1)
        own = [result.subject] if result.subject is not None and result.subject in fresh.table.columns else []
        fresh = fresh.complete(own)
        refuse_known(result.subjects, fresh.table.texts(own[0]) if own else fresh.names, fresh.table.where)
        new = (fresh, result.predictor.predict(fresh))
    make_folder(arguments.output)
    result.predictor.save(arguments.output / "predictor.npz")
    return _write_report(regression_report(result, new), arguments)


def answer_score(arguments: argparse.Namespace) -> Outcome:
    """Score subjects against a reference."""
    from shapespace.report.analyses.score_report import score_report
    from shapespace.statistics.score_subjects import ScoreConfig, score

    config = ScoreConfig(**given(arguments, ScoreConfig))
    doubtful = arguments.doubtful
    reference = cohort_of(
        arguments, arguments.reference, accept_review=doubtful, surfaces="coefficients", doubtful=False
    )
    subjects = cohort_of(arguments, onto=reference, surfaces="coefficients")
    compute = partial(score, reference, subjects, config)
    return _compute_and_report(arguments, "scoring", "subject", compute, score_report, len(subjects))


def answer_shape_tests(arguments: argparse.Namespace) -> Outcome:
    """Run a test of shape on a cohort, and write its report."""
    from shapespace.report.analyses.result_report import shape_test_report

    test = arguments.shape_test
    function = resolve_name(f"shapespace.statistics.shape_tests.{test.function}")
    compute = partial(function, cohort_of(arguments), **given(arguments, function))
    return _compute_and_report(arguments, "permuting", "permutation", compute, shape_test_report)


def answer_export(arguments: argparse.Namespace) -> Outcome:
    """Write fits of a store as single files, or all of them as a table; with `--to`, the shapes of a cohort.

    Raises:
        InputError: options of both kinds of export are combined.
    """
    from shapespace.commands.export import export, export_cohort

    if arguments.to is None and arguments.formula is None:
        return export(
            arguments.store, arguments.names, arguments.output, every=arguments.all, table=arguments.table,
            quiet=arguments.quiet, say=warn,
        )  # fmt: skip
    if arguments.names or arguments.all or arguments.table is not None:
        raise InputError("--to exports all shapes of DATA; omit names, --all and --table.")
    if arguments.formula is not None and arguments.to != "geomorph":
        raise InputError("--formula is the model of the script for geomorph; give --to geomorph too.")
    arguments.data = arguments.store
    return export_cohort(cohort_of(arguments), arguments.output, **given(arguments, export_cohort))
