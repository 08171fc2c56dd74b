"""Reader of the output folder of `shapespace correspond`, for report, viewer and terminal, one surface at a time."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from msgspec import structs

from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.geometry.closest import build_engine
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import (
    boundary_edges,
    face_vectors,
    faces_of,
    observed_mask,
    rms_size,
    without_estimates,
)
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.files import read_error
from shapespace.report.blocks.wording import known, printable, sentence, without_folders
from shapespace.report.inputs.saved_fits import Folder, ScanNotFoundError, nice_ceiling, unchanged_scan
from shapespace.schemas import CORRESPOND_AGAIN, CorrespondenceRecord, CorrespondRecord, read
from shapespace.store.corresponding import describe_review
from shapespace.types import BoolArray, FloatArray, Mesh, Similarity, are_same_triangles

_FEWEST_VERTICES = 3  # a triangle
_ONE_UNIT = 5.0  # ratio of scales; mm, cm and m differ by 10 or more
_POSED_ALIKE = 0.8  # strength of the mean rotation above which the scans share a pose
_POSES = 24  # surfaces that determine the pose of the mean shape
_OPEN_SHARE = 0.15  # share of the area that faces one way in an open surface


@dataclass(frozen=True, eq=False)
class PlacedSurface:
    """One surface in the frame of the pictures.

    Args:
        vertices: (V, 3) in the frame of `Corresponded.mean`, size divided out; NaN where missing.
        T_scan_mean: transformation from that frame to the scan's own.
        position_std: (V,) `Mesh.position_std` as a share of the object's size; None if the file has none.
    """

    vertices: FloatArray
    T_scan_mean: Similarity
    position_std: FloatArray | None

    @property
    def seen(self) -> BoolArray:
        """(V,) mask of observed vertices."""
        return observed_mask(self.vertices)


@dataclass(frozen=True, eq=False)
class SurfacePopulation:
    """Summary of all readable surfaces.

    Args:
        names: names of the scans.
        seen_count: (V,) number of scans that show each vertex.
        sizes: (N,) RMS distance of the surfaces from their middle, in the scans' own units.
        unread: reasons by the names of the scans that cannot be read.
        position_std: (V,) RMS of `PlacedSurface.position_std` over the scans that show a vertex; None if a file has
            none.
    """

    names: tuple[str, ...]
    seen_count: npt.NDArray[np.int64]
    sizes: FloatArray
    unread: dict[str, str]
    position_std: FloatArray | None

    @property
    def position_std_limit(self) -> float:
        """End of a scale of `position_std`, percent: 98 % of the vertices are below it."""
        return 1.0 if self.position_std is None else nice_ceiling(100 * float(np.quantile(self.position_std, 0.98)))


class Corresponded:
    """Output folder of a correspondence.

    Args:
        folder: folder that `shapespace correspond` wrote.

    Raises:
        FileError: correspondence.json or the mean shape cannot be read.
        FileFormatError: correspondence.json or the mean shape is damaged.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = Folder(folder, CORRESPOND_AGAIN)
        summary = CorrespondenceRecord.FILE
        self.run = read(CorrespondenceRecord, self.folder.json(summary), summary, CORRESPOND_AGAIN)
        self._mean = self.folder.mesh(CorrespondenceRecord.MEAN)
        if self._mean.faces is None or not np.isfinite(self._mean.vertices).all():
            raise FileFormatError(f"{CorrespondenceRecord.MEAN} is not a complete surface; {CORRESPOND_AGAIN}.")
        if self.run.parts and sum(self.run.parts.values()) != len(self._mean.vertices):
            raise FileFormatError(
                f"{summary}: its parts do not have the vertices of the mean shape; {CORRESPOND_AGAIN}."
            )
        self.unread: dict[str, str] = {}
        self.records = {record.name: record for record in map(self._record, self._record_files()) if record is not None}
        self.turn = np.eye(3)
        self._is_upright = False
        self._population: SurfacePopulation | None = None

    @property
    def root(self) -> Path:
        """The folder."""
        return self.folder.root

    @property
    def mean(self) -> Mesh:
        """The mean shape, upright and centred at the origin, in the size of its file."""
        vertices = self._mean.vertices
        return self._mean.with_vertices((vertices - vertices.mean(axis=0)) @ self.turn.T)

    @property
    def holes(self) -> int:
        """Number of borders of the mean shape beyond the first, which an open surface may have."""
        from shapespace.geometry.topology import join, labels  # compiled

        edges = boundary_edges(faces_of(self._mean))
        sets = np.arange(len(self._mean.vertices), dtype=np.int32)
        join(sets, edges)
        return max(len(np.unique(labels(sets)[1][edges])) - 1, 0)

    @property
    def corresponding(self) -> list[CorrespondRecord]:
        """The records of scans in correspondence."""
        return [record for record in self.records.values() if not record.is_excluded]

    @property
    def set_aside(self) -> list[CorrespondRecord]:
        """Records of excluded scans."""
        return [record for record in self.records.values() if record.is_excluded]

    def surface(self, name: str) -> Mesh:
        """Return the surface of the scan `name` in its own frame and unit, NaN where it is not observed.

        That of a mirrored scan is reflected at x = 0, as `raw_scan` is.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged, or not on the template of this folder.
        """
        mesh = without_estimates(self.folder.mesh(f"{name}{CorrespondRecord.SURFACE}"))
        mesh = mirror_image(mesh) if self.records[name].mirrored else mesh
        if not are_same_triangles(mesh.faces, faces_of(self._mean)):
            raise FileFormatError(
                f"{name}{CorrespondRecord.SURFACE} is not on the template of this folder; {CORRESPOND_AGAIN}."
            )
        if observed_mask(mesh.vertices).sum() < _FEWEST_VERTICES:
            raise FileFormatError(
                f"{name}{CorrespondRecord.SURFACE} has fewer than {_FEWEST_VERTICES} vertices that are not missing; "
                f"{CORRESPOND_AGAIN}."
            )
        return replace(mesh, faces=self._mean.faces)

    def placed(self, name: str) -> PlacedSurface:
        """Return the surface of the scan `name` moved onto the mean shape.

        Raises:
            FileError: it cannot be read.
            FileFormatError: it is damaged, or not on the template of this folder.
        """
        surface = self.surface(name)
        vertices, std = surface.vertices, surface.position_std
        is_observed = observed_mask(vertices)
        try:
            T = fit_similarity(self.mean.vertices[is_observed], vertices[is_observed])
        except ShapespaceError as error:
            raise FileFormatError(
                f"{name}{CorrespondRecord.SURFACE} cannot be laid onto the mean shape; {CORRESPOND_AGAIN}."
            ) from error
        return PlacedSurface(
            np.where(is_observed[:, None], T.inverse().apply(vertices), np.nan),
            T,
            (None if std is None else std / (T.scale * rms_size(self._mean.vertices))),
        )

    def raw_scan(self, record: CorrespondRecord) -> Mesh:
        """Return the scan of a record, reflected if it is mirrored, if it is in the same place with the same content.

        Raises:
            ScanNotFoundError: the scan was moved or changed, or cannot be read.
        """
        if record.path and not record.hash:
            raise ScanNotFoundError(
                "each part has a scan of its own, which is in the report of the folder of the part."
                if self.run.parts
                else "the scan cannot be read."
            )
        scan = unchanged_scan(self.root, record.path, record.hash)
        return mirror_image(scan) if record.mirrored else scan

    def scan_on_mean(self, scan: Mesh, placed: PlacedSurface) -> tuple[Mesh, FloatArray]:
        """Return a scan moved onto the mean shape, and the distance (V,) of each vertex from it, share of the size."""
        moved = scan.with_vertices(placed.T_scan_mean.inverse().apply(scan.vertices))
        distance = np.full(len(placed.vertices), np.nan)
        distance[placed.seen] = build_engine(moved).query(placed.vertices[placed.seen]).distance
        return moved, distance / rms_size(self._mean.vertices)

    def turn_upright(self) -> None:
        """Bring the mean shape upright, by the poses of some of the surfaces."""
        if self._is_upright:
            return
        turns: list[FloatArray] = []
        for record in self._records_for_pose():
            with contextlib.suppress(ShapespaceError):  # `population` reports unreadable surfaces
                turns.append(self.placed(record.name).T_scan_mean.rotation)
        self._turn_by(turns)

    def _records_for_pose(self) -> list[CorrespondRecord]:
        """Return the records of the surfaces whose poses turn the mean shape upright."""
        return self.corresponding[:: max(1, len(self.corresponding) // _POSES)]

    def _turn_by(self, turns: Sequence[FloatArray]) -> None:
        self.turn, self._is_upright = upright(self._mean, turns), True

    def population(self, on_scan: Callable[[str], None] | None = None) -> SurfacePopulation:
        """Summarise all surfaces, and bring the mean shape upright; each surface is read once.

        Args:
            on_scan: called after each scan.
        """
        if self._population is None:
            turns, posed = list[FloatArray](), {record.name for record in self._records_for_pose()}
            counts = np.zeros(len(self._mean.vertices), dtype=np.int64)
            names: list[str] = []
            sizes: list[float] = []
            unread: dict[str, str] = {}
            size, squares = rms_size(self._mean.vertices), np.zeros(len(counts))
            for record in self.corresponding:
                try:
                    placed = self.placed(record.name)
                except ShapespaceError as error:
                    unread[record.name] = str(error)
                    continue
                finally:
                    if on_scan is not None:
                        on_scan(record.name)
                counts += placed.seen
                squares += np.nan if placed.position_std is None else placed.seen * placed.position_std**2
                names.append(record.name)
                sizes.append(placed.T_scan_mean.scale * size)
                if record.name in posed:
                    turns.append(placed.T_scan_mean.rotation)
            if not self._is_upright:
                self._turn_by(turns)
            self._population = SurfacePopulation(
                tuple(names),
                counts,
                np.array(sizes),
                unread,
                (np.sqrt(squares / np.maximum(counts, 1)) if names and np.isfinite(squares).all() else None),
            )
        return self._population

    @property
    def settled(self) -> float:
        """Convergence threshold: the largest movement in the last round, as a share of the size."""
        value = self.run.settings.get("settled")
        return float(value) if isinstance(value, int | float) else 0.0

    @property
    def units_mixed(self) -> bool:
        """Whether sizes differ so much that the scans must have different units."""
        scales = [record.scale for record in self.corresponding if record.scale]
        return bool(scales) and max(scales) > _ONE_UNIT * min(scales)

    def _record_files(self) -> list[str]:
        try:
            return sorted(path.name for path in self.root.iterdir() if path.name.endswith(CorrespondRecord.ENDING))
        except OSError as error:
            raise read_error(self.root, error) from error

    def _record(self, file: str) -> CorrespondRecord | None:
        name = file.removesuffix(CorrespondRecord.ENDING)
        try:
            record = read(CorrespondRecord, self.folder.json(file), file, CORRESPOND_AGAIN)
            if record.name != name:
                raise FileFormatError(f"{file} is the record of another scan, {record.name}; {CORRESPOND_AGAIN}.")
            if any(isinstance(value, float) and not 0 <= value < math.inf for value in structs.astuple(record)):
                raise FileFormatError(f"{file} is damaged: a number is negative or not finite; {CORRESPOND_AGAIN}.")
        except ShapespaceError as error:
            self.unread[printable(name)] = str(error)
            return None
        # A report is mailed and a viewer has visitors: neither may reveal the folders of this machine.
        return structs.replace(record, reason=without_folders(record.reason))


def upright(mean: Mesh, turns: Sequence[FloatArray] = ()) -> FloatArray:
    """Return the rotation (3, 3) that brings the mean shape upright: +y up, its front along +z.

    If the scans share a pose, the mean shape gets the mean of their poses. Otherwise its longest axis is vertical, with
    the narrower end below, and its front is the side opposite the opening of an open surface, or lies along the
    shortest axis of a closed one.

    Args:
        mean: mean shape.
        turns: (3, 3) rotations from its frame to those of the scans.
    """
    if turns:
        u, strength, vt = np.linalg.svd(np.mean(turns, axis=0))
        if strength.min() > _POSED_ALIKE:
            return u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    centred = mean.vertices - mean.vertices.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    vectors = face_vectors(mean.vertices, faces_of(mean))
    facing = vectors.sum(axis=0)
    front = axes[:, 0]
    if np.linalg.norm(facing) > _OPEN_SHARE * np.linalg.norm(vectors, axis=1).sum():
        front = facing / np.linalg.norm(facing)
    elif facing @ front < 0:
        front = -front
    up = axes[:, 2] if abs(axes[:, 2] @ front) < math.sqrt(0.5) else axes[:, 1]
    up = up - (up @ front) * front
    up /= np.linalg.norm(up)
    if ((centred @ up) * (centred @ np.cross(up, front)) ** 2).mean() < 0:
        up = -up
    return np.stack([np.cross(up, front), up, front])


_DOUBTFUL_WEIGHT = 1e6  # before all other reasons


@dataclass(frozen=True)
class Concern:
    """Reasons to review a scan in correspondence.

    Args:
        weight: need for review, 0 for none.
        reasons: reasons in words, the most severe first.
    """

    weight: float = 0.0
    reasons: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Reasons as a sentence."""
        return sentence("; ".join(self.reasons)) if self.reasons else "No problems detected."


def concerns_of(folder: Corresponded) -> dict[str, Concern]:
    """Return the concerns about each readable scan in correspondence, by name."""
    concerns: dict[str, Concern] = {}
    for name in folder.population().names:
        record = folder.records[name]
        concerns[name] = Concern(
            (_DOUBTFUL_WEIGHT if record.doubt else max((reason.excess for reason in record.review), default=0.0)),
            describe_review(record),
        )
    return concerns


def distance_share(record: CorrespondRecord, statistic: str, size: float) -> float:
    """Return the distance `mean`, `p95`, `p99` or `max` of a record as a share of `size`, which is in its unit."""
    return known(getattr(record, f"distance_{statistic}")) / size


def scan_status(record: CorrespondRecord, concerns: Mapping[str, Concern]) -> str:
    """Return `converged`, `look` for an unusual scan, `doubtful`, `excluded`, or `unreadable`."""
    if record.is_excluded:
        return "excluded"
    concern = concerns.get(record.name)
    if concern is None:
        return "unreadable"
    return "doubtful" if record.status == "doubtful" else "look" if concern.reasons else "converged"
