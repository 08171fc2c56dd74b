"""Renderer of meshes and point clouds by a z-buffer: no GPU, no window, reproducible to the byte.

The nearest triangle of each pixel is found first; normals and scalars are interpolated only where they are visible.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from shapespace.compiled import compiled
from shapespace.errors import InputError
from shapespace.geometry.normals import vertex_normals
from shapespace.io.memory_cache import cached_with_owner
from shapespace.report.render.palette import CLAY, DIVERGING, PARTS, SEQUENTIAL, UNKNOWN_COLOUR, Colour
from shapespace.types import FloatArray, IntArray, Mesh, read_only

Image: TypeAlias = npt.NDArray[np.uint8]
"""(H, W, 3) uint8, sRGB."""
_Single: TypeAlias = npt.NDArray[np.float32]

SQUARE_COLOURS = 5
"""Number of colours that the squares of a checkerboard take in turn."""

_LARGEST_SIDE = 8192  # pixels; limit on memory
_SUPERSAMPLE = 2  # samples per pixel and axis
_GAMMA = 2.2  # approximation of the sRGB transfer function
# Powers of every pixel would take as long as finding what it shows.
_SRGB = np.round(255.0 * ((np.arange(65536) + 0.5) / 65536) ** (1 / _GAMMA)).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Camera:
    """Viewpoint of a picture; share one in a row so that its panels can be compared.

    With yaw and pitch 0 it looks along -z with +y up: the front of a face that looks along +z.

    Args:
        centre: (3,) point in the middle of the picture, mm.
        height_mm: height of the visible area at the depth of the centre, mm.
        yaw_deg: rotation of the object to the picture's right, degrees.
        pitch_deg: downward tilt of the object's front, degrees.
        distance_mm: distance of the eye from the centre, mm; None for an orthographic picture.

    Raises:
        InputError: a height or distance that is not positive.
    """

    centre: FloatArray
    height_mm: float
    yaw_deg: float = 0.0
    pitch_deg: float = 0.0
    distance_mm: float | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", read_only(self.centre))
        if self.centre.shape != (3,) or not np.isfinite(self.centre).all():
            raise InputError("The centre of a camera must be 3 finite numbers.")
        if not (np.isfinite(self.height_mm) and self.height_mm > 0):
            raise InputError(f"The height seen by a camera must be positive, not {self.height_mm!r} mm.")
        if self.distance_mm is not None and not self.distance_mm > 0:
            raise InputError(f"The distance of a camera must be positive, not {self.distance_mm!r} mm.")

    @staticmethod
    def framing(
        points: npt.ArrayLike,
        *,
        yaw_deg: float = 0.0,
        pitch_deg: float = 0.0,
        aspect: float = 1.0,
        margin: float = 0.06,
        perspective: bool = True,
    ) -> Camera:
        """Return a camera that sees all `points` (N, 3) in a picture `aspect` times as wide as high.

        Raises:
            InputError: no points, or points that are not finite.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        if not len(points) or not np.isfinite(points).all():
            raise InputError("A camera needs at least one point to look at, and all of them finite.")
        axes = _view_axes(yaw_deg, pitch_deg)
        projected = axes @ points.T
        low, high = projected.min(axis=1), projected.max(axis=1)
        extent = high - low
        height = float(max(extent[1], extent[0] / aspect, 1e-6)) * (1 + 2 * margin)
        centre = ((low + high) / 2) @ axes
        if not perspective:
            return Camera(centre, height, yaw_deg, pitch_deg)
        distance = 5.0 * height + float(extent[2])
        # Nearer parts grow in perspective, so the height is that of the point which reaches farthest out.
        x, y, z = projected - ((low + high) / 2)[:, None]
        growth = distance / (distance - z)
        half_height = max(float((np.abs(y) * growth).max()), float((np.abs(x) * growth).max()) / aspect, 1e-6)
        grown = 2 * half_height * (1 + 2 * margin)
        return Camera(centre, grown, yaw_deg, pitch_deg, distance)


