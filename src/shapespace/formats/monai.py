"""MONAI-Physio (PhysioTwin4D): `pca_model.json`, and `pca_mean_surface.vtp` beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from shapespace.errors import FileFormatError, ModelFileError
from shapespace.formats.facts import json_object
from shapespace.formats.model_parts import LinearModel, Modes, scale_columns
from shapespace.io.containers.json_files import check_file
from shapespace.io.files import read_bytes
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.parsing import json_value
from shapespace.types import FloatArray

_MODEL, _SURFACE = "pca_model.json", "pca_mean_surface.vtp"
_LARGEST_BYTES = 2**29  # 512 MiB
_AGAIN = "export the model again"
_KEYS = (b'"eigenvalues"', b'"explained_variance_ratio"')


class Monai:
    """Mean surface and principal components, as a folder, or as the JSON in it."""

    name = "monai-physio"
    title = "MONAI-Physio"
    suffixes: Sequence[str] = ()

    def recognises(self, path: Path, head: bytes) -> bool:
        """Whether it is, or holds, a `pca_model.json`, or JSON that begins with what such a file does."""
        if path.is_dir():
            return (path / _MODEL).is_file() and (path / _SURFACE).is_file()
        if path.suffix.lower() != ".json":
            return False
        return path.name == _MODEL or (head.lstrip()[:1] == b"{" and any(key in head for key in _KEYS))

    def read(self, path: Path) -> LinearModel:
        """As `ModelReader.read`."""
        file = path / _MODEL if path.is_dir() else path
        check_file(file, _LARGEST_BYTES, _AGAIN)
        surface = file.with_name(_SURFACE)
        if not surface.is_file():
            raise ModelFileError(f"{file} needs the surface {_SURFACE} beside it; copy it there.")
        mean = read_mesh(surface)
        tree = json_object(json_value(read_bytes(file), file))
        try:
            components = np.array(tree["components"], dtype=np.float64)
            variance = np.array(tree["eigenvalues"], dtype=np.float64)
            ratio = np.array(tree.get("explained_variance_ratio", ()), dtype=np.float64)
        except (KeyError, ValueError, TypeError, OverflowError) as error:
            raise FileFormatError(f"{file} has no components and eigenvalues of numbers; {_AGAIN}.") from error
        if components.ndim != 2 or components.shape != (variance.size, mean.vertices.size) or (variance < 0).any():
            raise ModelFileError(
                f"{file} has components of the shape {components.shape} and {variance.size} eigenvalues, which do not "
                f"belong to the {len(mean.vertices)} points of {_SURFACE}; {_AGAIN}."
            )
        return LinearModel(
            mean=mean.vertices,
            shape=Modes(scale_columns(components.T, np.sqrt(variance)), total_variance=_total(variance, ratio)),
            faces=mean.faces,
            provenance=f"MONAI-Physio model in {file.parent.name}",
        )


def _total(variance: FloatArray, ratio: npt.NDArray[np.float64]) -> float | None:
    """Return the variance of all modes, those that were cut off too, by the share that the first has."""
    if ratio.shape != variance.shape or not variance.size or not 0 < ratio[0] <= 1:
        return None
    return float(variance[0] / ratio[0])
