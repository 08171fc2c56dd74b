"""Statistical shape models: mean shape, modes, coefficients; PCA of every size; the model file.

Entry points: `shape_model.ShapeModel`, `additive.AdditiveModel`, `model_quality.measure_quality`. Imported by `fit` and
above; `model` reads no scan.
"""
