"""Dense correspondence of raw scans, in rounds.

    round 1    the template is registered to each scan
    round k    the mean of round k - 1 is the template, and each registration begins at the leave-one-out prediction

A scan that cannot be registered is excluded with a reason, and is tried again in the next round. The state between two
rounds is a `RegistrationState`; each step is a function of the problem and a state that returns a new state. Equations
Cn are those of docs/correspondence.md.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import TypeAlias

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from shapespace.correspondence.correspondence_result import (
    ANOTHER_SHAPE,
    Correspondence,
    Corresponding,
    judge_collection,
    unit_ratios,
)
from shapespace.correspondence.first_template import FirstTemplate, first_template, repaired_scans
from shapespace.correspondence.harmonics import Harmonics, Reliefs, agreement, relief
from shapespace.correspondence.isometry import common_symmetries
from shapespace.correspondence.kinds import Collection, ShapePredictor, find_kinds, is_outlier, predict_leave_one_out
from shapespace.correspondence.landmark_guide import ScanLandmarks, consensus_landmarks
from shapespace.correspondence.pose_consensus import SAME_POSE_DEG, TEMPLATE, PoseComparison, angle_deg, consensus_poses
from shapespace.correspondence.registration import (
    CLEARLY_LESS_STRAINED,
    Comparison,
    RegistrationTask,
    RoundContext,
    ScanRegistration,
)
from shapespace.correspondence.scan_status import (
    MOST_FOLDED,
    Judgement,
    SurfaceEvidence,
    SurfaceMeasures,
    judge,
)
from shapespace.correspondence.settings import FEWEST, SIZE, CorrespondConfig
from shapespace.correspondence.template import PoseModel, clean_scan
from shapespace.correspondence.vertex_confidence import VertexConfidence
from shapespace.errors import InputError, ShapespaceError
from shapespace.geometry.landmark_placement import place_landmarks
from shapespace.geometry.mirror_plane import ASYMMETRIC, FLIP, ScanSides, mirror_image, solve_sides
from shapespace.geometry.normals import Distortion, face_areas, rms_size, without_estimates
from shapespace.geometry.procrustes import align_to_weighted_mean
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.interop import as_meshes
from shapespace.model.missing import with_estimates
from shapespace.model.shape_model import ShapeModel
from shapespace.types import ByteArray, FloatArray, IntArray, Mesh, Similarity, SurfaceLandmarks

ENOUGH_TO_JUDGE, _ENOUGH_TO_PREDICT = 6, 4
"""Number of scans: fewer do not determine the normal range of shapes; fewer do not predict another scan."""
_JUDGES = 40  # largest number of finished scans with which an added scan is compared: time grows with their square
_PARTS = 4  # folds of the shapes: the pose model of a scan is built without it
_WHOLE, _LEAST_SPREAD, _SIZE_UNSEEN = 0.9, 0.01, 0.3
"""Share of the template that a scan of the usual size must observe; smallest standard deviation of log sizes; and
standard deviation of a scan's own log size per missing share."""
_CLEARLY_WORSE = 1.1  # ratio of the scores of the other side and a scan's own, beyond which the side is decided
_RELIEF = 0.4
"""Log ratio of distances that an agreement of reliefs counts as: 0 left a scan of a simulated kind in a wrong pose, and
with 1 the scans of another kind were no longer a group."""
_FALLS_SHORT = 0.3  # agreement of a relief below the usual one, from which other poses and sides are registered too
_AS_NEAR = 1.1  # ratio of distances up to which a registration from another scan of the subject is used
_BENDS = 0.15  # share of bent scans from which the object counts as one that bends
_ANCHORS, _MOST_ANCHORS = 2, 6
"""Number of scans with which all others are compared, besides the template, and its limit while sides are undecided."""


Runner: TypeAlias = Callable[[RoundContext, Sequence[RegistrationTask]], Iterable[ScanRegistration]]
"""Function that does the tasks of a round, in any process, and yields their registrations as they end, in any order."""


def run_here(context: RoundContext, tasks: Sequence[RegistrationTask]) -> Iterable[ScanRegistration]:
    """Do one task after the other in this process."""
    return map(context.register, tasks)


def correspond(
    scans: Sequence[Mesh],
    config: CorrespondConfig | None = None,
    *,
    template: Mesh | None = None,
    model: ShapeModel | None = None,
    first: FirstTemplate | None = None,
    subjects: Sequence[str] = (),
    run: Runner = run_here,
) -> Correspondence:
    """Bring raw `scans` into correspondence: any pose, size and triangles, holes allowed, no landmarks required.

    Args:
        scans: scans of one kind of object; their landmarks are soft constraints, except those far off the scan.
        config: settings.
        template: surface of the first round, used unchanged; None chooses a scan and meshes it evenly.
        model: shape model of such objects; its mean is the template, and the first round begins at its fit to each
            scan.
        first: result of `first_template` for these scans, if it is already known.
        subjects: subject of each scan; scans of one subject are then registered from each other. Empty if unknown.
        run: function that does the tasks of a round.

    Raises:
        InputError: fewer than two scans, scans that are all equal, too few that can be registered, or settings with
            which the first template has too few vertices, or the median surface more than 1 % of folded triangles.
        MeshError: no scan can be a template, or the given template is unusable.
    """
    scans = list(as_meshes(scans, "correspond"))
    config = config or CorrespondConfig()
    first = first or first_template(scans, template, config, model)
    if subjects and len(subjects) != len(scans):
        raise InputError(f"There are {len(subjects)} subjects for {len(scans)} scans; give one for each scan.")
    problem = replace(_RunConstants.of([scan.name for scan in scans], first, config), subjects=tuple(subjects))
    problem, sides = _decide_sides(problem, run, may_reflect=template is None and model is None)
    state = _initial_state(problem, sides)
    for _ in range(config.rounds):
        registrations = run(
            _round_context(problem, state), [_make_task(problem, state, i) for i in problem.first.repaired]
        )
        previous, state = state, _next_state(problem, state, registrations)
        if not previous.rounds and state.bends:
            state = _decide_sides_by_strain(problem, previous, state, run)
        if subjects and not previous.rounds:
            state = _register_by_subject(problem, previous, state, run)
        if state.rounds[-1].moved < config.settled:  # C17
            break
    given = template.name if template is not None else "" if model is None else "The model's mean"
    result = _make_result(problem, state, _find_evidence(state), given)
    _check_folds(result, config)
    return result


