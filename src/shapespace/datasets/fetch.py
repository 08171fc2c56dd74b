"""Open data sets: location, published hashes, and download.

A data set is searched for in this order: the local mirror that `SHAPESPACE_DATA` names (a folder that contains
`<name>/`), the cache folder of the platform (or `SHAPESPACE_CACHE`), and then the network: the published
repository at a pinned commit, or the server that `SHAPESPACE_DATA_URL` names, with the layout of a local mirror.
Nothing is used before it is verified, and a truncated file is never used.

James is checked by the SHA-256 of each file. ICT-FaceKit is 158 OBJ files (400 MB); they are checked one by one by
the SHA-256 of their content (see `ict_files`), packed into one `.npz` (11 MB) in the cache, and then deleted.
"""

from __future__ import annotations

import contextlib
import hashlib
import http.client
import importlib.resources
import json
import logging
import os
import shutil
import sys
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, BinaryIO, cast

import pooch
from tqdm import tqdm

from shapespace.datasets import ict_files
from shapespace.errors import DataError
from shapespace.io.disk_cache import cache_folder
from shapespace.io.files import atomic_path, make_folder, read_error, sha256_of_file, write_error, write_text

_TYPICAL_OBJ_BYTES = 2_558_000  # bytes; an estimate for the progress bar if the registry has no size
_LICENCE_NAME = "LICENSE.txt"
# Files that a mesh does not need, its material and picture; they are copied if they exist.
_OPTIONAL_SUFFIXES = (".mtl", ".jpg")


@dataclass(frozen=True)
class DataFile:
    """One file of a data set.

    Args:
        path: path relative to the folder of the data set, with forward slashes.
        remote: path relative to the root of the published repository.
        sha256: SHA-256 of the raw file; None if only that of the content is known.
        content_sha256: SHA-256 of the parsed content (see `ict_files`); None if not used.
        bytes: size of the raw file, bytes; None if not known.
    """

    path: str
    remote: str
    sha256: str | None
    content_sha256: str | None
    bytes: int | None


@dataclass(frozen=True)
class Dataset:
    """An open data set as published.

    Args:
        name: name of the data set, as in `shapespace data get NAME`.
        title, licence, citation: descriptions for readers.
        licence_text: complete licence, written next to the files.
        repository: `owner/name` on GitHub.
        commit: commit of the files, 40 hexadecimal digits.
        files: files that are downloaded.
        packed: name of the single file that replaces all of them after conversion; None without conversion.
    """

    name: str
    title: str
    licence: str
    licence_text: str
    citation: str
    repository: str
    commit: str
    files: tuple[DataFile, ...]
    packed: str | None

    @property
    def published_url(self) -> str:
        """The address of the folder of the published files, with a slash at the end."""
        return f"https://raw.githubusercontent.com/{self.repository}/{self.commit}/"

    @property
    def download_bytes(self) -> int:
        """Size of the download, bytes; an estimate if sizes are not known."""
        return sum(file.bytes or _TYPICAL_OBJ_BYTES for file in self.files)

    @property
    def sha256(self) -> str:
        """One hash for the complete set: the SHA-256 of the names and hashes of its files, one line each."""
        lines = sorted(f"{file.path} {file.sha256 or file.content_sha256}\n" for file in self.files)
        return hashlib.sha256("".join(lines).encode()).hexdigest()


def _read_registry() -> Mapping[str, Dataset]:
    text = importlib.resources.files("shapespace.datasets").joinpath("data/registry.json").read_text("utf-8")
    datasets: dict[str, Dataset] = {}
    for name, entry in cast("dict[str, dict[str, Any]]", json.loads(text)).items():
        files = tuple(
            DataFile(path, entry["remote_folder"] + path, f.get("sha256"), f.get("content_sha256"), f.get("bytes"))
            for path, f in entry["files"].items()
        )
        datasets[name] = Dataset(
            name=name,
            title=entry["title"],
            licence=entry["licence"],
            licence_text=entry["licence_text"],
            citation=entry["citation"],
            repository=entry["repository"],
            commit=entry["commit"],
            files=files,
            packed=ict_files.PACKED_NAME if any(f.content_sha256 for f in files) else None,
        )
    return MappingProxyType(datasets)


