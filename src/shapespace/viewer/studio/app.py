"""The studio's application: its page, the state of the project, edits, jobs, and the pages of results."""

from __future__ import annotations

import asyncio
import json
import threading
import time
import zipfile
from collections.abc import AsyncGenerator, Callable, Generator, Mapping
from contextlib import ExitStack, aclosing, suppress
from functools import lru_cache, partial
from itertools import compress
from pathlib import Path
from typing import Any, cast

import numpy as np
from msgspec import to_builtins
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response, StreamingResponse
from starlette.routing import Mount, Route
from starlette.types import ASGIApp

from shapespace.batch.result_folder import LOCK, only_writer
from shapespace.correspondence.odd_scans import OddScan, ScanMeasures, find_mirrored_scans, find_odd_scans
from shapespace.errors import FileError, InputError
from shapespace.io.containers.json_files import plain_json
from shapespace.io.files import atomic_path
from shapespace.io.landmarks.configuration_io import CONFIGURATION_ENDINGS
from shapespace.io.meshes.mesh_io import MESH_ENDINGS, MESH_FILE_ENDINGS
from shapespace.io.volume_io import VOLUME_ENDINGS
from shapespace.reprs import first_names
from shapespace.schemas import read
from shapespace.types import MM_PER_UNIT, FloatArray
from shapespace.version import __version__
from shapespace.viewer.guard import Access, Guard, refusal
from shapespace.viewer.server import (
    application,
    asset,
    binary,
    body_pieces,
    display_name,
    html_page,
    json_body,
    json_response,
    route,
    whole_body,
)
from shapespace.viewer.studio.job_commands import (
    QUESTIONS,
    Forms,
    OptionLabels,
    Outdated,
    checks,
    groomed_scans,
    order,
    outdated_results,
    shapes_of,
    stored_volumes,
)
from shapespace.viewer.studio.jobs import Job, Jobs, Order, history
from shapespace.viewer.studio.landmark_import import is_landmark_table, read_points
from shapespace.viewer.studio.placed_landmarks import PLACED
from shapespace.viewer.studio.project import (
    PastedBlock,
    Project,
    Role,
    StaleError,
    cells_of_table,
    change_of,
    recent_projects,
    scan_key,
    with_cells,
    with_points,
)
from shapespace.viewer.studio.specimen_checks import SpecimenChecks, content_hash
from shapespace.viewer.studio.views import Views, result_path, view_kinds

_VOLUME_ENDINGS = tuple(ending for ending in VOLUME_ENDINGS if ending != ".mhd")  # whose data are in another file
_TABLE_BYTES, _REQUEST_BYTES = 2**24, 2**20
_EVENT_S = 0.4  # between events
_MIRRORED = (
    "Probably a mirror image of most others, such as a left one among right ones; mirror it under Specimens if so."
)
_OUTSIDE = 0.1  # distance of a landmark from the box around its scan, as a share of the scan's extent, that is named
_MOST_LISTED = 2000  # folders and files of a listing


