"""Fitting of a shape model to one scan.

Entry points: `fit_scan.fit_scan`, `result.FitResult`, `method_choices`. Imported by `correspondence`,
`recognise`, `statistics`, `batch`, `report` and above; a fit reads no file and prints nothing.
"""

from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names

if TYPE_CHECKING:
    from shapespace.fit.completion.complete import Completion, QuantityEstimate
    from shapespace.fit.diagnostics.failure_model import ErrorEstimate, FitEvidence
    from shapespace.fit.diagnostics.reasons import Reason, ReasonCode
    from shapespace.fit.fit_scan import FitConfig
    from shapespace.fit.paper.paper_method import Paper
    from shapespace.fit.result import FitResult, OverlapDistances, Stage
    from shapespace.fit.robust.robust_method import Robust
    from shapespace.fit.search.second_instance import SecondInstance

__all__ = [
    "Completion",
    "ErrorEstimate",
    "FitConfig",
    "FitEvidence",
    "FitResult",
    "OverlapDistances",
    "Paper",
    "QuantityEstimate",
    "Reason",
    "ReasonCode",
    "Robust",
    "SecondInstance",
    "Stage",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "fit.completion.complete": ("Completion", "QuantityEstimate"),
        "fit.diagnostics.failure_model": ("ErrorEstimate", "FitEvidence"),
        "fit.diagnostics.reasons": ("Reason", "ReasonCode"),
        "fit.fit_scan": ("FitConfig",),
        "fit.paper.paper_method": ("Paper",),
        "fit.result": ("FitResult", "OverlapDistances", "Stage"),
        "fit.robust.robust_method": ("Robust",),
        "fit.search.second_instance": ("SecondInstance",),
    },
)
