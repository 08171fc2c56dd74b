"""Are several kinds of object in one collection found as groups, and one kind left whole?

    python benchmarks/kinds.py                     all collections
    python benchmarks/kinds.py "spleens 14 + femora 6" "molars 26"

Molars and spleens are read from the folder that SHAPESPACE_DATA names. A row shows how many scans of each kind are in
correspondence, in each other group, and excluded for other reasons.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from mirrored import MIRRORED_MOLARS, blobs

from correspondence import faces, femora
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.types import Mesh


def files(folder: str, pattern: str) -> list[Mesh]:
    """Return the meshes of a folder of the data, without mirrored molars."""
    found = sorted((Path(os.environ["SHAPESPACE_DATA"]) / folder).glob(pattern))
    return [read_mesh(file) for file in found if file.stem not in MIRRORED_MOLARS]


KINDS: dict[str, Callable[[int], list[Mesh]]] = {
    "blobs": lambda count: (blobs(0, symmetric=False) + blobs(1, symmetric=False))[:count],
    "symmetric-blobs": lambda count: blobs(2, symmetric=True)[:count],
    "femora": lambda count: [one.scan for one in femora(count, 3).known],
    "cut-femora": lambda count: [one.scan for one in femora(count, 4, cut_every=4).known],
    "faces": lambda count: [one.scan for one in faces(count, 5).known],
    "bundled-faces": lambda count: [one.scan for one in faces(count, 6, "bundled").known],
    "damaged-faces": lambda count: [one.scan for one in faces(count, 7, harm=True).known],
    "molars": lambda count: files("molars", "*.off")[:count],
    "spleens": lambda count: files("spleens", "*.ply")[:count],
}
COLLECTIONS = (
    "blobs 20", "femora 20", "cut-femora 20", "faces 20", "bundled-faces 20", "damaged-faces 20", "molars 26",
    "spleens 24", "spleens 14 + femora 6", "spleens 12 + molars 8", "faces 18 + femora 1 + spleens 1",
    "bundled-faces 10 + faces 10", "blobs 12 + femora 8",
)  # fmt: skip


def main() -> None:
    """Print a row for each collection."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("collections", nargs="*", default=list(COLLECTIONS))
    parser.add_argument("--vertices", type=int, default=800)
    parser.add_argument("--rounds", type=int, default=1)
    arguments = parser.parse_args()
    config = CorrespondConfig(vertices=arguments.vertices, rounds=arguments.rounds, mirror="never")
    print("| scans | in correspondence | other groups | excluded otherwise |\n|---|---|---|---|")
    for collection in arguments.collections:
        scans: list[Mesh] = []
        kinds: dict[str, str] = {}
        for part in collection.split(" + "):
            kind, count = part.split()
            for k, scan in enumerate(KINDS[kind](int(count))):
                scans.append(replace(scan, name=f"{kind}{k}"))
                kinds[f"{kind}{k}"] = kind
        made = correspond(scans, config)
        others = [list(group) for group in made.groups[1:]]
        alone = [scan.name for scan in made.scans if scan.reason and not any(scan.name in group for group in others)]
        there = [scan.name for scan in made.scans if not scan.reason]

        def counts(names: list[str], kinds: dict[str, str] = kinds) -> str:
            kind, count = np.unique([kinds[name] for name in names], return_counts=True)
            return " + ".join(f"{n} {one}" for one, n in zip(kind, count, strict=True)) or "-"

        print(
            f"| {collection} | {counts(there)} | {'; '.join(map(counts, others)) or '-'} | {counts(alone)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
