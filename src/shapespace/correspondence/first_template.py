"""The template of the first round: a given mesh, the mean of a model, or one of the scans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from shapespace.correspondence.correspondence_result import copies
from shapespace.correspondence.landmark_guide import contradicts_most, with_own_landmarks
from shapespace.correspondence.settings import FEWEST, SIZE, CorrespondConfig
from shapespace.correspondence.symmetric_template import symmetrise
from shapespace.correspondence.template import check_template, choose_template, clean_scan, resample
from shapespace.errors import InputError, MeshError
from shapespace.geometry.doctor import NON_FINITE, repair
from shapespace.geometry.landmark_placement import far_landmarks, place_landmarks
from shapespace.geometry.normals import faces_of, rms_size
from shapespace.geometry.outer_surface import outer_surface
from shapespace.model.shape_model import ShapeModel
from shapespace.types import Mesh, Similarity

_FEWEST_SHARE = 2 / 3  # share of the requested vertices; with fewer, handles of the surface have hardly a vertex each


@dataclass(frozen=True, eq=False)
class FirstTemplate:
    """The input of the first round.

    Args:
        mesh: the template, of the size `SIZE`, about the origin.
        origin: origin of the template, in a sentence.
        repaired: usable scans, by their number.
        broken: reasons why the other scans are unusable.
        notes: sentences on the repairs of the scans and on their landmarks, by number.
        guide: a model whose mean is the template, of the same size and position.
    """

    mesh: Mesh
    origin: str
    repaired: Mapping[int, Mesh]
    broken: Mapping[int, str]
    notes: Mapping[int, Sequence[str]]
    guide: ShapeModel | None = None


def first_template(
    scans: Sequence[Mesh],
    template: Mesh | None,
    config: CorrespondConfig,
    model: ShapeModel | None = None,
) -> FirstTemplate:
    """Return the input of the first round, from `template`, the mean of `model`, or the scan nearest to the others.

    Raises:
        InputError: fewer than two scans, scans that are all equal, both a template and a model, or an object without
            mirror symmetry that `symmetric_template` asks for.
        MeshError: no scan can be a template, or the template or model has no triangles.
    """
    if config.symmetric_template and model is not None:
        raise InputError("The mean of a model is used unchanged as the template; omit --symmetric-template.")
    if len(scans) < FEWEST:
        raise InputError(f"A correspondence needs at least {FEWEST} scans, not {len(scans)}; give more.")
    if not 0 < config.landmark_uncertainty < np.inf:
        raise InputError(f"Landmarks have an uncertainty above 0, not {config.landmark_uncertainty}; give another.")
    if template is not None and model is not None:
        raise InputError(
            "Both a template and a model are given, and the model's mean is a template; omit template or model."
        )
    repaired, broken, notes = repaired_scans(scans, config)
    if len(repaired) < FEWEST:
        raise InputError(f"Hardly any of the scans can be used: {'; '.join(broken.values())}")
    if len(copies(list(repaired.values()))) == len(repaired) - 1:
        raise InputError("All scans are equal, so there is nothing to bring into correspondence; give different scans.")
    if model is not None:
        mesh, origin = _mean_of(model), "The template is the mean of the model given."
    elif template is not None:
        mesh, sentences = with_own_landmarks(check_template(template))
        origin = " ".join([f"{template.name} was given as the template.", *sentences])
    else:
        mesh, origin = _chosen_scan(repaired, config)
    if config.symmetric_template:
        mesh = symmetrise(mesh).mesh
        origin += " It was made symmetric."
    scale = SIZE / rms_size(mesh.vertices)
    T = Similarity(scale, np.eye(3), -scale * mesh.vertices.mean(axis=0))
    mesh = mesh.with_vertices(T.apply(mesh.vertices), {name: T.apply(point) for name, point in mesh.landmarks.items()})
    if contradicts_most(mesh, repaired.values(), config.landmark_uncertainty):
        mesh = mesh.with_vertices(mesh.vertices, {})
        origin += " Its landmarks contradict those of most scans, so the first round does not use them."
    return FirstTemplate(mesh, origin, repaired, broken, notes, None if model is None else _transform_model(model, T))


def usable_scan(scan: Mesh, *, strict: bool = False) -> tuple[Mesh, list[str]]:
    """Return the repaired scan with the landmarks near its surface, and sentences on repairs and landmarks.

    Raises:
        MeshError: the scan cannot be used.
    """
    mesh, findings = repair(scan, strict=strict)
    notes = [
        f"{finding.problem} {finding.action}"
        for finding in findings
        if finding.level == "note" or NON_FINITE in finding.problem
    ]
    mesh, sentences = with_own_landmarks(mesh)
    far = far_landmarks(mesh, place_landmarks(mesh, mesh.landmarks)) if mesh.landmarks else []
    return mesh, [*notes, *sentences, *far]


def repaired_scans(
    scans: Sequence[Mesh], config: CorrespondConfig, first: int = 0
) -> tuple[dict[int, Mesh], dict[int, str], dict[int, list[str]]]:
    """Return the usable scans, by number from `first` on, why the others are not usable, and notes on scans."""
    repaired: dict[int, Mesh] = {}
    notes: dict[int, list[str]] = {}
    broken: dict[int, str] = {}
    for i, scan in enumerate(scans, first):
        try:
            repaired[i], notes[i] = usable_scan(outer_surface(scan) if config.outer else scan)
        except MeshError as error:
            broken[i] = f"broken: {error}"
    numbers = list(repaired)
    for copy, earlier in copies(list(repaired.values())).items():
        notes[numbers[copy]].append(f"It is {repaired[numbers[earlier]].name} again; exclude one of the two.")
    if config.ignore_colours:
        repaired = {i: replace(scan, colours=None) for i, scan in repaired.items()}
    return repaired, broken, notes


def _mean_of(model: ShapeModel) -> Mesh:
    if model.faces is None:
        raise MeshError("The model has no triangles, and a template needs them; omit it, or give another model.")
    return Mesh(model.mean_vertices, model.faces, model.landmarks.positions(model.mean_vertices), "mean")


def _chosen_scan(scans: Mapping[int, Mesh], config: CorrespondConfig) -> tuple[Mesh, str]:
    """Return the scan nearest to the others, meshed evenly, and why it was chosen."""
    choice = choose_template(list(scans.values()), config.seed)
    chosen = scans[list(scans)[choice.index]]
    mesh = resample(clean_scan(chosen), config.vertices)
    _check_vertices(mesh, config.vertices)
    origin = (
        f"{chosen.name} is the first template: of {np.isfinite(choice.nearness).sum()} candidates it lies nearest "
        f"to the others, {100 * choice.nearness[choice.index]:.1f} % of its size off after a smooth change."
    )
    if chosen.colours is not None:
        mesh = replace(mesh, colours=chosen.colours[cKDTree(chosen.vertices).query(mesh.vertices)[1]])
    return mesh.with_vertices(mesh.vertices, chosen.landmarks), origin


def _check_vertices(template: Mesh, wanted: int) -> None:
    """Check that the first template has about as many vertices as requested.

    Handles and holes take vertices: a closed surface of F triangles with g handles has F / 2 + 2 - 2 g.

    Raises:
        InputError: it has fewer than two thirds of the requested vertices.
    """
    count = len(template.vertices)
    if count < _FEWEST_SHARE * wanted:
        edges = faces_of(template)[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
        characteristic = count - len(np.unique(np.sort(edges, axis=1), axis=0)) + len(faces_of(template))
        handles = (2 - characteristic) // 2
        enough = int(np.ceil(-characteristic / (1 - _FEWEST_SHARE) / 100) * 100)
        raise InputError(
            f"{template.name} is the first template, and with --vertices {wanted} it has only {count} vertices, since "
            f"its surface has about {handles} handles, as inner surfaces of CT scans have; give --vertices {enough} or "
            "more, or remove inner surfaces (--outer)."
        )


def _transform_model(model: ShapeModel, T: Similarity) -> ShapeModel:
    """Return `model` with its frame moved by `T`, which does not rotate."""
    return ShapeModel(
        mean=T.apply(model.mean_vertices).ravel(),
        basis=model.vertex_basis,
        stddev=T.scale * model.stddev,
        total_variance=T.scale**2 * model.total_variance,
        n_training=model.n_training,
        faces=model.faces,
    )
