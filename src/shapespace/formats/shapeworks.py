"""ShapeWorks: a project (`.swproj` or `.xlsx`) of subjects with corresponding particles, and optionally meshes.

Keys and columns as ShapeWorks 6 writes them (Libs/Project): `world_particles_D` and `local_particles_D` of each domain
D, text files of `x y z` rows, and `groomed_D`, the surface on which the local particles lie.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np
from scipy.fft import dct
from scipy.interpolate import RBFInterpolator
from scipy.sparse import csr_array
from scipy.spatial import KDTree

from shapespace.errors import InputError, ModelFileError, ShapespaceError
from shapespace.formats.model_parts import KEY, LinearModel, Modes, facts_of, json_object, with_facts, write_folder
from shapespace.geometry.articulation import regions_of_parts
from shapespace.geometry.normals import part_of
from shapespace.geometry.procrustes import align_in_place
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.containers.json_files import check_file, parse_json
from shapespace.io.files import read_bytes, write_text
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, read_mesh
from shapespace.io.meshes.vtk import write_vtk
from shapespace.io.parsing import floats_of, number_lines
from shapespace.io.read_limits import LARGEST_MESH_FILE_BYTES, Allowance
from shapespace.io.tables.workbook import sheet_rows
from shapespace.types import FloatArray, IntArray, Mesh

_AGAIN = "run optimize in ShapeWorks again, or copy its folder of particles to the folder of the project"
_LARGEST_PROJECT_BYTES = 2**26  # 64 MiB
_PARTICLES = re.compile(r"(world|local)_particles_(.+)")
_SURFACES = ("groomed", "shape", "mesh")
_ON_PARTICLES = 1e-6  # share of the extent: rounding of particles in text
MOST_DENSE = 2_000
"""Largest number of particles for one spline; it takes 1.0 s for 2,000 and would take 45 s for 12,000."""
NEIGHBOURS = 32
"""Particles of a local spline: within 0.1 % (RMS) of the dense one, by tests/formats/test_shapeworks_projects.py."""
_BATCH = 512
"""Points whose splines are solved together: 40 MB of matrices."""
_MOST_CARRIED_BYTES = 2**31
"""Memory of the modes of a carried mesh (2 GiB)."""
_MOST_APART = 0.02
"""Share of the size of a shape; particles at a larger distance from its mesh belong to another shape."""
_IDENTITY = " ".join(str(value) for value in np.eye(4).ravel())

Row = Mapping[str, str]


def is_shapeworks(path: Path, head: bytes) -> bool:
    """Return whether a file has the ending of a project and begins like JSON or a workbook."""
    begin = {".swproj": b"{", ".xlsx": b"PK"}.get(path.suffix.lower())
    return begin is not None and head.lstrip()[: len(begin)] == begin


def read_shapeworks(path: Path) -> LinearModel:
    """Read the particles of all subjects as a model, on the mesh of the subject nearest to the mean, if any."""
    check_file(path, _LARGEST_PROJECT_BYTES, _AGAIN)
    content = read_bytes(path)
    facts: Mapping[str, Any] = {}
    if path.suffix.lower() == ".xlsx":
        rows = _sheet(content, path)
    else:
        tree = json_object(parse_json(content, path, _AGAIN))
        rows = _rows(tree.get("data"))
        facts = json_object(tree.get(KEY))
    return with_facts(_model(_Project(path, rows, Allowance(len(content), path))), facts)


def write_shapeworks(model: LinearModel, path: Path) -> Sequence[str]:
    """Write vertices as particles, and the model as shapes with its mean and covariance, see `ModelFormat.write`.

    K modes take K + 1 shapes, none further than 1.42 standard deviations in any mode: the rows of a cosine
    transform, which sum to zero and are orthogonal.
    """
    if path.suffix.lower() == ".xlsx":
        raise InputError(f"{path} cannot be written: workbooks can only be read; give a name that ends in .swproj.")
    displacements = model.moved * (model.mm or 1.0)
    mean = model.mean * (model.mm or 1.0)
    count = displacements.shape[1] + 1
    z = np.asarray(dct(np.eye(count), norm="ortho", axis=0), dtype=np.float64)[1:] * np.sqrt(count - 1)
    folder = path.with_name(f"{path.stem}_particles")
    domains = regions_of_parts(model.parts or {"1": len(mean)})
    files: dict[str, bytes] = {}
    rows: list[dict[str, str]] = []
    for number in range(count):
        vertices = mean + (displacements @ z[:, number]).reshape(-1, 3)
        row = {"name": f"shape_{number:03d}"}
        for k, (domain, region) in enumerate(domains.items(), 1):
            name = f"{row['name']}_{k}" if model.parts else row["name"]
            particles, surface = f"{name}.particles", f"{name}.vtk"
            files[particles] = number_lines(vertices[region], "%.17g %.17g %.17g").encode()
            if model.faces is not None:
                inside = np.isin(np.arange(len(mean)), region)
                files[surface] = write_vtk(part_of(Mesh(vertices, model.faces), inside))
                row |= {f"{key}_{domain}": f"{folder.name}/{surface}" for key in ("shape", "groomed")}
            row |= {f"{key}_particles_{domain}": f"{folder.name}/{particles}" for key in ("local", "world")}
            row |= {f"alignment_{domain}": _IDENTITY, f"procrustes_{domain}": _IDENTITY}
        rows.append(row)
    write_folder(folder, files)
    tree = {"data": rows, "optimize": {"number_of_particles": str(len(mean))}, KEY: facts_of(model)}
    write_text(path, json.dumps(tree, indent=1) + "\n")
    notes = [
        f"The model is {count} shapes in {folder.name}, whose mean and covariance (n - 1) are its own; they are no "
        "subjects.",
        f"Each of the {len(mean)} vertices is a particle, in mm.",
    ]
    if model.expression is not None:
        notes.append("Identity and expression are no longer separate.")
    return notes


@dataclass
class _Project:
    path: Path
    rows: Sequence[Row]
    allowance: Allowance
    read: dict[Path, FloatArray] = field(default_factory=lambda: dict[Path, FloatArray]())
    known: set[Path] = field(default_factory=lambda: set[Path]())

    def file(self, name: str) -> Path:
        """Return the path of a file in the folder of the project or below, and count the file at its first use."""
        folder = self.path.parent.resolve()
        try:
            target = (folder / PurePosixPath(name.strip().replace("\\", "/"))).resolve()
            is_there = target.is_file()
        except (OSError, ValueError) as error:  # a name that is too long, or contains null characters
            raise ModelFileError(f"{self.path} names a file with an invalid name ({name[:80]!r}); {_AGAIN}.") from error
        if not target.is_relative_to(folder):
            raise ModelFileError(
                f"{self.path} names a file outside its folder ({name[:80]!r}), which is not read; move it there."
            )
        if not is_there:
            raise ModelFileError(f"{self.path} names a file that does not exist ({name[:80]!r}); {_AGAIN}.")
        if target not in self.known:
            self.known.add(target)
            self.allowance.more_file(target.stat().st_size)
        return target

    def particles(self, name: str) -> FloatArray:
        """Return the (P, 3) particles in a file."""
        file = self.file(name)
        self.allowance.part()
        if file not in self.read:
            values = floats_of(read_bytes(file, LARGEST_MESH_FILE_BYTES), file)
            if not len(values) or len(values) % 3 or not np.isfinite(values).all():
                raise ModelFileError(f"{file} does not contain rows of three finite numbers; {_AGAIN}.")
            self.read[file] = values.reshape(-1, 3)
        # Several subjects may refer to one file; each becomes a row.
        self.allowance.take(self.read[file].size, 8)
        return self.read[file]


def _model(project: _Project) -> LinearModel:
    kind, domains = _domains(project)
    rows = [row for row in project.rows if all(row.get(f"{kind}_particles_{domain}") for domain in domains)]
    if len(rows) < 2:
        raise ModelFileError(f"{project.path} has particles of {len(rows)} subjects, and a model needs two; {_AGAIN}.")
    parts = [[project.particles(row[f"{kind}_particles_{domain}"]) for domain in domains] for row in rows]
    counts = [len(part) for part in parts[0]]
    if any([len(part) for part in subject] != counts for subject in parts):
        raise ModelFileError(f"{project.path} has subjects with different numbers of particles; {_AGAIN}.")
    shapes = np.stack([np.concatenate(subject) for subject in parts])
    notes: list[str] = []
    if len(rows) < len(project.rows):
        notes.append(f"{len(project.rows) - len(rows)} subjects without particles are omitted.")
    if len(domains) > 1:
        notes.append(f"Its {len(domains)} domains vary together in one model, as its parts {', '.join(domains)}.")
    if kind == "local":
        align_in_place(shapes, "form")
        notes.append("It has local particles only, which were aligned rigidly.")
    flat = shapes.reshape(len(shapes), -1)
    mean = flat.mean(axis=0)
    _, stddev, directions = np.linalg.svd((flat - mean) / np.sqrt(len(flat) - 1), full_matrices=False)
    modes = directions.T * stddev
    # One less than the number of subjects; the last mode is rounding.
    displacements = modes[:, : len(flat) - 1]
    surface = _surface(project, rows, domains, shapes, mean.reshape(-1, 3), counts)
    points: FloatArray = mean.reshape(-1, 3)
    faces: IntArray | None = None
    if isinstance(surface, str):
        notes.append(f"It is a point model of {len(points)} particles: {surface}.")
    elif surface.carry is None:
        faces = surface.faces
    elif isinstance(carried := surface.carried(points, displacements), str):
        notes.append(f"It is a point model of {len(points)} particles: {carried}.")
    else:
        points, displacements = carried
        faces, counts = surface.faces, [len(mesh) for _, mesh in surface.carry]
        notes.append(
            f"Its surface is the mesh of {surface.subject}, the most average subject, carried by the particles with "
            "biharmonic splines."
        )
    return LinearModel(
        mean=points,
        shape=Modes(displacements),
        faces=faces,
        n_training=len(rows),
        parts=dict(zip(domains, counts, strict=True)) if len(domains) > 1 else {},
        provenance=f"ShapeWorks project {project.path.name}: {len(rows)} subjects, {flat.shape[1] // 3} particles",
        notes=tuple(notes),
    )


def _domains(project: _Project) -> tuple[str, list[str]]:
    """Return whether particles are `world` or `local`, and the names of the domains."""
    names_by_space: dict[str, list[str]] = {"world": [], "local": []}
    for key, value in project.rows[0].items() if project.rows else ():
        match = _PARTICLES.fullmatch(key)
        if match and value:
            names_by_space[match[1]].append(match[2])
    for kind, domains in names_by_space.items():
        if domains:
            return kind, domains
    raise ModelFileError(f"{project.path} contains no paths of particles; {_AGAIN}.")


@dataclass(frozen=True, eq=False)
class _Surface:
    """Mesh of a subject.

    Args:
        subject: name of the subject.
        faces: (M, 3) triangles of the mesh.
        carry: particles (P, 3) and mesh vertices (V, 3) of the subject for each domain, or None if the particles are
            the vertices.
    """

    subject: str
    faces: IntArray
    carry: Sequence[tuple[FloatArray, FloatArray]] | None

    def carried(self, mean: FloatArray, displacements: FloatArray) -> tuple[FloatArray, FloatArray] | str:
        """Return the vertices (V, 3) and modes (3V, K) interpolated from the particles `mean` and their modes.

        If this is impossible, return the reason as a clause.
        """
        if 24 * sum(len(mesh) for _, mesh in self.carry or ()) * (1 + displacements.shape[1]) > _MOST_CARRIED_BYTES:
            return f"its modes on the mesh of {self.subject} would take more than {_MOST_CARRIED_BYTES >> 30} GiB"
        steps = displacements.reshape(len(mean), -1)
        start, vertices, modes = 0, list[FloatArray](), list[FloatArray]()
        for particles, mesh in self.carry or ():
            rows = slice(start, start + len(particles))
            start += len(particles)
            # Splines are linear in the displacements of the particles, so the model remains linear.
            particle_values = np.concatenate([mean[rows] - particles, steps[rows]], axis=1)
            try:
                carried_values = interpolate_displacements(particles, particle_values, mesh)
            except np.linalg.LinAlgError:
                return "its particles lie in a plane or nearly coincide, so a mesh cannot be interpolated"
            vertices.append(mesh + carried_values[:, :3])
            modes.append(carried_values[:, 3:].reshape(3 * len(mesh), -1))
        return np.concatenate(vertices), np.concatenate(modes)


def interpolate_displacements(
    particles: FloatArray, values: FloatArray, points: FloatArray, *, most_dense: int = MOST_DENSE
) -> FloatArray:
    """Interpolate values at particles to other points by biharmonic splines.

    Up to `most_dense` particles, one spline passes through all of them: time grows with their cube. More particles
    are fitted by an affine map, and a spline through the `NEIGHBOURS` nearest particles interpolates the residuals at
    each point, as `scipy.interpolate.RBFInterpolator(neighbors=...)` does: time grows with the number of points.

    Args:
        particles: (P, 3) mm, P at least 5, all different.
        values: (P, D) such as displacements and modes, mm.
        points: (V, 3) mm.
        most_dense: the largest P for which one spline passes through all particles.

    Returns:
        (V, D) values at the points.

    Raises:
        np.linalg.LinAlgError: the particles lie in a plane, or nearly coincide.
    """
    if len(particles) <= most_dense:
        spline = RBFInterpolator(particles, values, kernel="linear", degree=1)
        return np.asarray(spline(points), dtype=np.float64)
    centre = particles.mean(axis=0)
    design = np.column_stack([np.ones(len(particles)), particles - centre])
    affine = np.linalg.lstsq(design, values, rcond=None)[0]
    nearest = np.asarray(KDTree(particles).query(points, NEIGHBOURS)[1], dtype=np.int64)
    weights = np.concatenate(
        [
            _spline_weights(points[start : start + _BATCH], particles[nearest[start : start + _BATCH]])
            for start in range(0, len(points), _BATCH)
        ]
    )
    starts = np.arange(0, nearest.size + 1, NEIGHBOURS)
    matrix = csr_array((weights.ravel(), nearest.ravel(), starts), shape=(len(points), len(particles)))
    residuals = np.asarray(matrix @ (values - design @ affine), dtype=np.float64)
    return residuals + np.column_stack([np.ones(len(points)), points - centre]) @ affine


def _spline_weights(points: FloatArray, neighbours: FloatArray) -> FloatArray:
    """Return the weights (B, k) of a biharmonic spline with a constant, through `neighbours` (B, k, 3), at `points`."""
    count = neighbours.shape[1]
    system = np.ones((len(points), count + 1, count + 1))
    system[:, :count, :count] = -np.linalg.norm(neighbours[:, :, None] - neighbours[:, None], axis=3)
    system[:, count, count] = 0.0
    right = np.ones((len(points), count + 1, 1))
    right[:, :count, 0] = -np.linalg.norm(neighbours - points[:, None], axis=2)
    return np.asarray(np.linalg.solve(system, right)[:, :count, 0], dtype=np.float64)


def _surface(
    project: _Project,
    rows: Sequence[Row],
    domains: Sequence[str],
    shapes: FloatArray,
    mean: FloatArray,
    counts: Sequence[int],
) -> _Surface | str:
    """Return the mesh of the subject nearest to the mean, or the reason why there is none, as a clause."""
    number = int(((shapes - mean) ** 2).sum(axis=(1, 2)).argmin())
    row, points = rows[number], shapes[number]
    bounds = np.cumsum([0, *counts])
    pairs: list[tuple[FloatArray, FloatArray]] = []
    faces: list[IntArray] = []
    n_vertices, exact = 0, True
    for k, domain in enumerate(domains):
        name = next((row[f"{key}_{domain}"] for key in _SURFACES if row.get(f"{key}_{domain}")), "")
        if not name.lower().endswith(tuple(MESH_ENDINGS)):
            return "the project contains no mesh"
        world = points[bounds[k] : bounds[k + 1]]
        try:
            mesh = read_mesh(project.file(name))
            local = row.get(f"local_particles_{domain}")
            vertices = mesh.vertices
            if local:
                source = project.particles(local)
                T = fit_similarity(source, world)
                distance = float(np.sqrt(((T.apply(source) - world) ** 2).sum(axis=1).mean()))
                vertices = vertices if np.array_equal(source, world) else T.apply(vertices)
            else:
                distance = 0.0
        except ShapespaceError as error:
            # A project is a valid model without its meshes.
            return f"the mesh of the most average subject cannot be used ({str(error).rstrip('.')[:160]})"
        size = float(np.ptp(world, axis=0).max())
        if mesh.faces is None:
            return "the mesh of the most average subject has no triangles"
        gap = np.maximum(vertices.min(axis=0) - world.min(axis=0), world.max(axis=0) - vertices.max(axis=0))
        if distance > _MOST_APART * size or float(gap.max()) > _MOST_APART * size:
            return "the mesh of the most average subject does not match its particles"
        is_vertices = vertices.shape == world.shape and np.abs(vertices - world).max() <= _ON_PARTICLES * size
        exact = exact and bool(is_vertices)
        pairs.append((world, vertices))
        faces.append(mesh.faces + n_vertices)
        n_vertices += len(vertices)
    subject = row.get("name") or Path(row.get(f"world_particles_{domains[0]}", "")).stem
    all_faces = np.concatenate(faces)
    if exact:
        return _Surface(subject, all_faces, None)
    if any(len(np.unique(world, axis=0)) < len(world) or len(world) < 5 for world, _ in pairs):
        return "particles coincide or are too few to interpolate a mesh"
    return _Surface(subject, all_faces, pairs)


def _rows(data: object) -> list[Row]:
    rows = cast(list[object], data) if isinstance(data, list) else []
    return [{key: value for key, value in json_object(row).items() if isinstance(value, str)} for row in rows]


def _sheet(content: bytes, path: Path) -> list[Row]:
    """Return the rows of the sheet `data` of a workbook as dictionaries by column name."""
    try:
        table = sheet_rows(content, "data")
    except ValueError as error:
        raise ModelFileError(f"{path} {error}, so it is not a project of ShapeWorks; {_AGAIN}.") from error
    return [{table[0][column]: text for column, text in cells.items() if column in table[0]} for cells in table[1:]]
