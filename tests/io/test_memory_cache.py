"""Values are computed once for each object and arguments, freed with the object, and cleared by one call."""

import copy
import gc
import pickle
import weakref
from dataclasses import dataclass

import pytest

from shapespace.fit.robust.prepared_model import prepare
from shapespace.io import memory_cache
from shapespace.io.memory_cache import LatestValue, cached_with_owner
from synthetic_shapes import blob_model

calls: list[tuple[int, ...]] = []


@dataclass(frozen=True, eq=False)
class Owner:
    """What values are computed from."""

    number: int


@cached_with_owner(limit=2)
def total(owner: Owner, more: int = 0) -> int:
    calls.append((owner.number, more))
    return owner.number + more


@pytest.fixture(autouse=True)
def no_calls() -> None:
    calls.clear()


def test_a_value_is_computed_once_for_each_object_and_arguments() -> None:
    one, other = Owner(1), Owner(1)
    assert [total(one), total(one), total(one, 2), total(one, 2), total(other)] == [1, 1, 3, 3, 1]
    assert calls == [(1, 0), (1, 2), (1, 0)]


def test_the_oldest_goes_beyond_the_limit() -> None:
    one = Owner(1)
    for more in (0, 1, 2, 1, 0):
        total(one, more)
    assert calls == [(1, 0), (1, 1), (1, 2), (1, 0)]


def test_clear_empties_all_caches() -> None:
    one, latest = Owner(1), LatestValue[str]()
    total(one)
    latest.set("a", "A")
    memory_cache.clear()
    total(one)
    assert len(calls) == 2 and latest.get("a", lambda: "loaded") == "loaded"


def test_only_the_latest_value_is_held() -> None:
    latest = LatestValue[str]()
    assert [latest.get(key, lambda key=key: f"{key}{len(calls)}") for key in "aab"] == ["a0", "a0", "b0"]
    calls.append(())
    assert latest.get("a", lambda: f"a{len(calls)}") == "a1"


def test_a_model_takes_what_was_prepared_for_it_with_it_but_no_copy_does() -> None:
    model = blob_model(vertices=200).truncate(3)
    assert prepare(model).model is model
    for other in (copy.copy(model), pickle.loads(pickle.dumps(model))):
        assert prepare(other).model is other
    gone = weakref.ref(model)
    del model, other
    gc.collect()
    assert gone() is None
