"""Are wrong surfaces doubtful, and right ones not? The weights of the status (C33) are trained here.

    python benchmarks/scan_status.py --jobs 2            collections of simulated kinds, real and modelled objects
    python benchmarks/scan_status.py mirror --kinds 20   20 kinds, of which two to five of twelve scans are mirrored
    python benchmarks/scan_status.py trusted             `mirror="never"`: one mirrored, two of a similar other kind
    python benchmarks/scan_status.py --fit               trains on all, with each collection left out in turn

A kind is an ellipsoid with two to six bumps and a bend, which vary between its scans. A surface is wrong if the mean
distance of its vertices from the median places, carried to the mean, is above 25 % of the size, or if its side or kind
is; it is right below 10 %. Molars (SHAPESPACE_DATA) have landmarks of observers. Of real objects of one side, two of
fourteen are reflected and the files are trusted; only their sides are judged.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from multiprocessing import get_context

import numpy as np
from kinds import files
from landmark_transfer import molar_landmarks
from mirrored import molars
from scipy.optimize import minimize
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from correspondence import faces, femora
from shapespace.correspondence.correspondence_result import Correspondence
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.datasets.simulated_scan import random_similarity
from shapespace.geometry.closest import build_engine
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.geometry.normals import rms_size
from shapespace.types import FloatArray, Mesh

SCANS, POINTS = 12, 1500
VARIATION = (0.5, 1.0, 0.7)
"""Variation between the scans of a kind, in turn."""
RIGHT, WRONG = 0.1, 0.25


@dataclass(frozen=True, eq=False)
class Known:
    """A scan, the true surface below it, the places of its vertices on the mean, and whether it belongs there."""

    scan: Mesh
    truth: Mesh
    places: FloatArray
    mirrored: bool = False
    foreign: bool = False


@dataclass(frozen=True, eq=False)
class Row:
    """A surface in correspondence: of which collection, its error as a share of the size, and its evidence."""

    collection: str
    error: float
    features: tuple[float, ...]
    is_doubtful: bool


class Kind:
    """A random kind of object; `other` has the same numbers and its bumps in other places."""

    def __init__(self, seed: int, variation: float, other: bool = False) -> None:
        rng = np.random.default_rng([seed, 991])
        self.axes, count = np.exp(rng.uniform(-0.45, 0.45, 3)) * 80, rng.integers(2, 7)
        self.centres = rng.standard_normal((count, 3))
        self.heights = rng.uniform(0.15, 0.6, count) * rng.choice([1, 1, -0.5], count)
        self.widths = np.exp(rng.uniform(np.log(0.03), np.log(0.25), count))
        self.bend, self.variation = rng.uniform(-0.5, 0.5, 2), variation
        if other:
            self.centres = np.random.default_rng([seed, 7]).standard_normal((count, 3))
        self.centres /= np.linalg.norm(self.centres, axis=1, keepdims=True)

    def surface(self, directions: FloatArray, rng: np.random.Generator | None = None) -> FloatArray:
        """Return the points (M, 3) of a random shape in `directions`, or of the mean shape."""
        v = 0.0 if rng is None else self.variation
        g = np.zeros if rng is None else rng.standard_normal
        centres = self.centres + 0.08 * v * g(self.centres.shape)
        centres /= np.linalg.norm(centres, axis=1, keepdims=True)
        heights = self.heights * (1 + 0.25 * v * g(len(centres)))
        widths = self.widths * np.exp(0.15 * v * g(len(centres)))
        radius = 1 + (heights * np.exp((directions @ centres.T - 1) / widths)).sum(axis=1)
        x = radius[:, None] * directions * self.axes * np.exp(0.07 * v * g(3))
        bend = (self.bend + 0.12 * v * g(2)) / self.axes.max()
        x[:, 0] += bend[0] * x[:, 2] ** 2
        x[:, 1] += 0.5 * bend[1] * x[:, 0] ** 2
        return x

    def scan(self, rng: np.random.Generator, name: str, mean: Kind | None = None) -> Known:
        """Return a scan of it in any pose, with its places on the `mean` of another kind or on its own."""
        i = np.arange(POINTS)
        z, angle = 1 - (2 * i + 1) / POINTS, np.pi * (3 - np.sqrt(5)) * i
        d = np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1)
        d = d @ Rotation.random(random_state=int(rng.integers(2**31))).as_matrix().T
        corners = ConvexHull(d).simplices
        a, b, c = (d[corners[:, k]] for k in range(3))
        inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
        corners[inward] = corners[inward][:, ::-1]
        x, triangles = self.surface(d, rng), corners.astype(np.int32)
        T, noise = random_similarity(rng, 180.0), 0.002 * rms_size(x) * rng.standard_normal(x.shape)
        truth = Mesh(T.apply(x), triangles)
        return Known(Mesh(T.apply(x + noise), triangles, name=name), truth, (mean or self).surface(d))


def mirrored(one: Known) -> Known:
    """Return the mirror image of a scan."""
    return Known(mirror_image(one.scan), mirror_image(one.truth), one.places, mirrored=True, foreign=one.foreign)


def simulated(seed: int, mode: str) -> list[Known]:
    """Return the scans of a kind with mirrored ones, and in mode `trusted` with two of another kind."""
    kind = Kind(seed, VARIATION[seed % 3])
    rng, draw = np.random.default_rng([seed, 5]), np.random.default_rng([seed, 3])
    known = [kind.scan(rng, f"scan{k}") for k in range(SCANS)]
    if mode == "mirror":
        reflected = set(draw.permutation(SCANS)[: draw.integers(2, 6)].tolist())
        return [mirrored(one) if k in reflected else one for k, one in enumerate(known)]
    other = Kind(seed, kind.variation, other=True)
    foreign = [other.scan(rng, f"foreign{k}", kind) for k in range(2)]
    foreign = [Known(one.scan, one.truth, one.places, foreign=True) for one in foreign]
    return [mirrored(known[0]), *foreign, *known[3:]]


def errors(made: Correspondence, known: list[Known]) -> FloatArray:
    """Return (N,) mean distances from the median places, shares of the size; not-a-number for excluded scans."""
    places = np.full((len(known), len(made.template.vertices), 3), np.nan)
    for k, (one, true) in enumerate(zip(made.scans, known, strict=True)):
        if one.vertices is not None:
            near = build_engine(true.truth).query(np.ascontiguousarray(one.vertices))
            corners = true.places[np.asarray(true.truth.faces)[near.triangle]]
            places[k] = np.einsum("mc,mcd->md", near.barycentric, corners)
    middle = np.nanmedian(places, axis=0)
    return np.linalg.norm(places - middle, axis=2).mean(axis=1) / rms_size(middle)


def molar_errors(made: Correspondence) -> FloatArray:
    """Return the same of molars, by the observers' landmarks."""
    truth, places = molar_landmarks(), np.full((len(made.scans), 16, 3), np.nan)
    for k, one in enumerate(made.scans):
        if one.vertices is not None:
            near = build_engine(Mesh(one.vertices, made.template.faces)).query(np.ascontiguousarray(truth[one.name]))
            corners = made.template.vertices[np.asarray(made.template.faces)[near.triangle]]
            places[k] = np.einsum("mc,mcd->md", near.barycentric, corners)
    apart = np.linalg.norm(places - np.nanmedian(places, axis=0), axis=2).mean(axis=1)
    return apart / rms_size(made.template.vertices)


