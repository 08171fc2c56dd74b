"""Tables of the simulated study on people: whose face it is, faces of another generator, expressions put on others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import approaches
from approaches import Rows
from maker import HIGH, Maker, TextArray, neutral_of
from shapespace.io.files import make_folder
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.model.additive import AdditiveModel
from shapespace.recognise import evaluate
from shapespace.schemas import MeshesPart, Part, RowOfMeshes, Still
from shapespace.study import parts
from shapespace.study.parts import target, words
from shapespace.types import FloatArray
from simulated import PAPER_EXPRESSIONS, stranger_shown
from study_fits import STATUSES, read_fits, stranger_path

_STRANGERS_LEAST = 0.85
_RANK_1_LEAST = 0.95


def identity(maker: Maker) -> None:
    """Recognise people from expressive scans, and measure how far identity and expression are apart."""
    study, config = maker.study, maker.study.config
    rows: list[tuple[object, ...]] = []
    codes: dict[str, Callable[[int, Rows], FloatArray]] = {
        "additive model, a": lambda f, r: study.models[f].split(r.z)[0],
        "one PCA (the paper), b": lambda f, r: maker.features["one PCA (the paper)"][f](r),
        "additive model, e (should be chance)": lambda f, r: study.models[f].split(r.z)[1],
    }
    reached = float("nan")
    for name, code in codes.items():
        hits: list[FloatArray] = []
        for fold in range(config.folds):
            gallery = study.neutral(fold)
            enrolled = _unit(code(fold, gallery.where(gallery.usable)))
            names = gallery.subject[gallery.usable]
            probes = study.rows(fold, study.tested(fold))
            usable = probes.usable
            nearest = (_unit(code(fold, probes.where(usable))) @ enrolled.T).argmax(axis=1)
            hit = np.zeros(len(usable))
            hit[usable] = names[nearest] == probes.subject[usable]
            hits.append(hit)
        level = np.concatenate([study.level[study.tested(fold)] for fold in range(config.folds)])
        all_hits = np.concatenate(hits)
        rows.append((name, float(all_hits.mean()), float(all_hits[level >= HIGH].mean())))
        if name.endswith(" a"):
            reached = float(all_hits.mean())
    together = tied(maker)
    rows.append(("additive model, a of all a person's expressive scans together", together, None))
    people = config.people.people
    maker.targets.append(
        target(f"Identity, rank 1 of {people} enrolled neutral faces, from expressive scans",
               f"at least {words(_RANK_1_LEAST)}", words(reached), met=reached >= _RANK_1_LEAST,
               note=f"from all scans of a person together {words(together)}")
    )  # fmt: skip
    maker.parts += [
        parts.table(
            "Whose face it is, from expressive scans",
            [("Code, nearest by cosine", "text"), ("All four intensities", "percent"), ("Two highest", "percent")],
            rows,
            f"Rank 1 among the neutral faces of all {people} people; chance is {words(1 / people)}. Whoever is "
            "looked for was not in the shape model.",
        ),
        apart(maker),
    ]


def tied(maker: Maker) -> float:
    """Return the rank-1 rate with one identity for all of a person's expressive scans."""
    study, hits = maker.study, list[bool]()
    for fold in range(study.config.folds):
        model, gallery = study.models[fold], study.neutral(fold)
        finite = gallery.usable
        enrolled, names = _unit(model.split(gallery.z[finite])[0]), gallery.subject[finite]
        for person in np.flatnonzero(study.config.fold_of() == fold):
            a = study.fits.a_together[fold, person, : model.n_identity]
            name = study.config.people.subject(int(person))
            hits.append(bool(np.isfinite(a).all() and names[(enrolled @ (a / np.linalg.norm(a))).argmax()] == name))
    return float(np.mean(hits))


