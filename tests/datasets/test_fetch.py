import contextlib
import hashlib
import http.server
import re
import shutil
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from shapespace.datasets import fetch, ict_files
from shapespace.errors import DataError, FileError

ICT_OBJS = ("generic_neutral_mesh", "identity000", "identity001", "jawOpen")


class Server:
    """A loopback server of one folder that can cut connections, ignore Range, and count what it was asked for."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.requests: list[tuple[str, str | None]] = []
        self.cut_after: int | None = None
        self.cuts = 1
        self.ranges = True
        server = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                server.answer(self)

            def log_message(self, format: str, *args: object) -> None:
                pass

        self.http = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.http.server_port}"

    def answer(self, handler: http.server.BaseHTTPRequestHandler) -> None:
        asked = handler.headers.get("Range")
        self.requests.append((handler.path, asked))
        path = self.folder / handler.path.lstrip("/")
        if not path.is_file():
            handler.send_error(404)
            return
        data = path.read_bytes()
        start = int(re.fullmatch(r"bytes=(\d+)-", asked)[1]) if asked and self.ranges else 0
        if start and start >= len(data):
            handler.send_error(416)
            return
        handler.send_response(206 if start else 200)
        if start:
            handler.send_header("Content-Range", f"bytes {start}-{len(data) - 1}/{len(data)}")
        handler.send_header("Content-Length", str(len(data) - start))
        handler.end_headers()
        body = data[start:]
        if self.cut_after is not None and self.cuts > 0 and len(body) > self.cut_after:
            self.cuts -= 1
            body = body[: self.cut_after]
        with contextlib.suppress(ConnectionError):
            handler.wfile.write(body)


@pytest.fixture
def server(tmp_path: Path, shared_data: Path) -> Iterator[Server]:
    folder = tmp_path / "served"
    shutil.copytree(shared_data / "james", folder / "james")
    for path in folder.rglob("*"):
        path.chmod(0o755)
    one = Server(folder)
    thread = threading.Thread(target=one.http.serve_forever, args=(0.02,))
    thread.start()
    yield one
    one.http.shutdown()
    one.http.server_close()
    thread.join()


@pytest.fixture(autouse=True)
def no_mirror(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    if "shared_data" in request.fixturenames:
        request.getfixturevalue("shared_data")
    monkeypatch.delenv("SHAPESPACE_DATA", raising=False)
    monkeypatch.delenv("SHAPESPACE_DATA_URL", raising=False)
    monkeypatch.setenv("SHAPESPACE_CACHE", str(tmp_path / "cache"))


def james_from(server: Server, **options: object) -> Path:
    return fetch.data_get("james", base_url=server.url, progress=False, **options)


def assert_whole(folder: Path) -> None:
    for file in fetch.DATASETS["james"].files:
        assert hashlib.sha256((folder / file.path).read_bytes()).hexdigest() == file.sha256
    assert "Redistribution" in (folder / "LICENSE.txt").read_text()
    assert not list(folder.rglob("*.part"))


def test_every_data_set_names_a_full_commit_and_a_hash_for_every_file() -> None:
    for entry in fetch.DATASETS.values():
        assert re.fullmatch("[0-9a-f]{40}", entry.commit)
        assert all(re.fullmatch("[0-9a-f]{64}", f.content_sha256 or f.sha256 or "") for f in entry.files)
        assert entry.commit in entry.published_url
    assert len(fetch.DATASETS["ict-facekit"].files) == 1 + 100 + 57


def test_a_download_is_whole_and_a_second_call_makes_no_request(server: Server, tmp_path: Path) -> None:
    folder = james_from(server)
    assert folder == tmp_path / "cache" / "james"
    assert_whole(folder)
    count = len(server.requests)
    assert james_from(server) == folder
    assert len(server.requests) == count == 4


def test_the_server_can_be_named_by_the_environment(server: Server, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHAPESPACE_DATA_URL", server.url + "/")
    assert_whole(fetch.data_get("james", progress=False))


def test_a_wrong_hash_is_refused_and_nothing_of_it_stays(server: Server) -> None:
    path = server.folder / "james" / "james.obj"
    data = bytearray(path.read_bytes())
    data[1000] ^= 1
    path.write_bytes(data)
    with pytest.raises(DataError, match=r"james\.obj does not match its published SHA-256"):
        james_from(server)
    assert not (fetch.cache_folder() / "james" / "james.obj").exists()
    assert not list(fetch.cache_folder().rglob("*.part"))
    assert fetch.data_folder("james") is None


def test_a_cut_connection_is_resumed_with_a_range_in_the_same_call(server: Server) -> None:
    server.cut_after = 300_000
    assert_whole(james_from(server))
    assert ("/james/james.obj", "bytes=300000-") in server.requests


def test_a_download_that_died_is_resumed_by_the_next_call(server: Server) -> None:
    server.cut_after, server.cuts = 100_000, 99
    with pytest.raises(DataError, match=r"cut after 300000 of 738198 bytes.*SHAPESPACE_DATA"):
        james_from(server)
    assert fetch.data_folder("james") is None
    server.cut_after = None
    server.requests.clear()
    assert_whole(james_from(server))
    assert server.requests[0] == ("/james/james.obj", "bytes=300000-")


def test_a_server_that_ignores_range_sends_it_all_again(server: Server) -> None:
    server.cut_after, server.ranges = 300_000, False
    assert_whole(james_from(server))


def test_a_partial_file_of_something_else_is_found_out(server: Server) -> None:
    folder = fetch.cache_folder() / "james"
    folder.mkdir(parents=True)
    (folder / "james.obj.part").write_bytes(b"x" * 1000)
    with pytest.raises(DataError, match="SHA-256"):
        james_from(server)
    assert_whole(james_from(server))


def test_a_partial_file_that_is_too_long_is_thrown_away(server: Server) -> None:
    folder = fetch.cache_folder() / "james"
    folder.mkdir(parents=True)
    (folder / "james.obj.part").write_bytes(b"x" * 800_000)
    assert_whole(james_from(server))


def test_half_a_file_in_the_cache_is_never_taken_for_whole(server: Server) -> None:
    folder = james_from(server)
    data = (folder / "james.obj").read_bytes()
    (folder / "james.obj").write_bytes(data[: len(data) // 2])
    with pytest.raises(DataError, match=r"james\.obj does not match.*delete it"):
        james_from(server)


def test_no_network_names_the_address_the_cache_and_the_way_out(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with pytest.raises(DataError) as caught:
        fetch.data_get("james", base_url=f"http://127.0.0.1:{port}", progress=False)
    message = str(caught.value)
    assert f"http://127.0.0.1:{port}/james/james.obj" in message
    assert str(tmp_path / "cache" / "james") in message
    assert "SHAPESPACE_DATA" in message


def test_a_missing_file_on_the_server_is_named(server: Server) -> None:
    (server.folder / "james" / "james.ljson").unlink()
    with pytest.raises(DataError, match=r"james\.ljson: the server answered 404"):
        james_from(server)


def test_a_file_that_is_too_large_is_refused_before_it_is_read(server: Server) -> None:
    with (server.folder / "james" / "james.obj").open("ab") as stream:
        stream.write(b"\n" * 1000)
    with pytest.raises(DataError, match="larger than the published file"):
        james_from(server)


def test_other_schemes_are_refused() -> None:
    with pytest.raises(DataError, match="http://"):
        fetch.data_get("james", base_url="file:///etc", progress=False)


def test_concurrent_downloads_are_safe_and_done_once(server: Server) -> None:
    folders: list[Path] = []
    threads = [threading.Thread(target=lambda: folders.append(james_from(server))) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(folders) == 4
    assert_whole(folders[0])
    assert len(server.requests) == 4


def test_the_mirror_comes_first_and_is_verified(
    shared_data: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("SHAPESPACE_DATA", str(shared_data))
    assert fetch.data_get("james") == shared_data / "james"
    assert [f["state"] for f in fetch.data_list()] == ["mirror", "mirror"]
    shutil.copytree(shared_data / "james", tmp_path / "m" / "james")
    monkeypatch.setenv("SHAPESPACE_DATA", str(tmp_path / "m"))
    ljson = tmp_path / "m" / "james" / "james.ljson"
    ljson.chmod(0o644)
    ljson.write_text(ljson.read_text().replace("101.2", "101.3"))
    with pytest.raises(DataError, match=r"james\.ljson does not match"):
        fetch.data_get("james")


def test_an_incomplete_mirror_is_said_not_passed_over(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "m" / "james").mkdir(parents=True)
    monkeypatch.setenv("SHAPESPACE_DATA", str(tmp_path / "m"))
    with pytest.raises(DataError, match=r"lacks 2 of the files of james \(james\.obj"):
        fetch.data_get("james")
    assert "lacks" in str(fetch.data_list()[0]["problem"])


def test_a_copy_serves_as_a_mirror(shared_data: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SHAPESPACE_DATA", str(shared_data))
    copies = [fetch.data_get(name, to=tmp_path / "out") for name in fetch.DATASETS]
    monkeypatch.setenv("SHAPESPACE_DATA", str(tmp_path / "out"))
    assert [fetch.data_get(name) for name in fetch.DATASETS] == copies
    assert "MIT License" in (copies[1] / "LICENSE.txt").read_text()


def test_nothing_here_is_listed_as_such() -> None:
    assert [f["state"] for f in fetch.data_list()] == ["not here", "not here"]


def test_an_unknown_name_lists_the_known_ones() -> None:
    with pytest.raises(DataError, match="james, ict-facekit"):
        fetch.data_get("nobody")


def test_a_cache_that_cannot_be_written_is_named(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(FileError, match="file"):
        james_from(server, cache=tmp_path / "file")


@pytest.fixture
def small_ict(shared_data: Path) -> fetch.Dataset:
    """ICT-FaceKit cut down to four of its published files, with the registry's own hashes."""
    whole = fetch.DATASETS["ict-facekit"]
    return replace(whole, files=tuple(f for f in whole.files if Path(f.path).stem in ICT_OBJS))


