"""Compare the errors of `correspond` and of meshmonk 0.3, with the same template and the pose given to meshmonk.

    python benchmarks/meshmonk_comparison.py                          all sets
    python benchmarks/meshmonk_comparison.py faces femora --scans 12

meshmonk starts from the first template of `correspond`, and from the side and the pose that it found for each scan; one
pyramid with its defaults. Errors: the dispersion (faces, femora), the distance of landmarks carried between all pairs
(molars).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from landmark_transfer import molar_landmarks
from mirrored import molars
from peers.meshmonk_pyramid import fit

from correspondence import SETS, dispersion
from shapespace.correspondence.correspondence_result import Correspondence
from shapespace.correspondence.first_template import first_template
from shapespace.correspondence.groupwise import correspond
from shapespace.correspondence.settings import CorrespondConfig
from shapespace.geometry.closest import build_engine
from shapespace.geometry.mirror_plane import FLIP, mirror_image
from shapespace.geometry.normals import faces_of, rms_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import Mesh


def register_with_meshmonk(made: Correspondence, template: Mesh, scans: list[Mesh]) -> tuple[Correspondence, float]:
    """Return `made` with the surfaces of meshmonk in place of its own, and the CPU s for each."""
    # The template was reflected if most scans are its mirror images.
    sides = (template, mirror_image(template))
    template = min(sides, key=lambda side: _distance(side, made.template))
    surfaces, seconds = [], []
    for one, scan in zip(made.scans, scans, strict=True):
        if one.vertices is None or one.T_scan_template is None:
            surfaces.append(one)
            continue
        T = one.T_scan_template
        reflected = mirror_image(scan) if one.mirrored else scan
        posed = reflected.with_vertices(
            T.inverse().apply(reflected.vertices)
        )  # of one size and unit, as its settings expect
        vertices, cpu_s = fit(template, None, posed, T)
        placed = T.apply(vertices)
        surfaces.append(replace(one, vertices=placed * FLIP if one.mirrored else placed))
        seconds.append(cpu_s)
    return replace(made, scans=tuple(surfaces)), float(np.mean(seconds))


def _distance(one: Mesh, other: Mesh) -> float:
    fitted = fit_similarity(one.vertices, other.vertices).apply(one.vertices)
    return float(np.linalg.norm(fitted - other.vertices))


def landmark_error(made: Correspondence) -> float:
    """Return the distance of molar landmarks carried between all pairs, % of the RMS size."""
    truth, faces = molar_landmarks(), faces_of(made.template)
    shapes = {one.name: one.vertices for one in made.scans if one.vertices is not None}
    errors: list[float] = []
    for a, shape in shapes.items():
        near = build_engine(Mesh(shape, faces)).query(np.ascontiguousarray(truth[a]))
        corners = faces[near.triangle]
        for b, other in shapes.items():
            if a != b:
                placed = np.einsum("mc,mcd->md", near.barycentric, other[corners])
                errors.append(float(np.linalg.norm(placed - truth[b], axis=1).mean()) / rms_size(other))
    return 100 * float(np.mean(errors))


def main() -> None:
    """Print a row for each set."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sets", nargs="*", choices=["faces", "femora", "molars", []], default=[])
    parser.add_argument("--scans", type=int, default=24)
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--vertices", type=int, default=CorrespondConfig.vertices)
    arguments = parser.parse_args()
    config = CorrespondConfig(vertices=arguments.vertices)
    print("| scans | shapespace | meshmonk | ratio | CPU s a scan, all rounds | meshmonk |\n|---|---|---|---|---|---|")
    for name in arguments.sets or ["faces", "femora", "molars"]:
        error: Callable[[Correspondence], float]
        if name == "molars":
            scans, error, unit = molars(0)[0], landmark_error, "%"
        else:
            drawn = SETS[name][0](arguments.scans, arguments.seed, "ict")
            scans, unit = [one.scan for one in drawn.known], "mm"

            def error(made: Correspondence, of=drawn) -> float:
                return float(dispersion(made, of)["mean_mm"] or 0.0)

        first = first_template(scans, None, config, None)
        made = correspond(scans, config, first=first)
        other, seconds = register_with_meshmonk(made, first.mesh, scans)
        ours, theirs = error(made), error(other)
        own = float(np.mean([np.sum(one.seconds) for one in made.scans]))
        print(
            f"| {len(scans)} {name} | {ours:.3g} {unit} | {theirs:.3g} {unit} | {ours / theirs:.2f} | {own:.1f} | "
            f"{seconds:.1f} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
