"""The invariants of the paper's two phases, in the form that `docs/paper-map.md` corrects them to."""

from itertools import pairwise

import numpy as np
import pytest

from shapespace.errors import FitError, InputError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.iteration_state import IcpState, StopRule
from shapespace.fit.paper.paper_method import Paper, shape_icp, similarity_icp
from shapespace.geometry.closest import ENGINES, build_engine
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity
from synthetic_shapes import angle_deg, blob_model, raw_scan, similarity, sphere

LONG = StopRule(rate=1e-12, motion_mm=1e-9, max_iterations=400)
Z = np.array([0.8, -1.0, 0.5, 1.0, -0.7])


@pytest.fixture(scope="module")
def model() -> ShapeModel:
    return blob_model()


def both_phases(
    model: ShapeModel, scan: Mesh, T: Similarity, stop: StopRule, engine: str = "vertices"
) -> list[IcpState]:
    search = build_engine(scan, engine)
    one = list(similarity_icp(model, search, T, stop))
    return one + list(shape_icp(model, search, one[-1].T_scan_model, stop))


def instance(model: ShapeModel, T: Similarity, share: float = 0.4) -> tuple[FloatArray, Mesh]:
    b = share * model.stddev * np.array([1.0, -1.0, 1.0, -1.0, 1.0])
    return b, Mesh(T.apply(model.reconstruct(b)), model.faces, name="instance.ply")


@pytest.mark.parametrize("engine", ENGINES)
def test_no_step_raises_the_energy(model: ShapeModel, engine: str) -> None:
    raw = raw_scan(Z, similarity(1, 15.0, 1.2), noise_mm=0.3)
    search = build_engine(raw.scan, engine)
    start = similarity(1, 0.0, 1.2)
    start = Similarity(1.2, start.rotation, raw.truth.mean(axis=0) - 1.2 * start.rotation @ model.mean_vertices.mean(0))
    first = list(similarity_icp(model, search, start, StopRule(1e-12, 1e-9, 15)))
    second = list(shape_icp(model, search, first[-1].T_scan_model, StopRule(1e-12, 1e-9, 25)))
    energy: list[float] = []
    for before, after in [*pairwise(first), *pairwise(second)]:
        x = model.reconstruct(before.b)
        c = search.query(before.T_scan_model.apply(x)).points  # step 1
        energy.append(((c - before.T_scan_model.apply(x)) ** 2).sum())
        energy.append(((c - after.T_scan_model.apply(x)) ** 2).sum())  # step 2
        y = after.T_scan_model.apply(model.reconstruct(after.b))
        energy.append(((c - y) ** 2).sum())  # step 3
        energy.append((search.query(y).distance ** 2).sum())  # step 1 of the next round
    assert (np.diff(energy) <= 1e-9 * energy[0]).all()
    assert energy[-1] < 0.5 * energy[0]


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("scale", [0.01, 3.0])
def test_a_similarity_of_the_scan_and_of_the_start_leaves_b_alone(model: ShapeModel, seed: int, scale: float) -> None:
    raw, start = raw_scan(Z, noise_mm=0.2), similarity(7, 5.0, 0.95, 2.0)
    T = similarity(seed, 120.0, scale, 100.0)
    moved = raw.scan.with_vertices(T.apply(raw.scan.vertices))
    stop = StopRule(1e-5, 1e-2, 100)
    here, there = both_phases(model, raw.scan, start, stop), both_phases(model, moved, T @ start, stop)
    assert len(here) == len(there)
    assert np.abs(here[-1].b - there[-1].b).max() < 1e-6
    assert scale * here[-1].rms_mm == pytest.approx(there[-1].rms_mm, rel=1e-7)
    assert there[-1].T_scan_model.scale == pytest.approx(scale * here[-1].T_scan_model.scale, rel=1e-9)


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_a_shape_of_the_model_gives_its_own_b_from_a_near_start(gauge: str) -> None:
    model, T, with_scale = blob_model(gauge=gauge), similarity(2, 30.0, 1.0, 80.0), gauge == "shape"
    b, scan = instance(model, T)
    near = T @ similarity(9, 1.0, 1.01 if with_scale else 1.0, 0.5)
    states = list(
        shape_icp(
            model, build_engine(scan, "vertices"), near, StopRule(1e-9, 1e-9, 30), b=0.8 * b, with_scale=with_scale
        )
    )
    assert np.abs(states[0].b - b).max() > 1
    assert np.abs(states[-1].b - b).max() < 1e-9
    assert states[-1].rms_mm < 1e-9


