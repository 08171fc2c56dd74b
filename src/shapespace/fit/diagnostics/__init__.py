"""The quality of a fit: evidence, expected error, probability of failure, reasons for its status.

Entry points: `failure_model`, `verdict`, `reason_text`. Imported by `fit.fit_scan` and the methods; imports no
search.
"""
