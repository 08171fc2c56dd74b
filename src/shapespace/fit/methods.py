"""Fitting methods by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from shapespace.fit.method import Method
from shapespace.fit.paper_method import Paper
from shapespace.fit.robust_method import Robust

METHODS: Mapping[str, Callable[[], Method]] = {method.name: method for method in (Robust, Paper)}
"""Each with its default settings when called."""
