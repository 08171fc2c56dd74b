"""Several structures of one subject: the correspondences of the parts, joined to one surface per specimen.

All vertices stay in the frame of the scans, so that the relative pose of the parts is kept. A specimen whose parts
do not belong together is doubtful: parts on different sides, in different units, exchanged, or in an unusual
relative pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, replace
from functools import cache
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from shapespace.correspondence.correspondence_result import ENOUGH_TO_COMPARE, Correspondence, Corresponding
from shapespace.correspondence.odd_scans import ScanMeasures
from shapespace.correspondence.scan_status import SurfaceMeasures
from shapespace.correspondence.settings import FEWEST, SIZE
from shapespace.errors import InputError
from shapespace.geometry.articulation import Articulation, articulate
from shapespace.geometry.contact import find_penetrations
from shapespace.geometry.mirror_plane import FLIP, mirror_image
from shapespace.geometry.normals import faces_of, rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.reprs import first_names
from shapespace.types import FloatArray, Mesh, Similarity, SurfaceLandmarks

_TO_STDDEV = 1.4826  # MAD to standard deviation of a normal distribution: 1 / 0.6745
_FALSE_RATE = 0.05
"""Share of collections without odd specimens in which one is found by chance, for values with a Laplace distribution:
sizes and poses multiply, so relative poses have longer tails than normal values. Of 100 collections each of 6, 12, 20
and 40 simulated limbs 5 %, none, 2 % and 1 % had a false finding, and an error of 100 mm with a random rotation was
found in 92 % or more (benchmarks/structures.py); with normal values 7, 16, 24 and 55 % had one."""
_SIMULATED = 400  # collections that determine the limit of unusual values
_NO_FRAME = 0.01  # rate at which rotations without any common relative pose are taken for such with one
_INSIDE = 0.05
"""Depth of a part inside another, share of the size, from which on it is noted: noise, smoothing and a contact that is
a little too close lead to 3 % in simulated knees, and to 4 % in hippocampi of two parts with a common boundary."""
_SAME_POSE = 1e-6  # spread of relative poses below which all are equal, rad and mm


def join_parts(parts: Mapping[str, Correspondence], *, doubts: Mapping[str, str] | None = None) -> Correspondence:
    """Join the correspondences of several parts, such as the bones of a joint, to one surface for each specimen.

    Args:
        parts: correspondence of each part by name, with scans of one name for one specimen, in one frame.
        doubts: further reasons why specimens are doubtful, by name.

    Returns:
        The correspondence of the specimens, with `Correspondence.parts`. A part without a scan is not observed: its
        vertices are those of the mean. A specimen with an excluded part is excluded.

    Raises:
        InputError: fewer than two parts, or fewer than two specimens that have all parts.

    Example:
        >>> config = ss.CorrespondConfig(vertices=200, rounds=1, mirror="never")
        >>> correspondence = ss.correspond(meshes[:3], config)
        >>> list(ss.correspondence.join_parts({"left": correspondence, "right": correspondence}).parts)
        ['left', 'right']
    """
    if len(parts) < 2:
        raise InputError(f"Parts are the structures of one subject, two or more, not {len(parts)}; give each part.")
    joint = _PartScans(_on_one_side(parts), doubts or {})
    counts = list(joint.counts.values())
    poses = _PoseCheck(joint)
    doubtful = poses.doubts()
    usable = [name for name in joint.complete if name not in doubtful] or joint.complete
    mean = poses.articulation.template if len(usable) == len(joint.complete) else joint.mean_of(usable, counts).template
    centre, scale = mean.mean(axis=0), SIZE / rms_size(mean)
    template = Mesh(Similarity(scale, np.eye(3), -scale * centre).apply(mean), joint.faces, name="mean")
    scans = [joint.joined(name, template.vertices, doubtful.get(name, "")) for name in joint.names]
    known = [scan.T_scan_template.scale / scan.unit_ratio for scan in scans if scan.T_scan_template is not None]
    scans = [
        scan
        if scan.T_scan_template is None
        else replace(scan, scale=scan.T_scan_template.scale / scan.unit_ratio / float(np.median(known)))
        for scan in scans
    ]
    every = list(joint.parts.values())
    return Correspondence(
        template, tuple(scans),
        " ".join(f"{part}: {own.why}" for part, own in joint.parts.items()),
        (max(own.moved[-1] for own in every),) if all(own.moved for own in every) else (),
        joint.landmarks, any(own.sides_decided for own in every), parts=joint.counts,
        remarks=(*joint.remarks(), *poses.remarks()),
    )  # fmt: skip


def find_exchanged(measures: Mapping[str, Mapping[str, ScanMeasures]]) -> dict[str, str]:
    """Return the specimens two of whose parts are exchanged, with the reason.

    The distances between points of each scan are compared with the medians of both parts: the difference of two parts
    of a specimen, projected on that of the medians, is the same for all specimens except for variation.

    Args:
        measures: measures of the scans, by part and specimen.
    """
    found: dict[str, str] = {}
    for a, b in combinations(measures, 2):
        names = [name for name in measures[a] if name in measures[b]]
        if len(names) < ENOUGH_TO_COMPARE:
            continue
        first, second = (
            np.stack([measures[part][name].size * measures[part][name].profile for name in names]) for part in (a, b)
        )
        agreement = (first - second) @ (np.median(first, axis=0) - np.median(second, axis=0))
        odd = (robust_z(agreement) > outlier_limit(len(names), 1)) & (agreement < 0)
        reason = f"{a} and {b} are probably exchanged: each is more like the other part of the other specimens"
        found |= {names[k]: reason for k in np.flatnonzero(odd)}
    return found


def robust_z(values: FloatArray) -> FloatArray:
    """Return the distances of `values` (N, ...) from their median along the first axis, in robust standard deviations.

    Not-a-number is ignored, and remains.
    """
    off = np.abs(values - np.nanmedian(values, axis=0))
    return off / np.maximum(_TO_STDDEV * np.nanmedian(off, axis=0), _SAME_POSE)


@cache
def outlier_limit(count: int, columns: int) -> float:
    """Return the limit that 5 % of the maxima of `robust_z` of Laplace values (count, columns) exceed."""
    rng = np.random.default_rng(0)
    largest = [float(robust_z(rng.laplace(size=(count, columns))).max()) for _ in range(_SIMULATED)]
    return float(np.quantile(largest, 1 - _FALSE_RATE))


def _on_one_side(parts: Mapping[str, Correspondence]) -> dict[str, Correspondence]:
    """Return the correspondences, with those reflected that are on the other side than the first in most specimens."""
    sides = {part: {scan.name: scan.mirrored for scan in own.scans if not scan.reason} for part, own in parts.items()}
    reference = next((part for part, own in parts.items() if own.sides_decided), "")
    on_one_side = dict(parts)
    for part, own in parts.items():
        shared = [name for name in sides[part] if name in sides.get(reference, {})]
        other = sum(sides[part][name] != sides[reference][name] for name in shared)
        if own.sides_decided and 2 * other > len(shared):
            scans = tuple(scan if scan.reason else replace(scan, mirrored=not scan.mirrored) for scan in own.scans)
            on_one_side[part] = replace(own, template=mirror_image(own.template), scans=scans)
    return on_one_side


def _sides_of_specimens(parts: Mapping[str, Correspondence]) -> dict[str, bool]:
    """Return whether most parts of each specimen are mirror images; doubtful parts count only if all are doubtful."""
    votes: dict[str, list[tuple[bool, bool]]] = {scan.name: [] for own in parts.values() for scan in own.scans}
    for own in parts.values():
        for scan in own.scans:
            if own.sides_decided and not scan.reason:
                votes[scan.name].append((bool(scan.doubt), scan.mirrored))
    sides = {name: [side for doubtful, side in own if doubtful == min(own)[0]] for name, own in votes.items()}
    return {name: 2 * sum(own) + (own or [False])[0] > len(own) for name, own in sides.items()}


def find_wrong_sides(parts: Mapping[str, Correspondence]) -> dict[str, frozenset[str]]:
    """Return the parts with scans that may be on a wrong side, and the specimens that are mirrored by all their parts.

    A scan that is on another side than the other parts of its specimen may be on the wrong side if its surface is
    doubtful, or if the sides of its part were not decided. Otherwise it shows the other side of a body.

    Args:
        parts: correspondence of each part by name, with scans of one name for one specimen.
    """
    parts = _on_one_side(parts)
    sides = _sides_of_specimens(parts)
    mirrored = frozenset(name for name, side in sides.items() if side)
    return {
        part: mirrored
        for part, own in parts.items()
        if any(
            scan.mirrored != sides[scan.name] and (scan.doubt or not own.sides_decided)
            for scan in own.scans
            if not scan.reason
        )
    }


class _PartScans:
    """The scans of all parts by specimen."""

    def __init__(self, parts: Mapping[str, Correspondence], doubts: Mapping[str, str]) -> None:
        self.parts = parts
        self.counts = {part: len(own.template.vertices) for part, own in parts.items()}
        self.names = list(dict.fromkeys(scan.name for own in parts.values() for scan in own.scans))
        by_part = {part: {scan.name: scan for scan in own.scans} for part, own in parts.items()}
        self.scans = {name: {part: own[name] for part, own in by_part.items() if name in own} for name in self.names}
        self.present = {
            name: [part for part, scan in own.items() if scan.vertices is not None] for name, own in self.scans.items()
        }
        self._doubts = {name: [doubts[name]] if name in doubts else [] for name in self.names}
        self.mirrored = _sides_of_specimens(parts)
        for name in self.names:
            self._doubt_sides(name)
            self._doubt_units(name)
        self.complete = self._find_complete()
        starts = dict(zip(parts, np.cumsum([0, *self.counts.values()]).tolist(), strict=False))
        self._rows = {part: np.arange(count, dtype=np.int32) + starts[part] for part, count in self.counts.items()}
        faces = [faces_of(own.template) + starts[part] for part, own in parts.items()]
        self.faces = np.concatenate(faces).astype(np.int32)
        every = [name for own in parts.values() for name in own.landmarks.names]
        self.landmarks = SurfaceLandmarks().joined(
            *(
                replace(
                    own.landmarks,
                    names=tuple(f"{part}_{name}" if every.count(name) > 1 else name for name in own.landmarks.names),
                    corners=own.landmarks.corners + starts[part],
                )
                for part, own in parts.items()
            )
        )

    def _doubt_sides(self, name: str) -> None:
        own, mirrored = self.scans[name], self.mirrored[name]
        if other := [part for part in self.present[name] if own[part].mirrored != mirrored]:
            is_image = ("is", "are not") if own[other[0]].mirrored else ("is not", "are")
            self._doubts[name].append(
                f"{' and '.join(other)} {is_image[0]} a mirror image of the majority and its other parts {is_image[1]}"
            )

    def _doubt_units(self, name: str) -> None:
        ratios = {part: self.scans[name][part].unit_ratio for part in self.present[name]}
        if len(set(ratios.values())) > 1:
            of = ", ".join(f"{part} {ratio:g}" for part, ratio in ratios.items())
            self._doubts[name].append(f"its parts are in different units (coordinates relative to the others: {of})")

    def _find_complete(self) -> list[str]:
        """Return the specimens with all parts, those without a doubt if there are enough.

        Raises:
            InputError: fewer than two.
        """
        every = [name for name in self.names if len(self.present[name]) == len(self.parts)]
        if len(every) < FEWEST:
            of = "; ".join(
                f"{part}: {first_names([n for n in self.names if part in self.present[n]], 3) or 'none'}"
                for part in self.parts
            )
            raise InputError(
                f"{len(every)} specimens have a surface of each part, and the mean relative pose needs {FEWEST} "
                f"({of}); name the scans of one specimen alike."
            )
        certain = [
            name for name in every if not self._doubts[name] and not any(s.doubt for s in self.scans[name].values())
        ]
        return certain if len(certain) >= FEWEST else every

    def vertices(self, name: str) -> FloatArray:
        """Return the vertices (V, 3) of a specimen on the side of the majority; not-a-number for parts without any."""
        flip = FLIP if self.mirrored[name] else 1.0
        vertices = np.full((sum(self.counts.values()), 3), np.nan)
        for part, own in zip(self.parts, np.split(vertices, np.cumsum([*self.counts.values()])[:-1]), strict=True):
            if part in self.present[name]:
                own[:] = self.scans[name][part].vertices
        return vertices * flip

    def mean_of(self, names: Sequence[str], counts: Sequence[int]) -> Articulation:
        """Return the mean of specimens with all parts, in their mean relative pose."""
        return articulate(np.stack([self.vertices(name) for name in names]), counts, "shape")[0]

    def placed(self, name: str, mean: FloatArray) -> tuple[FloatArray, Similarity]:
        """Return the vertices of a specimen with missing parts at their place on the mean, and the pose of the mean."""
        vertices = self.vertices(name)
        there = np.isfinite(vertices[:, 0])
        T = fit_similarity(mean[there], vertices[there])
        return np.where(there[:, None], vertices, T.apply(mean)), T

    def joined(self, name: str, mean: FloatArray, doubt: str) -> Corresponding:
        """Return the joined scan of a specimen; `doubt` is about its relative pose."""
        own = self.scans[name]
        missing = " and ".join(part for part in self.parts if part not in own)
        notes = [f"{part}: {sentence}" for part, scan in own.items() for sentence in scan.notes]
        notes += [f"It has no scan of {missing}."] if missing else []
        if excluded := [f"{part}: {scan.reason}" for part, scan in own.items() if scan.reason]:
            return Corresponding(name, "; ".join([*self._doubts[name], *excluded]), notes=tuple(notes))
        vertices, T = self.placed(name, mean)
        inside = find_penetrations(Mesh(vertices, self.faces), self._rows)
        notes += [
            f"{found.part} is up to {found.depth_mm:.3g} (unit of the scan) inside {found.other}, which parts of a "
            "subject are not; check that their scans are in one frame."
            for found in inside[:1]
            if {found.part, found.other} <= {*self.present[name]} and found.depth_mm > _INSIDE * SIZE * T.scale
        ]
        of_parts = [f"{part}: {scan.doubt}" for part, scan in own.items() if scan.doubt]
        doubts = [*self._doubts[name], *([doubt] if doubt else []), *of_parts]
        scans, weights = list(own.values()), [self.counts[part] for part in own]

        def average(values: Sequence[float | None]) -> float:
            return float(np.average([np.nan if value is None else value for value in values], weights=weights))

        observed = [
            np.zeros(count, np.bool_) if part not in own
            else np.ones(count, np.bool_) if (mask := own[part].observed) is None else mask
            for part, count in self.counts.items()
        ]  # fmt: skip
        std = [scan.position_std for scan in scans if scan.position_std is not None]
        area = average([scan.area_share for scan in scans])
        p95, p99, largest = np.max([scan.distance[1:] for scan in scans], axis=0).tolist()
        worst = np.max([astuple(scan.measures) for scan in scans if scan.measures is not None], axis=0).tolist()
        reasons = sorted((reason for scan in scans for reason in scan.review), key=lambda reason: reason.excess)
        return Corresponding(
            name, "", vertices * (FLIP if self.mirrored[name] else 1.0), T,
            seen=average([scan.seen for scan in scans]) * sum(weights) / len(vertices),
            covered=average([scan.covered for scan in scans]),
            distance=(average([scan.distance[0] for scan in scans]), p95, p99, largest),
            moved=(max(scan.moved[-1] for scan in scans),) if all(scan.moved for scan in scans) else (),
            seconds=(sum(sum(scan.seconds) for scan in scans),),
            landmarks=max((scan.landmarks for scan in scans if np.isfinite(scan.landmarks)), default=np.nan),
            observed=np.concatenate(observed), mirrored=self.mirrored[name],
            status="doubtful" if doubts else "converged", doubt="; ".join(doubts),
            probability=min(scan.probability for scan in scans),
            position_std=np.concatenate(std) if len(std) == len(self.parts) else None,
            measures=SurfaceMeasures(**dict(zip(SurfaceMeasures.__annotations__, worst, strict=True))),
            review=tuple(reversed({reason.code: reason for reason in reasons}.values())),
            notes=tuple(notes), unit_ratio=scans[0].unit_ratio, area_share=area if np.isfinite(area) else None,
        )  # fmt: skip

    def remarks(self) -> list[str]:
        """Return a sentence on parts that some specimens lack."""
        count = {part: sum(part in own for own in self.scans.values()) for part in self.parts}
        if min(count.values()) == len(self.names):
            return []
        of = ", ".join(f"{part} {number}" for part, number in count.items())
        return [
            f"Of {len(self.names)} specimens some lack a part ({of}); the vertices of missing parts are not observed."
        ]


class _PoseCheck:
    """Relative poses and sizes of the parts of all specimens, and those that are unlike the others."""

    def __init__(self, joint: _PartScans) -> None:
        counts = list(joint.counts.values())
        self._joint, self.articulation = joint, joint.mean_of(joint.complete, counts)
        self._names = [name for name in joint.names if len(joint.present[name]) > 1]
        joints, labels = self.articulation.joints, list(joint.counts)
        self._pairs = [(labels[j.part], labels[j.parent]) for j in joints]
        rows: list[FloatArray] = []
        for name in self._names:
            unit = joint.scans[name][joint.present[name][0]].unit_ratio
            vertices = joint.placed(name, self.articulation.template)[0] / unit
            poses = self.articulation.poses_of(vertices)
            sizes = [rms_size(vertices[s]) for s in self.articulation.slices]
            ratio = [np.log(sizes[j.part] / sizes[j.parent]) for j in joints]
            row = np.column_stack([poses.rotation, poses.translation, ratio])
            row[[not {*pair} <= {*joint.present[name]} for pair in self._pairs]] = np.nan
            rows.append(row)
        self._values = np.stack(rows)

    def doubts(self) -> dict[str, str]:
        """Return the specimens with an unusual relative pose or size, with the reason."""
        if len(self._names) < ENOUGH_TO_COMPARE:
            return {}
        z = robust_z(self._values)
        limit, middle = outlier_limit(len(z), z[0].size), np.nanmedian(self._values, axis=0)
        found: dict[str, str] = {}
        for k, name in enumerate(self._names):
            if not np.nanmax(z[k]) > limit:
                continue
            at, column = np.unravel_index(int(np.nanargmax(z[k])), z[k].shape)
            off, (part, parent) = self._values[k, at] - middle[at], self._pairs[at]
            how = (
                f"rotated by {np.rad2deg(np.linalg.norm(off[:3])):.3g} degrees from its usual pose" if column < 3
                else f"{np.linalg.norm(off[3:6]):.3g} (unit of most scans) from its usual place" if column < 6
                else f"{np.exp(off[6]):.3g} times as large as usual"
            )  # fmt: skip
            found[name] = (
                f"{part} relative to {parent} is {how}, {z[k, at, column]:.2g} robust standard deviations from the "
                f"other specimens (limit {limit:.2g}), so one of them may be of another subject, frame or unit"
            )
        return found

    def remarks(self) -> list[str]:
        """Return a sentence on each joint whose relative rotations are as different as random ones (Rayleigh test)."""
        sentences: list[str] = []
        for at, (part, parent) in enumerate(self._pairs):
            own = self._values[np.isfinite(self._values[:, at, 0]), at, :3]
            mean = Rotation.from_rotvec(own).as_matrix().mean(axis=0)
            if len(own) >= ENOUGH_TO_COMPARE and 3 * len(own) * (mean**2).sum() < chdtri(9, _NO_FRAME):
                sentences.append(
                    f"{part} has no common pose relative to {parent}, so their scans are probably not in one frame; "
                    "export the parts of a specimen in one frame, or build with --relative-pose removed."
                )
        return sentences
