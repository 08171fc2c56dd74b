"""Modes beside the model's own: outside its span, as strong as the covariance they stand for, mirrored where due."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from shapespace.fit.dense import residual_modes as residual
from shapespace.fit.dense.residual_modes import ResidualModes, residual_modes
from shapespace.fit.robust.robust_settings import ResidualSettings
from shapespace.model import local_modes
from shapespace.model.shape_model import ShapeModel
from shapespace.types import FloatArray, Mesh
from synthetic_shapes import blob_model, sphere

SETTINGS = ResidualSettings(count=30, range_share=1.2)


def symmetric_model(vertices: int = 400) -> ShapeModel:
    """Return a model whose mean is its own mirror image in x, and whose modes are not."""
    d, faces = sphere(vertices)
    x, y, _ = d.T[:, :, None]
    base = d * [70.0, 110.0, 85.0] * (1 + 0.4 * np.exp((d @ [[0.0], [0.8], [0.6]] - 1) / 0.2))
    fields = np.stack([d * np.exp(3 * (x - 1)) * 9, d * x * y * 6, np.array([0.3, 0.0, 1.0]) * np.sin(2 * x + y) * 4])
    weights = np.random.default_rng(0).standard_normal((12, 3))
    shapes = [base + np.tensordot(s * w, fields, axes=1) for w in weights for s in (-1, 1)]
    return ShapeModel.fit([Mesh(shape, faces) for shape in shapes], modes=3, gauge="shape", align=False)


def covariance(model: ShapeModel, settings: ResidualSettings, *, mirrored: bool) -> FloatArray:
    """Return the whole covariance (3V, 3V) outside the model's span; the oracle, in dense float64."""
    x = model.mean_vertices
    size = np.sqrt(((x - x.mean(axis=0)) ** 2).sum(axis=1).mean())
    near = np.exp(-((x[:, None] - x) ** 2).sum(axis=2) / (settings.range_share * size) ** 2)
    near = np.repeat(np.repeat(near, 3, axis=0), 3, axis=1)
    P = model.basis
    S = P * model.stddev
    C = settings.local_share * near * (S @ S.T)
    if mirrored:
        weight, index = (a[:, :4] for a in cKDTree(x).query(x * [-1, 1, 1], 4))
        weight = 1 / np.maximum(weight, 1e-9)
        weight /= weight.sum(axis=1, keepdims=True)
        M = np.einsum("vn,vndk->vdk", weight, S.reshape(-1, 3, S.shape[1])[index]) * np.array([-1, 1, 1])[:, None]
        M = M.reshape(S.shape)
        C += settings.local_share * near * (M @ M.T) + settings.mirror_share * M @ M.T
    C -= P @ (P.T @ C)
    return C - (C @ P) @ P.T


def share_held(made: ResidualModes, C: FloatArray) -> float:
    """Return the variance in `C` along the modes, as a share of what as many can hold."""
    Q = flat(made)[:, -len(made.stddev) :]
    best = np.linalg.eigvalsh(C)[::-1][: len(made.stddev)]
    return float(np.trace(Q.T @ C @ Q) / best.sum())


def flat(made: ResidualModes) -> FloatArray:
    return made.modes.reshape(-1, made.modes.shape[2]).astype(np.float64)


def test_the_model_s_own_modes_come_first_and_the_others_are_at_right_angles() -> None:
    model = blob_model(400)
    made = residual_modes(model, SETTINGS)
    assert made.modes.shape == (400, 3, 5 + len(made.stddev)) and made.modes.dtype == np.float32
    np.testing.assert_allclose(flat(made)[:, :5], model.basis, atol=1e-7)
    np.testing.assert_allclose(flat(made).T @ flat(made), np.eye(flat(made).shape[1]), atol=1e-4)
    assert (np.diff(made.stddev) <= 0).all() and made.stddev[-1] > 0


def test_they_hold_the_variance_of_the_whole_covariance() -> None:
    model = blob_model(400)
    made, C = residual_modes(model, SETTINGS), covariance(model, SETTINGS, mirrored=False)
    assert len(made.stddev) == SETTINGS.count
    assert share_held(made, C) > 0.99
    np.testing.assert_allclose(made.stddev[:10], np.sqrt(np.linalg.eigvalsh(C)[::-1][:10]), rtol=0.05)


def test_the_strongest_products_stand_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    model = blob_model(400)
    monkeypatch.setattr(residual, "MOST_PRODUCTS", 45)
    made = residual._compute_modes(model, SETTINGS)
    assert share_held(made, covariance(model, SETTINGS, mirrored=False)) > 0.97


def test_a_mean_that_is_its_own_mirror_image_gets_the_mirrored_modes() -> None:
    model = symmetric_model()
    assert residual._mirror(model) is not None
    made = residual_modes(model, SETTINGS)
    assert share_held(made, covariance(model, SETTINGS, mirrored=True)) > 0.97
    mirrored = np.asarray(residual._mirror(model)(made.modes[:, :, :3])).reshape(-1, 3)
    inside = flat(made) @ (flat(made).T @ mirrored)
    assert np.linalg.norm(mirrored - inside) < 0.03 * np.linalg.norm(mirrored)


def test_a_lopsided_mean_has_no_mirror_image() -> None:
    assert residual._mirror(blob_model(400)) is None


def test_blocks_change_nothing_but_the_rounding(monkeypatch: pytest.MonkeyPatch) -> None:
    model = symmetric_model()
    before = residual._compute_modes(model, SETTINGS)
    monkeypatch.setattr(local_modes, "_BLOCK", 37)
    after = residual._compute_modes(model, SETTINGS)
    np.testing.assert_allclose(after.stddev, before.stddev, rtol=1e-4)
    # The same span, whatever the signs.
    np.testing.assert_allclose(np.linalg.svd(flat(before).T @ flat(after))[1], 1.0, atol=1e-3)


def test_they_are_made_once_a_model_and_settings() -> None:
    model = blob_model(400)
    assert residual_modes(model, SETTINGS) is residual_modes(model, ResidualSettings(count=30, range_share=1.2))
    assert len(residual_modes(model, ResidualSettings(count=7)).stddev) == 7


def test_those_of_a_model_in_a_file_are_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SHAPESPACE_CACHE", str(tmp_path))
    monkeypatch.delenv("SHAPESPACE_KEEP")
    made, asked = residual._compute_modes, []
    monkeypatch.setattr(residual, "_compute_modes", lambda *of: asked.append(of) or made(*of))

    def ask(model: ShapeModel, settings: ResidualSettings) -> tuple[ResidualModes, bool]:
        before = len(asked)
        return residual_modes(model, settings), len(asked) == before

    model = symmetric_model()
    ask(model, SETTINGS)
    assert not (tmp_path / "kept").exists(), "a model that stands in no file has no later runs"

    model.save(tmp_path / "model.h5")
    one, two, three = (ShapeModel.load(tmp_path / "model.h5") for _ in range(3))
    first, found = ask(one, SETTINGS)
    assert not found
    again, found = ask(two, SETTINGS)
    assert found and again.modes.tobytes() == first.modes.tobytes()
    assert again.stddev.tobytes() == first.stddev.tobytes()

    # Other settings, another model and a damaged file find nothing.
    assert not ask(two, ResidualSettings(count=7))[1]
    blob_model(400).truncate(3).save(tmp_path / "other.h5")
    assert not ask(ShapeModel.load(tmp_path / "other.h5"), SETTINGS)[1]
    for file in (tmp_path / "kept").iterdir():
        file.write_bytes(file.read_bytes()[:-9])
    assert not ask(three, SETTINGS)[1]
