"""Tables of the simulated study on expressions: approaches, classifiers, and where the decision lies."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence

import numpy as np

import approaches
from approaches import APPROACHES
from maker import Maker, Study
from shapespace.errors import InputError
from shapespace.io.files import write_bytes
from shapespace.model.additive import AdditiveModel
from shapespace.recognise import evaluate
from shapespace.recognise.classifiers import CLASSIFIERS
from shapespace.recognise.hierarchy import FaceTypes
from shapespace.schemas import SurfaceMapPart
from shapespace.study import parts
from shapespace.study.parts import target, words
from shapespace.types import FloatArray, IntArray

_NEAR_HIGH, _NEAR_ALL = 0.03, 0.08
_ADDITIVE_GAIN = 0.05
_OF_ALL_SCANS = {
    "together": "one identity for all scans of a person",
    "mean": "about the mean of all scans of a person",
}
_CURVE = (2, 5, 10, 20, 40, 75)


def compare(maker: Maker) -> dict[str, float]:
    """Compare all approaches, with the subject's neutral face unknown and known; return accuracy over all."""
    study, config = maker.study, maker.study.config
    rows: list[tuple[object, ...]] = []
    accuracy: dict[str, float] = {}
    for name, approach in APPROACHES.items():
        maker.on_part(name)
        learned = [approach(study.models[f], study.training(f)) for f in range(config.folds)]
        maker.features[name] = learned
        for relative in (False, True):
            if name == "additive":
                folds = maker.additive_folds("known" if relative else "unknown")
            else:
                folds = [maker.learned_fold(learned[f], f, relative=relative) for f in range(config.folds)]
            found = evaluate.fixed_predictions(folds, "lda")
            row = maker.row(name, found.predicted, "known" if relative else "unknown")
            rows.append(row)
            accuracy[f"{name}, known" if relative else name] = float(str(row[3]))
    typed, note = hierarchies(maker)
    rows[2:2] = typed
    for how, title in _OF_ALL_SCANS.items():
        found = evaluate.fixed_predictions(maker.additive_folds(how), "lda")
        rows.append(maker.row(f"additive, {title}", found.predicted, "unknown"))
    rows.append(maker.row("true unit weights (the ceiling)", tuple(maker.true_weights.tolist()), "not needed"))
    gain = accuracy["additive"] - accuracy["one PCA (the paper)"]
    known = accuracy["additive, known"] - accuracy["one PCA (the paper), known"]
    maker.targets.append(
        target("Additive model against one PCA, unseen people",
               f"at least {100 * _ADDITIVE_GAIN:.0f} points better",
               f"{100 * gain:+.1f} points", met=gain >= _ADDITIVE_GAIN,
               note=f"all intensities, same registrations and classifier; with neutral known {100 * known:+.1f}")
    )  # fmt: skip
    maker.parts.append(
        parts.table(
            "Six approaches, one classifier, the same folds",
            [
                ("Approach", "text"),
                ("Neutral face", "text"),
                ("Two highest", "percent"),
                ("All four", "percent"),
                ("95 % over people, all four", "interval"),
                ("Lowest", "percent"),
            ],
            rows,
            "Macro accuracy of shrinkage LDA on unseen people, by the same fits. With the neutral face known, "
            "codes are relative to it, and in the additive model it shares its identity. What takes all scans of a "
            "person takes no label of them; about their mean, it needs the expressions to be balanced, as they are "
            f"here. {note}",
        )
    )
    return accuracy


def hierarchies(maker: Maker) -> tuple[list[tuple[object, ...]], str]:
    """Return rows of the paper's hierarchy, hard and soft, with the number of types by BIC and with three."""
    study = maker.study
    rows: list[tuple[object, ...]] = []
    counts: list[int] = []
    for types in (None, 3):
        how = "types by BIC" if types is None else f"{types} types"
        try:
            found = [
                approaches.face_types(study.models[f], study.training(f), types, study.config.people.seed)
                for f in range(study.config.folds)
            ]
            answers = {soft: _by_type(maker, found, soft=soft) for soft in (False, True)}
        except InputError as error:
            rows += [
                (f"{word} hierarchy, {how}: {error}", "unknown", None, None, None, None) for word in ("hard", "soft")
            ]
            continue
        counts += [one.count for one in found if types is None]
        for soft, predicted in answers.items():
            rows.append(maker.row(f"{'soft' if soft else 'hard'} hierarchy, {how}", predicted, "unknown"))
    asked = " or ".join(map(str, sorted(set(counts)))) or "an unknown number of"
    return rows, (
        f"BIC asks for {asked} type(s) of face: identities of these people are drawn from one normal cloud. Three "
        "types are forced on them for the comparison, and each has fewer training faces."
    )