DATASETS: Mapping[str, Dataset] = _read_registry()
"""Available open data sets, by name."""


def dataset(name: str) -> Dataset:
    """Return the data set named `name`.

    Raises:
        DataError: there is no data set of that name.
    """
    if name not in DATASETS:
        raise DataError(f"There is no data set {name!r}; there are: {', '.join(DATASETS)}.")
    return DATASETS[name]


def data_folder(name: str | Dataset, *, cache: Path | None = None) -> Path | None:
    """Return the folder of a complete data set, from the mirror or the cache; None without it. Never downloads.

    Files are searched for by name here; their hashes are checked by `data_get` and by the loaders.

    Args:
        name: name of the data set, or the data set itself.
        cache: folder to use instead of `cache_folder()`.

    Raises:
        DataError: there is no data set of that name, or the mirror is incomplete.
    """
    data_set = dataset(name) if isinstance(name, str) else name
    mirror = _mirror_folder(data_set)
    if mirror is not None:
        return mirror
    cached = (cache or cache_folder()) / data_set.name
    return None if _missing_files(data_set, cached) else cached


def present_folder(name: str, purpose: str) -> Path:
    """Return the verified folder of a data set in the mirror or the cache; never downloads.

    Args:
        name: name of the data set in `DATASETS`.
        purpose: name of the data set in messages.

    Raises:
        DataError: it is neither in the mirror nor in the cache, or does not match its hashes.
    """
    if data_folder(name) is None:
        raise DataError(
            f"{purpose} is not here; run `shapespace data get {name}`, or set SHAPESPACE_DATA to a folder with {name}/."
        )
    return data_get(name)


def data_list(*, cache: Path | None = None) -> list[dict[str, object]]:
    """Return the facts of every data set as plain values, with its location: `mirror`, `cache` or `not here`.

    Args:
        cache: folder to use instead of `cache_folder()`.
    """
    facts: list[dict[str, object]] = []
    for name, entry in DATASETS.items():
        problem = ""
        try:
            folder = data_folder(name, cache=cache)
        except DataError as error:
            folder, problem = None, str(error)
        in_cache = folder is not None and folder == (cache or cache_folder()) / name
        facts.append(
            {
                "name": name,
                "title": entry.title,
                "licence": entry.licence,
                "citation": entry.citation,
                "source": f"https://github.com/{entry.repository}/tree/{entry.commit}",
                "commit": entry.commit,
                "sha256": entry.sha256,
                "files": len(entry.files),
                "download_bytes": entry.download_bytes,
                "state": "not here" if folder is None else "cache" if in_cache else "mirror",
                "folder": None if folder is None else str(folder),
                "problem": problem,
            }
        )
    return facts


def data_get(
    name: str | Dataset,
    *,
    to: Path | None = None,
    progress: bool | None = None,
    base_url: str | None = None,
    cache: Path | None = None,
) -> Path:
    """Return the folder of a data set with all files verified; download it if necessary.

    Args:
        name: name of the data set, or the data set itself.
        to: folder for a copy of the verified files, `to/<name>/`, which is returned; `to` can then serve as a mirror.
        progress: whether to show a bar on standard error; None shows it on a terminal only.
        base_url: server with the layout of a local mirror (`<base_url>/<name>/...`), instead of
            `SHAPESPACE_DATA_URL` or the published repository.
        cache: folder to use instead of `cache_folder()`.

    Raises:
        DataError: unknown name, a file that does not match its hash, an incomplete mirror, or no network.
        FileError: the cache or `to` cannot be written.
    """
    data_set = dataset(name) if isinstance(name, str) else name
    root = cache or cache_folder()
    folder = data_folder(data_set, cache=root)
    if folder is not None:
        folder = _verify(data_set, folder, root)
    else:
        make_folder(root / data_set.name)
        with hold_lock(root / f".{data_set.name}.lock"):
            # Another process may have finished it during the wait for the lock.
            if data_folder(data_set, cache=root) is None:
                _download_all(data_set, root / data_set.name, base_url, progress)
            folder = _verify(data_set, root / data_set.name, root)
    return folder if to is None else _copy(data_set, folder, Path(to))


