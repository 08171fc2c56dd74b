"""Identity and expression apart: an ordinary model in other words, that says who and what."""

from pathlib import Path

import numpy as np
import pytest

from shapespace.errors import InputError, ModelFileError
from shapespace.fit.fit_scan import FitConfig, fit_scan
from shapespace.fit.robust.posterior import variance_of_new_shapes
from shapespace.geometry.similarity import fit_similarity
from shapespace.model.additive import AdditiveModel, still_vertices
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh, Similarity
from synthetic_shapes import training_meshes

SUBJECTS, EXPRESSIONS = 8, 3


class World:
    """Faces that really are mean + A a + B e; the lower half alone moves with an expression."""

    def __init__(self) -> None:
        rng = np.random.default_rng(5)
        self.mean = training_meshes(vertices=300)[0]
        v = self.mean.vertices
        smooth = [np.cos(v @ rng.normal(0, 0.03, (3, 3)) + rng.uniform(0, 6, 3)) for _ in range(4 + EXPRESSIONS)]
        low = np.clip((np.median(v[:, 1]) - v[:, 1]) / 20, 0, 1)[:, None]
        self.A, self.B = 3.0 * np.stack(smooth[:4]), 4.0 * low * np.stack(smooth[4:])
        self.a = rng.standard_normal((SUBJECTS, 4))

    def face(self, a: np.ndarray, e: np.ndarray) -> Mesh:
        return self.mean.with_vertices(
            self.mean.vertices + np.tensordot(a, self.A, axes=1) + np.tensordot(e, self.B, axes=1)
        )

    def set(self) -> tuple[list[Mesh], list[str], list[bool]]:
        shown = np.concatenate([np.zeros((1, EXPRESSIONS)), np.eye(EXPRESSIONS)])
        rows = [(self.face(a, e), f"s{k}", not e.any()) for k, a in enumerate(self.a) for e in shown]
        meshes, subjects, neutral = (list(part) for part in zip(*rows, strict=True))
        return meshes, subjects, neutral


@pytest.fixture(scope="module")
def world() -> World:
    return World()


@pytest.fixture(scope="module")
def model(world: World) -> AdditiveModel:
    above = np.flatnonzero((world.B == 0).all(axis=(0, 2))).astype(np.int32)
    return AdditiveModel.fit(
        *world.set(), identity_modes=4, expression_modes=EXPRESSIONS, gauge="form", alignment_vertices=above
    )


def z_of(model: AdditiveModel, mesh: Mesh) -> np.ndarray:
    return model.shape.to_z(model.shape.project(mesh))


def test_it_has_the_modes_of_identity_and_of_expression(model: AdditiveModel) -> None:
    assert (model.n_identity, model.n_expression) == (4, EXPRESSIONS)
    assert np.allclose(model.shape.basis.T @ model.shape.basis, np.eye(7), atol=1e-9)


def test_splitting_and_joining_are_each_others_inverse(model: AdditiveModel) -> None:
    z = np.random.default_rng(0).standard_normal(7)
    assert np.allclose(model.join_z(*model.split(z)), z)


def test_its_covariance_is_that_of_identity_plus_that_of_expression(model: AdditiveModel) -> None:
    one = np.eye(7)
    parts = np.stack([model.mesh(t[:4], t[4:]).vertices - model.shape.mean_vertices for t in one])
    W = parts.reshape(7, -1).T
    assert np.allclose(W @ W.T, (model.shape.basis * model.shape.stddev**2) @ model.shape.basis.T, atol=1e-8)


def test_a_person_keeps_identity_whatever_the_face_does(world: World, model: AdditiveModel) -> None:
    rng = np.random.default_rng(1)
    a = rng.standard_normal(4)
    codes = [model.split(z_of(model, world.face(a, e))) for e in 0.8 * rng.standard_normal((4, EXPRESSIONS))]
    rest_a, rest_e = model.split(z_of(model, world.face(a, np.zeros(EXPRESSIONS))))
    assert np.abs(rest_e).max() < 0.1
    assert max(np.abs(code - rest_a).max() for code, _ in codes) < 0.15


