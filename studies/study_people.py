"""People of ICT-FaceKit who each show six expressions in their own way, and raw scans of them: a recognition study.

How an expression is made differs from person to person, as it does in life: units are stronger or weaker, another
expression is blended in, and no face is ever quite at rest. So even the true unit weights do not tell all expressions
apart, and what a classifier on them reaches is the ceiling of any that sees only surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from shapespace.datasets.ict import EXPRESSIONS, IctFaces
from shapespace.datasets.simulated_scan import Hole, SimulatedScan, random_similarity, simulate_scan
from shapespace.errors import InputError
from shapespace.types import FloatArray, Mesh

SIX_EXPRESSIONS = ("anger", "disgust", "fear", "smile", "sadness", "surprise")
_HOLE_MM = (8.0, 22.0)


@dataclass(frozen=True)
class StudyPeople:
    """Who is scanned, what they show, and how; the same numbers give the same scans whatever is made first.

    Args:
        people: how many; the first are the same whatever their number.
        expressions: names of `ict.EXPRESSIONS`, without neutral.
        levels: intensities of each.
        seed: of everything.
        style: standard deviation of the logarithm of each unit's strength, from person to person.
        blend: the largest share of another expression in a person's own way of showing one.
        take: standard deviation of the logarithm of each unit's strength, from scan to scan.
        resting: standard deviation of the units of a face at rest, of which the positive half is drawn.
        triangles: of a whole scan.
        noise_mm: along the normals.
        missing: share of the vertices cut away, in one to three round holes.
        max_angle_deg: largest angle of the random pose.

    Raises:
        InputError: numbers out of range, or unknown expressions.
    """

    people: int = 100
    expressions: tuple[str, ...] = SIX_EXPRESSIONS
    levels: tuple[float, ...] = (0.25, 0.5, 0.75, 1.0)
    seed: int = 2007
    style: float = 0.40
    blend: float = 0.45
    take: float = 0.10
    resting: float = 0.02
    triangles: int = 8_000
    noise_mm: float = 0.5
    missing: float = 0.10
    max_angle_deg: float = 180.0

    def __post_init__(self) -> None:
        unknown = [name for name in self.expressions if name == "neutral" or name not in EXPRESSIONS]
        if unknown or len(set(self.expressions)) < len(self.expressions) or not self.expressions:
            raise InputError(f"The expressions of a study must be different names of {', '.join(SIX_EXPRESSIONS)}.")
        if not self.levels or not all(0 < level <= 1 for level in self.levels):
            raise InputError(f"The intensities of a study must lie above 0 and at most at 1, not at {self.levels}.")
        if self.people < 1 or not 0 <= self.missing <= 0.5 or not 0 <= self.blend < 1:
            raise InputError("A study needs people, at most half of each scan missing, and a blend below 1.")

    @property
    def shown(self) -> tuple[tuple[str, float], ...]:
        """What each person shows: neutral, then each expression at each level."""
        return (("neutral", 0.0), *((name, level) for name in self.expressions for level in self.levels))

    def subject(self, person: int) -> str:
        """Return what a person is called."""
        return f"person_{person:03d}"

    def name(self, person: int, shown: int) -> str:
        """Return what a scan is called."""
        expression, level = self.shown[shown]
        return f"{self.subject(person)}_{expression}" + (f"_{round(100 * level):03d}" if level else "")

    def unit_weights(self, ict: IctFaces, person: int) -> FloatArray:
        """Return the true weights (S, 57) of the expression units in each of a person's scans."""
        rng = np.random.default_rng((self.seed, 1, person))
        recipes = {name: self._recipe(ict, name) for name in self.expressions}
        own: dict[str, FloatArray] = {}
        for name in self.expressions:
            others = [other for other in self.expressions if other != name]
            share = self.blend * rng.uniform() if others else 0.0
            other = recipes[others[rng.integers(len(others))]] if others else recipes[name]
            strength = np.exp(self.style * _on_both_sides(ict, rng))
            own[name] = strength * ((1 - share) * recipes[name] + share * other)
        rows: list[FloatArray] = []
        for name, level in self.shown:
            # Units that pull against each other, such as a jaw that shifts both ways, are not at rest but left alone.
            used = np.max(list(recipes.values()), axis=0) > 0
            row = self.resting * np.abs(_on_both_sides(ict, rng)) * used
            if level:
                row = row + level * own[name] * np.exp(self.take * _on_both_sides(ict, rng))
            rows.append(np.clip(row, 0.0, 1.2))
        return np.stack(rows)

    def faces(self, ict: IctFaces, person: int, *, coefficients: FloatArray | None = None) -> list[Mesh]:
        """Return the true surfaces of a person, one for each of `shown`, in correspondence, in mm.

        Args:
            ict: the face model.
            person: counted from 0.
            coefficients: (I,) of the person; None draws those of this study.
        """
        who = ict.draw_people(person + 1, self.seed)[person] if coefficients is None else coefficients
        neutral = ict.mesh(who)
        count = len(neutral.vertices)
        weights = self.unit_weights(ict, person)
        moved = np.tensordot(weights, ict.expression[:, :count], axes=1)
        return [
            ict_mesh_like(neutral, neutral.vertices + change, self.name(person, k)) for k, change in enumerate(moved)
        ]

    def scan(self, face: Mesh, person: int, shown: int) -> SimulatedScan:
        """Return a raw scan of one of a person's faces: other triangles, any pose, noise, holes."""
        return self.raw_scan(face, np.random.default_rng((self.seed, 2, person, shown)), self.name(person, shown))

    def raw_scan(self, face: Mesh, rng: np.random.Generator, name: str) -> SimulatedScan:
        """Return a raw scan of any face, under `name`, made as those of these people are."""
        pose = random_similarity(rng, self.max_angle_deg, (0.9, 1.1))
        return simulate_scan(
            face,
            rng,
            triangles=self.triangles,
            noise_mm=self.noise_mm,
            T_scan_model=pose,
            holes=holes_of(face, self.missing, rng),
            split=False,
            name=name,
        )

    def _recipe(self, ict: IctFaces, name: str) -> FloatArray:
        row = np.zeros(len(ict.expression_names))
        for unit, weight in EXPRESSIONS[name].items():
            row[ict.expression_names.index(unit)] = weight
        return row


