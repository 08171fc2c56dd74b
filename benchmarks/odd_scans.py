"""How often are scans in another unit, of another size or of another kind named before a correspondence?

    python benchmarks/odd_scans.py

Femora, molars, spleens and hippocampi are read from the folder that SHAPESPACE_DATA names; bones, organs and faces are
simulated. Each row shows, of 100 collections of scans of one kind: those with a finding; and those with one scan scaled
as if it were in another unit, or to a third of its size, in which its unit, a wrong unit, or only its size is named;
those with one scan of another real kind of object whose shape is named; and, of 20, those of one side with a mirrored
scan named, and the percentage of mirrored scans, one to half of a collection, that are named, with the collections in
which another scan is named. Molars are of both sides; those that are mirror images are reflected first.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from shapespace.correspondence.odd_scans import ScanMeasures, find_mirrored_scans, find_odd_scans, side_sample
from shapespace.datasets.bones import Bone
from shapespace.datasets.faces import load_faces
from shapespace.datasets.organs import Organ, raw_surface
from shapespace.geometry.doctor import repair
from shapespace.geometry.mirror_plane import FLIP, mirror_image
from shapespace.geometry.volume_surface import surface_of_volume
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.io.volume_io import read_volume
from shapespace.types import MM_PER_UNIT, FloatArray, Mesh

COUNT, DRAWS, SIDE_DRAWS = 24, 100, 20
LEFT_MOLARS = {"H16", "P35", "Q04", "V01", "b08", "i14", "i17", "j01", "j17", "k20", "t10", "x07", "x21"}
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


def sides_found(samples: list[FloatArray], count: int, rng: np.random.Generator) -> list[str]:
    """Return the collections of one side with a finding; the mirrored scans that are named, and wrong collections."""
    pure, named, mirrored, wrong = 0, 0, 0, 0
    for _ in range(SIDE_DRAWS):
        scans = [samples[k] for k in rng.choice(COUNT, count, replace=False)]
        pure += bool(find_mirrored_scans(scans))
        chosen = set(rng.choice(count, rng.integers(1, (count + 1) // 2), replace=False).tolist())
        images = [scan * np.tile(FLIP, 2) if k in chosen else scan for k, scan in enumerate(scans)]
        found = set(find_mirrored_scans(images))
        named, mirrored, wrong = named + len(found & chosen), mirrored + len(chosen), wrong + bool(found - chosen)
    return [str(pure), f"{100 * named / mirrored:.0f} %, {wrong}"]


def main() -> None:
    """Print a row for each kind and number of scans."""
    data = Path(os.environ["SHAPESPACE_DATA"])
    meshes = {
        name: [
            mirror_image(mesh) if file.stem in LEFT_MOLARS else mesh
            for file in sorted((data / name).glob(pattern))[:COUNT]
            for mesh in [read(file)]
        ]
        for name, pattern in REAL.items()
    }
    for name, draw in simulated().items():
        meshes[name] = [draw(np.random.default_rng(k)) for k in range(COUNT)]
    kinds = {name: list(map(ScanMeasures.of, scans)) for name, scans in meshes.items()}
    samples = {name: list(map(side_sample, scans)) for name, scans in meshes.items()}
    rng, sides_rng = np.random.default_rng(0), np.random.default_rng(1)
    print(f"| kind | scans | finding in one kind | {' | '.join(SCALES)} | another kind | named sides | mirrored |")
    print("|---|---|---|" + "---|" * (len(SCALES) + 3))
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
            cells += sides_found(samples[name], count, sides_rng)
            print(f"| {name} | {count} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
