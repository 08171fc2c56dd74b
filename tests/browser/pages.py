"""What the browser tests share by name: sizes of windows, and the world that the fixture `world` makes."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest

DESKTOP, PHONE = {"width": 1280, "height": 800}, {"width": 375, "height": 740}
WINDOWS = (
    pytest.param(DESKTOP, "light", id="desktop-light"),
    pytest.param(DESKTOP, "dark", id="desktop-dark", marks=[pytest.mark.long, pytest.mark.pairs]),
    pytest.param(PHONE, "light", id="phone-light", marks=[pytest.mark.long, pytest.mark.pairs]),
    pytest.param(PHONE, "dark", id="phone-dark"),
)
"""Each size and each scheme in every run, and in `make test-all` each with each."""
ONE_WINDOW = tuple(
    pytest.param(*one.values, id=one.id, marks=pytest.mark.pairs) if one.id == "phone-dark" else one for one in WINDOWS
)
"""One of them in .ci/run, where another test of the same page has the other one."""

WICKED = "</script><script>window.wicked = true</script>"
"""A label that stays text."""


@dataclass(frozen=True)
class World:
    """A model of faces and fits by it, made by the command line."""

    home: Path

    @property
    def model(self) -> Path:
        return self.home / "model.h5"

    @property
    def fits(self) -> Path:
        return self.home / "fits"

    @property
    def scan(self) -> Path:
        return self.home / "scans" / "plain.ply"

    @property
    def broken(self) -> Path:
        return self.home / "scans" / "broken.ply"


PANE = "document.querySelector('[data-testid=pane]')"
"""JavaScript: the part of the page that shows a result; its `shadowRoot` has the elements."""


def hear_signals() -> None:
    """Undo what nohup or a background shell hands down, so that the viewer is stopped as at a terminal."""
    for one in (signal.SIGHUP, signal.SIGINT):
        signal.signal(one, signal.SIG_DFL)


@contextmanager
def viewer(path: Path, how: signal.Signals = signal.SIGINT) -> Iterator[str]:
    """Run `shapespace view`, yield its address, stop it by a signal, and check that it leaves nothing behind."""
    # A short path, for there are sockets in it.
    with TemporaryDirectory(prefix="view-") as temporary:
        process = subprocess.Popen(
            [sys.executable, "-m", "shapespace", "view", str(path), "--no-open", "--quiet"],
            stdout=subprocess.PIPE, text=True, preexec_fn=hear_signals,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "TMPDIR": temporary},
        )  # fmt: skip
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            assert "http://127.0.0.1" in line, line
            yield line[line.index("http") :].strip()
        finally:
            process.send_signal(how)
            process.communicate(timeout=20)
        assert not list(Path(temporary).glob("shapespace-*"))
        assert process.returncode in (0, 128 + signal.SIGINT, 128 + signal.SIGTERM)