@pytest.mark.parametrize("engine", ENGINES)
def test_the_truth_is_a_fixed_point(model: ShapeModel, engine: str) -> None:
    T = similarity(2, 30.0, 0.7, 80.0)
    b, scan = instance(model, T)
    for state in shape_icp(model, build_engine(scan, engine), T, StopRule(1e-9, 1e-9, 10), b=b):
        assert np.abs(state.b - b).max() < 1e-9
        assert np.allclose(state.T_scan_model.rotation, T.rotation)


def test_the_order_of_the_scan_does_not_matter(model: ShapeModel) -> None:
    raw = raw_scan(Z, noise_mm=0.2)
    order = np.random.default_rng(0).permutation(len(raw.scan.vertices))
    place = np.argsort(order).astype(np.int32)
    mixed = Mesh(raw.scan.vertices[order], place[raw.scan.faces[::-1]])
    stop = StopRule(1e-5, 1e-2, 60)
    for engine in ENGINES:
        one, two = (both_phases(model, m, similarity(3, 3.0, 1.0, 1.0), stop, engine)[-1] for m in (raw.scan, mixed))
        assert np.abs(one.b - two.b).max() < 1e-6


def test_phase_1_moves_the_mean_only_and_phase_2_begins_there(model: ShapeModel) -> None:
    raw = raw_scan(Z)
    states = both_phases(model, raw.scan, similarity(4, 4.0, 1.0, 2.0), StopRule(1e-4, 1e-2, 50))
    assert [s.phase for s in states] == sorted(s.phase for s in states)
    for phase in (1, 2):
        own = [s for s in states if s.phase == phase]
        assert [s.iteration for s in own] == list(range(len(own)))
        assert [s.stopped is not None for s in own] == [False] * (len(own) - 1) + [True]
        assert len(own) > 2
    one = [s for s in states if s.phase == 1]
    assert all(not s.b.any() for s in one)
    two = [s for s in states if s.phase == 2]
    assert two[0].T_scan_model is one[-1].T_scan_model
    assert not two[0].b.any()
    assert two[1].b.any()
    assert two[-1].rms_mm < one[-1].rms_mm


def test_correspondences_follow_the_deformed_model(model: ShapeModel) -> None:
    # As printed, step 1 matches the mean shape in every round, and from the second round on nothing changes.
    raw = raw_scan(Z)
    states = [s for s in both_phases(model, raw.scan, Similarity.identity(), LONG) if s.phase == 2]
    search = build_engine(raw.scan)
    T = states[0].T_scan_model
    mean_matches = search.query(T.apply(model.mean_vertices)).points
    printed = model.basis.T @ (T.inverse().apply(mean_matches).ravel() - model.mean.ravel())
    assert np.abs(states[1].b - printed).max() > 0
    assert np.abs(states[-1].b - states[1].b).max() > 3.0
    truth = model.project(raw.truth)
    assert np.abs(states[-1].b - truth).max() < 0.5 * np.abs(states[1].b - truth).max()


def test_matches_are_projected_in_the_frame_of_the_model(model: ShapeModel) -> None:
    T = similarity(5, 60.0, 2.0, 100.0)
    b, scan = instance(model, T)
    raw_coordinates = model.basis.T @ (scan.vertices.ravel() - model.mean.ravel())  # P19 as printed
    assert np.abs(raw_coordinates - b).max() > 100
    state = list(shape_icp(model, build_engine(scan), T, StopRule(1e-6, 1e-6, 1), b=b))[-1]
    assert np.abs(state.b - b).max() < 1e-9


