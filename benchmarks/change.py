"""What comes back of a known change: raw scans before and after, their fits, and `shapespace change` on these.

    python benchmarks/change.py           two kinds of objects, two seeds: about ten minutes on one core
    python benchmarks/change.py --quick   few subjects, one seed: a minute or two

Models (gauge form) are made of other people and organs. Each subject is scanned twice before (rescans) and once after
each change, with triangles, pose, noise of 0.2 mm and holes of its own each time; sizes are kept. Faces get a smooth
bump on the nose or on a cheek, 10 mm wide (standard deviation), outwards, of 1, 2 and 3 mm; organs grow thicker, which
makes 2, 5 and 10 % of volume. The truth is known at each vertex. Told are, for faces:

    peak        mm that came back at the peak, by a fit of the true bump to the map: mean and standard deviation
    volume      swept where the bump is above a twentieth of its peak, off the true one
    elsewhere   RMS of the map where nothing changed, mm
    covered     vertices whose true change lies within the 95 % interval, where it is above half of the peak,
                and where there is none; by those of rescans, and by those that the fits state
    found       subjects in whom most of what changed by more than half of the peak exceeds the smallest detectable
                change of the rescans, and share of what did not change that does

and for organs the volume that came back, of the volume before. CPU seconds are told at the end.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull

from shapespace import cli
from shapespace.cohort.read import CohortConfig, read_cohort
from shapespace.datasets.faces import load_faces
from shapespace.datasets.organs import Organ, raw_surface
from shapespace.datasets.simulated_scan import Hole, random_similarity, simulate_scan
from shapespace.geometry.normals import enclosed_volume, vertex_normals
from shapespace.io.landmarks.landmark_io import write_landmark_indices
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.statistics.change_result import ChangeConfig
from shapespace.statistics.measure_change import ChangeResult, change
from shapespace.types import FloatArray, Mesh

PEAKS_MM, SHARES, WIDTH_MM, NEAR = (1.0, 2.0, 3.0), (0.02, 0.05, 0.10), 10.0, 0.05
ORGAN_VERTICES = 1500


@dataclass(frozen=True)
class Plan:
    """How many of all, and where they lie."""

    folder: Path
    seed: int
    subjects: int
    training: int


def typed(*words: object) -> None:
    """Run a command, and say nothing."""
    with contextlib.redirect_stdout(io.StringIO()):
        code = cli.main([*map(str, words), "--quiet"])
    assert code in (0, 1), words


def fitted(plan: Plan) -> None:
    """Build the model and fit all scans."""
    home = plan.folder
    marks = ["--landmarks", home / "landmarks.csv"] if (home / "landmarks.csv").is_file() else []
    regions = ["--region", f"stable={home / 'stable.csv'}"] if (home / "stable.csv").is_file() else []
    typed("build", home / "training", "-o", home / "model.h5", "--gauge", "form", "--variance", 0.98, *marks, *regions)
    typed("fit", home / "model.h5", home / "scans", "-o", home / "fits", "--unit", "mm", "--dense", "--jobs", 1)


def write_table(plan: Plan, after: int, *, rescans: bool) -> Path:
    """Write the table of the scans before and those after the change of that number."""
    path = plan.folder / f"visits_{after}_{rescans}.csv"
    visits = ("before_0", "before_1", f"after_{after}") if rescans else ("before_0", f"after_{after}")
    rows = [f"s{k:02d}_{visit},s{k:02d},{visit[:-2]}" for k in range(plan.subjects) for visit in visits]
    path.write_text("name,subject,visit\n" + "\n".join(rows) + "\n")
    return path


def asked(
    plan: Plan, after: int, surfaces: Any, stable: str, *, rescans: bool, bumps: dict[str, FloatArray] | None = None
) -> ChangeResult:
    """Return what `change` says of it, with the volume of the place of each subject's bump."""
    config = CohortConfig(
        shapes=plan.folder / "fits", model=plan.folder / "model.h5", surfaces=surfaces, gauge="form", doubtful=True
    )
    cohort = read_cohort(write_table(plan, after, rescans=rescans), config)
    regions = {name: np.flatnonzero(bump > NEAR).tolist() for name, bump in (bumps or {}).items()}
    config = ChangeConfig(order=("before", "after"), stable=stable, regions=regions, permutations=1)
    return change(cohort, config)


