"""Transfer of the landmarks of a few marked specimens to all specimens in dense correspondence, with 90 % regions.

A landmark of a marked specimen is a point of a triangle, and so has a position on every other surface. The positions
from all marked specimens are averaged with weights that fall with the squared shape distance. The expected squared
distance between the positions from specimens i and j is s_l^2 (D_ij^2 + `_LEAST_DISTANCE`^2), with the shape distance
D_ij and a factor s_l^2 for each landmark. This variogram gives the error variance of the weighted mean, as in kriging
(Cressie, Statistics for Spatial Data, 1993, section 3.2). s_l^2 is estimated from the marked specimens and shrunk to
the factor usual for the set, and this to `_USUAL_FACTOR`.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from shapespace.errors import InputError
from shapespace.geometry.landmark_placement import STRAY, place_landmarks
from shapespace.geometry.mirror_plane import FLIP
from shapespace.geometry.normals import rms_size
from shapespace.geometry.procrustes import align_to_weighted_mean
from shapespace.types import FloatArray, IntArray, Mesh, SurfaceLandmarks

_LEAST_DISTANCE = 0.01
"""Share of the size: landmarks of specimens of the same shape differ too."""
_USUAL_FACTOR, _FACTOR_DEGREES, _SET_DEGREES, _MEDIAN_TO_FACTOR = 0.25, 2.0, 1.0, 2.0
"""s^2 of the prior, its degrees of freedom for a landmark and for a set, and the ratio of the usual factor to a median;
the values with the best coverage on half of the landmarks of molars, femora and faces
(benchmarks/landmark_transfer.py; the other half is the test)."""
_OFF_SCAN, _WIDE = 0.05, 0.25
"""Shares of the size: distance of a landmark from the scan, and radius of its region, beyond which it is doubtful."""
_OUTLIER, _OUTLIER_REGIONS, _LEAST_ERROR, _ENOUGH = 4.0, 2.5, 0.02, 4
"""A landmark is an outlier beyond this multiple of the error usual for landmark and specimen, where at least `_ENOUGH`
specimens are marked, or this multiple of its 90 % region; but not below this share of the size."""
_SWAPPED = 0.5
"""Two landmarks are swapped if exchanging their names lowers the sum of their errors to this share or less."""


@dataclass(frozen=True, eq=False)
class TransferredLandmarks:
    """Landmarks predicted on one specimen, in the frame and unit of its surface.

    Args:
        specimen: name of the specimen.
        names: names of the L landmarks.
        positions: (L, 3) on the scan, or on the corresponding surface if no scan was given.
        radius_90: (L,) radius of the region on the surface that contains the true position with 90 % probability, in
            the unit of the surface; not-a-number if unknown.
        on_scan: the same positions in triangles of the scan; `distance_mm` is that to the corresponding surface.
        reasons: (L,) empty, or why the landmark is doubtful: `unobserved`, `off_scan` or `wide_region`.

    Example:
        >>> marked = {mesh.name: {"tip": mesh.vertices[7]} for mesh in meshes[:4]}
        >>> landmarks = ss.correspondence.MarkedSpecimens.of(meshes, marked).transfer("person 5")
        >>> bool(np.linalg.norm(landmarks.positions[0] - meshes[5].vertices[7]) < 1)
        True
    """

    specimen: str
    names: tuple[str, ...]
    positions: FloatArray
    radius_90: FloatArray
    on_scan: SurfaceLandmarks
    reasons: tuple[str, ...]

    @staticmethod
    def on(
        surface: Mesh, scan: Mesh | None, points: Mapping[str, FloatArray], radius_90: FloatArray, observed: FloatArray
    ) -> TransferredLandmarks:
        """Return `points` near a corresponding surface on its scan, or on itself.

        `observed` (L,) is the share of the surroundings of each point that the scan shows.
        """
        mesh, size = scan or surface, rms_size(surface.vertices)
        on_scan = place_landmarks(Mesh(mesh.vertices, mesh.faces, name=surface.name), points)
        reasons = tuple(
            "unobserved" if seen < 0.5 else "off_scan" if off > _OFF_SCAN * size else "wide_region" if wide else ""
            for seen, off, wide in zip(observed, on_scan.distance_mm, radius_90 > _WIDE * size, strict=True)
        )
        at = on_scan.interpolate(mesh.vertices)
        return TransferredLandmarks(surface.name, tuple(points), at, radius_90, on_scan, reasons)

    @property
    def status(self) -> str:
        """`converged`, or `doubtful` if any landmark is."""
        return "doubtful" if any(self.reasons) else "converged"


@dataclass(frozen=True)
class LandmarkCheck:
    """A given landmark compared with its prediction from all other marked specimens.

    Args:
        specimen: name of the specimen.
        landmark: name of the landmark.
        error: distance from the prediction, in the unit of the specimen.
        error_share: the same as a share of the specimen's RMS size.
        radius_90: radius of the 90 % region of the prediction.
        distance: distance of the given point from the specimen's surface.
        finding: empty, `outlier`, or `swapped with NAME`.

    Example:
        >>> marked = {mesh.name: {"tip": mesh.vertices[7], "eye": mesh.vertices[99]} for mesh in meshes}
        >>> checks = ss.correspondence.MarkedSpecimens.of(meshes, marked).check()
        >>> max(check.error for check in checks) < 1
        True
    """

    specimen: str
    landmark: str
    error: float
    error_share: float
    radius_90: float
    distance: float
    finding: str = ""


@dataclass(frozen=True, eq=False)
class MarkedSpecimens:
    """Specimens in correspondence, of which some have landmarks.

    Args:
        surfaces: N meshes with the same vertices, each in its own frame and unit, with different names.
        landmarks: index of a marked specimen -> its landmarks on its surface.
        distance: (N, N) shape distance: RMS distance of the aligned surfaces, as a share of the RMS size.
        mean: (V, 3) mean shape, of RMS size 1.

    Example:
        >>> marked = {mesh.name: {"tip": mesh.vertices[7]} for mesh in meshes[:4]}
        >>> specimens = ss.correspondence.MarkedSpecimens.of(meshes, marked)
        >>> sorted(specimens.landmarks)
        [0, 1, 2, 3]
    """

    surfaces: tuple[Mesh, ...]
    landmarks: Mapping[int, SurfaceLandmarks]
    distance: FloatArray
    mean: FloatArray

    @staticmethod
    def of(
        surfaces: Sequence[Mesh], marked: Mapping[str, Mapping[str, FloatArray]], mirrored: Collection[str] = ()
    ) -> MarkedSpecimens:
        """Return the specimens with `marked` landmarks placed on their surfaces.

        Args:
            surfaces: meshes in correspondence, see `Correspondence.meshes`.
            marked: name of a surface -> name of a landmark -> (3,) in the frame of that surface.
            mirrored: names of the surfaces that are mirror images of the others.

        Raises:
            InputError: surfaces that are not in correspondence, or landmarks that lie far off their surface.
        """
        index = {mesh.name: i for i, mesh in enumerate(surfaces)}
        if len(index) < len(surfaces) or len({len(mesh.vertices) for mesh in surfaces}) != 1 or len(surfaces) < 2:
            raise InputError("Landmarks are transferred between two or more surfaces in correspondence with own names.")
        if unknown := [name for name in marked if name not in index]:
            raise InputError(f"No surface is named {unknown[0]}; name the landmarks as the surfaces.")
        shapes = np.stack([m.vertices * (FLIP if m.name in mirrored else 1.0) for m in surfaces])
        if not np.isfinite(shapes).all():
            raise InputError("A corresponding surface has missing vertices; run shapespace correspond again.")
        aligned, mean = align_to_weighted_mean(shapes, np.ones(shapes.shape[:2]), shapes[0])
        size = rms_size(mean)
        flat = aligned.reshape(len(shapes), -1) / (size * np.sqrt(shapes.shape[1]))
        distance = np.stack([np.linalg.norm(flat - shape, axis=1) for shape in flat])
        placed: dict[int, SurfaceLandmarks] = {}
        for name, points in marked.items():
            mesh = surfaces[index[name]]
            on = placed[index[name]] = place_landmarks(Mesh(mesh.vertices, mesh.faces, name=name), points)
            limit = STRAY * rms_size(mesh.vertices)
            if far := [n for n, off in zip(on.names, on.distance_mm, strict=True) if off > limit]:
                raise InputError(
                    f"{name}: landmark {far[0]!r} lies {max(on.distance_mm) / limit * STRAY:.2g} sizes off the surface"
                    f" ({len(far)} of {len(on)} do); the landmarks are of another specimen or in another frame."
                )
        return MarkedSpecimens(tuple(surfaces), placed, distance, mean / size)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all landmarks, those of the first marked specimen first."""
        return tuple(dict.fromkeys(name for landmarks in self.landmarks.values() for name in landmarks.names))

    def transfer(self, specimen: str, scan: Mesh | None = None) -> TransferredLandmarks:
        """Predict the landmarks of a specimen from all other marked specimens.

        Args:
            specimen: name of its surface.
            scan: scan in the frame of the surface; without it positions are on the corresponding surface.

        Raises:
            InputError: no specimen of that name, or no other marked specimen.
            MeshError: the scan has no vertices.
        """
        target = next((i for i, mesh in enumerate(self.surfaces) if mesh.name == specimen), None)
        sources = {i: marks for i, marks in self.landmarks.items() if i != target}
        if target is None or not sources:
            raise InputError(
                f"{specimen}: no surface has this name, or no other specimen is marked; mark another specimen."
            )
        surface = self.surfaces[target]
        size = rms_size(surface.vertices)
        names = [name for name in self.names if any(name in marks.names for marks in sources.values())]
        used = {name: np.array([i for i, marks in sources.items() if name in marks.names]) for name in names}
        factors, degrees = self._factors(used)
        positions, radius, observed = np.empty((len(names), 3)), np.empty(len(names)), np.empty(len(names))
        mask = np.ones(len(surface.vertices)) if surface.observed is None else surface.observed.astype(np.float64)
        for row, (name, rows) in enumerate(used.items()):
            to_target = self.distance[target, rows] ** 2 + _LEAST_DISTANCE**2
            weights = 1.0 / to_target / (1.0 / to_target).sum()
            on = [sources[i].select([name]) for i in rows]
            positions[row] = weights @ np.concatenate([landmark.interpolate(surface.vertices) for landmark in on])
            observed[row] = weights @ np.concatenate([landmark.interpolate(mask) for landmark in on])
            variance = factors[row] * (weights @ to_target - 0.5 * weights @ self._variogram(rows) @ weights)
            # The 90 % quantile of F with 2 and `degrees` degrees of freedom, for an isotropic error on the surface.
            quantile = 0.5 * degrees[row] * (0.1 ** (-2.0 / degrees[row]) - 1.0)
            radius[row] = size * np.sqrt(variance * quantile)
        return TransferredLandmarks.on(surface, scan, dict(zip(names, positions, strict=True)), radius, observed)

    def check(self) -> list[LandmarkCheck]:
        """Predict each marked specimen from the others, and name the given landmarks that contradict the prediction.

        Raises:
            InputError: fewer than two specimens are marked.
        """
        if len(self.landmarks) < 2:
            raise InputError("A check compares marked specimens with each other; mark at least two.")
        checks: list[LandmarkCheck] = []
        for i, marks in self.landmarks.items():
            mesh, predicted = self.surfaces[i], self.transfer(self.surfaces[i].name)
            size, there = rms_size(mesh.vertices), [n for n in marks.names if n in predicted.names]
            rows = [predicted.names.index(n) for n in there]
            given = marks.select(there)
            apart = np.linalg.norm(
                given.interpolate(mesh.vertices)[:, None] - predicted.positions[rows][None], axis=2
            ).reshape(len(there), len(there))
            swapped = _find_swapped(apart)
            for k, name in enumerate(there):
                error, radius = float(apart[k, k]), float(predicted.radius_90[rows[k]])
                finding = f"swapped with {there[swapped[k]]}" if k in swapped else ""
                if not finding and error > max(_OUTLIER_REGIONS * radius, _LEAST_ERROR * size):
                    finding = "outlier"
                off = float(given.distance_mm[k])
                checks.append(LandmarkCheck(mesh.name, name, error, error / size, radius, off, finding))
        return _mark_outliers(checks, len(self.landmarks))

    def suggest(self, count: int = 5) -> list[tuple[str, float]]:
        """Return the specimens to mark next, best first, each given those before it.

        Errors grow with the shape distance to the nearest marked specimen. The best specimen lowers the mean of this
        distance over all specimens most; without marked specimens it is the medoid.

        Returns:
            (name, mean distance to the nearest marked specimen once it is marked, as a share of the size).
        """
        marked = list(self.landmarks)
        nearest = self.distance[:, marked].min(axis=1) if marked else np.full(len(self.surfaces), np.inf)
        chosen: list[tuple[str, float]] = []
        for _ in range(min(count, len(self.surfaces) - len(marked))):
            means = np.minimum(nearest[:, None], self.distance).mean(axis=0)
            means[marked] = np.inf
            best = int(means.argmin())
            nearest = np.minimum(nearest, self.distance[best])
            marked.append(best)
            chosen.append((self.surfaces[best].name, float(means[best])))
        return chosen

    def _variogram(self, rows: IntArray) -> FloatArray:
        """Return (m, m) the variogram without its factor."""
        squared = self.distance[np.ix_(rows, rows)] ** 2 + _LEAST_DISTANCE**2
        np.fill_diagonal(squared, 0.0)
        return squared

    def _factors(self, used: Mapping[str, IntArray]) -> tuple[FloatArray, FloatArray]:
        """Return (L,) s_l^2 of each landmark and its degrees of freedom."""
        degrees = np.array([len(rows) - 1.0 for rows in used.values()])
        ratios = np.zeros(len(used))
        for k, (name, rows) in enumerate(used.items()):
            if len(rows) > 1:
                at = np.concatenate([self.landmarks[i].select([name]).interpolate(self.mean) for i in rows])
                first, second = np.triu_indices(len(rows), 1)
                squared = ((at[first] - at[second]) ** 2).sum(axis=1)
                ratios[k] = (squared / self._variogram(rows)[first, second]).mean()
        usual, several = _USUAL_FACTOR, ratios > 0
        if several.any():
            n = float(np.median(degrees[several]))
            estimate = np.log(_MEDIAN_TO_FACTOR * np.median(ratios[several]))
            usual = np.exp((_SET_DEGREES * np.log(_USUAL_FACTOR) + n * estimate) / (_SET_DEGREES + n))
        total = _FACTOR_DEGREES + degrees
        return (_FACTOR_DEGREES * usual + degrees * ratios) / total, total


