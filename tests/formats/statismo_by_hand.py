"""statismo files as their own programs write them, by h5py and the layout of the format alone."""

import dataclasses
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]


@dataclasses.dataclass(frozen=True)
class Truth:
    """A model: mean (V, 3), orthonormal basis (3V, K), variances (K,), triangles (F, 3)."""

    mean: Array
    basis: Array
    variance: Array
    faces: Array

    @property
    def covariance(self) -> Array:
        return (self.basis * self.variance) @ self.basis.T


def truth(seed: int = 0, k: int = 4) -> Truth:
    """Return an octahedron with random modes, in single precision."""
    rng = np.random.default_rng(seed)
    mean = np.array([[60, 0, 0], [-60, 0, 0], [0, 50, 0], [0, -50, 0], [0, 0, 40], [0, 0, -40]], dtype=np.float32)
    faces = np.array(
        [[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]], dtype=np.int32
    )
    basis = np.linalg.qr(rng.normal(size=(18, k)))[0].astype(np.float32)
    return Truth(mean, basis, np.array([90.0, 40.0, 11.0, 3.0], dtype=np.float32)[:k], faces)


def scalar_text(group: Any, name: str, text: str) -> None:
    """Write a text as C++ does: one, of fixed length, its last zero counted."""
    group.create_dataset(name, data=np.array(text.encode() + b"\0", dtype=f"S{len(text) + 1}"))


def text_of_java(group: Any, name: str, text: str) -> None:
    """Write a text as scalismo did: a list of one, of fixed length, without a zero."""
    group.create_dataset(name, data=np.array([text.encode()], dtype=f"S{len(text)}"))


def write_version(group: Any, version: tuple[int, int]) -> None:
    group["version/majorVersion"] = np.int32(version[0])
    group["version/minorVersion"] = np.int32(version[1])


def write_numbers(group: Any, one: Truth, basis: Array | None = None, noise: Any = 0.0) -> None:
    group["model/mean"] = one.mean.astype(np.float32).ravel()
    group["model/pcaBasis"] = (one.basis if basis is None else basis).astype(np.float32)
    group["model/pcaVariance"] = one.variance.astype(np.float32)
    group["model/noiseVariance"] = np.array(noise, dtype=np.float32)
    group.require_group("modelinfo")


def write_surface(group: Any, one: Truth, kind: Any = np.int32) -> Any:
    group["representer/points"] = one.mean.T.astype(np.float32)
    group["representer/cells"] = one.faces.T.astype(kind)
    return group["representer"]


def cpp(path: Path, one: Truth, noise: float = 0.0, shapes: int = 9) -> None:
    """statismo in C++: scalar texts, unsigned cells, a scalar noise, scores of every shape; packed."""
    with h5py.File(path, "w") as file:
        write_version(file, (0, 9))
        write_numbers(file, dataclasses.replace(one, variance=one.variance - noise), noise=noise)
        kept = file["model/pcaBasis"][()]  # type: ignore[index]
        del file["model/pcaBasis"]
        file.create_dataset("model/pcaBasis", data=kept, chunks=(6, len(one.variance)), compression="gzip")
        scalar_text(file["modelinfo"], "build-time", "Tue Mar 3")
        file["modelinfo/scores"] = np.random.default_rng(1).normal(size=(len(one.variance), shapes)).astype(np.float32)
        representer = write_surface(file, one, np.uint32)
        for name, value in {
            "name": "vtkStandardMeshRepresenter",
            "datasetType": "POLYGON_MESH",
            "version": "1.0",
        }.items():
            representer.attrs[name] = np.array(value.encode() + b"\0", dtype=f"S{len(value) + 1}")


def scalismo(path: Path, one: Truth, basis: Array | None = None, version: tuple[int, int] = (0, 9)) -> None:
    """scalismo up to 0.91: texts and attributes as lists of one, a slash in names of attributes."""
    with h5py.File(path, "w") as file:
        write_version(file, version)
        write_numbers(file, one, basis, noise=[0.0])
        text_of_java(file["modelinfo"], "build-time", "Sun Aug 23")
        representer = write_surface(file, one)
        told = {"name": "itkStandardMeshRepresenter", "datasetType": "POLYGON_MESH"}
        for name, value in (told | {"version/majorVersion": "0", "version/minorVersion": "9"}).items():
            representer.attrs[name] = np.array([value.encode()], dtype=f"S{len(value)}")


def vtk_text(one: Truth) -> bytes:
    """Return a legacy .vtk file of the mean."""
    points = "\n".join(" ".join(f"{x:g}" for x in row) for row in one.mean)
    cells = "\n".join("3 " + " ".join(map(str, row)) for row in one.faces)
    head = f"# vtk DataFile Version 3.0\nmesh\nASCII\nDATASET POLYDATA\nPOINTS {len(one.mean)} float\n"
    return f"{head}{points}\nPOLYGONS {len(one.faces)} {4 * len(one.faces)}\n{cells}\n".encode()


def version_08(path: Path, one: Truth) -> None:
    """statismo 0.8: modes of the length of their standard deviation, and the surface as a file within the file."""
    with h5py.File(path, "w") as file:
        write_version(file, (0, 8))
        write_numbers(file, one, one.basis * np.sqrt(one.variance))
        file["representer/reference"] = np.frombuffer(vtk_text(one), np.int8)
        file["representer"].attrs["name"] = "vtkPolyDataRepresenter"


def gravis(path: Path, one: Truth) -> None:
    """Before versions were counted: as 0.8, with points and triangles in rows."""
    with h5py.File(path, "w") as file:
        write_numbers(file, one, one.basis * np.sqrt(one.variance))
        file["representer/reference-mesh/vertex-coordinates"] = one.mean
        file["representer/reference-mesh/triangle-list"] = one.faces
        file["representer"].attrs["name"] = "gravis::Mesh Shape Representer"


def in_rows(path: Path, one: Truth) -> None:
    """Others who took the names, with points and triangles in rows."""
    with h5py.File(path, "w") as file:
        write_version(file, (0, 9))
        write_numbers(file, one)
        file["representer/points"], file["representer/cells"] = one.mean, one.faces.astype(np.int64)


def by_catalogue(path: Path, one: Truth) -> None:
    """One model that is not at the root, whose place is told with two slashes; version 1."""
    with h5py.File(path, "w") as file:
        write_version(file, (1, 0))
        group = file.create_group("femur")
        write_numbers(group, one)
        write_surface(group, one)
        scalar_text(file.create_group("catalog/femur"), "modelPath", "//femur")


def momo(path: Path, one: Truth, expression: Truth, landmarks: tuple[str, str] | None = None) -> None:
    """A Morphable Model of scalismo-faces: shape, colour and expression; the mean of expressions is a displacement."""
    with h5py.File(path, "w") as file:
        write_version(file, (0, 9))
        parts = {
            "shape": one,
            "color": dataclasses.replace(one, mean=np.full_like(one.mean, 0.4)),
            "expression": expression,
        }
        for name, part in parts.items():
            group = file.create_group(name)
            write_version(group, (0, 9))
            write_numbers(group, part)
            write_surface(group, one)
            group["representer"].attrs["name"] = f"gravis::Mesh{name.title()}Representer"
            scalar_text(file.create_group(f"catalog/MorphableModel.{name}"), "modelPath", f"//{name}")
        if landmarks is not None:
            kind, text = landmarks
            file[f"metadata/landmarks/{kind}"] = text