def _mirror_folder(data_set: Dataset) -> Path | None:
    configured = os.environ.get("SHAPESPACE_DATA")
    if not configured or not (folder := Path(configured) / data_set.name).is_dir():
        return None
    missing = _missing_files(data_set, folder)
    if missing:
        raise DataError(
            f"{folder}, named by SHAPESPACE_DATA, lacks {len(missing)} of the files of {data_set.name} "
            f"({missing[0]}{', ...' if len(missing) > 1 else ''}); complete it, or unset SHAPESPACE_DATA."
        )
    return folder


def _missing_files(data_set: Dataset, folder: Path) -> list[str]:
    if data_set.packed and (folder / data_set.packed).is_file():
        return []
    required = [f.path for f in data_set.files if not f.path.endswith(_OPTIONAL_SUFFIXES)]
    return [path for path in required if not (folder / path).is_file()]


def _verify(data_set: Dataset, folder: Path, root: Path) -> Path:
    if data_set.packed is None:
        for file in data_set.files:
            path = folder / file.path
            if path.is_file() and sha256_of_file(path) != file.sha256:
                raise DataError(
                    f"{path} does not match its published SHA-256; delete it and get {data_set.name} again."
                )
        return folder
    hashes = {file.path: file.content_sha256 for file in data_set.files if file.content_sha256}
    if (folder / data_set.packed).is_file():
        ict_files.check_content(ict_files.read_packed(folder / data_set.packed), hashes, folder / data_set.packed)
        return folder
    # A mirror may be read-only, so its OBJ files are packed into the cache.
    packed = ict_files.read_obj_folder((folder / data_set.files[0].path).parent)
    ict_files.check_content(packed, hashes, folder)
    target = make_folder(root / data_set.name)
    ict_files.write_packed(target / data_set.packed, packed)
    write_text(target / _LICENCE_NAME, data_set.licence_text)
    return target


def _copy(data_set: Dataset, folder: Path, to: Path) -> Path:
    target = make_folder(to / data_set.name)
    names = [data_set.packed] if data_set.packed else [file.path for file in data_set.files]
    for name in names:
        if (folder / name).is_file() and (folder / name) != (target / name):
            try:
                with atomic_path(target / name) as temporary:
                    shutil.copyfile(folder / name, temporary)
            except shutil.SameFileError:
                continue
    write_text(target / _LICENCE_NAME, data_set.licence_text)
    return target


def _download_all(data_set: Dataset, folder: Path, base_url: str | None, progress: bool | None) -> None:
    server = base_url or os.environ.get("SHAPESPACE_DATA_URL")
    if server and urllib.parse.urlsplit(server).scheme not in ("http", "https"):
        raise DataError(f"{server} cannot serve data: give an address that begins with http:// or https://.")
    with tqdm(
        total=data_set.download_bytes,
        desc=data_set.name,
        unit="B",
        unit_scale=True,
        file=sys.stderr,
        disable=None if progress is None else not progress,
    ) as bar:
        if (
            server
            and data_set.packed
            and _fetch_packed(data_set, f"{server.rstrip('/')}/{data_set.name}/", folder, bar)
        ):
            return
        neutral = None
        for file in sorted(data_set.files, key=lambda f: ict_files.NEUTRAL_NAME not in f.path):
            url = (
                f"{server.rstrip('/')}/{data_set.name}/{file.path}" if server else data_set.published_url + file.remote
            )
            path = folder / file.path
            make_folder(path.parent)
            if file.content_sha256 is None:
                download(url, path, bar, sha256=file.sha256, size=file.bytes)
            else:
                _fetch_obj(file, url, path, neutral, bar)
                neutral = ict_files.read_obj(path)[0] if neutral is None else neutral
    if data_set.packed:
        objs = (folder / data_set.files[0].path).parent
        ict_files.write_packed(folder / data_set.packed, ict_files.read_obj_folder(objs))
        for file in data_set.files:
            (folder / file.path).unlink(missing_ok=True)
    write_text(folder / _LICENCE_NAME, data_set.licence_text)


