"""From raw scans to surfaces in correspondence, in rounds: each knows what the last one found.

    round 1    the template goes to each scan, by itself
    round k    the mean of the round is the template, and what the other scans say of a scan is where it begins

A scan that no round can reach is set aside with the reason, and the others go on without it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Protocol

import numpy as np

from shapespace.correspondence.guide import Others, aligned, predict_leave_one_out
from shapespace.correspondence.harmonics import Harmonics
from shapespace.correspondence.landmark_guide import Marks, agreed, unlike_most, without_astray
from shapespace.correspondence.mirror_image import Mirror
from shapespace.correspondence.place import Placed, PlaceTask, Workbench
from shapespace.correspondence.register import ElasticSettings
from shapespace.correspondence.scan_set import copies, unit_ratios
from shapespace.correspondence.template import Glance, choose, clean, given, resampled
from shapespace.errors import InputError, MeshError
from shapespace.geometry.doctor import repair
from shapespace.geometry.landmark_placement import place_landmarks
from shapespace.geometry.normals import rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.io.interop import as_meshes
from shapespace.lazy import lazy_import
from shapespace.model.missing import with_estimates
from shapespace.model.shape_model import ShapeModel
from shapespace.reprs import short_repr
from shapespace.types import BoolArray, FloatArray, Mesh, Similarity, SurfaceLandmarks

SIZE = 100.0
"""The template's RMS size in its own frame: all lengths of the method are in hundredths of an object's size."""
FEWEST = 2
ENOUGH_TO_JUDGE, _ENOUGH_TO_SETTLE = 6, 4
_PARTS = 4
_WHOLE, _LEAST_SPREAD, _SIZE_UNSEEN = 0.9, 0.01, 0.3
"""Who shows more than this share of the template tells what size is usual; the least standard deviation of sizes; and
that of a scan's own size for each share that is missing."""
_MIRRORED = 0.85
"""A scan whose mirror image lies nearer to the template, by this ratio, is one: of 60 faces, femora and spleens that
were not mirrored none had less than 0.88."""


@dataclass(frozen=True)
class CorrespondSettings:
    """How scans are brought into correspondence; lengths are shares of the object's size (RMS from its middle).

    Args:
        vertices: of the template, about.
        rounds: at most.
        settled: a round that moves vertices by less (RMS over all) is the last.
        first: the registration of round 1,
        next: and of the others, which begin at what the other scans say.
        guided: whether later rounds begin at what the others say, or at the mean.
        noise_share: how little the others are believed, as a share of a mode's mean variance.
        fewest_seen: share of the template that a scan must show,
        fewest_covered: and share of a scan that the template must reach.
        strange: shapes whose distance from what the others say of them is beyond this many times the usual are other
            objects.
        symmetric: whether the object is its own mirror image: the template is then made so, and the others' mirror
            images tell of a scan too.
        landmark_uncertainty: standard deviation of landmarks.
        seed: of all that is drawn.
    """

    vertices: int = 10_000
    rounds: int = 3
    settled: float = 0.002
    first: ElasticSettings = field(default_factory=ElasticSettings)
    next: ElasticSettings = field(default_factory=ElasticSettings)
    guided: bool = True
    noise_share: float = 1.0
    fewest_seen: float = 0.4
    fewest_covered: float = 0.6
    strange: float = 3.0
    symmetric: bool = False
    landmark_uncertainty: float = 0.02
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Corresponding:
    """One scan after the rounds.

    Args:
        name: of the scan.
        reason: why it is set aside; empty where it is not.
        vertices: (V, 3) in the scan's own frame and unit, finite everywhere: where the scan shows nothing they are
            estimates, the conditional means given the observed vertices; None if excluded.
        T_scan_template: to the scan's own frame; None where no pose was found.
        seen: share of the template's vertices that the scan shows.
        covered: share of the scan that the template reaches.
        distance: (4,) mean, 95 %, 99 % and largest distance both ways over what is seen, in the scan's unit.
        moved: RMS by which its vertices moved in each round, shares of its size.
        seconds: CPU time of each round.
        landmarks: RMS distance of the scan's landmarks from their places on the surface, in the scan's unit;
            not-a-number where it has none.
        observed: (V,) bool, False where `vertices` are estimates; None if excluded.
    """

    name: str
    reason: str
    vertices: FloatArray | None = None
    T_scan_template: Similarity | None = None
    seen: float = 0.0
    covered: float = 0.0
    distance: tuple[float, float, float, float] = (np.nan, np.nan, np.nan, np.nan)
    moved: tuple[float, ...] = ()
    seconds: tuple[float, ...] = ()
    landmarks: float = np.nan
    observed: BoolArray | None = None

    __repr__ = short_repr


