"""Surfaces of label volumes: smooth, closed, and no more than half a voxel from what the labels say.

The signed distance to the border between labelled and other voxels is smoothed; its level is chosen so that the
surface encloses the volume of the voxels, since smoothing alone shrinks what is small; and no voxel may change side
by more than half a voxel (after R. T. Whitaker, "Reducing Aliasing Artifacts in Iso-Surfaces of Binary Volumes",
2000). Marching cubes, by scikit-image, then gives the triangles. docs/volumes.md compares ways to do it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, cast

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from shapespace.errors import InputError, MeshError, ShapespaceError
from shapespace.geometry.remesh import is_sheet
from shapespace.geometry.surface import boundary_edges
from shapespace.late import late
from shapespace.reprs import short_repr
from shapespace.types import BoolArray, FloatArray, IntArray, LabelVolume, Mesh, require

SMOOTH = 1.3
"""Standard deviation of the smoothing by default, in voxels."""
MOST_SMOOTH = 10.0
"""The largest that can be asked for."""

_SLACK = np.float32(0.5)
_CLIP = 2.0
# How near to the middle of a voxel the surface may pass, so that no triangle shrinks to nothing.
_CLEAR = np.float32(0.05)
# Shares of the smoothing that are tried where something thin would vanish.
_FINER = (0.5, 0.25)
# How often voxels that vanish are put back, with more around them each time.
_ROUNDS = 3
_FEWEST = 8
_HALVINGS, _STEP = 20, 0.1
_MOST_VOXELS = 1 << 27
_LONG = 2.5
_LISTED = 10

_Field = npt.NDArray[np.float32]
_Labels = npt.NDArray[np.integer[Any]]


@dataclass(frozen=True, eq=False)
class VolumeSurface:
    """The surface of labels in a volume.

    Args:
        mesh: closed, its triangles counter-clockwise seen from outside; RAS, mm.
        labels: what it encloses.
        voxel_mm: (3,) size of a voxel.
        voxels: how many it was made of.
        pieces: how many pieces hang together, by faces or edges of voxels, among those of the labels.
        left_out: voxels of the pieces that are not in the surface.
        filled: voxels of cavities that are taken as inside.
        at_border: voxels on the border of the volume, where the surface is closed though the object may go on.
        volume_mm3: what the surface encloses.
        notes: sentences on what should be known.
    """

    mesh: Mesh
    labels: tuple[int, ...]
    voxel_mm: FloatArray
    voxels: int
    pieces: int
    left_out: int
    filled: int
    at_border: int
    volume_mm3: float
    notes: tuple[str, ...]

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        return late("html_of_volume_surface")(self)


def surface_of_volume(
    volume: LabelVolume,
    labels: int | Sequence[int] | Literal["all"] | None = None,
    *,
    smooth: float = SMOOTH,
    keep_pieces: bool = False,
) -> VolumeSurface:
    """Return the surface around labels, at sub-voxel accuracy.

    Args:
        volume: labels and where they lie, as `read_volume` gives them.
        labels: one, or several that are taken as one object; "all" but 0; None for the only one there is.
        smooth: standard deviation of the smoothing in voxels, of their mean size where they are not cubes; 0 for none.
        keep_pieces: keep all pieces and cavities, instead of the largest piece without them.

    Raises:
        InputError: no such label, several where none was chosen, too few voxels or too many, or a bad `smooth`.
        ShapespaceError: the extra `volumes` is not installed.
    """
    require(volume, LabelVolume, "surface_of_volume", "read one with shapespace.read_volume")
    if not 0 <= smooth <= MOST_SMOOTH:
        raise InputError(f"The smoothing must be from 0 to {MOST_SMOOTH:g} voxels, not {smooth}.")
    chosen = _chosen(volume, labels)
    inside = np.isin(volume.labels, chosen)
    sigma = smooth * np.cbrt(np.prod(volume.voxel_mm)) / volume.voxel_mm
    mask, corner = _cut_out(inside, np.ceil(3 * sigma).astype(int) + 3, volume.name)
    part = _Part.of(mask, keep_pieces=keep_pieces)
    if part.voxels < _FEWEST:
        raise InputError(
            f"{volume.name}: {_named(chosen)} has only {part.voxels} "
            f"{'voxel' if part.voxels == 1 else 'voxels that hang together'}; a surface needs {_FEWEST}."
        )
    at_border = _at_border(part.mask, corner, inside.shape)
    field, share = _smoothed(part, volume.voxel_mm, sigma)
    vertices, faces = _triangles(field, volume.name)
    points = (vertices + corner) @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    if np.linalg.det(volume.affine[:3, :3]) < 0:
        faces = faces[:, ::-1]
    return VolumeSurface(
        mesh=Mesh(points, np.ascontiguousarray(faces), name=volume.name),
        labels=chosen,
        voxel_mm=volume.voxel_mm,
        voxels=part.voxels,
        pieces=part.pieces,
        left_out=part.left_out,
        filled=part.filled,
        at_border=at_border,
        volume_mm3=_volume(points, faces),
        notes=(*volume.notes, *_notes(part, volume.voxel_mm, at_border, share)),
    )


def labels_in(labels: _Labels) -> tuple[int, ...]:
    """Return the labels in (X, Y, Z) other than 0, from the lowest."""
    low, high = int(labels.min()), int(labels.max())
    if high - low >= 1 << 16:
        return tuple(int(value) for value in np.unique(labels) if value)
    counts = np.zeros(high - low + 1, dtype=np.int64)
    for slab in np.moveaxis(labels, -1, 0):
        counts += np.bincount((slab.astype(np.int64) - low).ravel(), minlength=len(counts))
    return tuple(low + int(at) for at in np.flatnonzero(counts) if low + at)


def _chosen(volume: LabelVolume, labels: int | Sequence[int] | Literal["all"] | None) -> tuple[int, ...]:
    found = labels_in(volume.labels)
    if not found:
        raise InputError(f"{volume.name}: all its voxels are 0; give a volume with a label.")
    listed = ", ".join(map(str, found[:_LISTED])) + (f", ... ({len(found)})" if len(found) > _LISTED else "")
    if labels is None:
        if len(found) > 1:
            raise InputError(
                f"{volume.name}: it has the labels {listed}; say which (--label), or take all as one (--label all)."
            )
        return found
    if isinstance(labels, str):
        if labels != "all":
            raise InputError(f"Labels must be whole numbers or 'all', not {labels!r}.")
        return found
    asked = {int(label) for label in np.atleast_1d(np.asarray(labels, dtype=np.int64))}
    absent = tuple(sorted(asked - set(found)))
    if absent or not asked:
        raise InputError(f"{volume.name}: there is no {_named(absent) if absent else 'label'} in it; it has {listed}.")
    return tuple(sorted(asked))


def _named(labels: tuple[int, ...]) -> str:
    return f"label{'s' if len(labels) > 1 else ''} {', '.join(map(str, labels))}"


def _cut_out(inside: BoolArray, margin: npt.NDArray[np.int_], name: str) -> tuple[BoolArray, FloatArray]:
    """Return the box around what is `inside` with a margin on each axis, and (3,) where in the volume it begins."""
    low, high = np.zeros(3, dtype=np.int64), np.zeros(3, dtype=np.int64)
    for axis in range(3):
        along = np.flatnonzero(inside.any(axis=tuple(other for other in range(3) if other != axis)))
        low[axis], high[axis] = along[0], along[-1] + 1
    if np.prod(high - low + 2 * margin) > _MOST_VOXELS:
        size = " x ".join(map(str, high - low))
        raise InputError(
            f"{name}: the labels fill a box of {size} voxels, too many to smooth; resample it, as by 3D Slicer."
        )
    box = inside[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
    return np.pad(box, [(int(m), int(m)) for m in margin]), (low - margin).astype(np.float64)


def _at_border(mask: BoolArray, corner: FloatArray, shape: tuple[int, ...]) -> int:
    """Return how many voxels of `mask`, which begins at `corner` of a volume of that `shape`, are its outermost."""
    inner = tuple(slice(max(1 - int(at), 0), count - 1 - int(at)) for at, count in zip(corner, shape, strict=True))
    return int(mask.sum() - mask[inner].sum())


@dataclass(frozen=True, eq=False)
class _Part:
    """Voxels to make a surface of: none touch along an edge alone, so that it is a sheet whatever smoothing does."""

    mask: BoolArray
    voxels: int
    pieces: int
    left_out: int
    filled: int
    added: int
    kept: tuple[int, int]
    """Pieces and cavities that the surface has."""

    @staticmethod
    def of(mask: BoolArray, *, keep_pieces: bool) -> _Part:
        whole = _without_edge_contacts(mask)
        label, pieces = _components(whole)
        sizes = np.bincount(label[mask], minlength=pieces + 1)
        if keep_pieces:
            kept = (pieces, _components(~whole)[1] - 1)
            return _Part(whole, int(sizes.sum()), pieces, 0, 0, int(whole.sum() - mask.sum()), kept)
        largest = 1 + int(np.argmax(sizes[1:]))
        piece = label == largest
        outside, _ = _components(~piece)
        closed = outside != outside[0, 0, 0]
        filled = int((closed & ~piece).sum())
        added = int((piece & ~mask).sum())
        left_out = int(sizes.sum() - sizes[largest] - (closed & mask & ~piece).sum())
        return _Part(closed, int(sizes[largest]), pieces, left_out, filled, added, (1, 0))


def _without_edge_contacts(mask: BoolArray) -> BoolArray:
    """Return `mask` with voxels added until no two of it touch along an edge without one that shares faces with both.

    Then no face of a cube of marching cubes is ambiguous, and no edge of the surface has more than two triangles.
    """
    out = mask.copy()
    while True:
        before = int(out.sum())
        for first, second in ((0, 1), (0, 2), (1, 2)):
            square = np.moveaxis(out, (first, second), (0, 1))
            a, b, c, d = square[:-1, :-1], square[1:, :-1], square[:-1, 1:], square[1:, 1:]
            b |= a & d & ~b & ~c
            a |= b & c & ~a & ~d
        if int(out.sum()) == before:
            return out


def _components(mask: BoolArray) -> tuple[IntArray, int]:
    label, count = cast(Any, ndimage).label(mask)
    return label, int(count)


def _smoothed(part: _Part, voxel_mm: FloatArray, sigma: FloatArray) -> tuple[_Field, float]:
    """Return a field that is positive inside, and the share of the smoothing that it has.

    Less is smoothed where pieces would part or join otherwise, and in the end no voxel changes side.
    """
    distance = _signed_distance(part.mask, voxel_mm)
    for share in (1.0, *_FINER):
        field = _freed(distance, share * sigma, part)
        held = np.zeros_like(part.mask)
        for _ in range(_ROUNDS):
            side = _without_edge_contacts(field > 0)
            if part.kept == (1, 0):
                side = _Part.of(side, keep_pieces=False).mask
            lost = _vanished(part.mask, side)
            if not lost.any():
                if (_components(side)[1], _components(~side)[1] - 1) == part.kept:
                    return _clear_of_middles(field, side), share
                break
            held = _grown(held) | lost
            field = np.where(held, _clear_of_middles(field, part.mask), field)
    return _clear_of_middles(_levelled(distance, _FINER[-1] * sigma, part.mask), part.mask), 0.0


def _freed(distance: _Field, sigma: FloatArray, part: _Part) -> _Field:
    """Return `distance` smoothed so that voxels change side by half a voxel at most, less where something would vanish.

    A voxel of something thin that would vanish all the same keeps its side.
    """
    sign = np.where(part.mask, np.float32(1), np.float32(-1))
    field = _levelled(distance, sigma, part.mask)
    free = sign * np.maximum(sign * field, -_SLACK)
    for finer in _FINER:
        thin = _vanished(part.mask, free > 0)
        if not thin.any():
            return free
        there = _levelled(distance, finer * sigma, part.mask)
        weight = ndimage.gaussian_filter(thin.astype(np.float32), 1.0)
        free += weight * (sign * np.maximum(sign * there, -_SLACK) - free)
    return np.where(_vanished(part.mask, free > 0), _clear_of_middles(free, part.mask), free)


def _clear_of_middles(field: _Field, side: BoolArray) -> _Field:
    """Return `field` made positive on one `side` and negative on the other."""
    return np.where(side, np.maximum(field, _CLEAR), np.minimum(field, -_CLEAR))


def _levelled(distance: _Field, sigma: FloatArray, mask: BoolArray) -> _Field:
    field = ndimage.gaussian_filter(distance, sigma)
    return field - np.float32(_level(field, int(mask.sum())))


def _signed_distance(mask: BoolArray, voxel_mm: FloatArray) -> _Field:
    """Return the distance of each voxel from the border of `mask` in voxels of mean size, positive inside, cut off."""
    step = voxel_mm / np.cbrt(np.prod(voxel_mm))
    half = 0.5 * float(step.min())

    def depth(side: BoolArray) -> _Field:
        return np.maximum(np.sqrt(_squared_distance(side, step, _CLIP + half)) - np.float32(half), np.float32(0))

    return np.where(mask, depth(mask), -depth(~mask))


def _squared_distance(side: BoolArray, step: FloatArray, most: float) -> _Field:
    """Return the squared distance from each voxel of `side` to the nearest other, at most that of `most`.

    One axis after the other, as squares add up; SciPy's transform, without a bound, takes ten times as long.
    """
    found = np.where(side, np.float32(most**2), np.float32(0))
    for axis, length in enumerate(step):
        before = np.moveaxis(found, axis, 0)
        found = found.copy()
        after = np.moveaxis(found, axis, 0)
        for k in range(1, int(most / length) + 1):
            cost = np.float32((k * length) ** 2)
            np.minimum(after[:-k], before[k:] + cost, out=after[:-k])
            np.minimum(after[k:], before[:-k] + cost, out=after[k:])
    return found


def _level(field: _Field, voxels: int) -> float:
    """Return the level at which the surface of `field`, in voxels from the border, encloses as much as `voxels`."""
    near = field[np.abs(field) < _CLIP]
    wanted = voxels - int((field >= _CLIP).sum())
    low, high = -1.0, 1.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if float(np.clip(near - (middle - 0.5), 0, 1).sum(dtype=np.float64)) > wanted:
            low = middle
        else:
            high = middle
    # The triangles cut corners; how much goes by their volume at two levels.
    levels = (low, low - _STEP)
    if not float(field.min()) < levels[1] < low < float(field.max()):
        return low
    more, less = (_volume(*_marching_cubes(field, level)) for level in reversed(levels))
    return low + _STEP * min(max((less - voxels) / (more - less), -1.0), 1.0)


def _vanished(mask: BoolArray, side: BoolArray) -> BoolArray:
    """Return where, and two voxels around, a voxel of `mask` or of the rest has no neighbour on its side in `side`."""
    lost = (mask & ~_grown(side)) | (~mask & ~_grown(~side))
    return _grown(_grown(lost)) if lost.any() else lost


def _grown(mask: BoolArray) -> BoolArray:
    """Return `mask` with the 26 neighbours of its voxels."""
    for axis in range(3):
        before = np.moveaxis(mask, axis, 0)
        mask = mask.copy()
        after = np.moveaxis(mask, axis, 0)
        after[1:] |= before[:-1]
        after[:-1] |= before[1:]
    return mask


def _triangles(field: _Field, name: str) -> tuple[FloatArray, IntArray]:
    """Return vertices in voxels and triangles where `field` is zero, seen from outside counter-clockwise."""
    points, faces = _marching_cubes(field, 0.0)
    if not is_sheet(faces) or len(boundary_edges(faces)):
        raise MeshError(f"{name}: its surface is no closed sheet; smooth or mend the labels first.")
    return points, faces


def _marching_cubes(field: _Field, level: float) -> tuple[FloatArray, IntArray]:
    try:
        import skimage.measure  # pyright: ignore[reportMissingTypeStubs]
    except ImportError as error:
        raise ShapespaceError(
            "Volumes need scikit-image, which is not installed; run pip install 'shapespace[volumes]'."
        ) from error
    points, faces, *_ = cast(Any, skimage.measure).marching_cubes(field, level, gradient_direction="ascent")
    return np.asarray(points, dtype=np.float64), np.asarray(faces, dtype=np.int32)


def _volume(points: FloatArray, faces: IntArray) -> float:
    a, b, c = np.moveaxis((points - points.mean(axis=0))[faces], 1, 0)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6


def _notes(part: _Part, voxel_mm: FloatArray, at_border: int, share: float) -> list[str]:
    notes: list[str] = []
    if at_border:
        notes.append("It touches the border of the volume, where the surface is closed; what lies beyond is missing.")
    others = part.pieces - 1
    if part.left_out:
        notes.append(
            f"{others} smaller {'piece' if others == 1 else 'pieces'} with {part.left_out} of "
            f"{part.voxels + part.left_out} voxels {'is' if others == 1 else 'are'} left out."
        )
    elif others and part.kept[0] > 1:
        notes.append(f"It is in {part.pieces} pieces.")
    if part.filled:
        notes.append(f"Cavities of {part.filled} {'voxel' if part.filled == 1 else 'voxels'} inside it are filled.")
    if share < 1:
        notes.append("Parts of it are so thin that it is smoothed less, lest they vanish.")
    if (ratio := float(voxel_mm.max() / voxel_mm.min())) >= _LONG:
        notes.append(f"Its voxels are {ratio:.2g} times as long as wide; between slices the surface is a guess.")
    return notes
