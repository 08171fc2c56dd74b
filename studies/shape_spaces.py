"""Vertices and B-spline control points at equal numbers of modes: the same meshes, scans and classifier for each.

People are ICT-FaceKit's; those who are scanned are not those of the model. Errors are mean distances of all vertices to
their true places, in mm of the model's frame; the floor is the best that a model can do with the true correspondences.
Each measurement ends in a file of its own, so that an interrupted run goes on.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
from scipy.spatial import cKDTree

from shapespace import __version__
from shapespace.datasets.faces import load_faces
from shapespace.datasets.simulated_scan import SimulatedScan, random_similarity, simulate_scan
from shapespace.errors import FileFormatError, InputError, ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.geometry.closest import build_engine, surface_distances
from shapespace.geometry.flatten import cylinder_map, disc_map, folded_triangles
from shapespace.geometry.normals import face_areas, vertex_normals
from shapespace.io.files import make_folder, read_bytes, write_text
from shapespace.model.missing import MIN_SEEN, ObservedMeshes
from shapespace.model.model_quality import floor_mm
from shapespace.model.representation import BSplineSurface
from shapespace.model.shape_model import ShapeModel
from shapespace.types import BoolArray, FloatArray, IntArray, Mesh
from simulated import Stage, faces_of_ict
from study_people import StudyPeople, holes_of

Record: TypeAlias = dict[str, Any]

SCANS: Mapping[str, tuple[float, float]] = {
    "0.2 mm noise": (0.2, 0.0),
    "0.5 mm noise": (0.5, 0.0),
    "1 mm noise": (1.0, 0.0),
    "10 % missing": (0.2, 0.1),
    "30 % missing": (0.2, 0.3),
}
"""Noise in mm and share missing, of the scans that are fitted."""
TRAINING: Mapping[str, tuple[float, float]] = {
    "0.5 mm noise": (0.5, 0.0),
    "1 mm noise": (1.0, 0.0),
    "10 % missing": (0.0, 0.1),
    "30 % missing": (0.0, 0.3),
}
"""The same of the meshes that the models are made of."""
_NARROW_MM = 5.0
_SEED = 500


@dataclass(frozen=True)
class ShapeSpaces:
    """What is compared.

    Args:
        training: people in each model of the first comparison.
        people: others, who are scanned.
        modes: of every model.
        counts: control points along each side.
        triangles: of the scans of the first comparison.
        taught: people of the study who make the models and teach the classifiers of the second comparison.
        tested: others, whose expressions are told.
        recognised: shape spaces of the second comparison.
    """

    training: int = 200
    people: int = 10
    modes: int = 50
    counts: tuple[int, ...] = (16, 24, 32)
    triangles: int = 20_000
    taught: int = 30
    tested: int = 15
    recognised: tuple[str, ...] = ("vertices", "bspline 24x24", "bspline-detail 24x24")

    @property
    def kinds(self) -> dict[str, tuple[str, tuple[int, int] | None]]:
        """(representation, control points) by the name that tables show."""
        found: dict[str, tuple[str, tuple[int, int] | None]] = {"vertices": ("vertices", None)}
        for name in ("bspline", "bspline-detail"):
            found |= {f"{name} {n}x{n}": (name, (n, n)) for n in self.counts}
        return found

    def model(self, meshes: Sequence[Mesh], kind: str, *, align: bool) -> ShapeModel:
        """Return the model of `meshes` in one shape space."""
        representation, control_points = self.kinds[kind]
        return ShapeModel.fit(
            meshes, modes=self.modes, align=align, representation=representation, control_points=control_points
        )


def expressive_people(seed: int) -> StudyPeople:
    """Return the people of the second comparison: those of the study, at half and full intensity."""
    return StudyPeople(levels=(0.5, 1.0), seed=seed)


def prepare(folder: Path, compared: ShapeSpaces, seed: int) -> Path:
    """Return the folder of the comparison, made if absent.

    Raises:
        InputError: it holds a comparison with other settings.
        FileError: it cannot be written.
    """
    inside = make_folder(folder / "shape_spaces")
    path = inside / "settings.json"
    settings = json.dumps({**asdict(compared), "seed": seed, "version": __version__}, indent=1) + "\n"
    if path.is_file():
        if read_bytes(path).decode("utf-8", "replace") != settings:
            raise InputError(f"{inside} was measured with other settings or by another version; delete it.")
    else:
        write_text(path, settings)
    return inside


def stages(inside: Path, compared: ShapeSpaces, seed: int) -> list[Stage]:
    """Return what there is to do in order: (what, jobs, the file that each ends in).

    Args:
        inside: from `prepare`.
        compared: its settings.
        seed: of the people of the second comparison.
    """
    kinds, told = list(compared.kinds), [k for k in compared.recognised if k in compared.kinds]
    models = [_model_path(inside, kind) for kind in told]
    people = range(compared.taught + compared.tested)
    fits = [(kind, person) for kind in told for person in people]
    return [
        ("maps", [(_maps, (inside, compared))], [inside / "maps.json"]),
        ("shape spaces", [(_compare, (inside, compared, k)) for k in kinds], [_row_path(inside, k) for k in kinds]),
        ("shape spaces of expressions", [(_expressions, (inside, compared, k, seed)) for k in told], models),
        (
            "fits in shape spaces",
            [(_fit_person, (inside, kind, person, seed)) for kind, person in fits],
            [person_path(inside, kind, person) for kind, person in fits],
        ),
    ]


def _file_name(kind: str) -> str:
    return kind.replace(" ", "_")


def _row_path(inside: Path, kind: str) -> Path:
    return inside / f"{_file_name(kind)}.json"


def _model_path(inside: Path, kind: str) -> Path:
    return inside / f"{_file_name(kind)}.h5"


def person_path(inside: Path, kind: str, person: int) -> Path:
    """Return the file of a person's fits in one shape space."""
    return inside / "fits" / f"{_file_name(kind)}_{person:03d}.json"


