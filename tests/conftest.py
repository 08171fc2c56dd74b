import os
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture(scope="session", autouse=True)
def kept(tmp_path_factory: pytest.TempPathFactory, worker_id: str) -> Iterator[None]:
    """A folder for what is kept between runs, one for all workers of pytest-xdist and none of the user's."""
    folder = tmp_path_factory.getbasetemp()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SHAPESPACE_KEEP", str((folder if worker_id == "master" else folder.parent) / "kept"))
        yield


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data that is not part of the repository."""
    named = os.environ.get("SHAPESPACE_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not (folder / "james" / "james.obj").is_file():
        pytest.skip("real data absent: set SHAPESPACE_DATA to a folder holding james/ and ict-facekit/")
    return folder