@dataclass(frozen=True, eq=False)
class Layer:
    """One mesh or point cloud in a picture, in one colour or coloured by a scalar.

    Args:
        mesh: vertices in mm; without faces each vertex is drawn as a small ball.
        colour: colour of a layer without scalars.
        scalars: (V,) float64, one per vertex; values that are not finite are drawn in grey.
        colormap: (N, 3) colours from `vmin` to `vmax`; few colours give bands with sharp edges.
        vmin: scalar of the first colour.
        vmax: scalar of the last colour.
        point_radius_mm: radius of the balls of a point cloud; None derives it from the spacing and shades them as the
            surface that they lie on.
        categories: whether the scalars are codes: a pixel has the code of most of its triangle, not a mean.
        across: (V,) float64, second scalar: the surface is then a checkerboard of squares between consecutive integers
            of each scalar. The first colour is that of every other square, the others take turns.

    Raises:
        InputError: scalars without a map, of another length, or an empty range.
    """

    mesh: Mesh
    colour: Colour = CLAY
    scalars: FloatArray | None = None
    colormap: FloatArray | None = None
    vmin: float = 0.0
    vmax: float = 1.0
    point_radius_mm: float | None = None
    categories: bool = False
    across: FloatArray | None = None

    def __post_init__(self) -> None:
        if self.scalars is None:
            return
        name = self.mesh.name
        for field_name, field_values in (("scalars", self.scalars), ("across", self.across)):
            if field_values is None:
                continue
            values = read_only(field_values)
            object.__setattr__(self, field_name, values)
            if values.shape != (len(self.mesh.vertices),):
                raise InputError(
                    f"{name} has {len(self.mesh.vertices)} vertices but the scalars have the shape {values.shape}."
                )
        if self.colormap is None or np.ndim(self.colormap) != 2 or np.shape(self.colormap)[1] != 3:
            raise InputError(f"{name}: scalars need a colour map of the shape (N, 3).")
        if not self.vmax > self.vmin:
            raise InputError(f"{name}: the scale from {self.vmin} to {self.vmax} is empty.")


def distance_layer(mesh: Mesh, distances_mm: FloatArray, limit_mm: float, *, signed: bool) -> Layer:
    """Return a layer coloured by distances, on a scale whose end is `limit_mm`.

    Args:
        mesh: the surface or points.
        distances_mm: (V,) signed distances, mm; NaN is drawn in grey.
        limit_mm: end of the scale, mm; positive.
        signed: whether the signs have a meaning; those of distances to a point cloud have none.
    """
    if signed:
        return Layer(mesh, scalars=distances_mm, colormap=DIVERGING, vmin=-limit_mm, vmax=limit_mm)
    return Layer(mesh, scalars=np.abs(distances_mm), colormap=SEQUENTIAL, vmax=limit_mm)


_PART_COLOURS = np.array(PARTS)


def part_layer(mesh: Mesh, labels: npt.NDArray[np.integer[Any]] | None) -> Layer:
    """Return a layer in the colours of its parts.

    Args:
        mesh: the surface or points.
        labels: (V,) index of the part of each vertex; None for one part, which has the colour of layers.
    """
    if labels is None:
        return Layer(mesh)
    codes, end = np.asarray(labels % len(PARTS), dtype=np.float64), len(PARTS) - 0.5
    return Layer(mesh, scalars=codes, colormap=_PART_COLOURS, vmin=-0.5, vmax=end, categories=True)


@dataclass(frozen=True, eq=False)
class _Surfels:
    """Rasterised layer: position, depth and colour of each covered pixel."""

    pixel: npt.NDArray[np.int64]
    depth_mm: _Single
    normal: _Single  # (3, n), as seen from the eye
    scalar: _Single  # (n,), or (0,) if the layer has no scalars
    back: npt.NDArray[np.bool_]
    occlusion: _Single


def render(
    *layers: Layer, camera: Camera, size: tuple[int, int] = (480, 560), supersample: int = _SUPERSAMPLE
) -> Image:
    """Render layers on white, the nearest layer in each pixel.

    Args:
        layers: layers to draw.
        camera: camera of the picture.
        size: (width, height) in pixels.
        supersample: samples per pixel and axis.

    Returns:
        (height, width, 3) uint8.

    Raises:
        InputError: a size or supersample that is not a small positive integer.
    """
    return render_series([layers], camera=camera, size=size, supersample=supersample)[0]


def render_series(
    pictures: Sequence[Sequence[Layer]],
    *,
    camera: Camera,
    size: tuple[int, int] = (480, 560),
    supersample: int = _SUPERSAMPLE,
) -> list[Image]:
    """Render several pictures from one camera; layers in several pictures are rasterised once.

    Arguments and errors as in `render`.
    """
    if supersample < 1 or min(size) < 1 or max(size) * supersample > _LARGEST_SIDE:
        raise InputError(
            f"A picture of {size[0]} x {size[1]} pixels with {supersample} samples each way cannot be drawn; "
            f"each side times the samples must be 1 to {_LARGEST_SIDE}."
        )
    fine = (size[0] * supersample, size[1] * supersample)
    surfels_by_key: dict[tuple[object, ...], _Surfels] = {}
    pieces: dict[int, tuple[_Single, _Surfels]] = {}
    for layer in {id(layer): layer for layers in pictures for layer in layers}.values():
        # Layers have views of their scalars; all views of an array have one address.
        scalars = None if layer.scalars is None else layer.scalars.ctypes.data
        cache_key = (
            id(layer.mesh),
            scalars,
            (None if layer.across is None else layer.across.ctypes.data),
            layer.point_radius_mm,
            layer.categories,
        )
        if cache_key not in surfels_by_key:
            surfels_by_key[cache_key] = _surfels(layer, camera, fine, supersample)
        pieces[id(layer)] = (_shade(layer, surfels_by_key[cache_key]), surfels_by_key[cache_key])
    return [_compose_layers([pieces[id(layer)] for layer in layers], size, supersample) for layers in pictures]