def _check_folds(result: Correspondence, config: CorrespondConfig) -> None:
    """Check that the vertices and rounds suffice for surfaces without folds.

    Raises:
        InputError: the median surface has more than 1 % of folded triangles.
    """
    folded = float(np.median([scan.measures.folded for scan in result.scans if scan.measures is not None]))
    if folded > MOST_FOLDED:
        raise InputError(
            f"{100 * folded:.1f} % of the triangles of the median surface are folded over after {len(result.moved)} "
            f"rounds with {len(result.template.vertices)} vertices, so these settings do not suffice for a "
            f"correspondence; give more vertices (--vertices, {config.vertices} now) and rounds (--rounds, "
            f"{config.rounds} now), or remove inner surfaces (--outer)."
        )


@dataclass(frozen=True, eq=False)
class _RunConstants:
    """Constants of all rounds.

    Args:
        names: names of all scans, including unusable ones.
        first: the first template, and the usable scans.
        config: settings of the correspondence.
        harmonics: harmonics of the first template, used on every later one.
        comparisons: poses of scans relative to the anchors.
        reflected: whether the first template was reflected after the comparisons.
        subjects: subjects of all scans, or empty.
    """

    names: Sequence[str]
    first: FirstTemplate
    config: CorrespondConfig
    harmonics: Harmonics
    comparisons: tuple[PoseComparison, ...] = ()
    reflected: bool = False
    subjects: tuple[str, ...] = ()

    @staticmethod
    def of(names: Sequence[str], first: FirstTemplate, config: CorrespondConfig) -> _RunConstants:
        return _RunConstants(names, first, config, Harmonics.of(first.mesh, config.first.harmonics))

    def scan(self, i: int, *, mirrored: bool) -> Mesh:
        """Return scan `i`, or its mirror image."""
        scan = self.first.repaired[i]
        return mirror_image(scan) if mirrored else scan

    def landmarks(self, places: SurfaceLandmarks, scan: Mesh) -> ScanLandmarks | None:
        """Return the landmarks of `scan` that the template has at `places`."""
        return ScanLandmarks.shared(places, scan, self.config.landmark_uncertainty)


@dataclass(frozen=True)
class RoundRecord:
    """Cost and result of one round.

    Args:
        moved: RMS movement of the vertices of all scans, share of the size.
        scan_moved: RMS movement of the vertices of each registered scan, by its number, share of the size.
        cpu_s: CPU time of each scan that was tried, seconds.
    """

    moved: float
    scan_moved: Mapping[int, float]
    cpu_s: Mapping[int, float]