def rows_of(name: str, made: Correspondence, error: FloatArray, known: list[Known]) -> list[Row]:
    """Return a row for each surface; the side that most scans have is right."""
    found = np.array([one.mirrored for one in made.scans])
    wrong = found != np.array([one.mirrored for one in known])
    wrong = ~wrong if wrong.mean() > 0.5 else wrong
    wrong |= np.array([one.foreign for one in known])
    return [
        Row(name, max(float(e), WRONG * float(w)), one.evidence.features(), one.status == "doubtful")
        for one, e, w in zip(made.scans, error, wrong, strict=True)
        if one.evidence is not None
    ]


def report(name: str, rows: list[Row]) -> None:
    """Print how many of the right and of the wrong surfaces are doubtful."""
    right = [row for row in rows if row.error < RIGHT]
    wrong = [row for row in rows if row.error >= WRONG]
    doubted = sum(row.is_doubtful for row in right)
    print(
        f"| {name} | {len(rows)} | {doubted} of {len(right)} | {sum(not row.is_doubtful for row in wrong)} of "
        f"{len(wrong)} |", flush=True,
    )  # fmt: skip


def fitted(features: FloatArray, wrong: FloatArray) -> FloatArray:
    """Return intercept and weights, none negative, of the logistic model."""

    def loss(w: FloatArray) -> float:
        z = w[0] + features @ w[1:]
        return float(np.logaddexp(0, -z * (2 * wrong - 1)).sum() + 0.1 * (w[1:] ** 2).sum())

    free = [(None, None), *([(0, None)] * features.shape[1])]
    return np.asarray(minimize(loss, np.r_[-4.0, np.ones(features.shape[1])], bounds=free).x)


