"""Opens a viewer: finds a port, prints the address, and runs the server until it is stopped."""

from __future__ import annotations

import contextlib
import errno
import importlib.util
import signal
import socket
import threading
import webbrowser
from collections.abc import Callable, Generator
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, TypeAlias

from shapespace.batch.workers import cores, start_loading
from shapespace.errors import InputError, ShapespaceError
from shapespace.schemas import CorrespondenceRecord

if TYPE_CHECKING:
    from shapespace.viewer.guard import Access
    from shapespace.viewer.limits import Limits
    from shapespace.viewer.sessions import Sessions

FIRST_PORT = 7860
_PORTS_TRIED = 50
_EVERYWHERE = ("0.0.0.0", "::", "")


def require_view_extra() -> None:
    """Raise unless the packages that serve pages are installed.

    Raises:
        ShapespaceError: they are not; the sentence says how to install them.
    """
    for needed in ("starlette", "uvicorn"):
        if importlib.util.find_spec(needed) is None:
            raise ShapespaceError(
                f"The viewer needs the package {needed}; install it with: pip install 'shapespace[view]'."
            )


def serve(
    path: Path,
    *,
    model: Path | None = None,
    host: str = "127.0.0.1",
    port: int | None = None,
    open_browser: bool = True,
    max_upload_mb: int = 200,
    quiet: bool = False,
    say: Callable[[str], None] = print,
) -> None:
    """Show a model, the fits of a folder, or surfaces in correspondence, in the browser until Ctrl-C.

    Args:
        path: a model file, or a folder that `shapespace fit` or `shapespace correspond` wrote.
        model: the model's file, where the records of the folder do not lead to it.
        host: the address to listen at.
        port: None takes the first free one from `FIRST_PORT`.
        open_browser: whether to open the page.
        max_upload_mb: largest scan that may be dropped.
        quiet: whether to be silent about code that is being compiled.
        say: told the address, which holds the token that visitors need.

    Raises:
        ShapespaceError: the extra `view` is not installed.
        FileError: the model or the folder cannot be read.
        InputError: the port is taken, the host is none of this machine's, or a model is given with surfaces.
    """
    require_view_extra()
    from shapespace.viewer.guard import LOOPBACK, Access
    from shapespace.viewer.limits import Limits

    upload_bytes = max_upload_mb * 2**20
    limits = Limits(
        upload_bytes=upload_bytes,
        all_bytes=max(Limits.all_bytes, 2 * upload_bytes),
        fits_at_once=cores(),
    )
    make = (
        _of_surfaces(path, model)
        if (path / CorrespondenceRecord.FILE).is_file()
        else _of_model(path, model, limits, quiet=quiet)
    )
    with _ended_by_signals():
        build = make()
        listening = listen(host, port)
        taken = int(listening.getsockname()[1])
        access, local = Access(limits), host in LOOPBACK
        app, sessions = build(access, local, f"shapespace_{taken}")

        def started() -> None:
            say(f"The viewer is at {page_address(host, taken, access.token)}")
            if not local:
                say("Whoever has this address can use it, and the connection is not encrypted.")
            say("Ctrl-C ends the viewer.")
            if open_browser:
                opened = page_address(host, taken, access.ticket())
                threading.Thread(target=webbrowser.open, args=(opened,), daemon=True).start()

        run(app, sessions, limits, listening, started)


_App: TypeAlias = "tuple[object, Sessions | None]"
_Build: TypeAlias = "Callable[[Access, bool, str], _App]"


def _of_surfaces(path: Path, model: Path | None) -> Callable[[], _Build]:
    """Return what opens a folder in correspondence, and then makes its application.

    It is made of what lets visitors in, whether it is for this machine alone, and a cookie's name.
    """
    if model is not None:
        raise InputError(f"{path} is a correspondence without fits; leave --model out.")

    def open_() -> _Build:
        from shapespace.viewer.corresponding_surfaces import Surfaces
        from shapespace.viewer.surfaces_server import make_surfaces_app

        shown = Surfaces(path)
        return lambda access, local, cookie_name: (
            make_surfaces_app(shown, access=access, local=local, cookie_name=cookie_name),
            None,
        )

    return open_


