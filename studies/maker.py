"""What the tables of the simulated study share: what was measured, folds of it, and rows of tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

import approaches
from approaches import Features, Rows
from shapespace.datasets.ict import IctFaces, load_ict
from shapespace.model.additive import AdditiveModel
from shapespace.recognise import evaluate
from shapespace.schemas import Part, Target
from shapespace.study import parts
from shapespace.types import BoolArray, FloatArray, IntArray
from simulated import StudyConfig
from study_fits import Fits, model_path, person_path, read_fits

OnPart = Callable[[str], None]
TextArray = npt.NDArray[np.str_]

HIGH = 0.75


@dataclass(frozen=True, eq=False)
class Study:
    """Everything that the tables are made of.

    Args:
        folder: of the study.
        config: its settings.
        models: one a fold.
        fits: of all scans.
        ict: the face model, for the true unit weights.
    """

    folder: Path
    config: StudyConfig
    models: tuple[AdditiveModel, ...]
    fits: Fits
    ict: IctFaces

    @classmethod
    def read(cls, folder: Path, config: StudyConfig) -> Study:
        """Read what `run_fits` wrote.

        Raises:
            FileError: a file cannot be read.
            FileFormatError: a file is damaged.
        """
        models = tuple(AdditiveModel.load(model_path(folder, fold)) for fold in range(config.folds))
        most = max(model.shape.n_modes for model in models)
        paths = [person_path(folder, person) for person in range(config.people.people)]
        return cls(folder, config, models, read_fits(paths, most), load_ict())

    @cached_property
    def expression(self) -> TextArray:
        """(N,) what each scan shows."""
        return np.array([name for name, _ in self.config.people.shown], dtype=np.str_)[self.fits.shown]

    @cached_property
    def level(self) -> FloatArray:
        """(N,) at which intensity."""
        return np.array([level for _, level in self.config.people.shown])[self.fits.shown]

    @cached_property
    def subject(self) -> TextArray:
        """(N,) who."""
        return np.array([self.config.people.subject(int(p)) for p in self.fits.person], dtype=np.str_)

    @cached_property
    def fold(self) -> IntArray:
        """(N,) where each scan is tested."""
        return self.config.fold_of()[self.fits.person]

    @cached_property
    def place(self) -> IntArray:
        """(N,) place among the taught scans of the person, or -1."""
        return np.concatenate([self.config.taught(person) for person in range(self.config.people.people)])

    def rows(self, fold: int, chosen: BoolArray) -> Rows:
        """Return the fits of `chosen` scans by the model of `fold`; those that failed are NaN."""
        k, e = self.models[fold].shape.n_modes, self.models[fold].n_expression
        shown = np.where(self.place >= 0, self.place, self.fits.shown)
        return Rows(
            self.fits.z[fold][chosen][:, :k],
            self.fits.z_stddev[fold][chosen][:, :k],
            self.expression[chosen],
            shown[chosen],
            self.subject[chosen],
            self.fits.e_beside[fold][chosen][:, :e],
            self.fits.e_together[fold][chosen][:, :e],
        )

    def training(self, fold: int) -> Rows:
        """Return the taught scans of everybody who is not tested in `fold`, without those that failed."""
        rows = self.rows(fold, (self.fold != fold) & (self.place >= 0))
        return rows.where(rows.usable)

    def tested(self, fold: int) -> BoolArray:
        """Return (N,) which scans are tested in `fold`: expressive ones of its people."""
        return (self.fold == fold) & (self.level > 0)

    def neutral(self, fold: int) -> Rows:
        """Return everybody's neutral scans by the model of `fold`."""
        return self.rows(fold, self.fits.shown == 0)


