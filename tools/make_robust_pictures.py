"""Draw the two pictures of docs/robust.md from a real fit of the bundled faces.

python tools/make_robust_pictures.py [--out docs/images]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from scipy.spatial.transform import Rotation

from shapespace.datasets.faces import load_faces
from shapespace.datasets.simulated_scan import Cut, Hole, simulate_scan
from shapespace.fit.robust.posterior import Estimate
from shapespace.fit.robust.prepared_model import prepare
from shapespace.fit.robust.robust_icp import Iterate, Problem
from shapespace.fit.robust.robust_settings import RobustSettings
from shapespace.fit.scan_target import ScanTarget
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

INK, SCAN, AXIS = "#1f2933", "#c2410c", "#9aa5b1"
SLICE_MM = 3.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out
    faces, rng = load_faces(), np.random.default_rng(4)
    people = [faces.face(faces.draw_person(rng), name=f"{i}") for i in range(60)]
    model = ShapeModel.fit(people)
    truth = faces.face(faces.draw_person(rng))
    middle = truth.vertices[np.abs(truth.vertices[:, 0]) < SLICE_MM]
    cheek = middle[np.argmin(np.abs(middle[:, 1] - 40.0) - 0.2 * middle[:, 2])]
    scan = simulate_scan(
        truth,
        rng,
        triangles=30_000,
        noise_mm=0.4,
        outlier_fraction=0.04,
        holes=[Hole(16.0, cheek)],
        crop=[Cut((0.0, -75.0, 0.0), (0.0, -1.0, 0.0)), Cut((0.0, 85.0, 0.0), (0.0, 1.0, -0.3))],
    ).scan
    truth_mm = truth.vertices

    problem = Problem.of(prepare(model), ScanTarget(scan), RobustSettings(), 1.0, with_scale=True)
    pose = fit_similarity(model.mean_vertices, truth_mm)
    turn = np.asarray(Rotation.from_rotvec([0.12, 0.1, -0.08]).as_matrix())
    at = Estimate(pose @ Similarity(1.0, turn, np.array([4.0, -5.0, 3.0])), np.zeros(model.n_modes))
    sigma, width, error, ends = [], [], [], []
    iterate = problem.iterate(at)
    for number, level in enumerate(problem.settings.levels):
        matcher = problem.matcher(level)
        hint = matcher.first_hint(iterate.surface, iterate.T_scan_model)
        for step in problem.descent(matcher, iterate, hint, level):
            iterate = step.iterate
            sigma.append(step.weighted.sigma_mm)
            width.append(step.weighted.weights.width_mm)
            placed = iterate.T_scan_model.apply(iterate.surface.vertices)
            error.append(float(np.linalg.norm(placed - truth_mm, axis=1).mean()))
            if number == 0 and len(sigma) == 1:
                slice_picture(out / "robust-matching.png", problem, iterate, scan)
        ends.append(len(sigma))
    levels_picture(out / "robust-levels.png", sigma, width, error, ends)


def slice_picture(path: Path, problem: Problem, iterate: Iterate, scan: Mesh) -> None:
    """Draw what lies within a few millimetres of the middle of the face, seen from the side."""
    matcher = problem.matcher(problem.settings.levels[-1])
    weighted = problem.match(matcher, iterate, matcher.first_hint(iterate.surface, iterate.T_scan_model))
    x, faces, T = iterate.surface.vertices, problem.prepared.topology.faces, iterate.T_scan_model.inverse()
    middle = float(np.median(x[:, 0]))

    def near(points: FloatArray) -> np.ndarray:
        return np.abs(points[:, 0] - middle) < SLICE_MM

    figure, axes = plt.subplots(figsize=(6.5, 9.0), dpi=110)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    edges = edges[near(x[edges[:, 0]]) & near(x[edges[:, 1]])]
    axes.add_collection(LineCollection(x[edges][:, :, [2, 1]], colors=INK, linewidths=1.2, alpha=0.6))
    q = T.apply(scan.vertices)
    axes.plot(*q[near(q)][:, [2, 1]].T, ".", color=SCAN, ms=2.5, label="points of the scan")
    axes.plot([], [], color=INK, lw=1, label="the model, after the first step")
    points, vertices, weights = weighted.matches.points, weighted.matches.vertices, weighted.weights
    on_model = np.einsum("mc,mcd->md", points.barycentric, x[faces[points.triangle]])
    here = near(on_model)
    drawn = matcher._in_model(iterate.T_scan_model)
    lines = np.stack([drawn[here], on_model[here]], axis=1)[:, :, [2, 1]]
    strength = weights.points[here] / weights.points.max()
    axes.add_collection(
        LineCollection(
            lines, colors=[(0.05, 0.45, 0.75, 0.15 + 0.85 * w) for w in strength], linewidths=0.5 + 2.5 * strength
        )
    )
    on_scan = T.apply(vertices.near.points)
    here = near(x[vertices.vertex])
    lines = np.stack([x[vertices.vertex][here], on_scan[here]], axis=1)[:, :, [2, 1]]
    colours = [(0.1, 0.55, 0.25, 0.9) if allowed else (0.6, 0.6, 0.6, 0.7) for allowed in vertices.allowed[here]]
    axes.add_collection(LineCollection(lines, colors=colours, linewidths=1.0))
    axes.plot([], [], color=(0.05, 0.45, 0.75), lw=2, label="scan to model (R4), thick where it counts (R8)")
    axes.plot([], [], color=(0.1, 0.55, 0.25), lw=1.2, label="model to scan (R5)")
    axes.plot([], [], color=(0.6, 0.6, 0.6), lw=1.2, label="model to scan, not allowed (border, or R6)")
    axes.set_aspect("equal")
    axes.set_xlim(x[near(x), 2].max() - 75.0, x[near(x), 2].max() + 12.0)
    axes.set_ylim(-80.0, 75.0)
    axes.set_xlabel("towards the front, mm")
    axes.set_ylabel("up, mm")
    axes.legend(loc="upper left", fontsize=9, frameon=False, bbox_to_anchor=(1.0, 1.0))
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.savefig(path, bbox_inches="tight")


def levels_picture(path: Path, sigma: list[float], width: list[float], error: list[float], ends: list[int]) -> None:
    """Draw spread, width and true error against the step, with the levels shaded."""
    figure, (above, below) = plt.subplots(2, 1, figsize=(8.0, 5.2), dpi=110, sharex=True)
    steps = np.arange(1, len(sigma) + 1)
    above.semilogy(steps, width, color=SCAN, label="width (R7)")
    above.semilogy(steps, sigma, color=INK, label="spread sigma of the residuals")
    above.set_ylabel("mm")
    above.legend(frameon=False, fontsize=9)
    below.plot(steps, error, color="#0b6e99")
    below.set_ylabel("true vertex error, mm")
    below.set_xlabel("Gauss-Newton step")
    names = ("pose", "10 modes", "40", "all, to vertices", "all, to triangles")
    for axes in (above, below):
        begun = 0
        for number, end in enumerate(ends):
            if number % 2 == 0:
                axes.axvspan(begun + 0.5, end + 0.5, color=AXIS, alpha=0.15, lw=0)
            if axes is above:
                axes.text(
                    (begun + end) / 2 + 0.5, above.get_ylim()[1], names[number], ha="center", va="bottom", fontsize=8
                )
            begun = end
        for side in ("top", "right"):
            axes.spines[side].set_visible(False)
    figure.savefig(path, bbox_inches="tight")


if __name__ == "__main__":
    main()
