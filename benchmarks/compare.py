"""Measure what docs/compare.md promises of `shapespace compare`: false positives, power, speed.

Noise is that of real fits: raw scans of simulated people, fitted by models that know none of them. False positives are
measured on the fits of studies (`studies/`) of 100 people with 25 scans each, named by `--fits`; power on people of its
own, whose fits are kept in `--pool`.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pooch
from scipy.spatial import ConvexHull, Delaunay

from shapespace import ShapeModel, fit_scan, load_faces, simulate_scan
from shapespace.cohort.cohort import Cohort, FitDiagnostics
from shapespace.cohort.table import Table
from shapespace.datasets.simulated_scan import Cut
from shapespace.errors import FitError
from shapespace.fit.fit_scan import FitConfig
from shapespace.geometry.normals import vertex_normals
from shapespace.statistics.compare_shapes import CompareConfig, CompareResult, compare
from shapespace.types import BoolArray, FloatArray, Mesh

GROUP = 40
"""People in each of two groups."""
CHANGE_MM = 0.5
WHOLE_MM, NONE_MM = 16.0, 24.0
"""From the tip of the nose: as far as it is changed by all of it, and where the change ends."""
MISSING = (0.1, 0.35)
TRAINED, MODES, POOL = 150, 100, 100
TRIANGLES = 12_000


@dataclass(frozen=True, eq=False)
class Pool:
    """Fits of people without and with a changed nose, in the model's frame.

    Args:
        model: that knows none of them.
        b: (2, P, K) mm.
        b_stddev: (2, P, K).
        dense: (2, P, V, 3) mm, surfaces after the dense stage.
        used: (2, P) fits that are not doubtful or failed.
        change_mm: (V,) put in, along the normals, of the model's vertices.
    """

    model: ShapeModel
    b: FloatArray
    b_stddev: FloatArray
    dense: npt.NDArray[np.float32]
    used: BoolArray
    change_mm: FloatArray


def nose_change(vertices: FloatArray, tip: int) -> FloatArray:
    """Return how far each vertex of a face is moved along its normal: the tip of the nose, with a smooth edge."""
    far = np.linalg.norm(vertices - vertices[tip], axis=1)
    edge = np.clip((NONE_MM - far) / (NONE_MM - WHOLE_MM), 0.0, 1.0)
    return CHANGE_MM * edge * edge * (3.0 - 2.0 * edge)


def make_pool(folder: Path, missing: float, people: int = POOL) -> Pool:
    """Return the pool of one share of missing surface, fitted if its files are not there yet."""
    faces = load_faces()
    tip = faces.face_landmarks["pronasale"]

    def face(seed: int, k: int) -> Mesh:
        return faces.cut_to_face(faces.face(faces.draw_person(np.random.default_rng([seed, k]), f"{seed}_{k}")))

    trained = [face(0, k) for k in range(TRAINED)]
    model = ShapeModel.fit(trained, modes=MODES, gauge="shape", landmarks=faces.face_landmarks)
    groups: list[Mapping[str, npt.NDArray[Any]]] = []
    for changed in range(2):
        file = folder / f"pool_{round(100 * missing)}_{people}_{changed}.npz"
        if not file.is_file():
            shape = (people, MODES)
            b, stddev, used = np.zeros(shape), np.zeros(shape), np.zeros(people, dtype=bool)
            dense = np.zeros((people, *model.mean_vertices.shape), dtype=np.float32)
            for k in range(people):
                # Others in the second group: two groups of a study are different people.
                own = face(1 + changed, k)
                if changed:
                    moved = nose_change(own.vertices, tip)[:, None] * vertex_normals(own)
                    own = own.with_vertices(own.vertices + moved)
                rng = np.random.default_rng([3, changed, k, round(100 * missing)])
                scan = simulate_scan(own, rng, triangles=TRIANGLES, crop=[_cut(own, missing, rng)]).scan
                try:
                    found = fit_scan(model, scan, FitConfig(dense=True))
                except FitError:
                    continue
                b[k, : len(found.b)], stddev[k, : len(found.b_stddev)] = found.b, found.b_stddev
                dense[k] = found.T_scan_model.inverse().apply(found.surface(model, "dense").vertices)
                used[k] = found.status in ("converged", "max_iterations")
            folder.mkdir(parents=True, exist_ok=True)
            np.savez(file, b=b, b_stddev=stddev, dense=dense, used=used)
        groups.append(np.load(file))
    b, stddev, dense, used = (
        np.stack([group[name] for group in groups]) for name in ("b", "b_stddev", "dense", "used")
    )
    return Pool(model, b, stddev, dense, used, nose_change(model.mean_vertices, tip))


def _cut(face: Mesh, missing: float, rng: np.random.Generator) -> Cut:
    """Return a plane from a random side that takes away a share of the vertices."""
    turn = rng.uniform(0.0, 2.0 * np.pi)
    normal = np.array([np.cos(turn), np.sin(turn), 0.0])
    return Cut(normal * np.quantile(face.vertices @ normal, 1.0 - missing), normal)


# False positives: shapes of real fits, covariates drawn by lot.

ALONE, SUBJECTS, SCANS = 40, 24, (2, 6)
EVERY = 16
"""Vertices of which maps are tested, so that a thousand maps take minutes."""


def people_of(folders: list[Path]) -> tuple[Cohort, list[str]]:
    """Return all fits of people by models that know none of them, as if they were by one model, and who each is of."""
    model = ShapeModel.load(folders[0] / "fold_0.h5")
    K = len(model.stddev)
    b, stddev, who = list[FloatArray](), list[FloatArray](), list[str]()
    for folder in folders:
        for file in sorted((folder / "fits").glob("person_*.npz")):
            stored = np.load(file)
            fold = int((stored["status"] >= 0).all(axis=1).argmax())
            for row in np.flatnonzero(stored["status"][fold] <= 1):
                pair = [stored[name][fold, row][:K] for name in ("z", "z_stddev")]
                own, spread = (np.pad(one.astype(np.float64), (0, K - len(one))) * model.stddev for one in pair)
                b.append(own)
                stddev.append(spread)
                who.append(f"{folder.name}/{file.stem}")
    names = tuple(f"scan {at}" for at in range(len(b)))
    table = Table({"subject": tuple(who)}, names)
    fitted = FitDiagnostics(model, np.stack(b), np.stack(stddev), ("converged",) * len(b), "")
    seen = np.arange(0, len(model.mean_vertices), EVERY)
    x = model.mean_vertices[seen]
    faces = Delaunay(x[:, :2]).simplices.astype(np.int32)
    basis = model.vertex_basis.T.reshape(K, -1, 3)[:, seen].reshape(K, -1)
    return Cohort(names, x, basis, fitted.b, np.full(len(b), np.nan), table, "shape", faces, fitted=fitted), who


@dataclass
class Found:
    """How many studies found an effect that is not there: by the test of the term, and somewhere on the map."""

    studies: int = 0
    omnibus: int = 0
    somewhere: int = 0

    def count(self, study: CompareResult, term: str) -> None:
        made = next(effect.map for effect in study.effects if effect.name == term)
        assert made is not None
        self.studies += 1
        self.omnibus += study.test(term).p <= study.config.alpha
        self.somewhere += bool((made.test.p_family <= study.config.alpha).any())

    def rates_text(self) -> str:
        return f"{100 * self.omnibus / self.studies:5.1f} %   {100 * self.somewhere / self.studies:5.1f} %"


def null_studies(folders: list[Path], studies: int, permutations: int) -> Mapping[str, Found]:
    """Return what is found in studies of covariates that are drawn by lot."""
    everyone, who = people_of(folders)
    scans: dict[str, list[int]] = {}
    for at, one in enumerate(who):
        scans.setdefault(one, []).append(at)
    people = sorted(scans)
    found = {name: Found() for name in ("independent people", "between subjects", "within subjects", "blocks ignored")}
    for seed in range(studies):
        rng = np.random.default_rng([11, seed])
        options = CompareConfig(permutations=permutations, seed=seed)
        chosen = [people[int(k)] for k in rng.permutation(len(people))[:ALONE]]
        rows = [int(rng.choice(scans[one])) for one in chosen]
        sex = rng.choice(["f", "m"], ALONE)
        known = {"sex": tuple(sex), "age": tuple(f"{age:.2f}" for age in rng.uniform(20, 70, ALONE))}
        found["independent people"].count(compare(_with(everyone.take(rows), known), "~ sex + age", options), "sex")
        rows, sexes, visits = list[int](), list[str](), list[str]()
        for at, one in enumerate(chosen[:SUBJECTS]):
            own = rng.permutation(scans[one])[: rng.integers(SCANS[0], SCANS[1] + 1)]
            rows += own.tolist()
            sexes += [sex[at]] * len(own)
            visits += rng.permutation((["one", "two"] * len(own))[: len(own)]).tolist()
        cohort = _with(everyone.take(rows), {"sex": tuple(sexes), "visit": tuple(visits)})
        blocks = compare(cohort, "~ sex + visit", replace(options, blocks="subject"))
        found["between subjects"].count(blocks, "sex")
        found["within subjects"].count(blocks, "visit")
        found["blocks ignored"].count(compare(cohort, "~ sex + visit", options), "sex")
    return found


def _with(cohort: Cohort, columns: Mapping[str, tuple[str, ...]]) -> Cohort:
    return replace(cohort, table=Table({**cohort.table.columns, **columns}, cohort.table.rows))


# Power: a change of the nose between two groups.

WIDTH_MM = 12.0


def power(pool: Pool, surfaces: str, studies: int, permutations: int) -> str:
    """Return in how many studies the change is found, and where, by the maps of changes and by those of bumps."""
    count = pool.used.shape[1]
    names = tuple(f"person {at}" for at in range(2 * count))
    table = Table({"group": ("one",) * count + ("other",) * count}, names)
    b, stddev = pool.b.reshape(2 * count, -1), pool.b_stddev.reshape(2 * count, -1)
    fitted = FitDiagnostics(pool.model, b, stddev, ("converged",) * len(b), "")
    if surfaces == "coefficients":
        cohort = Cohort.of_fits(fitted, names, table, np.full(len(b), np.nan))
    else:
        shapes = pool.dense.reshape(2 * count, -1, 3).astype(np.float64)
        made = Cohort.of_shapes(shapes, {}, names=names, faces=pool.model.faces)
        cohort = replace(made, table=table, fitted=fitted)
    truth = pool.change_mm > CHANGE_MM / 2
    rows: list[tuple[float, ...]] = []
    for seed in range(studies):
        rng = np.random.default_rng([7, seed])
        one, other = (rng.permutation(np.flatnonzero(used))[:GROUP] for used in pool.used)
        options = CompareConfig(permutations=permutations, seed=seed, bump_width_mm=WIDTH_MM)
        study = compare(cohort.take([*one.tolist(), *(count + other).tolist()]), "~ group", options)
        made = study.effects[0].map
        assert made is not None and made.bump is not None
        found = made.bump.p_family <= options.alpha
        both, some = float((found & truth).sum()), float(found.sum())
        rows.append(
            (
                float(study.test("group").p <= options.alpha),
                float((made.test.p_family <= options.alpha).any()),
                float(found.any()),
                float(truth[int(made.bump.f.argmax())]),
                2 * both / (some + float(truth.sum())) if some else np.nan,
                both / some if some else np.nan,
            )
        )
    values = np.array(rows, dtype=np.float64)
    shares = "".join(f"{100 * value:7.0f} %" for value in values[:, :4].mean(axis=0))
    inside = " ".join(f"{value:7.2f}" for value in np.nanmedian(values[:, 4:], axis=0))
    return f"{shares} {inside}"


# Speed.


def speed(shapes: int, vertices: int, permutations: int) -> str:
    """Return what it takes to compare shapes, one of which there is for each direction in which they vary."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(vertices, 3))
    x *= 80.0 / np.linalg.norm(x, axis=1)[:, None]
    names = tuple(f"shape {at}" for at in range(shapes))
    known = {
        "sex": tuple(rng.choice(["f", "m"], shapes)),
        "age": tuple(f"{a:.2f}" for a in rng.uniform(20, 70, shapes)),
    }
    basis = np.linalg.qr(rng.normal(size=(3 * vertices, shapes)))[0].T
    coefficients = rng.normal(size=(shapes, shapes)) * np.linspace(100.0, 1.0, shapes)
    faces = ConvexHull(x).simplices.astype(np.int32)
    cohort = Cohort(
        names, x, basis, coefficients, np.full(shapes, np.nan), Table(known, names), "shape", faces
    )  # fmt: skip
    start = time.process_time()
    compare(cohort, "~ sex + age", CompareConfig(permutations=permutations))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    return f"{time.process_time() - start:.1f} CPU s, {peak:.2f} GiB at the peak"