def _compose_layers(pieces: Sequence[tuple[_Single, _Surfels]], size: tuple[int, int], supersample: int) -> Image:
    """Return the nearest of shaded layers in each sample, averaged over those of each pixel, as sRGB."""
    width, height = size
    count = width * height * supersample**2
    out, nearest = np.ones((count, 3), dtype=np.float32), np.full(count, np.inf, dtype=np.float32)
    for colours, surfels in pieces:
        merge_nearer(surfels.pixel, colours, surfels.depth_mm, out, nearest)
    image = np.empty((height, width, 3), dtype=np.uint8)
    average_pixels(out.reshape(height * supersample, width * supersample, 3), supersample, _SRGB, image)
    return image


def visible_triangles(mesh: Mesh, *, camera: Camera, size: tuple[int, int]) -> tuple[IntArray, FloatArray]:
    """Return the triangle that each pixel shows, and its depth.

    Args:
        mesh: mesh with faces.
        camera: camera of the picture.
        size: (width, height) in pixels.

    Returns:
        (H, W) int32 index of the nearest triangle at the pixel's centre, -1 without a triangle, and (H, W)
        float64 depth, growing away from the eye (infinite without a triangle). Its unit is mm for an
        orthographic camera; in perspective it is -1/mm.
    """
    screen, depth = _project(mesh.vertices, camera, size)
    faces = mesh.faces if mesh.faces is not None else np.zeros((0, 3), dtype=np.int32)
    triangle, nearest = _rasterise(screen, depth, faces, size)
    shape = (size[1], size[0])
    return triangle.astype(np.int32).reshape(shape), nearest.reshape(shape)


def _view_axes(yaw_deg: float, pitch_deg: float) -> FloatArray:
    """Return a (3, 3) matrix whose rows are the directions right, up and towards the eye, in world coordinates."""
    yaw, pitch = np.radians([yaw_deg, pitch_deg])
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    tilt = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    return tilt @ turn


def _project(points: FloatArray, camera: Camera, size: tuple[int, int]) -> tuple[FloatArray, FloatArray]:
    """Return pixel positions (N, 2), y down, and depths (N,) that are linear across a triangle on the screen."""
    width, height = size
    camera_points = (points - camera.centre) @ _view_axes(camera.yaw_deg, camera.pitch_deg).T
    pixels_per_mm = height / camera.height_mm
    if camera.distance_mm is None:
        scale, depth = np.full(len(camera_points), pixels_per_mm), -camera_points[:, 2]
    else:
        away = camera.distance_mm - camera_points[:, 2]
        # Behind the eye there is no picture: NaN drops the triangle.
        away = np.where(away > 0.05 * camera.distance_mm, away, np.nan)
        scale, depth = pixels_per_mm * camera.distance_mm / away, -1.0 / away
    screen = np.stack([width / 2 + camera_points[:, 0] * scale, height / 2 - camera_points[:, 1] * scale], axis=1)
    return screen, depth


def _depth_mm(depth: FloatArray, camera: Camera) -> FloatArray:
    """Turn the depth of `_project` into mm behind the camera's centre."""
    return depth if camera.distance_mm is None else -1.0 / depth - camera.distance_mm


def _rasterise(
    screen: FloatArray, depth: FloatArray, faces: IntArray, size: tuple[int, int]
) -> tuple[IntArray, FloatArray]:
    """Return for each pixel, row by row, the nearest triangle at its centre (-1 for none) and its depth."""
    count = size[0] * size[1]
    triangle, nearest = np.empty(count, dtype=np.int32), np.empty(count)
    nearest_triangles(screen, depth, faces, size[0], size[1], triangle, nearest)
    return triangle, nearest


_vertex_normals = cached_with_owner()(vertex_normals)
"""Vertex normals, computed once for all views of a mesh."""


