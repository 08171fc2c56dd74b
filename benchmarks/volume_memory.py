"""Peak of resident memory of surfaces of label volumes, and the estimate that `--max-memory` is compared with.

python benchmarks/volume_memory.py [--side N ...]: prints the table of docs/volumes.md. Linux alone; 1.6 GB for 200.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import numpy as np

from shapespace.geometry.volume_surface import count_crossings, estimated_bytes, surface_of_volume
from shapespace.types import BoolArray, LabelVolume

MARGIN = 7
"""Voxels that the default smoothing adds around the labels."""


def ball(side: int) -> BoolArray:
    g = np.arange(side) - (side - 1) / 2
    return g[:, None, None] ** 2 + g[None, :, None] ** 2 + g**2 < (side / 2) ** 2


def sheets(side: int) -> BoolArray:
    """Sheets of two voxels with two between them, joined in the middle: nearly as much border as there can be."""
    inside = np.zeros((side, side, side), dtype=np.bool_)
    for begin in (0, 1):
        inside[:, :, begin::4] = True
    inside[side // 2 : side // 2 + 3, side // 2 : side // 2 + 3] = True
    return inside


def holes(side: int) -> BoolArray:
    inside = np.ones((side, side, side), dtype=np.bool_)
    inside[2:-2:3, 2:-2:3, 2:-2:3] = False
    return inside


KINDS = {"ball": ball, "sheets": sheets, "block with holes": holes}


def peak_bytes() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM:"))


def measure(kind: str, side: int) -> None:
    """Print box voxels, vertices, measured and estimated bytes of one surface; run in a process of its own."""
    import skimage.measure  # noqa: F401  # pyright: ignore[reportMissingTypeStubs, reportUnusedImport]

    inside = KINDS[kind](side)
    vertices = count_crossings(np.pad(inside, 1))
    volume = LabelVolume(np.asfortranarray(inside.astype(np.uint8)), np.eye(4), kind)
    box = [side + 2 * MARGIN] * 3
    Path("/proc/self/clear_refs").write_text("5")  # begins the peak anew
    before = peak_bytes()
    surface_of_volume(volume, keep_pieces=True)
    print(np.prod(box), vertices, peak_bytes() - before, estimated_bytes(box, vertices))


def main() -> None:
    """Print the table."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    options.add_argument("--side", type=int, nargs="+", default=[100, 150, 200])
    options.add_argument("--one", nargs=2, metavar=("KIND", "SIDE"), help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.one:
        measure(arguments.one[0], int(arguments.one[1]))
        return
    print(
        "| labels | voxels of the box, million | vertices, million | measured, GB | estimate, GB |\n|---|---|---|---|---|"
    )
    for kind in KINDS:
        for side in arguments.side:
            command = [sys.executable, __file__, "--one", kind, str(side)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            voxels, vertices, measured, estimate = (float(number) for number in done.stdout.split())
            print(
                f"| {kind} | {voxels / 1e6:.1f} | {vertices / 1e6:.2f} | {measured / 1e9:.2f} | {estimate / 1e9:.2f} |"
            )


if __name__ == "__main__":
    main()