def ict_mesh_like(neutral: Mesh, vertices: FloatArray, name: str) -> Mesh:
    """Return `vertices` with the triangles of `neutral`, under `name`."""
    return Mesh(vertices, neutral.faces, name=name)


def holes_of(face: Mesh, missing: float, rng: np.random.Generator) -> Sequence[Hole]:
    """Return balls that together cut about the share `missing` of the vertices away."""
    gone = np.zeros(len(face.vertices), dtype=np.bool_)
    holes: list[Hole] = []
    while gone.mean() < missing:
        center = face.vertices[rng.integers(len(face.vertices))]
        distance = np.linalg.norm(face.vertices - center, axis=1)
        radius = float(rng.uniform(*_HOLE_MM))
        # The last hole is made no larger than it has to be.
        left = round(missing * len(gone)) - int(gone.sum())
        open_to = np.sort(distance[~gone])
        radius = min(radius, float(open_to[min(left, len(open_to) - 1)]) + 1e-3)
        holes.append(Hole(radius, center))
        gone |= distance <= radius
    return holes


def _on_both_sides(ict: IctFaces, rng: np.random.Generator) -> FloatArray:
    """Return normal values (57,), alike on both sides of the face but for a little."""
    names = ict.expression_names
    shared = {name.removesuffix("_L").removesuffix("_R"): rng.standard_normal() for name in names}
    stems = [name.removesuffix("_L").removesuffix("_R") for name in names]
    return np.array([shared[stem] for stem in stems]) + 0.25 * rng.standard_normal(len(names))