def read_record(path: Path) -> Record:
    """Return what a job wrote.

    Raises:
        FileError: the file cannot be read.
        FileFormatError: it is damaged.
    """
    try:
        found = json.loads(read_bytes(path))
    except ValueError as error:
        raise FileFormatError(f"{path} is damaged; delete it and run the study again.") from error
    if not isinstance(found, dict):
        raise FileFormatError(f"{path} is damaged; delete it and run the study again.")
    return cast(Record, found)


def read_rows(inside: Path, compared: ShapeSpaces) -> list[Record]:
    """Return the first comparison, a record for each shape space."""
    return [read_record(_row_path(inside, kind)) for kind in compared.kinds]


def _write(path: Path, record: Mapping[str, Any]) -> None:
    make_folder(path.parent)
    write_text(path, json.dumps(record, indent=1) + "\n")


# The first comparison: size, floors, fits under noise and holes


def _compare(inside: Path, compared: ShapeSpaces, kind: str) -> None:
    drawn = faces_of_ict().draw_people(compared.training + compared.people, seed=_SEED)
    meshes = [faces_of_ict().mesh(row, name=f"person {i}") for i, row in enumerate(drawn)]
    training, others = meshes[: compared.training], meshes[compared.training :]
    since = time.process_time()
    model = compared.model(training, kind, align=False)
    record: Record = {"shape space": kind, "modes": model.n_modes, "build_s": time.process_time() - since}
    path = inside / f"{_file_name(kind)}_size.h5"
    model.save(path)
    record["file_mb"] = path.stat().st_size / 1e6
    path.unlink()
    record["floor_mm"] = float(np.mean([floor_mm(model, mesh.vertices) for mesh in others]))
    record["floor_surface_mm"] = float(
        np.mean([_surface_mm(model.reconstruct(model.project(m.vertices, align=False)), m) for m in others])
    )
    scans = {
        name: [_scan_of(mesh, i, compared.triangles, *how) for i, mesh in enumerate(others)]
        for name, how in SCANS.items()
    }
    fit_scan(model, scans["0.2 mm noise"][0].scan, FitConfig(unit="mm"))  # what every fit with the model shares
    record["scans"] = {name: _fits(model, scans[name], others) for name in SCANS}
    record["trained on"] = {name: _trained_on(compared, training, others, kind, *how) for name, how in TRAINING.items()}
    _write(_row_path(inside, kind), record)