def _find_swapped(apart: FloatArray) -> dict[int, int]:
    """Return index -> index of landmarks whose names are exchanged.

    Args:
        apart: (L, L) distance of each given landmark (row) from each predicted landmark (column).
    """
    straight = apart.diagonal()[:, None] + apart.diagonal()[None]
    ratio = np.where(straight > 0, (apart + apart.T) / np.maximum(straight, 1e-300), 1.0)
    np.fill_diagonal(ratio, 1.0)
    best = ratio.argmin(axis=1)
    return {k: int(j) for k, j in enumerate(best) if ratio[k, j] <= _SWAPPED and best[j] == k}


def _mark_outliers(checks: Sequence[LandmarkCheck], specimens: int) -> list[LandmarkCheck]:
    """Return `checks`, marking as outliers those whose errors are far beyond those of the landmark and the specimen."""
    if specimens < _ENOUGH:
        return list(checks)
    share = np.array([check.error_share for check in checks])

    def medians(keys: Sequence[str]) -> FloatArray:
        array = np.array(keys)
        return np.array([np.median(share[array == key]) for key in keys])

    of_specimen, of_landmark = medians([c.specimen for c in checks]), medians([c.landmark for c in checks])
    usual = of_specimen * of_landmark / max(float(np.median(share)), 1e-300)
    is_outlier = share > np.maximum(_OUTLIER * usual, _LEAST_ERROR)
    return [
        replace(check, finding="outlier") if outlier and not check.finding else check
        for check, outlier in zip(checks, is_outlier, strict=True)
    ]