def _of_model(path: Path, model: Path | None, limits: Limits, *, quiet: bool) -> Callable[[], _Build]:
    """Return the same of a model, or of a folder of fits."""
    # While this process loads its own code.
    start_loading(tell=not quiet)

    def open_() -> _Build:
        from shapespace.viewer.scratch import sweep
        from shapespace.viewer.server import make_app
        from shapespace.viewer.shown import Shown

        sweep()
        shown = Shown.open(path, model)
        return lambda access, local, cookie_name: make_app(
            shown, limits=limits, access=access, local=local, cookie_name=cookie_name
        )

    return open_


def _ending_signals() -> list[signal.Signals]:
    """Return the signals beside Ctrl-C that end a viewer: SIGTERM, and SIGHUP unless it is ignored as under nohup."""
    hangup = getattr(signal, "SIGHUP", None)
    heard = hangup is not None and signal.getsignal(hangup) is not signal.SIG_IGN
    return [signal.SIGTERM, hangup] if heard and hangup is not None else [signal.SIGTERM]


@contextlib.contextmanager
def _ended_by_signals() -> Generator[None]:
    """Let SIGTERM and SIGHUP end the block as an exception does, so that temporary folders go."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        raise SystemExit(128 + number)

    before = {number: signal.signal(number, end) for number in _ending_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def run(
    app: object, sessions: Sessions | None, limits: Limits, listening: socket.socket, started: Callable[[], None]
) -> None:
    """Serve `app` until a signal ends it; scans and processes of visitors are gone when it returns.

    Args:
        app: the application.
        sessions: its sessions, None where it has none.
        limits: of connections.
        listening: where it is served.
        started: called when it answers.
    """
    import uvicorn

    from shapespace.viewer.connections import server_config

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            await super().startup(sockets)
            started()

        @contextlib.contextmanager
        def capture_signals(self) -> Generator[None]:
            # uvicorn itself does not listen to SIGHUP, which comes when a terminal is closed.
            with super().capture_signals():
                main = threading.current_thread() is threading.main_thread()
                before = {number: signal.signal(number, self.handle_exit) for number in _ending_signals() if main}
                try:
                    yield
                finally:
                    for number, handler in before.items():
                        signal.signal(number, handler)

        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            # Pages that watch a fit would otherwise hold the server up.
            if sessions is not None:
                sessions.closing = True
            super().handle_exit(sig, frame)

    try:
        Server(server_config(app, limits)).run(sockets=[listening])
    except KeyboardInterrupt:
        # Ctrl-C is how a viewer ends.
        pass
    finally:
        if sessions is not None:
            sessions.close()


def listen(host: str, port: int | None) -> socket.socket:
    """Return a socket that listens at `host`, at `port` or at the first free one.

    Raises:
        InputError: the port is taken or not allowed, or the host is none of this machine's.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    ports = range(FIRST_PORT, FIRST_PORT + _PORTS_TRIED) if port is None else [port]
    for attempt in ports:
        listening = socket.socket(family)
        try:
            listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listening.bind((host, attempt))
            listening.listen(128)
        except (OSError, OverflowError) as error:
            listening.close()
            number = error.errno if isinstance(error, OSError) else None
            if number == errno.EADDRINUSE:
                continue
            if number in (errno.EACCES, errno.EPERM) or isinstance(error, OverflowError):
                raise InputError(f"Port {attempt} cannot be used; choose one from 1024 to 65535.") from error
            raise InputError(f"The viewer cannot listen at {host!r}: it is no address of this machine.") from error
        return listening
    if port is not None:
        raise InputError(f"Port {port} is taken by another program; choose another one, or leave --port out.")
    raise InputError(f"The ports from {FIRST_PORT} to {FIRST_PORT + _PORTS_TRIED - 1} are taken; choose one by --port.")


def page_address(host: str, port: int, token: str) -> str:
    """Return the address that lets a browser in."""
    name = socket.gethostname() if host in _EVERYWHERE else host
    if ":" in name:
        name = f"[{name}]"
    return f"http://{name}:{port}/?token={token}"
