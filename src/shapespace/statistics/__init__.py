"""Statistical analyses of cohorts: groups, change, asymmetry, regression, identity, scores against a reference.

Entry points: `compare`, `change`, `measure_asymmetry`, `regress`, `predict_shapes`, `score`, `verify` and `identify`.
May be imported by `report`, `viewer`, `study`, `commands` and `cli`; results contain no prose and no HTML.
"""

from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names

if TYPE_CHECKING:
    from shapespace.statistics.asymmetry import AsymmetryResult, measure_asymmetry
    from shapespace.statistics.change_result import ChangeConfig, ChangeResult
    from shapespace.statistics.compare_shapes import CompareConfig, CompareResult, compare
    from shapespace.statistics.identity.identify import IdentificationResult, identify
    from shapespace.statistics.identity.trial import IdentityConfig
    from shapespace.statistics.identity.verify import VerificationResult, verify
    from shapespace.statistics.measure_change import change
    from shapespace.statistics.predictor import Predictions, Predictor
    from shapespace.statistics.regression import RegressionResult, regress
    from shapespace.statistics.score_subjects import ScoreConfig, ScoreResult, score
    from shapespace.statistics.shape_prediction import PredictedMeasure, ShapePrediction, predict_shapes
    from shapespace.statistics.shape_tests.covariation import compare_effect_sizes, estimate_modularity, fit_pls
    from shapespace.statistics.shape_tests.groups import (
        assess_equivalence,
        compare_disparity,
        compare_means_and_covariances,
        discriminate,
    )
    from shapespace.statistics.shape_tests.linear import (
        analyse_allometry,
        compare_pairs,
        compare_trajectories,
        measure_repeatability,
    )
    from shapespace.statistics.shape_tests.ordination import Ordination, ordinate
    from shapespace.statistics.shape_tests.phylogenetic import estimate_phylogenetic_signal, fit_pgls
    from shapespace.statistics.shape_tests.planning import plan_sample_size
    from shapespace.statistics.shape_tests.shape_test_result import ShapeTestResult, Statistic

__all__ = [
    "AsymmetryResult",
    "ChangeConfig",
    "ChangeResult",
    "CompareConfig",
    "CompareResult",
    "IdentificationResult",
    "IdentityConfig",
    "Ordination",
    "PredictedMeasure",
    "Predictions",
    "Predictor",
    "RegressionResult",
    "ScoreConfig",
    "ScoreResult",
    "ShapePrediction",
    "ShapeTestResult",
    "Statistic",
    "VerificationResult",
    "analyse_allometry",
    "assess_equivalence",
    "change",
    "compare",
    "compare_disparity",
    "compare_effect_sizes",
    "compare_means_and_covariances",
    "compare_pairs",
    "compare_trajectories",
    "discriminate",
    "estimate_modularity",
    "estimate_phylogenetic_signal",
    "fit_pgls",
    "fit_pls",
    "identify",
    "measure_asymmetry",
    "measure_repeatability",
    "ordinate",
    "plan_sample_size",
    "predict_shapes",
    "regress",
    "score",
    "verify",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "statistics.asymmetry": ("AsymmetryResult", "measure_asymmetry"),
        "statistics.change_result": ("ChangeConfig", "ChangeResult"),
        "statistics.compare_shapes": ("CompareConfig", "CompareResult", "compare"),
        "statistics.identity.identify": ("IdentificationResult", "identify"),
        "statistics.identity.trial": ("IdentityConfig",),
        "statistics.identity.verify": ("VerificationResult", "verify"),
        "statistics.measure_change": ("change",),
        "statistics.predictor": ("Predictions", "Predictor"),
        "statistics.regression": ("RegressionResult", "regress"),
        "statistics.score_subjects": ("ScoreConfig", "ScoreResult", "score"),
        "statistics.shape_prediction": ("PredictedMeasure", "ShapePrediction", "predict_shapes"),
        "statistics.shape_tests.covariation": ("compare_effect_sizes", "estimate_modularity", "fit_pls"),
        "statistics.shape_tests.groups": (
            "assess_equivalence",
            "compare_disparity",
            "compare_means_and_covariances",
            "discriminate",
        ),
        "statistics.shape_tests.linear": (
            "analyse_allometry",
            "compare_pairs",
            "compare_trajectories",
            "measure_repeatability",
        ),
        "statistics.shape_tests.ordination": ("Ordination", "ordinate"),
        "statistics.shape_tests.phylogenetic": ("estimate_phylogenetic_signal", "fit_pgls"),
        "statistics.shape_tests.planning": ("plan_sample_size",),
        "statistics.shape_tests.shape_test_result": ("ShapeTestResult", "Statistic"),
    },
)