def _scan_of(mesh: Mesh, index: int, triangles: int, noise_mm: float, missing: float) -> SimulatedScan:
    rng = np.random.default_rng([7, index])
    T = random_similarity(rng)
    holes = holes_of(mesh, missing, rng) if missing else ()
    return simulate_scan(mesh, rng, triangles=triangles, noise_mm=noise_mm, T_scan_model=T, holes=holes)


def _fits(model: ShapeModel, scans: Sequence[SimulatedScan], truths: Sequence[Mesh]) -> Record:
    """Return mean errors, doubts and CPU seconds of the robust fits of `scans`; one that fails is counted."""
    error: list[float] = []
    surface: list[float] = []
    seconds: list[float] = []
    doubtful = failed = 0
    for scan, truth in zip(scans, truths, strict=True):
        since = time.process_time()
        try:
            fitted = fit_scan(model, scan.scan, FitConfig(unit="mm"))
        except ShapespaceError:
            failed += 1
            continue
        seconds.append(time.process_time() - since)
        found = scan.T_scan_model.inverse().apply(fitted.T_scan_model.apply(model.reconstruct(fitted.b)))
        error.append(float(np.linalg.norm(found - truth.vertices, axis=1).mean()))
        surface.append(_surface_mm(found, truth))
        doubtful += fitted.status == "doubtful"
    return {
        "vertex_mm": float(np.mean(error)) if error else None,
        "surface_mm": float(np.mean(surface)) if surface else None,
        "seconds": float(np.median(seconds)) if seconds else None,
        "doubtful": doubtful,
        "failed": failed,
    }


def _surface_mm(vertices: FloatArray, truth: Mesh) -> float:
    """Return the mean distance of two surfaces, both ways."""
    distances = surface_distances(Mesh(vertices, truth.faces), truth)
    return 0.5 * (distances.model_to_scan.mean + distances.scan_to_model.mean)


def _trained_on(
    compared: ShapeSpaces, training: Sequence[Mesh], others: Sequence[Mesh], kind: str, noise_mm: float, missing: float
) -> float | None:
    """Return the floor for others, mm, of a model of damaged meshes; None where it cannot be made.

    A model of vertices leaves out those that hardly any of the meshes show; they do not count in its floor.
    """
    rng = np.random.default_rng(11)
    damaged: list[Mesh] = []
    for mesh in training:
        x = mesh.vertices + noise_mm * rng.standard_normal(mesh.vertices.shape)
        for hole in holes_of(mesh, missing, rng) if missing else ():
            x[np.linalg.norm(mesh.vertices - np.asarray(hole.center), axis=1) <= hole.radius_mm] = np.nan
        damaged.append(mesh.with_vertices(x))
    try:
        model = compared.model(damaged, kind, align=False)
    except InputError:
        return None
    kept = ObservedMeshes.of(damaged, MIN_SEEN).vertices
    shown = kept if model.n_vertices == kept.sum() else np.ones(len(kept), dtype=np.bool_)
    return float(np.mean([floor_mm(model, mesh.vertices[shown]) for mesh in others]))


# The second comparison: expressions from one PCA in each shape space


def _expressions(inside: Path, compared: ShapeSpaces, kind: str, seed: int) -> None:
    people, ict = expressive_people(seed), faces_of_ict()
    strongest = [k for k, (_, level) in enumerate(people.shown) if level in (0.0, max(people.levels))]
    meshes: list[Mesh] = []
    for person in range(compared.taught):
        faces = list(people.faces(ict, person))
        meshes += [faces[k] for k in strongest]
    compared.model(meshes, kind, align=True).save(_model_path(inside, kind))


def _fit_person(inside: Path, kind: str, person: int, seed: int) -> None:
    people, model = expressive_people(seed), _loaded(_model_path(inside, kind))
    record: Record = {"z": [], "error_mm": [], "status": []}
    for k, face in enumerate(people.faces(faces_of_ict(), person)):
        scan = people.scan(face, person, k)
        try:
            fitted = fit_scan(model, scan.scan, FitConfig(unit="mm"))
        except ShapespaceError:
            record["z"].append(None)
            record["error_mm"].append(None)
            record["status"].append("failed")
            continue
        away = fitted.T_scan_model.apply(model.reconstruct(fitted.b)) - scan.truth_vertices
        record["z"].append(fitted.z.tolist())
        record["error_mm"].append(float(np.linalg.norm(away, axis=1).mean()) / scan.T_scan_model.scale)
        record["status"].append(fitted.status)
    _write(person_path(inside, kind, person), record)