@dataclass(frozen=True, eq=False)
class Correspondence:
    """Scans in correspondence.

    Args:
        template: the mean shape of the last round, in mm of `SIZE`, with the landmarks that scans have.
        scans: in the order given.
        why: where the first template came from, in a sentence.
        moved: RMS movement in each round, share of the size.
        landmarks: the landmarks that scans have, on each of the surfaces.
    """

    template: Mesh
    scans: tuple[Corresponding, ...]
    why: str
    moved: tuple[float, ...]
    landmarks: SurfaceLandmarks = field(default_factory=SurfaceLandmarks)

    __repr__ = short_repr

    def _repr_html_(self) -> str:
        return lazy_import("html_of_correspondence")(self)

    def meshes(self) -> list[Mesh]:
        """Return the complete surfaces of scans that are not excluded, in their own frames, with `Mesh.observed`.

        They have the landmarks in whose triangles all vertices are observed.
        """
        return [self._mesh(one, one.vertices) for one in self.scans if one.vertices is not None]

    def _mesh(self, scan: Corresponding, vertices: FloatArray) -> Mesh:
        there = np.ones(len(vertices), dtype=np.bool_) if scan.observed is None else scan.observed
        landmarks = self.landmarks.within(there).positions(vertices)
        return Mesh(vertices, self.template.faces, landmarks, scan.name, observed=scan.observed)


class Runner(Protocol):
    """Does the tasks of a round, here or elsewhere, and yields them as they end."""

    def __call__(self, bench: Workbench, tasks: Sequence[PlaceTask]) -> Iterable[Placed]:
        """Yield what came of each of `tasks`, in any order."""
        ...


def run_here(bench: Workbench, tasks: Sequence[PlaceTask]) -> Iterable[Placed]:
    """Do one task after the other in this process."""
    return map(bench.place, tasks)


@dataclass(frozen=True, eq=False)
class First:
    """What the first round goes by.

    Args:
        mesh: the template, of the size `SIZE`, about the origin.
        why: where it comes from, in a sentence.
        repaired: the scans that can be used, by their number.
        broken: why the others cannot.
        guide: a model whose mean is the template, of the same size and place.
    """

    mesh: Mesh
    why: str
    repaired: Mapping[int, Mesh]
    broken: Mapping[int, str]
    guide: ShapeModel | None = None