def _fetch_packed(data_set: Dataset, address: str, folder: Path, bar: tqdm[Any]) -> bool:
    """Download the packed file from a server of our own; False if it has none. Its content is verified too."""
    assert data_set.packed
    path = folder / f"unverified.{data_set.packed}"
    try:
        download(address + data_set.packed, path, bar)
    except NotThereError:
        return False
    hashes = {file.path: file.content_sha256 for file in data_set.files if file.content_sha256}
    try:
        ict_files.check_content(ict_files.read_packed(path), hashes, path)
        path.replace(folder / data_set.packed)
    finally:
        path.unlink(missing_ok=True)
    write_text(folder / _LICENCE_NAME, data_set.licence_text)
    return True


def _fetch_obj(file: DataFile, url: str, path: Path, neutral: Any, bar: tqdm[Any]) -> None:
    """Download one OBJ file and check its content; a file of an interrupted run is checked first."""
    assert file.content_sha256
    if path.is_file():
        try:
            ict_files.check_obj(path, neutral, file.content_sha256)
        except DataError:
            path.unlink()
        else:
            bar.update(path.stat().st_size)
            return
    download(url, path, bar, sha256=file.sha256, size=file.bytes)
    try:
        ict_files.check_obj(path, neutral, file.content_sha256)
    except Exception as error:
        path.unlink(missing_ok=True)
        raise DataError(
            f"{url} is not the published file: its content does not match the known hash; the download was deleted, "
            "so try again later or set SHAPESPACE_DATA to a local copy."
        ) from error


# Downloads that resume after an interruption, and file locks between processes

_ATTEMPTS = 3  # number of tries of one file; each resumes the previous one
_TIMEOUT_S = 30.0  # seconds without a byte
_BLOCK = 1 << 16  # bytes (64 KiB), between updates of the progress bar
_MAX_FILE_BYTES = 32 << 20  # 32 MiB, for files without a published size


def download(url: str, path: Path, bar: tqdm[Any], *, sha256: str | None = None, size: int | None = None) -> None:
    """Download one file, resuming an interrupted run.

    Args:
        url: address of the file.
        path: path of the downloaded file.
        bar: progress bar, updated after each block.
        sha256: expected SHA-256; None for no check.
        size: expected size, bytes; None if not known.

    Raises:
        DataError: there is no network, no such file (`NotThereError`), or it is not the published file.
        FileError: the file cannot be written.
    """
    resuming = _ResumingDownload(path.with_name(f"{path.name}.part"), size, bar)
    try:
        with _quiet_pooch():
            pooch.retrieve(  # pyright: ignore[reportUnknownMemberType]  # its os.PathLike is bare
                url,
                None if sha256 is None else f"sha256:{sha256}",
                fname=path.name,
                path=path.parent,
                downloader=resuming,
            )
    except OSError as error:
        raise write_error(path, error) from error
    except ValueError as error:
        raise DataError(
            f"{url} does not match its published SHA-256; the download was deleted, so try again later or set "
            "SHAPESPACE_DATA to a local copy."
        ) from error


class NotThereError(DataError):
    """The server has no file at the address."""


class _CutError(Exception):
    """The connection closed before the end of the file."""


