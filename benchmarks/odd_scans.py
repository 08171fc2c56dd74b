"""How often are scans in another unit, of another size or of another kind named before a correspondence?

    python benchmarks/odd_scans.py

Femora, molars, spleens and hippocampi are read from the folder that SHAPESPACE_DATA names; bones, organs and faces are
simulated. Each row shows, of 100 collections of scans of one kind: those with a finding; and those with one scan scaled
as if it were in another unit, or to a third of its size, in which its unit, a wrong unit, or only its size is named;
and those with one scan of another real kind of object whose shape is named.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapespace.correspondence.odd_scans import ScanMeasures, find_odd_scans
from shapespace.datasets.bones import Bone
from shapespace.datasets.faces import load_faces
from shapespace.datasets.organs import Organ, raw_surface
from shapespace.geometry.doctor import repair
from shapespace.geometry.volume_surface import surface_of_volume
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.volume_io import read_volume
from shapespace.types import MM_PER_UNIT, Mesh

COUNT, DRAWS = 24, 100
REAL = {"femora": "femur*.ply", "molars": "*.off", "spleens": "*.ply", "hippocampus": "*.nii.gz"}
SCALES = {**{unit: 1.0 / length for unit, length in MM_PER_UNIT.items() if unit != "mm"}, "third": 1.0 / 3.0}
ALIKE = {"molars", "spleens"}  # which the profile does not distinguish


def read(file: Path) -> Mesh:
    """Return the repaired scan, or the surface of all labels of a volume."""
    if file.name.endswith(".nii.gz"):
        return surface_of_volume(read_volume(file), "all").mesh
    return repair(read_mesh(file))[0]


def simulated() -> dict[str, Callable[[np.random.Generator], Mesh]]:
    """Return functions that draw an object of each simulated kind."""
    faces = load_faces()
    return {
        "bones": lambda rng: raw_surface(Bone.draw(rng), rng, 1500),
        "organs": lambda rng: raw_surface(Organ.draw(rng), rng, 1500),
        "faces": lambda rng: faces.face(faces.draw_person(rng)),
    }


def main() -> None:
    """Print a row for each kind and number of scans."""
    data = Path(os.environ["SHAPESPACE_DATA"])
    kinds = {
        name: [ScanMeasures.of(read(file)) for file in sorted((data / name).glob(pattern))[:COUNT]]
        for name, pattern in REAL.items()
    }
    for name, draw in simulated().items():
        kinds[name] = [ScanMeasures.of(draw(np.random.default_rng(k))) for k in range(COUNT)]
    rng = np.random.default_rng(0)
    print(f"| kind | scans | finding in one kind | {' | '.join(SCALES)} | another kind |")
    print("|---|---|---|" + "---|" * (len(SCALES) + 1))
    for name, measures in kinds.items():
        others = [other for other in REAL if other != name and {other, name} != ALIKE]
        for count in (6, 12, 24):
            units, cells = ["mm"] * count, list[str]()
            draws = [[measures[k] for k in rng.choice(COUNT, count, replace=False)] for _ in range(DRAWS)]
            cells.append(str(sum(bool(find_odd_scans(scans, units)) for scans in draws)))
            for unit, factor in SCALES.items():
                odd = [
                    find_odd_scans([replace(scans[0], size=factor * scans[0].size), *scans[1:]], units).get(0)
                    for scans in draws
                ]
                right = sum(scan is not None and scan.unit == unit for scan in odd)
                wrong = sum(scan is not None and scan.unit not in ("", unit) for scan in odd)
                cells.append(f"{right}, {wrong}, {sum(scan is not None and not scan.unit for scan in odd)}")
            foreign = [kinds[rng.choice(others)][rng.integers(COUNT)] for _ in range(DRAWS)]
            found = [
                find_odd_scans([scan, *scans[1:]], units).get(0) for scan, scans in zip(foreign, draws, strict=True)
            ]
            cells.append(str(sum(scan is not None and scan.shape_ratio != 1 for scan in found)))
            print(f"| {name} | {count} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
