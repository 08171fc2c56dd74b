"""The verdict on what is returned: pose, coefficients and surface must agree with each other, whatever the method."""

from __future__ import annotations

import numpy as np

from shapespace.fit.method import Ended, Method
from shapespace.fit.result import Status

_FARTHEST_Z = 10.0
"""Standard deviations of new shapes; the plain method goes to 8 on real scans, where faint modes chase details."""
_OTHER_SCALE = 0.05
_MOVED_AWAY, _LEAST_MOVED_SHARE = 1.5, 0.005
"""The nearest shape in the span lies as far from a surface as that leaves the span, and hardly farther."""
_DENSE_MOVED_SHARE = 0.009
"""Dense surfaces move along their normals by a quarter of that share of the size where the model is made for them; of
those that move further, most lie elsewhere than they belong (docs/dense.md)."""


def verdict(method: Method, ended: Ended) -> tuple[Status, str]:
    """Return status and reason of a fit: what speaks against what is returned, then what the method doubts itself."""
    against = [*doubts_of_returned(ended), *method.doubts(ended)]
    if against:
        return "doubtful", f"Do not trust this fit: {'; '.join(against)}."
    for number, name in ((1, "Phase 1"), (2, "Phase 2")):
        if ended.phases[number].stopped == "cap":
            return "max_iterations", f"{name} was cut off after {ended.phases[number].iteration} iterations."
    return "converged", method.reason(ended)


def doubts_of_returned(ended: Ended) -> list[str]:
    """Return how pose, coefficients and surface contradict each other; none where they agree."""
    from shapespace.fit.robust.posterior import new_shapes  # compiled, and loads SciPy

    model, fitted, found = ended.model, ended.fitted, list[str]()
    z = np.abs(fitted.b) / np.sqrt(new_shapes(model)[: len(fitted.b)])
    worst = int(z.argmax())
    if z[worst] > _FARTHEST_Z:
        found.append(
            f"mode {worst + 1} lies {z[worst]:.3g} standard deviations out, which no shape of this kind does; build "
            "the model without its faint modes, or of more shapes"
        )
    scale = fitted.T_scan_model.scale / fitted.T_scan_fitted.scale
    if abs(np.log(scale)) > _OTHER_SCALE:
        found.append(
            f"projected onto the model's own modes, the fitted surface would be {scale:.3g} times as large as it is"
        )
    own = fitted.T_scan_fitted.inverse()
    told = (own @ fitted.T_scan_model).apply(model.reconstruct(fitted.b))
    away_mm = float(np.sqrt(((own.apply(fitted.vertices_scan_mm) - told) ** 2).sum(axis=1).mean()))
    if away_mm > _MOVED_AWAY * fitted.outside_mm + _LEAST_MOVED_SHARE * ended.size_mm:
        found.append(
            f"projected onto the model's own modes, the surface moves {away_mm:.2g} mm away from the fitted one"
        )
    dense = ended.stages.get("dense")
    if dense is not None and dense.moved_mm > _DENSE_MOVED_SHARE * ended.size_mm:
        found.append(
            f"to follow the scan, the dense surface moved by {dense.moved_mm:.2g} mm along its normals, more than the "
            "model should lack, so its vertices may lie in other places than those that correspond"
        )
    return found