def main() -> None:
    """Print what was asked for."""
    words = argparse.ArgumentParser(description=__doc__)
    words.add_argument("--quick", action="store_true", help="few studies and people")
    words.add_argument("--only", choices=("speed", "null", "power"))
    words.add_argument("--fits", type=Path, nargs="*", default=[], help="folders of studies of expressive people")
    words.add_argument("--pool", type=Path, default=Path(pooch.os_cache("shapespace")) / "benchmarks" / "compare")
    asked = words.parse_args()
    if asked.only in (None, "speed"):
        print("speed:", speed(*((100, 1000, 200) if asked.quick else (400, 10_000, 1000))), flush=True)
    if asked.only in (None, "null") and asked.fits:
        print("false positives at 5 %: term, map (family-wise)")
        for name, found in null_studies(asked.fits, 20 if asked.quick else 1000, 40 if asked.quick else 100).items():
            print(f"  {name:20} {found.rates_text()}", flush=True)
    if asked.only in (None, "power"):
        print("power: term, map, bump found, its peak in the nose, Dice, share of what is found that is true")
        for missing in MISSING:
            pool = make_pool(asked.pool, missing, 50 if asked.quick else POOL)
            for surfaces in ("coefficients", "dense"):
                rows = power(pool, surfaces, 3 if asked.quick else 40, 100)
                print(f"  {100 * missing:.0f} % missing, {surfaces:12} {rows}", flush=True)


if __name__ == "__main__":
    main()