_models: dict[Path, ShapeModel] = {}


def _loaded(path: Path) -> ShapeModel:
    if path not in _models:
        _models[path] = ShapeModel.load(path)
    return _models[path]


# What overlaps on a cylinder and on a disc


def _maps(inside: Path, compared: ShapeSpaces) -> None:
    """Write how much of a face lies double on each map, and how far B-splines over them are off, by region."""
    template, regions = _regions_of_faces()
    faces, rng = load_faces(), np.random.default_rng(3)
    people = np.stack([faces.face(faces.draw_person(rng)).vertices for _ in range(20)])
    changes = people - people.mean(axis=0)
    overlap: list[Record] = []
    by_region: list[Record] = []
    for name, mesh in (("ICT-FaceKit", faces_of_ict().mesh()), ("bundled faces", template)):
        for title, uv in (("cylinder", cylinder_map(mesh)), ("disc", disc_map(mesh))):
            folded, twice, _ = _shared_area(uv, mesh)
            overlap.append({"faces": name, "map": title, "folded": folded, "shared": twice})
    for title, uv in (("cylinder", cylinder_map(template)), ("disc", disc_map(template))):
        _, _, twice = _shared_area(uv, template)
        shared = np.zeros(len(template.vertices), dtype=np.bool_)
        shared[_faces_of(template)[twice].ravel()] = True
        for n in compared.counts:
            surface = BSplineSurface(uv, (n, n))
            shape = np.linalg.norm(surface.decode(surface.encode(people)) - people, axis=2).mean(axis=0)
            change = np.linalg.norm(surface.decode(surface.encode(changes)) - changes, axis=2).mean(axis=0)
            by_region += [
                {
                    "map": f"{title} {n}x{n}",
                    "region": region,
                    "shared": float(shared[index].mean()),
                    "surface_mm": float(shape[index].mean()),
                    "change_mm": float(change[index].mean()),
                }
                for region, index in regions.items()
            ]
    _write(inside / "maps.json", {"overlap": overlap, "regions": by_region})


def _faces_of(mesh: Mesh) -> IntArray:
    assert mesh.faces is not None
    return mesh.faces


def _shared_area(uv: FloatArray, mesh: Mesh) -> tuple[float, float, BoolArray]:
    """Return the shares of the area folded over and lying where other parts lie too, and (F,) which lie so."""
    faces = _faces_of(mesh)
    areas, corners = face_areas(mesh), uv[faces]
    middles = corners.mean(axis=1)
    reach = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
    twice = np.zeros(len(faces), dtype=np.bool_)
    tree = cKDTree(middles)
    for f, near in enumerate(cast(Iterable[list[int]], tree.query_ball_point(middles, reach))):
        others = np.array([n for n in near if n != f], dtype=np.int64)
        a, b, c = (corners[f, k] - middles[others] for k in range(3))
        turns = np.stack([p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0] for p, q in ((a, b), (b, c), (c, a))])
        inside = (turns.min(axis=0) > 0) | (turns.max(axis=0) < 0)
        twice[others[inside]] = True
        twice[f] |= bool(inside.any())
    folded = folded_triangles(uv, faces)
    return float(areas[folded].sum() / areas.sum()), float(areas[twice].sum() / areas.sum()), twice


def _regions_of_faces() -> tuple[Mesh, dict[str, IntArray]]:
    """Return the bundled template and its regions; nostrils are the narrow pockets of the nose."""
    faces = load_faces()
    template = faces.template
    ahead = template.vertices + _NARROW_MM * vertex_normals(template)
    narrow = build_engine(template).query(ahead).distance < 0.8 * _NARROW_MM
    named = {name: faces.regions[name] for name in ("nose", "mouth", "eyes", "ears")}
    nose = named["nose"]
    named["nostrils"] = nose[narrow[nose]]
    named["inner lips"] = faces.regions["mouth_interior"]
    inside = np.zeros(len(template.vertices), dtype=np.bool_)
    inside[np.concatenate(list(named.values()))] = True
    named["elsewhere"] = np.flatnonzero(~inside).astype(np.int32)
    return template, named
