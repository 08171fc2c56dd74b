"""The studio's server: files to results over HTTP, jobs that outlive it, and requests that it refuses."""

import errno
import os
import subprocess
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from io import BytesIO
from multiprocessing import active_children
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import httpx
import pytest
from msgspec.structs import replace
from test_studio_project import tetrahedron
from viewer_world import enter, sentence, served, unpacked

from shapespace.cli.command_table import summaries_and_options
from shapespace.cli.forms import forms
from shapespace.errors import FileError
from shapespace.io.files import make_folder
from shapespace.viewer import serve
from shapespace.viewer.guard import Access
from shapespace.viewer.studio import run_job
from shapespace.viewer.studio.app import Studio, make_studio
from shapespace.viewer.studio.jobs import Jobs, Order
from shapespace.viewer.studio.specimen_checks import SpecimenChecks, compile_fits

FORMS = forms(summaries_and_options())


@contextmanager
def studio(folder: Path | None, upload_bytes: int = 10**6, *, read_only: bool = False) -> Iterator[httpx.Client]:
    made, access = Studio(FORMS, folder, upload_bytes, read_only=read_only), Access()
    try:
        with served(make_studio(made, access)) as address, httpx.Client(base_url=address, timeout=60) as client:
            enter(client, access)
            yield client
    finally:
        made.close()


@pytest.fixture(autouse=True)
def own_home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))


def state(client: httpx.Client) -> dict[str, Any]:
    return client.get("/api/project").json()["project"]


def until(client: httpx.Client, true: Callable[[dict[str, Any]], bool], seconds: float = 120.0) -> dict[str, Any]:
    end = time.monotonic() + seconds
    while not true(now := state(client)):
        assert time.monotonic() < end, now
        time.sleep(0.1)
    return now


def ended(project: dict[str, Any]) -> bool:
    return all(job["status"] not in ("waiting", "running") for job in project["jobs"])


def upload(client: httpx.Client, tmp_path: Path, count: int, role: str = "training") -> None:
    for k in range(count):
        scan = tetrahedron(tmp_path / f"s{k}.ply", 1.0 + k)
        answer = client.put("/api/specimens", params={"name": scan.name, "set": role}, content=scan.read_bytes())
        assert answer.status_code == 201, answer.text


@pytest.mark.parametrize("read_only", [False, True])
def test_the_studio_compiles_the_code_of_a_fit_while_scans_are_dropped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read_only: bool
) -> None:
    with studio(tmp_path / "p"):
        pass
    compilers: list[BaseProcess] = []

    def run(*_: object, **__: object) -> None:
        compilers.extend(process for process in active_children() if process.name == compile_fits.__name__)

    monkeypatch.setattr(serve, "_run", run)
    serve.serve_studio(tmp_path / "p", FORMS, read_only=read_only)
    for process in compilers:
        process.join(300)
    assert [process.exitcode for process in compilers] == ([] if read_only else [0])


