import os
from pathlib import Path

import pytest

# Tests leave nothing in the user's cache; those of what is kept there name a folder of their own.
os.environ["SHAPESPACE_KEEP"] = "no"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data that is not part of the repository."""
    named = os.environ.get("SHAPESPACE_DATA")
    folder = Path(named) if named else Path(__file__).resolve().parents[2] / "shared" / "data"
    if not (folder / "james" / "james.obj").is_file():
        pytest.skip("real data absent: set SHAPESPACE_DATA to a folder holding james/ and ict-facekit/")
    return folder
