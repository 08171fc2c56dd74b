"""What every fitting method must do; a new entry of METHODS is tested by being there."""

from itertools import pairwise

import numpy as np
import pytest

from shapespace.fit.iteration_state import IcpState
from shapespace.fit.method import Limits
from shapespace.fit.method_choices import METHODS, method_named
from shapespace.fit.scan_target import ScanTarget
from shapespace.fit.search.initialisation import Start
from synthetic_shapes import blob_model, raw_scan, similarity

Z = np.array([1.5, -1.8, 1.3, 1.6, -1.4])


def states(name: str, max_iterations: int = 500, **settings: object) -> list[IcpState]:
    T = similarity(degrees=5.0, shift=2.0)
    raw = raw_scan(Z, T)
    limits = Limits(with_scale=True, modes=None, max_iterations=max_iterations)
    method, start = method_named(name, **settings), Start(T, "given", np.nan)
    return list(method.states(blob_model(), ScanTarget(raw.scan), start, limits))


@pytest.mark.parametrize("name", METHODS)
def test_phases_come_in_order_and_start_at_iteration_0(name: str) -> None:
    history = states(name)
    assert {state.phase for state in history} == {1, 2}
    assert history[0].phase == 1
    assert history[0].iteration == 0
    for before, after in pairwise(history):
        assert (after.phase, after.iteration) in ((before.phase, before.iteration + 1), (before.phase + 1, 0))


@pytest.mark.parametrize("name", METHODS)
def test_only_the_last_state_of_a_phase_says_why_it_stopped(name: str) -> None:
    for phase in (1, 2):
        stopped = [state.stopped for state in states(name) if state.phase == phase]
        assert stopped[-1] in ("rate", "cap")
        assert not any(stopped[:-1])


@pytest.mark.parametrize("name", METHODS)
def test_phase_1_has_no_shape_and_phase_2_begins_where_it_ended(name: str) -> None:
    history = states(name)
    first = [state for state in history if state.phase == 1]
    assert not any(state.b.any() for state in first)
    begin = next(state for state in history if state.phase == 2)
    np.testing.assert_array_equal(begin.T_scan_model.apply(np.eye(3)), first[-1].T_scan_model.apply(np.eye(3)))


@pytest.mark.parametrize("name", METHODS)
def test_a_clean_scan_is_fitted_closer_than_by_the_pose_alone(name: str) -> None:
    history = states(name, **({"search": "surface"} if name == "paper" else {}))
    begin = next(state for state in history if state.phase == 2)
    assert history[-1].rms_mm < 0.8 * begin.rms_mm
    assert np.isfinite(history[-1].b).all()
    assert history[-1].b.any()


@pytest.mark.parametrize("name", METHODS)
def test_the_cap_holds(name: str) -> None:
    assert max(state.iteration for state in states(name, max_iterations=3)) <= 3


@pytest.mark.parametrize("name", METHODS)
def test_the_same_scan_gives_the_same_states(name: str) -> None:
    for one, two in zip(states(name), states(name), strict=True):
        np.testing.assert_array_equal(one.b, two.b)
