"""Beyond the span of the model: residual modes, and smooth fields from the fitted surface to the scan.

Entry points: `dense_fit`, `residual_modes`. Imported by `fit.fit_scan` and `correspondence`.
"""
