"""Properties of parts in a tree of joints: conversion to tangent vertices and back, and its derivatives."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.errors import InputError
from shapespace.geometry.articulation import Articulation
from shapespace.geometry.similarity import fit_similarity, small_poses

COUNTS = (60, 50, 40)


def make_parts(rng: np.random.Generator) -> np.ndarray:
    """Return a long part, one beside its end, and one beside its middle."""
    directions = [rng.normal(size=(n, 3)) for n in COUNTS]
    parts = [u / np.linalg.norm(u, axis=1)[:, None] for u in directions]
    parts[0] = parts[0] * [40, 10, 10]
    parts[1] = parts[1] * [38, 8, 8] + [80, 0, 0]
    parts[2] = parts[2] * [5, 30, 5] + [0, 45, 0]
    return np.concatenate(parts)


def flexed(vertices: np.ndarray, degrees: float) -> np.ndarray:
    R = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(degrees)]).as_matrix()
    out, joint = vertices.copy(), np.array([41.0, 0.0, 0.0])
    out[60:110] = (out[60:110] - joint) @ R.T + joint
    return out


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_parts_are_jointed_where_they_are_nearest(rng) -> None:
    parts = Articulation(make_parts(rng), COUNTS)
    assert sorted((joint.part, joint.parent) for joint in parts.joints) == [(1, 0), (2, 0)]
    assert np.all(make_parts(np.random.default_rng(0))[parts.joints[0].other, 0] > 20)  # the end beside the second part


@pytest.mark.parametrize("degrees", [0.0, 40.0, 150.0])
def test_tangent_vertices_give_the_surface_back_in_the_pose_of_the_template(rng, degrees) -> None:
    template = make_parts(rng)
    parts = Articulation(template, COUNTS)
    surface = flexed(template, degrees) + rng.normal(size=template.shape)
    moved = surface @ Rotation.from_rotvec([1.0, 2.0, 0.4]).as_matrix().T + [5.0, 6.0, -70.0]
    tangent = parts.encode(moved)
    expected = fit_similarity(surface, template, with_scale=False).apply(surface)
    assert np.allclose(parts.decode(tangent), expected, atol=1e-9)
    assert np.allclose(parts.encode(parts.decode(tangent)), tangent, atol=1e-9)
    motions = small_poses(template - template.mean(axis=0))[:, :6]
    assert np.allclose(motions.T @ (tangent - template).ravel(), 0.0, atol=1e-6)


def test_relative_pose_is_that_of_the_part_and_not_its_shape(rng) -> None:
    template = make_parts(rng)
    parts = Articulation(template, COUNTS)
    surface = flexed(template, 30.0)
    poses = parts.poses_of(surface)
    at = [joint.part for joint in parts.joints].index(1)
    assert np.allclose(np.rad2deg(poses.rotation[at]), [0.0, 0.0, 30.0], atol=1e-6)
    assert np.allclose(poses.rotation[1 - at], 0.0, atol=1e-9)
    assert np.allclose(poses.shape, 0.0, atol=1e-9)
    moved = np.linalg.norm((surface - template)[60:110].mean(axis=0))
    assert np.linalg.norm(poses.translation[at]) < 0.3 * moved  # a joint moves less than the centre of the part


@pytest.mark.parametrize("degrees", [0.0, 40.0])
def test_derivatives_are_those_of_differences(rng, degrees) -> None:
    template = make_parts(rng)
    parts = Articulation(template, COUNTS)
    tangent = parts.encode(flexed(template, degrees) + rng.normal(size=template.shape))
    basis = np.linalg.qr(rng.normal(size=(template.size, 5)))[0]
    steps = [1e-5 * column.reshape(-1, 3) for column in basis.T]
    differences = [(parts.decode(tangent + e) - parts.decode(tangent - e)).ravel() / 2e-5 for e in steps]
    assert np.allclose(parts.directions(basis, tangent), np.transpose(differences), atol=1e-7)


@pytest.mark.parametrize("counts", [(150,), (100, 40), (147, 3), (100, 60)])
def test_numbers_that_are_not_those_of_the_parts_are_refused(rng, counts) -> None:
    with pytest.raises(InputError, match="Parts with"):
        Articulation(make_parts(rng), counts)