# Faces


def face_plan(plan: Plan) -> dict[str, FloatArray]:
    """Write training meshes and scans of people, and return subject -> the true bump (V,) of 1 mm."""
    faces, home = load_faces(), plan.folder
    for part in ("training", "scans"):
        (home / part).mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng([plan.seed, 0])
    for k in range(plan.training):
        person = faces.cut_to_face(faces.face(faces.draw_person(rng)))
        write_mesh(home / "training" / f"t{k:03d}.ply", person)
    write_landmark_indices(home / "landmarks.csv", faces.face_landmarks)
    template = faces.cut_to_face(faces.template)
    high = np.flatnonzero(template.vertices[:, 1] > template.vertices[faces.face_landmarks["glabella"], 1])
    (home / "stable.csv").write_text("vertex\n" + "\n".join(map(str, high)) + "\n")
    truth: dict[str, FloatArray] = {}
    for k in range(plan.subjects):
        rng = np.random.default_rng([plan.seed, 1, k])
        person = faces.cut_to_face(faces.face(faces.draw_person(rng)))
        place = person.vertices[faces.face_landmarks["pronasale" if k % 2 else "left_malare"]]
        bump = np.exp(-0.5 * (np.linalg.norm(person.vertices - place, axis=1) / WIDTH_MM) ** 2)
        truth[f"s{k:02d}"] = bump
        normals = vertex_normals(person)
        visits = {"before_0": 0.0, "before_1": 0.0} | {f"after_{at}": peak for at, peak in enumerate(PEAKS_MM)}
        for visit, peak_mm in visits.items():
            moved = person.with_vertices(person.vertices + peak_mm * bump[:, None] * normals)
            pose = random_similarity(rng, 180.0, (1.0, 1.0))
            scan = simulate_scan(
                moved, rng, triangles=16_000, T_scan_model=pose, holes=(Hole(8.0), Hole(5.0)), split=False
            ).scan
            write_mesh(home / "scans" / f"s{k:02d}_{visit}.ply", scan)
    return truth


def face_rows(plan: Plan, truth: dict[str, FloatArray]) -> list[dict[str, Any]]:
    """Return what came back, a row for each change, surface and stable region, with values of each subject."""
    rows: list[dict[str, Any]] = []
    for surfaces in ("coefficients", "dense"):
        for stable in ("stable", "auto", "all"):
            for after, peak_mm in enumerate(PEAKS_MM):
                by_rescans = asked(plan, after, surfaces, stable, rescans=True, bumps=truth)
                by_fits = asked(plan, after, surfaces, stable, rescans=False, bumps=truth)
                assert by_rescans.repeatability is not None
                smallest = by_rescans.repeatability.smallest_mm
                row: dict[str, Any] = {"kind": "faces", "surfaces": surfaces, "stable": stable, "change": peak_mm}
                row["smallest"] = [float(np.median(smallest))]
                large = [np.abs(one.change.along_mm) > smallest for one in by_fits.subjects]
                for one, other, is_large in zip(by_rescans.subjects, by_fits.subjects, large, strict=True):
                    bump, area = truth[one.name], one.area_mm2
                    core, none = bump > 0.5, bump < 0.01
                    at = by_fits.regions.index(one.name)
                    for name, value in {
                        "peak": float(area * bump @ other.change.along_mm / (area * bump @ bump)),
                        "elsewhere": float(np.sqrt(np.average(other.change.along_mm[none] ** 2, weights=area[none]))),
                        "core_rescans": covered(one, peak_mm * bump, core),
                        "none_rescans": covered(one, peak_mm * bump, none),
                        "core_fits": covered(other, peak_mm * bump, core),
                        "none_fits": covered(other, peak_mm * bump, none),
                        "found": float(np.mean(other.change.along_mm[core] > smallest[core]) > 0.5),
                        "false": float(np.average(is_large[none], weights=area[none])),
                        "volume": other.change.volumes_mm3[at] / (peak_mm * float(area @ bump)) - 1.0,
                    }.items():  # fmt: skip
                        row.setdefault(name, []).append(value)
                rows.append(row)
    return rows