def _surfels(layer: Layer, camera: Camera, size: tuple[int, int], supersample: int) -> _Surfels:
    if layer.mesh.faces is None:
        return _balls(layer, camera, size, supersample)
    vertices, faces = layer.mesh.vertices, layer.mesh.faces
    screen, depth = _project(vertices, camera, size)
    triangle, nearest = _rasterise(screen, depth, faces, size)
    pixel = np.flatnonzero(triangle >= 0)
    # Colours bear single precision.
    normal, is_back = np.empty((3, len(pixel)), dtype=np.float32), np.empty(len(pixel), dtype=np.bool_)
    scalars = read_only(np.zeros(0)) if layer.scalars is None else layer.scalars
    scalar = np.empty(len(pixel) if len(scalars) else 0, dtype=np.float32)
    nearness = np.ones(len(vertices)) if camera.distance_mm is None else -depth
    normals = _vertex_normals(layer.mesh) @ _view_axes(camera.yaw_deg, camera.pitch_deg).T
    interpolate(
        pixel, triangle[pixel], screen, nearness, faces, normals, scalars, layer.categories, size[0],
        normal, scalar, is_back,
    )  # fmt: skip
    if layer.across is not None:
        scratch = np.empty_like(scalar)
        interpolate(
            pixel,
            triangle[pixel],
            screen,
            nearness,
            faces,
            normals,
            layer.across,
            False,
            size[0],
            normal,
            scratch,
            is_back,
        )
        scalar = squares(scalar, scratch)
    depth_mm = _depth_mm(nearest[pixel], camera).astype(np.float32)
    occlusion = _occlusion(pixel, depth_mm, size, supersample, camera)
    return _Surfels(pixel, depth_mm, normal, scalar, is_back, occlusion)


def squares(along: npt.NDArray[np.floating[Any]], across: npt.NDArray[np.floating[Any]]) -> _Single:
    """Return square codes (n,) of a checkerboard: 0 for every second square, the others 1, 2, ... in turn.

    Those nearest to each other differ, also two columns or rows apart, so that neighbouring squares are visible.

    Args:
        along: (n,) positions in one direction, in widths of a square.
        across: (n,) positions in the other direction, in widths of a square.
    """
    column, row = np.floor(along).astype(np.int64), np.floor(across).astype(np.int64)
    turn = (3 * column - row) // 2 % SQUARE_COLOURS
    return np.where((column + row) % 2 == 0, 1 + turn, 0).astype(np.float32)


def _normalise(vectors: _Single) -> _Single:
    """Return (d, n) vectors normalised to length one."""
    squares = vectors[0] ** 2 + vectors[1] ** 2 + vectors[2] ** 2
    return vectors / np.sqrt(np.maximum(squares, 1e-24))


