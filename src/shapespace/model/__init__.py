"""Statistical shape models: mean shape, modes, coefficients; PCA of every size; the model file.

Entry points: `shape_model.ShapeModel`, `additive.AdditiveModel`, `model_quality.measure_quality`. Imported by `fit` and
above; `model` reads no scan.
"""

from typing import TYPE_CHECKING

from shapespace.lazy import lazy_names

if TYPE_CHECKING:
    from shapespace.model.additive import AdditiveModel
    from shapespace.model.build_model import BuildConfig
    from shapespace.model.model_quality import Curve, ModelQuality, QualityConfig, measure_quality
    from shapespace.model.shape_model import ShapeModel

__all__ = [
    "AdditiveModel",
    "BuildConfig",
    "Curve",
    "ModelQuality",
    "QualityConfig",
    "ShapeModel",
    "measure_quality",
]
__getattr__, __dir__ = lazy_names(
    __name__,
    {
        "model.additive": ("AdditiveModel",),
        "model.build_model": ("BuildConfig",),
        "model.model_quality": ("Curve", "ModelQuality", "QualityConfig", "measure_quality"),
        "model.shape_model": ("ShapeModel",),
    },
)
