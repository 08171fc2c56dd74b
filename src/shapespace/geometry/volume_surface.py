"""Surfaces of label volumes: smooth, closed, and within half a voxel of the border of the labels.

The signed distance to the border between labelled and other voxels is smoothed; its level is chosen so that the
surface encloses the volume of the voxels, since smoothing alone shrinks small objects; and no voxel may change side
by more than half a voxel (after R. T. Whitaker, "Reducing Aliasing Artifacts in Iso-Surfaces of Binary Volumes",
2000). Marching cubes of scikit-image then computes the triangles. docs/volumes.md compares methods.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial, reduce
from itertools import pairwise
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from shapespace.errors import InputError, MeshError, ShapespaceError
from shapespace.geometry.normals import boundary_edges, enclosed_volume
from shapespace.geometry.remesh import is_sheet
from shapespace.lazy import lazy_import
from shapespace.reprs import short_repr
from shapespace.types import MAX_MEMORY_BYTES, RAS_TO_LPS, BoolArray, FloatArray, IntArray, LabelVolume, Mesh, require

SMOOTH = 1.3
"""Default standard deviation of the smoothing, in voxels."""
MOST_SMOOTH = 10.0
"""Largest standard deviation of the smoothing, in voxels."""

_SLACK = np.float32(0.5)
_CLIP = 2.0  # voxels; the distance field is exact up to here and only its sign matters beyond
# Smallest distance of the surface from the middle of a voxel, so that no triangle degenerates.
_CLEAR = np.float32(0.05)
# Shares of the smoothing that are tried where thin parts would vanish.
_FINER = (0.5, 0.25)
# Limit of iterations that restore vanished voxels, with more surrounding voxels in each iteration.
_ROUNDS = 3
_FEWEST = 8  # voxels, a cube of 2 x 2 x 2: the smallest object with an extent along each axis
# bisections of the level that preserves the volume, to 1e-6 of the interval, and the step outside it in voxels
_HALVINGS, _STEP = 20, 0.1
_BLOCK = 1 << 20
"""Voxels of a volume that are processed together."""
_MOST_LABELS = 1 << 16
"""A volume with more labels than this is an image, not a segmentation."""
_BASE_BYTES = 1 << 27  # bytes; interpreter and libraries, independent of the volume
_VOXEL_BYTES, _VERTEX_BYTES = 32, 400
"""Memory of smoothing and marching cubes: for each voxel of the box around the labels, and for each vertex of the
surface. Upper bounds of the peaks of resident memory that benchmarks/volume_memory.py measures."""
_LONG = 2.5  # ratio of voxel edges from which a note warns of the gaps between slices
_LISTED = 10  # labels in a message, so that it stays readable

_Field = npt.NDArray[np.float32]
_Labels = npt.NDArray[np.integer[Any]]


@dataclass(frozen=True, eq=False)
class VolumeSurface:
    """The surface of labels in a volume.

    Args:
        mesh: closed surface, with triangles counter-clockwise seen from outside; LPS, mm.
        labels: enclosed labels, or names of segments if they were chosen by name.
        voxel_mm: (3,) size of a voxel, mm.
        voxels: number of voxels inside the surface.
        pieces: number of pieces of the labels, connected by faces or edges of voxels.
        left_out: number of voxels of the pieces that are not in the surface.
        filled: number of voxels of cavities that count as inside.
        at_border: number of voxels on the border of the volume, where the surface is closed although the object may
            continue.
        volume_mm3: volume that the surface encloses, mm^3.
        notes: sentences for the user about the surface.

    Example:
        >>> labels = np.zeros((9, 9, 9), dtype=np.uint8)
        >>> labels[3:6, 3:6, 3:6] = 1
        >>> surface = ss.geometry.surface_of_volume(ss.io.LabelVolume(labels, np.eye(4)))
        >>> surface.voxels
        27
    """

    mesh: Mesh
    labels: tuple[int | str, ...]
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
        return lazy_import("html_of_volume_surface")(self)


def surface_of_volume(
    volume: LabelVolume,
    labels: int | str | Sequence[int | str] | None = None,
    *,
    smooth: float = SMOOTH,
    keep_pieces: bool = False,
    max_memory_bytes: int = MAX_MEMORY_BYTES,
) -> VolumeSurface:
    """Return the surface around labels, at sub-voxel accuracy, in LPS mm.

    Args:
        volume: labels and their position, from `read_volume`.
        labels: labels or names of segments of the object: one, several in a sequence or separated by commas, or "all"
            for all but 0; None if there is only one.
        smooth: standard deviation of the smoothing in voxels (of mean size if they are not cubes); 0 for none.
        keep_pieces: whether to keep all pieces and cavities; False for the largest piece without cavities.
        max_memory_bytes: memory limit for the volume and its surface; the need is estimated from the size of
            the box around the labels and the area of their border, before memory is allocated.

    Raises:
        InputError: no such label, several labels of which none was chosen, too few voxels, more memory than allowed, or
            an invalid `smooth`.
        ShapespaceError: the extra `volumes` is not installed.
    """
    require(volume, LabelVolume, "surface_of_volume", "read one with shapespace.io.read_volume")
    if not 0 <= smooth <= MOST_SMOOTH:
        raise InputError(f"The smoothing must be from 0 to {MOST_SMOOTH:g} voxels, not {smooth}.")
    chosen, wanted = _select_labels(volume, labels)
    sigma = smooth * np.cbrt(np.prod(volume.voxel_mm)) / volume.voxel_mm
    check_memory = partial(_check_memory, volume, max_memory_bytes)
    mask, corner = _crop_labels(volume, wanted, np.ceil(3 * sigma).astype(int) + 3, check_memory)
    part = _Solid.of(mask, keep_pieces=keep_pieces)
    check_memory(mask.shape, count_crossings(part.mask))
    if part.voxels < _FEWEST:
        raise InputError(
            f"{volume.name}: {_format_labels(chosen)} has only {part.voxels} "
            f"{'voxel' if part.voxels == 1 else 'connected voxels'}; a surface needs {_FEWEST}."
        )
    at_border = _count_border_voxels(part.mask, corner, volume.labels.shape[:3])
    field, share = _smooth(part, volume.voxel_mm, sigma)
    vertices, faces = _triangles(field, volume.name)
    points = ((vertices + corner) @ volume.affine[:3, :3].T + volume.affine[:3, 3]) * RAS_TO_LPS
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
        volume_mm3=enclosed_volume(points, faces),
        notes=(*volume.notes, *_notes(part, volume.voxel_mm, at_border, share)),
    )


def _check_memory(volume: LabelVolume, limit_bytes: int, box: Sequence[int], vertices: int = 0) -> None:
    """Check the memory of a surface.

    Args:
        volume: volume of the labels.
        limit_bytes: largest allowed memory of the volume and its surface, bytes.
        box: (3,) numbers of voxels along the axes of the box around the labels.
        vertices: number of vertices of the border of the labels.

    Raises:
        InputError: the memory is over the limit.
    """
    needed = volume.labels.nbytes + estimated_bytes(box, vertices)
    if needed > limit_bytes:
        size = " x ".join(map(str, box))
        raise InputError(
            f"{volume.name}: the surface of its labels, in a box of {size} voxels, takes about "
            f"{needed / 2**30:.2g} GiB of memory, over the limit of {limit_bytes / 2**30:.2g} GiB; crop or resample "
            "it, for example with 3D Slicer, or allow more (--max-memory)."
        )


def estimated_bytes(box: Sequence[int], vertices: int) -> int:
    """Return an upper bound of the memory of smoothing and marching cubes, without the volume.

    Args:
        box: (3,) numbers of voxels along the axes of the box around the labels, with its margin.
        vertices: number of vertices of the surface, from the pairs of neighbouring voxels across its border.
    """
    return _BASE_BYTES + _VOXEL_BYTES * math.prod(map(int, box)) + _VERTEX_BYTES * vertices


def _blocks(shape: tuple[int, ...]) -> Generator[tuple[slice, slice, slice]]:
    """Yield slices of a volume that contain about `_BLOCK` voxels each, along its first axis first."""
    steps: list[int] = []
    left = _BLOCK
    for length in shape:
        steps.append(max(1, min(length, left)))
        left //= steps[-1]
    for z in range(0, shape[2], steps[2]):
        for y in range(0, shape[1], steps[1]):
            for x in range(0, shape[0], steps[0]):
                yield slice(x, x + steps[0]), slice(y, y + steps[1]), slice(z, z + steps[2])


def labels_in(labels: _Labels) -> tuple[int, ...]:
    """Return the labels in (X, Y, Z) other than 0, in ascending order.

    Raises:
        InputError: there are more labels than in a segmentation.
    """
    return tuple(count_voxels(labels))


def count_voxels(labels: _Labels) -> dict[int, int]:
    """Return the number of voxels of each label in (X, Y, Z) other than 0, in ascending order of the labels.

    Raises:
        InputError: there are more labels than in a segmentation.
    """
    numbers = Counter[int]()
    for block in _blocks(labels.shape):
        values = labels[block]
        if values.any():
            low, high = int(values.min()), int(values.max())
            if high - low < 2:
                above = int(np.count_nonzero(values == high))
                numbers.update({high: above} if low == high else {low: values.size - above, high: above})
            elif high - low < _MOST_LABELS:
                # Subtraction in uint64 wraps around, so that it is correct for negative labels too.
                counts = np.bincount((values.astype(np.uint64) - np.uint64(low % 2**64)).astype(np.intp).ravel())
                numbers.update({low + int(k): int(counts[k]) for k in np.flatnonzero(counts)})
            else:
                found, times = np.unique(values, return_counts=True)
                numbers.update(dict(zip(found.tolist(), times.tolist(), strict=True)))
        if len(numbers) > _MOST_LABELS:
            raise InputError(
                f"It has more than {_MOST_LABELS:,} labels, so it is an image, not a segmentation; give the label map."
            )
    return {label: numbers[label] for label in sorted(numbers) if label}


@dataclass(frozen=True)
class LabelCount:
    """A label or a segment of a volume.

    Args:
        choice: text that chooses it as the object, such as with `shapespace surface --label`.
        name: name of the segment, or the label.
        voxels: number of its voxels.
    """

    choice: str
    name: str
    voxels: int


def count_labels(volume: LabelVolume) -> tuple[LabelCount, ...]:
    """Return the labels and segments of a volume with their numbers of voxels.

    Raises:
        InputError: there is no label, or the values are grey values of an image.
    """
    segments = {(item.layer, item.label): item for item in volume.segments}
    often = Counter(item.name for item in volume.segments)
    counts: list[LabelCount] = []
    for layer, labels in enumerate(volume.layers):
        try:
            voxels = count_voxels(labels)
        except InputError as error:
            raise InputError(f"{volume.name}: {error}") from error
        if _is_image(labels, voxels):
            raise InputError(
                f"{volume.name}: most neighbouring voxels differ, with {len(voxels):,} values in all, as in a CT or MR "
                "image; give its segmentation (label map)."
            )
        for label, count in voxels.items():
            segment = segments.get((layer, label))
            if segment is None:
                counts.append(LabelCount(str(label), str(label), count))
                continue
            is_clear = often[segment.name] == 1 and "," not in segment.name  # a comma separates labels
            counts.append(LabelCount(segment.name if is_clear else segment.id, segment.name, count))
    if not counts:
        raise InputError(f"{volume.name}: all its voxels are 0; give a volume with a label.")
    return tuple(counts)


def _is_image(labels: _Labels, voxels: Mapping[int, int]) -> bool:
    """Return whether most neighbours have different values, apart from 0 and the most frequent one: the background."""
    common = max(voxels, key=voxels.__getitem__, default=0)
    equal = pairs = 0
    for first, second in pairwise(labels):
        inside = (first != 0) & (second != 0) & ((first != common) | (second != common))
        pairs += int(inside.sum())
        equal += int((inside & (first == second)).sum())
    return 2 * equal < pairs


_Places = dict[int, list[int]]
"""Layer -> labels in it that form an object."""


def _select_labels(
    volume: LabelVolume, labels: int | str | Sequence[int | str] | None
) -> tuple[tuple[int | str, ...], _Places]:
    """Return the labels or names of segments that form the object, and their layers."""
    try:
        present = [(layer, label) for layer, values in enumerate(volume.layers) for label in labels_in(values)]
    except InputError as error:
        raise InputError(f"{volume.name}: {error}") from error
    if not present:
        raise InputError(f"{volume.name}: all its voxels are 0; give a volume with a label.")
    segments = {(item.layer, item.label): item for item in volume.segments if (item.layer, item.label) in set(present)}
    places: dict[int | str, list[tuple[int, int]]] = {}
    for place in present:
        places.setdefault(place[1], []).append(place)
    for place, segment in segments.items():
        places.setdefault(segment.name, []).append(place)
    for place, segment in segments.items():
        places.setdefault(segment.id, [place])
    names = [segments[place].name if place in segments else place[1] for place in present]
    listed = ", ".join(map(str, names[:_LISTED])) + (f", ... ({len(names)})" if len(names) > _LISTED else "")
    if labels is None and len(present) > 1:
        kind = "segments" if segments else "labels"
        raise InputError(
            f"{volume.name}: it has the {kind} {listed}; choose some (--label), or combine all (--label all)."
        )
    if labels is None or (isinstance(labels, str) and labels == "all" and labels not in places):
        return tuple(dict.fromkeys(names)), _group_by_layer(present)
    if isinstance(labels, str):
        parts = [labels] if labels in places else [part.strip() for part in labels.split(",")]
        asked = {int(part) if part not in places and part.lstrip("-").isdecimal() else part for part in parts}
    else:
        asked = {label if isinstance(label, str) else int(label) for label in np.atleast_1d(np.array(labels, object))}
    absent = tuple(sorted(asked - places.keys(), key=str))
    if absent or not asked:
        raise InputError(
            f"{volume.name}: it has no {_format_labels(absent) if absent else 'label'}; choose from {listed}."
        )
    for label in asked:
        if len(places[label]) > 1:
            choices = ", ".join(segments[p].name if isinstance(label, int) else segments[p].id for p in places[label])
            raise InputError(
                f"{volume.name}: {_format_labels((label,))} is in several layers; choose one of {choices}."
            )
    return tuple(sorted(asked, key=places.__getitem__)), _group_by_layer([places[label][0] for label in asked])


def _group_by_layer(places: Sequence[tuple[int, int]]) -> _Places:
    return {layer: [label for other, label in places if other == layer] for layer, _ in places}


def _format_labels(labels: tuple[int | str, ...]) -> str:
    return f"label{'s' if len(labels) > 1 else ''} {', '.join(map(str, labels))}"


def _crop_labels(
    volume: LabelVolume, wanted: _Places, margin: npt.NDArray[np.int_], check_memory: Callable[[list[int]], None]
) -> tuple[BoolArray, FloatArray]:
    """Return the mask of the labels `wanted` in the box around them with a margin, and its first corner (3,)."""
    shape, layers = volume.labels.shape[:3], volume.layers

    def inside(block: tuple[slice, ...]) -> BoolArray:
        masks = (_is_one_of(layers[layer][block], labels) for layer, labels in wanted.items())
        return reduce(np.logical_or, masks)

    low, high = np.array(shape, dtype=np.int64), np.zeros(3, dtype=np.int64)
    for block in _blocks(shape):
        if (found := inside(block)).any():
            for axis in range(3):
                along = np.flatnonzero(found.any(axis=tuple(other for other in range(3) if other != axis)))
                low[axis] = min(low[axis], block[axis].start + along[0])
                high[axis] = max(high[axis], block[axis].start + along[-1] + 1)
    check_memory((high - low + 2 * margin).tolist())
    mask = np.zeros(high - low + 2 * margin, dtype=np.bool_)
    corner = low - margin
    for block in _blocks(shape):
        begin = [max(part.start, int(offset)) for part, offset in zip(block, low, strict=True)]
        end = [min(part.stop, int(offset)) for part, offset in zip(block, high, strict=True)]
        if all(a < b for a, b in zip(begin, end, strict=True)):
            there = tuple(slice(a, b) for a, b in zip(begin, end, strict=True))
            here = tuple(
                slice(a - int(offset), b - int(offset)) for a, b, offset in zip(begin, end, corner, strict=True)
            )
            mask[here] = inside(there)
    return mask, corner.astype(np.float64)


def _is_one_of(values: _Labels, wanted: list[int]) -> BoolArray:
    # Several times faster for one label, the usual case.
    return values == wanted[0] if len(wanted) == 1 else np.isin(values, wanted)


def count_crossings(mask: BoolArray) -> int:
    """Return the number of pairs of neighbouring voxels across the border, which are the vertices of marching cubes."""
    count = 0
    for axis in range(3):
        along = np.moveaxis(mask, axis, 0)
        count += sum(int(np.count_nonzero(a != b)) for a, b in pairwise(along))
    return count


def _count_border_voxels(mask: BoolArray, corner: FloatArray, shape: tuple[int, ...]) -> int:
    """Return the number of voxels of `mask`, whose first corner is `corner`, on the border of a volume of `shape`."""
    inner = tuple(
        slice(max(1 - int(offset), 0), count - 1 - int(offset)) for offset, count in zip(corner, shape, strict=True)
    )
    return int(mask.sum() - mask[inner].sum())


@dataclass(frozen=True, eq=False)
class _Solid:
    """Voxels inside a surface; none touch only along an edge, so that the surface is a sheet after any smoothing."""

    mask: BoolArray
    voxels: int
    pieces: int
    left_out: int
    filled: int
    added: int
    topology: tuple[int, int]
    """Numbers of pieces and cavities of the surface."""

    @staticmethod
    def of(mask: BoolArray, *, keep_pieces: bool) -> _Solid:
        separated = _without_edge_contacts(mask)
        label, pieces = _components(separated)
        sizes = np.bincount(label[mask], minlength=pieces + 1)
        if keep_pieces:
            return _Solid(
                mask=separated,
                voxels=int(sizes.sum()),
                pieces=pieces,
                left_out=0,
                filled=0,
                added=int(separated.sum() - mask.sum()),
                topology=(pieces, _components(~separated)[1] - 1),
            )
        largest = 1 + int(np.argmax(sizes[1:]))
        piece = label == largest
        outside, _ = _components(~piece)
        closed = outside != outside[0, 0, 0]
        return _Solid(
            mask=closed,
            voxels=int(sizes[largest]),
            pieces=pieces,
            left_out=int(sizes.sum() - sizes[largest] - (closed & mask & ~piece).sum()),
            filled=int((closed & ~piece).sum()),
            added=int((piece & ~mask).sum()),
            topology=(1, 0),
        )


def _without_edge_contacts(mask: BoolArray) -> BoolArray:
    """Return `mask` with added voxels, so that two voxels that touch along an edge have a common face neighbour.

    Then no face of a cell of marching cubes is ambiguous, and no edge of the surface has more than two triangles.
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