def first_template(
    scans: Sequence[Mesh],
    template: Mesh | None,
    settings: CorrespondSettings,
    model: ShapeModel | None = None,
) -> First:
    """Return what the first round goes by: `template` as it is, the mean of `model`, or the scan nearest to the others.

    Raises:
        InputError: fewer than two scans, scans that are all equal, or both a template and a model.
        MeshError: no scan can be a template, or the template or model has no triangles.
    """
    if len(scans) < FEWEST:
        raise InputError(f"A correspondence needs at least {FEWEST} scans, not {len(scans)}; give more.")
    if not 0 < settings.landmark_uncertainty < np.inf:
        raise InputError(f"Landmarks have an uncertainty above 0, not {settings.landmark_uncertainty}; give another.")
    if template is not None and model is not None:
        raise InputError("Both a template and a model are given, and the model's mean is a template; leave one out.")
    good, broken = _repaired(scans)
    if len(good) < FEWEST:
        raise InputError(f"Hardly any of the scans can be used: {'; '.join(broken.values())}")
    _refuse_equal(list(good.values()))
    if model is not None:
        if model.faces is None:
            raise MeshError("The model has no triangles, and a template needs them; leave it out, or give another.")
        points = model.landmarks.positions(model.mean_vertices)
        mesh, why = (
            Mesh(model.mean_vertices, model.faces, points, "mean"),
            "The template is the mean of the model given.",
        )
    elif template is not None:
        mesh, why = without_astray(given(template)), f"{template.name} was given as the template."
    else:
        mesh, why = _chosen(good, settings)
    scale = SIZE / rms_size(mesh.vertices)
    T = Similarity(scale, np.eye(3), -scale * mesh.vertices.mean(axis=0))
    points = {name: T.apply(point) for name, point in mesh.landmarks.items()}
    mesh = mesh.with_vertices(T.apply(mesh.vertices), points)
    if unlike_most(mesh, good.values(), settings.landmark_uncertainty):
        mesh = mesh.with_vertices(mesh.vertices, {})
        why += " Its landmarks contradict those of most scans, so the first round goes without them."
    return First(
        mesh,
        why,
        good,
        broken,
        None if model is None else _moved(model, T),
    )


def _chosen(good: Mapping[int, Mesh], settings: CorrespondSettings) -> tuple[Mesh, str]:
    """Return the scan nearest to the others, meshed evenly, and why it is that one."""
    choice = choose(list(good.values()), settings.seed)
    chosen = good[list(good)[choice.index]]
    even = resampled(clean(chosen), settings.vertices)
    why = (
        f"{chosen.name} is the first template: of {np.isfinite(choice.nearness).sum()} candidates it lies nearest "
        f"to the others, {100 * choice.nearness[choice.index]:.1f} % of its size off after a smooth change."
    )
    return even.with_vertices(even.vertices, chosen.landmarks), why


def _moved(model: ShapeModel, T: Similarity) -> ShapeModel:
    """Return `model` with its frame moved by `T`, which does not turn."""
    return ShapeModel(
        T.apply(model.mean_vertices).ravel(), model.vertex_basis, T.scale * model.stddev,
        T.scale**2 * model.total_variance, model.n_training, faces=model.faces,
    )  # fmt: skip


def correspond(
    scans: Sequence[Mesh],
    settings: CorrespondSettings | None = None,
    *,
    template: Mesh | None = None,
    model: ShapeModel | None = None,
    first: First | None = None,
    run: Runner = run_here,
) -> Correspondence:
    """Bring raw `scans` into correspondence: any pose, size and triangles, holes allowed, no landmarks.

    Args:
        scans: of one kind of object; landmarks that they have are soft constraints, but for those far off the scan.
        settings: how.
        template: the surface that the first round goes by, as it is; None chooses a scan and meshes it evenly.
        model: of such objects; its mean is the template, and its fit to a scan is where the first round begins.
        first: what `first_template` made of these scans, where it was called already.
        run: does the tasks of a round.

    Raises:
        InputError: fewer than two scans, scans that are all equal, or too few that can be reached.
        MeshError: no scan can be a template, or the template is none.
    """
    scans = list(as_meshes(scans, "correspond"))
    settings = settings or CorrespondSettings()
    first = first or first_template(scans, template, settings, model)
    state = _State([scan.name for scan in scans], first, settings)
    for _ in range(settings.rounds):
        if state.take(run(state.bench(), state.tasks())) < settings.settled:
            break
    return state.result(first.why)


def _repaired(scans: Sequence[Mesh]) -> tuple[dict[int, Mesh], dict[int, str]]:
    good: dict[int, Mesh] = {}
    broken: dict[int, str] = {}
    for i, scan in enumerate(scans):
        try:
            good[i] = without_astray(repair(scan)[0])
        except MeshError as error:
            broken[i] = f"broken: {error}"
    return good, broken