class OpenProject:
    """A project that is open: the owner of its locks, jobs, checks and pages.

    Args:
        folder: folder of the project.
        forms: forms of the commands.
        create: whether to create the project.
        changed: function that is called after each change.
        labels: labels of options in the messages of commands.
        read_only: whether nothing is written into the folder, in which a studio may run.
    """

    def __init__(
        self, folder: Path, forms: Forms, *, create: bool, changed: Callable[[], None], labels: OptionLabels,
        read_only: bool = False,
    ) -> None:  # fmt: skip
        self.project = Project.open(folder, create=create)
        self._resources = ExitStack()
        if not read_only:
            self._resources.enter_context(only_writer(self.project.folder))
        takers = {"surface": self._take_surfaces, "groom": self._take_groomed}
        self.jobs = Jobs(self.project.folder, changed, takers, read_only=read_only)
        self.checks = SpecimenChecks(self.project.folder, changed, self.project.exclude, read_only=read_only)
        self.views = Views(self._result, labels)
        self._sentence = labels.sentence
        self._forms = forms
        self._outdated: tuple[object, dict[int, Outdated]] = (None, {})
        for resource in (self.views, self.checks, self.jobs):
            self._resources.callback(resource.close)

    def close(self) -> None:
        """Close the project; a running job continues."""
        self._resources.close()

    def _take_surfaces(self, job: Job) -> list[str]:
        return self.project.add_surfaces(self.project.folder / job.output, _role(job.options.get("set")))

    def _take_groomed(self, job: Job) -> list[str]:
        self.project.take_groomed(groomed_scans(job, self.project.folder))
        return []

    def _result(self, number: int) -> Path | None:
        """Return the path of the result of a job; None if it has none."""
        job = next((job for job in self.jobs.all() if job.number == number and job.status == "done"), None)
        return None if job is None else result_path(self.project.folder, job.output)

    def _checked(self) -> dict[str, dict[str, Any]]:
        """Return the facts of the scan of each specimen by its id, of those that were checked."""
        project = self.project
        facts = {specimen.id: self.checks.facts(project.path(specimen)) for specimen in project.state.specimens}
        return {name: found for name, found in facts.items() if found is not None}

    def odd_scans(self, checked: Mapping[str, Mapping[str, Any]] | None = None) -> dict[str, OddScan]:
        """Return the included specimens that differ from the others in size or shape, by their ids.

        Args:
            checked: facts of the scans that were checked (default: read again).
        """
        facts = self._checked() if checked is None else checked
        key = [
            (
                specimen.part,
                specimen.id,
                specimen.unit or "mm",
                facts[specimen.id]["size"],
                facts[specimen.id]["profile"],
            )
            for specimen in self.project.state.specimens
            if specimen.included and "profile" in facts.get(specimen.id, ())
        ]

        def find() -> dict[str, OddScan]:
            return {
                of_part[k][1]: odd
                for part in dict.fromkeys(row[0] for row in key)  # scans of one part are compared
                for of_part in [[row for row in key if row[0] == part]]
                for k, odd in find_odd_scans(
                    [ScanMeasures(size, np.array(profile)) for *_, size, profile in of_part],
                    [unit for _, _, unit, _, _ in of_part],
                ).items()
            }

        return self.project.cached(("odd scans", *key), find)

    def mirrored_scans(self) -> list[str]:
        """Return the ids of the specimens for training that are probably mirror images of most others.

        It takes 20 ms per specimen, once for a set of scans.
        """
        project, odd = self.project, self.odd_scans()
        chosen = [
            specimen
            for specimen in project.state.chosen("training")
            if specimen.id not in odd or odd[specimen.id].shape_ratio == 1.0
        ]
        key = [
            (specimen.id, specimen.mirrored, scan_key(project.path(specimen), project.folder)) for specimen in chosen
        ]

        def find() -> list[str]:
            samples: dict[str, dict[str, FloatArray]] = {}
            for specimen in chosen:
                sample = self.checks.sample(project.path(specimen), mirrored=specimen.mirrored)
                samples.setdefault(specimen.part, {}).update({} if sample is None else {specimen.id: sample})
            return [list(own)[k] for own in samples.values() for k in find_mirrored_scans(list(own.values()))]

        return project.cached(("mirrored scans", *key), find)

    def landmarks_off_scans(self) -> dict[str, str]:
        """Return a sentence on each specimen with landmarks outside of the box around its scan, by its id."""
        found, facts = dict[str, str](), self._checked()
        for specimen in self.project.state.specimens:
            box = facts.get(specimen.id, {}).get("box")
            if box is None or not specimen.points:
                continue
            low, high = np.array(box)
            points = np.array([*specimen.points.values()])
            distances = np.maximum(low - points, points - high).max(axis=1)  # to the box, negative inside
            is_off = distances > _OUTSIDE * (high - low).max()
            if is_off.any():
                names = first_names([*compress(specimen.points, is_off)])
                found[specimen.id] = (
                    f"{specimen.id}: not on its scan: {names}; check the unit and axes of the landmarks."
                )
        return found

    def scan_contents(self) -> dict[str, str]:
        """Return the hash of the scan of each specimen by its id; scans that were not checked yet are read for it."""
        contents = _contents_of(self._checked())
        for specimen in self.project.state.specimens:
            if specimen.id not in contents:
                with suppress(FileError):  # which the command reports
                    contents[specimen.id] = content_hash(self.project.path(specimen))
        return contents

    def facts(self) -> dict[str, Any]:
        """Return the state for the page."""
        jobs, project = self.jobs.all(), self.project  # in this order: a job that is done has changed the state
        state = project.state
        checked = self._checked()
        scans = _contents_of(checked)
        key = (state, scans, [(job.number, job.status) for job in jobs])
        if key != self._outdated[0]:
            self._outdated = key, outdated_results(project, jobs, self._forms, scans)
        specimens: list[dict[str, Any]] = []
        for specimen in state.specimens:
            facts = checked.get(specimen.id) or {
                "state": "waiting", "vertices": 0, "triangles": 0, "extent": 0.0, "findings": []
            }  # fmt: skip
            specimens.append({
                "id": specimen.id, "file": specimen.file, "set": specimen.role, "included": specimen.included,
                "unit": specimen.unit, "mirrored": specimen.mirrored, "groomed": bool(specimen.original),
                "cells": specimen.cells, "points": specimen.points,
                "part": specimen.part, "subject": specimen.subject,
                "scan": scan_key(project.path(specimen), project.folder),
                **{key: fact for key, fact in facts.items() if key not in ("profile", "content", "box")},
                "findings": [{**finding, "text": self._sentence(finding["text"])} for finding in facts["findings"]],
            })  # fmt: skip
        return {
            "name": state.name, "folder": str(project.folder), "revision": project.revision,
            "columns": list(state.columns), "specimens": specimens,
            "odd": [{"id": name, "text": odd.text, "unit": odd.unit} for name, odd in self.odd_scans(checked).items()],
            "notes": state.notes(), "counts": state.counts(),
            "undo": project.undo_text, "redo": project.redo_text, "landmarks": state.landmarks,
            "landmarks_on": state.landmarks_on, "point_names": list(state.point_names),
            "views": to_builtins(state.views),
            "curves": to_builtins(state.curves), "pairs": state.mirrored_pairs,
            "jobs": [self._job(job) for job in jobs],
        }  # fmt: skip

    def _job(self, job: Job) -> dict[str, Any]:
        progress = self.jobs.progress(job) if job.status == "running" else None
        left_s = None if progress is None else progress.pop("left_s")
        path = self._result(job.number)
        kinds = [] if path is None else view_kinds(path)
        sentences, methods = ([], None) if path is None else _words(path)
        problems = self.jobs.problems(job) if job.kind in ("surface", "groom") and job.status == "done" else ""
        return {
            "number": job.number, "kind": job.kind, "command": job.command, "status": job.status,
            "message": self._sentence(problems or job.message), "progress": progress,
            "seconds": self.jobs.running_for(job), "left_s": left_s, "output": job.output,
            "options": job.options, "on": job.on,
            "views": [{"kind": kind, "href": f"/view/{job.number}/{kind}/"} for kind in kinds],
            "sentences": list(map(self._sentence, sentences)), "methods": methods and self._sentence(methods),
            "outdated": self._outdated[1].get(job.number), "partly": bool(problems),
            # A command that rejected its input would reject it again.
            "can_continue": job.status in ("cancelled", "interrupted") or (job.status == "failed" and job.code != 2),
        }  # fmt: skip


