"""How far from the truth is the surface of a voxelised object, by several ways to smooth its staircase?

    python benchmarks/volumes.py             four places of each object
    python benchmarks/volumes.py --places 1

Balls, ellipsoids and tori of known surface in voxels of 1 x 1 x 1 and 1 x 1 x 3 mm, turned and placed at random; one
is inside if its middle is. With noise, the surface is moved at each voxel by 0.4 mm (one standard deviation) before.
Errors are distances of random points on the surface found from the true one, mm, and volumes against the true ones.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy import ndimage
from scipy.spatial.transform import Rotation
from skimage.measure import marching_cubes

from shapespace.geometry.normals import face_vectors
from shapespace.geometry.volume_surface import surface_of_volume
from shapespace.types import RAS_TO_LPS, BoolArray, FloatArray, IntArray, LabelVolume

Surface = tuple[FloatArray, IntArray]
NOISE_MM, POINTS = 0.4, 8000


@dataclass(frozen=True, eq=False)
class Truth:
    """An object of known surface, in voxels.

    Args:
        name: of the object and its size in mm.
        inside: (X, Y, Z) whether a voxel is.
        voxel_mm: (3,) its size.
        distance: points (N, 3) in mm -> how far each is from the surface.
        volume: of the object, mm3.
    """

    name: str
    inside: BoolArray
    voxel_mm: FloatArray
    distance: Callable[[FloatArray], FloatArray]
    volume: float


def ellipsoid_distance(points: FloatArray, radii: FloatArray) -> FloatArray:
    """Return how far `points` (N, 3) are from an ellipsoid at the origin, by bisection."""
    p = np.abs(points)
    low, high = np.full(len(p), -(radii.min() ** 2)), np.full(len(p), radii.max() * (p.max() * 2 + radii.max()))
    for _ in range(80):
        middle = (low + high) / 2
        over = ((radii * p / (middle[:, None] + radii**2)) ** 2).sum(axis=1) > 1
        low, high = np.where(over, middle, low), np.where(over, high, middle)
    return np.linalg.norm(radii**2 * p / (high[:, None] + radii**2) - p, axis=1)


def objects() -> Iterator[tuple[str, FloatArray, Callable[[FloatArray], FloatArray], Callable, float]]:
    """Yield name, half its size, a function that is negative inside and like a distance nearby, distance, volume."""
    for radius in (3.0, 6.0, 12.0):

        def ball(p: FloatArray, r: float = radius) -> FloatArray:
            return np.linalg.norm(p, axis=-1) - r

        yield f"ball {radius:g}", np.full(3, radius), ball, lambda p, f=ball: np.abs(f(p)), 4 / 3 * np.pi * radius**3
    for longest in (7.0, 14.0):
        radii = longest * np.array([1, 0.65, 0.5])

        def oval(p: FloatArray, r: FloatArray = radii) -> FloatArray:
            size = np.linalg.norm(p / r, axis=-1)
            return size * (size - 1) / np.maximum(np.linalg.norm(p / r**2, axis=-1), 1e-12)

        volume = 4 / 3 * np.pi * radii.prod()
        yield f"ellipsoid {longest:g}", radii, oval, lambda p, r=radii: ellipsoid_distance(p, r), volume
    for thin in (3.0, 6.0):

        def torus(p: FloatArray, a: float = thin) -> FloatArray:
            return np.hypot(np.hypot(p[..., 0], p[..., 1]) - 2.5 * a, p[..., 2]) - a

        half, volume = thin * np.array([3.5, 3.5, 1]), 5 * np.pi**2 * thin**3
        yield f"torus {thin:g}", half, torus, lambda p, f=torus: np.abs(f(p)), volume


def truths(slice_mm: float, noise_mm: float, seed: int) -> Iterator[Truth]:
    """Yield each object, turned and placed at random."""
    rng = np.random.default_rng(seed)
    voxel = np.array([1.0, 1.0, slice_mm])
    for name, half, signed, distance, volume in objects():
        turn = Rotation.random(random_state=int(rng.integers(1 << 30))).as_matrix()
        count = np.ceil(2 * np.linalg.norm(half) / voxel).astype(int) + 8
        centre = (count - 1) * voxel / 2 + rng.uniform(-0.5, 0.5, 3) * voxel
        places = np.stack(
            np.meshgrid(*(np.arange(n) * s for n, s in zip(count, voxel, strict=True)), indexing="ij"), -1
        )
        inside = signed((places - centre) @ turn.T) + noise_mm * rng.normal(size=places.shape[:3]) < 0
        yield Truth(name, inside, voxel, lambda p, c=centre, t=turn, d=distance: d((p - c) @ t.T), volume)


def largest(inside: BoolArray) -> BoolArray:
    """Return the largest piece without its cavities, as the way that is measured last takes it."""
    label, _ = ndimage.label(inside)
    return ndimage.binary_fill_holes(label == 1 + np.argmax(np.bincount(label.ravel())[1:]))


def triangles(field: FloatArray, level: float, voxel: FloatArray) -> Surface:
    """Return marching cubes of a field, mm."""
    if not field.min() < level < field.max():
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)
    points, faces, *_ = marching_cubes(field.astype(np.float32), level, gradient_direction="ascent")
    return points.astype(np.float64) * voxel, faces.astype(np.int32)


def volume_of(surface: Surface) -> float:
    """Return what a closed surface encloses."""
    points, faces = surface
    return float(np.einsum("ij,ij->", points[faces[:, 0]], face_vectors(points, faces))) / 6 if len(faces) else 0.0


def with_volume(field: FloatArray, inside: BoolArray, voxel: FloatArray) -> float:
    """Return the level at which the surface of a field encloses the volume of the voxels, by bisection."""
    low, high = float(field.min()), float(field.max())
    for _ in range(16):
        level = (low + high) / 2
        over = volume_of(triangles(field, level, voxel)) > inside.sum() * voxel.prod()
        low, high = (level, high) if over else (low, level)
    return (low + high) / 2


def sigma_mm(voxel: FloatArray, voxels: float) -> FloatArray:
    """Return a standard deviation of as many voxels of mean size along each axis, in its own voxels."""
    return voxels * np.cbrt(voxel.prod()) / voxel


def distances(inside: BoolArray, voxel: FloatArray) -> FloatArray:
    """Return signed distances, mm, positive inside."""
    deep, far = (ndimage.distance_transform_edt(side, sampling=voxel) for side in (inside, ~inside))
    return np.where(inside, deep - voxel.min() / 2, voxel.min() / 2 - far)


def binary(inside: BoolArray, voxel: FloatArray) -> Surface:
    return triangles(inside.astype(np.float64), 0.5, voxel)


def gauss_half(inside: BoolArray, voxel: FloatArray) -> Surface:
    return triangles(ndimage.gaussian_filter(inside.astype(np.float64), 1.0), 0.5, voxel)


def gauss_volume(inside: BoolArray, voxel: FloatArray) -> Surface:
    field = ndimage.gaussian_filter(inside.astype(np.float64), sigma_mm(voxel, 1.3))
    return triangles(field, with_volume(field, inside, voxel), voxel)


def distance_zero(inside: BoolArray, voxel: FloatArray) -> Surface:
    return triangles(ndimage.gaussian_filter(distances(inside, voxel), sigma_mm(voxel, 1.0)), 0.0, voxel)


def kept_sides(inside: BoolArray, voxel: FloatArray) -> Surface:
    field = ndimage.gaussian_filter(distances(inside, voxel), sigma_mm(voxel, 1.3))
    field -= with_volume(field, inside, voxel)
    return triangles(np.where(inside, np.maximum(field, 0.05), np.minimum(field, -0.05)), 0.0, voxel)


def thin_plate(inside: BoolArray, voxel: FloatArray) -> Surface:
    """Least squared second differences in mm such that each voxel keeps its side, by projected gradients."""
    weight = (voxel.min() / voxel) ** 2
    field = ndimage.gaussian_filter(distances(inside, voxel), sigma_mm(voxel, 1.0))
    start, rate = field.copy(), 1 / (16 * (weight**2).sum())
    for step in range(60):
        slope = np.zeros_like(field)
        for axis in range(3):
            bend = np.roll(field, 1, axis) + np.roll(field, -1, axis) - 2 * field
            slope += weight[axis] ** 2 * (np.roll(bend, 1, axis) + np.roll(bend, -1, axis) - 2 * bend)
        field = np.where(np.abs(start) < 4 * voxel.max(), field - rate * slope, field)
        if step % 15 == 14:
            field -= with_volume(field, inside, voxel)
        field = np.where(inside, np.maximum(field, 0), np.minimum(field, 0))
    return triangles(np.where(inside, np.maximum(field, 0.05), np.minimum(field, -0.05)), 0.0, voxel)


def ours(inside: BoolArray, voxel: FloatArray) -> Surface:
    mesh = surface_of_volume(LabelVolume(inside.astype(np.uint8), np.diag([*(voxel * RAS_TO_LPS), 1.0]))).mesh
    return mesh.vertices, mesh.faces


WAYS: dict[str, Callable[[BoolArray, FloatArray], Surface]] = {
    "marching cubes of the labels": binary,
    "Gaussian of the labels, level 0.5": gauss_half,
    "Gaussian of the labels, volume kept": gauss_volume,
    "Gaussian of the distance, level 0": distance_zero,
    "Gaussian of the distance, volume kept, each voxel keeps its side": kept_sides,
    "thin plate, volume kept, each voxel keeps its side": thin_plate,
    "as chosen: Gaussian of the distance, volume kept, half a voxel of play": ours,
}


def errors(surface: Surface, truth: Truth) -> tuple[float, float, float]:
    """Return mean and 95th percentile of the distances of points on the surface from the truth, and of the volume."""
    points, faces = surface
    if not len(faces):
        return np.nan, np.nan, -100.0
    rng = np.random.default_rng(0)
    areas = np.linalg.norm(face_vectors(points, faces), axis=1)
    corners = points[faces[rng.choice(len(faces), POINTS, p=areas / areas.sum())]]
    weights = rng.dirichlet((1, 1, 1), POINTS)
    off = truth.distance(np.einsum("nk,nkx->nx", weights, corners))
    return float(off.mean()), float(np.quantile(off, 0.95)), 100 * (volume_of(surface) / truth.volume - 1)


def main() -> None:
    """Print the table of all ways, and that of the objects for the one that is chosen."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--places", type=int, default=4)
    places = options.parse_args().places
    cases = [(slice_mm, noise) for noise in (0.0, NOISE_MM) for slice_mm in (1.0, 3.0)]
    found: dict[tuple[str, float, float, str], list[tuple[float, float, float]]] = defaultdict(list)
    seconds: dict[str, float] = defaultdict(float)
    for slice_mm, noise in cases:
        for seed in range(places):
            for truth in truths(slice_mm, noise, seed):
                inside = largest(truth.inside)
                for way, make in WAYS.items():
                    start = time.process_time()
                    surface = make(inside, truth.voxel_mm)
                    seconds[way] += time.process_time() - start
                    found[way, slice_mm, noise, truth.name].append(errors(surface, truth))
    names = list(dict.fromkeys(key[3] for key in found))
    told = [f"{'noise, ' if noise else ''}1 x 1 x {slice_mm:g} mm" for slice_mm, noise in cases]
    print(f"| way | {' | '.join(told)} | ball 3 | s |\n|---|{'---|' * (len(cases) + 2)}")
    for way in WAYS:
        cells = []
        for slice_mm, noise in cases:
            every = np.concatenate([found[way, slice_mm, noise, name] for name in names])
            lost = int(np.isnan(every[:, 0]).sum())
            cells.append(
                "{:.2f}, {:.2f}".format(*np.nanmean(every[:, :2], axis=0)) + (f" ({lost} lost)" if lost else "")
            )
        small = np.mean([row[2] for row in found[way, 1.0, 0.0, "ball 3"]])
        print(f"| {way} | {' | '.join(cells)} | {small:+.0f} % | {seconds[way]:.1f} |")
    print(f"\n| object | {' | '.join(told)} |\n|---|{'---|' * len(cases)}")
    for name in names:
        cells = ["{:.2f}, {:.2f}, {:+.1f} %".format(*np.mean(found[way, s, n, name], axis=0)) for s, n in cases]
        print(f"| {name} | {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
