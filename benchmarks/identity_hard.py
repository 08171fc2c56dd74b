"""Measure verification and identification of similar people by poor scans, so that every score makes errors.

People of ICT-FaceKit whose identity coefficients are multiplied by a factor below 1 (`spread`), with more noise and
40 % of each scan missing. Other people with the same spread make the additive model; those tested are parted into four
folds, and scores and calibration are learned from the people of the other folds. Each person is scanned neutral (the
gallery) and with six expressions, each at one intensity (the probes). Every scan is a raw surface and is fitted;
nothing is simulated at the level of coefficients. Needs ICT-FaceKit; a row takes about 10 CPU minutes.

    python benchmarks/identity_hard.py
"""

from __future__ import annotations

import argparse
import io
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from identity import AS_EXACT, Fold, measured, samples, table, told
from identity_scans import Condition

from shapespace.datasets.ict import landmark_vertices
from shapespace.errors import ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.geometry.mirror_plane import FLIP
from shapespace.io.files import make_folder, read_bytes, write_bytes
from shapespace.model.additive import AdditiveModel
from shapespace.statistics.identity.scores import SCORES
from shapespace.types import FloatArray, Mesh
from simulated import MIRRORED, SETTINGS, StudyConfig, faces_of_ict, run_jobs
from study_fits import STATUSES
from study_people import StudyPeople

FOLDS = 4


@dataclass(frozen=True)
class HardCase:
    """A population of similar people, and the settings of their scans.

    Args:
        spread: factor of the identity coefficients, 1 for people of ICT-FaceKit.
        noise_mm: along the normals.
        missing: share of the vertices of each scan.
    """

    spread: float
    noise_mm: float
    missing: float

    @property
    def name(self) -> str:
        """Return the name of the row in the table."""
        return f"spread × {self.spread:g}, noise {self.noise_mm:g} mm, {100 * self.missing:.0f} % missing"


CASES = (HardCase(0.5, 1.0, 0.4), HardCase(0.25, 1.5, 0.4))
SHOWN: Mapping[str, Any] = MappingProxyType({"neutral": True, "expressions": 6, "number": 0})


def faces_of(people: StudyPeople, case: HardCase, person: int) -> list[Mesh]:
    """Return the true surfaces of a person, one for each of `StudyPeople.shown`."""
    ict = faces_of_ict()
    who: FloatArray = case.spread * ict.draw_people(person + 1, people.seed)[person]
    return people.faces(ict, person, coefficients=who)


def make_model(path: Path, config: StudyConfig, case: HardCase, first: int, count: int) -> None:
    """Write the additive model of `count` people from `first` on, neutral and each expression at its strongest."""
    people = config.people
    strongest, other = max(people.levels), faces_of_ict().mirror
    meshes: list[Mesh] = []
    subjects: list[str] = []
    neutral: list[bool] = []
    for person in range(first, first + count):
        for face, (_, level) in zip(faces_of(people, case, person), people.shown, strict=True):
            if level in (0.0, strongest):
                meshes += [face, face.with_vertices(face.vertices[..., other, :] * FLIP)]
                subjects += [people.subject(person), people.subject(person) + MIRRORED]
                neutral += 2 * [level == 0.0]
    AdditiveModel.fit(
        meshes,
        subjects,
        neutral,
        identity_modes=config.identity_modes,
        expression_modes=config.expression_modes,
        kin=[subject.removesuffix(MIRRORED) for subject in subjects],
        landmarks=landmark_vertices("face"),
        provenance=f"{count} simulated people of ICT-FaceKit with {len(people.expressions)} expressions",
        licence="MIT",
    ).save(path)


