"""Measure how many odd scans are fitted wrongly and still `converged`, and how many good fits are `doubtful`.

Odd: another object, a shape four to six standard deviations out, halves of different scale, two overlapping instances,
half of the scan in another unit, a mirrored scan, strong noise, a wrong unit, a model of two or three shapes. Good: the
scans that a scanner makes of a shape like those of the training set. A fit is wrong where its mean true vertex error,
over all vertices of the model, exceeds 3.75 % of the size (RMS distance from the centre; 3 mm on a face), or where the
scan shows another object or is mirrored. The models are bundled faces, femora, spleens and hippocampi of 1,000 to 1,600
vertices; the organs come from the folder `SHAPESPACE_DATA`, and are put in correspondence first, which takes minutes.

    python benchmarks/odd_cases.py --odd 500 --good 500 --seed 1      # resumes where it was interrupted
    python benchmarks/odd_cases.py --odd 500 --good 500 --seed 1 --report
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from cases import run
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from shapespace import FitConfig, ShapeModel, fit_scan
from shapespace.datasets.faces import load_faces
from shapespace.datasets.simulated_scan import Collar, Hair, simulate_scan
from shapespace.errors import ShapespaceError
from shapespace.fit.diagnostics.failure_model import FAILED_SHARE
from shapespace.geometry import remesh
from shapespace.geometry.normals import face_areas, faces_of, rms_size
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh, Similarity

Kind = Literal["odd", "good"]
FAMILIES = ("face", "femur", "spleen", "hippocampus")
SYMMETRIC = ("face",)
ODD = {
    "object": 0.2, "far": 0.12, "halves": 0.1, "overlap": 0.1, "mixed units": 0.08, "mirrored": 0.16, "noise": 0.06,
    "unit": 0.06, "few shapes": 0.12,
}  # fmt: skip
OBJECTS = ("ellipsoid", "sphere", "plane", "box", "cylinder", "lump", "other organ")
GOOD = {"complete": 0.35, "missing": 0.25, "outliers": 0.1, "noise": 0.15, "sparse": 0.15}
TRUSTED = ("converged", "max_iterations")


@dataclass(frozen=True)
class Variant:
    """A model of `shapes` shapes, cut to `modes`."""

    shapes: int
    modes: int | None = None
    gauge: Literal["shape", "form"] = "shape"
    representation: str = "vertices"

    @property
    def name(self) -> str:
        """Return a name for tables and files."""
        modes = "all" if self.modes is None else str(self.modes)
        return f"{self.shapes} shapes, {modes} modes, {self.gauge}, {self.representation}"


FEW = (Variant(2), Variant(3), Variant(3, None, "form"), Variant(5))
VARIANTS: Mapping[str, tuple[Variant, ...]] = {
    "face": (
        Variant(12, 6), Variant(30), Variant(60, 20, "form"), Variant(110), Variant(60, 6),
        Variant(60, 20, "shape", "bspline-detail"),
    ),
    "femur": (Variant(12, 6), Variant(20), Variant(60, 6), Variant(60, 30, "form"), Variant(100)),
    "spleen": (Variant(12, 6), Variant(24), Variant(24, None, "form"), Variant(24, 10)),
    "hippocampus": (Variant(12, 6), Variant(24), Variant(24, None, "form"), Variant(24, 10)),
}  # fmt: skip
_FACE_TRIANGLES = 3_000
_BATCH = 40
_TRAINING, _ORGAN_VERTICES = 24, {"spleen": 1_200, "hippocampus": 1_000}


def _data() -> Path:
    return Path(os.environ.get("SHAPESPACE_DATA", "."))


class Family:
    """Shapes of one kind of object in correspondence, and models of them."""

    def __init__(self, name: str, cache: Path) -> None:
        self.name, self.cache = name, cache
        self._models: dict[Variant, ShapeModel] = {}

    def draw(self, rng: np.random.Generator, *, training: bool = False) -> Mesh:
        """Return a shape; organs are drawn from those that no model was trained on, unless `training`."""
        if self.name == "face":
            faces, (origin, triangles) = load_faces(), self._coarse
            expression = faces.mixed_expression(rng) if rng.random() < 0.5 else None
            face = faces.cut_to_face(faces.face(faces.draw_person(rng), expression))
            return Mesh(face.vertices[origin], triangles, name="face")
        if self.name == "femur":
            mean, modes, triangles = self._femora
            return Mesh(mean + (modes @ rng.standard_normal(modes.shape[1])).reshape(-1, 3), triangles, name="femur")
        organs = self._organs[:_TRAINING] if training else self._organs[_TRAINING:]
        return organs[int(rng.integers(len(organs)))]

    def training(self, count: int) -> list[Mesh]:
        """Return `count` training shapes, the same in every run."""
        rng = _rng(self.name, "training", count)
        if self.name in _ORGAN_VERTICES:
            return [self._organs[i] for i in rng.permutation(_TRAINING)[:count]]
        return [self.draw(rng) for _ in range(count)]

    def model(self, variant: Variant) -> ShapeModel:
        """Return the model, from the cache if it was built before."""
        if variant not in self._models:
            path = self.cache / f"{self.name}, {variant.name}.h5"
            if not path.is_file():
                whole = ShapeModel.fit(
                    self.training(variant.shapes), gauge=variant.gauge, representation=variant.representation
                )
                model = whole if variant.modes is None else whole.truncate(min(variant.modes, whole.n_modes))
                path.parent.mkdir(parents=True, exist_ok=True)
                model.save(path)
            self._models[variant] = ShapeModel.load(path)
        return self._models[variant]

    @property
    def largest(self) -> ShapeModel:
        """The model of most shapes, with all of its modes."""
        variants = VARIANTS[self.name]
        return self.model(max(variants, key=lambda v: (v.representation == "vertices", v.modes is None, v.shapes)))

    @cached_property
    def _coarse(self) -> tuple[Any, Any]:
        faces = load_faces()
        template = faces.cut_to_face(faces.template)
        _, triangles, origin = remesh.collapse(
            template.vertices, faces_of(template), _FACE_TRIANGLES, "The template of the faces"
        )
        return origin, triangles.astype(np.int32)

    @cached_property
    def _femora(self) -> tuple[FloatArray, FloatArray, Any]:
        with h5py.File(_data() / "models" / "femur_gp_model_50-components.h5") as stored:
            modes = np.asarray(stored["model/pcaBasis"][:] * np.sqrt(stored["model/pcaVariance"][:]), dtype=np.float64)
            mean = np.asarray(stored["model/mean"][:], dtype=np.float64).reshape(-1, 3)
            return mean, modes, np.ascontiguousarray(stored["representer/cells"][:].T, dtype=np.int32)

    @cached_property
    def _organs(self) -> list[Mesh]:
        folder = self.cache / f"{self.name} in correspondence"
        found = sorted(folder.glob("*.ply"))
        if not found:
            scans = [str(_data() / "spleens")]
            if self.name == "hippocampus":
                masks = sorted((_data() / "hippocampus").glob("*.nii.gz"))[:44]
                _command("surface", *map(str, masks), "--label", "all", "-o", str(self.cache / "masks"))
                scans = [str(self.cache / "masks")]
            vertices = str(_ORGAN_VERTICES[self.name])
            _command("correspond", *scans, "-o", str(folder), "--vertices", vertices, "--rounds", "1", "--jobs", "1")
            found = sorted(folder.glob("*.ply"))
        meshes = [read_mesh(path) for path in found if not path.name.startswith(("mean", "template"))]
        complete = [mesh for mesh in meshes if np.isfinite(mesh.vertices).all()]
        order = _rng(self.name, "split").permutation(len(complete))
        return [complete[i] for i in order]


def _command(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "shapespace", *arguments, "--quiet"], check=True)


def _rng(*key: str | int) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(repr(("odd cases", *key)).encode()))


@dataclass(frozen=True, eq=False)
class Case:
    """One scan to fit, with the truth.

    Args:
        truths: (V, 3) each, true places of the model's vertices in the scan's frame and unit; none for another object.
        T_scan_model: from the frame of the truth, mm, to the scan's frame and unit.
        wrong: whether any fit of it is wrong.
    """

    case: str
    family: str
    variant: Variant
    details: str
    model: ShapeModel
    scan: Mesh
    truths: tuple[FloatArray, ...]
    T_scan_model: Similarity
    config: FitConfig
    wrong: bool = False


def draw(family_named: Callable[[str], Family], kind: Kind, seed: int, index: int) -> Case:
    """Return the index-th case of a seed."""
    rng = _rng(kind, seed, index)
    family = family_named(str(rng.choice(FAMILIES, p=(0.4, 0.25, 0.175, 0.175))))
    cases = ODD if kind == "odd" else GOOD
    case = str(rng.choice(list(cases), p=list(cases.values())))
    if case == "mirrored" and family.name in SYMMETRIC:
        family = family_named("femur")
    few = case == "few shapes" or (kind == "good" and rng.random() < 0.06)
    variants = FEW if few else VARIANTS[family.name]
    variant = variants[int(rng.integers(len(variants)))]
    model = family.model(variant)
    size = rms_size(model.mean_vertices)
    # A model of few shapes fits a new shape wrongly, so its good fits are of shapes that it contains.
    inside = kind == "good" and (variant.shapes <= 12 or rng.random() < 0.2)
    details: list[str] = []

    # The true vertices of an organ are those of a registration, which errs; those of a shape of a model are exact.
    exact = kind == "good" and family.name in _ORGAN_VERTICES

    def shape() -> Mesh:
        if inside or exact:
            source = model if inside else family.largest
            return source.mesh(np.clip(rng.standard_normal(source.n_modes), -2.5, 2.5) * source.stddev)
        return family.draw(rng)

    noise = size * float(rng.uniform(0.001, 0.004))
    triangles = round(float(np.exp(rng.uniform(np.log(4_000), np.log(10_000)))))
    missing, outliers, truths, wrong, unit = 0.0, 0.0, list[FloatArray](), False, "auto"
    if rng.random() < 0.3 and case not in ("object", "mixed units", "overlap"):
        missing = float(rng.uniform(0.05, 0.3))
    if case == "missing":
        missing = float(rng.uniform(0.1, 0.45))
    elif case == "outliers":
        outliers = float(rng.uniform(0.03, 0.2))
    elif case == "noise":
        noise = size * float(rng.uniform(*((0.05, 0.15) if kind == "odd" else (0.005, 0.012))))
    elif case == "sparse":
        triangles = round(float(np.exp(rng.uniform(np.log(1_500), np.log(4_000)))))
    details.append(f"{triangles} triangles, noise {100 * noise / size:.1f} %, {100 * missing:.0f} % missing")

    def scanned(mesh: Mesh, **options: Any) -> Mesh:
        raw = simulate_scan(mesh, rng, triangles=triangles, noise_mm=noise, outlier_fraction=outliers, **options)
        return _torn(raw.scan, missing, rng)

    if case == "object":
        wrong, object_name = True, str(rng.choice(OBJECTS, p=(0.25, 0.1, 0.1, 0.1, 0.1, 0.1, 0.25)))
        mesh = _object(object_name, family, family_named, size, rng, scanned)
        details.append(object_name)
    elif case == "far":
        # Half of them are far out for a larger model of the family, and may leave the span of the one that is fitted.
        source = model if rng.random() < 0.5 else family.largest
        z = np.zeros(source.n_modes)
        leading = min(int(rng.integers(1, 4)), source.n_modes)
        z[:leading] = rng.standard_normal(leading)
        z *= float(rng.uniform(4.0, 6.0)) / np.linalg.norm(z)
        true = source.mesh(z * source.stddev)
        mesh, truths = scanned(true), [true.vertices]
        details.append(f"{np.linalg.norm(z):.1f} standard deviations out")
    elif case == "overlap":
        one, two = shape(), shape()
        off = size * float(rng.uniform(0.1, 0.6)) * _direction(rng)
        two = two.with_vertices(_turn(rng, 8.0).apply(two.vertices) + off)
        mesh, truths = _together(scanned(one), scanned(two)), [one.vertices, two.vertices]
        details.append(f"{np.linalg.norm(off) / size:.2f} sizes apart")
    else:
        true = shape()
        dressed = kind == "good" and family.name == "face" and not inside and rng.random() < 0.15
        mesh = scanned(true, **({"hair": Hair(), "collar": Collar()} if dressed else {}))
        truths = [true.vertices]
        details += ["hair, collar"] * dressed
        if case == "halves":
            axis = _axes(true.vertices)[:, 0 if family.name == "face" else int(rng.integers(3))]
            if family.name == "face":
                axis = np.array([1.0, 0.0, 0.0])
            factor = float(rng.uniform(1.15, 1.3))
            mesh, (fixed,) = _half_changed(mesh, truths, axis, factor)
            truths = [fixed]
            details.append(f"one half {factor:.2f} times as large")
        elif case == "mixed units":
            axis, factor = _axes(true.vertices)[:, int(rng.integers(3))], float(rng.choice([0.1, 10.0]))
            mesh, _ = _half_changed(mesh, truths, axis, factor)
            truths = [true.vertices, factor * true.vertices]
            details.append(f"one half {factor:g} times as large")
        elif case == "unit":
            unit = str(rng.choice(["cm", "m", "um", "inch"]))
            details.append(f"unit {unit} for mm")
    if case == "mirrored":
        wrong, truths = True, []
        flip = np.array([-1.0, 1.0, 1.0])
        mesh = Mesh(mesh.vertices * flip, None if mesh.faces is None else mesh.faces[:, ::-1], name=mesh.name)
    T = _turn(rng, 20.0)
    if rng.random() < 0.4:
        T = Similarity(1.0, np.asarray(Rotation.from_quat(rng.standard_normal(4)).as_matrix()), np.zeros(3))
        details.append("any pose")
    T = Similarity(1.0, T.rotation, rng.uniform(-100, 100, 3))
    if case not in ("unit", "mixed units") and rng.random() < 0.2:
        mm = MM_PER_UNIT[str(rng.choice(["cm", "m"]))]
        T = Similarity(1.0 / mm, T.rotation, T.translation / mm)
        details.append(f"in units of {mm:g} mm")
    scan = Mesh(T.apply(mesh.vertices), mesh.faces, name=f"{kind} {seed} {index}")
    placed = tuple(T.apply(true) for true in truths)
    return Case(
        case, family.name, variant, ", ".join(details), model, scan, placed, T, FitConfig(unit=unit), wrong
    )  # fmt: skip


def _direction(rng: np.random.Generator) -> FloatArray:
    axis = rng.standard_normal(3)
    return axis / np.linalg.norm(axis)


def _turn(rng: np.random.Generator, most_deg: float) -> Similarity:
    angle = math.radians(rng.uniform(0.0, most_deg))
    return Similarity(1.0, np.asarray(Rotation.from_rotvec(angle * _direction(rng)).as_matrix()), np.zeros(3))


def _axes(vertices: FloatArray) -> FloatArray:
    return np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2].T


def _half_changed(
    mesh: Mesh, truths: Sequence[FloatArray], axis: FloatArray, factor: float
) -> tuple[Mesh, tuple[FloatArray, ...]]:
    """Return scan and truth, with the half beyond the centroid along `axis` scaled about the centroid."""
    centre = truths[0].mean(axis=0)

    def changed(x: FloatArray) -> FloatArray:
        far = ((x - centre) @ axis > 0)[:, None]
        return np.where(far, centre + factor * (x - centre), x)

    return mesh.with_vertices(changed(mesh.vertices)), tuple(changed(true) for true in truths)


def _together(one: Mesh, two: Mesh) -> Mesh:
    faces = np.concatenate([faces_of(one), faces_of(two) + len(one.vertices)]).astype(np.int32)
    return Mesh(np.concatenate([one.vertices, two.vertices]), faces)


def _torn(mesh: Mesh, missing: float, rng: np.random.Generator) -> Mesh:
    """Return `mesh` without a share of its area: cut by a plane, or torn out around two points."""
    if missing == 0.0:
        return mesh
    triangles = faces_of(mesh)
    area, middle = face_areas(mesh), mesh.vertices[triangles].mean(axis=1)
    there = np.ones(len(middle), dtype=np.bool_)
    ways = ("p", "hh")[rng.integers(2)]
    for way in ways:
        if way == "p":
            last = middle @ rng.standard_normal(3)
        else:
            last = -np.linalg.norm(middle - middle[rng.choice(np.flatnonzero(there))], axis=1)
        order = np.argsort(-np.where(there, last, -np.inf))
        there[order[: np.searchsorted(np.cumsum(area[order]), missing / len(ways) * area.sum())]] = False
    used, faces = np.unique(triangles[there], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), name=mesh.name)


def _object(
    object_name: str,
    family: Family,
    family_named: Callable[[str], Family],
    size: float,
    rng: np.random.Generator,
    scanned: Callable[[Mesh], Mesh],
) -> Mesh:
    """Return a scan of another object with about the size of the family's shapes."""
    grown = float(np.exp(0.15 * rng.standard_normal()))
    if object_name == "other organ":
        other = family_named(str(rng.choice([name for name in FAMILIES if name != family.name]))).draw(rng)
        x = other.vertices - other.vertices.mean(axis=0)
        return scanned(Mesh(x * (grown * size / rms_size(x)), other.faces))
    n = 50
    u, v = (axis.ravel() for axis in np.meshgrid(np.linspace(0, 1, n), np.linspace(0, 1, n), indexing="ij"))
    polar, azimuth = np.pi * (0.01 + 0.98 * u), 2 * np.pi * v
    if object_name == "plane":
        x = np.column_stack([u - 0.5, v - 0.5, 0 * u])
    elif object_name == "cylinder":
        x = np.column_stack([np.cos(azimuth), 4 * (u - 0.5), np.sin(azimuth)])
    else:
        x = np.column_stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)])
        if object_name == "box":
            x = x / np.abs(x).max(axis=1, keepdims=True)
        elif object_name == "lump":
            waves = rng.standard_normal((6, 3)) * 3.0
            x = x * (1 + 0.12 * np.sin(x @ waves.T + rng.uniform(0, 6, 6)).sum(axis=1, keepdims=True) / 2)
    if object_name != "sphere":
        # As long, wide and deep as the family's shapes, which makes it the harder to reject.
        extent = np.std(family.model(VARIANTS[family.name][0]).mean_vertices @ np.eye(3), axis=0)
        x = x / np.maximum(x.std(axis=0), 1e-9) * extent * np.exp(0.1 * rng.standard_normal(3))
        if object_name == "plane":
            x[:, 2] = 0.0
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + n, corner + 1], 1), np.stack([corner + 1, corner + n, corner + n + 1], 1)]
    )
    return scanned(Mesh(x * (grown * size / rms_size(x)), faces.astype(np.int32)))