def _balls(layer: Layer, camera: Camera, size: tuple[int, int], supersample: int) -> _Surfels:
    """Draw each vertex as a ball: a disc of pixels with the depth and the normals of a sphere, or of its surface."""
    width, height = size
    own_radius = layer.point_radius_mm
    spacing, surface = (0.0, None) if own_radius is not None else _cloud_surface(layer.mesh)
    radius_mm = _CLOSING * spacing if own_radius is None else own_radius
    screen, depth = _project(layer.mesh.vertices, camera, size)
    behind = _depth_mm(depth, camera)
    radius = max(radius_mm * height / camera.height_mm, 0.75)
    winner, nearest = np.empty(width * height, dtype=np.int32), np.empty(width * height)
    # Balls of a surface are flattened, so that they do not rise above the surface.
    rise_mm = radius_mm if surface is None else 0.3 * radius_mm
    nearest_balls(screen, behind, radius, rise_mm, width, height, winner, nearest)
    pixel = np.flatnonzero(winner >= 0)
    owner = winner[pixel]
    pixel_centres = np.stack([pixel % width + 0.5, pixel // width + 0.5], axis=1)
    flat = (pixel_centres - screen[owner]) / radius * [1.0, -1.0]
    up = np.sqrt(np.clip(1 - (flat**2).sum(axis=1), 0, 1))
    normal = np.concatenate([flat.T, up[None]]).astype(np.float32)
    if surface is not None:
        view_directions = (surface @ _view_axes(camera.yaw_deg, camera.pitch_deg).T).astype(np.float32)
        view_directions *= np.where(view_directions[:, 2:] < 0, np.float32(-1), np.float32(1))
        # A little of the ball is kept, which distinguishes a cloud from a closed surface.
        normal = np.ascontiguousarray(_normalise((view_directions[owner].T + 0.35 * normal).astype(np.float32)))
    scalar = (np.zeros(0) if layer.scalars is None else layer.scalars[owner]).astype(np.float32)
    depth_mm = nearest[pixel].astype(np.float32)
    is_back = np.zeros(len(pixel), dtype=np.bool_)
    return _Surfels(pixel, depth_mm, normal, scalar, is_back, _occlusion(pixel, depth_mm, size, supersample, camera))


_CLOSING = 0.8  # radius of a point's disc in spacings: neighbours overlap, so that a cloud looks closed
_NEIGHBOURS = 10  # nearest points that the spacing of a cloud is the median distance of


@cached_with_owner()
def _cloud_surface(mesh: Mesh) -> tuple[float, FloatArray | None]:
    """Return the spacing of points in mm, and unit normals (V, 3) of either sign; None for too few points."""
    points = mesh.vertices
    if len(points) <= _NEIGHBOURS:
        return 1.0, None
    away, near = cast(tuple[FloatArray, npt.NDArray[np.int64]], cKDTree(points).query(points, k=_NEIGHBOURS))
    offset = points[near] - points[near].mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", offset, offset))[1][:, :, 0]
    return float(np.median(away[:, 4])), np.asarray(normals)


def point_spacing(mesh: Mesh) -> float:
    """Return the typical distance between neighbouring points of a cloud, mm."""
    return _cloud_surface(mesh)[0]


def _direction(x: float, y: float, z: float) -> _Single:
    vector = np.array([x, y, z])
    return (vector / np.linalg.norm(vector)).astype(np.float32)


_KEY = _direction(-0.50, 0.58, 0.64)
_FILL = _direction(0.80, 0.05, 0.60)
_WARM, _COOL = np.array([[1.00, 0.965, 0.92], [0.86, 0.95, 1.10]], dtype=np.float32)
_HALF = _direction(*(float(v) for v in _KEY + np.array([0, 0, 1])))
_LIGHTS = np.stack([_KEY, _FILL, _HALF, _WARM, _COOL])


def _linear(colours: npt.ArrayLike) -> _Single:
    return (np.atleast_2d(np.asarray(colours, dtype=np.float64)) ** _GAMMA).astype(np.float32)


def _shade(layer: Layer, surfels: _Surfels) -> _Single:
    """Return linear colours (n, 3)."""
    out = np.empty((len(surfels.pixel), 3), dtype=np.float32)
    shade_pixels(
        surfels.normal,
        surfels.scalar,
        _linear(layer.colour if layer.scalars is None or layer.colormap is None else layer.colormap),
        _linear(UNKNOWN_COLOUR)[0],
        float(layer.vmin),
        float(layer.vmax),
        layer.scalars is not None and layer.across is None,
        _LIGHTS,
        surfels.occlusion,
        surfels.back,
        out,
    )
    return out


def _occlusion(
    pixel: npt.NDArray[np.int64], depth_mm: _Single, size: tuple[int, int], supersample: int, camera: Camera
) -> _Single:
    """Return (n,) in (0, 1]: darker where a point lies behind its neighbours' mean depth (Luft et al. 2006)."""
    width, height = size
    depth = np.full((height, width), np.nan, dtype=np.float32)
    depth.ravel()[pixel] = depth_mm
    depth = depth[::supersample, ::supersample]
    is_surface = np.isfinite(depth)
    both = (is_surface.astype(np.float32), np.where(is_surface, depth, np.float32(0)))
    out = np.ones(len(pixel), dtype=np.float32)
    # The wide one shades the eye sockets and below the chin, the narrow one draws lips, lids and folds.
    for radius_share, max_depth, strength in ((0.026, 0.035, 26.0), (0.007, 0.010, 42.0)):
        sigma = radius_share * height / supersample
        weights = np.exp(-0.5 / sigma**2 * np.arange(int(2.5 * sigma + 0.5) + 1) ** 2)
        weights /= weights[0] + 2 * weights[1:].sum()
        total, mean = (blur(values, weights) for values in both)
        mean /= np.maximum(total, np.float32(1e-6))
        around = mean.repeat(supersample, axis=0).repeat(supersample, axis=1).ravel()[pixel]
        depth_behind = np.clip(depth_mm - around, 0, max_depth * camera.height_mm)
        out *= np.exp(np.float32(-strength / camera.height_mm) * depth_behind)
    return out


def blur(image: _Single, weights: FloatArray) -> _Single:
    """Return an image blurred by a symmetric separable filter; beyond its edges it is mirrored.

    Args:
        image: (height, width).
        weights: (n,) weights at 0, 1, ... n - 1 pixels.
    """
    reach = len(weights) - 1
    for _ in range(2):
        blurred = np.empty_like(image)
        blur_columns(np.pad(image, ((reach, reach), (0, 0)), mode="symmetric"), weights, blurred)
        image = np.ascontiguousarray(blurred.T)
    return image


@compiled
def blur_columns(image: npt.NDArray[np.float32], weights: FloatArray, out: npt.NDArray[np.float32]) -> None:
    """Blur the columns of an image.

    The inner loop runs along a row, so that it is vectorised, unlike that of `scipy.ndimage`; the result is equal.

    Args:
        image: (height + 2 (n - 1), width), with n - 1 rows beyond each edge.
        weights: (n,) weights at 0, 1, ... n - 1 pixels.
        out: (height, width), written.
    """
    reach = len(weights) - 1
    total = np.empty(out.shape[1])
    for row in range(out.shape[0]):
        total[:] = weights[0] * image[row + reach]
        for k in range(reach, 0, -1):
            above, below, weight = image[row + reach - k], image[row + reach + k], weights[k]
            for column in range(len(total)):
                total[column] += (np.float64(above[column]) + np.float64(below[column])) * weight
        out[row] = total


_TINY = 1e-9  # pixels; keeps triangles that share an edge without gaps


@compiled
def nearest_triangles(
    screen: FloatArray,
    depth: FloatArray,
    faces: IntArray,
    width: int,
    height: int,
    triangle: npt.NDArray[np.int32],
    nearest: FloatArray,
) -> None:
    """Fill in for each pixel, row by row, the nearest triangle at its centre (-1 for none) and its depth.

    A triangle is cut into rows, and a row into the exact span of pixel centres inside it. Of equally near triangles the
    first one stays.

    Args:
        screen: (V, 2) pixels, y down; NaN drops the triangles of a vertex.
        depth: (V,) linear across a triangle on the screen, growing away from the eye.
        faces: (F, 3).
        width: width of the picture, pixels.
        height: height of the picture, pixels.
        triangle: (height * width,), written.
        nearest: (height * width,), written.
    """
    triangle[:] = -1
    nearest[:] = np.inf
    for t in range(len(faces)):
        a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
        xa, ya, za = screen[a, 0], screen[a, 1], depth[a]
        xb, yb, zb = screen[b, 0], screen[b, 1], depth[b]
        xc, yc, zc = screen[c, 0], screen[c, 1], depth[c]
        if not math.isfinite(za + zb + zc + xa + xb + xc):
            continue
        area = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
        if abs(area) <= 1e-12:
            continue
        if area < 0:
            xa, ya, za, xc, yc, zc = xc, yc, zc, xa, ya, za
            area = -area
        if max(xa, xb, xc) <= 0 or min(xa, xb, xc) >= width or max(ya, yb, yc) <= 0 or min(ya, yb, yc) >= height:
            continue
        slope_x = ((zb - za) * (yc - ya) - (zc - za) * (yb - ya)) / area
        slope_y = ((xb - xa) * (zc - za) - (xc - xa) * (zb - za)) / area
        closest, farthest = min(za, zb, zc), max(za, zb, zc)
        top = max(int(np.ceil(min(ya, yb, yc) - 0.5 - _TINY)), 0)
        bottom = min(int(np.floor(max(ya, yb, yc) - 0.5 + _TINY)), height - 1)
        for row in range(top, bottom + 1):
            y = row + 0.5
            low, high = 0.0, float(width)
            # Inside is rise * x <= reach for each edge of a triangle that turns the positive way.
            for edge in range(3):
                if edge == 0:
                    px, py, qx, qy = xa, ya, xb, yb
                elif edge == 1:
                    px, py, qx, qy = xb, yb, xc, yc
                else:
                    px, py, qx, qy = xc, yc, xa, ya
                rise = qy - py
                if rise != 0.0:
                    crossing = (rise * px + (qx - px) * (y - py)) / rise
                    if rise > 0.0:
                        high = min(high, crossing)
                    else:
                        low = max(low, crossing)
            left = max(int(np.ceil(low - 0.5 - _TINY)), 0)
            right = min(int(np.floor(high - 0.5 + _TINY)), width - 1)
            for column in range(left, right + 1):
                # A sliver's slopes are mostly rounding: its depth stays between its corners.
                value = za + slope_x * (column + 0.5 - xa) + slope_y * (y - ya)
                value = min(max(value, closest), farthest)
                pixel = row * width + column
                if value < nearest[pixel]:
                    nearest[pixel] = value
                    triangle[pixel] = t


@compiled
def interpolate(
    pixel: npt.NDArray[np.int64],
    triangle_index: npt.NDArray[np.int32],
    screen: FloatArray,
    nearness: FloatArray,
    faces: IntArray,
    normals: FloatArray,
    scalars: FloatArray,
    categories: bool,
    width: int,
    normal: npt.NDArray[np.float32],
    scalar: npt.NDArray[np.float32],
    is_back: npt.NDArray[np.bool_],
) -> None:
    """Fill in the normal, the scalar and the side of each covered pixel.

    Args:
        pixel: (n,) covered pixels, row by row.
        triangle_index: (n,) index of the triangle of each pixel.
        screen: (V, 2) pixels.
        nearness: (V,) one over the distance from the eye, or one for an orthographic camera.
        faces: (F, 3).
        normals: (V, 3) unit normals as seen from the eye.
        scalars: (V,), or (0,) for none.
        categories: whether scalars are codes, of which the one with the largest share is taken.
        width: width of the picture, pixels.
        normal: (3, n), written: of unit length, towards the eye.
        scalar: (n,) or (0,), written.
        is_back: (n,), written: whether the triangle is seen from behind.
    """
    for i in range(len(pixel)):
        x, y = pixel[i] % width + 0.5, pixel[i] // width + 0.5
        a, b, c = faces[triangle_index[i], 0], faces[triangle_index[i], 1], faces[triangle_index[i], 2]
        ax, ay = screen[a, 0] - x, screen[a, 1] - y
        bx, by = screen[b, 0] - x, screen[b, 1] - y
        cx, cy = screen[c, 0] - x, screen[c, 1] - y
        wa, wb, wc = bx * cy - by * cx, cx * ay - cy * ax, ax * by - ay * bx
        area = wa + wb + wc
        # On the screen y points down, so a triangle that faces the eye turns the negative way.
        is_back_facing = area > 0
        is_back[i] = is_back_facing
        if area == 0:
            area = 1.0
        wa = min(max(wa / area, 0.0), 1.0) * nearness[a]
        wb = min(max(wb / area, 0.0), 1.0) * nearness[b]
        wc = min(max(wc / area, 0.0), 1.0) * nearness[c]
        total = max(wa + wb + wc, 1e-30)
        wa, wb, wc = wa / total, wb / total, wc / total
        nx = wa * normals[a, 0] + wb * normals[b, 0] + wc * normals[c, 0]
        ny = wa * normals[a, 1] + wb * normals[b, 1] + wc * normals[c, 1]
        nz = wa * normals[a, 2] + wb * normals[b, 2] + wc * normals[c, 2]
        length = math.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-24))
        if is_back_facing:
            length = -length
        normal[0, i], normal[1, i], normal[2, i] = nx / length, ny / length, nz / length
        if len(scalars):
            va, vb, vc = scalars[a], scalars[b], scalars[c]
            if not categories:
                scalar[i] = wa * va + wb * vb + wc * vc
                continue
            share_a = wa + (wb if vb == va else 0.0) + (wc if vc == va else 0.0)
            share_b = wb + (wa if vb == va else 0.0) + (wc if vc == vb else 0.0)
            share_c = wc + (wa if vc == va else 0.0) + (wb if vc == vb else 0.0)
            scalar[i] = va if share_a >= share_b and share_a >= share_c else vb if share_b >= share_c else vc


