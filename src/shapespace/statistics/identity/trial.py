"""Roles of scans in a trial: enrolled, searched for, and training; no person is both tested and used for training."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import Table, list_names
from shapespace.errors import InputError
from shapespace.reprs import short_repr
from shapespace.statistics.identity.rates import Pairs
from shapespace.statistics.identity.scores import SCORES, check_score_names, samples_of
from shapespace.types import BoolArray, FloatArray, IntArray

ROLES = ("gallery", "probe", "train")
_FOLDS, _GROUPS = 4, 5  # folds of people, and groups for the calibration


@dataclass(frozen=True, kw_only=True)
class IdentityConfig:
    """Roles of scans, and options of the comparison.

    Args:
        subject: column of the subjects.
        gallery: scans to enrol, such as `expression=neutral` or `session!=2,3` (default: verify compares all scans with
            all, identify enrols the first scan of each subject).
        probe: scans to compare with the gallery (default: all that are neither enrolled nor used for training).
        train: training scans (default: the scans of the subjects in the other folds).
        role: column with `gallery`, `probe` or `train` for each scan, instead of the expressions (default: role, if the
            table has it).
        folds: number of folds of subjects; each is tested with scores trained on the others (default: 4, fewer for
            fewer than 8 subjects).
        scores: scores among `plda`, `cosine`, `mahalanobis` and `distance`; the summary reports the first (default:
            all).
        modes: number of leading coefficients of identity to use (default: all).
        curve: numbers of modes for which the equal error rate is also computed.
        by: column of the table; results are also reported for each of its values, from pairs whose probe has this value
            (without a gallery: one of whose scans has it).
        uncertainty: whether the PLDA score uses the estimated error of each fit.
        draws: number of bootstrap samples of subjects, from which intervals are computed.
        seed: seed of folds and bootstrap samples.
        drop_missing: exclude shapes with missing values in the table (default: an error).
    """

    subject: str = "subject"
    gallery: str | None = None
    probe: str | None = None
    train: str | None = None
    role: str | None = None
    folds: int | None = None
    scores: tuple[str, ...] = tuple(SCORES)
    modes: int | None = None
    curve: tuple[int, ...] = ()
    by: str | None = None
    uncertainty: bool = True
    draws: int = 1000
    seed: int = 0
    drop_missing: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "scores", tuple(self.scores))


@dataclass(frozen=True)
class Round:
    """Row numbers in a cohort: the training scans, and the gallery and probe scans of other people."""

    training: tuple[int, ...]
    gallery: tuple[int, ...]
    probes: tuple[int, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class Trial:
    """A cohort ready to be compared.

    Args:
        cohort: scans without missing values in the used columns.
        people: names of all people.
        person: (N,) number of the person that each scan shows.
        rounds: compared rounds; the training people of a round are not in its gallery and probes.
        group: (P,) group of each person, for calibration on people of other groups.
        all_pairs: whether there is no gallery, and each scan is compared with each other.
        notes: remarks for the user.
    """

    cohort: Cohort
    people: tuple[str, ...]
    person: IntArray
    rounds: tuple[Round, ...]
    group: IntArray
    all_pairs: bool
    notes: tuple[str, ...]

    __repr__ = short_repr

    @cached_property
    def subjects(self) -> tuple[str, ...]:
        """(N,) name of the person that each scan shows."""
        return tuple(self.people[int(k)] for k in self.person)

    @property
    def tested(self) -> BoolArray:
        """(P,) whether each person is compared."""
        out = np.zeros(len(self.people), dtype=np.bool_)
        for round_ in self.rounds:
            out[self.person[[*round_.gallery, *round_.probes]]] = True
        return out

    def pairs(self, round_: Round) -> tuple[Pairs, IntArray]:
        """Return the pairs of a round, and (M, 2) the places of each in gallery and probes."""
        gallery, probes = (np.asarray(rows, dtype=np.int32) for rows in (round_.gallery, round_.probes))
        indices = np.indices((len(gallery), len(probes)), dtype=np.int32).reshape(2, -1).T
        if self.all_pairs:
            indices = indices[indices[:, 0] < indices[:, 1]]
        rows = np.column_stack([gallery[indices[:, 0]], probes[indices[:, 1]]])
        return Pairs(self.person[rows[:, 0]], self.person[rows[:, 1]], rows), indices


def rows_of(table: Table, expression: str) -> list[int]:
    """Return the rows of a table that an expression such as `expression=neutral` names.

    Raises:
        InputError: the expression is invalid, there is no such column, or it names no row.
    """
    column, sign, text = _parts_of(expression)
    values = {value.strip() for value in text.split(",")}
    cells = table.texts(column)
    rows = [row for row, cell in enumerate(cells) if (cell in values) == (sign == "=")]
    if not rows:
        there = list_names(sorted(set(cells) - {""}))
        raise InputError(f"{table.where}: no scan has {expression}; {column} is {there or 'empty'}.")
    return rows


def _parts_of(expression: str) -> tuple[str, str, str]:
    """Return the column, the sign and the values of an expression that names rows."""
    match = re.fullmatch(r"\s*([^=!]+?)\s*(!?=)\s*(.+?)\s*", expression)
    if match is None:
        raise InputError(f"{expression!r} names no scans; write a column and its values, such as expression=neutral.")
    return match[1].strip("`"), match[2], match[3]


def trial_of(cohort: Cohort, config: IdentityConfig, *, enrol: bool = False) -> Trial:
    """Return the roles of scans, and the rounds of the comparison.

    Args:
        cohort: cohort of the scans.
        config: roles of the scans.
        enrol: whether there must be a gallery; if none is named, it is the first scan of each person.

    Raises:
        InputError: columns or scores that do not exist, people who are both tested and used for training, or too few
            people.
    """
    check_score_names(config.scores)
    role = config.role
    if role is None and "role" in cohort.table.columns and not (config.gallery or config.probe or config.train):
        role = "role"
    expressions = () if role else (config.train, config.gallery, config.probe)
    named = [_parts_of(expression)[0] for expression in expressions if expression]
    used = list(dict.fromkeys(column for column in (config.subject, role, config.by, *named) if column))
    cohort = cohort.complete(used, drop_missing=config.drop_missing)
    table, notes = cohort.table, list(cohort.notes)
    subjects = table.texts(config.subject)
    people = sorted(set(subjects))
    number = {name: k for k, name in enumerate(people)}
    person = np.array([number[name] for name in subjects], dtype=np.int32)
    gallery, probes, training = _roles(table, role, config)
    tested = sorted({*gallery, *probes})
    both = sorted({subjects[row] for row in tested} & {subjects[row] for row in training})
    if both:
        raise InputError(
            f"{table.where}: {list_names(both)} {'is' if len(both) == 1 else 'are'} both tested and learned from; use "
            "all scans of a subject for only one of the two."
        )
    if enrol and not gallery:
        first = {int(person[row]): row for row in reversed(probes)}
        gallery, chosen = sorted(first.values()), set(first.values())
        probes = [row for row in probes if row not in chosen]
        notes.append("No gallery was named, so the first scan of each subject is enrolled and the others are probes.")
    all_pairs = not gallery
    if all_pairs:
        gallery = probes
    group, rounds = _rounds(person, len(people), gallery, probes, training, config)
    trial = Trial(
        cohort=cohort,
        people=tuple(people),
        person=person,
        rounds=rounds,
        group=group,
        all_pairs=all_pairs,
        notes=tuple(notes),
    )
    _check_enough_scans(trial, table)
    return trial


def scores_of(
    trial: Trial, config: IdentityConfig, modes: int | None
) -> Iterator[tuple[Round, Mapping[str, FloatArray]]]:
    """Yield each round with the (G, P) scores of its gallery and probes by name.

    Raises:
        InputError: too few training people, or too many modes.
    """
    for round_ in trial.rounds:
        samples = samples_of(trial.cohort, trial.subjects, round_.training, uncertainty=config.uncertainty)
        samples = samples.leading(modes)
        training, gallery, probes = (samples.take(rows) for rows in (round_.training, round_.gallery, round_.probes))
        yield round_, {name: SCORES[name](training)(gallery, probes) for name in config.scores}


def _roles(table: Table, role: str | None, config: IdentityConfig) -> tuple[list[int], list[int], list[int]]:
    """Return the rows of gallery, probes and training; no gallery for all against all."""
    if role is not None:
        cells = [cell.lower() for cell in table.texts(role)]
        odd = sorted({cell for cell in cells if cell not in ROLES})
        if odd:
            raise InputError(f"{table.where}: {role!r} is {list_names(odd)}; it may be gallery, probe or train.")
        gallery, probes, training = ([row for row, cell in enumerate(cells) if cell == wanted] for wanted in ROLES)
        if gallery and not probes:
            raise InputError(f"{table.where}: {role!r} names a gallery and no probe.")
        return gallery, probes, training
    training = rows_of(table, config.train) if config.train else []
    gallery = [row for row in rows_of(table, config.gallery) if row not in set(training)] if config.gallery else []
    if config.probe and not gallery:
        raise InputError("Probes need a gallery; name it with --gallery.")
    taken = {*training, *gallery}
    probes = rows_of(table, config.probe) if config.probe else range(len(table))
    return gallery, [row for row in probes if row not in taken], training


def _rounds(
    person: IntArray,
    people: int,
    gallery: Sequence[int],
    probes: Sequence[int],
    training: Sequence[int],
    config: IdentityConfig,
) -> tuple[IntArray, tuple[Round, ...]]:
    """Return the group of each person, and the rounds."""
    if not gallery:
        raise InputError("No subject is left to test; train on fewer subjects.")
    tested = np.unique(person[[*gallery, *probes]])
    if training:
        parts = max(min(_GROUPS, len(tested) // 2), 1)
    else:
        parts = config.folds or max(min(_FOLDS, len(tested) // 2), 1)
        if config.folds and not 2 <= config.folds <= len(tested) // 2:
            raise InputError(
                f"{len(tested)} subjects cannot be split into {config.folds} folds; each needs two subjects, and two "
                "folds are the least."
            )
        if parts < 2:
            raise InputError(
                f"There are {len(tested)} subjects, but at least four are needed: two for training and two for testing."
            )
    order = np.random.default_rng((config.seed, 3)).permutation(len(tested))
    group = np.zeros(people, dtype=np.int32)
    group[tested[order]] = np.arange(len(tested)) % parts
    if training:
        return group, (Round(tuple(training), tuple(gallery), tuple(probes)),)
    rounds: list[Round] = []
    for fold in range(parts):
        own_gallery, own_probes = (tuple(r for r in rows if group[person[r]] == fold) for rows in (gallery, probes))
        others = tuple(sorted({r for r in (*gallery, *probes) if group[person[r]] != fold}))
        rounds.append(Round(others, own_gallery, own_probes))
    return group, tuple(rounds)


def _check_enough_scans(trial: Trial, table: Table) -> None:
    tested = int(trial.tested.sum())
    if tested < 2:
        raise InputError(f"{table.where}: {tested} subject is compared, but at least two are needed.")
    if not any(trial.pairs(round_)[0].same.any() for round_ in trial.rounds):
        raise InputError(
            f"{table.where}: no two of the compared scans are of one subject; add repeated scans of subjects."
        )