def judge(case: Case) -> dict[str, Any]:
    """Fit, and return status and evidence with the mean true vertex error as a share of the size."""
    record: dict[str, Any] = {
        "case": case.case, "family": case.family, "variant": case.variant.name, "details": case.details,
    }  # fmt: skip
    begun = time.process_time()
    try:
        result = fit_scan(case.model, case.scan, case.config)
    except ShapespaceError as error:
        cpu_s = time.process_time() - begun
        return {**record, "status": "failed", "reason": str(error), "wrong": True, "cpu_s": cpu_s}
    cpu_s = time.process_time() - begun
    vertices = result.surface().vertices
    size = rms_size(case.model.mean_vertices) * case.T_scan_model.scale
    errors = [float(np.linalg.norm(vertices - true, axis=1).mean()) / size for true in case.truths]
    error = min(errors, default=None)
    return {
        **record,
        "status": result.status,
        "reason": result.reason,
        "wrong": case.wrong or error is None or error > FAILED_SHARE,
        "error_share": error,
        "evidence": result.evidence.to_dict(),
        "cpu_s": cpu_s,
    }


def records(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the records measured so far."""
    if path.is_file():
        for line in path.read_text("utf-8").splitlines():
            yield json.loads(line)


_families: dict[str, Family] = {}
_cache = Path()


def prepare(cache: Path) -> None:
    """Set up a process that fits cases."""
    global _cache
    _cache = cache
    threadpool_limits(1)


def family_named(name: str) -> Family:
    """Return the family of this process."""
    if name not in _families:
        _families[name] = Family(name, _cache)
    return _families[name]


def measured(task: tuple[Kind, int, int]) -> dict[str, Any]:
    """Return the record of the case of a kind, a seed and an index."""
    kind, seed, index = task
    return {"kind": kind, "seed": seed, "index": index, **judge(draw(family_named, kind, seed, index))}


def measure(path: Path, cache: Path, wanted: Mapping[Kind, int], seed: int, jobs: int) -> None:
    """Append missing records to `path`: the wanted odd cases, and good cases until enough of their fits are right."""
    done = {(r["kind"], r["index"]): r["wrong"] for r in records(path) if r["seed"] == seed}
    prepare(cache)
    for name in FAMILIES:
        for variant in (*FEW, *VARIANTS[name]):
            family_named(name).model(variant)
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        path.open("a", encoding="utf-8") as out,
        ProcessPoolExecutor(jobs, get_context("spawn"), prepare, (cache,)) as pool,
    ):
        for kind, count in wanted.items():
            first, counted = 0, 0
            while counted < count:
                indices = range(first, first + min(_BATCH, count - counted))
                tasks = [(kind, seed, index) for index in indices if (kind, index) not in done]
                for record in pool.map(measured, tasks):
                    done[kind, record["index"]] = record["wrong"]
                    out.write(json.dumps(record, default=float) + "\n")
                    out.flush()
                counted += sum(kind == "odd" or not done[kind, index] for index in indices)
                first = indices.stop


def table(found: Sequence[Mapping[str, Any]]) -> str:
    """Return a markdown table by case: fits, wrong ones, wrong and trusted ones; good ones, good and doubted ones."""
    lines = [
        "| set | case | fits | wrong | wrong and converged | right | right and doubtful |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in ("odd", "good"):
        for case in ("all", *(ODD if kind == "odd" else GOOD)):
            of = [r for r in found if r["kind"] == kind and case in ("all", r["case"])]
            wrong, right = [r for r in of if r["wrong"]], [r for r in of if not r["wrong"]]
            passed = sum(r["status"] in TRUSTED for r in wrong)
            doubted = sum(r["status"] not in TRUSTED for r in right)
            lines.append(f"| {kind} | {case} | {len(of)} | {len(wrong)} | {passed} | {len(right)} | {doubted} |")
    return "\n".join(lines)


def misjudged(found: Sequence[Mapping[str, Any]]) -> str:
    """Return a line for each wrong fit that converged and each right one that is doubtful."""
    lines: list[str] = []
    for r in found:
        if r["wrong"] == (r["status"] in TRUSTED):
            error = r.get("error_share")
            off = "no truth" if error is None else f"{100 * error:.1f} % off"
            lines.append(
                f"{r['kind']} {r['index']}: {r['case']}, {r['family']} ({r['variant']}), {r['details']}: {off}; "
                f"{r['reason']}"
            )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--odd", type=int, default=500, help="number of odd cases")
    parser.add_argument("--good", type=int, default=500, help="number of right fits of ordinary scans")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--results", type=Path, default=Path("bench-out/odd_cases.jsonl"))
    parser.add_argument("--cache", type=Path, default=Path("bench-out/odd_cases"), help="of models and surfaces")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--report", action="store_true", help="print the table of the records measured so far")
    options = parser.parse_args()
    if not options.report:
        wanted: dict[Kind, int] = {"odd": options.odd, "good": options.good}
        measure(options.results, options.cache, wanted, options.seed, options.jobs)
    found = [r for r in records(options.results) if r["seed"] == options.seed]
    print(table(found), misjudged(found), sep="\n\n")


if __name__ == "__main__":
    run(main)
