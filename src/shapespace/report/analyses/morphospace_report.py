"""Report of an ordination: the morphospace, its scree plot, and scores, loadings and eigenvalues as tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.cohort.cohort import Cohort
from shapespace.errors import InputError
from shapespace.report.analyses.analysis_report import AnalysisReport, Rows
from shapespace.report.analyses.methods_section import methods_parts
from shapespace.report.analyses.shape_data import add_shape_data, model_hashes, scree_part, tangent_parts
from shapespace.schemas import ConfusionPart, MorphospacePart, Part, TableColumn, TablePart
from shapespace.statistics.methods import methods_of, sample_sizes
from shapespace.statistics.shape_tests.ordination import Ordination, ordinate, principal_components
from shapespace.statistics.shape_tests.permutations import Groups
from shapespace.types import FloatArray

FILE = "morphospace.npz"
_SHOWN_AXES = 6  # axes that the plot can show; a report with more of them is large
_MOST_SENTENCES = 3  # axes with a share in the summary
_TITLES = {
    "pca": "Morphospace: principal components",
    "between-groups": "Morphospace: between-group principal components",
    "cva": "Morphospace: canonical variates",
    "phylogenetic-pca": "Morphospace: phylogenetic principal components",
    "paca": "Morphospace: phylogenetically aligned components",
}
_AXES = {"pca": "principal component", "between-groups": "between-group component", "cva": "canonical variate",
         "phylogenetic-pca": "phylogenetic component", "paca": "aligned component"}  # fmt: skip
_DIVIDED = {
    "between-groups": "variance of the group means",
    "cva": "variance between groups in units of that within groups",
    "paca": "covariance with the phylogenetic signal",
}
"""What the shares of the axes are shares of, where it is not the variance."""
_CITATIONS = {
    "pca": (),
    "between-groups": ("Cardini, O'Higgins and Rohlf (2019) Evolutionary Biology 46:303–316.",),
    "cva": ("Campbell and Atchley (1981) Systematic Zoology 30:268–280.",
            "Venables and Ripley (2002) Modern Applied Statistics with S, 4th edition, Springer."),
    "phylogenetic-pca": ("Revell (2009) Evolution 63:3258–3268.",),
    "paca": ("Collyer and Adams (2021) Methods in Ecology and Evolution 12:359–372.",),
}  # fmt: skip


def morphospace_report(result: Ordination, first: tuple[int, int] = (1, 2)) -> AnalysisReport:
    """Return the report of an ordination.

    Args:
        result: the ordination.
        first: numbers of the axes that are drawn across and up, from 1.

    Raises:
        InputError: there are no such axes.
    """
    part, arrays = morphospace_part(result, first)
    cohort, groups = result.cohort, result.groups
    variables = [] if groups is None else [(result.variable, _classes(groups, groups.codes))]
    methods = methods_of(cohort, len(cohort), sizes=sample_sizes(cohort.names, variables))
    eigenvalues = _eigenvalue_table(result)
    scree = scree_part(result.eigenvalues, axis=_AXES[result.method])
    parts = [part, *_validation_parts(result), scree, *tangent_parts(cohort), eigenvalues]
    report = AnalysisReport(
        question="morphospace",
        title=_TITLES[result.method],
        summary=tuple(_summary(result)),
        parts=(*parts, *methods_parts(methods)),
        tables=_tables(result, eigenvalues),
        arrays={FILE: arrays},
        notes=(*cohort.notes, *result.notes),
        settings={
            "method": result.method, "group": result.variable or None, "components": result.components,
            "phylogeny": result.edges is not None, "gauge": cohort.gauge, "shapes": len(cohort),
        },
        model_hashes=model_hashes(cohort),
        methods=methods,
        citations=(*_CITATIONS[result.method], *(("Sidlauskas (2008) Evolution 62:3135–3156.",)
                                                 if result.method == "pca" and result.edges is not None else ())),
    )  # fmt: skip
    return add_shape_data(report, cohort)


def compared_morphospace(cohort: Cohort, column: str | None) -> tuple[MorphospacePart, dict[str, npt.NDArray[Any]]]:
    """Return the plot of the principal components of a comparison by the classes of a column, and its arrays."""
    return morphospace_part(ordinate(cohort, group=(column,) if column else ()))


def morphospace_part(
    result: Ordination, first: tuple[int, int] = (1, 2)
) -> tuple[MorphospacePart, dict[str, npt.NDArray[Any]]]:
    """Return the plot of an ordination, and the arrays of its file, `FILE`; arguments as of `morphospace_report`.

    An ordination with one axis is drawn against the first principal component of the residuals.
    """
    cohort, names = result.cohort, list(result.names)
    scores, shape_axes, shares = result.scores, result.shape_axes, list(result.explained_variance_ratio)
    validated = result.cross_validated
    if len(shape_axes) == 1:
        residual = cohort.coefficients - result.centre - scores @ shape_axes
        name, axis, across, share = _first_residual(residual)
        scores, shape_axes = np.column_stack([scores, across]), np.vstack([shape_axes, axis])
        validated = None if validated is None else np.column_stack([validated, across])
        names, shares = [*names, name], [*shares, share]
    shown = min(max(_SHOWN_AXES, *first), len(shape_axes))
    if first[0] == first[1] or not all(1 <= axis <= shown for axis in first):
        raise InputError(
            f"This ordination has {len(shape_axes)} axes, so axes {first[0]},{first[1]} cannot be drawn; name two "
            f"different ones from 1 to {len(shape_axes)}."
        )
    arrays: dict[str, npt.NDArray[Any]] = {
        "scores": scores[:, :shown],
        "mean": cohort.vertices(result.centre),
        "shape_axes": (shape_axes[:shown] @ cohort.basis).reshape(shown, -1, 3),
        "faces": np.zeros((0, 3), dtype=np.int32) if cohort.faces is None else cohort.faces,
    }
    if result.groups is not None:
        arrays["groups"] = result.groups.codes.astype(np.int32)
    if validated is not None:
        arrays["cross_validated"] = validated[:, :shown]
    if result.ancestors is not None and result.edges is not None:
        arrays |= {"nodes": result.ancestors[:, :shown], "edges": result.edges}
    part = MorphospacePart(
        title=_TITLES[result.method], level=2, note=_note(result), arrays=FILE, names=cohort.names,
        axes=tuple(names[:shown]), shares=tuple(float(share) for share in shares[:shown]),
        first=(first[0] - 1, first[1] - 1), variable=result.variable,
        groups=() if result.groups is None else result.groups.names, unit="" if result.method == "cva" else cohort.unit,
    )  # fmt: skip
    return part, arrays


def _first_residual(residual: FloatArray) -> tuple[str, FloatArray, FloatArray, float]:
    """Return name, axis (K,), scores (N,) and share of variance of the first principal component of residuals."""
    _, axes, variances = principal_components(residual)
    return "residual PC1", axes[0], residual @ axes[0], float(variances[0] / variances.sum())


def _note(result: Ordination) -> str:
    note = f"Share of the {_DIVIDED.get(result.method, 'variance')} on the axes."
    if result.groups is not None:
        note += " Convex hulls and 95 % ellipses of the groups."
    if result.edges is not None:
        note += " Lines: phylogeny, with ancestral shapes estimated under Brownian motion."
    return note


def _summary(result: Ordination) -> Iterator[str]:
    shares = [f"{name} {100 * share:.1f} %"
              for name, share in zip(result.names, result.explained_variance_ratio, strict=True)]  # fmt: skip
    yield f"Shares of the {_DIVIDED.get(result.method, 'variance')}: {', '.join(shares[:_MOST_SENTENCES])}."
    if result.groups is None:
        yield f"{len(result.cohort)} shapes."
        return
    plotted, n, groups = result.group_share(result.scores), len(result.cohort), result.groups
    if result.cross_validated is None or result.predicted is None:
        yield f"The groups of {result.variable} explain {100 * plotted:.1f} % of the variance of the {n} shapes."
        return
    validated = result.group_share(result.cross_validated)
    yield (
        f"The groups of {result.variable} explain {100 * plotted:.1f} % of the variance of the scores, and "
        f"{100 * validated:.1f} % of the leave-one-out scores; axes that are chosen to separate groups overstate their "
        "separation by the difference."
    )
    right = result.predicted == groups.codes
    largest = float(groups.counts.max() / n)
    yield (
        f"{int(right.sum())} of {n} shapes ({100 * right.mean():.1f} %) are classified correctly by leave-one-out "
        f"cross-validation; the largest group has {100 * largest:.1f} %."
    )


def _validation_parts(result: Ordination) -> Iterator[Part]:
    if result.groups is None or result.predicted is None:
        return
    n_groups = len(result.groups.names)
    counts = np.zeros((n_groups, n_groups))
    np.add.at(counts, (result.groups.codes, result.predicted), 1)
    yield ConfusionPart(
        title="Leave-one-out classification",
        classes=result.groups.names,
        counts=tuple(tuple(float(count) for count in row) for row in counts),
    )


def _eigenvalue_table(result: Ordination) -> TablePart:
    shares = result.explained_variance_ratio
    values = np.stack([result.eigenvalues, shares, shares.cumsum()], axis=1)
    return TablePart(
        title="Eigenvalues",
        columns=(TableColumn(name="axis"), TableColumn(name="eigenvalue", kind="number"),
                 TableColumn(name="share", kind="percent"), TableColumn(name="cumulative", kind="percent")),
        rows=tuple((name, *map(float, row)) for name, row in zip(result.names, values, strict=True)),
    )  # fmt: skip


def _classes(groups: Groups, codes: npt.NDArray[Any]) -> list[str]:
    return [groups.names[int(code)] for code in codes]


def _tables(result: Ordination, eigenvalues: TablePart) -> Mapping[str, Rows]:
    cohort, groups, names = result.cohort, result.groups, result.names
    columns: dict[str, Any] = {"name": cohort.names}
    if groups is not None:
        columns[result.variable] = _classes(groups, groups.codes)
    columns |= {name: result.scores[:, k] for k, name in enumerate(names)}
    if result.cross_validated is not None and result.predicted is not None and groups is not None:
        columns |= {f"{name}_leave_one_out": result.cross_validated[:, k] for k, name in enumerate(names)}
        columns["predicted"] = _classes(groups, result.predicted)
    shown = min(_SHOWN_AXES, len(names))
    loadings = [("change", result.shape_axes)] + ([("weight", result.axes)] if result.method == "cva" else [])
    points = (
        cohort.landmarks.names if cohort.source.kind == "landmarks" and cohort.landmarks else range(cohort.n_vertices)
    )
    values = np.hstack([(axes[:shown] @ cohort.basis).T for _, axes in loadings])
    rows = [(point, "xyz"[d], *values[3 * v + d]) for v, point in enumerate(points) for d in range(cohort.dimensions)]
    header = ("point", "coordinate", *(f"{name}_{kind}" if len(loadings) > 1 else name
                                       for kind, _ in loadings for name in names[:shown]))  # fmt: skip
    return {
        "scores.csv": (tuple(columns), list(zip(*columns.values(), strict=True))),
        "loadings.csv": (header, rows),
        "eigenvalues.csv": (tuple(column.name for column in eigenvalues.columns), eigenvalues.rows),
    }
