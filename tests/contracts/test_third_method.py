"""A third method is one object in one file: the example of docs/extending.md, put in place and fitted with."""

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.fit import method_choices as methods
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.method import Method
from synthetic_shapes import blob_model, raw_scan, similarity

DOCUMENT = Path(__file__).resolve().parents[2] / "docs" / "extending.md"
Z = np.array([0.8, -1.0, 0.5, 1.0, -0.7])


@pytest.fixture
def rigid(monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Method]]:
    """The method of the document, registered as it says."""
    found = re.search(r"```python\n(# rigid\.py.*?)```", DOCUMENT.read_text("utf-8"), re.S)
    assert found is not None
    names: dict[str, type[Method]] = {}
    exec(compile(found[1], "rigid.py", "exec"), names)
    monkeypatch.setattr(methods, "METHODS", {**methods.METHODS, "rigid": names["Rigid"]})
    yield names["Rigid"]


def test_it_is_chosen_by_name_or_as_an_object_and_its_settings_are_its_own(rigid: type[Method]) -> None:
    raw = raw_scan(Z, similarity(1, 5.0, 1.0, 2.0), noise_mm=0.1)
    by_name = fit_scan(blob_model(), raw.scan, FitConfig("rigid", unit="mm"))
    as_object = fit_scan(blob_model(), raw.scan, FitConfig(rigid(stop_rate=1e-3), unit="mm"))  # type: ignore[call-arg]
    assert by_name.method == as_object.method == "rigid"
    assert not by_name.b.any()
    assert (by_name.config["rigid"]["stop_rate"], as_object.config["rigid"]["stop_rate"]) == (1e-4, 1e-3)


def test_its_doubts_and_its_reason_are_said(rigid: type[Method]) -> None:
    near = fit_scan(blob_model(), raw_scan(0.1 * Z).scan, FitConfig("rigid", unit="mm"))
    assert near.status == "converged"
    assert "stood still" in near.reason
    far = fit_scan(blob_model(), raw_scan(4 * Z).scan, FitConfig("rigid", unit="mm"))
    assert far.status == "doubtful"
    assert "no pose brings the mean" in far.reason


def test_what_it_cannot_do_is_refused(rigid: type[Method]) -> None:
    with pytest.raises(InputError, match="dense stage"):
        FitConfig("rigid", dense=True)
    with pytest.raises(InputError, match="no setting 'search'"):
        methods.method_named("rigid", search="surface")