def fit(rows: list[Row]) -> None:
    """Print the weights, and the shares of doubtful surfaces with each collection left out of the training."""
    clear = [row for row in rows if row.error < RIGHT or row.error >= WRONG]
    features, wrong = np.array([row.features for row in clear]), np.array([row.error >= WRONG for row in clear])
    print("weights:", fitted(features, wrong).round(2).tolist())
    collection, probability = np.array([row.collection for row in clear]), np.zeros(len(clear))
    for name in np.unique(collection):
        w = fitted(features[collection != name], wrong[collection != name])
        probability[collection == name] = 1 / (1 + np.exp(-w[0] - features[collection == name] @ w[1:]))
    for limit in (0.1, 0.2, 0.3):
        doubtful = probability > limit
        print(
            f"above {limit}: {doubtful[~wrong].mean():.3f} of right ones, {(~doubtful[wrong]).mean():.3f} of wrong not"
        )


MODELLED = {
    "femora": lambda: femora(14, 3), "cut-femora": lambda: femora(16, 4, cut_every=4),
    "faces": lambda: faces(12, 5), "damaged-faces": lambda: faces(12, 6, harm=True),
    "expressions": lambda: faces(18, 7, expressive=True),
}  # fmt: skip
ONE_SIDE = {"spleens": ("spleens", "*.ply"), "right-molars": ("molars", "*.off")}


def measured(collection: tuple[str, int, int]) -> list[Row]:
    """Return the rows of a collection: its name, number, and vertices of its surfaces."""
    name, seed, vertices = collection
    config = CorrespondConfig(vertices=vertices, rounds=2, seed=seed)
    if name in ("mirror", "trusted"):
        known = simulated(seed, name)
        made = correspond([one.scan for one in known], replace(config, mirror="auto" if name == "mirror" else "never"))
        return rows_of(f"{name} {seed}", made, errors(made, known), known)
    if name in ONE_SIDE:
        scans = files(*ONE_SIDE[name])
        drawn = np.random.default_rng(seed).permutation(len(scans))[:14].tolist()
        known = [Known(scans[i], scans[i], scans[i].vertices) for i in drawn]
        known = [mirrored(one) if k < 2 else one for k, one in enumerate(known)]
        made = correspond([one.scan for one in known], replace(config, mirror="never"))
        return rows_of(f"{name} {seed}", made, np.zeros(len(known)), known)
    if name == "molars":
        scans, is_mirrored = molars(0)
        known = [Known(one, one, one.vertices, mirrored=bool(m)) for one, m in zip(scans, is_mirrored, strict=True)]
        made = correspond(scans, config)
        return rows_of(name, made, molar_errors(made), known)
    of = MODELLED[name]()
    known = [Known(one.scan, Mesh(one.truth, of.mean.faces), of.mean.vertices) for one in of.known]
    made = correspond([one.scan for one in known], config)
    return rows_of(name, made, errors(made, known), known)


def main() -> None:
    """Print a row for each collection."""
    sets = ["mirror", "trusted", "molars", *MODELLED, *ONE_SIDE]
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", choices=[*sets, []], default=[])
    parser.add_argument("--kinds", type=int, default=12)
    parser.add_argument("--first", type=int, default=0, help="number of the first kind")
    parser.add_argument("--vertices", type=int, default=400)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--fit", action="store_true")
    arguments = parser.parse_args()
    numbers = range(arguments.first, arguments.first + arguments.kinds)
    collections = [
        (name, k, arguments.vertices)
        for name in arguments.sets or sets
        for k in (numbers if name in ("mirror", "trusted") else [1, 2] if name in ONE_SIDE else [0])
    ]
    every: list[Row] = []
    print("| collection | surfaces | right ones doubtful | wrong ones converged |\n|---|---|---|---|")
    with get_context("spawn").Pool(arguments.jobs) as pool:
        for rows in pool.imap(measured, collections):
            report(rows[0].collection, rows)
            every += rows
    report("all", every)
    if arguments.fit:
        fit(every)


if __name__ == "__main__":
    main()
