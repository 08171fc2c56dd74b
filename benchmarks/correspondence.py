"""How well do raw scans come into correspondence, with no model, template or landmarks?

    python benchmarks/correspondence.py                            all cases, hours
    python benchmarks/correspondence.py faces --scans 48 --seed 7
    python benchmarks/correspondence.py femora --vertices 5000 --jobs 2
    python benchmarks/correspondence.py faces damaged expressions --people bundled
    python benchmarks/correspondence.py faces --given              template: the first one's true mesh
    python benchmarks/correspondence.py templates                  from two templates: how far apart
    python benchmarks/correspondence.py added --scans 16           the last four added to the others
    python benchmarks/correspondence.py faces --scans 6 --triangles 100000

Faces (ICT-FaceKit, or the bundled ones) and femora (samples of the open femur model) are known, so dispersion can be
told: each vertex is carried to the true surface of every scan, from there to the mean; its distance from the median
over scans counts; 0 is perfect. Spleens are real, and only distances to their surfaces can be told, as shares of
the diagonal.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from reliability import Femora

from shapespace.batch.executors import ExecutionConfig
from shapespace.batch.parallel_rounds import RoundRunner
from shapespace.correspondence.correspondence_result import Correspondence
from shapespace.correspondence.groupwise import FinishedCorrespondence, add_scans, correspond, run_here
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.datasets.faces import load_faces
from shapespace.datasets.ict import EXPRESSIONS, LANDMARK_VERTICES, load_ict
from shapespace.datasets.simulated_scan import Cut, Hole, random_similarity, simulate_scan
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import vertex_normals
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.types import BoolArray, FloatArray, Mesh, Similarity

FACE_MM = 95.0
"""Of faces, what lies this near to the tip of the nose counts."""
SPIKES, SPIKE_MM = 0.05, 1.0
"""Share of the points of a damaged scan that are thrown off the surface, and by how much (standard deviation)."""
MISSING, METRE = 0.2, 1e-3
EXPRESSION_NAMES = ("neutral", "anger", "disgust", "fear", "smile", "surprise")


@dataclass(frozen=True, eq=False)
class Known:
    """A raw scan and the true surface below it.

    Args:
        scan: as the method gets it.
        truth: (V, 3) in its frame.
        T_scan_model: from mm to its frame.
    """

    scan: Mesh
    truth: FloatArray
    T_scan_model: Similarity


@dataclass(frozen=True, eq=False)
class Set:
    """Scans whose truth is known.

    Args:
        known: the scans.
        mean: in mm; its vertices are those of every truth.
        counted: (V,) which of them count.
        length_mm: of the object.
    """

    known: list[Known]
    mean: Mesh
    counted: BoolArray
    length_mm: float


def raw(
    mesh: Mesh, rng: np.random.Generator, triangles: int, name: str, cut: Sequence[Cut] = (), *, own_size: bool = False
) -> Known:
    """Return `mesh` as a scanner would give it, in any pose, its size drawn too unless it keeps its own."""
    T = random_similarity(rng, 180.0, (1.0, 1.0) if own_size else (0.9, 1.1))
    made = simulate_scan(mesh, rng, triangles=triangles, noise_mm=0.2, T_scan_model=T, name=name, crop=cut)
    return Known(made.scan, made.truth_vertices, T)


def damaged(mesh: Mesh, rng: np.random.Generator, triangles: int, name: str, middle: FloatArray) -> Known:
    """Return `mesh` with a fifth missing in three holes about `middle`, spikes, every other scan in metres."""
    T = random_similarity(rng, 180.0)
    if int(name[-1]) % 2:
        T = Similarity(T.scale * METRE, T.rotation, T.translation * METRE)
    centres = mesh.vertices[rng.choice(np.flatnonzero(np.linalg.norm(mesh.vertices - middle, axis=1) < FACE_MM), 3)]
    # The radius that leaves out the share wanted of the vertices.
    near = np.linalg.norm(mesh.vertices[:, None] - centres, axis=2).min(axis=1)
    inside = np.linalg.norm(mesh.vertices - middle, axis=1) < FACE_MM
    radius = float(np.quantile(near[inside], MISSING))
    holes = [Hole(radius, centre) for centre in centres]
    made = simulate_scan(mesh, rng, triangles=triangles, noise_mm=0.2, T_scan_model=T, name=name, holes=holes)
    vertices, thrown = np.array(made.scan.vertices), rng.random(len(made.scan.vertices)) < SPIKES
    off = (thrown * rng.standard_normal(len(thrown)) * SPIKE_MM * T.scale)[:, None] * vertex_normals(made.scan)
    return Known(made.scan.with_vertices(vertices + off), made.truth_vertices, T)


def dispersion(made: Correspondence, of: Set) -> dict[str, float | None]:
    """Return dispersion in mm on the mean, over the vertices that lie near those counted, and to the true surface.

    Distances to the true surface are those of observed vertices; estimated ones have a figure of their own.
    """
    places, gaps, observations = [], [], []
    for one, truth in zip(made.scans, of.known[: len(made.scans)], strict=True):
        if one.vertices is None:
            continue
        near = build_engine(Mesh(truth.truth, of.mean.faces)).query(np.ascontiguousarray(one.vertices))
        places.append(np.einsum("mc,mcd->md", near.barycentric, of.mean.vertices[of.mean.faces[near.triangle]]))
        gaps.append(near.distance / truth.T_scan_model.scale)
        observations.append(np.ones(len(one.vertices), np.bool_) if one.observed is None else one.observed)
    place = np.array(places)
    middle = np.median(place, axis=0)
    inside = of.counted[build_engine(of.mean).query(middle).vertex]
    apart = np.linalg.norm(place - middle, axis=2)[:, inside]
    gap, observed = np.array(gaps)[:, inside], np.array(observations)[:, inside]
    return {
        "mean_mm": float(apart.mean()),
        "median_mm": float(np.median(apart)),
        "p95_mm": float(np.quantile(apart, 0.95)),
        "worst_scan_mm": float(apart.mean(axis=1).max()),
        "last_scans_mm": float(apart[-ADDED:].mean()),
        "to_true_surface_mm": float(gap[observed].mean()),
        "estimated_to_true_surface_mm": float(gap[~observed].mean()) if not observed.all() else None,
        "observed": float(observed.mean()),
        "mean_share_of_length": float(apart.mean()) / of.length_mm,
    }


def people(source: str, scans: int, seed: int, expressions: Sequence[str]) -> tuple[list[Mesh], Mesh, int]:
    """Return true faces, each person with each of `expressions`, their mean and the vertex at the tip of its nose."""
    rng, each = np.random.default_rng(77 + seed), len(expressions)
    count = -(-scans // each)
    if source == "ict":
        ict = load_ict()
        recipes = [EXPRESSIONS.get(name) for name in expressions]
        meshes = [ict.mesh(w, recipe) for w in ict.draw_people(count, 77 + seed) for recipe in recipes]
        return meshes[:scans], ict.mesh(), LANDMARK_VERTICES["nose_3"]
    heads = load_faces()
    drawn = [heads.draw_person(rng) for _ in range(count)]
    meshes = [
        heads.face(person, heads.draw_expression(name, rng, 1.0) if name != "neutral" else None)
        for person in drawn
        for name in expressions
    ]
    mean = Mesh(np.mean([mesh.vertices for mesh in meshes], axis=0), meshes[0].faces)
    return meshes[:scans], mean, heads.landmarks["pronasale"]


def faces(
    scans: int,
    seed: int,
    source: str = "ict",
    *,
    harm: bool = False,
    expressive: bool = False,
    triangles: int = 30_000,
) -> Set:
    """Simulated people, heads and necks."""
    rng = np.random.default_rng(seed)
    meshes, mean, nose = people(source, scans, seed, EXPRESSION_NAMES if expressive else ("neutral",))
    middle = mean.vertices[nose]
    known = [
        damaged(mesh, rng, 30_000, f"person{k}", mesh.vertices[nose])
        if harm
        else raw(mesh, rng, triangles, f"person{k}")
        for k, mesh in enumerate(meshes)
    ]
    counted = np.linalg.norm(mean.vertices - middle, axis=1) < FACE_MM
    return Set(known, mean, counted, float(np.ptp(mean.vertices, axis=0).max()))


def femora(scans: int, seed: int, _source: str = "", *, cut_every: int = 0, own_size: bool = False) -> Set:
    """Samples of the femur model, 12,000 triangles; of every so many, 30 % of the length is cut off at one end."""
    femur, rng = Femora(), np.random.default_rng(seed)
    drawn = [femur.draw(rng) for _ in range(scans)]
    mean = Mesh(femur._model[0], drawn[0].faces)
    along = int(np.ptp(mean.vertices, axis=0).argmax())
    known = []
    for k, mesh in enumerate(drawn):
        low, high = mesh.vertices[:, along].min(), mesh.vertices[:, along].max()
        end = 1.0 if (k // max(cut_every, 1)) % 2 else -1.0
        point, normal = mesh.vertices.mean(axis=0).copy(), np.zeros(3)
        point[along], normal[along] = (high - 0.3 * (high - low) if end > 0 else low + 0.3 * (high - low)), end
        cut = [Cut(point, normal)] if cut_every and k % cut_every == 0 else []
        known.append(raw(mesh, rng, 12_000, f"femur{k}", cut, own_size=own_size))
    whole = np.ones(len(mean.vertices), dtype=np.bool_)
    return Set(known, mean, whole, float(np.ptp(mean.vertices, axis=0).max()))


SETS: dict[str, tuple[Callable[..., Set], dict[str, object], int]] = {
    "faces": (faces, {}, 24),
    "damaged": (faces, {"harm": True}, 24),
    "expressions": (faces, {"expressive": True}, 60),
    "femora": (femora, {}, 40),
    "cut-femora": (femora, {"cut_every": 4}, 40),
    "cut-femora-of-own-size": (femora, {"cut_every": 4, "own_size": True}, 40),
}
OTHERS = ("templates", "spleens", "added")
ADDED = 4
"""Scans that are added to the others."""


def spleens(scans: int, seed: int, run: Callable[[list[Mesh], Mesh | None], Correspondence]) -> dict[str, object]:
    """Real spleens, from `spleens/` of the folder that SHAPESPACE_DATA names."""
    files = sorted((Path(os.environ.get("SHAPESPACE_DATA", ".")) / "spleens").glob("*.ply"))
    if not files:
        raise SystemExit("The spleens are not here; set SHAPESPACE_DATA to the folder that holds spleens/.")
    chosen = np.sort(np.random.default_rng(seed).permutation(len(files))[:scans])
    meshes = [read_mesh(files[k]) for k in chosen]
    made = run(meshes, None)
    diagonal = [float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) for mesh in meshes]
    shares = [
        np.array(one.distance) / length
        for one, length in zip(made.scans, diagonal, strict=True)
        if one.vertices is not None
    ]
    mean, p95, p99, largest = np.mean(shares, axis=0)
    told = {"mean_share": mean, "p95_share": p95, "p99_share": p99, "largest_share": largest}
    return told | summary(made)


def templates(of: Set, run: Callable[[list[Mesh], Mesh | None], Correspondence], vertices: int) -> dict[str, object]:
    """From the first scan and from the second as the template: how far apart the two correspondences carry a point.

    A point of each scan is carried to another one by both; its two places there are compared, mm.
    """
    from shapespace.correspondence.template import clean_scan, resample

    scans = [one.scan for one in of.known]
    made = [run(scans, resample(clean_scan(scans[k]), vertices)) for k in (0, 1)]
    rng, apart = np.random.default_rng(0), []
    for i in range(len(scans)):
        j = (i + 1) % len(scans)
        ends = [(one.scans[i].vertices, one.scans[j].vertices) for one in made]
        if any(a is None or b is None for a, b in ends):
            continue
        points = of.known[i].truth[rng.choice(np.flatnonzero(of.counted), 500)]
        carried = []
        for one, (a, b) in zip(made, ends, strict=True):
            assert a is not None and b is not None
            good = (np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1))[one.template.faces].all(axis=1)
            near = build_engine(Mesh(np.nan_to_num(a), one.template.faces[good])).query(points)
            place = np.einsum("mc,mcd->md", near.barycentric, b[one.template.faces[good][near.triangle]])
            carried.append(place / of.known[j].T_scan_model.scale)
        apart.append(np.linalg.norm(carried[0] - carried[1], axis=1))
    whole = np.concatenate(apart)
    return {
        "apart_mean_mm": float(whole.mean()), "apart_median_mm": float(np.median(whole)),
        "apart_p95_mm": float(np.quantile(whole, 0.95)), "set_aside": [summary(one)["set_aside"] for one in made],
    }  # fmt: skip


def added(
    of: Set, run: Callable[[list[Mesh], Mesh | None], Correspondence], config: CorrespondConfig
) -> dict[str, object]:
    """The last scans added to a correspondence of the others, with and without an update, beside all together."""
    scans = [one.scan for one in of.known]
    others, last = scans[:-ADDED], scans[-ADDED:]
    seconds = [time.process_time()]

    def timed(made: Correspondence) -> tuple[Correspondence, float]:
        seconds.append(time.process_time())
        return made, seconds[-1] - seconds[-2]

    joint, joint_s = timed(run(scans, None))
    first, first_s = timed(run(others, None))
    finished = FinishedCorrespondence(first.template, first.landmarks, first.meshes())
    rest, added_s = timed(add_scans(finished, last, config))
    updated, updated_s = timed(add_scans(replace(finished, scans=others), last, config))
    outcomes = {
        "together": (joint, joint_s),
        "others alone": (first, first_s),
        "added": (replace(first, scans=(*first.scans, *rest.scans)), added_s),
        "added with --update": (updated, updated_s),
    }
    return {
        name: {**dispersion(made, of), "set_aside": summary(made)["set_aside"], "cpu_s": cpu_s}
        for name, (made, cpu_s) in outcomes.items()
    }


def summary(made: Correspondence) -> dict[str, object]:
    """Return what a correspondence says of itself."""
    return {
        "cpu_s_a_scan_and_round": float(np.mean([second for one in made.scans for second in one.seconds])),
        "moved": [round(share, 4) for share in made.moved],
        "set_aside": {one.name: one.reason for one in made.scans if one.reason},
    }


def main() -> None:
    """Run the cases that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", choices=[*SETS, *OTHERS, []], default=[])
    parser.add_argument("--scans", type=int)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--people", choices=["ict", "bundled"], default="ict")
    parser.add_argument("--given", action="store_true", help="the template is the first one's true mesh")
    parser.add_argument("--vertices", type=int, default=CorrespondConfig.vertices)
    parser.add_argument("--rounds", type=int, default=CorrespondConfig.rounds)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--triangles", type=int, default=30_000, help="of each face")
    arguments = parser.parse_args()
    config = CorrespondConfig(vertices=arguments.vertices, rounds=arguments.rounds)

    def run(scans: list[Mesh], template: Mesh | None) -> Correspondence:
        if arguments.jobs < 2:
            return correspond(scans, config, template=template, run=run_here)
        with tempfile.TemporaryDirectory() as folder:
            kept = RoundRunner(Path(folder), ExecutionConfig(jobs=arguments.jobs), quiet=True, on_done=lambda: None)
            return correspond(scans, config, template=template, run=kept)

    for name in arguments.cases or [*SETS, *OTHERS]:
        begun = time.process_time()
        report: dict[str, object]
        if name == "spleens":
            report = spleens(arguments.scans or 40, arguments.seed, run)
        elif name == "added":
            drawn = faces(arguments.scans or 16, arguments.seed, arguments.people)
            report = added(drawn, run, config)
        elif name == "templates":
            report = templates(faces(arguments.scans or 24, arguments.seed, arguments.people), run, arguments.vertices)
        else:
            make, options, usual = SETS[name]
            options = options | ({"triangles": arguments.triangles} if make is faces else {})
            drawn = make(arguments.scans or usual, arguments.seed, arguments.people, **options)
            first = drawn.known[0]
            true = drawn.mean.with_vertices(first.T_scan_model.inverse().apply(first.truth))
            made = run([one.scan for one in drawn.known], true if arguments.given else None)
            report = {**dispersion(made, drawn), **summary(made)}
        peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        report |= {"cpu_s": time.process_time() - begun, "peak_memory_mb": peak_mb}
        asked = {"case": name, **vars(arguments), "cases": None}
        print(json.dumps({**asked, **report}, indent=1), flush=True)


if __name__ == "__main__":
    main()
