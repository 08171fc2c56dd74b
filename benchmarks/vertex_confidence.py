"""How many true positions are in the 90 % regions of the vertices, and does `position_std` rank the errors?

    python benchmarks/vertex_confidence.py                       all sets, an hour
    python benchmarks/vertex_confidence.py ict molars --vertices 1500

The error of a vertex of a scan is the distance, on the mean, of its true place from the median place of the same vertex
on all scans, as in `correspondence.py`; of molars (SHAPESPACE_DATA), that of the 16 landmarks of observers. A region
contains it if it is within 2.146 times `position_std`. All in percent of the RMS size. `rank` is the rank correlation
of error and `position_std` within a scan (molars: over all), `deciles` the mean error of the least certain tenth
divided by that of the most certain tenth.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from landmark_transfer import molar_landmarks
from mirrored import molars
from scipy.stats import spearmanr

from correspondence import Set, faces, femora
from shapespace.correspondence.correspondence_result import Correspondence
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.geometry.closest import build_engine
from shapespace.geometry.normals import rms_size
from shapespace.types import FloatArray, Mesh

sys.path.append(str(Path(__file__).resolve().parents[1] / "tests"))
from raw_blobs import raw_blob
from synthetic_shapes import blob

RADIUS = 2.146
"""Standard deviations that 90 % of the positions are within, for normal errors in two directions."""
SETS = {
    "ict": lambda scans, seed: faces(scans, seed),
    "bundled": lambda scans, seed: faces(scans, seed, "bundled"),
    "damaged": lambda scans, seed: faces(scans, seed, harm=True),
    "femora": lambda scans, seed: femora(scans, seed),
    "cut femora": lambda scans, seed: femora(scans, seed, cut_every=4),
}


def of_set(made: Correspondence, known: Set) -> list[tuple[FloatArray, FloatArray]]:
    """Return errors and standard deviations of each scan, percent of the size."""
    mean, places, share = known.mean, [], []
    assert mean.faces is not None
    for one, true in zip(made.scans, known.known, strict=True):
        if one.vertices is None or one.position_std is None:
            continue
        near = build_engine(Mesh(true.truth, mean.faces)).query(np.ascontiguousarray(one.vertices))
        places.append(np.einsum("mc,mcd->md", near.barycentric, mean.vertices[mean.faces[near.triangle]]))
        share.append(one.position_std / rms_size(one.vertices))
    middle = np.median(places, axis=0)
    inside = known.counted[build_engine(mean).query(middle).vertex]
    errors = np.linalg.norm(np.array(places) - middle, axis=2) / rms_size(middle)
    return [(100 * e[inside], 100 * s[inside]) for e, s in zip(errors, share, strict=True)]


def of_blobs(scans: int, config: CorrespondConfig) -> list[tuple[FloatArray, FloatArray]]:
    """Return the same of smooth blobs, whose poses are nearly known, since they can be registered turned over."""
    from shapespace.datasets.simulated_scan import random_similarity

    blobs = [raw_blob(k, T=random_similarity(np.random.default_rng(k), 10.0)) for k in range(scans)]
    made = correspond([one.scan for one in blobs], config)
    rows = [(b, one) for b, one in zip(blobs, made.scans, strict=True) if one.vertices is not None]
    at = np.array([b.directions_at(one.vertices) for b, one in rows])
    middle = np.median(at, axis=0)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    mean = blob(middle, np.zeros(5))
    errors = [np.linalg.norm(blob(a, np.zeros(5)) - mean, axis=1) / rms_size(mean) for a in at]
    return [
        (100 * e, 100 * one.position_std / rms_size(one.vertices)) for e, (_, one) in zip(errors, rows, strict=True)
    ]


def of_molars(made: Correspondence) -> list[tuple[FloatArray, FloatArray]]:
    """Return the same of the observers' landmarks, carried to the mean."""
    truth, faces_ = molar_landmarks(), made.template.faces
    places, share = [], []
    for one in made.scans:
        if one.vertices is None:
            continue
        near = build_engine(Mesh(one.vertices, faces_)).query(np.ascontiguousarray(truth[one.name]))
        corners = faces_[near.triangle]
        places.append(np.einsum("mc,mcd->md", near.barycentric, made.template.vertices[corners]))
        share.append((near.barycentric * one.position_std[corners]).sum(axis=1) / rms_size(one.vertices))
    errors = np.linalg.norm(np.array(places) - np.median(places, axis=0), axis=2) / rms_size(made.template.vertices)
    return [(100 * errors.ravel(), 100 * np.concatenate(share))]


def main() -> None:
    """Print a row for each set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", choices=[*SETS, "molars", "blobs", []], default=[*SETS, "molars", "blobs"])
    parser.add_argument("--scans", type=int, default=14)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--vertices", type=int, default=1500)
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    print("| set | scans | error, % | in the region, % | rank | deciles |\n|---|---|---|---|---|---|")
    for name in arguments.sets:
        config = CorrespondConfig(vertices=arguments.vertices, rounds=arguments.rounds, seed=arguments.seed)
        if name == "molars":
            per_scan = of_molars(correspond(molars(0)[0], config))
        elif name == "blobs":
            per_scan = of_blobs(
                arguments.scans,
                CorrespondConfig(vertices=1000, rounds=arguments.rounds, pose="as-given", mirror="never"),
            )
        else:
            known = SETS[name](arguments.scans, arguments.seed)
            per_scan = of_set(correspond([one.scan for one in known.known], config), known)
        error, std = (np.concatenate(column) for column in zip(*per_scan, strict=True))
        order, tenth = np.argsort(std), max(len(std) // 10, 1)
        ratio = error[order[-tenth:]].mean() / error[order[:tenth]].mean()
        rank = np.mean([spearmanr(e, s)[0] for e, s in per_scan])
        inside = 100 * (error <= RADIUS * std).mean()
        print(
            f"| {name} | {len(per_scan)} | {error.mean():.2f} | {inside:.1f} | {rank:.2f} | {ratio:.1f} |", flush=True
        )


if __name__ == "__main__":
    main()
