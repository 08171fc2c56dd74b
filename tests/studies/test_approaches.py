"""All approaches of the study against one contract: taught by some people, they tell expressions of others apart."""

import sys
from pathlib import Path

import numpy as np
import pytest

from shapespace.model.additive import AdditiveModel
from shapespace.model.shape_model import ShapeModel
from shapespace.recognise.classifiers import ShrinkageLDA
from shapespace.recognise.hierarchy import FaceTypes

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "studies"))
import approaches
from approaches import APPROACHES, Rows

EXPRESSIONS = ("anger", "fear", "smile")
IDENTITIES, MODES = 6, 10


@pytest.fixture(scope="module")
def model() -> AdditiveModel:
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.standard_normal((120, MODES)))[0]
    shape = ShapeModel(
        mean=rng.normal(0, 50, 120), basis=basis, stddev=np.linspace(9, 2, MODES), total_variance=1000.0, n_training=60
    )
    return AdditiveModel(shape, np.linalg.qr(rng.standard_normal((MODES, MODES)))[0], IDENTITIES)


def people(model: AdditiveModel, count: int, seed: int) -> Rows:
    """Return neutral and three expressions of `count` people, each told with a little noise."""
    rng = np.random.default_rng(seed)
    shown = np.tile(np.arange(4, dtype=np.int32), count)
    a = np.repeat(1.5 * rng.standard_normal((count, IDENTITIES)), 4, axis=0)
    centres = np.zeros((4, MODES - IDENTITIES))
    centres[1:, :3] = 1.6 * np.eye(3)
    e = centres[shown] + 0.25 * rng.standard_normal((4 * count, MODES - IDENTITIES))
    z = np.concatenate([a, e], axis=1) @ model.rotation + 0.05 * rng.standard_normal((4 * count, MODES))
    return Rows(
        z, np.full(z.shape, 0.1), np.array(["neutral", *EXPRESSIONS])[shown], shown,
        np.repeat([f"{seed}-{k}" for k in range(count)], 4),
    )  # fmt: skip


@pytest.mark.parametrize("name", APPROACHES)
def test_an_approach_tells_expressions_of_unseen_people_apart(model: AdditiveModel, name: str) -> None:
    training, others = people(model, 40, 1), people(model, 25, 2)
    features = APPROACHES[name](model, training)
    learned, found = features(training.expressive), features(others.expressive)
    assert learned.shape == (120, found.shape[1]) and np.isfinite(found).all()
    right = ShrinkageLDA().fit(learned, training.expressive.expression).predict(found) == others.expressive.expression
    assert right.mean() > 0.85


@pytest.mark.parametrize("name", APPROACHES)
def test_what_one_face_gives_does_not_depend_on_the_others_that_are_asked(model: AdditiveModel, name: str) -> None:
    features = APPROACHES[name](model, people(model, 40, 1))
    others = people(model, 5, 3)
    alone = np.concatenate([features(others.where(np.arange(20) == k)) for k in range(20)])
    assert np.allclose(alone, features(others), atol=1e-6)


def test_the_additive_feature_leaves_the_person_out(model: AdditiveModel) -> None:
    others = people(model, 25, 4)
    e = APPROACHES["additive"](model, others)(others)
    b = APPROACHES["one PCA (the paper)"](model, others)(others)

    def between(x: np.ndarray) -> float:
        means = np.stack([x[others.subject == name].mean(axis=0) for name in np.unique(others.subject)])
        return float(means.var(axis=0).sum() / x.var(axis=0).sum())

    assert between(e) < 0.2 < between(b)


@pytest.mark.parametrize("soft", [False, True])
def test_the_hierarchy_answers_by_type(model: AdditiveModel, soft: bool) -> None:
    training, others = people(model, 60, 1), people(model, 20, 2)
    types = approaches.face_types(model, training, 2, 0)
    assert isinstance(types, FaceTypes) and types.count == 2
    classes, likely = approaches.by_type(model, training, others.expressive, types, soft=soft)
    assert classes == EXPRESSIONS and np.allclose(likely.sum(axis=1), 1.0)
    assert (np.array(classes)[likely.argmax(axis=1)] == others.expressive.expression).mean() > 0.85


def test_beside_a_known_neutral_face_what_it_has_of_expression_is_no_matter(model: AdditiveModel) -> None:
    faces = people(model, 6, 5)
    z_neutral = np.repeat(faces.z[faces.shown == 0], 4, axis=0)
    found = approaches.beside_neutral(model, faces, z_neutral)
    assert np.allclose(found[faces.shown == 0], 0.0)
    wanted = (faces.z - z_neutral) @ model.rotation[IDENTITIES:].T
    assert np.corrcoef(found.ravel(), wanted.ravel())[0, 1] > 0.98
    z_neutral[3] = np.nan
    assert np.isnan(approaches.beside_neutral(model, faces, z_neutral)[3]).all()
