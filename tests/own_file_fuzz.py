"""What fuzzers of our own files share: how long they run, and how bytes and JSON are damaged."""

import copy
import functools
import json
import os
import random
import time
from collections.abc import Callable
from typing import Any

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

MINUTES = float(os.environ.get("SHAPESPACE_FUZZ_MINUTES", "0"))
"""How long each fuzzer runs by hand, with new examples; without it, it takes a few, always the same."""

TOKENS = {
    "@huge@": "1" + "0" * 400, "@beyond@": "1" + "0" * 5000, "@infinite@": "1e400", "@nan@": "NaN",
    "@minus@": "-Infinity", "@deep@": "[" * 300 + "]" * 300, "@deeper@": "[" * 100_000,
    "@nested@": '{"a":' * 90 + "1" + "}" * 90,
    "@surrogate@": '"\\udcff\\u0000"',
}  # fmt: skip
"""JSON that `json.dumps` would not write."""
VALUES: list[Any] = [
    *TOKENS, None, True, 0, 3, -1, 2**62, 1e308, -2.5, 5e-324, "", "text", "\0", "../..", [], {}, [None], [[]],
    [1, [2]], ["a"], {"a": 1}, [{"b": [1], "z": [1]}], [1.5] * 300, "long " * 400,
]  # fmt: skip


def fuzzed(examples: int) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Run a test with `examples` values of its argument `seed`, or as long as `MINUTES` says."""

    def wrap(test: Callable[..., None]) -> Callable[..., None]:
        rules = settings(
            max_examples=examples,
            deadline=None,
            database=None,
            derandomize=not MINUTES,
            suppress_health_check=list(HealthCheck),
        )
        run = rules(given(seed=st.integers(0, 2**32 - 1))(test))

        @functools.wraps(run)
        def repeated(**fixtures: Any) -> None:
            end = time.monotonic() + 60 * MINUTES
            run(**fixtures)
            while time.monotonic() < end:
                run(**fixtures)

        return repeated

    return wrap


def damaged_bytes(content: bytes, rng: random.Random, places: list[int] | None = None) -> bytes:
    """Return `content` with one to three parts flipped, cut, overwritten or repeated; at `places` where given."""
    data = bytearray(content)
    for _ in range(rng.choice([1, 1, 1, 2, 3])):
        at = rng.choice(places) if places else rng.randrange(max(len(data), 1))
        match rng.choice(
            ["flip", "flip", "flip", "set", "number", "cut", "repeat"] if not places else ["flip", "number"]
        ):
            case "flip":
                data[at : at + 1] = bytes(byte ^ 1 << rng.randrange(8) for byte in data[at : at + 1])
            case "set":
                data[at : at + 1] = bytes([rng.choice([0, 0x7F, 0xFF, 0x2C, 0x0A, 0x31])])
            case "number":
                width = rng.choice([1, 2, 4, 8])
                number = rng.choice(
                    [0, 1, 2**31 - 1, 2**32 - 1, 2**63, 2**64 - 1, len(data), at, rng.randrange(len(data))]
                )
                data[at : at + width] = number.to_bytes(8, "little")[:width]
            case "cut":
                del data[at:]
            case _:
                data[at:at] = data[at : at + rng.choice([1, 8, 512])]
    return bytes(data)


def damaged_json(content: Any, rng: random.Random) -> bytes:
    """Return JSON `content` as text with one to three values replaced or gone."""
    content = copy.deepcopy(content)
    for _ in range(rng.choice([1, 1, 2, 3])):
        at: Any = content
        while True:
            keys = list(at) if isinstance(at, dict) else list(range(len(at)))
            if not keys:
                break
            key = rng.choice(keys)
            if isinstance(at[key], (dict, list)) and at[key] and rng.random() < 0.8:
                at = at[key]
                continue
            if rng.random() < 0.15:
                del at[key]
            else:
                at[key] = copy.deepcopy(rng.choice(VALUES))
            break
    text = json.dumps(content)
    for token, written in TOKENS.items():
        text = text.replace(json.dumps(token), written)
    return text.encode()
