"""Write src/shapespace/datasets/data/registry.json: the sizes and hashes of the open data sets, from a local mirror.

Usage: python tools/make_data_registry.py MIRROR, a folder that holds james/ and ict-facekit/.
The hashes of ICT-FaceKit are hashes of content; see shapespace/datasets/ict_files.py.
"""

import json
import sys
from pathlib import Path

from shapespace.datasets import ict_files
from shapespace.io.files import sha256_of_file, write_text

MENPO3D = "c3fba1d01c0dfcae21063195b0cdd27b951f6198"
FACEKIT = "da5f95a607f5e6b37755b38d3385d7f2853732e5"


def raw(path: Path) -> dict[str, str | int]:
    return {"bytes": path.stat().st_size, "sha256": sha256_of_file(path)}


def main(mirror: Path) -> None:
    james, ict = mirror / "james", mirror / "ict-facekit"
    packed = ict_files.read_packed(ict / ict_files.PACKED_NAME)
    content = {ict_files.NEUTRAL_NAME: ict_files.neutral_hash(packed.mean, packed.faces)}
    content |= {f"identity{i:03d}": ict_files.mode_hash(m) for i, m in enumerate(packed.identity)}
    content |= {n: ict_files.mode_hash(m) for n, m in zip(packed.expression_names, packed.expression, strict=True)}
    ict_entries: dict[str, dict[str, str | int]] = {}
    for name, digest in content.items():
        path = ict / "FaceXModel" / f"{name}.obj"
        ict_entries[f"FaceXModel/{name}.obj"] = {
            "content_sha256": digest,
            **(raw(path) if path.is_file() else {}),
        }
    registry = {
        "james": {
            "title": "James: a 3dMD head scan with hair and collar, 6,393 vertices, 68 landmarks, millimetres",
            "licence": "BSD-3-Clause",
            "licence_text": (james / "LICENSE.txt").read_text(),
            "citation": "Alabort-i-Medina, Antonakos, Booth, Snape, Zafeiriou: Menpo, ACM Multimedia 2014.",
            "repository": "menpo/menpo3d",
            "commit": MENPO3D,
            "remote_folder": "menpo3d/data/",
            "files": {n: raw(james / n) for n in ("james.obj", "james.ljson", "james.obj.mtl", "james.jpg")},
        },
        "ict-facekit": {
            "title": "ICT-FaceKit Light: 100 identity modes and 57 expressions of face, head and neck",
            "licence": "MIT",
            "licence_text": (ict / "LICENSE").read_text(),
            "citation": "Li et al.: Learning Formation of Physically-Based Face Attributes, CVPR 2020.",
            "repository": "USC-ICT/ICT-FaceKit",
            "commit": FACEKIT,
            "remote_folder": "",
            "files": ict_entries,
        },
    }
    target = Path(__file__).parents[1] / "src" / "shapespace" / "datasets" / "data" / "registry.json"
    write_text(target, json.dumps(registry, indent=1) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