@compiled
def nearest_balls(
    screen: FloatArray,
    depth_mm: FloatArray,
    radius: float,
    rise_mm: float,
    width: int,
    height: int,
    ball: npt.NDArray[np.int32],
    nearest: FloatArray,
) -> None:
    """Fill in for each pixel, row by row, the ball whose surface is nearest at its centre (-1 for none), and its depth.

    Args:
        screen: (V, 2) pixels, y down; NaN drops a ball.
        depth_mm: (V,) depth of the balls' centres.
        radius: radius of the balls, pixels.
        rise_mm: distance of the front of a ball from its centre, mm.
        width: width of the picture, pixels.
        height: height of the picture, pixels.
        ball: (height * width,), written.
        nearest: (height * width,), written.
    """
    ball[:] = -1
    nearest[:] = np.inf
    for k in range(len(screen)):
        x, y = screen[k, 0], screen[k, 1]
        if not math.isfinite(x + y + depth_mm[k]) or x + radius < 0 or y + radius < 0 or x - radius > width:
            continue
        top, bottom = max(int(y - radius), 0), min(int(min(y + radius, height)), height - 1)
        left, right = max(int(x - radius), 0), min(int(min(x + radius, width)), width - 1)
        for row in range(top, bottom + 1):
            for column in range(left, right + 1):
                squared_distance = (column + 0.5 - x) ** 2 + (row + 0.5 - y) ** 2
                if squared_distance <= radius * radius:
                    value = depth_mm[k] - math.sqrt(radius * radius - squared_distance) / radius * rise_mm
                    pixel = row * width + column
                    if value < nearest[pixel]:
                        nearest[pixel] = value
                        ball[pixel] = k