def covered(subject: Any, truth: FloatArray, where: Any) -> float:
    """Return the share of vertices whose true change lies within the 95 % interval."""
    off = np.abs(subject.change.along_mm - truth)[where]
    return float(np.mean(off <= subject.change.quantile * subject.change.stddev_mm[where]))


# Organs


def organ_mesh(organ: Organ) -> Mesh:
    """Return an organ in correspondence with all others."""
    i = np.arange(ORGAN_VERTICES)
    z, angle = 1 - (2 * i + 1) / ORGAN_VERTICES, np.pi * (3 - np.sqrt(5)) * i
    d = np.column_stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z])
    faces = ConvexHull(d).simplices.astype(np.int32)
    a, b, c = (d[faces[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
    faces[inward] = faces[inward][:, ::-1]
    return Mesh(organ.surface(d), faces, name="organ")


def grown(organ: Organ, share: float) -> Organ:
    """Return it thicker, so that it has `share` more volume, which is linear in its thickness."""
    return replace(organ, half_mm=organ.half_mm * np.array([1.0, 1.0, 1.0 + share]))


def volume(mesh: Mesh) -> float:
    """Return the volume of a closed surface, mm3."""
    assert mesh.faces is not None
    return enclosed_volume(mesh.vertices, mesh.faces)


def organ_plan(plan: Plan) -> dict[str, list[float]]:
    """Write training meshes and scans of organs, and return subject -> shares that its volume truly grows by."""
    home = plan.folder
    for part in ("training", "scans"):
        (home / part).mkdir(parents=True, exist_ok=True)
    for k in range(plan.training):
        organ = Organ.draw(np.random.default_rng([plan.seed, 2, k]))
        write_mesh(home / "training" / f"t{k:03d}.ply", organ_mesh(organ))
    truth: dict[str, list[float]] = {}
    for k in range(plan.subjects):
        rng = np.random.default_rng([plan.seed, 3, k])
        organ = Organ.draw(rng)
        before = volume(organ_mesh(organ))
        truth[f"s{k:02d}"] = [volume(organ_mesh(grown(organ, share))) / before - 1 for share in SHARES]
        visits = {"before_0": 0.0, "before_1": 0.0} | {f"after_{at}": share for at, share in enumerate(SHARES)}
        for visit, share in visits.items():
            write_mesh(home / "scans" / f"s{k:02d}_{visit}.ply", raw_surface(grown(organ, share), rng))
    return truth


def organ_rows(plan: Plan, truth: dict[str, list[float]]) -> list[dict[str, Any]]:
    """Return what came back of the volumes."""
    rows: list[dict[str, Any]] = []
    for surfaces in ("coefficients", "dense"):
        for after, share in enumerate(SHARES):
            by_rescans = asked(plan, after, surfaces, "all", rescans=True)
            by_fits = asked(plan, after, surfaces, "all", rescans=False)
            assert by_rescans.repeatability is not None
            smallest = float(by_rescans.repeatability.volumes_smallest_mm3[0])
            row: dict[str, Any] = {"kind": "organs", "surfaces": surfaces, "stable": "all", "change": 100 * share}
            for one, other in zip(by_rescans.subjects, by_fits.subjects, strict=True):
                true = truth[one.name][after]
                found = float(other.change.volumes_mm3[0]) / other.volume_before_mm3
                # A share of the volume before, as the true one is, so that the size of the fit's own error drops out.
                for name, value in {
                    "off": 100 * (found - true),
                    "smallest": 100 * smallest / other.volume_before_mm3,
                    "covered_rescans": float(
                        abs(float(one.change.volumes_mm3[0]) - true * one.volume_before_mm3)
                        <= one.change.quantile * float(one.change.volumes_stddev_mm3[0])
                    ),
                    "covered_fits": float(
                        abs(float(other.change.volumes_mm3[0]) - true * other.volume_before_mm3)
                        <= 1.96 * float(other.change.volumes_stddev_mm3[0])
                    ),
                    "found": float(float(other.change.volumes_mm3[0]) > smallest),
                }.items():
                    row.setdefault(name, []).append(value)
            rows.append(row)
    return rows


# Tables


def merged(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return rows of the same question from several seeds as one."""
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        key = tuple(row[name] for name in ("kind", "surfaces", "stable", "change"))
        there = found.setdefault(key, {name: value for name, value in row.items() if not isinstance(value, list)})
        for name, value in row.items():
            if isinstance(value, list):
                there[name] = [*there.get(name, []), *value]
    return list(found.values())


def tell(rows: Sequence[dict[str, Any]]) -> None:
    """Print both tables as Markdown."""
    print("| surfaces | stable | change, mm | peak, mm | elsewhere, mm | volume | covered by rescans: changed, "
          "elsewhere | by fits: changed, elsewhere | found | false | SDC, mm |")  # fmt: skip
    print("|" + "---|" * 11)
    for row in rows:
        if row["kind"] != "faces":
            continue
        mean = {name: float(np.mean(value)) for name, value in row.items() if isinstance(value, list)}
        spread = {name: float(np.std(row[name], ddof=1)) for name in ("peak", "volume")}
        print(
            f"| {row['surfaces']} | {row['stable']} | {row['change']:g} | {mean['peak']:.2f} ± {spread['peak']:.2f} "
            f"| {mean['elsewhere']:.2f} | {100 * mean['volume']:+.0f} ± {100 * spread['volume']:.0f} % "
            f"| {100 * mean['core_rescans']:.0f} %, {100 * mean['none_rescans']:.0f} % "
            f"| {100 * mean['core_fits']:.0f} %, {100 * mean['none_fits']:.0f} % | {100 * mean['found']:.0f} % "
            f"| {100 * mean['false']:.0f} % | {mean['smallest']:.2f} |"
        )
    print("\n| surfaces | growth | bias ± stddev, points | covered by rescans | by fits | found | SDC |")
    print("|" + "---|" * 7)
    for row in rows:
        if row["kind"] != "organs":
            continue
        mean = {name: float(np.mean(value)) for name, value in row.items() if isinstance(value, list)}
        print(
            f"| {row['surfaces']} | {row['change']:.0f} % | {mean['off']:+.2f} ± {np.std(row['off'], ddof=1):.2f} "
            f"| {100 * mean['covered_rescans']:.0f} % | {100 * mean['covered_fits']:.0f} % "
            f"| {100 * mean['found']:.0f} % | {mean['smallest']:.2f} % |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="3 subjects, one seed")
    parser.add_argument("--subjects", type=int, default=8)
    parser.add_argument("--training", type=int, default=60)
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 23])
    parser.add_argument("--kinds", nargs="+", choices=("faces", "organs"), default=["faces", "organs"])
    parser.add_argument("--keep", type=Path, help="folder in which scans and fits stay, and are taken up again")
    arguments = parser.parse_args()
    subjects, training, seeds = (3, 20, [11]) if arguments.quick else (
        arguments.subjects, arguments.training, arguments.seeds
    )  # fmt: skip
    began = time.process_time()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        for kind in arguments.kinds:
            for seed in seeds:
                folder = (arguments.keep or Path(temporary)) / f"{kind}_{seed}"
                plan = Plan(folder, seed, subjects, training)
                if kind == "faces":
                    truth = face_plan(plan)
                    fitted(plan)
                    rows += face_rows(plan, truth)
                else:
                    shares = organ_plan(plan)
                    fitted(plan)
                    rows += organ_rows(plan, shares)
    tell(merged(rows))
    print(
        f"\n{subjects} subjects of each kind and seed, {len(seeds)} seeds; {time.process_time() - began:.0f} s of CPU"
    )


if __name__ == "__main__":
    main()
