"""rustcpd: coherent point drift of the template's vertices to those of the scan, from where the template lies.

`fit` has settings that came near to two spleens (benchmarks/correspondence_peers.py): the 30 nearest matches of
each point alone, and a narrow kernel. `fit_as_documented` has those of its README for clouds of many points in large
units.
"""

from __future__ import annotations

import time

from shapespace.types import FloatArray, Mesh

NEEDS = ("rustcpd",)
LOW_RANK, METHOD = 300, "pivoted_cholesky"
NEAREST, ALPHA, BETA, TOLERANCE, ITERATIONS = 30, 0.5, 0.5, 1e-6, 150


def fit(mean: Mesh, model: object, scan: Mesh, T_scan_model: object) -> tuple[FloatArray, float]:
    return _registered(mean, scan, k=NEAREST, alpha=ALPHA, beta=BETA, tolerance=TOLERANCE, max_iterations=ITERATIONS)


def fit_as_documented(mean: Mesh, model: object, scan: Mesh, T_scan_model: object) -> tuple[FloatArray, float]:
    return _registered(mean, scan)


def _registered(mean: Mesh, scan: Mesh, **settings: float) -> tuple[FloatArray, float]:
    import rustcpd

    began = time.process_time()
    result = rustcpd.register_deformable(
        scan.vertices,
        mean.vertices,
        low_rank=LOW_RANK,
        low_rank_method=METHOD,
        normalize=True,
        parallel=False,
        **settings,
    )
    return result.points, time.process_time() - began
