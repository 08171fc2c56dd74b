"""Completions follow the scan where there is one, and say how uncertain they are where there is none."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from shapespace.datasets.simulated_scan import Cut, simulate_scan
from shapespace.errors import FitError, InputError
from shapespace.fit.completion.complete import Completion, CompletionConfig, complete, refine_surface
from shapespace.fit.completion.shape_posterior import _DataLikelihood, leave_one_out
from shapespace.fit.dense.residual_modes import ResidualModes
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.geometry.closest import build_engine
from shapespace.geometry.doctor import examine
from shapespace.geometry.normals import part_of
from shapespace.geometry.similarity import POSE
from shapespace.model.new_shapes import variances_of_new_shapes
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh, Similarity
from synthetic_shapes import blob, blob_model, raw_scan, similarity, sphere, training_meshes

MODEL = blob_model(vertices=400, gauge="form")
T = similarity(3, degrees=40.0, scale=1.0)
FORM = CompletionConfig(fit=FitConfig(unit="mm"))


def cut_scan(z: FloatArray, below: float, seed: int = 0) -> tuple[Mesh, FloatArray, np.ndarray]:
    """Return a scan without the directions below this height along x, the true vertices, and which of them it lacks."""
    raw = raw_scan(z, T, model_vertices=400, noise_mm=0.15, keep=below, seed=seed)
    return raw.scan, raw.truth, sphere(400)[0][:, 0] < below


@cache
def completed(below: float = -0.2) -> tuple[Completion, FloatArray, np.ndarray]:
    scan, truth, missing = cut_scan(np.array([0.8, -0.6, 1.0, 0.5, -0.4]), below)
    return complete(MODEL, scan, FORM), truth, missing


def test_the_missing_part_is_near_the_truth_and_the_rest_on_the_scan() -> None:
    completion, truth, missing = completed()
    error = np.linalg.norm(completion.vertices - truth, axis=1)
    mean = fit_scan(MODEL, completion.fit.scan).T_scan_model.apply(MODEL.mean_vertices)
    assert completion.status == "converged"
    assert error[missing].mean() < 0.5 * np.linalg.norm(mean - truth, axis=1)[missing].mean()
    on_scan = build_engine(completion.fit.scan).query(completion.vertices[completion.observed]).distance
    assert np.median(on_scan) < 0.2
    assert completion.observed[~missing].mean() > 0.9
    assert completion.observed[missing].mean() < 0.2


def test_there_is_no_step_at_the_seam() -> None:
    completion, truth, _ = completed()
    faces = np.asarray(MODEL.faces)
    edges = np.unique(np.sort(np.concatenate([faces[:, :2], faces[:, 1:]]), axis=1), axis=0)
    error = completion.vertices - truth
    step = np.linalg.norm(error[edges[:, 0]] - error[edges[:, 1]], axis=1)
    at_seam = completion.observed[edges[:, 0]] != completion.observed[edges[:, 1]]
    assert step[at_seam].mean() < 1.0  # mm, with edges of 10 mm


def test_more_missing_is_less_certain_and_the_observed_part_is_most_certain() -> None:
    (less, _, _), (more, _, missing) = completed(), completed(0.2)
    assert more.stddev_mm[missing].mean() > less.stddev_mm[missing].mean()
    assert more.stddev_mm[more.observed].mean() < more.stddev_mm[~more.observed].mean()


def test_samples_have_the_mean_and_the_covariance_of_the_posterior() -> None:
    completion, _, _ = completed()
    x = completion.draw_samples(4000).astype(np.float64)
    R = completion.T_scan_model.rotation
    expected = R @ completion.posterior.vertex_covariance() @ R.T
    for v in (0, 150, 399):
        sample = np.cov(x[:, v].T)
        assert np.allclose(sample, expected[v], atol=0.1 * np.trace(expected[v]))
    assert np.abs(x.mean(axis=0) - completion.vertices).max() < 0.2
    assert np.array_equal(completion.draw_samples(7), completion.draw_samples(7))


def test_intervals_of_a_function_are_quantiles_over_whole_shapes() -> None:
    completion, truth, _ = completed()
    by_name = {one.name: one for one in completion.estimates()}
    corners = truth[np.asarray(MODEL.faces)]
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    estimate = by_name["volume"]
    assert estimate.low < estimate.value < estimate.high
    assert abs(estimate.mean / volume - 1) < 0.003
    height = completion.estimate(lambda mesh: float(np.ptp(mesh.vertices[:, 0])), "height", "mm", level=0.5)
    wide = completion.estimate(lambda mesh: float(np.ptp(mesh.vertices[:, 0])), "height", "mm", level=0.9)
    assert wide.low < height.low < height.high < wide.high
    assert by_name.keys() == {"volume", "area", "length", "centroid size"}
    assert all((stddev > 0).all() for stddev in completion.landmark_stddev_mm().values())
    with pytest.raises(InputError, match="between 0 and 1"):
        completion.estimate(lambda mesh: 1.0, level=1.0)
    with pytest.raises(InputError, match="not finite"):
        completion.estimate(lambda mesh: float("nan"))


@pytest.mark.parametrize("rows", [3, 12])
def test_posterior_mean_and_evidence_are_those_of_gaussian_process_regression(rows: int) -> None:
    """With A the rows of the observations, S the prior: S A^T (A S A^T + I)^-1 y, and log N(y; 0, A S A^T + I)."""
    rng = np.random.default_rng(rows)
    A, y, variance = rng.standard_normal((rows, 6)), rng.standard_normal(rows), rng.uniform(0.5, 3.0, 6)
    data, K = _DataLikelihood(A.T @ A, A.T @ y), A @ np.diag(variance) @ A.T + np.eye(rows)
    assert np.allclose(data.mean(variance), variance * (A.T @ np.linalg.solve(K, y)))

    def log_density(K: FloatArray) -> float:
        return -0.5 * float(y @ np.linalg.solve(K, y)) - 0.5 * np.linalg.slogdet(K)[1]

    other = 2 * variance
    difference = log_density(K) - log_density(A @ np.diag(other) @ A.T + np.eye(rows))
    assert np.isclose(data.log_evidence(variance) - data.log_evidence(other), difference)


@pytest.mark.parametrize("has_scale", [False, True])
def test_left_out_errors_are_those_of_gaussian_process_regression(has_scale: bool) -> None:
    """Each shape is predicted by S A^T (A S A^T + I)^-1 y, S the prior of the model of the others."""
    n, K, R, rows = 9, 8, 3, 6
    rng = np.random.default_rng(0)
    P = POSE + K + R
    C = rng.standard_normal((n, K)) * np.linspace(4.0, 1.0, K)
    C -= C.mean(axis=0)
    known = np.column_stack([0.1 * rng.standard_normal(n) if has_scale else np.zeros(n), C])
    A, noise = rng.standard_normal((rows, P)), rng.standard_normal(rows)
    variance = np.r_[np.full(6, 100.0), 0.01 if has_scale else 0.0, np.ones(K), np.full(R, 0.2)]
    products, mode = rng.standard_normal((K + R, 2 * K)).astype(np.float32), np.tile(np.arange(K), 2)
    extra = ResidualModes(np.zeros((1, 3, 1)), np.sqrt(variance[-R:]), products, mode, np.repeat([0, 1], K))
    left = leave_one_out(known, A.T @ A, A.T @ noise, np.zeros(P), variance, extra)
    z = C / C.std(axis=0, ddof=1)
    for i in range(n):
        others = np.delete(C, i, axis=0)
        mean = others.mean(axis=0)
        value, axes = np.linalg.eigh(np.cov(others.T))
        sample, V = value[::-1][: n - 2], axes[:, ::-1][:, : n - 2]
        u = axes[:, 0]
        spread = np.maximum(sample, variances_of_new_shapes(sample, sample.sum(), n - 1))
        S = np.diag(variance)
        b = slice(POSE, POSE + K)
        S[b, b] = V * spread @ V.T
        # The kernel of the residual modes without those that are made of the shape, along u.
        kernel = sum(X @ (np.eye(K) - np.outer(z[i], z[i]) / (n - 1)) @ X.T for X in (products[:, :K], products[:, K:]))
        S[b, b] += np.outer(u, u) * (u @ kernel[:K, :K] @ u)
        S[b, POSE + K :] = np.outer(u, u @ kernel[:K, K:])
        S[POSE + K :, b] = S[b, POSE + K :].T
        truth, prior_mean = np.zeros(P), np.zeros(P)
        truth[POSE - 1], truth[b], prior_mean[b] = known[i, 0], C[i], mean
        gain = S @ A.T @ np.linalg.inv(A @ S @ A.T + np.eye(rows))
        predicted = prior_mean + gain @ A @ (truth - prior_mean)
        assert np.allclose(left.errors[i], predicted - truth, atol=1e-6)
        assert np.allclose(left.shifts[i], prior_mean + gain @ (noise - A @ prior_mean), atol=1e-6)
    S = np.diag(variance)
    gain = S @ A.T @ np.linalg.inv(A @ S @ A.T + np.eye(rows))
    assert np.allclose(left.noise, gain @ gain.T, atol=1e-8)
    draws = np.random.default_rng(1).standard_normal((20_000, n + 1, 3))
    S = np.einsum("sni,snj->sij", draws[:, 1:], draws[:, 1:])
    factor = (left.covariance() - left.noise)[0, 0] / (left.errors.T @ left.errors)[0, 0]
    T2 = np.einsum("si,sij,sj->s", draws[:, 0], np.linalg.inv(factor * S), draws[:, 0])
    assert abs((T2 < 7.815).mean() - 0.95) < 0.01  # the quantile of 95 % of chi-squared with 3 degrees of freedom


def test_regions_of_ninety_percent_contain_most_of_the_truth() -> None:
    inside = []
    for seed in range(6):
        z = np.random.default_rng(seed).standard_normal(5)
        scan, truth, missing = cut_scan(z, 0.1, seed)
        completion = complete(MODEL, scan, FORM, T_scan_model=T)
        R = completion.T_scan_model.rotation
        error = (completion.vertices - truth)[missing] @ R
        covariance = completion.posterior.vertex_covariance()[missing] + 1e-6 * np.eye(3)
        inside.append((np.einsum("vi,vij,vj->v", error, np.linalg.inv(covariance), error) < 6.251).mean())
    assert 0.7 < np.mean(inside) <= 1.0


def test_a_part_is_estimated_where_the_scan_shows_it() -> None:
    region = np.flatnonzero(MODEL.mean_vertices[:, 1] > 60).astype(np.int32)
    model = replace(MODEL, regions={"top": region})
    raw = raw_scan(np.zeros(5), T, model_vertices=400)
    completion = complete(model, raw.scan, replace(FORM, part="top"))
    assert not completion.observed[region].any() and completion.observed.mean() > 0.5
    with pytest.raises(InputError, match="no region 'tail'"):
        complete(model, raw.scan, replace(FORM, part="tail"))


def symmetric_blobs(count: int) -> tuple[list[FloatArray], np.ndarray]:
    """Return blobs that are their own mirror images at x = 0, and their triangles."""
    d = sphere(400)[0]
    d = np.concatenate([d[d[:, 0] > 0.02], d[d[:, 0] > 0.02] * (-1, 1, 1)])
    faces = ConvexHull(d).simplices.astype(np.int32)
    a, b, c = (d[faces[:, k]] for k in range(3))
    inward = np.einsum("fi,fi->f", np.cross(b - a, c - a), a) < 0
    faces[inward] = faces[inward][:, ::-1]
    side = np.where(d[:, :1] < 0, (-1.0, 1.0, 1.0), 1.0)
    return [blob(d * side, z) * side for z in np.random.default_rng(0).standard_normal((count, 5))], faces


def test_the_other_side_improves_what_the_model_says() -> None:
    shapes, faces = symmetric_blobs(10)
    model = ShapeModel.fit([Mesh(x, faces) for x in shapes[:7]], gauge="form")
    truth = shapes[9]
    for side in (-1, 1):  # a bump on both sides that no training shape has
        truth = truth + 4 * np.exp(-(((truth - (side * 60, 20, 20)) / 20) ** 2).sum(axis=1))[:, None] * (side, 0, 0)
    cut = [Cut((0.0, 0, 0), (1, 0, 0))]
    scan = simulate_scan(Mesh(truth, faces), np.random.default_rng(1), triangles=4_000, noise_mm=0.1, crop=cut).scan
    errors: dict[str, float] = {}
    for mirror in ("never", "combined", "alone"):
        config = CompletionConfig(mirror=mirror, fit=FitConfig(unit="mm"))
        completion = complete(model, scan, config, T_scan_model=Similarity.identity())
        errors[mirror] = np.linalg.norm(completion.vertices - truth, axis=1)[truth[:, 0] > 0].mean()
    assert errors["alone"] < errors["never"] and errors["combined"] < errors["never"], errors
    with pytest.raises(InputError, match="omit --mirror"):
        complete(MODEL, cut_scan(np.zeros(5), -0.2)[0], replace(FORM, mirror="combined"))


def test_the_refined_surface_is_closed_and_on_the_scan() -> None:
    completion, _, _ = completed()
    mesh = refine_surface(completion)
    assert len(mesh.faces) == 4 * len(MODEL.faces)
    edges = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    moved = np.linalg.norm(mesh.vertices[: MODEL.n_vertices] - completion.vertices, axis=1)
    assert np.median(moved[~completion.observed]) < 0.5
    report = examine(mesh)
    assert report.usable and not (report.boundary_edges or report.degenerate_triangles or report.reversed_triangles)


def test_a_small_part_that_fits_in_two_poses_is_refused() -> None:
    scan = cut_scan(np.zeros(5), 0.82)[0]
    with pytest.raises(FitError, match="two poses about equally well"):
        complete(MODEL, scan, FORM)
    doubtful = complete(MODEL, scan, replace(FORM, with_doubtful=True))
    assert doubtful.status == "doubtful" and "two poses" in doubtful.reason


def test_bad_input_has_one_sentence() -> None:
    scan = cut_scan(np.zeros(5), -0.2)[0]
    few = ShapeModel.fit(training_meshes(count=4, vertices=400), gauge="form")
    with pytest.raises(InputError, match="built from 4 shapes"):
        complete(few, scan, FORM)
    for wrong in ({"samples": 1}, {"mirror": "both"}, {"fit": FitConfig(method="paper")}):
        with pytest.raises(InputError):
            CompletionConfig(**wrong)
    whole = complete(MODEL, raw_scan(np.zeros(5), T, model_vertices=400).scan, FORM)
    assert any("Nothing of the model is missing" in note for note in whole.notes)
    with pytest.raises(FitError, match=r"10 % are needed|hardly|two poses"):
        complete(MODEL, cut_scan(np.zeros(5), 0.97)[0], FORM)


@cache
def blobs(gauge: str, count: int = 14) -> ShapeModel:
    """Return a model of blobs of five modes, each scaled by its own size, that contains its training shapes."""
    d, faces = sphere(400)
    rng = np.random.default_rng(3)
    shapes = [Mesh(blob(d, rng.standard_normal(5)) * np.exp(0.05 * rng.standard_normal()), faces) for _ in range(count)]
    return ShapeModel.fit(shapes, gauge=gauge)


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_results_of_a_model_with_its_training_shapes_are_calibrated_on_them(gauge: str) -> None:
    scan, truth, _ = cut_scan(np.array([0.8, -0.6, 1.0, 0.5, -0.4]), -0.2)
    completion = complete(blobs(gauge), scan, replace(FORM, with_doubtful=True))
    assert completion.status == "converged"
    assert {estimate.calibrated_on for estimate in completion.estimates()} == {14}
    assert not any("not calibrated" in note for note in completion.notes)
    length = next(estimate for estimate in completion.estimates() if estimate.name == "area")
    corners = truth[np.asarray(MODEL.faces)]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    assert length.low < area < length.high
    without = complete(replace(blobs(gauge), training=None), scan, replace(FORM, with_doubtful=True))
    assert {estimate.calibrated_on for estimate in without.estimates()} == {0}
    assert any("not calibrated" in note for note in without.notes)


def test_the_prior_of_a_free_size_is_the_spread_of_the_training_shapes() -> None:
    model = blobs("shape")
    scan = cut_scan(np.zeros(5), 0.1)[0]
    completion = complete(model, scan, replace(FORM, with_doubtful=True))
    assert model.training is not None
    spread = model.training.log_scale_stddev
    assert spread is not None and 0.02 < spread < 0.1
    assert np.isclose(completion.posterior.prior_variance[POSE - 1], spread**2)
    assert any(f"{100 * spread:.2g} %" in note for note in completion.notes)
    larger = complete(model, scan.with_vertices(3.0 * scan.vertices), replace(FORM, with_doubtful=True))
    assert larger.status == "doubtful" and "times as large" in larger.reason


def test_other_objects_are_not_converged() -> None:
    d, faces = sphere(2000)
    for stretch in ((1.0, 1.0, 3.0), (1.0, 2.5, 2.5)):
        x = d * stretch
        x = x * (np.linalg.norm(MODEL.mean_vertices) / 20.0 / np.sqrt((x**2).sum(axis=1).mean()))
        for part in (x[:, 2] > -9e9, x[:, 2] > 0):
            try:
                completion = complete(blobs("form"), part_of(Mesh(x, faces), part), replace(FORM, with_doubtful=True))
            except FitError:
                continue
            assert completion.status == "doubtful"


def test_a_model_of_few_shapes_does_not_claim_to_predict_what_is_missing() -> None:
    """Of a population of 30 equal modes, five shapes say nothing on a half that is missing."""
    d, faces = sphere(400)
    rng = np.random.default_rng(0)
    centres = rng.standard_normal((30, 3))
    bumps = np.exp(4 * (d @ (centres / np.linalg.norm(centres, axis=1, keepdims=True)).T - 1))

    def shape() -> Mesh:
        return Mesh(80 * d * (1 + 0.05 * bumps @ rng.standard_normal(30))[:, None], faces)

    model = ShapeModel.fit([shape() for _ in range(5)], gauge="form")
    truth = shape()
    scan = part_of(truth, truth.vertices[:, 0] < 0)
    with pytest.raises(FitError, match=r"not predicted better than by the mean shape|does not explain"):
        complete(model, scan, FORM, T_scan_model=Similarity.identity())