class Maker:
    """The parts made so far, the targets that they answer, and folds of the fits."""

    def __init__(self, study: Study, on_part: OnPart) -> None:
        self.study = study
        self.on_part = on_part
        self.targets: list[Target] = []
        self.parts: list[Part] = []
        self.features: dict[str, list[Features]] = {}
        self.true_weights: TextArray = np.zeros(0, dtype=np.str_)
        tested = study.level > 0
        self.labels = study.expression[tested]
        self.subjects = study.subject[tested]
        self.level = study.level[tested]
        self.high = self.level >= HIGH
        self.classes = tuple(sorted(set(self.labels.tolist())))
        self.index = np.full(len(tested), -1)
        self.index[tested] = np.arange(int(tested.sum()))

    def additive_folds(self, how: str) -> list[evaluate.Fold]:
        """Return the additive model's expressions: of one scan, beside the neutral scan, or of all a person's scans."""
        readers: dict[str, Callable[[int], Features]] = {
            "unknown": lambda f: self.features["additive"][f],
            "known": lambda f: lambda rows: rows.e_beside,
            "together": lambda f: lambda rows: rows.e_together,
            "mean": lambda f: lambda rows: approaches.about_own_mean(self.study.models[f], rows),
        }
        return [self.learned_fold(readers[how](f), f, relative=False) for f in range(self.study.config.folds)]

    def learned_fold(self, features: Features, fold: int, *, relative: bool) -> evaluate.Fold:
        """Return the taught and the tested scans of `fold` as features; relative: to each person's neutral scan."""
        study = self.study
        training, tested = study.training(fold), study.tested(fold)
        faces = study.rows(fold, tested)
        usable = faces.usable
        found = features(faces.where(usable))
        known = np.full((len(usable), found.shape[1]), np.nan)
        known[usable] = found
        if relative:
            neutral = study.rows(fold, (study.fold == fold) & (study.fits.shown == 0))
            neutral = neutral.where(neutral.usable)
            at_rest = neutral_of(features(neutral), neutral.subject, neutral.shown == 0, faces.subject)
            known = known - at_rest
            learned = features(training)
            learned = learned - neutral_of(learned, training.subject, training.shown == 0, training.subject)
            learned, taught = learned[training.shown != 0], training.expressive
        else:
            taught = training.expressive
            learned = features(taught)
        kept = np.isfinite(learned).all(axis=1)
        return evaluate.Fold(
            learned[kept], taught.expression[kept].tolist(), taught.subject[kept].tolist(),
            known, faces.expression.tolist(), faces.subject.tolist(), self.index[tested],
        )  # fmt: skip

    def fold_of(self, codes: FloatArray, fold: int) -> evaluate.Fold:
        """Return codes (N, K) of all expressive scans, parted into those tested in `fold` and the others."""
        study, tested = self.study, self.study.tested(fold)
        others = (study.fold != fold) & (study.level > 0)
        return evaluate.Fold(
            codes[others], study.expression[others].tolist(), study.subject[others].tolist(),
            codes[tested], study.expression[tested].tolist(), study.subject[tested].tolist(), self.index[tested],
        )  # fmt: skip

    def row(self, name: str, predicted: Sequence[str], neutral: str) -> tuple[object, ...]:
        """Return a row of a table: name, neutral, accuracy of the two highest levels, of all, its interval, lowest."""
        every, interval = parts.accuracy_of(self.labels, predicted, self.subjects)
        high, _ = parts.accuracy_of(self.labels, predicted, self.subjects, self.high)
        low, _ = parts.accuracy_of(self.labels, predicted, self.subjects, self.level == self.level.min())
        return name, neutral, high, every, interval, low

    def accuracy_of(self, code: Callable[[int, Rows], FloatArray]) -> float:
        """Return the accuracy of LDA on a code of each fold's scans."""
        folds = [
            self.learned_fold(lambda rows, f=f: code(f, rows), f, relative=False)
            for f in range(self.study.config.folds)
        ]
        return parts.accuracy_of(self.labels, evaluate.fixed_predictions(folds, "lda").predicted, self.subjects)[0]


def neutral_of(codes: FloatArray, subjects: TextArray, neutral: BoolArray, wanted: TextArray) -> FloatArray:
    """Return (n, K) the neutral code of each `wanted` person; NaN where there is none."""
    at_rest = dict(zip(subjects[neutral].tolist(), codes[neutral], strict=True))
    none = np.full(codes.shape[1], np.nan)
    return np.stack([at_rest.get(str(name), none) for name in wanted])
