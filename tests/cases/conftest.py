"""The command line in this process, and inputs made after reports of users, which are not part of the repository."""

from pathlib import Path

import pytest

from shapespace.cli import main


@pytest.fixture
def reported(shared_data: Path) -> Path:
    """The folder of the inputs, next to that of the real data."""
    folder = shared_data.parent / "cases"
    if not folder.is_dir():
        pytest.skip(f"inputs after reports of users absent: {folder} is no folder")
    return folder


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]):
    """Run a command line that must end with `code`, and return what it printed."""

    def run(*arguments: object, code: int = 0) -> str:
        capsys.readouterr()
        try:
            ended = main([str(argument) for argument in arguments])
        except SystemExit as stop:
            ended = int(stop.code or 0)
        printed = "".join(capsys.readouterr())
        assert ended == code, printed
        return printed

    return run