def apart(maker: Maker) -> Part:
    """Measure disentanglement: what should be chance, and the spread of neutralised faces."""
    study, config = maker.study, maker.study.config
    from_a = maker.accuracy_of(lambda f, r: study.models[f].split(r.z)[0])
    spread_a: list[float] = []
    spread_e: list[float] = []
    between: list[float] = []
    for fold in range(config.folds):
        model = study.models[fold]
        chosen = study.fold == fold
        faces = study.rows(fold, chosen)
        usable = faces.usable
        faces, level = faces.where(usable), study.level[chosen][usable]
        a, e = model.split(faces.z)
        for name in np.unique(faces.subject):
            spread_a.append(_spread_mm(model, a[faces.subject == name], identity=True))
        for name in config.people.expressions:
            same = (faces.expression == name) & (level == max(config.people.levels))
            spread_e.append(_spread_mm(model, e[same], identity=False))
        between.append(_spread_mm(model, a[faces.expression == "neutral"], identity=True))
    return parts.table(
        "How far identity and expression are apart",
        [("Measure", "text"), ("Value", "text"), ("Should be", "text")],
        [
            ("Expression from identity a", words(from_a), f"chance, {words(1 / len(maker.classes))}"),
            ("Spread of one person's faces made neutral (e = 0)", f"{np.mean(spread_a):.2f} mm", "0 mm"),
            ("Spread of neutral faces between people, the same measure", f"{np.mean(between):.2f} mm", "large"),
            ("Spread of one expression at its strongest put on the mean (a = 0)", f"{np.mean(spread_e):.2f} mm",
             "as much as people make it differently"),
        ],
        "Spread is the standard deviation of each vertex, averaged over the surface.",
    )  # fmt: skip


def strangers(maker: Maker) -> dict[str, float]:
    """Classify faces of the bundled generator by what was learned on ICT-FaceKit; return how well."""
    study, config = maker.study, maker.study.config
    model = study.models[0]
    paths = [stranger_path(study.folder, person) for person in range(config.strangers)]
    fits = read_fits(paths, study.fits.z.shape[2])
    z, stddev = (of[0][:, : model.shape.n_modes] for of in (fits.z, fits.z_stddev))
    shows = np.array([name for name, _ in stranger_shown(config)])[fits.shown]
    subject = np.array([f"stranger_{int(person):03d}" for person in fits.person])
    new, training = Rows(z, stddev, shows, fits.shown, subject), study.training(0)
    four = training.where(np.isin(training.expression, ("neutral", *PAPER_EXPRESSIONS)))
    labels, whose = new.expressive.expression, new.expressive.subject
    rows: list[tuple[object, ...]] = []
    answers: dict[str, TextArray] = {}
    reached: dict[str, float] = {}
    for how, fold in _folds_of_strangers(model, four, new).items():
        nested = evaluate.nested_predictions([fold], modes=(10, None), inner_folds=parts.inner_folds([fold]))
        answers[how] = np.asarray(nested.predicted)
        reached[how], interval = parts.accuracy_of(labels, answers[how], whose)
        chosen = f"chosen inside the training people ({nested.chosen[0].classifier})"
        rows.append((how, chosen, reached[how], interval))
        for classifier in ("lda", "mean-direction", "logistic"):
            fixed = parts.fixed([fold], classifier)
            if fixed is not None:
                rows.append((how, classifier, *parts.accuracy_of(labels, fixed.predicted, whose)))
    doubtful = int((fits.status[0] == STATUSES.index("doubtful")).sum())
    maker.targets += [
        target(f"ICT-trained system on faces of another generator and topology, four expressions, {how}",
               f"at least {words(_STRANGERS_LEAST)}", words(reached[how]), met=reached[how] >= _STRANGERS_LEAST,
               note=note)
        for how, note in (
            ("as it stands", "each scan relative to the person's neutral scan"),
            ("about each person's own mean", "relative to the mean of the person's scans, without their labels"),
            ("adapted", "as it stands, then centred and scaled over all new scans, without their labels"),
        )
    ]  # fmt: skip
    maker.parts += [
        parts.table(
            "Trained on ICT-FaceKit, tested on the bundled generator",
            [("Coefficients", "text"), ("Classifier", "text"), ("Macro accuracy", "percent"),
             ("95 % over people", "interval")],
            rows,
            f"{config.strangers} people of another generator, with triangles and expressions of its own. "
            "As it stands, expression is solved for beside each person's neutral scan. About their own mean, it is "
            "relative to all scans of the person, which takes no label, but a balanced set. Adapted: every "
            "coefficient is centred and scaled over the new scans as it was over the training ones. "
            f"{doubtful} of {len(z)} fits are called doubtful, since no such face was in the model.",
        ),
        *(
            parts.confusion(f"Another generator, {how}", labels.tolist(), answers[how].tolist(),
                            PAPER_EXPRESSIONS, "The classifier chosen inside the training people.")
            for how in answers
        ),
    ]  # fmt: skip
    return reached


