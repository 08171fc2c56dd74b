"""Measure whether `expected_error_mm` rises where the true error does, and tune what it is calibrated by.

Fits whose truth is known, of faces, the bundled heads and femora, over noise, outliers, few triangles or points alone,
missing parts, expressions, two of the kind in one scan, things of another kind, and models of few or many shapes, too
narrow or too wide. The three splits share no shape, no model and no seed: the coefficients of the failure model are
learnt on "dev", its intervals set on "calibration", and "test" judges them.

    python benchmarks/reliability.py --fits 240            # of each split; goes on where it was cut short
    python benchmarks/reliability.py --tune                # prints the constants of fit/diagnostics/failure_model.py
    python benchmarks/reliability.py --report docs/images  # tables and the figure, of the split "test"
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import time
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import h5py
import numpy as np
from cases import run
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from shapespace import fit_scan
from shapespace.datasets.faces import load_faces
from shapespace.datasets.ict import EXPRESSIONS, load_ict
from shapespace.datasets.simulated_scan import simulate_scan
from shapespace.errors import ShapespaceError
from shapespace.fit.diagnostics import failure_model
from shapespace.fit.diagnostics.failure_model import FitEvidence
from shapespace.geometry.normals import face_areas, rms_size
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity

Split = Literal["dev", "calibration", "test"]
SPLITS: tuple[Split, ...] = ("dev", "calibration", "test")
FITS = 240
KINDS = {"face": 0.5, "head": 0.2, "femur": 0.3}
CONDITIONS = {
    "clean": 0.14, "noise": 0.15, "outliers": 0.13, "sparse": 0.08, "missing": 0.13, "mixed": 0.13,
    "expression": 0.06, "overlaid": 0.08, "beside": 0.05, "other": 0.05,
}  # fmt: skip
SAID = {
    "clean": "clean", "noise": "noise of 0.5 to 4 mm on a face", "outliers": "5 to 60 % outliers",
    "sparse": "1,000 to 4,000 triangles, or points", "missing": "10 to 60 % missing", "mixed": "several of these",
    "expression": "expressions the model lacks", "overlaid": "two on top of each other", "beside": "two side by side",
}  # fmt: skip
FACE_MM = 80.6
"""Size of a face; noise and the like are told for one, and grow with what is scanned."""

_HUBER, _RIDGE = 0.3, 0.1
_STEPS = (0.0, 0.02, 0.05, 0.1, 0.3, 0.7, 1.01)


@dataclass(frozen=True)
class Variant:
    """A model of `people`, cut to `modes`, with standard deviations `width` times as large."""

    people: int
    modes: int | None = None
    width: float = 1.0
    often: float = 1.0


VARIANTS: Mapping[str, tuple[Variant, ...]] = {
    "face": (
        Variant(10), Variant(20), Variant(60, often=2), Variant(200, often=2), Variant(200, 30),
        Variant(20, None, 3.0, 0.5), Variant(60, None, 1 / 3, 0.5), Variant(20, None, 1 / 30, 0.5),
        Variant(60, None, 1e-3, 0.5),
    ),
    "head": (Variant(20), Variant(60, often=2), Variant(60, 15), Variant(20, None, 1 / 10, 0.5)),
    "femur": (
        Variant(10), Variant(20), Variant(60, often=2), Variant(60, 12), Variant(20, None, 3.0, 0.5),
        Variant(20, None, 1 / 10, 0.5), Variant(60, None, 1e-3, 0.5),
    ),
}  # fmt: skip


class Femora:
    """Samples of the Gaussian process model of the femur, (1,622 vertices), whose modes are not orthonormal."""

    @cached_property
    def _model(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        path = Path(os.environ.get("SHAPESPACE_DATA", ".")) / "models" / "femur_gp_model_50-components.h5"
        if not path.is_file():
            raise SystemExit(f"{path} is not here; it comes from unibas-gravis/icp-proposal, data/femur.")
        with h5py.File(path) as stored:
            modes = np.asarray(stored["model/pcaBasis"][:] * np.sqrt(stored["model/pcaVariance"][:]), dtype=np.float64)
            mean = np.asarray(stored["model/mean"][:], dtype=np.float64).reshape(-1, 3)
            return mean, modes, np.asarray(stored["representer/cells"][:].T, dtype=np.int32)

    def draw(self, rng: np.random.Generator) -> Mesh:
        mean, modes, faces = self._model
        at = mean + (modes @ rng.standard_normal(modes.shape[1])).reshape(-1, 3)
        return Mesh(at, np.ascontiguousarray(faces), name="femur")


class Family:
    """Shapes of one kind and models of them."""

    def __init__(self, kind: str) -> None:
        self.kind = kind
        self._models: dict[tuple[Split, Variant], ShapeModel] = {}
        if kind == "face":
            ict = load_ict()
            self.draw = lambda rng, expression=None: ict.mesh(rng.standard_normal(len(ict.identity)), expression)
        elif kind == "head":
            heads = load_faces()
            self.draw = lambda rng, expression=None: heads.face(heads.draw_person(rng))
        else:
            femora = Femora()
            self.draw = lambda rng, expression=None: femora.draw(rng)

    def model(self, split: Split, variant: Variant) -> ShapeModel:
        if (split, variant) not in self._models:
            rng = _rng(split, self.kind, "model", variant.people)
            whole = ShapeModel.fit([self.draw(rng) for _ in range(variant.people)])
            cut = whole if variant.modes is None else whole.truncate(variant.modes)
            self._models[split, variant] = dataclasses.replace(
                cut, stddev=cut.stddev * variant.width, total_variance=cut.total_variance * variant.width**2
            )
        return self._models[split, variant]


def _rng(*what: str | int) -> np.random.Generator:
    return np.random.default_rng(zlib.crc32(repr(("reliability", *what)).encode()))


@dataclass(frozen=True, eq=False)
class Drawn:
    """One fit to be judged.

    Args:
        truths: (V, 3) each, places of the model's vertices in the scan; two where two are in it, none where it shows
            something else.
    """

    kind: str
    condition: str
    variant: Variant
    in_span: bool
    what: str
    model: ShapeModel
    scan: Mesh
    truths: tuple[FloatArray, ...]
    start: Similarity | None


def draw(families: Callable[[str], Family], split: Split, index: int) -> Drawn:
    """Return the index-th fit of `split`."""
    rng = _rng(split, index)
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    condition = str(rng.choice(list(CONDITIONS), p=list(CONDITIONS.values())))
    if condition == "expression" and kind != "face":
        condition = "noise"
    often = np.array([variant.often for variant in VARIANTS[kind]])
    variant = VARIANTS[kind][int(rng.choice(len(often), p=often / often.sum()))]
    family = families(kind)
    model = family.model(split, variant)
    unit = rms_size(model.mean_vertices) / FACE_MM
    in_span = bool(rng.random() < 0.2) and variant.width == 1.0

    def shape() -> Mesh:
        if in_span:
            return model.mesh(model.sample(1, rng)[0])
        expression = None
        if condition == "expression":
            share = float(rng.uniform(0.3, 1.0))
            whole = EXPRESSIONS[str(rng.choice([name for name, units in EXPRESSIONS.items() if units]))]
            expression = {name: share * value for name, value in whole.items()}
        return family.draw(rng, expression)

    several = condition == "mixed"

    def some(name: str, least: float, most: float, otherwise: float) -> float:
        wanted = condition == name or (several and rng.random() < 0.6)
        return float(np.exp(rng.uniform(np.log(least), np.log(most)))) if wanted else otherwise

    noise_mm = unit * some("noise", 0.5, 4.0, float(rng.uniform(0.1, 0.4)))
    outliers = some("outliers", 0.05, 0.6, 0.0)
    missing = some("missing", 0.1, 0.6, 0.0)
    triangles = round(some("sparse", 1_000, 4_000, float(np.exp(rng.uniform(np.log(4_000), np.log(16_000))))))
    points = (condition == "sparse" or several) and bool(rng.random() < 0.4)

    def scanned(mesh: Mesh) -> Mesh:
        raw = simulate_scan(mesh, rng, triangles=triangles, noise_mm=noise_mm, outlier_fraction=outliers, split=False)
        torn = _torn(raw.scan, missing, rng)
        return Mesh(torn.vertices) if points else torn

    if condition == "other":
        other = str(rng.choice([name for name in KINDS if name != kind]))
        if {kind, other} == {"face", "head"}:
            other = "femur"
        other_mesh = families(other).draw(rng)
        grown = (
            rms_size(model.mean_vertices) / rms_size(other_mesh.vertices) * float(np.exp(0.2 * rng.standard_normal()))
        )
        shapes = [other_mesh.with_vertices(grown * other_mesh.vertices)]
    else:
        shapes = [shape() for _ in range(2 if condition in ("overlaid", "beside") else 1)]
    if condition == "overlaid":
        off = Similarity(1.0, _turn(rng, 4.0), unit * rng.normal(0.0, 2.0, 3))
        shapes[1] = shapes[1].with_vertices(off.apply(shapes[1].vertices))
    elif condition == "beside":
        gap = float(rng.uniform(1.05, 1.5)) * np.ptp(shapes[0].vertices[:, 0])
        shapes[1] = shapes[1].with_vertices(shapes[1].vertices + np.array([gap, 0.0, 0.0]))
    scan = _together([scanned(each) for each in shapes])
    T = Similarity(1.0, _turn(rng, 20.0), rng.uniform(-100, 100, 3))
    start = None
    if rng.random() < 0.5 and condition not in ("beside", "other"):
        start = T @ Similarity(
            float(np.exp(0.04 * rng.standard_normal())), _turn(rng, 12.0), unit * rng.normal(0, 4, 3)
        )
    description = (
        f"{triangles} triangles, {noise_mm / unit:.1f} mm noise, {100 * outliers:.0f} % outliers, "
        f"{100 * missing:.0f} % missing{', points' * points}{', given start' * (start is not None)}"
    )
    truths = () if condition == "other" else tuple(T.apply(each.vertices) for each in shapes)
    placed = Mesh(T.apply(scan.vertices), scan.faces, name=f"{split} {index}")
    return Drawn(kind, condition, variant, in_span, description, model, placed, truths, start)


def _turn(rng: np.random.Generator, most_deg: float) -> FloatArray:
    axis = rng.standard_normal(3)
    turn = np.radians(rng.uniform(0, most_deg)) / np.linalg.norm(axis)
    return np.asarray(Rotation.from_rotvec(turn * axis).as_matrix())


def _torn(mesh: Mesh, missing: float, rng: np.random.Generator) -> Mesh:
    """Return `mesh` without a share of its area: cut by a plane, torn out around a point, or both."""
    area, middle = face_areas(mesh), mesh.vertices[mesh.faces].mean(axis=1)
    there = np.ones(len(middle), dtype=np.bool_)
    ways = ("p", "h", "ph", "hhh")[rng.integers(4)]
    for way in ways:
        if way == "p":
            last = middle @ rng.standard_normal(3)
        else:
            last = -np.linalg.norm(middle - middle[rng.choice(np.flatnonzero(there))], axis=1)
        order = np.argsort(-np.where(there, last, -np.inf))
        there[order[: np.searchsorted(np.cumsum(area[order]), missing / len(ways) * area.sum())]] = False
    used, faces = np.unique(mesh.faces[there], return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3).astype(np.int32), name=mesh.name)


def _together(meshes: list[Mesh]) -> Mesh:
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    if meshes[0].faces is None:
        return Mesh(vertices)
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False) if mesh.faces is not None]
    return Mesh(vertices, np.concatenate(faces).astype(np.int32))


def judge(drawn: Drawn) -> dict[str, Any]:
    """Fit and return the evidence beside the mean true vertex error, to the nearer of two truths."""
    begun = time.process_time()
    record: dict[str, Any] = {
        "kind": drawn.kind, "condition": drawn.condition, "people": drawn.variant.people,
        "modes": drawn.model.n_modes, "width": drawn.variant.width, "in_span": drawn.in_span, "what": drawn.what,
    }  # fmt: skip
    try:
        result = fit_scan(drawn.model, drawn.scan, T_scan_model=drawn.start)
    except ShapespaceError as error:
        return {**record, "status": "failed", "reason": str(error)}
    seconds = time.process_time() - begun
    vertices = result.surface().vertices
    errors = [float(np.linalg.norm(vertices - truth, axis=1).mean()) for truth in drawn.truths]
    return {
        **record,
        "status": result.status,
        "reason": result.reason,
        "notes": list(result.notes),
        "error_mm": min(errors, default=None),
        "evidence": result.evidence.to_dict(),
        "cpu_s": seconds,
    }


def records(path: Path) -> Iterator[dict[str, Any]]:
    """Yield what was measured so far."""
    if path.is_file():
        for line in path.read_text("utf-8").splitlines():
            yield json.loads(line)


def measure(path: Path, fits: int) -> None:
    """Add to `path` the fits it lacks, of all splits in turn, so that it may be cut short at any time."""
    done = {(record["split"], record["index"]) for record in records(path)}
    made: dict[str, Family] = {}

    def family(kind: str) -> Family:
        return made.setdefault(kind, made.get(kind) or Family(kind))

    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a", encoding="utf-8") as out:
        for index in range(fits):
            for split in SPLITS:
                if (split, index) not in done:
                    record = {"split": split, "index": index, **judge(draw(family, split, index))}
                    out.write(json.dumps(record, default=float) + "\n")
                    out.flush()


def summary_rows(found: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the fits that gave evidence and whose truth is known."""
    return [record for record in found if record.get("evidence") and record["error_mm"] is not None]