@pytest.mark.parametrize(
    "scan",
    [
        Mesh(sphere(800)[0] * [90.0, 90.0, 0.0] + [5.0, 0.0, 3.0], name="plane"),
        Mesh(raw_scan(Z).scan.vertices * [-1.0, 1.0, 1.0], name="mirror"),
    ],
    ids=["plane", "mirror"],
)
def test_flat_and_mirrored_scans_never_give_a_reflection_or_a_scale_below_zero(model: ShapeModel, scan: Mesh) -> None:
    for state in both_phases(model, scan, Similarity.identity(), StopRule(1e-4, 1e-2, 40)):
        assert np.linalg.det(state.T_scan_model.rotation) == pytest.approx(1.0)
        assert state.T_scan_model.scale > 0
        assert np.isfinite(state.b).all()


def test_a_fixed_scale_stays(model: ShapeModel) -> None:
    raw = raw_scan(Z)
    search = build_engine(raw.scan)
    start = similarity(6, 5.0, 0.97, 1.0)
    for phase in (similarity_icp, shape_icp):
        states = list(phase(model, search, start, StopRule(1e-4, 1e-2, 30), with_scale=False))
        assert {s.T_scan_model.scale for s in states} == {0.97}
        free = list(phase(model, search, start, StopRule(1e-4, 1e-2, 30)))
        assert abs(free[-1].T_scan_model.scale - 0.97) > 1e-3


@pytest.mark.parametrize(
    ("rms", "motion", "why"),
    [
        ([10.0], 0.0, None),
        ([10.0, 9.0], 0.0, None),
        ([10.0, 10.0 - 0.9e-3], 0.0, "rate"),
        ([10.0, 10.0 + 0.9e-3], 0.0, "rate"),
        ([10.0, 10.0], 0.02, None),
        ([0.0, 0.0], 0.0, "rate"),
        ([5.0, 4.0, 3.0, 2.0], 9.0, "cap"),
        ([5.0, 4.0, 3.0, 3.0], 0.0, "rate"),
    ],
)
def test_the_stopping_rule_wants_rate_and_motion_and_says_which_fired(
    rms: list[float], motion: float, why: str | None
) -> None:
    assert StopRule(1e-4, 0.01, 3).why(rms, motion) == why


def test_the_rate_alone_stops_while_b_still_moves(model: ShapeModel) -> None:
    raw = raw_scan(Z)
    ends = []
    for motion in (np.inf, 1e-2):
        states = both_phases(model, raw.scan, Similarity.identity(), StopRule(1e-2, motion, 1000), "surface")
        assert states[-1].stopped == "rate"
        ends.append(states[-1])
    far = both_phases(model, raw.scan, Similarity.identity(), StopRule(1e-9, 1e-6, 500), "surface")[-1]
    printed, corrected = (np.abs(e.b - far.b).max() for e in ends)
    assert corrected < 0.8 * printed


def test_the_cap_holds_and_is_told(model: ShapeModel) -> None:
    raw = raw_scan(Z)
    states = both_phases(model, raw.scan, Similarity.identity(), StopRule(1e-15, 1e-15, 4))
    assert [(s.phase, s.iteration, s.stopped) for s in states if s.stopped] == [(1, 4, "cap"), (2, 4, "cap")]
    result = fit_scan(
        model, raw.scan, FitConfig(method="paper", max_iterations=4, unit="mm"), T_scan_model=Similarity.identity()
    )
    assert result.status == "max_iterations"
    assert "4 iterations" in result.reason
    assert result.iterations == {"phase_1": 4, "phase_2": 4}


@pytest.mark.parametrize("rule", [{"rate": 0.0}, {"rate": np.nan}, {"motion_mm": 0.0}, {"max_iterations": 0}])
def test_stopping_rules_that_cannot_stop_are_refused(rule: dict[str, float]) -> None:
    with pytest.raises(InputError, match="stopping rule"):
        StopRule(**rule)


