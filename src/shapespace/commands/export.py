"""Command `export`: fits of a store as single files or as one table, and cohorts as files of other programs."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from shapespace.batch.progress import progress
from shapespace.cohort.cohort import Cohort
from shapespace.cohort.table import numbers_as_text
from shapespace.commands.outcome import Outcome, exit_code_of
from shapespace.errors import InputError, ShapespaceError
from shapespace.io.files import atomic_path, make_folder, write_bytes, write_error, write_text
from shapespace.io.landmarks.configuration_io import CONFIGURATION_FORMATS, write_configurations
from shapespace.io.landmarks.landmark_configurations import LandmarkConfigurations
from shapespace.io.landmarks.landmark_io import fiducial_texts
from shapespace.io.meshes.mesh_io import write_mesh
from shapespace.io.tables.table_io import CHECKSUM, write_checked, write_rows
from shapespace.schemas import to_json
from shapespace.statistics.compare_shapes import complete_cohort
from shapespace.store.results import ENDING, ENDINGS, Results, modes_of
from shapespace.store.rows import META, coefficient_columns, kind_of

_MAT_HEADER, _MAT_HEADER_BYTES = b"MATLAB 5.0 MAT-file, written by shapespace", 116
_LONGEST_IN_MATLAB = 63  # characters; MATLAB's namelengthmax
Target: TypeAlias = Literal["geomorph", "morphoj", "tps", "csv"]
"""Programs and formats that cohorts are exported to."""
COORDINATES, COVARIATES, R_SCRIPT = "coordinates.csv", "covariates.csv", "shapespace.R"
"""Files of an export to geomorph; the script writes anova.csv."""


def export(
    folder: Path,
    names: Sequence[str],
    output: Path,
    *,
    every: bool,
    table: Path | None,
    quiet: bool,
    say: Callable[[str], None],
) -> Outcome:
    """Write fits of a folder as the single files that `fit` writes.

    Records and landmarks are the same to the byte, surfaces to a 16-millionth of their half extent (float32).

    Args:
        folder: folder that `shapespace fit` wrote, with or without a store.
        names: names of the fits.
        output: folder to write them to.
        every: export all fits.
        table: write the coefficients of all fits to this file: FILE.csv, or FILE.mat for MATLAB.
        quiet: no progress.
        say: called with a message on each fit that cannot be read; the others are written.

    Raises:
        FileError: something cannot be written.
        FileFormatError: the manifest is damaged.
        InputError: a name that does not exist, nothing to export, or `output` is the folder itself.
    """
    results = Results(folder)
    if not (names or every or table):
        raise InputError("Give the names of the fits to export, or --all, or --table FILE.csv.")
    wanted = results.names() if every else list(dict.fromkeys(names))
    for name in wanted:
        results.known(name)
    if wanted and output.resolve() == folder.resolve():
        raise InputError(f"{output} is the folder of the results itself; give another folder.")
    failed: list[str] = []
    if wanted:
        make_folder(output)
    with progress(len(wanted), "exporting", "fit", quiet=quiet) as bar:
        for name in wanted:
            try:
                _write_fit(results, name, output)
            except ShapespaceError as error:
                failed.append(name)
                say(str(error))
            bar.update()
    if table is not None:
        (write_mat if table.suffix.lower() == ".mat" else write_table)(results, table)
    for problem in results.problems:
        say(problem)
    written, table_name = len(wanted) - len(failed), None if table is None else str(table)
    facts = {"folder": str(output), "written": written, "failed": failed, "table": table_name}
    lines = [f"{written} {'fit' if written == 1 else 'fits'} in {output}"] if written else []
    lines += [] if table is None else [f"The table is {table}"]
    return Outcome(facts, lines, exit_code=exit_code_of(len(failed), len(wanted)))


def _write_fit(results: Results, name: str, output: Path) -> None:
    # The record comes last, as in a fit, so that results with a record are complete.
    for kind, ending in ENDINGS.items():
        path = output / f"{name}{ending}"
        if kind == "stages" and results.has(name, kind):
            write_bytes(path, results.stages(name))
        elif results.has(name, kind):
            write_mesh(path, results.surface(name, kind))
    # No table of a store has the landmarks in columns; the record has them, and their files are made of it again.
    if landmarks := results.fit(name).found_landmarks:
        for ending, text in fiducial_texts(to_json(landmarks)).items():
            write_text(output / f"{name}{ending}", text)
    write_bytes(output / f"{name}{ENDING}", results.record_bytes(name))


def write_table(results: Results, path: Path) -> None:
    """Write the coefficients of all fits as CSV, with the columns of coefficients.csv, some rows at a time.

    Raises:
        FileError: it cannot be written.
    """
    known = [column for column in results.column_names() if column.startswith(META)]
    columns = coefficient_columns(modes_of(results), known)
    make_folder(path.absolute().parent)
    with atomic_path(path) as temporary:
        try:
            with temporary.open("w", encoding="utf-8", newline="") as stream:
                cells = ([row.get(c) for c in columns] for row in _rows(results, columns))
                write_checked(stream, columns, cells)
        except OSError as error:
            raise write_error(path, error) from error


def write_mat(results: Results, path: Path) -> None:
    """Write the coefficients of all fits for MATLAB and Octave, as the struct `fits` of a MAT-file of level 5.

    `b`, `z` and `b_stddev` are (N, K); other columns of coefficients.csv are (N, 1), texts as cells. Unknown numbers
    are NaN, and characters that MATLAB does not allow in names are underscores.

    Raises:
        FileError: it cannot be written.
    """
    from scipy.io import savemat

    known = [column for column in results.column_names() if column.startswith(META)]
    modes = modes_of(results)
    columns = [column for column in coefficient_columns(modes, known) if column != CHECKSUM]
    rows = list(_rows(results, columns))
    fits: dict[str, npt.NDArray[Any]] = {
        name: _numbers(rows, [form.format(k) for k in range(1, modes + 1)])
        for name, form in (("b", "b{}"), ("z", "z{}"), ("b_stddev", "b{}_stddev"))
    }
    of_modes = {form.format(k) for form in ("b{}", "z{}", "b{}_stddev") for k in range(1, modes + 1)}
    for column in (column for column in columns if column not in of_modes):
        text = kind_of(column) == "text"
        fits[_name_in_matlab(column, fits)] = _texts(rows, column) if text else _numbers(rows, [column])
    stream = io.BytesIO()
    cast(Any, savemat)(stream, {"fits": fits}, long_field_names=True, do_compression=True)
    # Without the time of writing, so that the same fits are the same file.
    content = _MAT_HEADER.ljust(_MAT_HEADER_BYTES) + stream.getvalue()[_MAT_HEADER_BYTES:]
    make_folder(path.absolute().parent)
    write_bytes(path, content)


def _numbers(rows: Sequence[Mapping[str, Any]], columns: Sequence[str]) -> npt.NDArray[np.float64]:
    return np.array([[row.get(column) for column in columns] for row in rows], dtype=np.float64)


def _texts(rows: Sequence[Mapping[str, Any]], column: str) -> npt.NDArray[Any]:
    cells = np.empty((len(rows), 1), dtype=object)
    cells[:, 0] = [str(row.get(column) or "") for row in rows]
    return cells


def _name_in_matlab(column: str, taken: Container[str]) -> str:
    name = re.sub(r"[^A-Za-z0-9_]", "_", column)[:_LONGEST_IN_MATLAB]
    number = 2
    while name in taken:
        name = f"{name[: _LONGEST_IN_MATLAB - 4]}_{number}"
        number += 1
    return name


def _rows(results: Results, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    asked = [column for column in columns if column != CHECKSUM]
    for rows in results.iter_rows(asked):
        for values in zip(*rows.values(), strict=True):
            yield dict(zip(asked, values, strict=True))


def export_cohort(cohort: Cohort, output: Path, to: Target, formula: str | None = None) -> Outcome:
    """Write the aligned coordinates of a cohort, its table and sizes.

    `geomorph` is a folder with coordinates, covariates, and a script in R of the linear model `formula`.

    Args:
        cohort: cohort with coordinates as they are compared: aligned, and in the tangent space in the gauge shape.
        output: the file; a folder for geomorph, or to write landmarks.ENDING into.
        to: geomorph (a folder with a script in R), morphoj, tps or csv (default: fits as files)
        formula: linear model of shape for geomorph, such as '~ sex + age' (default: the mean alone)

    Raises:
        InputError: a formula that cannot be read, or missing values in its columns.
        FileError: something cannot be written.
    """
    given, notes = cohort, list[str]()
    if formula is not None:
        cohort = complete_cohort(cohort, (formula,), (), drop_missing=False)
        notes += cohort.cautions
    if cohort.estimated_share.any():
        notes.append("Missing landmarks or vertices are written at their estimated positions.")
    if cohort.parts:
        notes.append(
            "Parts are exported as they are compared: those that turn by large angles shrink, unlike surfaces."
        )
    known = cohort.landmarks.names if cohort.source.kind == "landmarks" and cohort.landmarks is not None else ()
    shapes = np.stack([cohort.vertices(k) for k in range(len(cohort))])[:, :, : cohort.dimensions]
    columns = {"size": numbers_as_text(cohort.sizes_mm), **cohort.table.columns}
    configurations = LandmarkConfigurations(names=cohort.names, points=shapes, landmarks=known, columns=columns)
    if to != "geomorph":
        ending = CONFIGURATION_FORMATS[to]
        if output.suffix.lower() != ending:
            output = make_folder(output) / f"landmarks{ending}"
        return _export_outcome(given, [output], [*notes, *write_configurations(output, configurations, to)])
    make_folder(output)
    write_configurations(output / COORDINATES, replace(configurations, columns={}), "csv")
    table = zip(cohort.names, *columns.values(), strict=True)
    write_rows(output / COVARIATES, ("name", *columns), table)
    model = "1" if formula is None else formula.strip().removeprefix("~").strip()
    write_text(output / R_SCRIPT, _R.replace("@FORMULA", model).replace("@K", str(cohort.dimensions)))
    if cohort.position_std is not None:
        notes.append("The script gives all vertices the same weight, as compare does with --set weights=none.")
    return _export_outcome(given, [output / name for name in (COORDINATES, COVARIATES, R_SCRIPT)], notes)


def _export_outcome(cohort: Cohort, files: Sequence[Path], notes: Sequence[str]) -> Outcome:
    facts = {"files": [str(file) for file in files], "shapes": len(cohort), "notes": notes}
    lines = [f"{len(cohort)} shapes in {', '.join(map(str, files))}"]
    return Outcome(facts, lines, [*cohort.notes, *notes])


_R = """\
# Linear model of the exported shapes: by procD.lm if geomorph is installed, and its sums of squares in R alone.
model <- coords ~ @FORMULA
ss_type <- "II"  # type of the sums of squares: "I", "II" or "III"
covariates <- read.csv("covariates.csv", check.names = FALSE, stringsAsFactors = TRUE, na.strings = "")
table <- read.csv("coordinates.csv", check.names = FALSE)
stopifnot(identical(as.character(table$name), as.character(covariates$name)))
coords <- as.matrix(data.frame(table[, -1], row.names = table$name))
# Coding and functions of formulas as in shapespace.
options(contrasts = c("contr.sum", "contr.poly"))
C <- function(x) factor(x)
center <- function(x) x - mean(x)
bs <- splines::bs