@compiled
def shade_pixels(
    normal: npt.NDArray[np.float32],
    scalar: npt.NDArray[np.float32],
    table: npt.NDArray[np.float32],
    unknown: npt.NDArray[np.float32],
    low: float,
    high: float,
    as_map: bool,
    lights: npt.NDArray[np.float32],
    occlusion: npt.NDArray[np.float32],
    is_back: npt.NDArray[np.bool_],
    out: npt.NDArray[np.float32],
) -> None:
    """Fill in linear colours: soft key, fill and rim light, a little gloss.

    Args:
        normal: (3, n) as seen from the eye.
        scalar: (n,), or (0,) for a surface of one colour.
        table: (N, 3) linear colours from `low` to `high`; the first is that of a surface of one colour.
        unknown: (3,) linear colour where the scalar is not finite.
        low: scalar of the first colour.
        high: scalar of the last colour.
        as_map: whether colours are read by a scale, and shading must leave them alone.
        lights: (5, 3): directions of key, fill and gloss, colours of key and fill.
        occlusion: (n,) in (0, 1].
        is_back: (n,) whether a surface is seen from its inside.
        out: (n, 3), written.
    """
    mapped = len(scalar) > 0
    for i in range(normal.shape[1]):
        x, y, z = normal[0, i], normal[1, i], normal[2, i]
        # Wrapped diffuse light keeps the shadow side of a face readable.
        key = min(max((lights[0, 0] * x + lights[0, 1] * y + lights[0, 2] * z + 0.18) / 1.18, 0.0), 1.0)
        fill = min(max(lights[1, 0] * x + lights[1, 1] * y + lights[1, 2] * z, 0.0), 1.0)
        gloss = min(max(lights[2, 0] * x + lights[2, 1] * y + lights[2, 2] * z, 0.0), 1.0)
        gloss = gloss**32 * occlusion[i]
        rim = min(max(1.0 - abs(z), 0.0), 1.0)
        position, is_known = 0, True
        if mapped:
            is_known = math.isfinite(scalar[i])
            if is_known:
                share = min(max((scalar[i] - low) / (high - low), 0.0), 1.0)
                position = min(int(share * len(table)), len(table) - 1)
        # A map is read by its colours: less shading there, and none of it coloured, so that they stay the scale's.
        plain = (0.50 + 0.48 * key + 0.08 * fill) * (1.0 - 0.45 * rim**4)
        for k in range(3):
            base = table[position, k] if is_known else unknown[k]
            if as_map:
                value = base * plain * occlusion[i] + 0.02 * gloss
            else:
                light = key * lights[3, k] + (0.15 * fill + 0.13 * (0.5 + 0.5 * y)) * lights[4, k] + 0.035
                value = base * light * occlusion[i] + 0.07 * gloss + 0.035 * rim**3
            if is_back[i]:
                value = 0.4 * value + 0.02
            out[i, k] = min(max(value, 0.0), 1.0)


