"""Conversion of meshes from and to other tools by the attributes of their objects; none of these tools is required."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias, cast, overload

import numpy as np

from shapespace.errors import InputError, MeshError
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.lazy import lazy_import, require_package
from shapespace.types import ByteArray, IntArray, Mesh

MeshLike: TypeAlias = Mesh | str | os.PathLike[str] | Any
"""Input of `as_mesh`: a mesh, a path, or a mesh of another tool."""


def as_mesh(x: MeshLike, name: str = "") -> Mesh:
    """Return `x` as a mesh with its vertices in their order and unit, and polygons split into triangles.

    Vertex colours are kept; textures and other data of other tools are ignored, and landmarks are kept from a `Mesh`
    only.

    Args:
        x: a `Mesh`, which is returned as it is; the path of a mesh file; an object of trimesh, PyVista, Open3D, meshio
            or menpo; an array (V, 3) of points; or vertices (V, 3) and triangles (F, 3) as a pair.
        name: name of the mesh in messages and result files; empty for the name that `x` has, or `mesh`.

    Raises:
        FileError: the file cannot be read.
        InputError: `x` is no such object, or has cells that are not a surface.
        MeshError: arrays of the wrong shape.
    """
    if isinstance(x, Mesh):
        return x
    if isinstance(x, str | os.PathLike):
        return read_mesh(Path(cast("str | os.PathLike[str]", x)))
    mesh_name = name or _name_of(x)
    mesh_parts = _as_simple_mesh(x)
    vertices, faces = _mesh_arrays(mesh_parts, mesh_name)
    try:
        return Mesh(
            np.array(vertices, dtype=np.float64), faces, name=mesh_name, colours=_colours_of(mesh_parts, len(vertices))
        )
    except (TypeError, ValueError) as error:
        if isinstance(error, MeshError):
            raise
        raise InputError(f"{mesh_name}: its vertices are not numbers of the shape (V, 3).") from error


class _MeshSequence(Sequence[Mesh]):
    """A sequence of meshes that are converted when they are accessed."""

    def __init__(self, items: Any) -> None:
        self._items = items

    def __len__(self) -> int:
        return len(self._items)

    @overload
    def __getitem__(self, index: int) -> Mesh: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[Mesh]: ...
    def __getitem__(self, index: int | slice) -> Mesh | Sequence[Mesh]:
        if isinstance(index, slice):
            return _MeshSequence(self._items[index])
        return as_mesh(self._items[index], name=f"mesh {index + 1}")


def as_meshes(items: Any, function: str) -> Sequence[Mesh]:
    """Return a sequence of meshes from anything that `as_mesh` takes; each is converted when it is accessed.

    Args:
        items: a list or another sequence of meshes; an array (N, V, 3); or the path of a folder, of which those meshes
            are read that `build` would use.
        function: name of the function that received `items`, used in messages.

    Raises:
        InputError: `items` is no such sequence. An item that is not a mesh raises it when the item is accessed.
    """
    if isinstance(items, str | os.PathLike) and Path(cast("str | os.PathLike[str]", items)).is_dir():
        return _MeshSequence(lazy_import("trusted_surfaces")(Path(cast("str | os.PathLike[str]", items))))
    if isinstance(items, str | os.PathLike | Mesh) or not (hasattr(items, "__len__") and hasattr(items, "__getitem__")):
        raise InputError(
            f"{function} takes a list of meshes, not {type(cast(object, items)).__name__}; give meshes, their paths, "
            "arrays (V, 3), or a folder of meshes."
        )
    return _MeshSequence(items)


def _as_simple_mesh(x: Any) -> Any:
    """Convert tensors of Open3D and scenes of trimesh to a simple mesh of the same tool."""
    if hasattr(x, "to_legacy"):  # Open3D's tensors
        return x.to_legacy()
    return x.to_mesh() if hasattr(x, "geometry") and hasattr(x, "to_mesh") else x  # a scene of trimesh


def _mesh_arrays(x: Any, mesh_name: str) -> tuple[Any, Any]:
    """Return vertices, and triangles or None."""
    if isinstance(x, np.ndarray):
        return cast(Any, x), None
    if isinstance(x, list | tuple):
        pair = cast(Sequence[Any], x)
        if len(pair) != 2:
            raise InputError(f"{mesh_name}: give vertices and triangles as a pair of arrays, not {len(pair)} things.")
        return pair[0], pair[1]
    if hasattr(x, "points") and hasattr(x, "cells") and hasattr(x, "cells_dict"):  # meshio
        return x.points, _triangles_of_cells(x.cells_dict, mesh_name)
    if hasattr(x, "points") and hasattr(x, "trilist"):  # menpo
        return x.points, x.trilist
    if hasattr(x, "points") and hasattr(x, "n_points"):  # PyVista, and menpo's clouds
        return _pyvista_arrays(x, mesh_name)
    if hasattr(x, "vertices"):  # trimesh and Open3D
        faces = getattr(x, "faces", getattr(x, "triangles", None))
        return x.vertices, None if faces is None or not len(faces) else np.asarray(faces)
    if hasattr(x, "points"):  # Open3D's clouds
        return x.points, None
    raise InputError(
        f"{type(x).__module__}.{type(x).__qualname__} is not a mesh type that shapespace supports; give a "
        "shapespace.Mesh, a path, a mesh of trimesh, PyVista, Open3D, meshio or menpo, or vertices and "
        "triangles as a pair of arrays."
    )


def _triangles_of_cells(cells: Mapping[str, Any], mesh_name: str) -> IntArray | None:
    blocks = [np.asarray(cells["triangle"])] if "triangle" in cells else []
    if "quad" in cells:
        quads = np.asarray(cells["quad"])
        blocks += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    others = sorted(set(cells) - {"triangle", "quad", "vertex", "line"})
    if others:
        raise InputError(
            f"{mesh_name}: it has cells of type {others[0]}, which are not a surface; extract the surface first."
        )
    return np.concatenate(blocks).astype(np.int32) if blocks else None


def _pyvista_arrays(x: Any, mesh_name: str) -> tuple[Any, Any]:
    if not hasattr(x, "faces"):
        if hasattr(x, "extract_surface"):
            raise InputError(f"{mesh_name}: a grid is not a surface; give the result of its extract_surface().")
        return x.points, None
    if not len(x.faces):
        return x.points, None
    if not x.is_all_triangles:
        x = x.triangulate()
    # Each triangle is stored as the number 3 and its three vertices.
    return x.points, np.asarray(x.faces).reshape(-1, 4)[:, 1:]


def _colours_of(x: Any, count: int) -> ByteArray | None:
    """Return the vertex colours (V, 3) of an object of another tool, or None unless each vertex has a colour."""
    values: Any = None
    if getattr(getattr(x, "visual", None), "kind", None) == "vertex":  # trimesh
        values = x.visual.vertex_colors
    elif hasattr(x, "colors"):  # trimesh's and Open3D's clouds
        values = x.colors
    elif hasattr(x, "vertex_colors"):  # Open3D
        values = x.vertex_colors
    elif hasattr(x, "colours"):  # menpo
        values = x.colours
    elif hasattr(x, "point_data"):  # PyVista, and meshio with the columns of PLY
        array_names = {str(name).lower(): name for name in x.point_data}
        if "rgb" in array_names or "rgba" in array_names:
            values = x.point_data[array_names.get("rgb", array_names.get("rgba"))]
        elif {"red", "green", "blue"} <= set(array_names):
            values = np.column_stack(
                [np.asarray(x.point_data[array_names[channel]]) for channel in ("red", "green", "blue")]
            )
    try:
        colours = np.asarray([] if values is None else values)
    except ValueError:
        return None
    if colours.ndim != 2 or len(colours) != count or colours.shape[1] not in (3, 4):
        return None
    colours = colours[:, :3]
    if colours.dtype.kind == "f":
        if not np.isfinite(colours).all():
            return None
        # Open3D and menpo store colours from 0 to 1.
        colours = np.rint(255.0 * np.clip(colours, 0.0, 1.0))
    return np.clip(colours, 0, 255).astype(np.uint8)


def _name_of(x: Any) -> str:
    source_path: Any = getattr(x, "path", None) or getattr(getattr(x, "source", None), "file_name", None)
    metadata: Any = getattr(x, "metadata", None)
    if not source_path and isinstance(metadata, Mapping):
        source_path = cast(Mapping[str, Any], metadata).get("file_name") or cast(Mapping[str, Any], metadata).get(
            "name"
        )
    if not isinstance(source_path, str | os.PathLike):
        return "mesh"
    return Path(cast("str | os.PathLike[str]", source_path)).name or "mesh"


def to_trimesh(mesh: Mesh) -> Any:
    """Return a `trimesh.Trimesh`, or a `trimesh.PointCloud` without triangles; vertices keep their order."""
    trimesh = require_package("trimesh", "Mesh.to_trimesh")
    metadata = {"name": mesh.name}
    colours = None if mesh.colours is None else mesh.colours.copy()
    if mesh.faces is None:
        return trimesh.PointCloud(mesh.vertices.copy(), colors=colours, metadata=metadata)
    return trimesh.Trimesh(
        mesh.vertices.copy(), mesh.faces.copy(), vertex_colors=colours, process=False, metadata=metadata
    )


def to_pyvista(mesh: Mesh) -> Any:
    """Return a `pyvista.PolyData`."""
    pyvista = require_package("pyvista", "Mesh.to_pyvista")
    if mesh.faces is None:
        out = pyvista.PolyData(mesh.vertices.copy())
    else:
        cells = np.insert(mesh.faces.astype(np.int64), 0, 3, axis=1)
        out = pyvista.PolyData(mesh.vertices.copy(), cells.ravel())
    if mesh.colours is not None:
        out.point_data["RGB"] = mesh.colours.copy()
    return out


def to_open3d(mesh: Mesh) -> Any:
    """Return an `open3d.geometry.TriangleMesh`, or a `PointCloud` without triangles."""
    open3d = require_package("open3d", "Mesh.to_open3d")
    points = open3d.utility.Vector3dVector(mesh.vertices.copy())
    colours = None if mesh.colours is None else open3d.utility.Vector3dVector(mesh.colours / 255.0)
    if mesh.faces is None:
        out = open3d.geometry.PointCloud(points)
        if colours is not None:
            out.colors = colours
        return out
    out = open3d.geometry.TriangleMesh(points, open3d.utility.Vector3iVector(mesh.faces.copy()))
    if colours is not None:
        out.vertex_colors = colours
    return out


def to_meshio(mesh: Mesh) -> Any:
    """Return a `meshio.Mesh`."""
    meshio = require_package("meshio", "Mesh.to_meshio")
    cells = np.arange(len(mesh.vertices))[:, None] if mesh.faces is None else mesh.faces.copy()
    point_data = {}
    if mesh.colours is not None:
        point_data = {name: mesh.colours[:, k].copy() for k, name in enumerate(("red", "green", "blue"))}
    return meshio.Mesh(
        mesh.vertices.copy(), [("vertex" if mesh.faces is None else "triangle", cells)], point_data=point_data
    )


def to_menpo(mesh: Mesh) -> Any:
    """Return a `menpo.shape.TriMesh`, or a `PointCloud` without triangles."""
    shape = require_package("menpo.shape", "Mesh.to_menpo")
    if mesh.faces is None:
        return shape.PointCloud(mesh.vertices.copy())
    return shape.TriMesh(mesh.vertices.copy(), trilist=mesh.faces.copy())