if (requireNamespace("geomorph", quietly = TRUE)) {
  data <- list(coords = geomorph::arrayspecs(coords, ncol(coords) / @K, @K))
  data <- do.call(geomorph::geomorph.data.frame, c(data, as.list(covariates)))
  fit <- geomorph::procD.lm(model, data = data, iter = 999, SS.type = ss_type, print.progress = FALSE)
  print(summary(fit))
}

# Differences of the residual sums of squares of nested models, in R alone.
right <- model[-2]
X <- model.matrix(right, covariates)
labels <- attr(terms(right), "term.labels")
factors <- attr(terms(right), "factors") > 0
residual <- function(terms) {
  fit <- qr(X[, attr(X, "assign") %in% c(0, terms), drop = FALSE])
  c(SS = sum(qr.resid(fit, coords)^2), Df = nrow(X) - fit$rank)
}
all <- seq_along(labels)
rows <- lapply(all, function(k) {
  without <- switch(ss_type,
    I = all[all < k],
    II = Filter(function(other) any(factors[, other] < factors[, k]), all),
    III = all[all != k])
  residual(without) - residual(c(without, k))
})
rows <- do.call(rbind, c(rows, list(residual(all), residual(0))))
anova <- data.frame(term = c(labels, "Residuals", "Total"), Df = rows[, "Df"], SS = rows[, "SS"])
last <- length(labels) + 1
anova$R2 <- anova$SS / anova$SS[last + 1]
anova$F <- ifelse(seq_len(nrow(anova)) < last, (anova$SS / anova$Df) / (anova$SS[last] / anova$Df[last]), NA)
print(anova, row.names = FALSE)
write.csv(anova, "anova.csv", row.names = FALSE)
"""