def _contents_of(checked: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Return the hash of each scan from the facts of its check, if they contain it."""
    return {name: facts["content"] for name, facts in checked.items() if "content" in facts}


def _words(folder: Path) -> tuple[list[str], str | None]:
    """Return the sentences and the methods paragraph of an analysis; none if the result is no analysis."""
    analysis = folder / "analysis.json"
    return _read_words(analysis, analysis.stat().st_mtime_ns) if analysis.is_file() else ([], None)


@lru_cache(maxsize=256)
def _read_words(analysis: Path, modified_ns: int) -> tuple[list[str], str | None]:
    """Return the words of the analysis that was written at a time; the page asks for them again and again."""
    try:
        sentences = list(plain_json(analysis.read_bytes()).get("summary", []))
    except (OSError, ValueError, AttributeError):
        return [], None
    try:
        return sentences, (analysis.parent / "methods.txt").read_text(encoding="utf-8")
    except (OSError, ValueError):
        return sentences, None


class Studio:
    """The endpoints of the studio, and the owner of the project that is open.

    Args:
        forms: forms of the commands.
        folder: folder of the project to open; None for the start page.
        upload_bytes: size limit of a scan.
        read_only: whether to only show the project, and reject edits and jobs.
    """

    def __init__(self, forms: Forms, folder: Path | None, upload_bytes: int, *, read_only: bool = False) -> None:
        self.ends: Callable[[], bool] = lambda: False  # whether the server is about to end, and streams with it
        self._forms, self._labels = forms, OptionLabels(forms)
        self._upload_bytes = upload_bytes
        self._read_only = read_only
        self._changes, self._state_s = 0, 0.0  # and the seconds that the last state took
        self._open: OpenProject | None = None
        self._lock = threading.RLock()
        if folder is not None:
            is_new = not folder.exists() or (folder.is_dir() and not any(folder.iterdir()))
            self._switch(folder, create=is_new and not read_only)

    def app(self) -> ASGIApp:
        """Return the application, without a guard."""
        job = "/api/jobs/{number:int}"
        routes = [
            route("/", lambda _: html_page()),
            Route("/assets/{name}", asset),
            Route("/api/project", self._state),
            Route("/api/events", self._events),
            route("/api/forms", lambda _: json_response(self._labels.forms)),
            Route("/api/open", self._open_project, methods=["POST"]),
            Route("/api/close", self._close_project, methods=["POST"]),
            Route("/api/folders", self._folders),
            Route("/api/specimens", self._upload, methods=["PUT"]),
            Route("/api/volumes", self._upload_volume, methods=["PUT"]),
            Route("/api/volumes", self._forget_volumes, methods=["DELETE"]),
            Route("/api/labels", self._labels_of_volume, methods=["POST"]),
            Route("/api/import", self._take_files, methods=["POST"]),
            Route("/api/thumbnails/{id}", self._thumbnail),
            Route("/api/scans/{id}", self._scan),
            Route("/api/edit", partial(self._edit, Project.edit), methods=["POST"]),
            Route("/api/undo", partial(self._edit, Project.undo), methods=["POST"]),
            Route("/api/redo", partial(self._edit, Project.redo), methods=["POST"]),
            Route("/api/table", self._table, methods=["POST"]),
            Route("/api/paste", self._match_block, methods=["POST"]),
            Route("/api/checks", self._check, methods=["POST"]),
            Route("/api/jobs", self._add_job, methods=["POST"]),
            Route(f"{job}/cancel", partial(self._change_job, Jobs.cancel), methods=["POST"]),
            Route(f"{job}/continue", partial(self._change_job, Jobs.go_on), methods=["POST"]),
            Route(f"{job}/log", self._log),
            Route(f"{job}/files", self._files),
            route("/api/history", lambda _: PlainTextResponse(history(self._project.jobs.all()))),
            Route("/files/{path:path}", self._file),
            Route("/zip/{number:int}", self._zip),
            Mount("/view", app=self._view),
        ]
        if self._read_only:
            routes = [
                known if isinstance(known, Mount) or "GET" in (known.methods or ())
                else Route(known.path, _reject_change, methods=list(known.methods or ()))
                for known in routes
            ]  # fmt: skip
        return application(routes, self._labels.sentence)

    def close(self) -> None:
        """Close the project."""
        with self._lock:
            if self._open is not None:
                self._open.close()
                self._open = None

    @property
    def _project(self) -> OpenProject:
        if self._open is None:
            raise InputError("No project is open; open one first.")
        return self._open

    def _changed(self) -> None:
        self._changes += 1

    def _switch(self, folder: Path, *, create: bool) -> None:
        with self._lock:
            if self._open is not None and self._open.project.folder == folder.resolve():
                return
            opened = OpenProject(
                folder, self._forms, create=create, changed=self._changed, labels=self._labels,
                read_only=self._read_only,
            )  # fmt: skip
            self.close()
            self._open = opened
            if not self._read_only:
                recent_projects(opened.project.folder)
            self._changed()

    # The state

    def _state(self, request: Request) -> Response:
        began = time.monotonic()
        response = json_response(
            {
                "version": __version__, "project": None if self._open is None else self._open.facts(),
                "recent": recent_projects(), "formats": list(MESH_ENDINGS),
                "landmark_formats": list(CONFIGURATION_ENDINGS), "volume_formats": list(_VOLUME_ENDINGS),
                "upload_bytes": self._upload_bytes,
                "units": list(MM_PER_UNIT), "read_only": self._read_only,
            }
        )  # fmt: skip
        self._state_s = time.monotonic() - began
        return response

    async def _events(self, request: Request) -> Response:
        async def stream() -> AsyncGenerator[str]:
            sent = -1
            while not self.ends() and not await request.is_disconnected():
                if sent != self._changes:
                    sent = self._changes
                    yield f"data: {json.dumps({'revision': sent})}\n\n"
                await asyncio.sleep(max(_EVENT_S, 2.0 * self._state_s))  # the rest of the time is for other requests

        return StreamingResponse(stream(), media_type="text/event-stream")

    async def _open_project(self, request: Request) -> Response:
        content = await json_body(request, _REQUEST_BYTES)
        folder = _place(content.get("folder"))
        await run_in_threadpool(self._switch, folder, create=bool(content.get("create")))
        return json_response({})

    async def _close_project(self, request: Request) -> Response:
        await run_in_threadpool(self.close)
        self._changed()
        return json_response({})

    def _folders(self, request: Request) -> Response:
        path = _place(request.query_params.get("path") or str(Path.home()))
        try:
            entries = sorted(path.iterdir(), key=lambda entry: entry.name.casefold())
            names = [entry.name for entry in entries if entry.is_dir() and not entry.name.startswith(".")]
            scans = sum(entry.name.lower().endswith(MESH_FILE_ENDINGS) for entry in entries)
        except OSError as error:
            raise FileError(f"Cannot read {path}: {error.strerror or error}.") from error
        return json_response(
            {
                "path": str(path), "parent": None if path.parent == path else str(path.parent),
                "folders": names[:_MOST_LISTED], "scans": scans, "is_project": (path / Project.FILE).is_file(),
            }
        )  # fmt: skip

    # Specimens

    async def _upload(self, request: Request) -> Response:
        name, role = display_name(request.query_params.get("name", "")), _role(request.query_params.get("set"))
        if not name.lower().endswith(MESH_FILE_ENDINGS):
            raise HTTPException(415, f"{name} is not a scan that can be read; drop {', '.join(MESH_ENDINGS)}.")
        project = self._project.project
        target = await self._store(request, name)
        added, same_as = await run_in_threadpool(project.add_stored, target, role, name)
        self._changed()
        return json_response({"id": added, "same_as": same_as}, 201)

    async def _store(self, request: Request, name: str) -> Path:
        """Write the body of a request into a new file of the project."""
        project = self._project.project
        limit = f"{name} is larger than the {self._upload_bytes / 2**20:g} MB that the studio takes."
        target = await run_in_threadpool(project.new_file, name)
        with project.removed_on_error(target), atomic_path(target) as path, path.open("wb") as file:
            async with aclosing(body_pieces(request, self._upload_bytes, limit)) as pieces:
                async for piece in pieces:
                    file.write(piece)
        return target

    async def _upload_volume(self, request: Request) -> Response:
        name = display_name(request.query_params.get("name", ""))
        if not name.lower().endswith(_VOLUME_ENDINGS):
            raise HTTPException(415, f"{name} is not a volume that can be read; drop {', '.join(_VOLUME_ENDINGS)}.")
        target = await self._store(request, name)
        kept = await run_in_threadpool(self._project.project.keep_volume, target)
        same_as = None if kept == target else kept.name
        return json_response({"file": f"{kept.parent.name}/{kept.name}", "same_as": same_as}, 201)

    async def _labels_of_volume(self, request: Request) -> Response:
        content = await json_body(request, _REQUEST_BYTES)
        opened = self._project
        [file] = stored_volumes(opened.project, [content.get("file")])
        return json_response(await opened.checks.labels(opened.project.folder / file))

    async def _forget_volumes(self, request: Request) -> Response:
        """Remove uploaded volumes of which no surfaces were made."""
        content = await json_body(request, _REQUEST_BYTES)
        opened = self._project
        used = {word for job in opened.jobs.all() for word in job.arguments}
        for file in stored_volumes(opened.project, content.get("files")):
            if file not in used:
                (opened.project.folder / file).unlink(missing_ok=True)
        return json_response({})

    async def _take_files(self, request: Request) -> Response:
        content = await json_body(request, _REQUEST_BYTES)
        place, role, copy = _place(content.get("path")), _role(content.get("set")), bool(content.get("copy"))
        added, left_out = await run_in_threadpool(self._project.project.import_files, place, role, copy=copy)
        self._changed()
        return json_response({"added": added, "left_out": list(map(self._labels.sentence, left_out))})

    def _thumbnail(self, request: Request) -> Response:
        opened, wanted = self._project, request.path_params["id"]
        for specimen in opened.project.state.specimens:
            picture = opened.checks.picture(opened.project.path(specimen)) if specimen.id == wanted else None
            if picture is not None and picture.is_file():
                return FileResponse(picture, media_type="image/webp")
        raise HTTPException(404, "There is no picture of this specimen.")

    async def _scan(self, request: Request) -> Response:
        opened, wanted = self._project, request.path_params["id"]
        for specimen in opened.project.state.specimens:
            if specimen.id == wanted:
                surface = opened.checks.surface(opened.project.path(specimen), mirrored=specimen.mirrored)
                return binary(await asyncio.wrap_future(surface))
        raise HTTPException(404, "There is no such specimen; reload the page.")

    async def _edit(self, edit: Callable[..., None], request: Request) -> Response:
        content = await json_body(request, _TABLE_BYTES)
        try:
            edit(self._project.project, _revision(content), *([change_of(content)] if edit is Project.edit else []))
        except StaleError as error:
            return refusal(409, str(error))
        self._changed()
        return json_response({"revision": self._project.project.revision})

    async def _table(self, request: Request) -> Response:
        content = await whole_body(request, _TABLE_BYTES, "The table is too large.")
        project = self._project.project
        name = display_name(request.query_params.get("name", "The table"))
        as_landmarks = request.query_params.get("kind") == "landmarks"
        if as_landmarks or await run_in_threadpool(is_landmark_table, content, name, project.state):
            return await self._take_landmarks(content, name)
        columns, cells, notes = await run_in_threadpool(cells_of_table, content, project.state, name)
        await run_in_threadpool(project.edit, None, with_cells(columns, cells))
        self._changed()
        return json_response({"matched": len(cells), "notes": [*notes, *project.state.notes()]})

    async def _take_landmarks(self, content: bytes, name: str) -> Response:
        project = self._project.project
        names, points, curves, notes = await run_in_threadpool(read_points, content, name, project.state)
        await run_in_threadpool(project.edit, None, with_points(names, points, curves), together="import landmarks")
        self._changed()
        off = await run_in_threadpool(self._project.landmarks_off_scans)
        notes += [text for name, text in off.items() if name in points]
        return json_response({"matched": len(points), "landmarks": len(names), "notes": notes})

    async def _match_block(self, request: Request) -> Response:
        content = await json_body(request, _TABLE_BYTES)
        block = read(PastedBlock, content, "The pasted block", "copy the cells again")
        project = self._project.project
        match = await run_in_threadpool(block.match, project.state)
        return json_response({**to_builtins(match), "seen": project.revision})

    # Jobs

    async def _add_job(self, request: Request) -> Response:
        content = await json_body(request, _REQUEST_BYTES)
        kind, options, on = str(content.get("kind", "")), content.get("options"), content.get("on")
        if not isinstance(options, dict) or not (on is None or isinstance(on, int)):
            raise HTTPException(400, "A job needs options, and perhaps the number of another.")
        opened = self._project

        scans = await run_in_threadpool(opened.scan_contents)

        def make(number: int, before: list[Job]) -> Order:
            given = cast(dict[str, Any], options)
            return order(opened.project, before, self._forms, kind, given, on, number, scans)

        job = await run_in_threadpool(opened.jobs.add, kind, make, cast(dict[str, Any], options))
        return json_response({"number": job.number}, 201)

    async def _check(self, request: Request) -> Response:
        content = await json_body(request, _REQUEST_BYTES)
        kind, options, on = str(content.get("kind", "")), content.get("options"), content.get("on")
        opened, shapes = self._project, None
        if kind in QUESTIONS:
            try:
                shapes = shapes_of(opened.project, opened.jobs.all(), kind, on)
            except InputError as error:
                return json_response([{"level": "problem", "text": str(error)}])
        given = cast(dict[str, Any], options) if isinstance(options, dict) else {}
        odd = list[str]()
        if kind == "correspond":
            odd = [f"{name}: {odd.text}" for name, odd in opened.odd_scans().items()]
            odd += [f"{name}: {_MIRRORED}" for name in await run_in_threadpool(opened.mirrored_scans)]
        elif shapes is not None and shapes.number == PLACED:
            odd = [*(await run_in_threadpool(opened.landmarks_off_scans)).values()]
        found = await run_in_threadpool(checks, opened.project, self._forms, kind, given, shapes, odd)
        return json_response([{**finding, "text": self._labels.sentence(finding["text"])} for finding in found])

    def _change_job(self, change: Callable[[Jobs, int], None], request: Request) -> Response:
        change(self._project.jobs, request.path_params["number"])
        return json_response({})

    def _log(self, request: Request) -> Response:
        return PlainTextResponse(self._labels.sentence(self._project.jobs.log(request.path_params["number"])))

    # Results

    def _files(self, request: Request) -> Response:
        folder, paths = self._result_files(request.path_params["number"])
        return json_response(
            [{"path": path.relative_to(folder).as_posix(), "bytes": path.stat().st_size} for path in paths]
        )

    def _file(self, request: Request) -> Response:
        folder = self._project.project.folder
        path = result_path(folder, request.path_params["path"])
        if not path.is_file() or path.name == LOCK:
            raise HTTPException(404, "There is no such file in the project.")
        # As a download: a page among the results must not run as a page of the studio.
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    def _zip(self, request: Request) -> Response:
        number = request.path_params["number"]
        folder, paths = self._result_files(number)
        name = f"{Path(self._project.jobs.get(number).output).name}.zip"
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        return StreamingResponse(_zip_files(folder, paths), media_type="application/zip", headers=headers)

    async def _view(self, scope: Any, receive: Any, send: Any) -> None:
        await self._project.views(scope, receive, send)

    def _result_files(self, number: int) -> tuple[Path, list[Path]]:
        folder = self._project.project.folder.resolve()
        path = result_path(folder, self._project.jobs.get(number).output)
        if path.is_file():
            return folder, [path]
        found = sorted(file for file in path.rglob("*") if file.is_file() and file.name != LOCK)
        return folder, found[:_MOST_LISTED]


def _reject_change(request: Request) -> Response:
    return refusal(403, "This page only shows the project; run shapespace studio to change it.")


class _Pieces:
    """A file that is written to, and read piece by piece as it grows."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def write(self, piece: bytes) -> int:
        self._pieces.append(bytes(piece))
        return len(piece)

    def flush(self) -> None:
        """Do nothing; it has no buffer."""

    def take(self) -> bytes:
        taken, self._pieces = b"".join(self._pieces), []
        return taken


def _zip_files(folder: Path, paths: list[Path]) -> Generator[bytes]:
    """Yield a zip archive of files, without holding it in memory."""
    pieces = _Pieces()
    with zipfile.ZipFile(cast(Any, pieces), "w", zipfile.ZIP_DEFLATED) as archive:
        for path in paths:
            with (
                path.open("rb") as source,
                archive.open(path.relative_to(folder).as_posix(), "w", force_zip64=True) as to,
            ):
                while piece := source.read(2**20):
                    to.write(piece)
                    yield pieces.take()
    yield pieces.take()


def _revision(content: Mapping[str, Any]) -> int:
    revision = content.get("seen", content.get("revision"))
    if not isinstance(revision, int):
        raise HTTPException(400, "An edit needs the revision that it was made on.")
    return revision


def _role(text: object) -> Role:
    return "new" if text == "new" else "training"


def _place(text: object) -> Path:
    if not isinstance(text, str) or not text.strip() or "\0" in text:
        raise InputError("Give the path of a folder or file on this machine.")
    return Path(text.strip()).expanduser()


def make_studio(studio: Studio, access: Access, *, loopback: bool = True, cookie_name: str = "shapespace") -> ASGIApp:
    """Return the application behind a guard.

    Args:
        studio: the endpoints.
        access: the secrets of this studio.
        loopback: whether only this machine can reach the server.
        cookie_name: browsers share cookies between ports, so the name should contain the port.
    """
    return Guard(studio.app(), access=access, cookie_name=cookie_name, loopback=loopback)