def _refuse_equal(scans: Sequence[Mesh]) -> None:
    if len(copies(scans)) == len(scans) - 1:
        raise InputError("All scans are equal, so there is nothing to bring into correspondence; give different ones.")


class _State:
    """What the rounds know: the template, and where each scan is."""

    def __init__(self, names: Sequence[str], first: First, settings: CorrespondSettings) -> None:
        self.names, self.scans, self.settings = list(names), first.repaired, settings
        self.broken, self.reasons = first.broken, dict(first.broken)
        self.template, self.guide = first.mesh, first.guide
        self.harmonics = Harmonics.of(first.mesh, settings.first.harmonics)
        self.places = place_landmarks(first.mesh, first.mesh.landmarks)
        self.mirror = (
            Mirror.of(first.mesh, self.harmonics, settings.first, settings.seed) if settings.symmetric else None
        )
        self.placed: dict[int, Placed] = {}
        self.expected: dict[int, FloatArray] = {}
        self.moved: list[float] = []
        self.moves: dict[int, list[float]] = {i: [] for i in first.repaired}
        self.seconds: dict[int, list[float]] = {i: [] for i in first.repaired}

    def tasks(self) -> list[PlaceTask]:
        """Return what is to be done in the next round: all scans, those that were set aside from anywhere."""
        return [self._task(i) for i in self.scans]

    def bench(self) -> Workbench:
        """Return what its tasks share."""
        order = sorted(self.placed)
        if len(order) < ENOUGH_TO_JUDGE:
            guide = None if self.placed else self.guide
            glance = Glance.of(self.template) if guide is None else Glance(guide)
            return Workbench(self.template, self.harmonics, (glance,), self.settings.seed, guide)
        shapes, parts = self._stacked(order)[0], np.array([self._part(i) for i in order])
        glances = tuple(Glance.of(self.template, shapes[parts != part]) for part in range(_PARTS))
        return Workbench(self.template, self.harmonics, glances, self.settings.seed)

    def take(self, ended: Iterable[Placed]) -> float:
        """Take what came of a round; return by how much vertices moved (RMS), as a share of the size."""
        last, self.placed, self.reasons = self.placed, {}, dict(self.broken)
        for placed in sorted(ended, key=lambda one: one.index):
            self.seconds[placed.index].append(placed.seconds)
            if reason := self._why_not(placed, first=placed.index not in last):
                self.reasons[placed.index] = reason
            else:
                self.placed[placed.index] = placed
        self._set_strange_aside([i for i in sorted(self.placed) if not self.placed[i].rivals])
        self._settle_rivals()
        self._set_strange_aside(sorted(self.placed))
        if len(self.placed) < FEWEST:
            why = "; ".join(f"{self.names[i]}: {reason}" for i, reason in list(self.reasons.items())[:3])
            raise InputError(f"Only {len(self.placed)} of {len(self.names)} scans could be reached: {why}.")
        moved = self._agree(last)
        self.moved.append(moved)
        return moved

    def _part(self, i: int) -> int:
        """Return the part of the scans that number `i` belongs to; the glance of that part knows nothing of it."""
        return i % _PARTS

    def _task(self, i: int) -> PlaceTask:
        part = self._part(i) if len(self.placed) >= ENOUGH_TO_JUDGE else 0
        marks = Marks.shared(self.places, self.scans[i], self.settings.landmark_uncertainty)
        if i not in self.placed:
            return PlaceTask(i, self.scans[i], None, None, self.settings.first, part, marks)
        return PlaceTask(i, self.scans[i], self._sized(i), self.expected.get(i), self.settings.next, part, marks)

    def _sized(self, i: int) -> Similarity:
        """Return the pose of a scan, its size as the others have it where it shows too little to tell its own.

        A bone without its end fits a smaller whole one, so what it says of its size counts by what it shows.
        """
        T, seen = self.placed[i].T_scan_template, self.placed[i].seen
        order = sorted(self.placed)
        whole = np.array([self.placed[j].seen.mean() > _WHOLE for j in order])
        if seen.mean() > _WHOLE or whole.sum() < _ENOUGH_TO_SETTLE:
            return T
        logs = np.log(unit_ratios([self.placed[j].T_scan_template.scale for j in order])[0])
        usual = float(np.median(logs[whole]))
        spread = max(float(np.std(logs[whole])), _LEAST_SPREAD)
        own = logs[order.index(i)]
        trust = 1.0 / (1.0 + (_SIZE_UNSEEN * (1.0 - seen.mean()) / spread) ** 2)
        ratio = float(np.exp((1.0 - trust) * (usual - own)))
        centre = T.apply(self.placed[i].vertices[seen]).mean(axis=0)
        return Similarity(ratio, np.eye(3), (1.0 - ratio) * centre) @ T

    def _why_not(self, placed: Placed, *, first: bool) -> str:
        s = self.settings
        if placed.reason:
            return placed.reason
        if first and not s.symmetric and placed.mirrored < _MIRRORED:
            return (
                f"mirrored: its mirror image lies {placed.mirrored:.2f} times as far from the template as itself; turn "
                "it over, or do such scans on their own"
            )
        if placed.covered < s.fewest_covered:
            return (
                f"surface not reached: the template covers {100 * placed.covered:.0f} % of it; another object, or "
                f"one with much beside it{self._doubt(placed)}"
            )
        if placed.seen.mean() < s.fewest_seen:
            return f"half missing: it shows {100 * placed.seen.mean():.0f} % of the template"
        return ""

    def _doubt(self, placed: Placed) -> str:
        """Return what else may be wrong with a scan whose pose its landmarks tell."""
        return "; or its landmarks, which determine its pose, have wrong names" if placed.by_landmarks else ""

    def _settle_rivals(self) -> None:
        """Where several poses were about as likely, take the one whose shape the scans of sure pose tell best."""
        sure = [i for i in sorted(self.placed) if not self.placed[i].rivals]
        if len(sure) < _ENOUGH_TO_SETTLE:
            return
        shapes, seen = self._stacked(sure)
        others = Others.of(aligned(shapes, seen, self.template.vertices)[0], self.settings.noise_share)
        for i, placed in self.placed.items():
            if placed.rivals:
                self.placed[i] = min(
                    (placed, *placed.rivals), key=lambda one: others.apart(one.vertices, one.seen.astype(np.float64))
                )

    def _set_strange_aside(self, order: Sequence[int]) -> None:
        """Set aside what is like no other in `order`, measured by what the others say of it."""
        if len(order) < ENOUGH_TO_JUDGE:
            return
        shapes, seen = self._stacked(order)
        shapes, _ = aligned(shapes, seen, self.template.vertices)
        predicted = predict_leave_one_out(shapes, seen, self.settings.noise_share)
        apart = ((shapes - predicted) ** 2).sum(axis=2)
        rms = np.sqrt((seen * apart).sum(axis=1) / np.maximum(seen.sum(axis=1), 1))
        usual = float(np.median(rms))
        for i, value in zip(order, rms, strict=True):
            if value > self.settings.strange * usual:
                self.reasons[i] = (
                    f"another object, or wrongly placed: {value / usual:.1f} times as far as usual from what the other "
                    f"scans say of it{self._doubt(self.placed[i])}"
                )
                del self.placed[i]

    def _stacked(self, order: Sequence[int]) -> tuple[FloatArray, FloatArray]:
        shapes = np.stack([self.placed[i].vertices for i in order])
        return shapes, np.stack([self.placed[i].seen for i in order]).astype(np.float64)

    def _agree(self, last: dict[int, Placed]) -> float:
        """Make the mean of the round the template, and say what the others expect of each."""
        order = sorted(self.placed)
        shapes, seen = self._stacked(order)
        shapes, mean = aligned(shapes, seen, self.template.vertices)
        images = None
        if self.mirror is not None:
            images = np.stack([self.mirror.image(shape) for shape in shapes])
            shown = np.concatenate([seen, self.mirror.shown(seen)])
            both, mean = aligned(np.concatenate([shapes, images]), shown, mean)
            shapes, images = np.split(both, 2)
        squares: list[float] = []
        for i, shape in zip(order, shapes, strict=True):
            now = self.placed[i]
            T = now.T_scan_template @ fit_similarity(shape, now.vertices)
            before = last[i].vertices if i in last else np.array(self.template.vertices)
            square = float(((fit_similarity(before, shape).apply(before) - shape) ** 2).sum(axis=1).mean())
            squares.append(square)
            self.moves[i].append(float(np.sqrt(square)) / SIZE)
            self.placed[i] = replace(now, vertices=shape, T_scan_template=T)
        if self.settings.guided and len(order) >= _ENOUGH_TO_SETTLE:
            predicted = predict_leave_one_out(shapes, seen, self.settings.noise_share, images)
            self.expected = dict(zip(order, predicted, strict=True))
        self.template = Mesh(mean, self.template.faces, name=self.template.name)
        self.places = agreed(self.template, [(self.placed[i].vertices, self._landmarks(i)) for i in order])
        return float(np.sqrt(np.mean(squares))) / SIZE

    def _landmarks(self, i: int) -> dict[str, FloatArray]:
        """Return the landmarks of a scan that is placed, in the template's frame."""
        back = self.placed[i].T_scan_template.inverse()
        return {name: back.apply(point) for name, point in self.scans[i].landmarks.items()}

    def result(self, why: str) -> Correspondence:
        """Return the scans with what is known of each."""
        complete = self._completed()
        scans = [self._ended(i, complete.get(i)) for i in range(len(self.names))]
        points = self.places.positions(self.template.vertices)
        template = self.template.with_vertices(self.template.vertices, points)
        landmarks = replace(self.places, distance_mm=np.empty(0))  # places on a mean have no given point
        return Correspondence(template, tuple(scans), why, tuple(self.moved), landmarks)

    def _completed(self) -> dict[int, FloatArray]:
        """Return the vertices (V, 3) of each placed scan, in the template's frame, with estimates where not observed.

        An estimate is the conditional mean by probabilistic PCA of all placed scans. A vertex that fewer than
        `FEWEST` scans show, and any vertex of too few scans for a model, stays where the registration has put it.
        """
        order = sorted(self.placed)
        seen = np.stack([self.placed[i].seen for i in order])
        shapes = np.stack([self.placed[i].vertices for i in order])
        learnt = seen.sum(axis=0) >= FEWEST
        if not seen[:, learnt].all() and len(order) >= _ENOUGH_TO_SETTLE:
            masked = np.where(seen[:, learnt, None], shapes[:, learnt], np.nan)
            shapes[:, learnt] = with_estimates(masked, [self.names[i] for i in order])
        return dict(zip(order, shapes, strict=True))

    def _ended(self, i: int, complete: FloatArray | None) -> Corresponding:
        moves, seconds = tuple(self.moves.get(i, ())), tuple(self.seconds.get(i, ()))
        if complete is None:
            return Corresponding(self.names[i], self.reasons[i], moved=moves, seconds=seconds)
        placed = self.placed[i]
        T = placed.T_scan_template
        vertices = T.apply(complete)
        marks = Marks.shared(self.places, self.scans[i], self.settings.landmark_uncertainty)
        off = np.nan if marks is None else marks.rms(vertices)
        mean, p95, p99, largest = (T.scale * length for length in placed.distance)
        return Corresponding(
            self.names[i], "", vertices, T, float(placed.seen.mean()), placed.covered, (mean, p95, p99, largest), moves,
            seconds, off, placed.seen,
        )  # fmt: skip
