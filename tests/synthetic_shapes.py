"""Small synthetic surfaces that can be triangulated anew: each is a smooth function on the sphere."""

from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

TRUE_MODES = 5
_AMPLITUDES_MM = np.array([6.0, 5.0, 4.0, 3.0, 2.0])


def sphere(count: int, turn: float = 0.0) -> tuple[FloatArray, np.ndarray]:
    """Return `count` evenly spread directions (count, 3) and the triangles of their hull, seen from outside."""
    i = np.arange(count)
    z = 1 - (2 * i + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * i + turn
    d = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
    # Away from z, so that one set's spiral is not the other's.
    d = d @ Rotation.from_rotvec([turn, 2 * turn, 0.0]).as_matrix().T
    faces = ConvexHull(d).simplices.astype(np.int32)
    a, b, c = (d[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return d, faces


def _bump(d: FloatArray, at: tuple[float, float, float], width: float) -> FloatArray:
    centre = np.array(at) / np.linalg.norm(at)
    return np.exp((d @ centre - 1) / width)[:, None]


def blob(d: FloatArray, z: FloatArray) -> FloatArray:
    """Return the points (M, 3), mm, of the blob with `z` (5,) in directions `d` (M, 3): lopsided, with a nose."""
    base = (
        d
        * np.array([70.0, 100.0, 85.0])
        * (1 + 0.35 * _bump(d, (0, -0.1, 1), 0.05) + 0.15 * _bump(d, (1, 1, 0.3), 0.1))
    )
    x, y, w = d.T[:, :, None]
    fields = np.stack(
        [
            d * _bump(d, (0, -0.8, 0.8), 0.15),
            np.array([0, 0, 1.0]) * _bump(d, (0, 0.3, 1), 0.1),
            d * (x * y),
            np.array([0, 1.0, 0.3]) * _bump(d, (-0.8, 0.2, 0.5), 0.2),
            d * np.sin(4 * y + w) * 0.7,
        ]
    )
    return base + np.tensordot(z * _AMPLITUDES_MM, fields, axes=1)


@cache
def training_meshes(count: int = 40, vertices: int = 700, seed: int = 0) -> tuple[Mesh, ...]:
    d, faces = sphere(vertices)
    rng = np.random.default_rng(seed)
    return tuple(Mesh(blob(d, z), faces, name=f"blob_{i}.ply") for i, z in enumerate(rng.standard_normal((count, 5))))


@cache
def blob_model(vertices: int = 700, modes: int = TRUE_MODES, gauge: str = "shape") -> ShapeModel:
    landmarks = {"tip": int(sphere(vertices)[0][:, 2].argmax()), "top": int(sphere(vertices)[0][:, 1].argmax())}
    landmarks |= {"left": int(sphere(vertices)[0][:, 0].argmax()), "back": int(sphere(vertices)[0][:, 2].argmin())}
    return ShapeModel.fit(
        training_meshes(vertices=vertices),
        modes=modes,
        gauge=gauge,
        landmarks=landmarks,
        provenance="synthetic blobs",
        licence="CC0",
    )


def similarity(seed: int = 0, degrees: float = 20.0, scale: float = 1.2, shift: float = 50.0) -> Similarity:
    rng = np.random.default_rng(seed)
    axis = rng.standard_normal(3)
    R = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix()
    return Similarity(scale, R, shift * rng.standard_normal(3))


def angle_deg(R: FloatArray) -> float:
    return float(np.degrees(Rotation.from_matrix(R).magnitude()))


@dataclass(frozen=True)
class Raw:
    """A scan of the blob with `z` on its own triangles, and the truth in the model's vertex order."""

    scan: Mesh
    truth: FloatArray
    T_scan_model: Similarity


def raw_scan(
    z: FloatArray,
    T: Similarity | None = None,
    *,
    vertices: int = 2500,
    model_vertices: int = 700,
    noise_mm: float = 0.0,
    keep: float | None = None,
    seed: int = 0,
) -> Raw:
    """Scan the blob with `z`; `keep` drops triangles whose directions lie below that height along x."""
    T = T or Similarity.identity()
    d, faces = sphere(vertices, turn=0.7)
    if keep is not None:
        faces = faces[(d[faces, 0] > keep).all(axis=1)]
        used, faces = np.unique(faces, return_inverse=True)
        d, faces = d[used], faces.reshape(-1, 3)
    points = blob(d, z)
    points = points + noise_mm * np.random.default_rng(seed).standard_normal(points.shape)
    truth = blob(sphere(model_vertices)[0], z)
    return Raw(Mesh(T.apply(points), faces.astype(np.int32), name="raw.ply"), T.apply(truth), T)


def twisted(mesh: Mesh) -> Mesh:
    """Return a mesh that is flattened, and twisted about its longest axis to the right, and so has a side."""
    centred = mesh.vertices - mesh.vertices.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1]
    x, y, z = ((centred @ axes) * [0.4 * np.linalg.det(axes), 0.8, 1.5]).T
    angle = 1.5 * z / np.ptp(z)
    along = np.cos(angle) * x - np.sin(angle) * y
    return mesh.with_vertices(np.stack([along, np.sin(angle) * x + np.cos(angle) * y, z], axis=1))
