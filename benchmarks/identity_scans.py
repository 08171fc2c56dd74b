"""Harder scans of the people of the simulated study, fitted with the models that did not see them.

Each condition changes one thing of the study's scans. A person is shown neutral and with expressions, each at one
intensity that goes round from person to person; every scan is drawn anew, so that none shares its noise, its holes or
its triangles with one of the study.
"""

from __future__ import annotations

import io
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from shapespace.errors import ShapespaceError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.io.files import make_folder, read_bytes, write_bytes
from shapespace.model.additive import AdditiveModel
from shapespace.types import FloatArray, IntArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "studies"))
from simulated import SETTINGS, StudyConfig, faces_of_ict, run_jobs
from study_fits import STATUSES, model_path
from study_people import StudyPeople


@dataclass(frozen=True)
class Condition:
    """One thing that is harder, and which of a person's faces are scanned so.

    Args:
        change: fields of `StudyPeople` and their values.
        neutral: whether the neutral face is scanned too.
        expressions: how many of the study's.
        number: of its random numbers.
    """

    change: Mapping[str, Any]
    neutral: bool
    expressions: int
    number: int

    def shown(self, people: StudyPeople, person: int) -> list[int]:
        """Return which of `StudyPeople.shown` a person shows."""
        levels = len(people.levels)
        chosen = [
            1 + (k % len(people.expressions)) * levels + (person + k) % levels
            for k in range(person, person + min(self.expressions, len(people.expressions)))
        ]
        return [*([0] if self.neutral else []), *sorted(chosen)]


CONDITIONS: Mapping[str, Condition] = MappingProxyType(
    {
        "40 % missing": Condition({"missing": 0.4}, True, 6, 1),
        "noise 1.5 mm": Condition({"noise_mm": 1.5}, False, 2, 2),
        "1,500 triangles": Condition({"triangles": 1_500}, False, 2, 3),
    }
)


@dataclass(frozen=True, eq=False)
class HardFits:
    """The fits of one condition; rows as `StudyPeople.shown` of each person.

    Args:
        z: (N, K) coefficients in standard deviations of the model of the person's fold; K is that of the largest.
        z_stddev: (N, K) theirs.
        a_stddev: (N, Ka) standard deviations of identity by the whole covariance of z; NaN beyond a model's modes.
        status: (N,) index of `STATUSES`.
        person: (N,) who is scanned.
        shown: (N,) what they show.
    """

    z: FloatArray
    z_stddev: FloatArray
    a_stddev: FloatArray
    status: IntArray
    person: IntArray
    shown: IntArray


def study_config(folder: Path) -> StudyConfig:
    """Return the settings of the study in `folder`, whatever version made it."""
    held = json.loads(read_bytes(folder / "study.json"))["settings"]
    people = held.pop("people")
    tuples = {key: tuple(value) if isinstance(value, list) else value for key, value in people.items()}
    return StudyConfig(StudyPeople(**tuples), **held | {"stranger_levels": tuple(held["stranger_levels"])})


def fits_path(folder: Path, condition: str, person: int) -> Path:
    """Return the file of a person's fits under a condition."""
    called = "".join(letter if letter.isalnum() else "_" for letter in condition)
    return folder / called / f"person_{person:03d}.npz"


def fit_harder(study: Path, output: Path, config: StudyConfig, conditions: Sequence[str], *, workers: int) -> None:
    """Fit the scans of `conditions` into `output`, leaving out what is there already."""
    people = range(config.people.people)
    run_jobs(
        [
            (name, [(_fit_person, (study, output, config, name, person)) for person in people],
             [fits_path(output, name, person) for person in people])
            for name in conditions
        ],
        workers=workers,
        on_progress=lambda what, done, total: print(f"{what}: {done} of {total} people", file=sys.stderr, flush=True),
    )  # fmt: skip


def read_harder(output: Path, config: StudyConfig, condition: str) -> HardFits:
    """Return the fits of a condition, of the people who were fitted."""
    parts: list[dict[str, Any]] = []
    for person in people_there(output, config, condition):
        with np.load(io.BytesIO(read_bytes(fits_path(output, condition, person))), allow_pickle=False) as held:
            parts.append({name: held[name] for name in held.files} | {"person": person})
    joined: dict[str, FloatArray] = {}
    for key, rest in (("z", 0.0), ("z_stddev", 1.0), ("a_stddev", np.nan)):
        most = max(part[key].shape[1] for part in parts)
        pad = [
            np.pad(part[key], ((0, 0), (0, most - part[key].shape[1])), constant_values=rest).astype(np.float64)
            for part in parts
        ]
        joined[key] = np.concatenate(pad)
    return HardFits(
        **joined,
        status=np.concatenate([part["status"] for part in parts]),
        person=np.concatenate([np.full(len(part["z"]), part["person"], dtype=np.int32) for part in parts]),
        shown=np.concatenate([part["shown"] for part in parts]),
    )


def people_there(output: Path, config: StudyConfig, condition: str) -> list[int]:
    """Return the people whose fits of a condition are there."""
    return [person for person in range(config.people.people) if fits_path(output, condition, person).is_file()]


@cache
def _model(path: Path) -> AdditiveModel:
    return AdditiveModel.load(path)


def _fit_person(study: Path, output: Path, config: StudyConfig, name: str, person: int) -> None:
    condition = CONDITIONS[name]
    people = replace(config.people, **condition.change)
    model = _model(model_path(study, int(config.fold_of()[person])))
    faces, shown = people.faces(faces_of_ict(), person), condition.shown(people, person)
    n, k = len(shown), model.shape.n_modes
    z, stddev = np.full((n, k), np.nan), np.full((n, k), np.nan)
    a_stddev = np.full((n, model.n_identity), np.nan)
    status = np.full(n, STATUSES.index("failed"), dtype=np.int32)
    of_identity = model.rotation[: model.n_identity]
    for row, which in enumerate(shown):
        rng = np.random.default_rng((people.seed, 8, condition.number, person, which))
        scan = people.raw_scan(faces[which], rng, people.name(person, which))
        try:
            fitted = fit_scan(model.shape, scan.scan, FitConfig(SETTINGS, unit="mm"))
        except ShapespaceError:
            continue  # it stays "failed", and is counted as such
        z[row], stddev[row] = fitted.z, fitted.b_stddev / model.shape.stddev
        status[row] = STATUSES.index(fitted.status)
        assert fitted.z_covariance is not None
        a_stddev[row] = np.sqrt(np.einsum("ij,jk,ik->i", of_identity, fitted.z_covariance, of_identity))
    memory = io.BytesIO()
    np.savez(
        memory,
        z=z.astype(np.float32),
        z_stddev=stddev.astype(np.float32),
        a_stddev=a_stddev.astype(np.float32),
        status=status,
        shown=np.array(shown, dtype=np.int32),
    )
    path = fits_path(output, name, person)
    make_folder(path.parent)
    write_bytes(path, memory.getvalue())
