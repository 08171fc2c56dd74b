"""Checks and pictures of specimens, made in other processes and kept in the project."""

from __future__ import annotations

import asyncio
import contextlib
import json
import multiprocessing
import os
import sys
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from shapespace.batch.workers import context, end_after
from shapespace.correspondence.odd_scans import ScanMeasures, side_sample
from shapespace.errors import FileError, InputError, ShapespaceError
from shapespace.geometry.doctor import examine_and_repair
from shapespace.geometry.mirror_plane import FLIP, mirror_image
from shapespace.geometry.normals import boundary_edges, drawable
from shapespace.io.files import sha256_of_file, write_bytes, write_text
from shapespace.io.meshes.mesh_io import read_mesh
from shapespace.report.render.scene import decimate, pack
from shapespace.report.render.thumbnails import mesh_still
from shapespace.types import FloatArray, Mesh, read_only
from shapespace.viewer.studio.project import scan_key

_FOLDER, _SAMPLE = "checks", ".points"
_MOST_PROCESSES = 4
_MOST_DRAWN, _MOST_TURNING = 100_000, 12_000  # triangles of a scan in its view, at rest and while it turns
_KEY = 24  # hexadecimal digits of the hash of a scan
_MOST_BORDERS = 50_000  # edges of borders that are drawn


