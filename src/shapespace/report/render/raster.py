"""Compiled loops of the renderer: visibility of triangles and balls, and interpolation."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from shapespace.compiled import compiled
from shapespace.types import FloatArray, IntArray

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
        screen: (V, 2) pixels, y down; not-a-number drops the triangles of a vertex.
        depth: (V,) linear across a triangle on the screen, growing away from the eye.
        faces: (F, 3).
        width: of the picture in pixels.
        height: of the picture in pixels.
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
        triangle_index: (n,) the triangle of each.
        screen: (V, 2) pixels.
        nearness: (V,) one over the distance from the eye, or one where the picture is orthographic.
        faces: (F, 3).
        normals: (V, 3) unit normals as seen from the eye.
        scalars: (V,), or (0,) for none.
        categories: whether scalars are codes, of which the one with the largest share is taken.
        width: of the picture in pixels.
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
        screen: (V, 2) pixels, y down; not-a-number drops a ball.
        depth_mm: (V,) of the balls' centres.
        radius: of the balls in pixels.
        rise_mm: how far a ball stands out before its centre, mm.
        width: of the picture in pixels.
        height: of the picture in pixels.
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
