"""`shapespace regress`: regression of a number, such as age, on shape, and of shape on a number."""

from __future__ import annotations

import argparse

from shapespace.cli.answers.common import cohort_of, column_value, finish
from shapespace.cli.options import given
from shapespace.errors import InputError


def run(arguments: argparse.Namespace) -> int:
    """Fit a regression on shape, predict with it, and write the report."""
    from shapespace.batch.progress import steps
    from shapespace.cohort.read import CohortConfig, read_cohort
    from shapespace.io.files import make_folder
    from shapespace.report.analyses.regression_report import prediction_report, regression_report
    from shapespace.report.analyses.shape_prediction_report import shape_prediction_report
    from shapespace.statistics.predictor import Predictor, refuse_known
    from shapespace.statistics.regression import regress
    from shapespace.statistics.shape_prediction import predict_shapes

    others = ("at", "curve", "covariates", "hold", "length") if arguments.along is None else ("predict", "new_shapes")
    for name in others:
        if getattr(arguments, name):
            needed = "--along" if arguments.along is None else "--target"
            raise InputError(f"--{name.replace('_', '-')} needs {needed}; name the column of the number with it.")
    names = ("subject", "seed", "drop_missing", "permutations", "confidence")
    shared = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    if arguments.predictor is not None:
        learned = Predictor.load(arguments.predictor)
        if learned.model_hash and arguments.surfaces == "auto":
            arguments.surfaces = "coefficients"
        cohort = cohort_of(arguments, learned.gauge, least=1)
        return finish(prediction_report(learned, cohort, learned.predict(cohort)), arguments)
    cohort = cohort_of(arguments)
    if arguments.along is not None:
        hold = dict(column_value(word, "--hold") for word in arguments.hold or ())
        options = {**given(arguments, predict_shapes, hold=hold), **shared}
        options = {name: value for name, value in options.items() if value is not None}
        with steps(None, "flipping signs", "step", quiet=arguments.quiet) as step:
            shapes = predict_shapes(cohort, **options, progress=step)
        return finish(shape_prediction_report(shapes), arguments)
    with steps(None, "learning", "fold", quiet=arguments.quiet) as step:
        result = regress(cohort, arguments.target, folds=arguments.folds, **shared, progress=step)
    new = None
    if arguments.predict is not None:
        config = CohortConfig(**given(arguments, CohortConfig, shapes=arguments.new_shapes, least=1))
        with steps(None, "reading", "shape", quiet=arguments.quiet) as step:
            fresh = read_cohort(arguments.predict, config, onto=result.cohort, on_shape=step)
        own = [result.subject] if result.subject is not None and result.subject in fresh.table.columns else []
        fresh = fresh.complete(own, drop_missing=arguments.drop_missing)
        refuse_known(result.subjects, fresh.table.texts(own[0]) if own else fresh.names, fresh.table.where)
        new = (fresh, result.predictor.predict(fresh))
    make_folder(arguments.output)
    result.predictor.save(arguments.output / "predictor.npz")
    return finish(regression_report(result, new), arguments)