@dataclass(frozen=True)
class _ResumingDownload:
    """A downloader for pooch that keeps received data in a `.part` file and requests only the rest.

    Pooch's own names for the arguments of the call are misleading: `fname` is the address, `action` the target.
    """

    part: Path
    expected_bytes: int | None
    bar: tqdm[Any]

    def __call__(self, fname: str, action: Any, pooch: Any = None, *, check_only: bool | None = None) -> bool | None:
        reason: Exception | None = None
        for attempt in range(_ATTEMPTS):
            if attempt:
                time.sleep(0.2 * 2**attempt)
            try:
                self._get_rest(fname)
                self.part.replace(cast(str, action))
                return None
            except urllib.error.HTTPError as error:
                error.close()
                if error.code == 416:
                    self.part.unlink(missing_ok=True)
                elif error.code < 500:
                    kind = NotThereError if error.code in (404, 410) else DataError
                    raise kind(
                        f"Cannot download {fname}: the server answered {error.code} {error.reason}; "
                        "set SHAPESPACE_DATA to a local copy, or SHAPESPACE_DATA_URL to a server that has it."
                    ) from error
                reason = error
            except (
                _CutError,
                urllib.error.URLError,
                http.client.HTTPException,
                ConnectionError,
                TimeoutError,
            ) as error:
                reason = error
        cause = getattr(reason, "reason", None) or reason
        raise DataError(
            f"Cannot download {fname} ({str(cause).strip('.')}), and {self.part.parent} does not contain it yet: "
            "check the network and run again, which resumes the download, or set SHAPESPACE_DATA to a local copy."
        ) from reason

    def _get_rest(self, url: str) -> None:
        offset = self.part.stat().st_size if self.part.is_file() else 0
        if offset > (self.expected_bytes or _MAX_FILE_BYTES):
            self.part.unlink()
            offset = 0
        if offset and offset == self.expected_bytes:
            return
        request = urllib.request.Request(url, headers={"User-Agent": "shapespace", "Accept-Encoding": "identity"})
        if offset:
            request.add_header("Range", f"bytes={offset}-")
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as response:
            resumed = response.status == 206 and str(response.headers.get("Content-Range", "")).startswith(
                f"bytes {offset}-"
            )
            if response.status == 206 and not resumed:
                raise _CutError("the server sent another part than was asked for")
            offset = offset if resumed else 0
            length = response.headers.get("Content-Length")
            total = offset + int(length) if length and length.isdigit() else self.expected_bytes
            limit = self.expected_bytes or _MAX_FILE_BYTES
            if total is not None and total > limit:
                raise DataError(f"{url} is larger than the published file ({total} bytes); it is not the same file.")
            try:
                stream = self.part.open("ab" if resumed else "wb")
            except OSError as error:
                raise write_error(self.part, error) from error
            with stream:
                self.bar.update(offset)
                self._copy(response, stream, url, limit - offset)
                size = stream.tell()
        if total is not None and size < total:
            self.bar.update(-size)
            raise _CutError(f"the connection was cut after {size} of {total} bytes")

    def _copy(self, response: Any, stream: BinaryIO, url: str, room: int) -> None:
        while block := cast(bytes, response.read(_BLOCK)):
            room -= len(block)
            if room < 0:
                raise DataError(f"{url} is larger than the published file; it is not the same file.")
            try:
                stream.write(block)
            except OSError as error:
                raise write_error(self.part, error) from error
            self.bar.update(len(block))


@contextlib.contextmanager
def _quiet_pooch() -> Generator[None]:
    """Suppress the log of pooch on standard error, where the progress bar is."""
    logger = pooch.get_logger()
    level = logger.level
    logger.setLevel(logging.WARNING)
    try:
        yield
    finally:
        logger.setLevel(level)


@contextlib.contextmanager
def hold_lock(path: Path) -> Generator[None]:
    """Lock the file `path`; the system releases the lock even if the process is killed."""
    try:
        stream = path.open("a+b")
    except OSError as error:
        raise write_error(path, error) from error
    with stream:
        if sys.platform == "win32":
            import msvcrt

            while True:
                with contextlib.suppress(OSError):
                    msvcrt.locking(stream.fileno(), msvcrt.LK_LOCK, 1)
                    break
            try:
                yield
            finally:
                stream.seek(0)
                msvcrt.locking(stream.fileno(), msvcrt.LK_UNLCK, 1)
        else:
            import fcntl

            try:
                fcntl.flock(stream, fcntl.LOCK_EX)
            except OSError as error:
                raise read_error(path, error) from error
            yield