def _by_type(maker: Maker, types: Sequence[FaceTypes], *, soft: bool) -> tuple[str, ...]:
    study = maker.study
    predicted = np.full(len(maker.labels), "", dtype=maker.labels.dtype)
    for fold, one in enumerate(types):
        tested = study.tested(fold)
        faces = study.rows(fold, tested)
        classes, likely = approaches.by_type(
            study.models[fold], study.training(fold), faces.where(faces.usable), one, soft=soft
        )
        predicted[maker.index[np.flatnonzero(tested)[faces.usable]]] = np.asarray(classes)[likely.argmax(axis=1)]
    return tuple(predicted.tolist())


def automatic(maker: Maker, ceiling: Mapping[str, float]) -> dict[str, float]:
    """Choose classifiers by nested cross-validation on the additive model's expressions; return the accuracies."""
    best: dict[str, float] = {}
    rows: list[tuple[object, ...]] = []
    by_neutral: dict[bool, evaluate.Predictions] = {}
    for relative in (False, True):
        folds = maker.additive_folds("known" if relative else "unknown")
        maker.on_part("the classifier, by nested cross-validation")
        nested = evaluate.nested_predictions(folds, modes=(10, None), inner_folds=parts.inner_folds(folds))
        by_neutral[relative] = nested
        chosen = ", ".join(sorted({choice.classifier for choice in nested.chosen}))
        word = "known" if relative else "unknown"
        rows.append(maker.row(f"chosen by nested cross-validation ({chosen})", nested.predicted, word))
        for name in CLASSIFIERS:
            fixed = parts.fixed(folds, name)
            if fixed is None:
                rows.append((f"{name} (too few samples)", word, None, None, None, None))
            else:
                rows.append(maker.row(name, fixed.predicted, word))
    for relative, key in ((False, ""), (True, ", known")):
        found = by_neutral[relative].predicted
        best[f"all{key}"] = parts.accuracy_of(maker.labels, found, maker.subjects)[0]
        best[f"high{key}"] = parts.accuracy_of(maker.labels, found, maker.subjects, maker.high)[0]
    for key, near, what in (
        ("high", _NEAR_HIGH, "two highest intensities"),
        ("all", _NEAR_ALL, "all four intensities"),
    ):
        wanted = f"within {100 * near:.0f} points of the ceiling of {words(ceiling[key])}"
        maker.targets += [
            target(f"Six expressions, unseen people, {what}, neutral face {word}", wanted, words(reached),
                   met=reached >= ceiling[key] - near, note=note)
            for word, reached, note in (
                ("known", best[f"{key}, known"], "relative to the person's own neutral scan, no landmarks"),
                ("unknown", best[key], "from one scan alone"),
            )
        ]  # fmt: skip
    found = by_neutral[False]
    folds = maker.additive_folds("unknown")
    maker.on_part("permutations")
    test = evaluate.permutation_test(_same_rows(folds), permutations=99)
    maker.parts += [
        parts.table(
            "Classifiers on the additive model's expressions",
            [("Classifier", "text"), ("Neutral face", "text"), ("Two highest", "percent"), ("All four", "percent"),
             ("95 % over people, all four", "interval"), ("Lowest", "percent")],
            rows,
            f"Macro accuracy on unseen people. With labels shuffled within each person LDA gets "
            f"{words(float(test.null.mean()))} (p = {test.p:.3f}).",
        ),
        parts.confusion("All four intensities", maker.labels.tolist(), found.predicted, maker.classes,
                        "The additive model, classifier chosen inside the training people, neutral face unknown."),
        parts.confusion("Two highest intensities", maker.labels[maker.high].tolist(),
                        np.asarray(found.predicted)[maker.high].tolist(), maker.classes, "The same."),
        parts.per_class("Each expression, all intensities", maker.labels.tolist(), found.predicted, maker.classes),
        parts.calibration("Calibration of the probabilities", maker.labels.tolist(), found.probabilities,
                          found.classes),
        parts.learning_curve("Accuracy by number of training people", folds, _CURVE, ceiling=ceiling["all"]),
    ]  # fmt: skip
    return best


