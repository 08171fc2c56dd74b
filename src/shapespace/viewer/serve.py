"""Start a viewer: find a port, print the address, and run the server until it is stopped."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import logging
import signal
import socket
import threading
import webbrowser
from collections.abc import Callable, Generator, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from shapespace.batch.workers import context, interrupts_ignored, preload
from shapespace.errors import InputError, ShapespaceError

if TYPE_CHECKING:
    import uvicorn
    from starlette.types import ASGIApp

FIRST_PORT = 7860  # first port that is tried, not a privileged one, and the number of ports after it
_PORTS_TRIED = 50  # as many viewers at once on one machine
_ALL_INTERFACES = ("0.0.0.0", "::", "")


def require_view_extra() -> None:
    """Check that the packages of the extra `view` are installed.

    Raises:
        ShapespaceError: a package is missing; the message states how to install it.
    """
    for package in ("starlette", "uvicorn"):
        if importlib.util.find_spec(package) is None:
            raise ShapespaceError(
                f"The viewer needs the package {package}; install it with: pip install 'shapespace[view]'."
            )


def serve(
    path: Path,
    *,
    model: Path | None = None,
    host: str = "127.0.0.1",
    port: int | None = None,
    open_browser: bool = True,
    forms: Callable[[], Mapping[str, Mapping[str, Any]]] = dict,
    say: Callable[[str], None] = print,
) -> None:
    """Show a model, fits, surfaces in correspondence, a report, or a project in the browser until Ctrl-C.

    Args:
        path: a model file, a folder of results, a report, or a project of the studio.
        model: model file of the fits in the folder (default: the one that their records name).
        host: address to listen at.
        port: port (default: the first free one from 7860).
        open_browser: whether to open the page.
        forms: function that returns the forms of the commands, with whose labels a project is shown.
        say: called with the address, which contains the token.

    Raises:
        ShapespaceError: the extra `view` is not installed.
        FileError: the model or the folder cannot be read.
        InputError: the port is taken, the host is not an address of this machine, or a model is given without fits.
    """
    require_view_extra()
    if _is_project(path):
        if model is not None:
            raise InputError(f"{path} is a project without fits; omit --model.")
        serve_studio(path, forms(), host=host, port=port, open_browser=open_browser, read_only=True, say=say)
        return
    from shapespace.viewer.guard import Guard
    from shapespace.viewer.studio.views import open_view, single_result_app, view_kinds

    with _end_by_signals():
        kinds = view_kinds(path) or ["model"]  # its reader knows models of other tools, and rejects the rest
        if model is not None and "model" not in kinds:
            what = "a correspondence" if "surfaces" in kinds else "a report"
            raise InputError(f"{path} is {what} without fits; omit --model.")
        page = single_result_app(path.resolve().name, {kind: open_view(kind, path, model=model) for kind in kinds})
        _run(partial(Guard, page), "viewer", host, port, open_browser=open_browser, say=say)


def serve_studio(
    project: Path | None,
    forms: Mapping[str, Mapping[str, Any]],
    *,
    host: str = "127.0.0.1",
    port: int | None = None,
    open_browser: bool = True,
    max_upload_mb: int = 500,
    read_only: bool = False,
    say: Callable[[str], None] = print,
) -> None:
    """Show a project of the studio in the browser until Ctrl-C; running commands continue.

    Args:
        project: folder of the project, created if it is new or empty; None for the start page.
        forms: forms of the commands that the page offers.
        host: address to listen at.
        port: port (default: the first free one from 7860).
        open_browser: whether to open the page.
        max_upload_mb: size limit of a scan that is dropped onto the page, in MB.
        read_only: show the project, and reject edits and jobs.
        say: called with the address, which contains the token.

    Raises:
        ShapespaceError: the extras `view` and `report` are not installed, or the project cannot be opened.
        InputError: the port is taken, or the host is not an address of this machine.
    """
    require_view_extra()
    if not read_only:
        # While this process imports its own code.
        preload(("shapespace.viewer.studio.specimen_checks",))
    from shapespace.report.pages.write_html import require_report_extra
    from shapespace.viewer.studio.app import Studio, make_studio
    from shapespace.viewer.studio.specimen_checks import compile_fits

    require_report_extra()
    with _end_by_signals(), ExitStack() as stack:
        studio = Studio(forms, project, max_upload_mb * 2**20, read_only=read_only)
        stack.callback(studio.close)
        if not read_only:
            with interrupts_ignored():
                context().Process(target=compile_fits, name=compile_fits.__name__, daemon=True).start()

        def started(server: uvicorn.Server) -> None:
            studio.ends = lambda: server.should_exit

        what = "viewer" if read_only else "studio"
        _run(partial(make_studio, studio), what, host, port, open_browser=open_browser, started=started, say=say)


def _is_project(path: Path) -> bool:
    from shapespace.viewer.studio.project import Project, State

    try:
        with (path / Project.FILE).open("rb") as file:
            return State.FORMAT.encode() in file.read(200)
    except OSError:
        return False


def _run(
    make: Callable[..., ASGIApp], what: str, host: str, port: int | None, *, open_browser: bool,
    started: Callable[[uvicorn.Server], None] | None = None, say: Callable[[str], None],
) -> None:  # fmt: skip
    """Run the application that `make` returns until Ctrl-C: print its address, and open it in a browser."""
    from shapespace.viewer.guard import LOOPBACK, Access

    access, loopback = Access(), host in LOOPBACK
    with contextlib.closing(listen(host, port)) as listener:
        port = int(listener.getsockname()[1])
        server = make_server(make(access=access, loopback=loopback, cookie_name=f"shapespace_{port}"))
        if started is not None:
            started(server)
        say(f"The {what} is at {page_address(host, port, access.token)}")
        if not loopback:
            say(f"Anyone with this address can use the {what}, and the connection is not encrypted.")
        say(f"Ctrl-C ends the {what}.")
        if open_browser:
            address = page_address(host, port, access.new_ticket())
            threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()

        def is_running(_: logging.LogRecord) -> bool:
            return not server.should_exit

        log = logging.getLogger("uvicorn.error")
        log.addFilter(is_running)  # a request that Ctrl-C cuts off is no error
        try:
            with contextlib.suppress(KeyboardInterrupt):
                server.run(sockets=[listener])
        finally:
            log.removeFilter(is_running)


def make_server(app: object) -> uvicorn.Server:
    """Return a server of `app`."""
    import uvicorn

    return uvicorn.Server(
        uvicorn.Config(
            app,  # type: ignore[arg-type]
            http="h11",
            ws="none",
            lifespan="off",
            log_level="error",
            access_log=False,
            server_header=False,
            proxy_headers=False,
            timeout_graceful_shutdown=3,
        )
    )


@contextlib.contextmanager
def _end_by_signals() -> Generator[None]:
    """Let SIGTERM and SIGHUP end the block as an exception does, so that temporary folders are removed."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def stop(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    handlers = {signal.SIGTERM: stop}
    hangup = getattr(signal, "SIGHUP", None)
    # Ignored under nohup.
    if hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN:
        # The server listens to SIGTERM, but not to SIGHUP, which a closed terminal sends.
        handlers[hangup] = lambda number, frame: signal.raise_signal(signal.SIGTERM)
    previous = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def listen(host: str, port: int | None) -> socket.socket:
    """Return a socket that listens on `host`, at `port` or at the first free port.

    Raises:
        InputError: the port is taken or not allowed, or the host is not an address of this machine.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    ports = range(FIRST_PORT, FIRST_PORT + _PORTS_TRIED) if port is None else [port]
    for candidate in ports:
        listener = socket.socket(family)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((host, candidate))
            listener.listen(128)
        except (OSError, OverflowError) as error:
            listener.close()
            number = error.errno if isinstance(error, OSError) else None
            if number == errno.EADDRINUSE:
                continue
            if number in (errno.EACCES, errno.EPERM) or isinstance(error, OverflowError):
                raise InputError(f"Port {candidate} cannot be used; choose one from 1024 to 65535.") from error
            raise InputError(f"The viewer cannot listen on {host!r}: it is not an address of this machine.") from error
        return listener
    if port is not None:
        raise InputError(f"Port {port} is taken by another program; choose another one, or omit --port.")
    raise InputError(f"The ports from {FIRST_PORT} to {FIRST_PORT + _PORTS_TRIED - 1} are taken; choose one by --port.")


def page_address(host: str, port: int, token: str) -> str:
    """Return the address of the page with a token or ticket."""
    name = socket.gethostname() if host in _ALL_INTERFACES else host
    if ":" in name:
        name = f"[{name}]"
    return f"http://{name}:{port}/?token={token}"