def _smooth(part: _Solid, voxel_mm: FloatArray, sigma: FloatArray) -> tuple[_Field, float]:
    """Return a field that is positive inside, and its share of the requested smoothing.

    The smoothing is reduced if pieces would otherwise split or merge, in the last resort until no voxel changes side.
    """
    distance = _signed_distance(part.mask, voxel_mm)
    for share in (1.0, *_FINER):
        field = _smooth_freely(distance, share * sigma, part)
        fixed = np.zeros_like(part.mask)
        for _ in range(_ROUNDS):
            side = _without_edge_contacts(field > 0)
            if part.topology == (1, 0):
                side = _Solid.of(side, keep_pieces=False).mask
            lost = _find_vanished(part.mask, side)
            if not lost.any():
                if (_components(side)[1], _components(~side)[1] - 1) == part.topology:
                    return _clear_of_middles(field, side), share
                break
            fixed = _dilate(fixed) | lost
            field = np.where(fixed, _clear_of_middles(field, part.mask), field)
    return _clear_of_middles(_smooth_to_volume(distance, _FINER[-1] * sigma, part.mask), part.mask), 0.0


def _smooth_freely(distance: _Field, sigma: FloatArray, part: _Solid) -> _Field:
    """Return smoothed `distance`; voxels change side by at most half a voxel, and less where thin parts would vanish.

    Voxels of thin parts that would vanish nevertheless keep their side.
    """
    sign = np.where(part.mask, np.float32(1), np.float32(-1))
    field = _smooth_to_volume(distance, sigma, part.mask)
    free = sign * np.maximum(sign * field, -_SLACK)
    for finer in _FINER:
        thin = _find_vanished(part.mask, free > 0)
        if not thin.any():
            return free
        there = _smooth_to_volume(distance, finer * sigma, part.mask)
        weight = ndimage.gaussian_filter(thin.astype(np.float32), 1.0)
        free += weight * (sign * np.maximum(sign * there, -_SLACK) - free)
    return np.where(_find_vanished(part.mask, free > 0), _clear_of_middles(free, part.mask), free)