def where(maker: Maker) -> None:
    """Show which modes and which parts of the face carry the decision."""
    study = maker.study
    folds = maker.additive_folds("unknown")
    fewest = min(fold.train.shape[1] for fold in folds)
    losses = [evaluate.mode_importance([fold], modes=fewest, repeats=2)[0, :fewest] for fold in folds]
    loss = np.mean(losses, axis=0)
    model = study.models[0]
    training = study.training(0).expressive
    a, e = model.split(training.z)
    t: FloatArray = np.concatenate([np.zeros(a.shape), e], axis=1)
    basis = _basis_of_codes(model)
    decision = evaluate.decision_map(basis, np.ones(model.shape.n_modes), t, training.expression.tolist())
    shares = evaluate.region_shares(decision, _regions(study))
    faces: IntArray = model.shape.faces if model.shape.faces is not None else np.zeros((0, 3), dtype=np.int32)
    memory = io.BytesIO()
    np.savez(memory, vertices=model.shape.mean_vertices, faces=faces, decision=decision)
    write_bytes(study.folder / "recognition.npz", memory.getvalue())
    maker.parts += [
        parts.table(
            "Modes that carry the decision",
            [("Mode", "text"), ("Points of accuracy lost when the mode is shuffled", "number")],
            [(f"e{k + 1}", round(100 * float(loss[k]), 3)) for k in np.argsort(-loss)[:20]],
            "Means over the folds, whose models number their modes alike only about; the 20 largest.",
        ),
        SurfaceMapPart(
            title="Parts of the face that carry the decision", arrays="recognition.npz", values="decision",
            unit="variance between expressions over variance within", signed=False,
        ),
        parts.table(
            "Share of the decision by region",
            [("Region", "text"), ("Share", "percent")],
            [(name, shares[name]) for name in sorted(shares, key=lambda name: -shares[name])],
        ),
    ]  # fmt: skip


def _same_rows(folds: Sequence[evaluate.Fold]) -> list[evaluate.Fold]:
    """Return folds in which everybody has as many rows to be tested as to be taught from, as a shuffle needs."""
    taught: dict[str, int] = {}
    for fold in folds:
        for name in set(fold.train_subjects):
            count = list(fold.train_subjects).count(name)
            taught[name] = min(taught.get(name, count), count)
    out: list[evaluate.Fold] = []
    for fold in folds:
        train, test = (_first_rows(part, taught) for part in (fold.train_subjects, fold.test_subjects))
        out.append(
            evaluate.Fold(
                fold.train[train], [fold.train_labels[i] for i in train], [fold.train_subjects[i] for i in train],
                fold.test[test], [fold.test_labels[i] for i in test], [fold.test_subjects[i] for i in test],
            )
        )  # fmt: skip
    return out


def _first_rows(subjects: Sequence[str], counts: Mapping[str, int]) -> list[int]:
    seen: dict[str, int] = {}
    kept: list[int] = []
    for row, name in enumerate(subjects):
        seen[name] = seen.get(name, 0) + 1
        if seen[name] <= counts[name]:
            kept.append(row)
    return kept


def _basis_of_codes(model: AdditiveModel) -> FloatArray:
    """Return (V, 3, K) what one standard deviation of each of [a; e] does to each vertex, mm."""
    flat: FloatArray = model.shape.vertex_basis @ model.shape.to_b(model.rotation).T
    return flat.reshape(model.shape.n_vertices, 3, model.shape.n_modes)


def _regions(study: Study) -> dict[str, IntArray]:
    """Return parts of the face about the landmarks of the model: each vertex belongs to the nearest named part."""
    model = study.models[0].shape
    groups: dict[str, list[int]] = {}
    for name, vertex in model.landmarks.items():
        part = {"leyebrow": "brows", "reyebrow": "brows", "leye": "eyes", "reye": "eyes"}.get(
            name.rpartition("_")[0], name.rpartition("_")[0]
        )
        groups.setdefault("jaw" if part == "chin" else part, []).append(vertex)
    vertices = model.mean_vertices
    names = list(groups)
    distance = np.stack(
        [np.min(np.linalg.norm(vertices[:, None] - vertices[groups[name]], axis=2), axis=1) for name in names]
    )
    nearest, near = distance.argmin(axis=0), distance.min(axis=0) < 25.0
    found = {name: np.flatnonzero((nearest == k) & near).astype(np.int32) for k, name in enumerate(names)}
    return found | {"elsewhere": np.flatnonzero(~near).astype(np.int32)}
