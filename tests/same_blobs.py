"""A folder as `shapespace correspond` writes it, of blobs in true correspondence, made without running it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from msgspec import structs

from shapespace.correspondence.scan_status import SurfaceMeasures, find_review_reasons
from shapespace.geometry.normals import Distortion, rms_size
from shapespace.io.files import make_folder, sha256_of_file, write_text
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.schemas import CorrespondenceRecord, CorrespondRecord, json_text
from shapespace.types import Mesh, Similarity
from synthetic_shapes import blob, similarity, sphere

VERTICES = 600
SETTLED = 0.002
HIDDEN = "holed"
"""A scan without its top."""
FAR = "far"
"""One whose distances are ten times those of the others."""
FOLDED = "folded"
"""One with a vertex pushed over its neighbours."""
ASIDE = "stranger"
EVIL = "<img src=x onerror=alert(1)>"
NAMES = ("able", "baker", FAR, FOLDED, HIDDEN, "item")


def mean_blob() -> Mesh:
    d, faces = sphere(VERTICES)
    return Mesh(blob(d, np.zeros(5)), faces, name="mean")


def surface(name: str, number: int) -> tuple[Mesh, Similarity]:
    """Return the surface of a scan in its own frame, and the pose that it has there."""
    d, faces = sphere(VERTICES)
    vertices = blob(d, 0.4 * np.random.default_rng(number).standard_normal(5))
    if name == HIDDEN:
        vertices[d[:, 1] > 0.5] = np.nan
    if name == FOLDED:
        at = int(d[:, 2].argmax())
        ring = np.unique(faces[(faces == at).any(axis=1)])
        across = vertices[ring[ring != at]]
        vertices[at] = across[0] + 1.5 * (across[0] - vertices[at])
    T = similarity(number, degrees=20.0 * number, scale=1.0)
    return Mesh(T.apply(vertices), faces, name=name), T


def write_records(folder: Path, records: Sequence[CorrespondRecord]) -> None:
    """Write records with their reasons to review the surfaces."""
    measures = [SurfaceMeasures.of_record(record, rms_size(mean_blob().vertices)) for record in records]
    for record, review in zip(records, find_review_reasons(measures, SETTLED), strict=True):
        text = json_text(structs.replace(record, review=review))
        write_text(folder / f"{record.name}{CorrespondRecord.ENDING}", text)


def write_same(home: Path, names: Sequence[str] = NAMES, *, aside: bool = True) -> Path:
    """Write `home`/same and the scans beside it in `home`/scans; return the former."""
    folder, scans, mean = home / "same", home / "scans", mean_blob()
    make_folder(folder / "template")
    make_folder(scans)
    write_mesh(folder / CorrespondenceRecord.MEAN, mean)
    records: list[CorrespondRecord] = []
    for number, name in enumerate(names):
        mesh, _ = surface(name, number)
        write_mesh(folder / f"{name}{CorrespondRecord.SURFACE}", mesh)
        there = np.isfinite(mesh.vertices).all(axis=1)
        kept = there[mesh.faces].all(axis=1)
        used, faces = np.unique(mesh.faces[kept], return_inverse=True)
        raw = Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), name=name)
        write_mesh(scans / f"{name}.ply", raw)
        changed, times = Distortion.of(mesh, mean), 10.0 if name == FAR else 1.0 + 0.01 * number
        record = CorrespondRecord(
            name=name, path=f"../scans/{name}.ply", hash=sha256_of_file(scans / f"{name}.ply"),
            status="converged", seen_share=float(there.mean()), covered_share=1.0, area_share=0.99,
            distance_mean=0.2 * times, distance_p95=0.5 * times, distance_p99=times, distance_max=3 * times, scale=1.0,
            folded_share=changed.folded_share, area_factor=changed.area_factor, moved_share=[0.05, 0.012],
            cpu_s=[2.0, 1.0 + number],
        )  # fmt: skip
        records.append(record)
    write_records(folder, records)
    if aside:
        write_mesh(scans / f"{ASIDE}.ply", mean.with_vertices(mean.vertices * [1.0, 3.0, 0.3]))
        record = CorrespondRecord(
            name=ASIDE, path=f"../scans/{ASIDE}.ply", hash=sha256_of_file(scans / f"{ASIDE}.ply"), status="excluded",
            reason=f"another object {EVIL}, as in /home/somebody/scans/{ASIDE}.ply",
        )  # fmt: skip
        write_text(folder / f"{ASIDE}{CorrespondRecord.ENDING}", json_text(record))
    summary = CorrespondenceRecord(
        template="able is the first template.", vertices=VERTICES, rounds=[0.05, 0.012], corresponding=list(names),
        set_aside={ASIDE: "another object"} if aside else {}, settings={"rounds": 2, "settled": SETTLED},
        version="0.1.0",
    )  # fmt: skip
    write_text(folder / CorrespondenceRecord.FILE, json_text(summary))
    return folder
