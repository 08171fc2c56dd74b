"""Recognition from vertices and from B-spline control points, at equal numbers of modes, on the people of the study.

    python benchmarks/recognition_by_shape_space.py                       60 people train, 30 are tested, 50 modes
    python benchmarks/recognition_by_shape_space.py --train 8 --test 4 --modes 20

One PCA of the training people's meshes, as in the paper; every scan, of training and of test people, is fitted raw.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from shapespace.batch.workers import context, cores
from shapespace.datasets.ict import load_ict
from shapespace.datasets.study_people import StudyPeople
from shapespace.fit.fit import FitConfig, fit_scan
from shapespace.model.shape_model import ShapeModel
from shapespace.recognise import evaluate

PEOPLE = StudyPeople(levels=(0.5, 1.0))
KINDS = {
    "vertices": ("vertices", None),
    "bspline 24x24": ("bspline", (24, 24)),
    "bspline-detail 24x24": ("bspline-detail", (24, 24)),
    "bspline-detail 32x32": ("bspline-detail", (32, 32)),
}
_model: ShapeModel | None = None


def start(path: Path) -> None:
    global _model
    threadpool_limits(1)
    _model = ShapeModel.load(path)


def fit_person(person: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Return z (S, K), vertex errors (S,) in mm, and how many fits are doubtful."""
    assert _model is not None
    ict, z, errors, doubtful = load_ict(), [], [], 0
    for k, face in enumerate(PEOPLE.faces(ict, person)):
        scan = PEOPLE.scan(face, person, k)
        fitted = fit_scan(_model, scan.scan, FitConfig(unit="mm"))
        away = fitted.T_scan_model.apply(_model.reconstruct(fitted.b)) - scan.truth_vertices
        z.append(fitted.z)
        errors.append(np.linalg.norm(away, axis=1).mean() / scan.T_scan_model.scale)
        doubtful += fitted.status == "doubtful"
    return np.stack(z), np.array(errors), doubtful


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", type=int, default=60)
    parser.add_argument("--test", type=int, default=30)
    parser.add_argument("--modes", type=int, default=50)
    parser.add_argument("--out", type=Path, default=Path("bench-out"))
    chosen = parser.parse_args(arguments)
    chosen.out.mkdir(parents=True, exist_ok=True)
    ict = load_ict()
    everybody = range(chosen.train + chosen.test)
    strongest = [k for k, (_, level) in enumerate(PEOPLE.shown) if level in (0.0, 1.0)]
    meshes = [PEOPLE.faces(ict, person)[k] for person in range(chosen.train) for k in strongest]
    expression = np.array([name for name, _ in PEOPLE.shown])
    rows = []
    for name, (representation, control_points) in KINDS.items():
        model = ShapeModel.fit(meshes, modes=chosen.modes, representation=representation, control_points=control_points)
        path = chosen.out / "recognition_model.h5"
        model.save(path)
        since = time.perf_counter()
        with ProcessPoolExecutor(cores(), mp_context=context(), initializer=start, initargs=(path,)) as pool:
            found = list(pool.map(fit_person, everybody))
        seconds = (time.perf_counter() - since) * cores() / (len(found) * len(PEOPLE.shown))
        row = {"shape space": name, "file_mb": path.stat().st_size / 1e6, "seconds_a_scan": seconds}
        row["vertex_error_mm"] = float(np.mean([errors for _, errors, _ in found[chosen.train :]]))
        row["doubtful"] = sum(doubtful for _, _, doubtful in found[chosen.train :])
        for known in (False, True):
            codes = [z - z[:1] if known else z for z, _, _ in found]
            halves = (slice(chosen.train), slice(chosen.train, None))
            parts = [np.concatenate([z[1:] for z in codes[half]]) for half in halves]
            subjects = [[f"p{p}" for p in everybody[half] for _ in expression[1:]] for half in halves]
            labels = [np.tile(expression[1:], n).tolist() for n in (chosen.train, chosen.test)]
            fold = evaluate.Fold(parts[0], labels[0], subjects[0], parts[1], labels[1], subjects[1])
            answer = evaluate.fixed_predictions([fold], "lda")
            key = "neutral known" if known else "neutral unknown"
            row[key] = evaluate.macro_accuracy(answer.labels, answer.predicted, answer.classes)
            row[f"{key}, 95 %"] = evaluate.subject_bootstrap(answer.labels, answer.predicted, answer.subjects)
        path.unlink()
        rows.append(row)
        print(json.dumps(row), flush=True)
    (chosen.out / "recognition_by_shape_space.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