class SpecimenChecks:
    """The owner of the checks of a project's scans, which are identified by `scan_key`.

    Args:
        folder: folder of the project.
        changed: function that is called when a check was finished.
        unusable: function that is called before that, with the path of a scan that cannot be used.
    """

    def __init__(
        self, folder: Path, changed: Callable[[], None], unusable: Callable[[Path], None], *, read_only: bool = False
    ) -> None:
        self._folder = folder / _FOLDER
        self._changed = changed
        self._unusable = unusable
        self._read_only = read_only
        self._asked: set[str] = set()
        self._pool: ProcessPoolExecutor | None = None
        self._known: dict[str, dict[str, Any]] = {}
        if not read_only:
            self._processes().submit(_load_code)  # before the first scan comes

    def facts(self, scan: Path) -> dict[str, Any] | None:
        """Return the facts of a scan, or None while it is checked; the first call asks for the check."""
        key = scan_key(scan, self._folder.parent)
        if key in self._known:
            return self._known[key]
        try:
            facts = json.loads((self._folder / f"{key}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            self._ask(key, scan)
            return None
        if (
            facts.get("state") == "ready" and not {"profile", "content", "box"} <= facts.keys()
        ):  # from an earlier version
            self._ask(key, scan)
            return None
        self._known[key] = facts
        return facts

    def picture(self, scan: Path) -> Path:
        """Return the path of the picture of a scan, which exists once it was checked and is usable."""
        return self._folder / f"{scan_key(scan, self._folder.parent)}.webp"

    def sample(self, scan: Path, *, mirrored: bool) -> FloatArray | None:
        """Return the sample of a scan or of its mirror image, (P, 6), see `side_sample`; None if there is none."""
        file = self.picture(scan).with_suffix(_SAMPLE)
        if not file.is_file():
            return None
        sample = read_only(np.fromfile(file, dtype=np.float32).reshape(-1, 6))
        return sample * np.tile(FLIP, 2) if mirrored else sample

    def surface(self, scan: Path, *, mirrored: bool) -> Future[bytes]:
        """Return the packed surface of a scan for a view, as it is in its file or reflected at x = 0.

        The future raises a ShapespaceError if the scan cannot be read.
        """
        return self._processes().submit(pack_scan, scan, mirrored=mirrored)

    async def labels(self, volume: Path) -> list[dict[str, Any]]:
        """Return the labels of a volume, as `count_labels` returns them.

        Raises:
            ShapespaceError: it cannot be read, has no labels, or takes too much memory.
        """
        try:
            return await asyncio.wrap_future(self._processes().submit(read_labels, volume))
        except BrokenExecutor as error:
            self._pool = None
            raise InputError(f"{volume.name}: the memory does not suffice for it; crop or resample it.") from error

    def close(self) -> None:
        """End the processes after the checks that they make now."""
        if self._pool is not None:
            # Without a wait its thread may close a pipe while the end of the program writes into it: "Bad file
            # descriptor"; and a check may be written after the lock of the project was released.
            self._pool.shutdown(wait=True, cancel_futures=True)

    def _ask(self, key: str, scan: Path) -> None:
        if key in self._asked or self._read_only:
            return
        self._asked.add(key)
        with contextlib.suppress(OSError):  # the check reports what cannot be written
            self._folder.mkdir(parents=True, exist_ok=True)

        def done(future: Future[dict[str, Any]]) -> None:
            if future.cancelled():
                return
            failure = future.exception()
            if failure is not None:
                self._known[key] = self._facts_of_failure(failure)
            if failure is not None or future.result()["state"] == "unusable":
                # On a full disk the scan stays included; commands reject it.
                with contextlib.suppress(FileError):
                    self._unusable(scan)
            self._changed()

        self._processes().submit(check_scan, scan, self._folder / key).add_done_callback(done)

    def _processes(self) -> ProcessPoolExecutor:
        if self._pool is None:
            processes = min(_MOST_PROCESSES, max(1, (os.cpu_count() or 2) - 1))
            self._pool = ProcessPoolExecutor(processes, mp_context=context(), initializer=_start_process)
        return self._pool

    def _facts_of_failure(self, error: BaseException | None) -> dict[str, Any]:
        """Return the facts of a scan whose check ended with an error; it is not tried again."""
        if isinstance(error, ShapespaceError):
            return _unusable(f"It cannot be checked: {error}")
        self._pool = None  # its process was killed, as for want of memory: the file is to blame
        return _unusable("It cannot be checked: the memory does not suffice, or the check failed.")


def _start_process() -> None:
    """Prefer the server, and end with it also when it is killed; a process of a pool would wait for its queue."""
    if sys.platform != "win32":
        os.nice(5)
    if sys.platform == "linux":
        with contextlib.suppress(OSError):
            # The server survives when memory runs out.
            Path("/proc/self/oom_score_adj").write_text("1000")
    if (server := multiprocessing.parent_process()) is not None:
        end_after(server.join)


def compile_fits() -> None:
    """Compile the code of a fit, unless it is compiled, so that the first fit does not wait for it."""
    _start_process()
    from shapespace.batch.warm import warm_up  # loads the code of a fit

    warm_up(notify=False)


def _load_code() -> None:
    """Check and draw a tetrahedron, for which the compiled code is loaded."""
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=np.int32)
    _, repaired = examine_and_repair(Mesh(vertices, faces))
    if repaired is not None:
        mesh_still(repaired)


def content_hash(scan: Path) -> str:
    """Return the hash of the content of a scan.

    Raises:
        FileError: it cannot be read.
    """
    return sha256_of_file(scan)[:_KEY]


def check_scan(scan: Path, stem: Path) -> dict[str, Any]:
    """Write the facts and the picture of a scan next to `stem`, and return the facts."""
    try:
        report, repaired = examine_and_repair(read_mesh(scan))
        findings = [
            {"level": finding.level, "text": f"{finding.problem} {finding.action}"} for finding in report.findings
        ]
        facts = {
            "state": "unusable" if repaired is None else "ready",
            "vertices": report.vertices, "triangles": report.triangles,
            "extent": 0.0 if repaired is None else float(report.extent.max()), "findings": findings,
        }  # fmt: skip
        if repaired is not None:
            measures = ScanMeasures.of(repaired)
            box = [repaired.vertices.min(axis=0).tolist(), repaired.vertices.max(axis=0).tolist()]
            facts |= {"size": measures.size, "profile": measures.profile.tolist(), "box": box}
            if repaired.faces is not None:
                write_bytes(stem.with_suffix(_SAMPLE), side_sample(repaired).astype(np.float32).tobytes())
            picture, _ = mesh_still(repaired)
            write_bytes(stem.with_suffix(".webp"), picture)
    except ShapespaceError as error:
        facts = _unusable(_without_folder(error, scan))
    with contextlib.suppress(ShapespaceError):  # of a file that cannot be read, which is a finding
        facts["content"] = content_hash(scan)
    write_text(stem.with_suffix(".json"), json.dumps(facts))
    return facts


def read_labels(volume: Path) -> list[dict[str, Any]]:
    """Return the labels of a volume, as `count_labels` returns them.

    Raises:
        InputError: it cannot be read, has no labels, or takes too much memory.
    """
    from shapespace.geometry.volume_surface import count_labels
    from shapespace.io.volume_io import default_limit_bytes, read_volume

    try:
        counts = count_labels(read_volume(volume, max_memory_bytes=default_limit_bytes()))
    except MemoryError as error:
        raise InputError(f"{volume.name}: the memory does not suffice for it; crop or resample it.") from error
    except ShapespaceError as error:
        raise InputError(_without_folder(error, volume)) from error
    return [asdict(count) for count in counts]


def pack_scan(scan: Path, *, mirrored: bool) -> bytes:
    """Return the surface of a scan for a view: its triangles or points, those drawn while it turns, and its borders.

    Raises:
        InputError: it cannot be read, or is damaged.
    """
    try:
        mesh = read_mesh(scan)
    except ShapespaceError as error:
        raise InputError(_without_folder(error, scan)) from error
    mesh = drawable(mirror_image(mesh) if mirrored else mesh)[0]
    drawn, _ = decimate(mesh, _MOST_DRAWN)
    turning, kept = decimate(drawn, _MOST_TURNING)
    arrays: dict[str, Any] = {"positions": drawn.vertices}
    if drawn.faces is not None and turning.faces is not None and mesh.faces is not None:
        arrays |= {"faces": drawn.faces.astype(np.uint32), "draft": kept[turning.faces].astype(np.uint32)}
        arrays["borders"] = mesh.vertices[boundary_edges(mesh.faces)[:_MOST_BORDERS]].reshape(-1, 3)
    return pack(arrays, {"name": scan.name})


def _without_folder(error: ShapespaceError, scan: Path) -> str:
    return str(error).replace(f"{scan.parent}{os.sep}", "")


def _unusable(text: str) -> dict[str, Any]:
    findings = [{"level": "refused", "text": text}]
    return {"state": "unusable", "vertices": 0, "triangles": 0, "extent": 0.0, "findings": findings}
