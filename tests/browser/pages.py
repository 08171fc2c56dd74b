"""What the browser tests share by name: sizes of windows, and the world that the fixture `world` makes."""

from dataclasses import dataclass
from pathlib import Path

import pytest

DESKTOP, PHONE = {"width": 1280, "height": 800}, {"width": 375, "height": 740}
WINDOWS = (
    pytest.param(DESKTOP, "light", id="desktop-light"),
    pytest.param(DESKTOP, "dark", id="desktop-dark", marks=[pytest.mark.long, pytest.mark.pairs]),
    pytest.param(PHONE, "light", id="phone-light", marks=[pytest.mark.long, pytest.mark.pairs]),
    pytest.param(PHONE, "dark", id="phone-dark"),
)
"""Each size and each scheme in every run, and in `make test-all` each with each."""

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