def _clear_of_middles(field: _Field, side: BoolArray) -> _Field:
    """Return `field` made positive on one `side` and negative on the other."""
    return np.where(side, np.maximum(field, _CLEAR), np.minimum(field, -_CLEAR))


def _smooth_to_volume(distance: _Field, sigma: FloatArray, mask: BoolArray) -> _Field:
    field = ndimage.gaussian_filter(distance, sigma)
    return field - np.float32(_level(field, int(mask.sum())))


def _signed_distance(mask: BoolArray, voxel_mm: FloatArray) -> _Field:
    """Return the distance of each voxel from the border of `mask` in voxels of mean size, positive inside, clipped."""
    step = voxel_mm / np.cbrt(np.prod(voxel_mm))
    half = 0.5 * float(step.min())

    def depth(side: BoolArray) -> _Field:
        return np.maximum(np.sqrt(_squared_distance(side, step, _CLIP + half)) - np.float32(half), np.float32(0))

    return np.where(mask, depth(mask), -depth(~mask))


def _squared_distance(side: BoolArray, step: FloatArray, most: float) -> _Field:
    """Return the squared distance from each voxel of `side` to the nearest other voxel, at most the square of `most`.

    Axes are processed one after the other, because squares are additive; SciPy's transform, which has no bound, takes
    ten times as long.
    """
    squared = np.where(side, np.float32(most**2), np.float32(0))
    for axis, length in enumerate(step):
        before = np.moveaxis(squared, axis, 0)
        squared = squared.copy()
        after = np.moveaxis(squared, axis, 0)
        for k in range(1, int(most / length) + 1):
            cost = np.float32((k * length) ** 2)
            np.minimum(after[:-k], before[k:] + cost, out=after[:-k])
            np.minimum(after[k:], before[:-k] + cost, out=after[k:])
    return squared