@compiled
def merge_nearer(
    pixel: npt.NDArray[np.int64],
    colours: npt.NDArray[np.float32],
    depth: npt.NDArray[np.float32],
    out: npt.NDArray[np.float32],
    nearest: npt.NDArray[np.float32],
) -> None:
    """Put `colours` (n, 3) of covered pixels (n,) into `out` (m, 3) where `depth` (n,) is below `nearest` (m,)."""
    for i in range(len(pixel)):
        pixel_index = pixel[i]
        if depth[i] < nearest[pixel_index]:
            nearest[pixel_index] = depth[i]
            for k in range(3):
                out[pixel_index, k] = colours[i, k]


@compiled
def average_pixels(
    samples: npt.NDArray[np.float32], supersample: int, srgb: npt.NDArray[np.uint8], out: npt.NDArray[np.uint8]
) -> None:
    """Fill in the mean of the samples of each pixel, as sRGB.

    Args:
        samples: (height * supersample, width * supersample, 3) linear colours in [0, 1].
        supersample: samples per pixel and axis.
        srgb: (65536,) value in sRGB of 65535 times a linear colour.
        out: (height, width, 3), written.
    """
    share = 65535.0 / (supersample * supersample)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            for k in range(3):
                total = 0.0
                for i in range(supersample):
                    for j in range(supersample):
                        total += samples[row * supersample + i, column * supersample + j, k]
                out[row, column, k] = srgb[int(min(max(total * share, 0.0), 65535.0))]
