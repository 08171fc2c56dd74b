"""Face types and an expression model for each: found where they are, and no better than one where they are not."""

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.recognise.classifiers import ShrinkageLDA
from shapespace.recognise.hierarchy import ExpressionByType, FaceTypes


def people(types: int, each: int = 40, apart: float = 6.0) -> np.ndarray:
    rng = np.random.default_rng(types)
    centres = apart * np.eye(types, 5)
    return np.concatenate([c + rng.standard_normal((each, 5)) for c in centres])


@pytest.mark.parametrize("types", [1, 2, 3])
def test_bic_asks_for_as_many_types_as_there_are(types: int) -> None:
    found = FaceTypes.fit(people(types))
    assert found.count == types and int(np.argmin(found.bic)) + 1 == types


def test_everybody_belongs_to_the_types_in_shares_that_add_up() -> None:
    a = people(3)
    posterior = FaceTypes.fit(a).posterior(a)
    assert np.allclose(posterior.sum(axis=1), 1.0)
    own = posterior.argmax(axis=1)
    assert all(len(set(own[40 * k : 40 * k + 40])) == 1 for k in range(3)) and len(set(own)) == 3


def contrary() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two types of face that show the same two expressions the opposite way."""
    rng = np.random.default_rng(9)
    a = np.repeat(people(2, each=60), 2, axis=0)
    labels = np.array(["down", "up"])[np.tile([0, 1], 120)]
    sign = np.where(labels == "up", 1.0, -1.0) * np.repeat([1.0, -1.0], 120)
    e = np.stack([2.0 * sign, np.zeros(240)], axis=1) + 0.5 * rng.standard_normal((240, 2))
    return a, e, labels


@pytest.mark.parametrize("soft", [False, True])
def test_types_that_show_it_the_opposite_way_need_a_model_each(soft: bool) -> None:
    a, e, labels = contrary()
    types = FaceTypes.fit(a[::2])
    hierarchy = ExpressionByType(types, soft=soft).fit(a, e, labels.tolist())
    likely = hierarchy.predict_proba(a, e)
    assert hierarchy.classes == ("down", "up") and np.allclose(likely.sum(axis=1), 1.0)
    right = (np.array(hierarchy.classes)[likely.argmax(axis=1)] == labels).mean()
    alone = (ShrinkageLDA().fit(e, labels).predict(e) == labels).mean()
    assert right > 0.95 and alone < 0.7


def test_between_two_types_the_soft_form_hears_both() -> None:
    a, e, labels = contrary()
    types = FaceTypes.fit(a[::2])
    between = types.mean.mean(axis=0)[None]
    hard, soft = (ExpressionByType(types, soft=s).fit(a, e, labels.tolist()) for s in (False, True))
    shown = np.array([[2.0, 0.0]])
    assert hard.predict_proba(between, shown).max() > 0.95
    assert soft.predict_proba(between, shown).max() < 0.95


def test_too_few_people_are_refused() -> None:
    with pytest.raises(InputError, match="too few for 9 types"):
        FaceTypes.fit(people(1, each=8), types=9)
    a, e, labels = contrary()
    with pytest.raises(InputError, match="ask for fewer types"):
        ExpressionByType(FaceTypes.fit(a[::2]), soft=True).fit(a[:3], e[:3], labels[:3].tolist())