def _level(field: _Field, voxels: int) -> float:
    """Return the level at which the surface of `field` (voxels from the border) encloses the volume of `voxels`."""
    near = field[np.abs(field) < _CLIP]
    wanted = voxels - int((field >= _CLIP).sum())
    low, high = -1.0, 1.0
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        if float(np.clip(near - (middle - 0.5), 0, 1).sum(dtype=np.float64)) > wanted:
            low = middle
        else:
            high = middle
    # Triangles cut corners; this volume is estimated from the enclosed volumes at two levels.
    levels = (low, low - _STEP)
    if not float(field.min()) < levels[1] < low < float(field.max()):
        return low
    more, less = (enclosed_volume(*_marching_cubes(field, level)) for level in reversed(levels))
    return low + _STEP * min(max((less - voxels) / (more - less), -1.0), 1.0)


def _find_vanished(mask: BoolArray, side: BoolArray) -> BoolArray:
    """Return the voxels where the object of `mask` or its outside vanished in `side`, and two voxels around these.

    The object has vanished where neither a voxel of `mask` nor a neighbour of it is in `side`; the outside likewise.
    """
    lost = (mask & ~_dilate(side)) | (~mask & ~_dilate(~side))
    return _dilate(_dilate(lost)) if lost.any() else lost


def _dilate(mask: BoolArray) -> BoolArray:
    """Return `mask` with the 26 neighbours of its voxels."""
    for axis in range(3):
        before = np.moveaxis(mask, axis, 0)
        mask = mask.copy()
        after = np.moveaxis(mask, axis, 0)
        after[1:] |= before[:-1]
        after[:-1] |= before[1:]
    return mask


