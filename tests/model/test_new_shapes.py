"""Variances of new shapes: positive, falling, near the truth from ten shapes on, without a jump at any number."""

import numpy as np
import pytest

from shapespace.model.new_shapes import HeldOut, held_out_shapes, variances_of_new_shapes
from shapespace.types import FloatArray

COORDINATES = 200
SPREADS = {"steep": 50.0 / np.arange(1.0, COORDINATES + 1), "slow": 50.0 * np.arange(1.0, COORDINATES + 1) ** -0.6}


def sampled(
    shapes: FloatArray, groups: list[str] | None = None
) -> tuple[FloatArray, float, int, FloatArray, FloatArray, HeldOut]:
    """Return sample variances, their total, N, mean, modes and what those left out have, of shapes (N, D)."""
    mean = shapes.mean(axis=0)
    centred = shapes - mean
    _, size, modes = np.linalg.svd(centred, full_matrices=False)
    sample = size**2 / (len(shapes) - 1)
    kept = sample > 1e-9 * sample[0]
    names = groups or [str(k) for k in range(len(shapes))]
    held = held_out_shapes(centred @ centred.T, names, int(kept.sum()), centred=True)
    return sample[kept], float(sample.sum()), len(shapes), mean, modes[kept], held


def too_unlikely(variance: FloatArray, true: FloatArray) -> float:
    """Return what the likelihood of a new shape loses beside the true variances, a mode."""
    return float((0.5 * (true / variance - 1 - np.log(true / variance))).mean())


@pytest.mark.parametrize("kind", SPREADS)
@pytest.mark.parametrize("count", [3, 10, 30, 150])
@pytest.mark.parametrize("left_out", [True, False])
def test_they_are_positive_and_fall(kind: str, count: int, left_out: bool) -> None:
    shapes = np.random.default_rng(count).standard_normal((count, COORDINATES)) * SPREADS[kind]
    sample, total, n, _, _, held = sampled(shapes)
    found = variances_of_new_shapes(sample, total, n, held if left_out else None)
    assert (found > 0).all() and (np.diff(found) <= 0).all() and np.isfinite(found).all()


@pytest.mark.parametrize("kind", SPREADS)
@pytest.mark.parametrize("count", [10, 20, 49, 50])
@pytest.mark.parametrize("left_out", [True, False])
def test_new_shapes_vary_as_they_say(kind: str, count: int, left_out: bool) -> None:
    loss, own_loss, ratio = [], [], []
    for seed in range(3):
        rng = np.random.default_rng((count, seed))
        shapes, new = (rng.standard_normal((k, COORDINATES)) * SPREADS[kind] for k in (count, 400))
        sample, total, n, mean, modes, held = sampled(shapes)
        found = variances_of_new_shapes(sample, total, n, held if left_out else None)
        true = (((new - mean) @ modes.T) ** 2).mean(axis=0)
        loss.append(too_unlikely(found, true))
        own_loss.append(too_unlikely(sample, true))
        ratio.append(float(np.exp(np.log(found / true).mean())))
    assert np.mean(loss) < 0.3
    assert count < 40 or np.mean(loss) < 0.5 * np.mean(own_loss)
    assert 1 / 1.6 < np.mean(ratio) < 1.6


def test_of_many_shapes_they_are_those_of_the_sample() -> None:
    spread = 20.0 * 0.8 ** np.arange(15.0)
    shapes = np.random.default_rng(1).standard_normal((500, 15)) * spread
    sample, total, n, _, _, held = sampled(shapes)
    assert np.allclose(variances_of_new_shapes(sample, total, n), sample, rtol=0.2)
    assert np.allclose(variances_of_new_shapes(sample, total, n, held), sample, rtol=0.2)


@pytest.mark.parametrize("count", [24, 49])
def test_one_shape_more_changes_little(count: int) -> None:
    change = []
    for seed in range(3):
        shapes = np.random.default_rng(seed).standard_normal((count + 1, COORDINATES)) * SPREADS["steep"]
        less, more = (
            variances_of_new_shapes(sample, total, n, held)
            for sample, total, n, _, _, held in (sampled(shapes[:count]), sampled(shapes))
        )
        change.append(np.log(more[: len(less)] / less))
    assert np.abs(np.mean(change, axis=0)[: count // 2]).max() < 0.15


def test_mirror_images_are_no_further_people() -> None:
    # Each stands beside another with every second coordinate turned about, as a face beside its mirror image.
    spread = np.where(np.arange(COORDINATES) % 2, 0.3, 1.0) * SPREADS["steep"]
    turned = np.where(np.arange(COORDINATES) % 2, -1.0, 1.0)
    loss = {"spectrum": [], "left out": [], "sample": []}
    for seed in range(3):
        rng = np.random.default_rng(seed)
        people, new = (rng.standard_normal((k, COORDINATES)) * spread for k in (30, 1_000))
        shapes = np.stack([people, people * turned], axis=1).reshape(60, -1)
        sample, total, n, mean, modes, held = sampled(shapes, [str(k // 2) for k in range(60)])
        true = (((new - mean) @ modes.T) ** 2).mean(axis=0)
        loss["spectrum"].append(too_unlikely(variances_of_new_shapes(sample, total, n), true))
        loss["left out"].append(too_unlikely(variances_of_new_shapes(sample, total, n, held), true))
        loss["sample"].append(too_unlikely(sample, true))
    spectrum, left_out, own = (float(np.mean(loss[name])) for name in ("spectrum", "left out", "sample"))
    assert left_out < 0.8 * spectrum and left_out < 0.8 * own
