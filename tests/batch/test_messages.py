"""That code is compiled is printed once by a command, whichever of its processes compiles first."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from shapespace.batch import workers
from shapespace.batch.warm import COMPILING, notify_compiling


def printed_by_another(mark: Path) -> str:
    code = "from shapespace.batch.warm import notify_compiling; notify_compiling(); notify_compiling()"
    env = {**os.environ, workers.MARK: str(mark)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, env=env, check=True)
    return done.stderr


@pytest.mark.parametrize("first", ["server", "command"])
def test_the_command_and_its_server_print_it_once(
    first: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mark = tmp_path / "printed"
    monkeypatch.setattr(workers._Mark, "path", str(mark))
    other = printed_by_another(mark) if first == "server" else ""
    notify_compiling()
    other += printed_by_another(mark) if first == "command" else ""
    assert (other + capsys.readouterr().err).count(COMPILING) == 1


def test_without_a_server_it_is_always_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(workers._Mark, "path", "")
    notify_compiling()
    assert capsys.readouterr().err == COMPILING + "\n"
