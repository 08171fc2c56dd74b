import numpy as np
import pytest

from shapespace.errors import InputError
from shapespace.geometry.procrustes import align_in_place, centroid_size
from shapespace.geometry.similarity import fit_similarity
from shapespace.types import FloatArray
from synthetic_shapes import angle_deg, similarity, training_meshes


def shapes(n: int = 8) -> FloatArray:
    return np.stack([m.vertices for m in training_meshes(vertices=200)[:n]])


def moved(data: FloatArray, scales: bool) -> FloatArray:
    return np.stack([similarity(i, 35.0, 0.5 + 0.2 * i if scales else 1.0).apply(x) for i, x in enumerate(data)])


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_copies_of_one_shape_in_many_poses_fall_on_each_other(gauge: str) -> None:
    data = moved(np.repeat(shapes(1), 6, axis=0), scales=gauge == "shape")
    size = np.mean([centroid_size(x) for x in data])
    aligned = align_in_place(data, gauge)
    assert aligned.converged
    assert np.abs(data - data[0]).max() < 1e-9
    assert np.allclose(aligned.mean, data[0])
    assert centroid_size(aligned.mean) == pytest.approx(size)


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_the_outcome_does_not_depend_on_the_poses_given(gauge: str) -> None:
    plain, posed = shapes(), moved(shapes(), scales=gauge == "shape")
    posed[0] = plain[0]  # its orientation is the frame
    a, b = align_in_place(plain, gauge, tolerance=1e-13), align_in_place(posed, gauge, tolerance=1e-13)
    ratio = centroid_size(b.mean) / centroid_size(a.mean)
    assert np.allclose(plain * ratio, posed, atol=1e-6)
    assert ratio == pytest.approx(1.0, abs=1e-6) or gauge == "shape"


@pytest.mark.parametrize("gauge", ["form", "shape"])
def test_at_the_end_every_shape_lies_best_on_the_mean(gauge: str) -> None:
    data = moved(shapes(), scales=False)
    mean = align_in_place(data, gauge, tolerance=1e-13).mean
    assert np.allclose(mean, data.mean(axis=0))
    assert np.allclose(mean.mean(axis=0), 0, atol=1e-9)
    for x in data:
        T = fit_similarity(x, mean, with_scale=False)
        assert angle_deg(T.rotation) < 1e-5
        assert np.linalg.norm(T.translation) < 1e-6


def test_form_keeps_sizes_and_shape_makes_them_the_mean_size() -> None:
    data = moved(shapes(), scales=True)
    sizes = np.array([centroid_size(x) for x in data])
    form, shape = data.copy(), data.copy()
    align_in_place(form, "form")
    align_in_place(shape, "shape")
    assert np.allclose([centroid_size(x) for x in form], sizes)
    assert np.allclose([centroid_size(x) for x in shape], sizes.mean())


def test_alignment_never_makes_the_spread_larger_than_the_poses_given() -> None:
    data = shapes()
    before = ((data - data.mean(axis=0)) ** 2).sum()
    align_in_place(data, "form")
    assert ((data - data.mean(axis=0)) ** 2).sum() <= before


def test_only_the_chosen_vertices_carry_the_alignment() -> None:
    base = shapes(1)[0]
    data = np.repeat(base[None], 5, axis=0)
    rigid = np.arange(100, dtype=np.int32)
    data[:, 150:] += np.random.default_rng(0).standard_normal((5, 50, 3)) * 30
    data = moved(data, scales=False)
    align_in_place(data, "form", alignment_vertices=rigid)
    assert np.abs(data[:, rigid] - data[0, rigid]).max() < 1e-8
    assert np.ptp(data[:, 150:], axis=0).max() > 10


def test_the_cap_is_reported_and_each_round_is_told() -> None:
    told: list[tuple[int, float]] = []
    data = moved(shapes(), scales=True)
    aligned = align_in_place(data, "shape", tolerance=1e-300, max_iterations=3, on_iteration=lambda *a: told.append(a))
    assert (aligned.converged, aligned.iterations) == (False, 3)
    assert [i for i, _ in told] == [1, 2, 3]
    assert told[0][1] > told[1][1] > told[2][1]


def test_what_cannot_be_aligned_is_refused() -> None:
    with pytest.raises(InputError, match="gauge"):
        align_in_place(shapes(), "size")
    with pytest.raises(InputError, match="three vertices"):
        align_in_place(shapes(), "form", alignment_vertices=np.array([0, 1], dtype=np.int32))
    for outside in (-1, 10**6):
        with pytest.raises(InputError, match="is outside this range"):
            align_in_place(shapes(), "form", alignment_vertices=np.array([0, 1, 2, outside], dtype=np.int32))
    with pytest.raises(InputError, match="coincide"):
        align_in_place(np.zeros((3, 10, 3)), "shape")
    for gauge in ("form", "shape"):
        for index in (0, 2):
            data = shapes(4)
            data[index] = 1.0
            with pytest.raises(InputError, match=r"line|coincide"):
                align_in_place(data, gauge)
