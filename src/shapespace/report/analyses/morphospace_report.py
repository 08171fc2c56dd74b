"""Report of an ordination: the morphospace, its scree plot, and scores, loadings and eigenvalues as tables."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from shapespace.errors import InputError
from shapespace.report.analyses.analysis_report import (
    AnalysisReport,
    Column,
    LengthFormat,
    ResultTable,
    cohort_report,
    scree_part,
    tangent_parts,
)
from shapespace.schemas import ConfusionPart, MorphospacePart
from shapespace.statistics.compare_shapes import CompareResult
from shapespace.statistics.methods import methods_of, sample_sizes
from shapespace.statistics.shape_tests.ordination import Ordination, OrdinationMethod, ordinate

FILE = "morphospace.npz"
_SHOWN_AXES = 6  # axes that the plot can show; a report with more of them is large
_MOST_SENTENCES = 3  # axes with a share in the summary
_AXES: Mapping[OrdinationMethod, str] = {
    "pca": "principal component",
    "between-groups": "between-group principal component",
    "cva": "canonical variate",
    "phylogenetic-pca": "phylogenetic principal component",
    "paca": "phylogenetically aligned component",
}
_SHARES: Mapping[OrdinationMethod, str] = {
    "between-groups": "variance of the group means",
    "cva": "variance between groups relative to that within groups",
    "paca": "variance along the aligned components",
}
"""Reference of the shares of axes, if it is not the variance of the shapes."""
_CITATIONS: Mapping[OrdinationMethod, tuple[str, ...]] = {
    "pca": (),
    "between-groups": (
        "Cardini A., O'Higgins P., Rohlf F. J. (2019) Seeing distinct groups where "
        "there are none: spurious patterns from between-group PCA. Evolutionary Biology 46, 303-316.",
    ),
    "cva": (
        "Campbell N. A., Atchley W. R. (1981) The geometry of canonical variate analysis. Systematic Zoology 30, "
        "268-280.",
    ),
    "phylogenetic-pca": (
        "Revell L. J. (2009) Size-correction and principal components for interspecific comparative studies. "
        "Evolution 63, 3258-3268.",
    ),
    "paca": (
        "Collyer M. L., Adams D. C. (2021) Phylogenetically aligned component analysis. Methods in Ecology and "
        "Evolution 12, 359-372.",
    ),
}
_PHYLOMORPHOSPACE = (
    "Sidlauskas B. (2008) Continuous and arrested morphological diversification in sister clades of characiform "
    "fishes: a phylomorphospace approach. Evolution 62, 3135-3156."
)


def morphospace_report(result: Ordination, first: tuple[int, int] = (1, 2)) -> AnalysisReport:
    """Return the report of an ordination.

    Args:
        result: the ordination.
        first: numbers of the axes that are drawn across and up, from 1.

    Raises:
        InputError: there are no such axes.
    """
    part, arrays = morphospace_part(result, first)
    cohort = result.cohort
    variables = [(result.variable, _classes(result, result.groups.codes))] if result.groups is not None else []
    assumptions = [f"The axes are {_AXES[result.method]}s."]
    if result.edges is not None:
        assumptions.append("Ancestral shapes follow from Brownian motion along the branches of the phylogeny.")
    sizes = sample_sizes(cohort.names, variables)
    methods = methods_of(cohort, len(cohort), sizes=sizes, assumptions=tuple(assumptions))
    return cohort_report(
        "morphospace",
        f"Morphospace: {_AXES[result.method]}s",
        [part, *_confusion_parts(result), scree_part(result.eigenvalues, axis=_AXES[result.method]),
         *tangent_parts(cohort), _eigenvalue_table(result), *_file_tables(result)],
        cohort,
        summary=tuple(_summary(result)),
        arrays={FILE: arrays},
        notes=(*cohort.notes, *result.notes),
        settings={
            "method": result.method, "group": result.variable or None, "components": result.components,
            "phylogeny": result.edges is not None, "gauge": cohort.gauge, "shapes": len(cohort),
        },
        methods=methods,
        citations=(*_CITATIONS[result.method], *((_PHYLOMORPHOSPACE,) if result.edges is not None else ())),
    )  # fmt: skip


def compared_morphospace(result: CompareResult) -> tuple[MorphospacePart, dict[str, npt.NDArray[Any]]]:
    """Return the plot of the shapes of a comparison by its first variable with classes, and its arrays."""
    variables = [variable.name for variable in result.design.variables if variable.levels]
    columns = [
        name for variable in variables for name in result.cohort.table.columns if variable in (name, f"C({name})")
    ]
    return morphospace_part(ordinate(result.cohort, group=tuple(columns[:1])))


def morphospace_part(
    result: Ordination, first: tuple[int, int] = (1, 2)
) -> tuple[MorphospacePart, dict[str, npt.NDArray[Any]]]:
    """Return the plot of an ordination, and the arrays of its file, `FILE`; see `morphospace_report` for the arguments.

    An ordination with one axis is drawn against the first principal component of the residuals.
    """
    cohort, names, shares = result.cohort, list(result.names), list(result.explained_variance_ratio)
    scores, shape_axes, validated = result.scores, result.shape_axes, result.cross_validated
    if len(shape_axes) == 1:
        residual = cohort.coefficients - result.centre - scores @ shape_axes
        _, s, vt = np.linalg.svd(residual, full_matrices=False)
        axis = vt[0] * np.sign(max(residual @ vt[0], key=abs))
        across = residual @ axis
        scores, shape_axes = np.column_stack([scores, across]), np.vstack([shape_axes, axis])
        validated = None if validated is None else np.column_stack([validated, across])
        names, shares = [*names, "residual PC1"], [*shares, s[0] ** 2 / max((s**2).sum(), np.finfo(np.float64).tiny)]
    shown = min(max(_SHOWN_AXES, *first), len(shape_axes))
    if first[0] == first[1] or not all(1 <= axis <= shown for axis in first):
        raise InputError(
            f"Axes {first[0]},{first[1]} cannot be drawn, since this ordination has {len(shape_axes)}; name two "
            f"different axes from 1 to {len(shape_axes)}."
        )
    arrays: dict[str, npt.NDArray[Any]] = {
        "scores": scores[:, :shown],
        "mean": cohort.vertices(result.centre),
        "shape_axes": (shape_axes[:shown] @ cohort.basis).reshape(shown, -1, 3),
        "faces": np.zeros((0, 3), dtype=np.int32) if cohort.faces is None else cohort.faces,
    }
    note = f"Labels of axes give their share of the {_SHARES.get(result.method, 'variance')}."
    if result.method != "cva":
        lengths, point = LengthFormat(cohort.unit), "landmark" if cohort.faces is None else "vertex"
        norm, rms = lengths.text(1.0), lengths.text(1.0 / math.sqrt(cohort.n_vertices))
        note += f" A score of {norm} is a Procrustes norm over all {cohort.n_vertices:,} points: {rms} RMS per {point}."
    if result.groups is not None:
        arrays["groups"] = result.groups.codes
        note += " Convex hulls are those of the groups, and 95 % ellipses those of groups of five shapes or more."
    if validated is not None:
        arrays["cross_validated"] = validated[:, :shown]
    if result.ancestors is not None and result.edges is not None:
        arrays |= {"nodes": result.ancestors[:, :shown], "edges": result.edges}
        note += " Lines are the phylogeny, with ancestral shapes by Brownian motion."
    part = MorphospacePart(
        title="Morphospace", level=2, note=note, arrays=FILE, names=cohort.names,
        axes=tuple(names[:shown]), shares=tuple(map(float, shares[:shown])), first=(first[0] - 1, first[1] - 1),
        variable=result.variable, groups=() if result.groups is None else result.groups.names,
        unit="" if result.method == "cva" else cohort.unit,
    )  # fmt: skip
    return part, arrays


def _summary(result: Ordination) -> Iterator[str]:
    shares = zip(result.names, result.explained_variance_ratio, strict=True)
    listed = ", ".join([f"{name} {100 * share:.1f} %" for name, share in shares][:_MOST_SENTENCES])
    yield f"Shares of the {_SHARES.get(result.method, 'variance')}: {listed}."
    if result.groups is None:
        return
    n, explained = len(result.cohort), f"explain {100 * result.group_share(result.scores):.1f} %"
    if result.cross_validated is None or result.predicted is None:
        yield f"The groups of {result.variable} {explained} of the variance of the {n} shapes."
        return
    yield (
        f"The groups of {result.variable} {explained} of the variance of the scores, and "
        f"{100 * result.group_share(result.cross_validated):.1f} % of the leave-one-out scores; axes that are chosen "
        "to separate groups overstate their separation by the difference."
    )
    right = result.predicted == result.groups.codes
    yield (
        f"{int(right.sum())} of {n} shapes ({100 * right.mean():.1f} %) are classified correctly by leave-one-out "
        f"cross-validation; the largest group has {100 * result.groups.counts.max() / n:.1f} %."
    )


def _confusion_parts(result: Ordination) -> Iterator[ConfusionPart]:
    if result.groups is not None and result.predicted is not None:
        counts = np.zeros((len(result.groups.names),) * 2)
        np.add.at(counts, (result.groups.codes, result.predicted), 1)
        rows = tuple(tuple(map(float, row)) for row in counts)
        yield ConfusionPart(title="Leave-one-out classification", classes=result.groups.names, counts=rows)


def _eigenvalue_table(result: Ordination) -> ResultTable:
    shares = result.explained_variance_ratio
    values = [result.eigenvalues, shares, shares.cumsum()]
    kinds: dict[str, Any] = {"axis": "text", "eigenvalue": "number", "share": "percent", "cumulative": "percent"}
    if result.method != "cva":
        values.append(np.sqrt(result.eigenvalues / result.cohort.n_vertices))
        kinds[LengthFormat(result.cohort.unit).label("standard deviation, RMS per point")] = "number"
    columns = [Column(name, kind, name) for name, kind in kinds.items()]
    return ResultTable(
        title="Eigenvalues", columns=columns, rows=list(zip(result.names, *values, strict=True)), file="eigenvalues.csv"
    )


def _classes(result: Ordination, codes: npt.NDArray[Any]) -> list[str]:
    return [] if result.groups is None else [result.groups.names[int(code)] for code in codes]


def _file_tables(result: Ordination) -> tuple[ResultTable, ResultTable]:
    """Return the tables of scores and loadings, which are files alone."""
    cohort, names, shown = result.cohort, result.names, result.names[:_SHOWN_AXES]
    columns: dict[str, Any] = {"name": cohort.names, **dict(zip(names, result.scores.T, strict=True))}
    if result.groups is not None:
        columns[result.variable] = _classes(result, result.groups.codes)
    if result.cross_validated is not None and result.predicted is not None:
        columns |= {
            f"{name} leave-one-out": values for name, values in zip(names, result.cross_validated.T, strict=True)
        }
        columns["predicted"] = _classes(result, result.predicted)
    # The weights of canonical variates differ from the change of shape along them.
    loadings = {"": result.shape_axes} | ({" weight": result.axes} if result.method == "cva" else {})
    values = np.hstack([(axes[: len(shown)] @ cohort.basis).T for axes in loadings.values()])
    is_landmarks = cohort.source.kind == "landmarks" and cohort.landmarks is not None
    points = cohort.landmarks.names if is_landmarks and cohort.landmarks else range(cohort.n_vertices)
    rows = [(point, "xyz"[d], *values[3 * v + d]) for v, point in enumerate(points) for d in range(cohort.dimensions)]
    return (
        ResultTable.of_fields("scores.csv", tuple(columns), list(zip(*columns.values(), strict=True))),
        ResultTable.of_fields(
            "loadings.csv", ("point", "coordinate", *(f"{name}{kind}" for kind in loadings for name in shown)), rows
        ),
    )