def test_dropped_scans_are_checked_pictured_and_listed(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        upload(client, tmp_path, 2)
        client.put("/api/specimens", params={"name": "broken.ply"}, content=b"ply\nnonsense")
        again = client.put("/api/specimens", params={"name": "copy.ply"}, content=(tmp_path / "s1.ply").read_bytes())
        assert again.json() == {"id": "s1", "same_as": "s1"}
        project = until(client, lambda now: all(one["state"] != "waiting" for one in now["specimens"]))
        s0, _, broken = project["specimens"]
        assert (s0["vertices"], s0["triangles"], s0["state"]) == (4, 4, "ready")
        assert broken["state"] == "unusable" and str(tmp_path) not in broken["findings"][0]["text"]
        assert client.get("/api/thumbnails/s0").content[8:12] == b"WEBP"
        assert client.get("/api/thumbnails/broken").status_code == 404
        _, surface = unpacked(client.get("/api/scans/s0").content)
        assert surface["positions"].shape == (4, 3) and surface["faces"].shape == (4, 3) and not len(surface["borders"])
        answer = client.get("/api/scans/broken")
        assert answer.status_code == 422 and str(tmp_path) not in answer.json()["error"]
        assert client.get("/api/scans/nobody").status_code == 404


def test_a_scan_that_is_replaced_under_its_path_is_checked_and_pictured_again(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        upload(client, tmp_path, 1)
        first = until(client, lambda now: now["specimens"][0]["state"] == "ready")["specimens"][0]
        (tmp_path / "p" / first["file"]).write_bytes(tetrahedron(tmp_path / "new.ply", 50.0).read_bytes())
        assert state(client)["specimens"][0]["scan"] != first["scan"]  # of which the address of the picture is made
        again = until(client, lambda now: now["specimens"][0]["state"] == "ready")["specimens"][0]
        assert again["extent"] > 10 * first["extent"]
        assert client.get("/api/thumbnails/s0").content[8:12] == b"WEBP"


def test_scans_of_one_name_size_and_time_in_different_folders_are_checked_each(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        for k in (1, 2):  # as an archive with a folder for each subject is unpacked
            scan = tetrahedron(make_folder(tmp_path / f"P{k}") / "face.ply", float(k))
            os.utime(scan, (1_700_000_000, 1_700_000_000))
            client.post("/api/import", json={"path": str(scan.parent), "set": "training", "copy": False})
        now = until(client, lambda now: all(specimen["state"] == "ready" for specimen in now["specimens"]))
        first, second = now["specimens"]
        assert first["scan"] != second["scan"] and second["extent"] == pytest.approx(2 * first["extent"], rel=1e-3)


def test_a_usable_scan_is_never_excluded_however_often_its_check_is_asked_for(tmp_path: Path) -> None:
    excluded: list[Path] = []
    checks = SpecimenChecks(tmp_path / "p", lambda: None, excluded.append)
    scans = [tetrahedron(tmp_path / f"s{k}.ply", 1.0 + k) for k in range(20)]
    end = time.monotonic() + 60
    try:
        # The file of a check is read here before its process has reported it.
        while any(checks.facts(scan) is None for scan in scans):
            assert time.monotonic() < end
    finally:
        checks.close()
    assert excluded == [] and all(checks.facts(scan)["state"] == "ready" for scan in scans)


def test_what_cannot_be_taken_is_refused_in_a_sentence(tmp_path: Path) -> None:
    with studio(tmp_path / "p", upload_bytes=100) as client:
        assert client.put("/api/specimens", params={"name": "a.exe"}, content=b"x").status_code == 415
        assert client.put("/api/specimens", params={"name": "a.ply"}, content=b"x" * 200).status_code == 413
        assert not list((tmp_path / "p" / "scans").iterdir())
        for path, content in (
            ("/api/edit", {"what": "remove"}), ("/api/edit", {"revision": 0, "what": "x"}), ("/api/jobs", {}),
            ("/api/jobs", {"kind": "correspond", "options": {}}), ("/api/jobs", {"kind": "rm", "options": {}}),
            ("/api/jobs", {"kind": "build", "options": {}}), ("/api/import", {"path": str(tmp_path / "nowhere")}),
            ("/api/open", {"folder": str(tmp_path)}), ("/api/open", {"folder": ""}),
            ("/api/jobs/7/cancel", {}), ("/api/jobs/7/continue", {}),
        ):  # fmt: skip
            answer = client.post(path, json=content)
            assert 400 <= answer.status_code < 500 and sentence(answer), (path, answer.text)
        for path in ("/files/../secret", "/files/%2e%2e/%2e%2e/etc/passwd", "/view/1/", "/zip/1", "/api/jobs/1/log"):
            assert 400 <= client.get(path).status_code < 500, path
        assert client.post("/api/edit", content=b"[" * 5000).status_code == 400


def test_files_of_one_name_that_come_at_the_same_time_are_all_kept(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        scans = [tetrahedron(tmp_path / f"t{k}.ply", 1.0 + k).read_bytes() for k in range(8)]
        with ThreadPoolExecutor(8) as threads:
            put = [threads.submit(client.put, "/api/specimens?name=scan.ply", content=scan) for scan in scans]
        assert sorted(one.result().json()["id"] for one in put)[0] == "scan"
        specimens = state(client)["specimens"]
        assert len({one["id"] for one in specimens}) == len({one["file"] for one in specimens}) == 8
        assert sorted((tmp_path / "p" / one["file"]).read_bytes() for one in specimens) == sorted(scans)


def test_an_edit_of_an_old_state_is_a_conflict(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        for column, status in (("age", 200), ("sex", 409)):
            edit = {"revision": 0, "what": "add-column", "column": column}
            assert client.post("/api/edit", json=edit).status_code == status
        assert state(client)["columns"] == ["age"]
        assert client.post("/api/undo", json={"revision": 1}).status_code == 200
        assert state(client)["columns"] == [] and state(client)["redo"] == "add the column age"


def test_an_option_that_the_form_does_not_have_never_reaches_a_command(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        upload(client, tmp_path, 2)
        for options in ({"--output": "/etc"}, {"-o": "x"}, {"--template": "/etc/passwd"}, {"; rm": True}):
            answer = client.post("/api/jobs", json={"kind": "correspond", "options": options})
            assert answer.status_code == 422 and "has no option" in sentence(answer)
        assert state(client)["jobs"] == []


def test_another_page_and_a_wrong_token_get_nothing(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        foreign = {"Origin": "http://evil.example"}
        assert client.post("/api/edit", json={"revision": 0}, headers=foreign).status_code == 403
        assert client.put("/api/specimens?name=a.ply", content=b"x", headers=foreign).status_code == 403
        client.cookies.clear()
        assert client.get("/api/project").status_code == 401
        assert client.get("/", params={"token": "guess"}).status_code == 401


def test_two_studios_cannot_write_into_one_project(tmp_path: Path) -> None:
    with studio(tmp_path / "p"), pytest.raises(FileError, match="is being written by another"):
        Studio(FORMS, tmp_path / "p", 1)


def test_a_read_only_studio_shows_a_project_beside_another_one_and_writes_nothing(tmp_path: Path) -> None:
    folder = tmp_path / "p"
    with studio(folder) as client:
        upload(client, tmp_path, 1)
        until(client, lambda now: all(one["state"] != "waiting" for one in now["specimens"]))

        def files() -> dict[Path, bytes]:
            return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file() and path.name != "lock"}

        before = files()
        with studio(folder, read_only=True) as viewer:
            shown = viewer.get("/api/project").json()
            assert shown["read_only"] and [one["id"] for one in shown["project"]["specimens"]] == ["s0"]
            assert viewer.get("/api/thumbnails/s0").status_code == 200
            for path in ("/api/edit", "/api/undo", "/api/jobs", "/api/table", "/api/close", "/api/open"):
                answer = viewer.post(path, json={"revision": 0})
                assert answer.status_code == 403 and "only shows the project" in sentence(answer), path
            assert viewer.put("/api/specimens?name=a.ply", content=b"x").status_code == 403
        assert files() == before


def test_on_a_full_disk_nothing_is_lost_and_the_reason_is_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "p"
    with studio(folder) as client:
        upload(client, tmp_path, 2)
        until(client, lambda now: all(one["state"] != "waiting" for one in now["specimens"]))
        before = (folder / "project.json").read_bytes()

        def full(*_: object) -> None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        monkeypatch.setattr(os, "replace", full)
        answers = [
            client.put("/api/specimens?name=more.ply", content=(tmp_path / "s0.ply").read_bytes() + b"\n"),
            client.post("/api/edit", json={"revision": state(client)["revision"], "what": "remove", "ids": ["s0"]}),
            client.post("/api/jobs", json={"kind": "correspond", "options": {}}),
        ]
        for answer in answers:
            assert answer.status_code in (422, 507) and "the disk is full" in sentence(answer)
        assert (folder / "project.json").read_bytes() == before
        assert sorted(path.name for path in (folder / "scans").iterdir()) == ["s0.ply", "s1.ply"]
        assert [one["id"] for one in state(client)["specimens"]] == ["s0", "s1"] and state(client)["jobs"] == []
        monkeypatch.undo()
        assert client.post("/api/jobs", json={"kind": "correspond", "options": {}}).json()["number"] == 1


def test_a_project_is_opened_from_the_page_and_is_among_the_recent_ones(tmp_path: Path) -> None:
    with studio(None) as client:
        assert client.get("/api/project").json()["project"] is None
        assert client.post("/api/edit", json={"revision": 0, "what": "add-column", "column": "a"}).status_code == 422
        folder = str(tmp_path / "new")
        assert client.post("/api/open", json={"folder": folder, "create": True}).status_code == 200
        assert state(client)["name"] == "new"
        assert client.get("/api/folders", params={"path": str(tmp_path)}).json()["folders"] == ["new", "state"]
        assert client.get("/api/project").json()["recent"][0] == {"name": "new", "folder": folder, "exists": True}
        client.post("/api/close", json={})
        assert client.get("/api/project").json()["project"] is None


def command(jobs: Jobs, *arguments: str) -> int:
    return jobs.add("data", lambda number, before: Order(arguments, f"out-{number}")).number


def wait_for(jobs: Jobs, number: int, *statuses: str) -> Any:
    end = time.monotonic() + 120
    while jobs.get(number).status not in statuses:
        assert time.monotonic() < end, (jobs.get(number), jobs.log(number))
        time.sleep(0.05)
    return jobs.get(number)


def test_jobs_run_in_order_and_tell_how_they_ended(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path, lambda: None)
    try:
        first = command(jobs, "data", "bones", "--count", "2", "-o", "out-1")
        second = command(jobs, "build", "nowhere", "-o", "m.h5")
        cancelled = command(jobs, "data", "bones", "-o", "out-3")
        jobs.cancel(cancelled)
        assert wait_for(jobs, first, "done", "failed").status == "done"
        assert (tmp_path / "out-1" / "bone_000.ply").is_file()
        failed = wait_for(jobs, second, "done", "failed")
        assert failed.status == "failed" and failed.code == 2 and "nowhere" in failed.message
        assert jobs.get(cancelled).status == "cancelled" and not (tmp_path / "out-3").exists()
    finally:
        jobs.close()


def test_a_job_goes_on_without_the_server_and_is_found_again(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path, lambda: None)
    number = command(jobs, "data", "bones", "--count", "3", "-o", "out-1")
    wait_for(jobs, number, "running", "done")
    jobs.close()  # as a server that is killed: the thread ends, the process goes on
    again = Jobs(tmp_path, lambda: None)
    try:
        assert wait_for(again, number, "done", "failed", "interrupted").status == "done"
        assert len(list((tmp_path / "out-1").glob("*.ply"))) == 3
    finally:
        again.close()


def test_a_cancelled_job_can_be_continued(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path, lambda: None)
    try:
        number = command(jobs, "data", "bones", "--count", "40", "-o", "out-1")
        end = time.monotonic() + 60
        while not list((tmp_path / "out-1").glob("*.ply")) and time.monotonic() < end:
            time.sleep(0.05)
        jobs.cancel(number)
        assert wait_for(jobs, number, "cancelled", "done").status == "cancelled"
        jobs.go_on(number)
        assert wait_for(jobs, number, "done", "failed").status == "done"
    finally:
        jobs.close()


def statuses(jobs: Jobs) -> dict[int, str]:
    return {job.number: job.status for job in jobs.all()}


def test_independent_jobs_run_together_and_jobs_on_the_same_results_wait(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path, lambda: None, at_once=3)
    try:
        long = command(jobs, "data", "bones", "--count", "3000", "-o", "out-1")
        reader = jobs.add("build", lambda number, before: Order(("build", "out-1", "-o", "m.h5"), "m.h5")).number
        changed = jobs.add("redo", lambda number, before: Order(("build", "out-1", "-o", "out-1"), "out-1")).number
        after = jobs.add("build", lambda number, before: Order(("build", "m.h5/x", "-o", "out-4"), "out-4")).number
        free = command(jobs, "data", "bones", "--count", "2", "-o", "out-5")
        assert wait_for(jobs, free, "done", "failed").status == "done"
        assert statuses(jobs) == {
            long: "running",
            reader: "waiting",
            changed: "waiting",
            after: "waiting",
            free: "done",
        }
        jobs.cancel(reader)
        jobs.cancel(after)
        jobs.cancel(long)
        assert wait_for(jobs, long, "cancelled", "done").status == "cancelled"
        wait_for(jobs, changed, "failed")  # it waited for the end of the job that writes its input
    finally:
        jobs.close()


def test_a_long_job_that_has_just_let_go_of_its_folder_is_not_interrupted(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path, lambda: None)
    jobs.close()
    job = replace(jobs.get(command(jobs, "data", "bones", "-o", "out-1")), status="running")
    jobs._started[job.number], jobs._alive[job.number] = time.time() - 100, time.time()
    assert jobs._with_status(job).status == "running"
    jobs._alive[job.number] -= 100
    assert jobs._with_status(job).status == "interrupted"


def test_no_more_jobs_run_than_cores_allow_and_they_start_in_order(tmp_path: Path) -> None:
    most: list[int] = []

    def changed() -> None:
        most.append(sum(job.status == "running" for job in jobs.all()))

    jobs = Jobs(tmp_path, changed, at_once=2)
    try:
        numbers = [command(jobs, "data", "bones", "--count", "2", "-o", f"out-{k}") for k in (1, 2, 3, 4)]
        for number in numbers:
            assert wait_for(jobs, number, "done", "failed").status == "done"
            assert all(jobs.get(other).status != "waiting" for other in numbers if other < number)
        assert max(most) == 2
        assert [line.split()[-1] for line in (tmp_path / "history.sh").read_text().splitlines()[-4:]] == [
            "out-1", "out-2", "out-3", "out-4",
        ]  # fmt: skip
    finally:
        jobs.close()


def test_two_jobs_go_on_without_the_server_and_the_next_one_waits_for_the_cores(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path, lambda: None, at_once=2)
    numbers = [command(jobs, "data", "bones", "--count", "6", "-o", f"out-{k}") for k in (1, 2, 3)]
    for number in numbers[:2]:
        wait_for(jobs, number, "running", "done")
    jobs.close()  # as a server that is killed
    again = Jobs(tmp_path, lambda: None, at_once=2)
    try:
        assert again.get(3).status == "waiting" or "running" not in {again.get(k).status for k in (1, 2)}
        for number in numbers:
            assert wait_for(again, number, "done", "failed", "interrupted").status == "done"
            assert len(list((tmp_path / f"out-{number}").glob("*.ply"))) == 6
    finally:
        again.close()


def test_the_page_is_not_drawn_again_while_two_jobs_report_the_same_progress(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{Jobs.__module__}.start", lambda folder: folder)
    monkeypatch.setattr(f"{Jobs.__module__}.is_running", lambda folder: True)
    changes: list[int] = []
    jobs = Jobs(tmp_path, lambda: changes.append(1), at_once=2)
    try:
        for k in (1, 2):
            number = command(jobs, "data", f"{k}")
            (jobs.folder_of(jobs.get(number)) / run_job.PROGRESS).write_text('{"doing": "x"}')
            wait_for(jobs, number, "running")
        time.sleep(1.0)
        before = len(changes)
        time.sleep(1.0)
        assert len(changes) == before
    finally:
        jobs.close()


def test_the_processes_of_checks_have_ended_when_the_checks_are_closed(tmp_path: Path) -> None:
    """A thread of theirs that ends with the program may close a pipe that the program writes into."""
    before = {thread.name for thread in threading.enumerate()} | {process.name for process in active_children()}
    checks = SpecimenChecks(tmp_path / "p", lambda: None, lambda _: None)
    for k in range(6):
        checks.facts(tetrahedron(tmp_path / f"s{k}.ply", 1.0 + k))
    checks.close()
    files = set((tmp_path / "p").rglob("*"))
    left = {thread.name for thread in threading.enumerate()} | {process.name for process in active_children()}
    assert left <= before and files == set((tmp_path / "p").rglob("*"))


def test_a_job_whose_process_was_killed_is_interrupted(tmp_path: Path) -> None:
    jobs = Jobs(tmp_path, lambda: None)
    number = command(jobs, "data", "bones", "--count", "40", "-o", "out-1")
    wait_for(jobs, number, "running")
    folder = jobs.folder_of(jobs.get(number))
    end = time.monotonic() + 30
    while not run_job.is_running(folder) and time.monotonic() < end:
        time.sleep(0.02)
    jobs.close()
    subprocess.run(["pkill", "-9", "-f", f"run_job {folder}"], check=False)
    subprocess.run(["pkill", "-9", "-f", "data bones --count 40 -o out-1"], check=False)
    end = time.monotonic() + 30
    while run_job.is_running(folder) and time.monotonic() < end:
        time.sleep(0.02)
    again = Jobs(tmp_path, lambda: None)
    try:
        assert again.get(number).status == "interrupted"
        again.go_on(number)
        assert wait_for(again, number, "done", "failed").status == "done"
    finally:
        again.close()


def test_results_are_listed_and_downloaded_alone_and_together(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        project = tmp_path / "p"
        (project / "out-1").mkdir()
        (project / "out-1" / "a.csv").write_text("1,2\n")
        job = project / "jobs" / "0001"
        job.mkdir(parents=True)
        (job / "job.json").write_text('{"number": 1, "kind": "fit", "arguments": ["fit"], "output": "out-1"}')
        (job / "exit.json").write_text('{"code": 0, "seconds": 1.5}')
        (job / "log.txt").write_text("done\n")
        client.post("/api/close", json={})
        client.post("/api/open", json={"folder": str(project)})
        assert state(client)["jobs"][0]["status"] == "done"
        assert client.get("/api/jobs/1/files").json() == [{"path": "out-1/a.csv", "bytes": 4}]
        answer = client.get("/files/out-1/a.csv")
        assert answer.text == "1,2\n" and answer.headers["content-disposition"].startswith("attachment")
        with zipfile.ZipFile(BytesIO(client.get("/zip/1").content)) as archive:
            assert archive.read("out-1/a.csv") == b"1,2\n"
        assert "run shapespace fit" in client.get("/api/history").text


def test_a_result_outside_the_project_is_never_served(tmp_path: Path) -> None:
    with studio(tmp_path / "p") as client:
        (tmp_path / "secret.txt").write_text("x")
        (tmp_path / "p" / "link").symlink_to(tmp_path / "secret.txt")
        assert client.get("/files/link").status_code == 422