def test_an_expression_is_put_on_somebody_else_to_half_a_millimetre(world: World, model: AdditiveModel) -> None:
    rng = np.random.default_rng(2)
    one, other = rng.standard_normal((2, 4))
    e = np.array([0.7, 0.0, 0.2])
    moved = model.transfer(z_of(model, world.face(one, np.zeros(3))), z_of(model, world.face(other, e)))
    wanted = model.shape.reconstruct(model.shape.project(world.face(one, e)))
    away = moved.vertices - wanted
    assert np.linalg.norm(away, axis=1).mean() < 0.5
    assert np.linalg.norm(model.shape.mean_vertices - wanted, axis=1).mean() > 2


def covariance(rng: np.random.Generator, noise: float) -> np.ndarray:
    """Return (7, 7) what is known after a fit that hardly parts some directions from others."""
    J = rng.standard_normal((12, 7)) * np.geomspace(3.0, 0.1, 7)
    return np.linalg.inv(J.T @ J / noise**2 + np.eye(7))


def fitted(rng: np.random.Generator, truth: np.ndarray, C: np.ndarray) -> np.ndarray:
    """Return (7,) the fit of `truth`, both in standard deviations, whose covariance after it is C."""
    told = np.linalg.inv(C) - np.eye(7)
    return C @ (told @ truth + np.linalg.cholesky(told + 1e-9 * np.eye(7)) @ rng.standard_normal(7))


def test_scans_of_one_person_together_tell_identity_better_than_one(model: AdditiveModel) -> None:
    rng = np.random.default_rng(3)
    single, tied = [], []
    for _ in range(60):
        a, e = rng.standard_normal(4), rng.standard_normal((5, EXPRESSIONS))
        truth = np.concatenate([np.tile(a, (5, 1)), e], axis=1) @ model.rotation
        covariances = [covariance(rng, 0.5) for _ in truth]
        seen = np.stack([fitted(rng, t, C) for t, C in zip(truth, covariances, strict=True)])
        found, shown = model.tie([model.information(z, C) for z, C in zip(seen, covariances, strict=True)])
        assert shown.shape == (5, EXPRESSIONS)
        single.append(np.abs(model.split(seen)[0] - a).mean())
        tied.append(np.abs(found - a).mean())
    assert np.mean(tied) < 0.75 * np.mean(single)


def test_one_scan_tied_with_nothing_is_the_scan(model: AdditiveModel) -> None:
    rng = np.random.default_rng(4)
    z = rng.standard_normal(7)
    a, e = model.tie([model.information(z, covariance(rng, 0.3))])
    assert np.allclose(np.concatenate([a, e[0]]), np.concatenate(model.split(z)), atol=1e-8)


def test_tying_is_the_least_squares_over_all_scans_at_once(model: AdditiveModel) -> None:
    rng = np.random.default_rng(6)
    told = [model.information(rng.standard_normal(7), covariance(rng, 0.4)) for _ in range(3)]
    for neutral in (None, [True, False, False]):
        blocks = [np.zeros((7, 4 + 3 * EXPRESSIONS)) for _ in told]
        for k, block in enumerate(blocks):
            block[:4, :4] = np.eye(4)
            if neutral is None or not neutral[k]:
                block[4:, 4 + 3 * k : 7 + 3 * k] = np.eye(3)
        left, right = np.eye(4 + 3 * EXPRESSIONS), np.zeros(4 + 3 * EXPRESSIONS)
        left[4:, 4:] /= 3
        for B, one in zip(blocks, told, strict=True):
            left, right = left + B.T @ one.precision @ B / 3, right + B.T @ one.vector / 3
        wanted = np.linalg.solve(left, right)
        a, e = model.tie(told, neutral)
        assert np.allclose(a, wanted[:4]) and np.allclose(e.ravel(), wanted[4:])