@dataclass(frozen=True, eq=False)
class RegistrationState:
    """The state between two rounds.

    Args:
        template: the mean shape, of the size `SIZE`.
        landmarks: landmarks of the scans, on the template.
        registrations: registrations of the scans that are not excluded, by their number.
        excluded: reason for each excluded scan.
        predictions: (V, 3) vertices from which the registration of each scan begins in the next round.
        sides: sides of all scans, from the comparisons before the first round.
        rounds: one record for each round so far.
        other_kinds: scans that were in another group than the largest -> the first scan of their group.
        consensus: poses of the scans, or of their mirror images, on which the comparisons with anchors agree (C32).
        bent: scans whose next registration begins at their own surface, since no other scan predicts it.
        relief_agreement: agreement of each registered scan with the median relief (C35); empty for few scans.
        symmetries: (S, V) near symmetries of an object that bends; None if there are none.
    """

    template: Mesh
    landmarks: SurfaceLandmarks
    registrations: Mapping[int, ScanRegistration]
    excluded: Mapping[int, str]
    predictions: Mapping[int, FloatArray]
    sides: ScanSides
    rounds: tuple[RoundRecord, ...]
    other_kinds: Mapping[int, int] = field(default_factory=dict[int, int])
    consensus: Mapping[int, Similarity] = field(default_factory=dict[int, Similarity])
    bent: frozenset[int] = frozenset()
    relief_agreement: Mapping[int, float] = field(default_factory=dict[int, float])
    symmetries: IntArray | None = None

    @property
    def bends(self) -> bool:
        """Whether the object bends: several scans are less strained if they begin at a map along the surface."""
        bent = [registration.bent for registration in self.registrations.values()]
        return sum(bent) >= max(2.0, _BENDS * len(bent))

    def agrees_less_than_usual(self, i: int, by: float = 0.0) -> bool:
        """Return whether the relief of scan `i` agrees less than usual with those of the others, by more than `by`."""
        usual = np.median(list(self.relief_agreement.values())) if i in self.relief_agreement else -np.inf
        return bool(self.relief_agreement.get(i, 0.0) < usual - by)

    def is_mirrored(self, i: int) -> bool:
        """Return whether scan `i` is a mirror image of the majority, by its registration or the comparisons."""
        if i in self.registrations:
            return self.registrations[i].mirrored
        return bool(self.sides.mirrored[i])

    def shapes(self, order: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        """Return the vertices (N, V, 3) of scans in the template's frame, and (N, V) 1.0 at observed vertices."""
        shapes = np.stack([self.registrations[i].vertices for i in order])
        return shapes, np.stack([self.registrations[i].observed for i in order]).astype(np.float64)


def _initial_state(problem: _RunConstants, sides: ScanSides) -> RegistrationState:
    mesh, broken = problem.first.mesh, dict(problem.first.broken)
    return RegistrationState(mesh, place_landmarks(mesh, mesh.landmarks), {}, broken, {}, sides, ())


# Sides


def _decide_sides(problem: _RunConstants, run: Runner, *, may_reflect: bool) -> tuple[_RunConstants, ScanSides]:
    """Return the sides of all scans, and the problem with their comparisons and its template on the majority's side.

    Args:
        problem: the scans and the first template.
        run: function that does the comparisons.
        may_reflect: whether the template may be reflected; otherwise its side is that of the majority.
    """
    count = len(problem.names)
    sides = ScanSides(np.zeros(count, np.bool_), np.zeros(count), decided=False)
    is_enough = len(problem.first.repaired) >= ENOUGH_TO_JUDGE
    if problem.config.mirror == "never" and (problem.config.pose != "search" or not is_enough):  # nothing is compared
        return problem, sides
    context, scores = _round_context(problem, _initial_state(problem, sides)), np.zeros((0, count, 2))
    anchors: list[int] = []
    for i, pose_model in chain([(TEMPLATE, context.pose_models[0])], _find_anchors(problem)):
        anchors.append(i)
        problem, row = _compare_with_anchor(problem, replace(context, pose_models=(pose_model,)), i, run)
        scores = np.concatenate([scores, row[None]])
        if len(anchors) > _ANCHORS and problem.config.mirror != "never":
            sides = solve_sides(scores, anchors, problem.config.seed)
        is_unsure = not sides.decided and sides.asymmetry > ASYMMETRIC
        if len(anchors) > (_MOST_ANCHORS if is_unsure else _ANCHORS):
            break
    if may_reflect and sides.decided and sides.mirrored.sum() > len(problem.first.repaired) / 2:
        if problem.config.pose != "search":  # the frame of a reflected template is not that of any file
            raise InputError(
                f"--pose {problem.config.pose} cannot be used: the first template is a mirror image of most scans. "
                "Give one of these scans as --template, or omit --pose."
            )
        first = replace(problem.first, mesh=mirror_image(problem.first.mesh))
        usable = np.isin(np.arange(count), list(problem.first.repaired))
        return replace(problem, first=first, reflected=True), replace(sides, mirrored=usable & ~sides.mirrored)
    return problem, sides


def _compare_with_anchor(
    problem: _RunConstants, context: RoundContext, anchor: int, run: Runner
) -> tuple[_RunConstants, FloatArray]:
    """Return the problem with the comparisons of all scans with an anchor, and scores (N, 2), as given and mirrored."""
    sides: Comparison = "pose" if problem.config.mirror == "never" else "scores"
    tasks = [
        RegistrationTask(i, scan, None, None, problem.config.first, sides=sides)
        for i, scan in problem.first.repaired.items()
    ]
    scores = np.full((len(problem.names), 2), np.nan)
    comparisons = list(problem.comparisons)
    for compared in run(context, tasks):
        scores[compared.index] = compared.scores.pose, compared.scores.mirrored
        T_image = next(
            (alternative.T_scan_template for alternative in compared.alternatives if alternative.mirrored), None
        )
        comparisons.append(PoseComparison(anchor, compared.index, compared.T_scan_template, T_image))
    return replace(problem, comparisons=tuple(comparisons)), scores


def _find_anchors(problem: _RunConstants) -> Iterator[tuple[int, PoseModel]]:
    """Yield the number and the pose model of some scans that can be templates."""
    for i in np.random.default_rng(problem.config.seed).permutation(list(problem.first.repaired)).tolist():
        try:
            yield i, PoseModel.of(clean_scan(problem.first.repaired[i]))
        except ShapespaceError:
            continue


# One round


def _round_context(problem: _RunConstants, state: RegistrationState) -> RoundContext:
    """Return the shared input of the tasks of the next round."""
    order, seed = sorted(state.registrations), problem.config.seed
    if len(order) < ENOUGH_TO_JUDGE:
        guide = None if state.registrations else problem.first.guide
        pose_model = PoseModel.of(state.template) if guide is None else PoseModel(guide)
        return RoundContext(state.template, problem.harmonics, (pose_model,), seed, guide)
    shapes, parts = state.shapes(order)[0], np.array([_part_of_scan(i) for i in order])
    pose_models = tuple(PoseModel.of(state.template, shapes[parts != part]) for part in range(_PARTS))
    return RoundContext(state.template, problem.harmonics, pose_models, seed)


def _part_of_scan(i: int) -> int:
    """Return the part of the scans that scan `i` belongs to; the pose model of a part is trained without it."""
    return i % _PARTS


def _make_task(problem: _RunConstants, state: RegistrationState, i: int) -> RegistrationTask:
    """Return the task of scan `i` in the next round; an excluded scan is searched for in all poses."""
    known, config = i in state.registrations, problem.config
    mirrored = state.is_mirrored(i)
    scan = problem.scan(i, mirrored=mirrored)
    return RegistrationTask(
        index=i,
        scan=scan,
        T_scan_template=_pose_with_usual_size(state, i) if known else None,
        expected=state.predictions.get(i) if known else None,
        settings=config.next if known else config.first,
        pose_model=_part_of_scan(i) if len(state.registrations) >= ENOUGH_TO_JUDGE else 0,
        landmarks=problem.landmarks(state.landmarks, scan),
        mirrored=mirrored,
        sides=_choose_comparison(problem, state, i),
        pose=config.pose,
        other_pose=_other_pose(state, i),
        bent=i in state.bent and known,
        from_all_poses=known and state.agrees_less_than_usual(i, _FALLS_SHORT),
        symmetries=state.symmetries if state.agrees_less_than_usual(i) else None,
    )


def _other_pose(state: RegistrationState, i: int) -> Similarity | None:
    """Return the pose of scan `i` on which the comparisons agree, if it is known and differs from its own."""
    T = state.consensus.get(i)
    if T is None or i not in state.registrations:
        return None
    return T if angle_deg(T, state.registrations[i].T_scan_template) > SAME_POSE_DEG else None


def _choose_comparison(problem: _RunConstants, state: RegistrationState, i: int) -> Comparison:
    """Return the comparison of scan `i` with its mirror image in the next round."""
    if problem.config.mirror == "never":
        return "as given"
    if not (state.sides.decided and state.registrations):
        return "one"
    is_settled = (
        i in state.registrations
        and not state.agrees_less_than_usual(i, _FALLS_SHORT)
        and state.registrations[i].scores.mirrored > _CLEARLY_WORSE * state.registrations[i].scores.pose
    )
    return "one" if is_settled else "both"


def _pose_with_usual_size(state: RegistrationState, i: int) -> Similarity:
    """Return the pose of a scan; if the scan is partial, with its size shrunk towards that of the complete scans.

    A bone without its end fits a smaller complete bone, so its own size has a variance that grows with the missing
    share.
    """
    T, observed = state.registrations[i].T_scan_template, state.registrations[i].observed
    order = sorted(state.registrations)
    complete = np.array([state.registrations[j].observed.mean() > _WHOLE for j in order])
    if observed.mean() > _WHOLE or complete.sum() < _ENOUGH_TO_PREDICT:
        return T
    log_sizes = np.log(unit_ratios([state.registrations[j].T_scan_template.scale for j in order])[0])
    usual = float(np.median(log_sizes[complete]))
    spread = max(float(np.std(log_sizes[complete])), _LEAST_SPREAD)
    own = log_sizes[order.index(i)]
    shrinkage = 1.0 / (1.0 + (_SIZE_UNSEEN * (1.0 - observed.mean()) / spread) ** 2)
    ratio = float(np.exp((1.0 - shrinkage) * (usual - own)))  # C16
    centre = T.apply(state.registrations[i].vertices[observed]).mean(axis=0)
    return Similarity(ratio, np.eye(3), (1.0 - ratio) * centre) @ T


def _next_state(
    problem: _RunConstants, previous: RegistrationState, registrations: Iterable[ScanRegistration]
) -> RegistrationState:
    """Return the state after a round.

    Raises:
        InputError: fewer than two scans are registered.
    """
    ended = sorted(registrations, key=lambda registration: registration.index)
    state = _accept(problem, previous, ended)
    sure = [i for i, registration in state.registrations.items() if not registration.alternatives]
    state = _exclude_other_kinds(problem, state, sure)
    state = _resolve_alternatives(problem, state)
    state = _exclude_other_kinds(problem, state, list(state.registrations))
    state = _exclude_mirrored(problem, state)
    if len(state.registrations) < FEWEST:
        reasons = "; ".join(f"{problem.names[i]}: {reason}" for i, reason in list(state.excluded.items())[:3])
        raise InputError(
            f"Only {len(state.registrations)} of {len(problem.names)} scans could be registered: {reasons}."
        )
    return _update_template(
        problem, previous, state, {registration.index: registration.cpu_s for registration in ended}
    )


def _decide_sides_by_strain(
    problem: _RunConstants, previous: RegistrationState, state: RegistrationState, run: Runner
) -> RegistrationState:
    """Return the state of the first round with the sides of an object that bends.

    Scores of rigid poses do not show the side of limbs that have moved. A scan stays reflected only if its mirror
    image is clearly less strained than the scan itself.
    """
    reflected = [i for i, registration in state.registrations.items() if registration.mirrored]
    if not reflected:
        return state
    as_given = replace(previous, sides=replace(previous.sides, mirrored=np.zeros(len(problem.names), np.bool_)))
    tasks = [replace(_make_task(problem, as_given, i), sides="as given") for i in reflected]
    registrations, cpu_s = dict(state.registrations), dict(state.rounds[-1].cpu_s)
    mirrored = np.array(as_given.sides.mirrored)
    for registration in run(_round_context(problem, as_given), tasks):
        i = registration.index
        cpu_s[i] += registration.cpu_s
        if _exclusion_reason(problem.config, registration) or (
            registrations[i].strain < CLEARLY_LESS_STRAINED * registration.strain
        ):
            mirrored[i] = True
        else:
            registrations[i] = registration
    sides = replace(previous.sides, mirrored=mirrored, decided=False)
    state = replace(state, registrations=registrations, sides=sides, rounds=previous.rounds)
    return _update_template(problem, previous, state, cpu_s)


def _register_by_subject(
    problem: _RunConstants, previous: RegistrationState, state: RegistrationState, run: Runner
) -> RegistrationState:
    """Return the state of the first round with each scan registered from the surface of another scan of its subject."""
    order = sorted(state.registrations)
    levels = subject_levels(state.shapes(order)[0], state.template.vertices, [problem.subjects[i] for i in order])
    context, registrations = _round_context(problem, state), dict(state.registrations)
    cpu_s = dict(state.rounds[-1].cpu_s)
    for level in levels:
        tasks: list[RegistrationTask] = []
        for i, parent in ((order[child], order[parent]) for child, parent in level):
            start = registrations[parent].vertices
            T = registrations[i].T_scan_template @ fit_similarity(start, registrations[i].vertices)
            task = replace(_make_task(problem, state, i), T_scan_template=T, expected=start, is_start_known=True)
            tasks.append(replace(task, settings=problem.config.first))
        for registration in run(context, tasks):
            i = registration.index
            own, cpu_s[i] = registrations[i], cpu_s[i] + registration.cpu_s
            if not _exclusion_reason(problem.config, registration) and (
                registration.distance[0] < _AS_NEAR * own.distance[0]
            ):
                registrations[i] = replace(registration, bent=own.bent, scores=own.scores)
    state = replace(state, registrations=registrations, rounds=previous.rounds)
    return _update_template(problem, previous, state, cpu_s)


# Selection of the registrations


def _accept(
    problem: _RunConstants, previous: RegistrationState, ended: Sequence[ScanRegistration]
) -> RegistrationState:
    """Return the state with the registrations of a round that are valid, and reasons for the others."""
    registrations: dict[int, ScanRegistration] = {}
    excluded = dict(problem.first.broken)
    for registration in ended:
        i = registration.index
        if reason := _exclusion_reason(problem.config, registration):
            excluded[i] = reason
        else:
            last = previous.registrations.get(i, registration)
            is_compared = np.isfinite(registration.relief_gap)
            registrations[i] = registration if is_compared else replace(registration, relief_gap=last.relief_gap)
    return replace(previous, registrations=registrations, excluded=excluded)


def _exclusion_reason(config: CorrespondConfig, registration: ScanRegistration) -> str:
    """Return why a registration is not used; empty if it is used."""
    if registration.reason:
        return registration.reason
    if registration.covered < config.fewest_covered:
        return (
            f"surface not reached: the template covers {100 * registration.covered:.0f} % of the scan; it shows "
            f"another object, or much besides the object{_wrong_names(registration)}"
        )
    if registration.observed.mean() < config.fewest_seen:
        return f"incomplete: it shows {100 * registration.observed.mean():.0f} % of the template"
    return ""


def _wrong_names(registration: ScanRegistration) -> str:
    """Return the other explanation for a scan whose pose is that of its landmarks."""
    return "; or its landmarks, which determine its pose, have wrong names" if registration.posed_by_landmarks else ""


def _exclude_other_kinds(problem: _RunConstants, state: RegistrationState, order: Sequence[int]) -> RegistrationState:
    """Exclude the scans in `order` that are another kind of object than the largest group, or resemble no other."""
    if problem.subjects:  # scans of one subject predict each other, and are not a kind of object
        order = list({problem.subjects[i]: i for i in sorted(order, reverse=True)}.values())
    if len(order) < ENOUGH_TO_JUDGE or state.bends:  # other poses are not other kinds
        return state
    order, config = sorted(order), problem.config
    shapes, observed = state.shapes(order)
    reliefs = Reliefs.of(shapes, observed, state.template, problem.harmonics)
    kinds = find_kinds(shapes, observed, state.template.vertices, reliefs)
    outliers = is_outlier(kinds.distance, kinds.relief_agreement, config.outlier_threshold)
    reasons = {
        order[k]: _outlier_reason(state.registrations[order[k]], float(kinds.distance[k]))
        for k in np.flatnonzero(outliers).tolist()
    }
    other_kinds = dict(state.other_kinds)
    for group in kinds.groups[1:]:
        members = [order[int(k)] for k in group]
        other_kinds |= dict.fromkeys(members, members[0])
        reasons |= dict.fromkeys(members, _another_kind(len(members), len(kinds.groups[0])))
    registrations = {i: registration for i, registration in state.registrations.items() if i not in reasons}
    excluded = {**state.excluded, **reasons}
    return replace(state, registrations=registrations, excluded=excluded, other_kinds=other_kinds)


def _another_kind(alike: int, largest: int) -> str:
    return f"another kind of object: one of {alike} scans that are alike and differ from the largest group of {largest}"


def _outlier_reason(registration: ScanRegistration, distance: float) -> str:
    return (
        f"another object, or wrongly placed: {distance:.1f} times as far as usual from its prediction by the other "
        f"scans{_wrong_names(registration)}"
    )


def _resolve_alternatives(problem: _RunConstants, state: RegistrationState) -> RegistrationState:
    """If several poses are about equally likely, use the pose whose shape the scans of certain pose predict best."""
    sure = [i for i, registration in state.registrations.items() if not registration.alternatives]
    if not _ENOUGH_TO_PREDICT <= len(sure) < len(state.registrations):
        return state
    shapes, observed = state.shapes(sure)
    shapes, _ = align_to_weighted_mean(shapes, observed, state.template.vertices)
    predictor = ShapePredictor.of(shapes, problem.config.noise_share)
    middle = Reliefs.of(shapes, observed, state.template, problem.harmonics).median()

    def unlikelihood(registration: ScanRegistration) -> float:
        distance = predictor.distance(registration.vertices, registration.observed.astype(np.float64))
        own = relief(registration.vertices, state.template, problem.harmonics)
        return float(np.log(distance)) - _RELIEF * agreement(
            own, middle, problem.harmonics.area * registration.observed
        )  # C15

    def best(registration: ScanRegistration) -> ScanRegistration:
        if not registration.alternatives:
            return registration
        return min((registration, *registration.alternatives), key=unlikelihood)

    return replace(state, registrations={i: best(registration) for i, registration in state.registrations.items()})


def _exclude_mirrored(problem: _RunConstants, state: RegistrationState) -> RegistrationState:
    """Exclude mirrored scans if the setting `mirror` is `ask`."""
    if problem.config.mirror != "ask":
        return state
    reason = "mirrored: its mirror image fits the other scans better; reflect it, or choose --mirror auto"
    mirrored = {i: reason for i, registration in state.registrations.items() if registration.mirrored}
    registrations = {i: registration for i, registration in state.registrations.items() if not registration.mirrored}
    return replace(state, registrations=registrations, excluded={**state.excluded, **mirrored})


# Evidence


def _find_evidence(state: RegistrationState) -> dict[int, SurfaceEvidence]:
    """Return the evidence on each registered scan; none if there are too few scans to determine the usual values."""
    if not state.relief_agreement:
        return {}
    usual = float(np.median(list(state.relief_agreement.values())))
    return {
        i: SurfaceEvidence(
            relief_agreement=own, usual_relief_agreement=usual, consensus_deg=_consensus_deg(state, i),
            relief_gap=state.registrations[i].relief_gap,
        )
        for i, own in state.relief_agreement.items()
    }  # fmt: skip


def _consensus_deg(state: RegistrationState, i: int) -> float:
    """Return the rotation between a scan's pose and the pose on which the comparisons agree (C32); 0 if unknown."""
    T = None if state.bends else state.consensus.get(i)
    return 0.0 if T is None else angle_deg(T, state.registrations[i].T_scan_template)


# The mean of a round


def _update_template(
    problem: _RunConstants, previous: RegistrationState, state: RegistrationState, cpu_s: Mapping[int, float]
) -> RegistrationState:
    """Make the mean of the round the template, and predict each scan from the others."""
    order = sorted(state.registrations)
    shapes, observed = state.shapes(order)
    shapes, mean = align_to_weighted_mean(shapes, observed, state.template.vertices)
    registrations: dict[int, ScanRegistration] = {}
    squares: dict[int, float] = {}
    for i, shape in zip(order, shapes, strict=True):
        registration = state.registrations[i]
        T = registration.T_scan_template @ fit_similarity(shape, registration.vertices)
        registrations[i] = replace(registration, vertices=shape, T_scan_template=T)
        squares[i] = _squared_movement(previous, i, shape)
    predictions = state.predictions
    if problem.config.guided and len(order) >= _ENOUGH_TO_PREDICT:
        predicted = predict_leave_one_out(shapes, observed, problem.config.noise_share)
        predictions = dict(zip(order, predicted, strict=True))
    template = Mesh(mean, state.template.faces, name=state.template.name, colours=_median_colours(registrations))
    bent = frozenset(i for i in order if registrations[i].bent)
    if state.bends:  # a mean of poses is not a shape, and other scans predict no pose
        bent, template = frozenset(order), state.template
    predictions = {**predictions, **{i: registrations[i].vertices for i in bent}}
    maps = [registration.symmetries for registration in registrations.values() if registration.symmetries is not None]
    agreements: dict[int, float] = {}
    if len(order) >= ENOUGH_TO_JUDGE:
        reliefs = Reliefs.of(shapes, observed, template, problem.harmonics)
        agreements = dict(zip(order, reliefs.agreements().tolist(), strict=True))
    record = RoundRecord(
        moved=float(np.sqrt(np.mean(list(squares.values())))) / SIZE,  # C17
        scan_moved={i: float(np.sqrt(square)) / SIZE for i, square in squares.items()},
        cpu_s=cpu_s,
    )
    return RegistrationState(
        template=template,
        landmarks=_landmarks_on(template, problem, registrations),
        registrations=registrations,
        excluded=state.excluded,
        predictions=predictions,
        sides=state.sides,
        rounds=(*state.rounds, record),
        other_kinds=state.other_kinds,
        consensus=_find_consensus(problem, state),
        bent=bent,
        relief_agreement=agreements,
        symmetries=common_symmetries(maps, template) if state.bends else None,
    )


def _median_colours(registrations: Mapping[int, ScanRegistration]) -> ByteArray | None:
    """Return the colours of the template: at each vertex the median of the scans that have colours and observe it."""
    coloured = [registration for registration in registrations.values() if registration.colours is not None]
    if not coloured:
        return None
    seen = np.stack([registration.observed for registration in coloured])
    seen |= ~seen.any(axis=0)
    colours = np.where(
        seen[:, :, None],
        np.stack([registration.colours for registration in coloured if registration.colours is not None]),
        np.nan,
    )
    return np.nanmedian(colours, axis=0).astype(np.uint8)


def _find_consensus(problem: _RunConstants, state: RegistrationState) -> dict[int, Similarity]:
    """Return the poses on which the comparisons agree (C32); none for few scans, or if frames of files are used."""
    if problem.config.pose != "search" or len(problem.first.repaired) < ENOUGH_TO_JUDGE:
        return {}
    mirrored = {TEMPLATE: problem.reflected} | {i: state.is_mirrored(i) for i in range(len(problem.names))}
    poses = consensus_poses(problem.comparisons, mirrored)
    angles = [
        angle_deg(poses[i], registration.T_scan_template)
        for i, registration in state.registrations.items()
        if i in poses
    ]
    # If most scans contradict the comparisons with the template, these are wrong and not the scans.
    return poses if angles and np.median(angles) < SAME_POSE_DEG else {}


def _squared_movement(previous: RegistrationState, i: int, shape: FloatArray) -> float:
    """Return the mean squared movement of the vertices of scan `i` since the last round, or since the mean at first."""
    known = i in previous.registrations
    before = previous.registrations[i].vertices if known else previous.template.vertices
    return float(((fit_similarity(before, shape).apply(before) - shape) ** 2).sum(axis=1).mean())


def _landmarks_on(
    template: Mesh, problem: _RunConstants, registrations: Mapping[int, ScanRegistration]
) -> SurfaceLandmarks:
    """Return the positions of the landmarks of the registered scans on the template."""

    def in_template_frame(i: int) -> dict[str, FloatArray]:
        T_template_scan = registrations[i].T_scan_template.inverse()
        scan = problem.scan(i, mirrored=registrations[i].mirrored)
        return {name: T_template_scan.apply(point) for name, point in scan.landmarks.items()}

    return consensus_landmarks(
        template, [(registration.vertices, in_template_frame(i)) for i, registration in registrations.items()]
    )


# Scans added to a finished correspondence


@dataclass(frozen=True, eq=False)
class FinishedCorrespondence:
    """The result of `correspond` that scans are added to.

    Args:
        mean: mean shape, of the size `SIZE`.
        landmarks: landmarks on the mean.
        surfaces: surfaces in correspondence, each in the frame and unit of its scan, with `Mesh.observed`; those of
            mirrored scans are reflected. Their landmarks are used if the mean has none.
        scans: raw scans of the surfaces; empty if the mean and the surfaces stay unchanged.
        mirrored: whether each scan is mirrored; empty if none is.
        sides_decided: whether scans could be distinguished from their mirror images, see `Correspondence`.
        judged: results of the scans, with which those of added scans are compared; empty if unknown.
    """

    mean: Mesh
    landmarks: SurfaceLandmarks
    surfaces: Sequence[Mesh]
    scans: Sequence[Mesh] = ()
    mirrored: Sequence[bool] = ()
    sides_decided: bool = False
    judged: Sequence[Corresponding] = ()


def add_scans(
    finished: FinishedCorrespondence,
    scans: Sequence[Mesh],
    config: CorrespondConfig | None = None,
    *,
    run: Runner = run_here,
) -> Correspondence:
    """Register `scans` to the mean of a finished correspondence, each with the finished surfaces as prior.

    No result depends on the other added scans, and mean and surfaces stay unchanged. With `finished.scans` another
    round over all scans follows, which computes the mean and all surfaces again.

    Args:
        finished: the correspondence.
        scans: the scans to add, in any pose, size and unit.
        config: settings of the finished correspondence.
        run: function that does the tasks of a round.

    Returns:
        The mean, and the results of `scans` alone; with `finished.scans` those of all scans, the finished ones first.

    Raises:
        InputError: a scan of `finished` cannot be used, or the round over all scans registers fewer than two.
    """
    config = config or CorrespondConfig()
    kept, scans = len(finished.surfaces), list(as_meshes(scans, "add_scans"))
    given = [*finished.scans, *scans]
    repaired, broken, notes = repaired_scans(given, config, first=kept + len(scans) - len(given))
    if unusable := [reason for i, reason in broken.items() if i < kept]:
        raise InputError(f"A scan of the finished correspondence is {unusable[0]}")
    names = [mesh.name for mesh in (*finished.surfaces, *scans)]
    origin = "The template is the mean of the finished correspondence."
    first = FirstTemplate(finished.mean, origin, repaired, broken, notes)
    problem = _RunConstants.of(names, first, config)
    start = _finished_state(problem, finished)
    states = _added_states(problem, start, [i for i in repaired if i >= kept], run)
    judged = {i: _judge_by_finished(problem, state, i) for i, state in states.items()}
    if finished.scans:
        state = _merge_states(start, {i: state for i, (state, _) in judged.items()})
        state = replace(_update_template(problem, state, state, {}), rounds=())
        registrations = run(_round_context(problem, state), [_make_task(problem, state, i) for i in repaired])
        state = _next_state(problem, state, registrations)
        return _make_result(problem, state, _find_evidence(state))
    confidence = VertexConfidence.of(finished.mean, problem.harmonics)
    results = [_added_result(problem, *judged.get(i, (start, None)), i, confidence) for i in range(kept, len(names))]
    if finished.judged:
        results = judge_collection(results, config.settled, finished.judged)
    return Correspondence(finished.mean, tuple(results), first.origin, (), start.landmarks)


def _added_result(
    problem: _RunConstants,
    state: RegistrationState,
    evidence: SurfaceEvidence | None,
    i: int,
    confidence: VertexConfidence,
) -> Corresponding:
    own = state.registrations.get(i)
    if own is None or own.observed.all():  # estimates take long where there are many scans
        return _scan_result(problem, state, i, None if own is None else own.vertices, evidence, confidence)
    return _scan_result(problem, state, i, _complete_shapes(problem, state)[i], evidence, confidence)


def _finished_state(problem: _RunConstants, finished: FinishedCorrespondence) -> RegistrationState:
    """Return the state after the last round of a finished correspondence, from its surfaces aligned to its mean."""
    registrations: dict[int, ScanRegistration] = {}
    for i, surface in enumerate(finished.surfaces):
        observed = np.ones(len(surface.vertices), np.bool_) if surface.observed is None else surface.observed
        T = fit_similarity(surface.vertices[observed], finished.mean.vertices[observed])  # C11
        nan = np.nan
        registrations[i] = ScanRegistration(
            i, T.apply(surface.vertices), T.inverse(), observed, covered=1.0, distance=(nan, nan, nan, nan), cpu_s=0.0,
            mirrored=bool(finished.mirrored) and finished.mirrored[i],
        )  # fmt: skip
    places = finished.landmarks or consensus_landmarks(
        finished.mean,
        [
            (
                registration.vertices,
                {k: registration.T_scan_template.inverse().apply(x) for k, x in finished.surfaces[i].landmarks.items()},
            )
            for i, registration in registrations.items()
        ],
    )
    unknown = np.zeros(len(problem.names))
    sides = ScanSides(unknown > 0, unknown, finished.sides_decided)
    return RegistrationState(finished.mean, places, registrations, dict(problem.first.broken), {}, sides, ())


def _added_states(
    problem: _RunConstants, start: RegistrationState, added: Sequence[int], run: Runner
) -> dict[int, RegistrationState]:
    """Return for each scan of `added` the state after its last round, with the finished scans and this one only."""
    shapes = start.shapes(sorted(start.registrations))[0]
    prior = shapes if len(shapes) >= ENOUGH_TO_JUDGE else None
    pose_models = (PoseModel.of(start.template, prior),)  # it is trained without all added scans
    context = RoundContext(start.template, problem.harmonics, pose_models, problem.config.seed)
    can_predict = problem.config.guided and len(start.registrations) >= _ENOUGH_TO_PREDICT
    predictor = ShapePredictor.of(shapes, problem.config.noise_share) if can_predict else None
    states = dict.fromkeys(added, start)
    left = list(added)
    for _ in range(problem.config.rounds):
        tasks = [replace(_make_task(problem, states[i], i), pose_model=0) for i in left]
        for registration in run(context, tasks):
            i = registration.index
            states[i] = _next_added_state(problem, start, states[i], registration, predictor)
        # The mean stays unchanged, so an excluded scan would be excluded again.
        left = [i for i in left if states[i].rounds and states[i].rounds[-1].moved >= problem.config.settled]
    return states


def _next_added_state(
    problem: _RunConstants,
    start: RegistrationState,
    previous: RegistrationState,
    registration: ScanRegistration,
    predictor: ShapePredictor | None,
) -> RegistrationState:
    """Return the state after a round of one added scan; the finished scans and their mean stay unchanged."""
    i, kept = registration.index, start.registrations
    state = _accept(problem, previous, [registration])
    if i not in state.registrations:
        return replace(start, excluded={i: state.excluded[i]})
    state = replace(state, registrations={**kept, i: state.registrations[i]})
    if registration.alternatives:
        state = _resolve_alternatives(problem, state)
    state = _exclude_mirrored(problem, state)
    if i not in state.registrations:
        return replace(start, excluded={i: state.excluded[i]})
    own, mean = state.registrations[i], start.template.vertices
    T = fit_similarity(own.vertices[own.observed], mean[own.observed])  # C11
    shape = T.apply(own.vertices)
    moved = float(np.sqrt(_squared_movement(previous, i, shape))) / SIZE
    own = replace(own, vertices=shape, T_scan_template=own.T_scan_template @ T.inverse())
    predicted = {} if predictor is None else {i: predictor.predict(shape, own.observed.astype(np.float64))}
    record = RoundRecord(moved, {i: moved}, {i: registration.cpu_s})
    rounds = (*previous.rounds, record)
    return replace(start, registrations={**kept, i: own}, predictions=predicted, rounds=rounds)


def _judge_by_finished(
    problem: _RunConstants, state: RegistrationState, i: int
) -> tuple[RegistrationState, SurfaceEvidence | None]:
    """Return the state of an added scan, which excludes an outlier among the finished scans, and their evidence.

    There is no evidence if there are too few finished scans.
    """
    kept = sorted(state.registrations.keys() - {i})
    judges = kept[:: -(-len(kept) // _JUDGES)]
    if i not in state.registrations or len(judges) < ENOUGH_TO_JUDGE - 1:
        return state, None
    shapes, observed = state.shapes([*judges, i])
    finished = np.arange(len(judges))
    distance = Collection.of(shapes, observed, state.template.vertices).distances(finished)[-1]
    *others, own = Reliefs.of(shapes, observed, state.template, problem.harmonics).agreements(finished).tolist()
    if is_outlier(distance, own, problem.config.outlier_threshold):
        excluded = {i: _outlier_reason(state.registrations[i], float(distance))}
        registrations = {j: registration for j, registration in state.registrations.items() if j != i}
        return replace(state, registrations=registrations, excluded=excluded), None
    return state, SurfaceEvidence(relief_agreement=own, usual_relief_agreement=float(np.median(others)))


def _merge_states(start: RegistrationState, states: Mapping[int, RegistrationState]) -> RegistrationState:
    """Return the state with the finished scans and all added scans."""
    registered = {i: state.registrations[i] for i, state in states.items() if i in state.registrations}
    excluded = {i: state.excluded[i] for i, state in states.items() if i not in registered}
    registrations, reasons = {**start.registrations, **registered}, {**start.excluded, **excluded}
    return replace(start, registrations=registrations, excluded=reasons)


# The result


def _group_kinds(state: RegistrationState) -> list[list[int]]:
    """Return the scans in correspondence, then those of each other kind; empty if all are of one kind."""
    others: dict[int, list[int]] = {}
    for i in sorted(state.other_kinds.keys() & state.excluded.keys()):
        others.setdefault(state.other_kinds[i], []).append(i)
    alike = [group for group in others.values() if len(group) > 1]
    return [sorted(state.registrations), *sorted(alike, key=len, reverse=True)] if alike else []


def _make_result(
    problem: _RunConstants, state: RegistrationState, evidence: Mapping[int, SurfaceEvidence], given: str | None = None
) -> Correspondence:
    """Return the result of all scans; `given` is the template or model of the first round, None for later rounds."""
    complete, groups = _complete_shapes(problem, state), _group_kinds(state)
    # A scan of another kind is tried again in each round, and can end with a reason that names no kind.
    kinds = {i: _another_kind(len(group), len(groups[0])) for group in groups[1:] for i in group}
    state = replace(state, excluded={**state.excluded, **kinds})
    confidence = VertexConfidence.of(state.template, problem.harmonics)
    scans = tuple(
        _scan_result(problem, state, i, complete.get(i), evidence.get(i), confidence) for i in range(len(problem.names))
    )
    points = state.landmarks.positions(state.template.vertices)
    template = state.template.with_vertices(state.template.vertices, points)
    landmarks = replace(state.landmarks, distance_mm=np.empty(0))  # landmarks of a mean have no given point
    moved = tuple(record.moved for record in state.rounds)
    made = Correspondence(
        template, scans, problem.first.origin, moved, landmarks, sides_decided=state.sides.decided,
        groups=tuple(tuple(problem.names[i] for i in group) for group in groups), given=given or "",
    )  # fmt: skip
    if given is not None and not made.is_of_another_kind and len(state.registrations) < ENOUGH_TO_JUDGE:
        scans = [_note_other_shape(scan) for scan in scans]
    return replace(made, scans=judge_collection(scans, problem.config.settled))


def _note_other_shape(scan: Corresponding) -> Corresponding:
    """Return a scan, of too few to find other objects, with a note if its shape differs clearly."""
    if scan.reason or not scan.moved or scan.moved[0] <= ANOTHER_SHAPE:
        return scan
    return scan.noting(
        f"It differs from the others by {100 * scan.moved[0]:.0f} % of its size, and there are too few scans to decide "
        "whether it is another object; inspect it."
    )


def _complete_shapes(problem: _RunConstants, state: RegistrationState) -> dict[int, FloatArray]:
    """Return the vertices (V, 3) of each registered scan, in the template's frame, with estimates where not observed.

    An estimate is the conditional mean by probabilistic PCA of all registered scans (C27). A vertex that fewer than
    `FEWEST` scans observe keeps its registered position. If there are too few scans for a model, all vertices do.
    """
    order = sorted(state.registrations)
    shapes, weights = state.shapes(order)
    observed = weights > 0
    learnt = observed.sum(axis=0) >= FEWEST
    if not observed[:, learnt].all() and len(order) >= _ENOUGH_TO_PREDICT:
        masked = np.where(observed[:, learnt, None], shapes[:, learnt], np.nan)
        shapes[:, learnt] = with_estimates(masked, [problem.names[i] for i in order])
    return dict(zip(order, shapes, strict=True))


def _scan_result(
    problem: _RunConstants,
    state: RegistrationState,
    i: int,
    complete: FloatArray | None,
    evidence: SurfaceEvidence | None,
    confidence: VertexConfidence,
) -> Corresponding:
    """Return the result of scan `i`; `complete` are its vertices (V, 3) in the template's frame, None if excluded."""
    moved = tuple(record.scan_moved[i] for record in state.rounds if i in record.scan_moved)
    cpu_s = tuple(record.cpu_s[i] for record in state.rounds if i in record.cpu_s)
    notes = tuple(problem.first.notes.get(i, ()))
    if complete is None:
        return Corresponding(problem.names[i], state.excluded[i], moved=moved, seconds=cpu_s, notes=notes)
    registration, scan = state.registrations[i], problem.first.repaired[i]
    judgement = Judgement("converged", np.nan, "") if evidence is None else judge(evidence)
    T = registration.T_scan_template
    vertices = T.apply(complete)
    landmarks = problem.landmarks(state.landmarks, problem.scan(i, mirrored=registration.mirrored))
    mean, p95, p99, largest = (T.scale * length for length in registration.distance)
    position_std = confidence.position_std(complete, registration.observed, len(state.registrations))
    shown = without_estimates(Mesh(vertices, state.template.faces, observed=registration.observed))
    area = float(np.nansum(face_areas(shown)))
    return Corresponding(
        name=problem.names[i],
        reason="",
        vertices=vertices * FLIP if registration.mirrored else vertices,
        T_scan_template=T,
        seen=float(registration.observed.mean()),
        covered=registration.covered,
        distance=(mean, p95, p99, largest),
        moved=moved,
        seconds=cpu_s,
        landmarks=np.nan if landmarks is None else landmarks.rms_distance(vertices),
        observed=registration.observed,
        mirrored=registration.mirrored,
        status=judgement.status,
        probability=judgement.probability,
        doubt=judgement.doubt,
        evidence=evidence,
        position_std=T.scale * position_std,
        measures=_measure_surface(state.template, registration, moved),
        notes=notes,
        area_share=None if scan.faces is None else area / float(face_areas(scan).sum()),
    )


def _measure_surface(template: Mesh, registration: ScanRegistration, moved: Sequence[float]) -> SurfaceMeasures:
    """Return the measures of a surface in the frame of the template; `moved` are its movements in the rounds."""
    seen = np.where(registration.observed[:, None], registration.vertices, np.nan)
    changed = Distortion.of(template.with_vertices(seen), template)
    return SurfaceMeasures(
        distance=registration.distance[2] / rms_size(template.vertices),
        folded=changed.folded_share,
        missing=1.0 - float(registration.observed.mean()),
        unreached=1.0 - registration.covered,
        area_change=changed.area_factor,
        not_settled=moved[-1] if moved else np.nan,
    )


_LEAST = 1e-9  # share of the largest distance, so that equal shapes are connected


def subject_levels(shapes: FloatArray, mean: FloatArray, subjects: Sequence[Hashable]) -> list[list[tuple[int, int]]]:
    """Return pairs of shape and parent; those of a level have parents in the levels before, or roots.

    The shapes of a subject are the nodes of a minimum spanning tree of their RMS distances. Its root is the shape
    nearest to the mean, such as the neutral face; extreme shapes follow through intermediate ones.

    Args:
        shapes: (N, V, 3) aligned shapes.
        mean: (V, 3) mean of all shapes.
        subjects: (N,) subjects of the shapes.
    """
    members: dict[Hashable, list[int]] = {}
    for i, subject in enumerate(subjects):
        members.setdefault(subject, []).append(i)
    levels: dict[int, list[tuple[int, int]]] = {}
    for own in members.values():
        flat = shapes[own].reshape(len(own), -1)
        distances = np.linalg.norm(flat[:, None] - flat, axis=2)
        root = int(np.linalg.norm(flat - mean.ravel(), axis=1).argmin())
        tree = minimum_spanning_tree(distances + _LEAST * max(float(distances.max()), 1.0))
        order, parents = breadth_first_order(tree, root, directed=False)
        depth = {root: 0}
        for child in map(int, order[1:]):
            parent = int(parents[child])
            depth[child] = depth[parent] + 1
            levels.setdefault(depth[child], []).append((own[child], own[parent]))
    return [levels[depth] for depth in sorted(levels)]