def serve_ict(server: Server, shared_data: Path) -> Path:
    folder = server.folder / "ict-facekit" / "FaceXModel"
    folder.mkdir(parents=True)
    for name in ICT_OBJS:
        shutil.copyfile(shared_data / "ict-facekit" / "FaceXModel" / f"{name}.obj", folder / f"{name}.obj")
    return folder


def test_objs_are_checked_by_content_and_packed(server: Server, small_ict: fetch.Dataset, shared_data: Path) -> None:
    serve_ict(server, shared_data)
    # Without raw hashes, as for most of the published files: only the content is checked.
    unknown = replace(small_ict, files=tuple(replace(f, sha256=None, bytes=None) for f in small_ict.files))
    folder = fetch.data_get(unknown, base_url=server.url, progress=False)
    packed = ict_files.read_packed(folder / ict_files.PACKED_NAME)
    whole = ict_files.read_packed(shared_data / "ict-facekit" / ict_files.PACKED_NAME)
    assert (packed.identity == whole.identity[:2]).all()
    assert (packed.faces == whole.faces).all()
    assert packed.expression_names == ("jawOpen",)
    assert not list(folder.rglob("*.obj"))
    count = len(server.requests)
    assert fetch.data_get(unknown, base_url=server.url, progress=False) == folder
    assert len(server.requests) == count


