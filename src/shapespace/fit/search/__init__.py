"""Initialisation of a fit: unit, pose from landmarks or by global search, chirality, second instances.

Entry points: `initialisation`, `pose_search`. Imported by `fit.fit_scan` and `correspondence`.
"""
