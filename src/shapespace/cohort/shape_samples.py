"""Samples of completed shapes, next to their surfaces; one sample at a time is in memory."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from shapespace.errors import CorrespondenceError, FileFormatError
from shapespace.geometry.normals import rms_size
from shapespace.io.containers.archives import read_row
from shapespace.types import FloatArray, Mesh

ENDING = ".samples.npz"
"""Ending of the samples of NAME.ply: an array `vertices` (S, V, 3) in the frame and unit of the surface."""
_AGAIN = "write it again with shapespace complete, or remove it"
_FARTHEST = 0.5
"""RMS distance of a sample from its surface, as a share of the size; between shapes of one kind it is below 0.2."""


class ShapeSamples(Protocol):
    """S samples (V, 3) of one shape, indexed by their number; for example an array (S, V, 3)."""

    def __len__(self) -> int: ...

    def __getitem__(self, k: int, /) -> Any: ...


@dataclass(frozen=True)
class SampleFile:
    """The first samples in a file.

    Args:
        path: path of the file.
        count: number of samples that are used.
        n_vertices: number of vertices of each sample.
    """

    path: Path
    count: int
    n_vertices: int

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, k: int, /) -> FloatArray:
        """Return sample k (V, 3).

        Raises:
            FileError: the file cannot be read.
            FileFormatError: it is damaged.
        """
        sample = read_row(self.path, "vertices", k, _AGAIN)[0].astype(np.float64)
        if sample.shape != (self.n_vertices, 3) or not np.isfinite(sample).all():
            raise FileFormatError(f"{self.path}: sample {k + 1} is not finite, or has other vertices; {_AGAIN}.")
        return sample


def find_samples(file: Path, mesh: Mesh, most: int) -> SampleFile | None:
    """Return the first `most` samples of the surface in NAME.ply, from NAME.samples.npz; None without such a file.

    Raises:
        FileError: it cannot be read.
        FileFormatError: it is damaged, or has one sample.
        CorrespondenceError: the samples are of another mesh, or in another frame or unit.
    """
    path = file.with_name(f"{file.stem}{ENDING}")
    if not path.is_file():
        return None
    first, count = read_row(path, "vertices", 0, _AGAIN)
    if first.shape != mesh.vertices.shape:
        raise CorrespondenceError(
            f"{path}: its samples have {len(first) if first.ndim else 0} vertices and {file.name} has "
            f"{len(mesh.vertices)}; {_AGAIN}."
        )
    if count < 2:
        raise FileFormatError(f"{path}: one sample does not show any uncertainty; {_AGAIN}.")
    samples = SampleFile(path, min(count, most), len(mesh.vertices))
    off = float(np.sqrt(((samples[0] - mesh.vertices) ** 2).sum(axis=1).mean()))
    if not off <= _FARTHEST * rms_size(mesh.vertices):
        raise CorrespondenceError(
            f"{path}: its samples lie {off:.3g} (RMS) from {file.name}, so they are of another mesh, or in another "
            f"frame or unit; {_AGAIN}."
        )
    return samples