def fit_person(path: Path, model_file: Path, people: StudyPeople, case: HardCase, number: int, person: int) -> None:
    """Write the fits of a person's scans."""
    model = AdditiveModel.load(model_file)
    scanned = replace(people, noise_mm=case.noise_mm, missing=case.missing)
    faces, shown = faces_of(people, case, person), Condition({}, **SHOWN).shown(people, person)
    z = np.full((len(shown), model.shape.n_modes), np.nan)
    stddev = np.full_like(z, np.nan)
    status = np.full(len(shown), STATUSES.index("failed"), dtype=np.int32)
    for row, which in enumerate(shown):
        rng = np.random.default_rng((people.seed, 9, number, person, which))
        scan = scanned.raw_scan(faces[which], rng, people.name(person, which))
        try:
            fitted = fit_scan(model.shape, scan.scan, FitConfig(SETTINGS, unit="mm"))
        except ShapespaceError:
            continue  # it stays "failed", and is counted as such
        z[row], stddev[row] = fitted.z, fitted.b_stddev / model.shape.stddev
        status[row] = STATUSES.index(fitted.status)
    memory = io.BytesIO()
    np.savez(memory, z=z, z_stddev=stddev, status=status, shown=np.array(shown, dtype=np.int32))
    make_folder(path.parent)
    write_bytes(path, memory.getvalue())


def fits_of_case(folder: Path, people: int, number: int, case: HardCase, workers: int) -> tuple[Path, list[Path]]:
    """Fit all scans of a case, leaving out those whose file is there, and return the model and the files."""
    # The people who make the model come after those tested.
    config = StudyConfig(StudyPeople(people=people), folds=FOLDS, strangers=0)
    own = folder / f"case_{number}_{people}"
    make_folder(own)
    model_file = own / "model.h5"
    files = [own / f"person_{person:03d}.npz" for person in range(people)]
    count = max(people * 3 // 2, 12)
    jobs = [(fit_person, (file, model_file, config.people, case, number, person)) for person, file in enumerate(files)]
    run_jobs(
        [
            (f"{case.name}: model", [(make_model, (model_file, config, case, people, count))], [model_file]),
            (f"{case.name}: people", jobs, files),
        ],
        workers=workers,
        on_progress=told,
    )
    return model_file, files


def folds_of_case(model_file: Path, files: list[Path]) -> tuple[list[Fold], dict[str, int]]:
    """Return the folds of a case, and the number of fits of each status."""
    model = AdditiveModel.load(model_file)
    good = [STATUSES.index(name) for name in ("converged", "max_iterations")]
    parts: list[dict[str, Any]] = []
    for file in files:
        with np.load(io.BytesIO(read_bytes(file)), allow_pickle=False) as held:
            parts.append({name: held[name] for name in held.files})
    z, stddev, status, shown = (
        np.concatenate([part[name] for part in parts]) for name in ("z", "z_stddev", "status", "shown")
    )
    person = np.repeat(np.arange(len(parts)), [len(part["z"]) for part in parts])
    fold_of = np.random.default_rng(3).permutation(len(parts)) % FOLDS
    used = np.isin(status, good)
    folds: list[Fold] = []
    for fold in range(FOLDS):
        mine = fold_of[person] == fold
        training, gallery, probes = (
            samples(model, z[rows], stddev[rows], [str(p) for p in person[rows]])
            for rows in (used & ~mine, used & mine & (shown == 0), used & mine & (shown > 0))
        )
        folds.append(Fold(training, gallery, probes, group=fold))
    return folds, {name: int((status == k).sum()) for k, name in enumerate(STATUSES)}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, default=40, help="tested in each row (default 40)")
    parser.add_argument("--cases", type=int, nargs="*", default=list(range(len(CASES))), help="rows, from 0")
    parser.add_argument("--work", type=Path, default=Path("identity-work/hard"), help="where fits are written")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--draws", type=int, default=1000, help="of people, for intervals")
    parser.add_argument("--json", type=Path, help="where all figures are written")
    chosen = parser.parse_args()
    found: dict[str, Any] = {}
    for number in chosen.cases:
        case = CASES[number]
        folds, counts = folds_of_case(*fits_of_case(chosen.work, chosen.people, number, case, chosen.jobs))
        scores = measured(folds, [*list(SCORES)[:1], AS_EXACT, *list(SCORES)[1:]], (), chosen.draws)
        found[case.name] = {"fits": counts, "scores": scores}
    print(table(found))
    for name, one in found.items():
        scores = one["scores"]
        calibrated, score = scores["plda"]["cllr"][0], scores["plda"]["cllr_of_the_score"]
        print(f"{name}: fits {one['fits']}, pairs {scores['pairs']}")
        print(f"{name}: Cllr of uncalibrated PLDA scores {score:.2f}, calibrated {calibrated:.2f} bits")
    if chosen.json:
        chosen.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
