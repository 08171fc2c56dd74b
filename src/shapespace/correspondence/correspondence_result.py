"""The result of a correspondence: one surface for each scan, or the reason why the scan is excluded.

`judge_collection` finds sizes, units and unusual surfaces of scans by comparison with the other scans.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from shapespace.correspondence.scan_status import ScanStatus, SurfaceEvidence, SurfaceMeasures, find_review_reasons
from shapespace.errors import InputError
from shapespace.geometry.mirror_plane import FLIP
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.lazy import lazy_import
from shapespace.reprs import describe_groups, first_names, short_repr
from shapespace.schemas import ReviewCode, ReviewReason
from shapespace.types import MM_PER_UNIT, BoolArray, FloatArray, Mesh, Similarity, SurfaceLandmarks

ANOTHER_SHAPE = 0.25
"""Change of the template, as a share of its size, from which on it is another object."""
_LISTED = 10  # names or notes in the notes, so that they stay readable


@dataclass(frozen=True, eq=False)
class Corresponding:
    """One scan after the last round.

    Args:
        name: name of the scan.
        reason: why the scan is excluded; empty if it is not.
        status: converged, doubtful or excluded.
        probability: probability that the surface is right, from its evidence; not-a-number if excluded.
        doubt: why the scan is doubtful; empty if it is not.
        evidence: comparison of the surface with the shapes of the other scans; None if excluded.
        vertices: (V, 3) vertices in the scan's own frame and unit, finite everywhere: where the scan shows nothing they
            are estimates, the conditional means given the observed vertices; None if excluded.
        T_scan_template: similarity from the template's frame to the scan's own frame, or to that of its mirror image;
            None if no pose was found.
        mirrored: whether the scan is a mirror image of the majority; `vertices` are in its own frame nevertheless.
        seen: share of the template's vertices that the scan observes.
        covered: share of the scan that the template covers.
        distance: (4,) mean, 95 %, 99 % and largest distance both ways over the overlap, in the scan's unit.
        moved: RMS movement of its vertices in each round, shares of its size.
        seconds: CPU time of each round.
        landmarks: RMS distance of the scan's landmarks from their positions on the surface, in the scan's unit;
            not-a-number without landmarks.
        observed: (V,) bool, False where `vertices` are estimates; None if excluded.
        position_std: (V,) standard deviation of each vertex's position in any direction along the surface, in the
            scan's unit: with 90 % probability the position is within 2.15 times it; None if excluded.
        measures: measures of the quality of the surface; None if excluded.
        review: reasons to review the surface, in addition to `doubt`, by its measures; the most unusual first. Empty
            for scans that were added to a finished correspondence without the results of its scans.
        notes: sentences on the repairs of the scan and on its landmarks, such as that they were rotated by a half turn,
            on copies of other scans, and on unusual sizes and surfaces.
        scale: size relative to the usual size, with units converted; not-a-number if excluded.
        unit_ratio: ratio of its unit to the unit of most scans, in terms of coordinates, such as 0.001 for metres
            among millimetres.
        area_share: ratio of the area of the surface to that of the scan; None if excluded, and for points.

    Example:
        >>> correspondence = ss.correspond(meshes[:3], ss.CorrespondConfig(vertices=200, rounds=1, mirror="never"))
        >>> correspondence.scans[0].status
        'converged'
    """

    name: str
    reason: str
    vertices: FloatArray | None = None
    T_scan_template: Similarity | None = None
    seen: float = 0.0
    covered: float = 0.0
    distance: tuple[float, float, float, float] = (np.nan, np.nan, np.nan, np.nan)
    moved: tuple[float, ...] = ()
    seconds: tuple[float, ...] = ()
    landmarks: float = np.nan
    observed: BoolArray | None = None
    mirrored: bool = False
    status: ScanStatus = "excluded"
    probability: float = np.nan
    doubt: str = ""
    evidence: SurfaceEvidence | None = None
    position_std: FloatArray | None = None
    measures: SurfaceMeasures | None = None
    review: tuple[ReviewReason, ...] = ()
    notes: Sequence[str] = ()
    scale: float = np.nan
    unit_ratio: float = 1.0
    area_share: float | None = None

    __repr__ = short_repr

    def noting(self, *sentences: str) -> Corresponding:
        """Return the scan with further notes."""
        return replace(self, notes=tuple(dict.fromkeys([*self.notes, *sentences])))

    @property
    def review_codes(self) -> list[ReviewCode]:
        """Codes of the reasons to review the surface; empty if it needs no review."""
        return [*(["doubtful"] if self.doubt else []), *(reason.code for reason in self.review)]


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Scans in correspondence.

    Args:
        template: mean shape of the last round, in mm of `SIZE`, with the landmarks of the scans.
        scans: results of the scans, in the given order.
        why: origin of the first template, in a sentence.
        moved: RMS movement in each round, share of the size.
        landmarks: landmarks of the scans, on each of the surfaces.
        sides_decided: whether scans could be distinguished from their mirror images; False for a symmetric object,
            and if they were not compared.
        groups: names of the scans in correspondence, then of those of each other kind of object; empty if all are of
            one kind.
        given: the given template or model, as a subject of a sentence; empty if none was given.
        parts: name -> number of vertices of each part, in the order of the vertices; empty for objects of one part.
        remarks: sentences on the parts.

    Example:
        >>> correspondence = ss.correspond(meshes[:3], ss.CorrespondConfig(vertices=200, rounds=1, mirror="never"))
        >>> len(correspondence.meshes()) == len(meshes[:3])
        True
    """

    template: Mesh
    scans: tuple[Corresponding, ...]
    why: str
    moved: tuple[float, ...]
    landmarks: SurfaceLandmarks = field(default_factory=SurfaceLandmarks)
    sides_decided: bool = False
    groups: tuple[tuple[str, ...], ...] = ()
    given: str = ""
    parts: Mapping[str, int] = field(default_factory=dict[str, int])
    remarks: tuple[str, ...] = ()

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        return lazy_import("html_of_correspondence")(self)

    @property
    def is_of_another_kind(self) -> bool:
        """Whether the first template, if it was given, is probably another object than the scans."""
        return bool(self.given) and self.moved[0] >= ANOTHER_SHAPE

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences to read before the surfaces are used; all notes on a scan are with the scan."""
        notes = list(self.remarks)
        if self.is_of_another_kind:
            notes.append(
                f"{self.given} had to change by {100 * self.moved[0]:.0f} % of its size to become these scans, so it "
                "is probably another kind of object; inspect the surfaces, or omit it."
            )
        if mirrored := [scan.name for scan in self.scans if scan.mirrored]:
            of = "scan is a mirror image" if len(mirrored) == 1 else "scans are mirror images"
            notes.append(
                f"{len(mirrored)} {of} of {self.given or 'the others'} ({first_names(mirrored, _LISTED)}) and "
                "reflected for the correspondence; surfaces are in the frames of their scans."
            )
        notes += [describe_groups(self.groups)] if self.groups else []
        noted = [f"{scan.name}: {' '.join(scan.notes)}" for scan in self.scans if scan.notes]
        notes += noted[:_LISTED]
        if len(noted) > _LISTED:
            notes.append(f"Notes on {len(noted) - _LISTED} more scans are in their records.")
        if others := [scan.name for scan in self.scans if scan.unit_ratio != 1.0]:
            noun = "scans is" if len(others) == 1 else "scans are"
            notes.append(
                f"{len(others)} of {len(self.scans)} {noun} in another unit than the majority, judging by size "
                f"({first_names(others, _LISTED)}); so are the surfaces, and build converts them to the unit of the "
                "majority."
            )
        return tuple(notes)

    def meshes(self) -> list[Mesh]:
        """Return the complete surfaces of scans that are not excluded, in their own frames, with `Mesh.observed`.

        They have the landmarks in whose triangles all vertices are observed. Surfaces of mirrored scans are reflected
        at the plane x = 0 of their frame, so that all have the same side.
        """
        return [
            self._mesh(scan, scan.vertices * (FLIP if scan.mirrored else 1.0))
            for scan in self.scans
            if scan.vertices is not None
        ]

    def with_sides(self, mirrored: Collection[str]) -> Correspondence:
        """Return this correspondence, of the mirror images of the scans that `mirrored` names, as that of the scans."""
        scans = [
            scan
            if scan.vertices is None or scan.name not in mirrored
            else replace(scan, mirrored=True, vertices=scan.vertices * FLIP)
            for scan in self.scans
        ]
        return replace(self, scans=tuple(scans), sides_decided=True)

    def _mesh(self, scan: Corresponding, vertices: FloatArray) -> Mesh:
        observed = np.ones(len(vertices), dtype=np.bool_) if scan.observed is None else scan.observed
        landmarks = self.landmarks.within(observed).positions(vertices)
        return Mesh(
            vertices, self.template.faces, landmarks, scan.name,
            observed=scan.observed, position_std=scan.position_std,
        )  # fmt: skip


_EQUAL = 1e-4
"""RMS distance, as a share of the size: the precision of coordinates stored as float32 far from the origin."""
LEAST_RATIO = 8.0
"""Ratio of sizes that two objects of one kind do not reach, so that a larger ratio is a ratio of units."""
_UNITS = np.array(list(MM_PER_UNIT.values()))
_RATIOS = np.unique((_UNITS[:, None] / _UNITS).ravel())
_RATIOS = _RATIOS[(_RATIOS == 1.0) | (np.abs(np.log(_RATIOS)) > np.log(LEAST_RATIO))]


def copies(scans: Sequence[Mesh]) -> dict[int, int]:
    """Return scans that are copies of earlier ones, in any pose and size: index of the copy -> index of the first."""
    first: dict[object, list[int]] = {}
    copy_of: dict[int, int] = {}
    for i, scan in enumerate(scans):
        alike = first.setdefault((len(scan.vertices), None if scan.faces is None else scan.faces.tobytes()), [])
        same = next((j for j in alike if _equal(scan, scans[j])), None)
        if same is None:
            alike.append(i)
        else:
            copy_of[i] = same
    return copy_of


def _equal(scan: Mesh, other: Mesh) -> bool:
    try:
        moved = fit_similarity(scan.vertices, other.vertices).apply(scan.vertices)
    except InputError:
        return np.array_equal(scan.vertices, other.vertices)
    rms = np.sqrt(((moved - other.vertices) ** 2).sum(axis=1).mean())
    return bool(rms < _EQUAL * rms_size(other.vertices))


def unit_ratios(scales: Sequence[float]) -> tuple[FloatArray, FloatArray]:
    """Return sizes and units relative to those of most scans.

    Args:
        scales: (N,) sizes of scans relative to one template.

    Returns:
        (N,) sizes relative to the median of most scans, in one unit, and (N,) ratios of the unit to that of most scans,
        in terms of coordinates, such as 0.001 for metres among millimetres; 1 for most.
    """
    logs: FloatArray = np.log(np.asarray(scales, dtype=np.float64))
    reach, ordered = 0.5 * float(np.log(LEAST_RATIO)), np.sort(logs)
    near = np.searchsorted(ordered, logs + reach) - np.searchsorted(ordered, logs - reach, side="right")
    # If two units are equally frequent, the smaller unit counts as usual.
    most = logs[np.lexsort((logs, near))[-1]]
    relative = logs - np.median(logs[np.abs(logs - most) < reach])
    ratios = _RATIOS[np.abs(relative[:, None] - np.log(_RATIOS)).argmin(axis=1)]
    return np.exp(relative) / ratios, ratios


OTHER_SIZE = 2.0  # ratio of sizes: beyond twice the median a scan is probably of another object or unit
ENOUGH_TO_COMPARE, _FAR = 4, 3.0
"""Ratio to the usual distance (95 % of both directions), relative to size, above which a surface is unusual."""


def judge_collection(
    scans: Sequence[Corresponding], settled: float, earlier: Sequence[Corresponding] = ()
) -> tuple[Corresponding, ...]:
    """Return the scans with sizes and units, the reasons to review their surfaces, and notes on unusual ones.

    Args:
        scans: scans of one correspondence.
        settled: a round is the last if it moves the vertices by less than this share of the size (RMS over all
            vertices).
        earlier: scans that were judged before, to which `scans` are added; they are not changed and not returned.
    """
    every = [*earlier, *_add_sizes(scans, earlier)]
    measured = [(k, scan.measures) for k, scan in enumerate(every) if scan.measures is not None]
    reasons = find_review_reasons([measures for _, measures in measured], settled)
    for (k, _), own in zip(measured, reasons, strict=True):
        every[k] = replace(every[k], review=tuple(own))
    # Point clouds are compared with each other, since their distances are those to points.
    far = np.array([(scan.distance[1] or np.nan) / (scan.scale * scan.unit_ratio) for scan in every])
    is_cloud = np.array([scan.area_share is None for scan in every])
    for alike in (is_cloud, ~is_cloud):
        if np.isfinite(far[alike]).sum() >= ENOUGH_TO_COMPARE:
            for k in np.flatnonzero(alike & (far / np.nanmedian(far[alike]) > _FAR)).tolist():
                times = far[k] / np.nanmedian(far[alike])
                every[k] = every[k].noting(
                    f"Its surface lies {times:.2g} times the usual distance from it; inspect it."
                )
    return tuple(every[len(earlier) :])


def _add_sizes(scans: Sequence[Corresponding], earlier: Sequence[Corresponding]) -> list[Corresponding]:
    """Return the scans with size and unit relative to the others, or to the scans that they are added to."""
    own = {k: scan.T_scan_template.scale for k, scan in enumerate(scans) if scan.T_scan_template is not None}
    usual = [scan.T_scan_template.scale / scan.unit_ratio for scan in earlier if scan.T_scan_template is not None]
    groups = [[k] for k in own] if usual else [list(own)]  # added scans do not depend on each other
    sized = list(scans)
    for group in groups if own else []:
        scales, ratios = unit_ratios([*usual, *usual, *(own[k] for k in group)])  # the others are most
        for k, scale, ratio in zip(group, scales[-len(group) :].tolist(), ratios[-len(group) :].tolist(), strict=True):
            sized[k] = replace(scans[k], scale=scale, unit_ratio=ratio)
            if not 1 / OTHER_SIZE < scale < OTHER_SIZE:
                sized[k] = sized[k].noting(
                    f"It is {scale:.2g} times as large as most; check whether it is the same kind of object."
                )
    return sized
