"""The robust fit: pose and coefficients by one Gauss-Newton step an iteration, from both directions.

Entry points: `robust_method.Robust`, `robust_icp.robust_icp`. Imported by `fit.fit_scan`, `fit.search`, `fit.dense`
and `fit.diagnostics`.
"""
