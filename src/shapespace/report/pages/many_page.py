"""The report of a folder of very many fits: all of them in numbers, those to look at with their pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from shapespace.report import figures
from shapespace.report.blocks import fit_tables as tables
from shapespace.report.blocks import sections
from shapespace.report.blocks.blocks import (
    Block,
    Cell,
    Column,
    Facts,
    Folded,
    Item,
    Notice,
    Table,
    Text,
    Tiles,
    number,
    status,
)
from shapespace.report.blocks.wording import (
    DASH,
    STATUS_WORDS,
    counted,
    isfinite,
    listed,
    mm,
    percent,
    printable,
    without_folders,
)
from shapespace.report.inputs.fit_population import FEWEST, MEASURES, Group, ListedColumn, Population
from shapespace.report.inputs.saved_fits import Folder, SavedFit, saved_fit
from shapespace.report.pages import recognition_page as recognition
from shapespace.report.pages.folder_page import FolderPage
from shapespace.report.pages.page import Chapter, Step
from shapespace.store.results import Results
from shapespace.types import FloatArray
from shapespace.version import __version__

WORST = {"failed": 12, "doubtful": 60, "max_iterations": 20, "converged": 60}
"""How many fits of each status are looked at, the worst first."""

MOST_SINGLE, MOST_STORED = 10_000, 2_000
"""Fits of which a folder of single files, and a store, are reported with one row for each."""

# Items on a page, and points in a picture: what can be looked through without paging.
_FARTHEST, _MOST_REASONS, _MOST_NOTED, _MOST_LINES, _IN_PICTURE = 20, 20, 24, 6, 400
_MOST_COLUMNS = 12  # columns of metadata; each has a figure


def is_many(results: Results) -> bool:
    """Return whether a folder has too many fits to report each one."""
    return len(results) > (MOST_SINGLE if results.store is None else MOST_STORED)


class ManyPage(FolderPage):
    """The report of very many fits in the making; the page of a folder, whose fits are those to look at.

    Args:
        folder: that the fits lie in.
        results: of it.
        model: the model's file, or None to go by the records.
        labels: a table of labels, or None to look for one.
        on_step: called after each picture.

    Raises:
        InputError: none of the fits can be read.
    """

    def __init__(
        self,
        folder: Folder,
        results: Results,
        *,
        model: Path | None = None,
        labels: Path | None = None,
        on_step: Step | None = None,
    ) -> None:
        self.population = Population(results)
        self.problems = results.problems
        self._far = self.population.far()
        farthest = np.argsort(np.where(np.isfinite(self._far), -self._far, np.inf), kind="stable")[:_FARTHEST]
        self.farthest = [int(k) for k in farthest if isfinite(self._far[k])]
        names = [name for kind, most in WORST.items() for name in self.population.worst(kind, most)]
        names += [self.population.names[k] for k in self.farthest]
        fits = [saved_fit(folder, results, name) for name in sorted(set(names))]
        super().__init__(folder, fits, model=model, labels=labels, on_step=on_step)

    def html(self) -> str:
        """Return the page."""
        name = self.folder.root.resolve().name
        chapters = [
            Chapter("Summary", self.summary),
            Chapter("Fits to look at", self.fits_part, "Fits"),
            Chapter("Distributions", self.distributions),
            Chapter("Time and site", self.drift),
            *recognition.analysis_chapters(self.page, self.folder.root, self.analyses),
            Chapter("The model", self.model_part, "Model"),
            Chapter("Settings and versions", self.settings, "Settings"),
        ]
        lead = "What a statistical shape model made of raw surfaces. Lengths are in millimetres of the scan."
        made = f"Made by shapespace {__version__} from the files in {name}."
        return self.page.html(f"{counted(len(self.population), 'fit')} in {name}", [Text(lead)], made, chapters)

    def summary(self) -> list[Block]:
        """Return how many fits have which status and why, what stands out, and what could not be read."""
        counts = self.population.counts
        tiles = [
            (f"{counts['converged']:,}", f"of {len(self.population):,}", "with nothing found against them"),
            (f"{counts['doubtful'] + counts['max_iterations']:,}", "", "to be looked at before use"),
            (f"{counts['failed'] + counts['unreadable']:,}", "", "without a result"),
        ]
        for measure, words in tuple(MEASURES.items())[:3]:
            if isfinite(value := self.population.median(measure)):
                tiles.append((mm(value).removesuffix(" mm"), "mm", f"{words.removesuffix(' (mm)')}, median of those"))
        return [
            Tiles(tiles),
            *self.other_models(),
            Notice(
                "Cannot be read",
                [without_folders(printable(text)) for text in self.problems[:_MOST_NOTED]],
                "broken",
            ),
            *([] if len(self.population.models) < 2 else [Text(self._of_models())]),
            *self.page.tried(self.stands_out),
            *self.page.tried(self.reasons),
        ]

    def _of_models(self) -> str:
        most = self.population.models.most_common(1)[0][1]
        return (
            f"The fits are by {len(self.population.models)} models; coefficients are compared of the {most:,} fits by "
            "the one with most."
        )

    def stands_out(self) -> Notice:
        """Return which times and sites differ from the rest by more than chance."""
        items: list[str | Item] = []
        for column in self.population.listed:
            for group in self.population.compared(column):
                if group.stands_out:
                    text = "; ".join(group.stands_out)
                    items.append(Item(f"{text[:1].upper()}{text[1:]}.", Cell(f"{column.name} {printable(group.name)}")))
        if len(items) > _MOST_NOTED:
            items = [*items[:_MOST_NOTED], f"{len(items) - _MOST_NOTED} more, in the tables of Time and site."]
        return Notice("Differ from all the others", items)

    def reasons(self) -> list[Block]:
        """Return why fits are not trusted, and how often."""
        most = self.population.n_reasons.most_common(_MOST_REASONS)
        if not most:
            return []
        rows = [[status(kind), Cell(printable(reason)), number(count, 0)] for (kind, reason), count in most]
        heads = [Column("Status"), Column("Reason, without its names and numbers"), Column("Fits", "number")]
        out: list[Block] = [Table(heads, rows, "Why fits are not trusted, the most frequent reasons first")]
        rest = sum(self.population.n_reasons.values()) - sum(count for _, count in most)
        return [*out, Text(f"{counted(rest, 'other')} with rarer reasons.", "soft")] if rest else out

    # Distributions

    def distributions(self) -> list[Block]:
        """Return histograms of distances and coefficients, and the fits that lie farthest from the mean."""
        page = self.page
        return [
            sections.in_columns(
                *page.tried(self._histograms), *page.tried(self._coefficients), *page.tried(self._density)
            ),
            page.section("Farthest from the mean", self.outliers),
            Folded("The fits to look at in space, to be turned", self.page.tried(self.together)),
        ]

    def _histograms(self) -> Block:
        every = counted(len(self.population), "fit")
        measures = {words: self.population.measures[key] for key, words in MEASURES.items()}
        return self.page.figure(
            figures.distributions_figure(measures, self.population.trusted, title=f"How near {every} come"),
            "Distances over what the scan shows, and the error that a fit expects of itself. The last bar holds all "
            "that lies beyond.",
            alt=f"Histograms of {listed(list(measures))} of {every}",
            chart=True,
        )

    def _trusted_z(self) -> npt.NDArray[np.float32]:
        return self.population.z[self.population.trusted]

    def _coefficients(self) -> Block:
        return self.page.figure(
            figures.coefficients_spread(self._trusted_z(), title="How widely each coefficient spreads"),
            "Percentiles of each coefficient over the trusted fits, in standard deviations of the model. Where the "
            "scans vary as the training shapes did, the band of 5 to 95 % ends at the dashed lines.",
            alt="Bands of the percentiles of each coefficient",
            chart=True,
        )

    def _density(self) -> Block:
        trusted = self.population.trusted
        return self.page.figure(
            figures.density_figure(self._trusted_z(), self._far[trusted], title="Where in the shape space"),
            "How many trusted fits lie where, darker for more, by the logarithm; the farthest are left out. Dashed: "
            "three standard deviations. Right: how far each fit is from the mean in all coefficients.",
            alt="Density of z1 against z2 and z3, and a histogram of the root mean square of all coefficients",
            chart=True,
        )

    def outliers(self) -> list[Block]:
        """Return a table of the fits whose coefficients are the largest."""
        rows: list[list[Cell]] = []
        listed_in = [column for column in self.population.listed if column.kind == "level"][:2]
        for k in self.farthest:
            z = self.population.z[k]
            most = int(np.nanargmax(np.abs(z)))
            levels: list[Cell] = [
                Cell(printable(column.levels[int(column.codes[k])])) if column.codes[k] >= 0 else Cell(DASH)
                for column in listed_in
            ]
            name = self.population.names[k]
            rows.append([
                Cell(printable(name), anchor=self.place_of(name)),
                status(sections.ORDER_OF_CONCERN[int(self.population.status[k])]),
                number(float(self._far[k]), 2),
                Cell(f"z{most + 1} = {float(z[most]):+.1f}".replace("-", "−"), float(np.abs(z[most]))),
                number(float(self.population.measures["expected_error_mm"][k]), 2),
                *levels,
            ])  # fmt: skip
        if not rows:
            return [Text("No fit has coefficients.", "soft")]
        heads = [
            Column("Scan"), Column("Status"), Column("RMS of z", "number"), Column("Largest", "number"),
            Column("Expected vertex error", "number"), *(Column(column.name) for column in listed_in),
        ]  # fmt: skip
        caption = "The fits whose coefficients are largest: rare shapes, or fits that went astray"
        return [Table(heads, rows, caption, sortable=True)]

    # Time and site

    def drift(self) -> list[Block]:
        """Return how errors and coefficients go with what the scans were listed with."""
        columns = self.population.listed[:_MOST_COLUMNS]
        if not columns:
            return [
                Text(
                    "The scans were listed without columns such as a date or a site; give them in the list of scans to "
                    "see how the fits go with them.",
                    "soft",
                )
            ]
        parts: list[Block] = [
            self.page.section(column.name, lambda column=column: self.by(column)) for column in columns
        ]
        left = [*self.population.left_out, *(column.name for column in self.population.listed[_MOST_COLUMNS:])]
        if left:
            parts.append(Text(f"Not shown: {listed(left)}.", "soft"))
        return parts

    def by(self, column: ListedColumn) -> list[Block]:
        """Return how the fits go with one column."""
        people, trusted = self.population, self.population.trusted
        # Errors are of trusted fits; the number of the others is given beside them.
        measures = {words: np.where(trusted, people.measures[key], np.nan) for key, words in MEASURES.items()}
        error = next(iter(MEASURES.values()))
        if column.kind == "level":
            groups = [(name, inside) for name, inside, _ in column.groups()]
            drawing = figures.levels_figure(groups, measures[error], words=error, title=f"By {column.name}")
            caption = "Of each: the median of the trusted fits, the middle half and the middle 90 %. Dashed: of all."
        else:
            levels = next((other for other in people.listed if 1 < len(other.levels) <= _MOST_LINES), None)
            lines = [] if levels is None else [(name, inside) for name, inside, _ in levels.groups()]
            drawing = figures.over_time_figure(
                column.values, column.edges(), dict(list(measures.items())[:2]), ~trusted,
                is_time=column.kind == "time", name=column.name, title=f"Along {column.name}", lines=lines,
            )  # fmt: skip
            caption = (
                f"Medians of the trusted fits, of at least {FEWEST} each, and the share of all that is not trusted."
            )
            caption += f" Thin lines: by {levels.name}." if levels is not None and lines else ""
        picture = self.page.figure(drawing, caption, alt=f"Errors by {column.name}", chart=True)
        table = self._compared(column)
        return [picture, table if column.kind == "level" else Folded(f"By {column.name}, in numbers", [table])]

    def _compared(self, column: ListedColumn) -> Table:
        def row(group: Group) -> list[Cell]:
            shift = f"z{group.mode} {group.shift:+.2f}".replace("-", "−") if group.mode else DASH
            return [
                Cell(printable(group.name)),
                number(group.count, 0),
                number(100 * group.untrusted, 1),
                number(group.error_mm, 2),
                number(group.error_off_mm, 2),
                Cell(shift, abs(group.shift)),
                Cell("yes" if group.stands_out else ""),
            ]

        heads = [
            Column(column.name), Column("Fits", "number"), Column("Not trusted, %", "number"),
            Column("Expected error, median", "number"), Column("Beside all", "number"),
            Column("Coefficient that differs most", "number"), Column("Stands out"),
        ]  # fmt: skip
        rows = [row(group) for group in self.population.compared(column)]
        caption = f"Fits by {column.name}; errors of the trusted ones in mm, coefficients in standard deviations"
        return Table(heads, rows, caption, sortable=len(rows) > 1)

    # Fits to look at

    def numbers(self) -> list[Block]:
        """Return the table of the fits that are looked at."""
        wanted = listed([f"{most} {STATUS_WORDS[kind]}" for kind, most in WORST.items()])
        text = (
            f"Of {counted(len(self.population), 'fit')} these {len(self.fits)}: the worst of each status ({wanted}), "
            f"and the {_FARTHEST} farthest from the mean. shapespace export gives the table of all, and fits as files."
        )
        table = tables.fits_table(self.fits, self.places, caption="Fits to look at: distances and errors in mm")
        return [Text(text), table, *([Text(self.label_note, "soft")] if self.label_note else [])]

    def together(self) -> list[Block]:
        """Return the first coefficients of the fits that are looked at, to be turned."""
        compared = self.of_one_model(self.model_hash())
        return list(
            self.page.tried(lambda: sections.scatter_to_turn(self.page, [*map(sections.coefficients_of, compared)]))
        )

    def others(self, fit: SavedFit) -> FloatArray | None:
        """Return coefficients of other fits, evenly from all."""
        z = self._trusted_z()
        z = z[np.isfinite(z).all(axis=1)]
        few = z[:: max(1, len(z) // _IN_PICTURE)].astype(np.float64)
        return few if z.shape[1] == len(fit.record.z) and len(z) > 2 else None

    def settings(self) -> list[Block]:
        """Return methods, versions and models, and of how many fits they are."""
        rows = [("Report", f"shapespace {__version__}")]
        words = {"method": "Methods", "version": "Versions of shapespace", "model_name": "Models"}
        for key, heading in words.items():
            counts = self.population.origins[key].most_common(_MOST_NOTED)
            rows.append((heading, listed([f"{printable(value)} ({count:,})" for value, count in counts]) or DASH))
        hashes = [f"{value} ({count:,})" for value, count in self.population.models.most_common(_MOST_NOTED)]
        rows.append(("Hashes of the models", listed(hashes) or DASH))
        rows.append(("Not trusted", percent(1 - float(self.population.trusted.mean()))))
        known: Sequence[tuple[str, str]] = rows
        return [Facts(known, "Settings and versions")]