def test_a_known_neutral_scan_frees_expressions_from_identity(model: AdditiveModel) -> None:
    rng = np.random.default_rng(7)
    alone, beside = [], []
    for _ in range(60):
        a, e = rng.standard_normal(4), rng.standard_normal(EXPRESSIONS)
        truths = np.stack([np.r_[a, np.zeros(EXPRESSIONS)], np.r_[a, e]]) @ model.rotation
        C = [covariance(rng, 0.5) for _ in truths]
        told = [model.information(fitted(rng, t, c), c) for t, c in zip(truths, C, strict=True)]
        alone.append(np.abs(model.tie(told[1:])[1][0] - e).mean())
        beside.append(np.abs(model.tie(told, [True, False])[1][1] - e).mean())
    assert np.mean(beside) < 0.95 * np.mean(alone)


def test_what_a_robust_fit_knows_can_be_tied(world: World, model: AdditiveModel) -> None:
    scan = world.face(np.array([0.5, -0.5, 0.2, 0.1]), np.array([0.6, 0.0, 0.3]))
    one = fit_scan(model.shape, scan, FitConfig(unit="mm"), T_scan_model=Similarity.identity())
    assert one.z_covariance is not None
    assert np.allclose(np.sqrt(one.z_covariance.diagonal()) * model.shape.stddev, one.b_stddev, rtol=1e-6)
    a, _ = model.tie([model.information(one.z, one.z_covariance)])
    assert np.allclose(a, model.split(one.z)[0], atol=1e-6)
    config = FitConfig(method="paper", unit="mm")
    assert fit_scan(model.shape, scan, config, T_scan_model=Similarity.identity()).z_covariance is None


def test_its_file_reads_as_the_plain_model_too(model: AdditiveModel, tmp_path: Path) -> None:
    model.save(tmp_path / "m.h5")
    again = AdditiveModel.load(tmp_path / "m.h5")
    assert again.n_identity == 4 and np.array_equal(again.rotation, model.rotation)
    assert ShapeModel.load(tmp_path / "m.h5").content_hash == model.shape.content_hash


def test_a_plain_model_is_not_taken_for_one(model: AdditiveModel, tmp_path: Path) -> None:
    model.shape.save(tmp_path / "plain.h5")
    with pytest.raises(ModelFileError, match="does not separate identity and expression"):
        AdditiveModel.load(tmp_path / "plain.h5")


def test_still_vertices_are_those_that_expressions_leave_alone(world: World) -> None:
    meshes, _, neutral = world.set()
    rest = np.stack([m.vertices for m, plain in zip(meshes, neutral, strict=True) if plain])
    shown = np.stack([m.vertices for m, plain in zip(meshes, neutral, strict=True) if not plain])
    still = still_vertices(np.repeat(rest, EXPRESSIONS, axis=0), shown, 0.3)
    moved = np.abs(world.B).sum(axis=(0, 2))
    assert len(still) == round(0.3 * len(moved)) and moved[still].max() <= np.median(moved)


def test_training_sets_that_cannot_be_parted_are_refused(world: World) -> None:
    meshes, subjects, neutral = world.set()
    with pytest.raises(InputError, match="There is no neutral face of s0"):
        AdditiveModel.fit(meshes[1:], subjects[1:], neutral[1:])
    with pytest.raises(InputError, match="at least two people"):
        AdditiveModel.fit(meshes[:4], subjects[:4], neutral[:4])
    with pytest.raises(InputError, match="one subject"):
        AdditiveModel.fit(meshes, subjects[1:], neutral)
    still = [m for m, plain in zip(meshes, neutral, strict=True) if plain]
    with pytest.raises(InputError, match="No expression differs"):
        AdditiveModel.fit(
            [*still, *still],
            [f"s{k}" for k in range(8)] * 2,
            [True] * 8 + [False] * 8,
            alignment_vertices=np.arange(300),
        )


def test_coefficients_of_another_number_are_refused(model: AdditiveModel) -> None:
    with pytest.raises(InputError, match="Give 7 finite coefficients"):
        model.split(np.zeros(6))
    with pytest.raises(InputError, match="at most 4 finite coefficients of identity"):
        model.join_z(np.zeros(5), ())
    with pytest.raises(InputError, match=r"their \(7, 7\) covariance"):
        model.information(np.zeros(7), np.ones(7))
    with pytest.raises(InputError, match="positive definite"):
        model.information(np.zeros(7), np.zeros((7, 7)))
    with pytest.raises(InputError, match="at least one estimate"):
        model.tie([])