def log_share(record: Mapping[str, Any]) -> float:
    """Return the logarithm of the true error as a share of the model's size."""
    return float(np.log(record["error_mm"] / record["evidence"]["size_mm"]))


def failed(record: Mapping[str, Any]) -> bool:
    if record["error_mm"] is None:
        return True
    return record["error_mm"] > failure_model.FAILED_SHARE * record["evidence"]["size_mm"]


def tune(found: list[dict[str, Any]]) -> str:
    """Return the constants of `shapespace.fit.diagnostics.failure_model`.

    Weights: a regression of the logarithm of the error on "dev", by Huber's loss with a small ridge on standardised
    inputs and no weight below zero. Offset and interval: quantiles of what that leaves on "calibration". The
    probability of failure: a logistic regression on both.
    """
    dev, held = (summary_rows([r for r in found if r["split"] == split]) for split in ("dev", "calibration"))
    terms = failure_model.ERROR_TERMS
    raw = np.array([[term.value(FitEvidence(**r["evidence"])) for term in terms.values()] for r in dev])
    truth = np.array([log_share(r) for r in dev])
    middle, spread = raw.mean(axis=0), np.maximum(raw.std(axis=0), 1e-9)
    inputs = np.column_stack([(raw - middle) / spread, np.ones(len(raw))])

    def loss(t: np.ndarray) -> tuple[float, np.ndarray]:
        off = truth - inputs @ t
        pull = np.clip(off, -_HUBER, _HUBER)
        ridge = _RIDGE * np.append(t[:-1], 0.0)
        return float((pull * (off - 0.5 * pull)).sum() + 0.5 * ridge @ t), ridge - inputs.T @ pull

    bounds = [(0, None)] * len(terms) + [(None, None)]
    t = minimize(loss, np.zeros(inputs.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds).x
    weights = dict(zip(terms, (t[:-1] / spread).round(3), strict=True))

    def foretold(record: Mapping[str, Any]) -> float:
        evidence = FitEvidence(**record["evidence"])
        return sum(weight * terms[name].value(evidence) for name, weight in weights.items())

    left = np.sort([log_share(r) - foretold(r) for r in held])
    offset, outside = float(np.median(left)), (1.0 - failure_model.COVERAGE) / 2
    low = left[max(int(np.floor((len(left) + 1) * outside)) - 1, 0)] - offset
    high = left[min(int(np.ceil((len(left) + 1) * (1 - outside))) - 1, len(left) - 1)] - offset
    judged = [r for r in found if r.get("evidence") and r["split"] != "test"]
    wrong = np.array([failed(r) for r in judged])
    bound = np.log(failure_model.FAILED_SHARE)
    x = np.array([(min(offset + foretold(r), 0.0) - bound, 1.0) for r in judged])
    sign = np.where(wrong, -1.0, 1.0)

    def unlikely(t: np.ndarray) -> tuple[float, np.ndarray]:
        margin = sign * (x @ t)
        return float(np.logaddexp(0, margin).sum()), x.T @ (sign / (1 + np.exp(-margin)))

    f = minimize(unlikely, np.zeros(2), jac=True, method="L-BFGS-B", bounds=[(0, None), (None, None)]).x
    return "\n".join(
        [
            f"# {len(dev)} fits of dev, {len(held)} of calibration; {int(wrong.sum())} of {len(judged)} failed",
            "# weights of ERROR_TERMS",
            *(f'"{name}": {weight:.3f}' for name, weight in weights.items()),
            f"ERROR_OFFSET = {offset:.3f}",
            f"INTERVAL = {np.exp(low):.3f}, {np.exp(high):.3f}",
            f"FAILURE_OFFSET, FAILURE_SLOPE = {f[1]:.3f}, {f[0]:.3f}",
        ]
    )


def again(record: dict[str, Any]) -> dict[str, Any]:
    """Return `record` with the figures that the constants of today give its evidence."""
    evidence = record["evidence"]
    estimate = failure_model.estimate_error(FitEvidence(**evidence))
    return {**record, "evidence": {**evidence, **dataclasses.asdict(estimate)}}


def table(found: list[dict[str, Any]]) -> str:
    """Return a markdown table of what was expected and what is true, by kind, condition and model."""
    groups: dict[str, Callable[[Mapping[str, Any]], bool]] = {
        "all": lambda r: True,
        "those that converged": lambda r: r["status"] in ("converged", "max_iterations"),
        **{f"{kind}s" if kind != "femur" else "femora": (lambda r, k=kind: r["kind"] == k) for kind in KINDS},
        **{SAID[name]: (lambda r, c=name: r["condition"] == c) for name in CONDITIONS if name != "other"},
        "model of 10 or 20 shapes": lambda r: r["people"] <= 20 and r["width"] == 1,
        "model of 60 or 200 shapes": lambda r: r["people"] > 20 and r["width"] == 1,
        "model too narrow, 3 to 1,000 times": lambda r: r["width"] < 1,
        "model too wide, 3 times": lambda r: r["width"] > 1,
    }
    lines = [
        "| fits of the split test | fits | true | posterior | expected | over twice the posterior's | "
        "over twice the expected | in the 90 % interval |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, belongs in groups.items():
        of = [record for record in found if belongs(record)]
        if not of:
            continue
        of_size = {
            key: np.array([100 * r["evidence"][key] / r["evidence"]["size_mm"] for r in of])
            for key in ("posterior_error_mm", "expected_error_mm", "error_low_mm", "error_high_mm")
        }
        true = np.array([100 * r["error_mm"] / r["evidence"]["size_mm"] for r in of])
        raw, expected = of_size["posterior_error_mm"], of_size["expected_error_mm"]
        inside = (of_size["error_low_mm"] <= true) & (true <= of_size["error_high_mm"])
        lines.append(
            f"| {name} | {len(of)} | {np.median(true):.2f} | {np.median(raw):.2f} | {np.median(expected):.2f} | "
            f"{100 * (true > 2 * raw).mean():.0f} % | {100 * (true > 2 * expected).mean():.0f} % | "
            f"{100 * inside.mean():.0f} % |"
        )
    return "\n".join(lines)


def of_failure(judged: list[dict[str, Any]]) -> str:
    """Return a markdown table of the probability of failure against how many failed."""
    p = np.array([r["evidence"]["failure_probability"] for r in judged])
    wrong = np.array([failed(r) for r in judged])
    lines = ["| probability of failure | fits | mean | failed |", "|---|---|---|---|"]
    for low, high in pairwise(_STEPS):
        there = (p >= low) & (p < high)
        if there.any():
            lines.append(
                f"| {100 * low:.0f}-{min(100 * high, 100):.0f} % | {there.sum()} | {100 * p[there].mean():.0f} % | "
                f"{100 * wrong[there].mean():.0f} % |"
            )
    lines.append(f"\nArea under the curve {_auc(p, wrong):.3f}; ")
    for name, key in (("of the spread alone", "spread_mm"), ("of the posterior's figure alone", "posterior_error_mm")):
        alone = np.array([r["evidence"][key] / r["evidence"]["size_mm"] for r in judged])
        lines[-1] += f"{name} {_auc(alone, wrong):.3f}; "
    lines[-1] += (
        f"Brier score {((p - wrong) ** 2).mean():.3f}, {wrong.mean() * (1 - wrong.mean()):.3f} by the share alone."
    )
    return "\n".join(lines)


def _auc(value: np.ndarray, wrong: np.ndarray) -> float:
    return float(np.mean(np.sign(value[wrong][:, None] - value[~wrong]) * 0.5 + 0.5))


def picture(found: list[dict[str, Any]], judged: list[dict[str, Any]], path: Path) -> None:
    """Draw true against expected errors, of the posterior and calibrated, and failures against their probability."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 3, figsize=(11.0, 3.7), dpi=90)
    true = np.array([100 * r["error_mm"] / r["evidence"]["size_mm"] for r in found])
    for ax, key, label in zip(
        axes, ("posterior_error_mm", "expected_error_mm"), ("the posterior alone", "calibrated"), strict=False
    ):
        expected = np.array([100 * r["evidence"][key] / r["evidence"]["size_mm"] for r in found])
        for kind, colour in zip(KINDS, ("#4c72b0", "#dd8452", "#55a868"), strict=True):
            of = np.array([r["kind"] == kind for r in found])
            name = "femora" if kind == "femur" else f"{kind}s"
            ax.plot(expected[of], true[of], ".", ms=4, alpha=0.6, color=colour, label=name)
        order = np.array_split(np.argsort(expected), 8)
        ax.plot([np.median(expected[b]) for b in order], [np.median(true[b]) for b in order], "k.-", label="eighths")
        ends = np.array([0.05, 30.0])
        ax.plot(ends, ends, color="0.5", lw=1)
        if key == "expected_error_mm":
            low, high = failure_model.INTERVAL
            ax.fill_between(ends, low * ends, high * ends, color="0.9", zorder=0)
        ax.set(
            xscale="log", yscale="log", xlim=ends, ylim=ends, title=label,
            xlabel="expected error, % of size", ylabel="true mean vertex error, % of size",
        )  # fmt: skip
    axes[0].legend(fontsize=8)
    p = np.array([r["evidence"]["failure_probability"] for r in judged])
    wrong = np.array([failed(r) for r in judged])
    order = np.array_split(np.argsort(p), 8)
    axes[2].plot([0, 100], [0, 100], color="0.5", lw=1)
    axes[2].plot([100 * p[b].mean() for b in order], [100 * wrong[b].mean() for b in order], "k.-")
    axes[2].set(title="failures, by eighths", xlabel="probability of failure, %", ylabel="failed, %")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--fits", type=int, default=FITS, help="of each split")
    parser.add_argument("--kept", type=Path, default=Path("bench-out/reliability.jsonl"), help="what was measured")
    parser.add_argument("--tune", action="store_true", help="print constants for what was measured")
    parser.add_argument("--report", type=Path, metavar="FOLDER", help="print the tables of test; draw reliability.png")
    options = parser.parse_args()
    found = list(records(options.kept))
    if options.tune:
        print(tune(found))
    elif options.report:
        judged = [again(r) for r in found if r["split"] == "test" and r.get("evidence")]
        print(table(summary_rows(judged)), of_failure(judged), sep="\n\n")
        picture(summary_rows(judged), judged, options.report / "reliability.png")
    else:
        threadpool_limits(1)
        measure(options.kept, options.fits)


if __name__ == "__main__":
    run(main)