def test_the_plain_method_loses_scale_when_much_is_missing_and_says_so(model: ShapeModel) -> None:
    """The energy is zero for a model of no size on one scan point; with half of the surface gone it slides there."""
    raw = raw_scan(Z, keep=0.0)
    result = fit_scan(model, raw.scan, FitConfig(method="paper", unit="mm"), T_scan_model=Similarity.identity())
    scale, forward = result.T_scan_model.scale, result.distances.model_to_scan
    error_mm = np.linalg.norm(result.surface(model).vertices - raw.truth, axis=1).mean()
    assert scale < 0.5
    # In the scan's frame, as the paper measures, the one-way distance looks splendid.
    assert forward.mean < 2.0
    assert error_mm > 50
    assert result.status == "doubtful"
    assert "shrank" in result.reason


def test_a_model_that_shrinks_to_a_point_is_an_error_that_says_so(model: ShapeModel) -> None:
    with pytest.raises(FitError, match=r"raw\.ply: .*shrank to a point"):
        fit_scan(
            model, raw_scan(Z, keep=0.3).scan, FitConfig(method="paper", unit="mm"), T_scan_model=Similarity.identity()
        )


@pytest.mark.parametrize("keep", [-0.6, -0.2, 0.2])
@pytest.mark.parametrize("scale", ["free", "fixed"])
def test_no_scan_with_a_large_part_missing_passes_for_good(model: ShapeModel, keep: float, scale: str) -> None:
    config = FitConfig(method="paper", unit="mm", scale=scale)
    try:
        result = fit_scan(model, raw_scan(Z, keep=keep).scan, config, T_scan_model=Similarity.identity())
    except FitError:
        return
    assert result.status == "doubtful"


def test_a_complete_scan_is_not_doubtful(model: ShapeModel) -> None:
    raw = raw_scan(Z, similarity(8, 15.0, 1.0), noise_mm=0.2)
    told: list[IcpState] = []
    result = fit_scan(model, raw.scan, FitConfig(method="paper"), on_state=told.append)
    assert (result.status, result.method) == ("converged", "paper")
    assert list(result.history) == told
    assert result.mm_per_scan_unit == 1.0
    assert result.stages["final"].distances.model_to_scan.mean < result.stages["initial"].distances.model_to_scan.mean
    assert result.stages["initial"].distances.model_to_scan.mean < result.stages["before"].distances.model_to_scan.mean
    assert np.allclose(result.z, result.b / model.stddev)
    T = fit_similarity(model.reconstruct(result.b), result.surface(model).vertices)
    assert angle_deg(T.rotation @ result.T_scan_model.rotation.T) < 1e-5
    assert T.scale == pytest.approx(result.T_scan_model.scale)


def test_a_scan_far_from_the_origin_and_in_metres_gives_the_same_b(model: ShapeModel) -> None:
    raw = raw_scan(Z, similarity(8, 15.0, 1.0), noise_mm=0.2)
    here = fit_scan(model, raw.scan)
    far = fit_scan(model, raw.scan.with_vertices(raw.scan.vertices + 1e6))
    metres = fit_scan(model, raw.scan.with_vertices(1e-3 * raw.scan.vertices))
    assert np.abs(far.b - here.b).max() < 1e-3
    assert np.abs(metres.b - here.b).max() < 1e-6
    assert metres.mm_per_scan_unit == 1000.0
    assert metres.distances.model_to_scan.mean == pytest.approx(here.distances.model_to_scan.mean, rel=1e-6)
    assert np.allclose(metres.surface(model).vertices, 1e-3 * here.surface(model).vertices, atol=1e-8)


@pytest.mark.parametrize("what", ["method", "unit", "search", "scale"])
def test_settings_that_do_not_exist_are_refused(what: str) -> None:
    with pytest.raises(InputError, match=f"no {what} 'nonsense'"):
        Paper(search="nonsense") if what == "search" else FitConfig(**{what: "nonsense"})