def test_an_obj_of_other_content_is_refused(server: Server, small_ict: fetch.Dataset, shared_data: Path) -> None:
    folder = serve_ict(server, shared_data)
    text = (folder / "identity001.obj").read_text()
    (folder / "identity001.obj").write_text(text.replace("\nv -6.5", "\nv -6.6", 1))
    unknown = replace(small_ict, files=tuple(replace(f, sha256=None, bytes=None) for f in small_ict.files))
    with pytest.raises(DataError, match=r"identity001\.obj is not the published file"):
        fetch.data_get(unknown, base_url=server.url, progress=False)
    assert not list(fetch.cache_folder().rglob("identity001.obj"))
    (folder / "identity001.obj").write_text(text)
    server.requests.clear()
    fetch.data_get(unknown, base_url=server.url, progress=False)
    assert not any("identity000" in path for path, _ in server.requests)


def test_a_server_with_the_packed_file_gives_that_alone_and_it_is_verified(server: Server, shared_data: Path) -> None:
    place = server.folder / "ict-facekit"
    place.mkdir()
    shutil.copyfile(shared_data / "ict-facekit" / ict_files.PACKED_NAME, place / ict_files.PACKED_NAME)
    folder = fetch.data_get("ict-facekit", base_url=server.url, progress=False)
    assert [path for path, _ in server.requests] == [f"/ict-facekit/{ict_files.PACKED_NAME}"]
    packed = ict_files.read_packed(folder / ict_files.PACKED_NAME)
    packed.identity[7, 100, 1] += 1e-6
    ict_files.write_packed(place / ict_files.PACKED_NAME, packed)
    with pytest.raises(DataError, match="differs from the published identity007"):
        fetch.data_get("ict-facekit", base_url=server.url, progress=False, cache=folder.parent / "other")
    assert not list((folder.parent / "other").rglob("*.npz"))


def test_the_published_objs_give_the_packed_file_bit_by_bit(small_ict: fetch.Dataset, shared_data: Path) -> None:
    folder = shared_data / "ict-facekit" / "FaceXModel"
    neutral = ict_files.read_obj(folder / "generic_neutral_mesh.obj")[0]
    for file in small_ict.files:
        assert file.content_sha256
        path = shared_data / "ict-facekit" / file.path
        ict_files.check_obj(path, None if "neutral" in file.path else neutral, file.content_sha256)
        assert hashlib.sha256(path.read_bytes()).hexdigest() == file.sha256