def _folds_of_strangers(model: AdditiveModel, four: Rows, new: Rows) -> dict[str, evaluate.Fold]:
    """Return folds that learn from `four` expressions and test `new` faces, by what codes are relative to."""
    at_rest = neutral_of(four.z, four.subject, four.shown == 0, four.subject)
    learned = approaches.beside_neutral(model, four, at_rest)
    taught = (four.shown != 0) & np.isfinite(learned).all(axis=1)
    X = learned[taught]
    beside = approaches.beside_neutral(model, new, neutral_of(new.z, new.subject, new.shown == 0, new.subject))
    known, tested = beside[new.shown != 0], new.expressive
    usable = np.isfinite(known).all(axis=1)
    centre, spread = known[usable].mean(axis=0), known[usable].std(axis=0)
    about_mean = np.full(known.shape, np.nan)
    about_mean[tested.usable] = approaches.about_own_mean(model, tested.where(tested.usable))
    names, by = four.expression[taught].tolist(), four.subject[taught].tolist()
    return {
        how: evaluate.Fold(training, names, by, codes, tested.expression.tolist(), tested.subject.tolist())
        for how, training, codes in (
            ("as it stands", X, known),
            ("about each person's own mean", approaches.about_own_mean(model, four.where(taught)), about_mean),
            ("adapted", X, (known - centre) / spread * X.std(axis=0) + X.mean(axis=0)),
        )
    }


def transfer(maker: Maker) -> None:
    """Put expressions of one person on another, from fits alone."""
    study = maker.study
    model = study.models[0]
    faces = study.rows(0, study.fold == 0)
    level = study.level[study.fold == 0]
    usable = faces.usable
    names = np.unique(faces.subject[usable])[:3]
    folder = make_folder(study.folder / "transfer")
    rows: list[RowOfMeshes] = []
    source = str(names[0])
    for expression in ("smile", "surprise"):
        meshes: list[Still] = []
        taken = (faces.subject == source) & (faces.expression == expression) & (level == level.max()) & usable
        if not taken.any():
            continue
        for name in names:
            own = (faces.subject == name) & (faces.expression == "neutral") & usable
            if not own.any():
                continue
            path = folder / f"{expression}_on_{name}.ply"
            write_mesh(path, model.transfer(faces.z[own][0], faces.z[taken][0]))
            meshes.append(Still(label=str(name), file=f"transfer/{path.name}"))
        rows.append(RowOfMeshes(label=f"{expression} of {source}", meshes=tuple(meshes)))
    maker.parts.append(
        MeshesPart(
            title="One person's expression put on others",
            rows=tuple(rows),
            note="From fits of raw scans: identity of one, expression of another.",
        )
    )


def _unit(codes: FloatArray) -> FloatArray:
    return codes / np.linalg.norm(codes, axis=1, keepdims=True)


def _spread_mm(model: AdditiveModel, codes: FloatArray, *, identity: bool) -> float:
    """Return the mean over the vertices of the standard deviation of surfaces with these codes alone, mm."""
    none = np.zeros(0)
    surfaces = np.stack([(model.mesh(code, none) if identity else model.mesh(none, code)).vertices for code in codes])
    return float(np.sqrt(surfaces.var(axis=0).sum(axis=1)).mean())
