"""Readers and writers of meshes and point clouds, selected by file name ending, and lists of mesh files."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePath
from types import MappingProxyType
from typing import TypeAlias

import numpy as np

from shapespace.errors import FileFormatError, InputError
from shapespace.io.containers.archives import GZIP, unpack_gzip
from shapespace.io.files import open_file, read_bytes, reading, write_bytes
from shapespace.io.meshes.bnt import read_bnt
from shapespace.io.meshes.gltf_mesh import read_gltf, write_glb, write_gltf
from shapespace.io.meshes.mat_mesh import read_mat_mesh
from shapespace.io.meshes.obj import read_obj, write_obj
from shapespace.io.meshes.off import read_off, write_off
from shapespace.io.meshes.ply import probe_ply, read_ply, write_ply
from shapespace.io.meshes.point_clouds import read_pcd, read_xyz
from shapespace.io.meshes.stl import probe_stl, read_stl, write_stl
from shapespace.io.meshes.vrml import read_vrml
from shapespace.io.meshes.vtk import read_vtk, write_vtk, write_vtp
from shapespace.io.read_limits import LARGEST_MESH_FILE_BYTES
from shapespace.reprs import first_names
from shapespace.types import Mesh, require

_PACKED = ".gz"
_PROBED_BYTES = 2**16  # 64 KiB contain any usual header
_Probe: TypeAlias = Callable[[bytes, int, Path], None]
_PROBES: Mapping[str, _Probe] = {".ply": probe_ply, ".stl": probe_stl}
_CONVERT: Mapping[str, str] = {
    ".las": "convert it to PLY",
    ".laz": "convert it to PLY",
    ".raw": "convert a mesh to PLY, a volume to NRRD or NIfTI",
}
"""File name ending -> advice for files that cannot be read."""
_LEFT_OUT: Mapping[str, tuple[str, str, str, str]] = {
    "folder": ("folder", "folders", "searched", "give --recursive to include the {} there"),
    "linked": ("link to a folder", "links to folders", "followed", "give that folder too"),
    "broken": ("broken link", "broken links", "used", "repair or remove it"),
    "packed": ("compressed file", "compressed files", "used", "unpack them with gunzip first"),
}
"""Kind of skipped entry of a folder -> singular, plural, participle for the message, and advice."""


@dataclass(frozen=True)
class MeshFormat:
    """A file format for surfaces.

    Args:
        name: common name of the format.
        read: function (content, path) -> mesh; the path is used in messages and to find companion files.
        write: function mesh -> content.
        exact: whether float64 coordinates are preserved exactly.
        point_clouds: whether it can store points without triangles.
        keeps_vertices: whether order and number of the vertices are preserved.
    """

    name: str
    read: Callable[[bytes, Path], Mesh]
    write: Callable[[Mesh], bytes]
    exact: bool = True
    point_clouds: bool = True
    keeps_vertices: bool = True


def read_mesh(path: Path | str) -> Mesh:
    """Read a surface or point cloud, named after its file.

    Vertices keep the order and number of the file, its frame and its unit (STL has no vertices, only corners:
    equal corners are merged in the order of first appearance). Polygons become fans of triangles.

    Args:
        path: path of a file with one of the endings in `MESH_ENDINGS` or `NAMED_FORMATS`, in upper or lower case,
            optionally compressed by gzip (`.ply.gz`).

    Returns:
        The mesh as in the file, including any defects.

    Raises:
        FileError: it does not exist, cannot be read, is no file, or is longer than `LARGEST_MESH_FILE_BYTES`.
        FileFormatError: the ending is unknown, or the content is not in that format, cut short, damaged, or
            exceeds the limits of `io.read_limits`.
        MeshError: faces that point past the end of the vertices.
    """
    path = Path(path)
    ending = ending_of(path)
    read = READ_ONLY_FORMATS.get(ending) or NAMED_FORMATS.get(ending) or _format(path, "read").read
    data = read_bytes(path, LARGEST_MESH_FILE_BYTES)
    if data.startswith(GZIP):
        data = unpack_gzip(data, path, LARGEST_MESH_FILE_BYTES)
    if not data.strip():
        raise FileFormatError(f"Cannot read {path}: it is empty; export or copy it again.")
    # The mesh doctor reports NaN and infinity; warnings of numpy would be redundant.
    with np.errstate(invalid="ignore", over="ignore"):
        return read(data, path)


def probe_mesh(path: Path) -> None:
    """Check a mesh file by its first 64 KiB and its size, without reading the complete file.

    The file must be readable, have a known ending, not be empty and not be too long; PLY and binary STL must be at
    least as long as their header declares. A file that passes may still be damaged in a later part.

    Raises:
        FileError: see `read_mesh`.
        FileFormatError: see `read_mesh`.
    """
    ending = ending_of(path)
    if ending not in READ_ONLY_FORMATS and ending not in NAMED_FORMATS:
        _format(path, "read")
    with open_file(path) as stream, reading(path):
        size, head = os.fstat(stream.fileno()).st_size, stream.read(_PROBED_BYTES)
    if size > LARGEST_MESH_FILE_BYTES:
        read_bytes(path, LARGEST_MESH_FILE_BYTES)  # raises the error
    if not head.strip():
        raise FileFormatError(f"Cannot read {path}: it is empty; export or copy it again.")
    if not head.startswith(GZIP) and ending in _PROBES:
        _PROBES[ending](head, size, path)


def write_mesh(path: Path | str, mesh: Mesh) -> None:
    """Write `mesh` in the format of the ending of `path`, atomically; landmarks are not written.

    Args:
        path: path of the file, with one of the endings in `MESH_FORMATS`.
        mesh: mesh in any unit; PLY, OBJ, OFF, VTK and VTP store float64 coordinates exactly.

    Raises:
        FileFormatError: the ending is unknown.
        FileError: the folder cannot be written, or the disk is full.
        InputError: the format cannot store this mesh (STL without triangles, float32 overflow).
    """
    require(mesh, Mesh, "write_mesh", "convert it with shapespace.as_mesh")
    path = Path(path)
    write_bytes(path, _format(path, "write").write(mesh))


def ending_of(path: PurePath | str) -> str:
    """Return the ending that determines the format, in lower case: `.ply` of `a.PLY` and of `a.ply.gz`."""
    return _unpacked_name(path).suffix.lower()


def stem_of(path: PurePath | str) -> str:
    """Return the name of a scan without its ending: `a` of `a.ply` and of `a.ply.gz`."""
    return _unpacked_name(path).stem


def _unpacked_name(path: PurePath | str) -> PurePath:
    name = PurePath(path).name
    return PurePath(name[: -len(_PACKED)] if name.lower().endswith(_PACKED) else name)


def _format(path: Path, verb: str) -> MeshFormat:
    ending = ending_of(path) if verb == "read" else path.suffix.lower()
    mesh_format = MESH_FORMATS.get(ending)
    if mesh_format is None:
        known = ending in READ_ONLY_FORMATS
        problem = "can be read, not written" if known else "is not a mesh format"
        endings = MESH_ENDINGS if verb == "read" else MESH_FORMATS
        advice = _CONVERT.get(ending, f"use one of {', '.join(endings)}")
        raise FileFormatError(f"Cannot {verb} {path}: the ending '{path.suffix}' {problem}; {advice}.")
    return mesh_format


MESH_FORMATS: Mapping[str, MeshFormat] = MappingProxyType(
    {
        ".ply": MeshFormat("PLY", read_ply, write_ply),
        ".obj": MeshFormat("Wavefront OBJ", read_obj, write_obj),
        ".stl": MeshFormat("STL", read_stl, write_stl, exact=False, point_clouds=False, keeps_vertices=False),
        ".off": MeshFormat("OFF", read_off, write_off),
        ".vtk": MeshFormat("legacy VTK", read_vtk, write_vtk),
        ".vtp": MeshFormat("XML VTK", read_vtk, write_vtp),
        ".glb": MeshFormat("binary glTF", read_gltf, write_glb, exact=False),
        ".gltf": MeshFormat("glTF", read_gltf, write_gltf, exact=False),
    }
)
"""File name ending -> format that is read and written."""

READ_ONLY_FORMATS: Mapping[str, Callable[[bytes, Path], Mesh]] = MappingProxyType(
    {
        ".wrl": read_vrml,
        ".bnt": read_bnt,
        ".xyz": read_xyz,
        ".pts": read_xyz,
        ".pcd": read_pcd,
    }
)
"""File name ending -> reader (content, path) -> mesh, for formats that are not written."""

NAMED_FORMATS: Mapping[str, Callable[[bytes, Path], Mesh]] = MappingProxyType({".mat": read_mat_mesh})
"""Readers for endings that many other files share; such files are read if they are named, but not from folders."""

MESH_ENDINGS = (*MESH_FORMATS, *READ_ONLY_FORMATS)
"""File name endings that `read_mesh` accepts."""

MESH_FILE_ENDINGS = (*MESH_ENDINGS, *(f"{ending}{_PACKED}" for ending in MESH_ENDINGS))
"""File name endings of meshes, including those of files compressed by gzip."""


@dataclass(frozen=True)
class MeshFiles:
    """Result of `mesh_files`.

    Args:
        files: paths in the given order, those of a folder in the order of their names.
        left_out: a sentence for each kind of skipped entry.
    """

    files: tuple[Path, ...]
    left_out: tuple[str, ...]


def mesh_files(
    paths: Sequence[Path],
    *,
    recursive: bool = False,
    apart_from: Path | None = None,
    endings: Sequence[str] = MESH_FILE_ENDINGS,
    kind_name: str = "meshes",
) -> MeshFiles:
    """Return `paths` with each folder replaced by the files in it that have one of the `endings`.

    Args:
        paths: files, which are always included, and folders.
        recursive: whether to include files in subfolders. Links to folders are not followed.
        apart_from: subfolder to skip, such as that of the results.
        endings: endings of the files to include, in lower case.
        kind_name: plural noun of the files in messages.

    Raises:
        InputError: a folder without meshes.
        FileError: a folder that cannot be read.
    """
    files: list[Path] = []
    left_out: list[str] = []
    for path in paths:
        with reading(path):
            is_folder = path.is_dir()
        if not is_folder:
            files.append(path)
            continue
        found: dict[str, list[Path]] = defaultdict(list)
        apart = None if apart_from is None else apart_from.resolve()
        for kind, entry in _entries(path, tuple(endings), recursive, apart):
            found[kind].append(entry)
        if not found["file"]:
            advice = "; give --recursive to include its subfolders" if found["folder"] else ""
            advice += "; unpack those that are compressed with gunzip" if found["packed"] else ""
            known = MESH_ENDINGS if endings is MESH_FILE_ENDINGS else endings
            raise InputError(f"{path} contains no {kind_name}{advice}; shapespace reads {', '.join(known)}.")
        files += found["file"]
        for kind, (singular, plural, verb, advice) in _LEFT_OUT.items():
            if names := [entry.relative_to(path).as_posix() for entry in found[kind]]:
                count_words = f"1 {singular} is" if len(names) == 1 else f"{len(names)} {plural} are"
                shown = f"({first_names(names)}); {advice.format(kind_name)}"
                left_out.append(f"{path}: {count_words} not {verb} {shown}.")
    return MeshFiles(tuple(files), tuple(left_out))


def _entries(
    folder: Path, endings: tuple[str, ...], recursive: bool, apart_from: Path | None
) -> Iterator[tuple[str, Path]]:
    """Yield kind and path of each entry of a folder, by name: `file` to include, or a kind of `_LEFT_OUT` to skip."""
    packed_endings = tuple(f"{ending}{_PACKED}" for ending in endings)
    with reading(folder):
        for path in sorted(p for p in folder.iterdir() if not p.name.startswith(".")):
            is_of_kind = path.name.lower().endswith(endings)
            if path.is_dir():
                if path.resolve() == apart_from:
                    continue
                if recursive and not path.is_symlink():
                    yield from _entries(path, endings, recursive, apart_from)
                else:
                    yield "linked" if recursive else "folder", path
            elif is_of_kind and path.is_file():
                yield "file", path
            elif path.name.lower().endswith(packed_endings):
                yield "packed", path
            elif path.is_symlink() and not path.exists() and (is_of_kind or not path.suffix):
                yield "broken", path
