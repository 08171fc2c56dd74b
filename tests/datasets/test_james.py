from pathlib import Path

import numpy as np
import pytest

from shapespace.datasets import james
from shapespace.errors import DataError


def test_james_is_the_published_scan_with_68_landmarks_on_it(shared_data: Path) -> None:
    scan = james.load_james(shared_data / "james")
    assert scan.faces is not None
    assert (len(scan.vertices), len(scan.faces)) == (6393, 12228)
    assert len(scan.landmarks) == 68
    marks = np.array(list(scan.landmarks.values()))
    gap = np.linalg.norm(marks[:, None] - scan.vertices[None], axis=2).min(axis=1)
    assert gap.max() < 10.0


def test_james_is_found_in_the_mirror(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHAPESPACE_DATA", str(shared_data))
    assert james.james_available()
    assert james.load_james().name == "james"


def test_absent_james_says_how_to_get_him(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SHAPESPACE_DATA", raising=False)
    monkeypatch.setenv("SHAPESPACE_CACHE", str(tmp_path))
    assert not james.james_available()
    with pytest.raises(DataError, match="shapespace data get james"):
        james.load_james()
