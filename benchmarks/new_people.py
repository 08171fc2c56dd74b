"""Compare rules for how much new people vary along the modes of a few: the likelihood of people who took no part.

Each figure is what a normal distribution with a rule's variances loses in log-likelihood, in nats a new person over all
modes that hold 0.99999 of the variance, against one with the true variances along them; the mean of the seeds.
The last column is what is left outside the modes by those left out, over what new people have there.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import h5py
import numpy as np
from scipy.optimize import isotonic_regression

from shapespace.datasets.faces import load_faces
from shapespace.datasets.ict import load_ict
from shapespace.geometry.mirror_plane import FLIP
from shapespace.model.new_shapes import held_out_shapes, variances_of_new_shapes
from shapespace.model.pca import modes_for_variance
from shapespace.types import FloatArray

PEOPLE = (10, 20, 30, 45, 60, 75, 100, 150)
NEW = 600
SHARE = 0.99999
_STRIDE = 20
RULES = ("sample", "probabilistic PCA", "left out alone", "spectrum", "both")
Draw = Callable[[np.random.Generator, int], FloatArray]
"""Returns (n, copies, D): shapes of n people, each with its mirror image where there are two copies."""


def kinds(femur: Path | None) -> Mapping[str, Draw]:
    """Return what is drawn, by name: every 20th vertex will do, since only inner products count."""
    ict, faces = load_ict(), load_faces()
    other = ict.mirror
    modes = ict.identity[:, : ict.face_vertices]
    both = np.stack([modes[:, ::_STRIDE], (modes[..., other, :] * FLIP)[:, ::_STRIDE]])

    def draw_ict(rng: np.random.Generator, n: int) -> FloatArray:
        return (rng.standard_normal((n, len(modes))) @ both[0].reshape(len(modes), -1))[:, None]

    def draw_pairs(rng: np.random.Generator, n: int) -> FloatArray:
        return np.einsum("nk,ckd->ncd", rng.standard_normal((n, len(modes))), both.reshape(2, len(modes), -1))

    def draw_faces(rng: np.random.Generator, n: int) -> FloatArray:
        people = [faces.face(faces.draw_person(rng)).vertices[::_STRIDE] for _ in range(n)]
        return np.stack(people).reshape(n, 1, -1)

    found: dict[str, Draw] = {"ICT": draw_ict, "ICT, mirrored": draw_pairs, "bundled faces": draw_faces}
    if femur is not None:
        with h5py.File(femur) as file:
            spread = np.sqrt(np.asarray(file["model/pcaVariance"]))
        found["femora"] = lambda rng, n: (rng.standard_normal((n, len(spread))) * spread)[:, None]
    return found


def compare(draw: Draw, people: int, seed: int) -> tuple[list[float], float]:
    """Return what each of `RULES` loses, and what is left outside over the truth."""
    rng = np.random.default_rng((people, seed))
    drawn, new = draw(rng, people), draw(rng, NEW)
    shapes, others = drawn.reshape(-1, drawn.shape[2]), new.reshape(-1, new.shape[2])
    mean = shapes.mean(axis=0)
    _, size, rows = np.linalg.svd(shapes - mean, full_matrices=False)
    spectrum = size**2 / (len(shapes) - 1)
    k = min(modes_for_variance(spectrum, SHARE), len(shapes) - 1)
    sample, total, whole = spectrum[:k], float(spectrum.sum()), spectrum[spectrum > 1e-10 * spectrum[0]]
    along = (others - mean) @ rows[:k].T
    true = (along**2).mean(axis=0)
    outside = float(((others - mean) ** 2).sum(axis=1).mean() - true.sum())
    groups = [str(person) for person in range(people) for _ in range(drawn.shape[1])]
    held = held_out_shapes((shapes - mean) @ (shapes - mean).T, groups, k, centred=True)
    seen = held.seen > 0
    alone = np.maximum(np.interp(np.arange(k), np.flatnonzero(seen), (held.squares[seen] / held.seen[seen])), 1e-12)
    floor = sample.copy()
    floor[k // 2 :] = sample[k // 2 :].mean()
    found = (
        sample,
        floor,
        isotonic_regression(alone / len(shapes), increasing=False).x,
        variances_of_new_shapes(whole, total, len(shapes))[:k],
        variances_of_new_shapes(whole, total, len(shapes), held),
    )
    lost = [float((0.5 * (true / v - 1 - np.log(true / v))).sum()) for v in found]
    return lost, held.left_mm2 / outside if outside > 1e-4 * total else float("nan")


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--people", type=int, nargs="+", default=PEOPLE)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--femur", type=Path, help="femur_gp_model_50-components.h5, for a kind that is no face")
    options = parser.parse_args(arguments)
    print("| shapes | people | " + " | ".join(RULES) + " | left outside |")
    print("|---|---|" + "---|" * (len(RULES) + 1))
    for name, draw in kinds(options.femur).items():
        for people in options.people:
            runs = [compare(draw, people, seed) for seed in range(options.seeds)]
            lost = np.mean([run[0] for run in runs], axis=0)
            left = float(np.mean([run[1] for run in runs]))
            cells = [f"{value:.2f}" for value in lost] + ["" if np.isnan(left) else f"{left:.2f}"]
            print(f"| {name} | {people} | " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
