"""A closed object that is its own mirror image about x = 0, vertex for vertex, and subjects of it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from shapespace.cohort.cohort import Cohort

FLIP = np.array([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Symmetric:
    x: np.ndarray
    faces: np.ndarray
    other: np.ndarray

    @property
    def pairs(self) -> list[tuple[int, int]]:
        return list(enumerate(self.other.tolist()))

    def image(self, fields: np.ndarray) -> np.ndarray:
        return fields[..., self.other, :] * FLIP

    def sides_differ(self, fields: np.ndarray) -> np.ndarray:
        """Return the part of fields (..., V, 3) that changes its sign in the mirror."""
        return (fields - self.image(fields)) / 2.0

    def smooth(self, rng: np.random.Generator, count: int, length: float = 25.0) -> np.ndarray:
        """Return (count, V, 3) random fields, smooth over `length`, of variance about 1."""
        waves, phases = rng.standard_normal((30, 3)) / length, rng.uniform(0, 2 * np.pi, (count, 30))
        heights = rng.standard_normal((count, 30, 3)) * np.sqrt(2 / 30)
        return np.einsum("cvw,cwd->cvd", np.cos(self.x @ waves.T + phases[:, None]), heights)


def symmetric_object(half: int = 60, ring: int = 14) -> Symmetric:
    k = np.arange(2 * half + 6)
    z = 1.0 - (2.0 * k + 1.0) / len(k)
    turn = np.pi * (3.0 - np.sqrt(5.0)) * k
    ball = np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])
    right = ball[ball[:, 0] > 0.05]
    at = np.linspace(0.0, 2.0 * np.pi, ring, endpoint=False)
    directions = np.concatenate([right, right * FLIP, np.column_stack([0 * at, np.cos(at), np.sin(at)])])
    n = len(right)
    other = np.concatenate([np.arange(n, 2 * n), np.arange(n), np.arange(2 * n, 2 * n + ring)])
    faces = ConvexHull(directions).simplices.astype(np.int32)
    a, b, c = (directions[faces[:, j]] for j in range(3))
    inward = np.einsum("fd,fd->f", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    bump = 1 + 0.3 * np.exp((directions[:, 1] - 1) / 0.1) - 0.2 * np.exp((directions[:, 2] - 1) / 0.1)
    x = directions * bump[:, None] / np.linalg.norm(directions / np.array([60.0, 45.0, 35.0]), axis=1)[:, None]
    return Symmetric(x, faces, other.astype(np.int32))


def posed(shapes: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return shapes (N, V, 3), each in a pose of its own."""
    turns = Rotation.random(len(shapes), random_state=rng).as_matrix()
    return np.einsum("nij,nvj->nvi", turns, shapes) + rng.uniform(-80, 80, (len(shapes), 1, 3))


def cohort_of(thing: Symmetric, shapes: np.ndarray, subjects: list[str] | None = None, **columns: object) -> Cohort:
    known = {**columns, **({} if subjects is None else {"subject": subjects})}
    return Cohort.of_shapes(shapes, known, faces=thing.faces, gauge="form")  # type: ignore[arg-type]
