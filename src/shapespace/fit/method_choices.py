"""Fitting methods by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

from shapespace.errors import InputError
from shapespace.fit.method import Method
from shapespace.fit.paper.paper_method import Paper
from shapespace.fit.robust.robust_method import Robust

METHODS: Mapping[str, Callable[..., Method]] = {"robust": Robust, "paper": Paper}
"""Name -> class of the method, which is called with its settings, or without for the defaults."""


def method_named(name: str, **settings: Any) -> Method:
    """Return the method called `name` with `settings` in place of its defaults.

    Raises:
        InputError: there is no such method, or it has no such setting.
    """
    if name not in METHODS:
        raise InputError(f"There is no method {name!r}; choose one of {', '.join(METHODS)}.")
    method = METHODS[name]()
    known = {field.name for field in fields(method)}  # type: ignore[arg-type]
    for setting in settings:
        if setting not in known:
            raise InputError(f"The method {name!r} has no setting {setting!r}; omit it, or choose another method.")
    return METHODS[name](**settings)
