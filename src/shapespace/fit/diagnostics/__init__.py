"""The quality of a fit: evidence, expected error, probability of failure, status and reason.

Entry points: `reliability`, `verdict`. Imported by `fit.fit_scan` and the methods; imports no search.
"""
