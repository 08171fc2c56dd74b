"""Are mirrored scans found, and no others?

    python benchmarks/mirrored.py                                   molars, femora, blobs, faces
    python benchmarks/mirrored.py femora blobs --mixes 10 --jobs 2

Of each set a third is reflected, drawn anew for each mix, in any pose. A scan is wrong if its side is not that of the
majority. The molars (SHAPESPACE_DATA) come as they are, 13 of 39 mirrored, and only the seed differs. Faces and
symmetric blobs are their own mirror images, nearly or exactly, so that their sides should not be decided.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from correspondence import faces, femora
from shapespace.batch.executors import ExecutionConfig
from shapespace.batch.parallel_rounds import RoundRunner
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.datasets.simulated_scan import random_similarity
from shapespace.geometry.mirror_plane import mirror_image
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.types import BoolArray, FloatArray, Mesh

MIRRORED_MOLARS = frozenset(["H16", "P35", "Q04", "V01", "b08", "i14", "i17", "j01", "j17", "k20", "t10", "x07", "x21"])
SCANS, SHARE = 15, 1 / 3
"""Scans of a simulated set, and the share of them that is reflected."""


def blob(rng: np.random.Generator, directions: FloatArray, *, symmetric: bool) -> FloatArray:
    """Return the points (M, 3) of a random smooth object with three bumps in fixed places, symmetric or not."""
    radius = np.ones(len(directions))
    for centre, height in (((0.2, 0.1, 1.0), 0.4), ((1.0, 0.8, 0.3), 0.3), ((-0.5, -1.0, 0.2), 0.2)):
        at = np.array(centre) / np.linalg.norm(centre) + 0.1 * rng.standard_normal(3)
        height *= 1 + 0.25 * rng.standard_normal()
        for side in (1.0, -1.0) if symmetric else (1.0,):
            radius += height * np.exp((directions @ (at * [side, 1.0, 1.0]) - 1) / 0.1)
    return radius[:, None] * directions * [70.0, 100.0, 85.0] * (1 + 0.05 * rng.standard_normal(3))


def blobs(seed: int, *, symmetric: bool) -> list[Mesh]:
    """Return raw scans of random objects of one kind."""
    from scipy.spatial import ConvexHull

    rng = np.random.default_rng([seed, 17])
    scans: list[Mesh] = []
    for k in range(SCANS):
        directions = rng.standard_normal((2000, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        corners = ConvexHull(directions).simplices
        a, b, c = (directions[corners[:, i]] for i in range(3))
        inward = (np.cross(b - a, c - a) * a).sum(axis=1) < 0
        corners[inward] = corners[inward][:, ::-1]
        vertices = random_similarity(rng, 180.0).apply(blob(rng, directions, symmetric=symmetric))
        scans.append(Mesh(vertices + 0.2 * rng.standard_normal(vertices.shape), corners.astype(np.int32), name=f"{k}"))
    return scans


def reflected(scans: list[Mesh], seed: int) -> tuple[list[Mesh], BoolArray]:
    """Return the scans with a third of them reflected, and which they are."""
    is_mirrored = np.zeros(len(scans), np.bool_)
    is_mirrored[np.random.default_rng([seed, 23]).permutation(len(scans))[: round(SHARE * len(scans))]] = True
    return [mirror_image(s) if m else s for s, m in zip(scans, is_mirrored, strict=True)], is_mirrored


def molars(_seed: int) -> tuple[list[Mesh], BoolArray]:
    """Return the molars as they are, and which are mirrored."""
    files = sorted((Path(os.environ["SHAPESPACE_DATA"]) / "molars").glob("*.off"))
    return [replace(read_mesh(f), name=f.stem) for f in files], np.array([f.stem in MIRRORED_MOLARS for f in files])


SETS: dict[str, Callable[[int], tuple[list[Mesh], BoolArray]]] = {
    "molars": molars,
    "femora": lambda seed: reflected([known.scan for known in femora(SCANS, seed).known], seed),
    "blobs": lambda seed: reflected(blobs(seed, symmetric=False), seed),
    "faces": lambda seed: reflected([known.scan for known in faces(SCANS, seed, "bundled").known], seed),
    "symmetric blobs": lambda seed: reflected(blobs(seed, symmetric=True), seed),
}


def main() -> None:
    """Print a row for each mix."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", choices=[*SETS, []], default=list(SETS))
    parser.add_argument("--mixes", type=int, default=3)
    parser.add_argument("--vertices", type=int, default=1500)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--jobs", type=int, default=1)
    arguments = parser.parse_args()
    print("| set | mix | scans | mirrored | decided | wrong side | excluded |\n|---|---|---|---|---|---|---|")
    for name in arguments.sets:
        for seed in range(arguments.mixes):
            scans, is_mirrored = SETS[name](seed)
            config = CorrespondConfig(vertices=arguments.vertices, rounds=arguments.rounds, seed=seed)
            with tempfile.TemporaryDirectory() as folder:
                run = RoundRunner(Path(folder), ExecutionConfig(jobs=arguments.jobs), True, lambda: None)
                made = correspond(scans, config, run=run)
            there = np.array([not scan.reason for scan in made.scans])
            wrong = there & (np.array([scan.mirrored for scan in made.scans]) != is_mirrored)
            decided = "yes" if made.sides_decided else "no"
            row = (name, seed, len(scans), is_mirrored.sum(), decided, wrong.sum(), (~there).sum())
            print(f"| {' | '.join(map(str, row))} |", flush=True)


if __name__ == "__main__":
    main()
