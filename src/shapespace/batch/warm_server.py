"""Imported by the server of `workers`, and by nothing else: warms it up, so that its copies are warm."""

from __future__ import annotations

import contextlib
import os

from shapespace.batch.warm import warm_up
from shapespace.batch.workers import WARM_UP

if how := os.environ.get(WARM_UP):
    # What fails here is said by the fits to come, and by name.
    with contextlib.suppress(Exception):
        warm_up(notify=how == "notify")
