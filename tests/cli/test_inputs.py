"""Scans named by pattern, list and address, and what is known of them carried to the results."""

import csv
import http.server
import json
import shutil
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from conftest import Run, World, leftovers
from shapespace.io import remote

FAST = ("--set", "max_iterations=3", "--jobs", "1", "--quiet")


def rows(folder: Path) -> dict[str, dict[str, str]]:
    with (folder / "coefficients.csv").open(newline="") as stream:
        return {row["scan"]: row for row in csv.DictReader(stream)}


def test_ids_and_columns_of_a_list_are_carried_to_the_results(run: Run, world: World, tmp_path: Path) -> None:
    shutil.copy(world.scan, tmp_path / "here.ply")
    table = f"id,scan,site,age\nP1,here.ply,Preston,41\nP2,{world.scans[1]},Leeds,\n,none.ply,Leeds,3\n"
    (tmp_path / "scans.csv").write_text("\ufeff" + table, encoding="utf-8")
    out = tmp_path / "out"
    assert run("fit", world.model, tmp_path / "scans.csv", "-o", out, *FAST).code == 1
    found = rows(out)
    assert {name: (row["meta_site"], row["meta_age"]) for name, row in found.items()} == {
        "P1": ("Preston", "41"), "P2": ("Leeds", ""), "none": ("Leeds", "3"),
    }  # fmt: skip
    assert json.loads((out / "P1.fit.json").read_text())["metadata"] == {"site": "Preston", "age": "41"}
    assert found["none"]["status"] == "failed" and "none.ply" in found["none"]["reason"]
    # What is known of a scan may change without the scan.
    (tmp_path / "scans.csv").write_text(table.replace("41", "42"))
    before = (out / "P1.fitted.ply").stat().st_mtime_ns
    assert "2 of 3" in run("fit", world.model, tmp_path / "scans.csv", "-o", out, *FAST).err
    assert rows(out)["P1"]["meta_age"] == "42" and (out / "P1.fitted.ply").stat().st_mtime_ns == before