def _triangles(field: _Field, name: str) -> tuple[FloatArray, IntArray]:
    """Return vertices (in voxels) and triangles of the zero level of `field`, counter-clockwise seen from outside."""
    points, faces = _marching_cubes(field, 0.0)
    if not is_sheet(faces) or len(boundary_edges(faces)):
        raise MeshError(f"{name}: its surface is not a closed sheet; smooth or correct the labels first.")
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


def _notes(part: _Solid, voxel_mm: FloatArray, at_border: int, share: float) -> list[str]:
    notes: list[str] = []
    if at_border:
        notes.append("It touches the border of the volume, where the surface is closed; parts beyond it are missing.")
    others = part.pieces - 1
    if part.left_out:
        notes.append(
            f"{others} smaller {'piece' if others == 1 else 'pieces'} with {part.left_out} of "
            f"{part.voxels + part.left_out} voxels {'is' if others == 1 else 'are'} omitted."
        )
    elif others and part.topology[0] > 1:
        notes.append(f"It is in {part.pieces} pieces.")
    if part.filled:
        notes.append(f"Cavities of {part.filled} {'voxel' if part.filled == 1 else 'voxels'} inside it are filled.")
    if share < 1:
        notes.append("Parts of it are so thin that the smoothing was reduced to preserve them.")
    if (ratio := float(voxel_mm.max() / voxel_mm.min())) >= _LONG:
        notes.append(f"Its voxels are {ratio:.2g} times as long as wide; between slices the surface is a guess.")
    return notes