@pytest.fixture(scope="module")
def crowd(world: World) -> tuple[list[Mesh], list[str], list[bool]]:
    """Sixty people, neutral and with one expression."""
    rng = np.random.default_rng(8)
    rows = [
        (world.face(a, e), f"c{k}", not e.any())
        for k, a in enumerate(rng.standard_normal((60, 4)))
        for e in (np.zeros(EXPRESSIONS), rng.standard_normal(EXPRESSIONS))
    ]
    meshes, subjects, neutral = (list(part) for part in zip(*rows, strict=True))
    return meshes, subjects, neutral


def test_the_file_says_that_variances_are_of_those_left_out(
    model: AdditiveModel, crowd: tuple[list[Mesh], list[str], list[bool]], tmp_path: Path
) -> None:
    many = AdditiveModel.fit(*crowd, gauge="form", identity_modes=4, expression_modes=2)
    many.save(tmp_path / "m.h5")
    read = ShapeModel.load(tmp_path / "m.h5")
    assert read.held_out and read.content_hash == many.shape.content_hash
    assert np.array_equal(variance_of_new_shapes(read), read.stddev**2)
    assert model.shape.held_out and not ShapeModel.fit(training_meshes(vertices=300)).held_out


def test_what_identity_leaves_outside_its_modes_becomes_local_modes_of_identity(
    crowd: tuple[list[Mesh], list[str], list[bool]], world: World
) -> None:
    few = 12  # meshes, of six people, whose modes leave much of the four of the world
    part = tuple(values[:few] for values in crowd)
    lacking, whole = (
        AdditiveModel.fit(*part, gauge="form", identity_modes=2, expression_modes=2, local_identity_modes=most)
        for most in (0, 40)
    )
    assert lacking.n_identity == 2 and 2 < whole.n_identity <= 42
    assert lacking.n_expression == whole.n_expression == 2
    rng = np.random.default_rng(4)
    neutral = [world.face(a, np.zeros(EXPRESSIONS)) for a in rng.standard_normal((20, 4))]

    def left_over(model: AdditiveModel) -> float:
        found = [model.shape.reconstruct(model.shape.project(mesh)) for mesh in neutral]
        pairs = [
            (fit_similarity(x, mesh.vertices, with_scale=False).apply(x), mesh)
            for x, mesh in zip(found, neutral, strict=True)
        ]
        return float(np.mean([((x - mesh.vertices) ** 2).mean() for x, mesh in pairs]))

    assert left_over(whole) < 0.8 * left_over(lacking)
    assert (whole.shape.stddev**2).sum() <= whole.shape.total_variance * (1 + 1e-9)


def test_kin_are_left_out_together_when_variances_are_found(
    crowd: tuple[list[Mesh], list[str], list[bool]],
) -> None:
    meshes, subjects, neutral = crowd
    twins = [f"{name}'s twin" for name in subjects]
    kin = [*subjects, *subjects]
    together, strangers = (
        AdditiveModel.fit(
            meshes * 2, subjects + twins, neutral * 2, gauge="form", identity_modes=3, expression_modes=1, kin=given
        )
        for given in (kin, None)
    )
    alone = AdditiveModel.fit(meshes, subjects, neutral, gauge="form", identity_modes=3, expression_modes=1)
    assert together.shape.held_out and strangers.shape.held_out
    # Twins who are left out with each other tell no more of a new person than one of them; twins who are not, do.
    total = alone.shape.total_variance
    assert together.shape.total_variance == pytest.approx(total, rel=1e-4)
    assert abs(strangers.shape.total_variance - total) > 2e-3 * total
    with pytest.raises(InputError, match="kin for each or none"):
        AdditiveModel.fit(meshes, subjects, neutral, kin=kin)


def test_the_same_scan_many_times_is_the_scan(model: AdditiveModel) -> None:
    rng = np.random.default_rng(9)
    told = model.information(rng.standard_normal(7), covariance(rng, 0.4))
    once, often = model.tie([told]), model.tie([told] * 24)
    assert np.allclose(often[0], once[0]) and np.allclose(often[1], once[1])