def test_lists_of_lines_and_patterns_name_scans(run: Run, world: World, tmp_path: Path) -> None:
    folder = world.scans[0].parent
    (tmp_path / "scans.txt").write_text(f"# the first ones\n{world.scans[0]}\n\n{folder}/scan_[12].ply\n")
    assert run("fit", world.model, tmp_path / "scans.txt", "-o", tmp_path / "a", *FAST).code == 0
    assert run("fit", world.model, f"{folder}/scan_*.ply", "-o", tmp_path / "b", *FAST).code == 0
    assert rows(tmp_path / "a").keys() == rows(tmp_path / "b").keys() == {"scan_0", "scan_1", "scan_2"}
    assert "No file matches" in run("fit", world.model, f"{folder}/nothing_*.ply", "-o", tmp_path / "c").sentence()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("person,age\na,3\n", "needs a column named scan or file or path"),
        ("scan,scan\na,b\n", "two columns of the same name"),
        ("scan\n", "lists no scans"),
        ("", "needs a column"),
        ("id,scan\n../x,a.ply\n", "row 2 has an id that no file can have"),
        ("id,scan\nx,a.ply\nX,b.ply\n", "Two scans have the id"),
        ("scan,age\na.ply,1\nb.ply,2\na.ply,3\n", "rows 1 ('a.ply') and 3 ('a.ply') are of one specimen"),
        ("id,scan\nx,a.ply\nX,a.ply\n", "rows 1 ('x') and 2 ('X') are of one specimen"),
        ("scan,age\na.ply,3,4\n", "has 3 cells in row 1"),
        ("scan,age\n,3\n", "row 2 names no scan"),
        ("scan\n\0\n", "binary"),
        (b"\xff\xfe\x00", "UTF-16"),
    ],
)
def test_a_list_that_is_none_is_one_sentence(
    text: str | bytes, said: str, run: Run, world: World, tmp_path: Path
) -> None:
    (tmp_path / "scans.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    outcome = run("fit", world.model, tmp_path / "scans.csv", "-o", tmp_path / "out")
    assert outcome.code == 2 and said in outcome.sentence()


class Shy(http.server.SimpleHTTPRequestHandler):
    """Serves a folder, but for the first times that a file is asked for."""

    refused: dict[str, int]

    def do_GET(self) -> None:
        self.refused[self.path] = self.refused.get(self.path, 0) + 1
        if self.path.startswith("/shy") and self.refused[self.path] < remote.TRIES:
            self.send_error(503)
        else:
            super().do_GET()

    def log_message(self, format: str, *args: Any) -> None:
        pass


@pytest.fixture
def served(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """The address of a folder with scans."""
    pytest.importorskip("aiohttp", reason="the extra 'remote' is not installed")
    monkeypatch.setattr(remote, "_WAIT_S", 0.01)
    folder = tmp_path / "served"
    folder.mkdir()
    for name in ("scan.ply", "shy.ply"):
        shutil.copy(world.scan, folder / name)
    handler = type("Handler", (Shy,), {"refused": {}})
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), lambda *a: handler(*a, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_addresses_are_fetched_tried_again_and_fail_alone(served: str, run: Run, world: World, tmp_path: Path) -> None:
    out = tmp_path / "out"
    scans = [f"{served}/{name}.ply" for name in ("scan", "shy", "none")]
    outcome = run("fit", world.model, *scans, "-o", out, *FAST)
    assert outcome.code == 1, outcome.err
    found = rows(out)
    assert {name: row["status"] for name, row in found.items()} == {
        "scan": "max_iterations", "shy": "max_iterations", "none": "failed",
    }  # fmt: skip
    assert found["scan"]["path"] == scans[0] and scans[2] in found["none"]["reason"]
    assert found["scan"]["b1"] == found["shy"]["b1"]
    assert leftovers(tmp_path) == []
    # The same again fetches nothing that has not changed.
    times = (out / "scan.fit.json").stat().st_mtime_ns
    assert "2 of 3" in run("fit", world.model, *scans, "-o", out, *FAST).err
    assert (out / "scan.fit.json").stat().st_mtime_ns == times


def test_scans_in_an_archive_and_in_a_bucket_are_scans(
    run: Run, world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("fsspec", reason="the extra 'remote' is not installed")
    with zipfile.ZipFile(tmp_path / "scans.zip", "w") as archive:
        for scan in world.scans[:2]:
            archive.write(scan, f"raw/{scan.name}")
    out = tmp_path / "zip"
    outcome = run("fit", world.model, f"zip://raw/*.ply::file://{tmp_path}/scans.zip", "-o", out, *FAST)
    assert outcome.code == 0, outcome.err
    assert rows(out).keys() == {"scan_0", "scan_1"}

    server = pytest.importorskip("moto.server", reason="moto's server is not installed").ThreadedMotoServer(
        "127.0.0.1", 0
    )
    server.start()
    try:
        host, port = server.get_host_and_port()
        keys = {"AWS_ACCESS_KEY_ID": "x", "AWS_SECRET_ACCESS_KEY": "x", "AWS_DEFAULT_REGION": "us-east-1"}
        for name, value in {**keys, "AWS_ENDPOINT_URL": f"http://{host}:{port}"}.items():
            monkeypatch.setenv(name, value)
        import s3fs

        s3fs.S3FileSystem.clear_instance_cache()
        bucket = s3fs.S3FileSystem()
        bucket.mkdir("scans")
        for scan in world.scans[:2]:
            bucket.put(str(scan), f"scans/site1/{scan.name}")
        out = tmp_path / "s3"
        outcome = run("fit", world.model, "s3://scans/site1", "-o", out, *FAST)
        assert outcome.code == 0, outcome.err
        assert {name: row["path"] for name, row in rows(out).items()} == {
            f"scan_{k}": f"s3://scans/site1/scan_{k}.ply" for k in (0, 1)
        }
        assert "s3://scans/none" in run("fit", world.model, "s3://scans/none/x.ply", "-o", out, *FAST).err
    finally:
        server.stop()
