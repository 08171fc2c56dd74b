"""Statistical analyses of cohorts: groups, change, asymmetry, regression, identity, scores against a reference.

Entry points: `compare`, `change`, `measure_asymmetry`, `regress`, `score`, `verify` and `identify`.
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

__all__ = [
    "AsymmetryResult",
    "ChangeConfig",
    "ChangeResult",
    "CompareConfig",
    "CompareResult",
    "IdentificationResult",
    "IdentityConfig",
    "Predictions",
    "Predictor",
    "RegressionResult",
    "ScoreConfig",
    "ScoreResult",
    "VerificationResult",
    "change",
    "compare",
    "identify",
    "measure_asymmetry",
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
    },
)
