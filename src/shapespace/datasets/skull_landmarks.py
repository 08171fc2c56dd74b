"""Simulated landmarks of skulls in profile, in 2-D: two species at two sites, with known differences.

Twelve landmarks are digitised on photographs: coordinates are pixels, each specimen has its own pose and scale. Jaws of
the two species differ more where both live than where each lives alone, and larger skulls have longer snouts.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from shapespace.errors import InputError
from shapespace.io.files import make_folder, write_text
from shapespace.io.landmarks.tps_nts import tps_text
from shapespace.io.tables.table_io import write_rows
from shapespace.types import FloatArray

LANDMARKS_FILE, TABLE, LINKS = "skulls.tps", "skulls.csv", "links.csv"
SPECIES, SITES = ("agilis", "robusta"), ("alone", "together")
DIFFERENCE_ALONE, DIFFERENCE_TOGETHER = 0.02, 0.06
"""Movement of the jaw landmarks between the species at each site, as a share of the length of the skull."""

_MEAN = np.array(
    [
        # x along the skull, y upwards; jaw joint, jaw angle, three along the jaw, snout, nostril, orbit, crown, occiput
        [0.02, 0.10], [0.10, -0.06], [0.32, -0.12], [0.58, -0.11], [0.84, -0.04], [1.00, 0.08],
        [0.90, 0.17], [0.66, 0.26], [0.50, 0.20], [0.36, 0.34], [0.12, 0.30], [0.00, 0.20],
    ]
)  # fmt: skip
_LINKS = [(k, k % 12 + 1) for k in range(1, 13) if k != 9]
_JAW = np.zeros((12, 2))
_JAW[[1, 2, 3, 4], 1] = [-0.5, -1.0, -0.8, -0.3]
_SNOUT = np.zeros((12, 2))
_SNOUT[[4, 5, 6], 0] = [0.8, 1.0, 0.7]
_ALLOMETRY = 0.25  # share of the length by which the snout moves per unit of log size
_LENGTH_MM, _LOG_SIZE = 14.0, 0.12  # length of a skull, and standard deviation of log size
_SHARED, _OWN = 0.012, 0.006  # standard deviations of smooth and of single movements, shares of the length
_MM_PER_PIXEL = 0.02
_MOST = 10_000  # limit on the rows of a demonstration


def skull_landmarks(seed: int, k: int) -> tuple[FloatArray, float]:
    """Return the landmarks (12, 2) of a skull in pixels, in its own pose, and mm per pixel."""
    rng = np.random.default_rng([seed, k])
    species, site = k % 2, k // 2 % 2
    log_size = _LOG_SIZE * rng.standard_normal() + 0.05 * species
    difference = (DIFFERENCE_ALONE, DIFFERENCE_TOGETHER)[site]
    x = _MEAN + (species - 0.5) * difference * _JAW + _ALLOMETRY * log_size * _SNOUT
    bending = np.stack([np.ones(12), _MEAN[:, 0], _MEAN[:, 1], _MEAN[:, 0] ** 2, np.sin(3 * _MEAN[:, 0])], axis=1)
    x = x + _SHARED * bending @ rng.standard_normal((5, 2)) / 2 + _OWN * rng.standard_normal((12, 2))
    mm_per_pixel = _MM_PER_PIXEL * rng.uniform(0.8, 1.25)
    turn = rng.uniform(-0.6, 0.6)
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    pixels = _LENGTH_MM * np.exp(log_size) / mm_per_pixel * x @ rotation.T + rng.uniform(300, 600, 2)
    return np.asarray(np.round(pixels, 2), dtype=np.float64), float(np.round(mm_per_pixel, 6))


def write_skull_landmarks(folder: Path, *, count: int, seed: int = 0) -> Path:
    """Write skulls.tps, the table skulls.csv with species and site, and links.csv, the outline between landmarks.

    Args:
        folder: output folder; created if it does not exist.
        count: 8 to 10,000; species and sites alternate.
        seed: seed, 0 or more.

    Raises:
        InputError: a count out of range.
        FileError: the folder cannot be written.
    """
    if not 8 <= count <= _MOST:
        raise InputError(f"The number of skulls must be between 8 and {_MOST}, not {count}.")
    make_folder(folder)
    names = [f"skull_{k:03d}" for k in range(count)]
    points, mm_per_pixel = zip(*(skull_landmarks(seed, k) for k in range(count)), strict=True)
    text = tps_text(dict(zip(names, points, strict=True)), {"SCALE": list(map(repr, mm_per_pixel))})
    write_text(folder / LANDMARKS_FILE, text)
    rows = [(name, SPECIES[k % 2], SITES[k // 2 % 2]) for k, name in enumerate(names)]
    write_rows(folder / TABLE, ("specimen", "species", "site"), rows)
    write_rows(folder / LINKS, ("from", "to"), _LINKS)
    return folder
