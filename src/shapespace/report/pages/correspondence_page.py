"""The report of a folder that `shapespace correspond` wrote."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from math import isfinite, nan
from typing import TypeAlias

import numpy as np

from shapespace.errors import FileFormatError, ShapespaceError
from shapespace.report import figures
from shapespace.report.blocks import sections
from shapespace.report.blocks.blocks import (
    Block,
    Card,
    Cell,
    Command,
    Facts,
    Folded,
    Gallery,
    Head,
    Image,
    Notice,
    StripKey,
    Table,
    Text,
    Tiles,
    first_items,
    no_picture,
    number,
    table_of,
    text_table,
)
from shapespace.report.blocks.wording import (
    DASH,
    counted,
    known,
    listed,
    median,
    percent,
    percent_of,
    plain,
    sentence,
    setting,
    words,
)
from shapespace.report.inputs.correspondence_folder import (
    Corresponded,
    concerns_of,
    distance_share,
    scan_status,
    upright,
)
from shapespace.report.inputs.saved_fits import Folder, nice_ceiling
from shapespace.report.inputs.subject_parts import Parts
from shapespace.report.pages.page import Chapter, Page
from shapespace.report.render import thumbnails
from shapespace.report.render.palette import DIVERGING, SEQUENTIAL
from shapespace.report.render.scene import bounded_scan
from shapespace.reprs import describe_groups, first_names
from shapespace.schemas import CORRESPOND_AGAIN, CorrespondRecord, Quality
from shapespace.types import Mesh
from shapespace.version import __version__

# Items on a page: what can be looked through without paging, and a page that stays within its bytes.
MOST_CARDS, MOST_EMPTY_CARDS, MOST_BOARDS, MOST_ROWS = 24, 6, 11, 2000
_MOST_NAMED = 12  # items of a list; the table has all
# share of the scans that observe a hardly seen vertex, and of vertices for a complete surface
_HARDLY_SEEN, _WHOLE_SHARE = 0.5, 0.9
_STATUS = {
    "unreadable": ("unreadable", "failed"),
    "excluded": ("excluded", "failed"),
    "doubtful": ("doubtful", "doubtful"),
    "look": ("needs review", "doubtful"),
    "converged": ("converged", "converged"),
}

_Make: TypeAlias = Callable[[CorrespondRecord], Cell]


class CorrespondencePage:
    """Builder of the report of a correspondence.

    Args:
        folder: folder that `shapespace correspond` wrote.
        page: page that it fills.

    Raises:
        FileError: correspondence.json or the mean shape cannot be read.
        FileFormatError: correspondence.json or the mean shape is damaged, or no scan's record can be read.
    """

    def __init__(self, folder: Folder, page: Page) -> None:
        self.result = Corresponded(folder.root)
        if not self.result.records:
            raise FileFormatError(f"{folder.root} contains no record of a scan; {CORRESPOND_AGAIN}.")
        self.page = page
        page.planned = len(self.result.corresponding) + min(len(self.result.records), MOST_CARDS) + 5
        self.all = self.result.population(self.page.step)
        self.mean = self.result.mean
        self.size = dict(zip(self.all.names, self.all.sizes, strict=True))
        self.records = [self.result.records[name] for name in self.all.names]
        self.concerns = concerns_of(self.result)
        self.ordered = sorted(self.records, key=lambda record: (-self.concerns[record.name].weight, record.name))
        self.out = [*self.result.set_aside, *(self.result.records[name] for name in self.all.unread)]
        self._cards = {record.name: self.page.anchor(f"scan-{record.name}") for record in self._select_cards()}

    # Facts of each

    def share(self, record: CorrespondRecord, which: str) -> float:
        """Return a distance of a record as a share of the object's size."""
        return distance_share(record, which, self.size.get(record.name, nan))

    def status(self, record: CorrespondRecord) -> Cell:
        """Return the status of a scan, sorted from bad to good."""
        kind = scan_status(record, self.concerns)
        return Cell(_STATUS[kind][0], float(list(_STATUS).index(kind)), _STATUS[kind][1])

    @property
    def looked_at(self) -> list[CorrespondRecord]:
        """Scans that need review."""
        return [record for record in self.ordered if self.concerns[record.name].reasons]

    # The page

    def html(self) -> str:
        """Return the page."""
        name = self.result.root.resolve().name
        chapters = [
            Chapter("Summary", self.summary),
            Chapter("The same places on every scan", self.same_places, "Same places"),
            Chapter("Distances and missing vertices", self.nearness, "Nearness"),
            Chapter("The scans", self.scans, "Scans"),
            Chapter("The rounds", self.rounds, "Rounds"),
            Chapter("Settings and hashes", self.settings, "Settings"),
        ]
        if (self.result.root / Quality.FILE).is_file():
            chapters.insert(
                4,
                Chapter(
                    "Quality of the shape space",
                    lambda: sections.quality_part(self.page, self.result.folder),
                    "Quality",
                ),
            )
        return self.page.html(
            f"Correspondence of {counted(self.total, 'scan')} in {name}",
            [
                Text(
                    "Raw scans in correspondence: the same vertex is meant to be the same place on all scans. "
                    "The size of an object is the RMS distance of its surface from its middle."
                )
            ],
            f"Made by shapespace {__version__} from the files in {name}.",
            chapters,
        )

    @property
    def total(self) -> int:
        """Number of scans, including unreadable scans."""
        return len(self.result.records) + len(self.result.unread)

    def summary(self) -> list[Block]:
        """Return the result of the correspondence in sentences and figures, and the scans that need review."""
        mean, far = (median([self.share(r, which) for r in self.records]) for which in ("mean", "p99"))
        tiles = [
            (str(len(self.records)), f"of {self.total}", "scans in correspondence"),
            (f"{self.result.run.vertices:,}", "", "vertices, the same on all"),
            (
                percent_of(mean).removesuffix(" %"),
                "%",
                "of its size: mean distance between scan and surface, median scan",
            ),
            (percent_of(far).removesuffix(" %"), "%", "of its size: 99 % of the points lie nearer, median scan"),
            (
                percent(median([known(record.seen_share) for record in self.records])).removesuffix(" %"),
                "%",
                "of the vertices are shown by the median scan",
            ),
        ]
        if self.result.run.rounds:
            tiles.append(
                (
                    percent_of(self.result.run.rounds[-1]).removesuffix(" %"),
                    "%",
                    "of the size: movement of vertices in the last round (RMS)",
                )
            )
        return [
            Text(self.verdict()),
            Tiles(tiles),
            Notice(
                "Excluded scans: they are not in a model built from this folder",
                self._items({record.name: sentence(record.reason) for record in self.result.set_aside}),
                "broken",
            ),
            Notice(
                "In correspondence; needs review",
                self._items({record.name: self.concerns[record.name].text for record in self.looked_at}),
            ),
            Notice(
                "Cannot be read",
                [Text(text, name=Cell(name)) for name, text in {**self.result.unread, **self.all.unread}.items()],
                "broken",
            ),
            Text("To look at single vertices on all scans, and to go on to a shape space:"),
            Command(f"shapespace view {self.result.root.name}\nshapespace build {self.result.root.name} -o model.h5"),
        ]

    def verdict(self) -> str:
        """Return a few sentences on the state of the correspondence and on the scans to review."""
        n, aside = len(self.records), len(self.out) + len(self.result.unread)
        some = self.looked_at
        excluded = f"; {aside} {'is' if aside == 1 else 'are'} excluded"
        review = f"; {counted(len(some), 'of them needs', 'of them need')} review"
        folded = [record.folded_share for record in self.records if record.folded_share]
        most_folded = (
            f"{counted(len(folded), 'scan has', 'scans have')} folded triangles, "
            f"{percent_of(max(folded, default=nan))} at most."
        )
        mirrored = [record.name for record in self.records if record.mirrored]
        reflected = (
            f"{counted(len(mirrored), 'scan is a mirror image', 'scans are mirror images')} of the others and shown "
            f"reflected ({first_names(mirrored, _MOST_NAMED)})."
        )
        sentences = [
            f"{n} of {counted(self.total, 'scan')} {'is' if n == 1 else 'are'} in correspondence"
            f"{review if some else ' and none of them needs review'}"
            f"{excluded if aside else ''}.",
            most_folded if folded else "No triangle is folded over.",
            reflected if mirrored else "",
            describe_groups(self.result.run.groups) if self.result.run.groups else "",
        ]
        return f"{' '.join(filter(None, sentences))} {self._settling()}"

    def _settling(self) -> str:
        moved = self.result.run.rounds
        if not moved:
            return ""
        if moved[-1] < self.result.settled:
            return f"The rounds have settled: in the last round vertices moved by {percent_of(moved[-1])} of the size."
        return (
            f"The rounds have not settled: in the last round vertices still moved by {percent_of(moved[-1])} of the "
            f"size, and {percent_of(self.result.settled)} counts as settled; more --rounds may still improve it."
        )

    def _items(self, texts: Mapping[str, str]) -> list[str | Text]:
        """Return a sentence for each of the first scans, by name, and the number of the others."""
        return first_items(
            [Text(text, name=Cell(name, anchor=self._cards.get(name))) for name, text in texts.items()],
            _MOST_NAMED,
            "in the table of all",
        )

    # The pictures

    def same_places(self) -> list[Block]:
        """Return a checkerboard on the mean shape, carried to the worst scans and to some of the others."""
        pictured = self._boards()
        if not pictured:
            return [Text("There is no surface to show.", "broken")]
        placed = {record.name: self.result.placed(record.name) for record in pictured}
        which = "All scans." if len(pictured) == len(self.records) else (
            f"{len(pictured)} of {counted(len(self.records), 'scan')}: those that need review most, then some of the "
            "others."
        )  # fmt: skip
        surfaces, labels = [placed[r.name].vertices for r in pictured], [record.name for record in pictured]
        pictures: list[Block] = []
        if (parts := Parts.of_counts(self.result.run.parts)) is not None:
            pictures.append(
                self.page.figure(
                    figures.parts_figure(self.mean, parts, title="The parts of the mean shape"),
                    f"The parts: {listed([f'{name}, {n:,} vertices' for name, n in self.result.run.parts.items()])}.",
                    alt="The parts of the mean shape in their colours, from three sides",
                )
            )
        for yaw, side in ((0.0, "from the front"), (figures.SIDE_DEG, "from one side")):
            drawn = figures.checkerboard_figure(
                self.mean, surfaces, labels, yaw_deg=yaw, title=f"The same squares on every scan, {side}"
            )
            # As wide as the page, since small squares cannot be compared.
            pictures.append(
                replace(
                    self.page.figure(
                        drawn,
                        f"{which} A checkerboard is laid onto the mean shape and carried to each scan by its vertices.",
                        alt=f"The same checkerboard {side} on the mean shape and on {listed(labels)}",
                    ),
                    kind="plain",
                )
            )
        return [
            Text(
                "Compare them place by place: an edge or a corner that you know, such as the corner of an eye or a "
                "knob of a bone, must lie in the same square on every scan, at the same place of the square. "
                "Where squares have slid along the surface, the correspondence is wrong, however near the surface lies "
                "to the scan. All have the pose and size of the mean shape; parts that a scan lacks are omitted."
            ),
            *pictures,
        ]

    def _boards(self) -> list[CorrespondRecord]:
        """Return the scans to draw with a checkerboard: those that need review first, then others at even steps."""
        first = self.looked_at[: MOST_BOARDS // 2 + 1] if len(self.records) > MOST_BOARDS else list(self.ordered)
        rest = [record for record in self.ordered if record not in first]
        room = MOST_BOARDS - len(first)
        return [*first, *(rest[k] for k in [len(rest) * k // room for k in range(min(room, len(rest)))])]

    def nearness(self) -> list[Block]:
        """Return the distances of all scans, and where vertices are missing."""
        if not self.records:
            return [Text("There is no scan in correspondence.", "broken")]
        shares = np.array([[self.share(r, w) for w in ("mean", "p95", "p99", "max")] for r in self.records])
        share = 1 - self.all.seen_count / len(self.records)
        hardly = float((share > 1 - _HARDLY_SEEN).mean())
        most = f"{percent(hardly)} on more than half, which build omits" if hardly else "none on more than half"
        missing = f"{percent(float((share > 0).mean()))} of the vertices are missing on at least one scan, and {most}."
        there = median([known(record.area_share) for record in self.records])
        lacking = (
            f"The mean shape lacks parts that the scans show: its surface is {percent(there)} of the median scan's, "
            "mostly because the first template lacked them. Pass a complete template with --template."
        )
        holes = (
            f"The mean shape has {counted(self.result.holes, 'hole')} in addition to its border. If the object has no "
            "opening there, the first template had a hole, and no scan can show anything there; pass a complete "
            "template with --template."
        )
        return [
            Text(
                "Distances are measured both ways: from the vertices that a scan shows to the scan, and from its "
                "points to the surface, excluding the points beyond the surface's rim."
            ),
            Text(lacking if there < _WHOLE_SHARE else "", "notice"),
            Text(holes if self.result.holes else "", "notice"),
            sections.in_columns(
                self.page.figure(
                    figures.nearness_figure(shares),
                    "How many scans have a mean distance, and 95 %, 99 % and all of their points, within each length.",
                    alt=f"Cumulative distances of {counted(len(self.records), 'scan')}",
                    chart=True,
                ),
                self.page.figure(
                    figures.missing_figure(self.mean, share),
                    f"{missing if share.any() else 'Every scan shows every vertex.'} The mean shape from four sides.",
                    alt="Share of scans that do not show each vertex, on the mean shape from four sides",
                ),
            ),
            *self._confidence(),
        ]

    def _confidence(self) -> list[Block]:
        """Return the uncertainty of vertex positions along the surface; nothing for surfaces of older versions."""
        std = self.all.position_std
        if std is None:
            return []
        caption = (
            f"The position of the median vertex has a standard deviation of {percent_of(float(np.median(std)))} of the "
            "size in any direction along the surface (RMS over the scans that show it); 90 % of the positions are "
            "within 2.15 times it. It is large where the surface is flat or of constant curvature, so that no feature "
            "determines the position. Single surfaces are in the viewer."
        )
        return [
            self.page.figure(
                figures.position_std_figure(self.mean, std, self.all.position_std_limit),
                caption,
                alt="Standard deviation of the position of each vertex along the surface, on the mean shape from four "
                "sides",
            )
        ]

    # The scans

    def scans(self) -> list[Block]:
        """Return the gallery of scans, the worst first, and the table of all scans."""
        return [
            self.page.section(
                (
                    "All scans, the worst first"
                    if (len(self._cards) == len(self.records) + len(self.out))
                    else f"The {len(self._cards)} scans to look at first"
                ),
                self.gallery,
            ),
            self.page.section("Every scan in numbers", self.numbers),
        ]

    def _select_cards(self) -> list[CorrespondRecord]:
        first = self.out[: max(MOST_EMPTY_CARDS, MOST_CARDS - len(self.records))]
        return [*first, *self.ordered[: MOST_CARDS - len(first)]]

    def gallery(self) -> list[Block]:
        """Return a card for each of the first scans."""
        limit = 100 * (median([self.share(record, "p99") for record in self.records]) or nan)
        limit = nice_ceiling(limit)
        key = StripKey(
            "Each strip, from the left: the scan; the checkerboard of the front view; how far each vertex lies from "
            "the scan (pale to dark); how much each triangle has shrunk (blue) or grown (red) relative to the mean "
            "shape, with the change of size divided out and folded triangles in black.",
            [
                (self.page.image(thumbnails.colour_bar(c), f"from {low} to {high}"), low, high)
                for c, low, high in [
                    (SEQUENTIAL, "0", f"{limit:g} % of its size, or more"),
                    (DIVERGING, "half the area", "twice the area"),
                ]
            ],
            "Where areas change, shapes may differ; where they change suddenly, squares have slid.",
        )
        carded = self._select_cards()
        return [
            Text("Sorted: excluded scans first, then by their need for review."),
            no_picture(len(self.records) + len(self.out) - len(carded), "scan"),
            key,
            Gallery([self.card(record, limit) for record in carded]),
        ]

    def card(self, record: CorrespondRecord, limit: float) -> Card:
        """Return one scan of the gallery, its distances on a scale that ends at `limit` percent of its size."""
        image, note = None, ""
        try:
            image, note = self._still(record, limit)
        except ShapespaceError as error:
            note = f"No picture: {error}"
        self.page.step(record.name)
        status = self.status(record)
        if record in self.out:
            return Card(
                anchor=self._cards[record.name],
                name=record.name,
                status=status,
                label="",
                text=self._reason(record),
                image=image,
                why_none=note,
            )
        text = f"Mean distance {percent_of(self.share(record, 'mean'))} of its size. {self.concerns[record.name].text}"
        text += f" {note}" if note else ""
        return Card(self._cards[record.name], record.name, status, "", text, image)

    def _still(self, record: CorrespondRecord, limit: float) -> tuple[Image, str]:
        """Return the picture of a scan, and a sentence on a missing scan."""
        if record in self.out:
            scan = self._bounded(record)
            if scan.faces is not None:
                scan = scan.with_vertices(scan.vertices @ upright(scan).T)
            return self.page.image(thumbnails.mesh_still(scan), f"The scan {record.name}, excluded"), ""
        placed = self.result.placed(record.name)
        scan, note = None, ""
        far = np.full(len(placed.vertices), nan)
        try:
            scan, far = self.result.scan_on_mean(self._bounded(record), placed)
        except FileFormatError as error:
            note = f"The picture lacks the scan: {error}"
        still = thumbnails.correspondence_strip(self.mean, placed.vertices, scan, 100 * far, limit)
        seen = "the scan, the checkerboard, distances and areas" if scan else "the checkerboard and areas"
        return self.page.image(still, f"{record.name}: {seen}"), note

    def _bounded(self, record: CorrespondRecord) -> Mesh:
        return bounded_scan(self.result.raw_scan(record))

    def numbers(self) -> list[Block]:
        """Return the table of all scans."""
        columns: list[tuple[Head, _Make]] = [
            (Head("Scan"), lambda r: Cell(r.name, anchor=self._cards.get(r.name))),
            (Head("Status"), lambda r: self.status(r)),
            (Head("Mean distance", "number"), lambda r: _cell(known(r.distance_mean))),
            (Head("95 % within", "number"), lambda r: _cell(known(r.distance_p95))),
            (Head("99 % within", "number"), lambda r: _cell(known(r.distance_p99))),
            (Head("Farthest", "number"), lambda r: _cell(known(r.distance_max))),
            (Head("Mean, % of size", "number"), lambda r: _cell(100 * self.share(r, "mean"))),
            (Head("99 %, % of size", "number"), lambda r: _cell(100 * self.share(r, "p99"))),
            (Head("Vertices shown, %", "number"), lambda r: number(100 * known(r.seen_share), 1)),
            (Head("Scan reached, %", "number"), lambda r: number(100 * known(r.covered_share), 1)),
            (Head("Area covered, %", "number"), lambda r: number(100 * known(r.area_share), 1)),
            (Head("Folded, %", "number"), lambda r: _cell(100 * known(r.folded_share))),
            (Head("Area change, times", "number"), lambda r: number(known(r.area_factor), 2)),
            (Head("Size, relative to usual", "number"), lambda r: number(known(r.scale), 3)),
            (Head("Moved last, % of size", "number"), lambda r: _cell(100 * (r.moved_share or [nan])[-1])),
            (Head("CPU seconds", "number"), lambda r: number(sum(r.cpu_s) if r.cpu_s else nan, 1)),
        ]
        records = [*self.out, *self.ordered]
        units = "The scans are in different units: compare distances in % of the size."
        first = f"The first {MOST_ROWS:,} of {len(records):,} scans; their records have all."
        caption = (
            "Distances are both ways; those without % are in the unit of the scan's file. Area covered: that of the "
            "surface relative to that of the scan. Folded: triangles that turn back over their neighbours. Area "
            "change: 95 % of the triangles grow or shrink by less than this factor relative to the mean shape, size "
            "divided out."
        )
        why = [[record.name, self._reason(record)] for record in records if self._reason(record)]
        return [
            Text(units if self.result.units_mixed else "", "notice"),
            Text(first if len(records) > MOST_ROWS else ""),
            table_of(records[:MOST_ROWS], columns, "All scans"),
            Text(caption, "soft"),
            Folded(
                f"The reasons of {counted(len(why), 'scan')}",
                ([text_table(("Scan", "Why"), why, "Reasons")] if why else []),
            ),
        ]

    def _reason(self, record: CorrespondRecord) -> str:
        if record in self.out:
            return sentence(record.reason or self.all.unread.get(record.name, ""))
        return self.concerns[record.name].text if self.concerns[record.name].reasons else ""

    # The rest

    def rounds(self) -> list[Block]:
        """Return the movement of vertices in each round, and the computing time."""
        run = self.result.run
        figure = self.page.figure(
            figures.movement_figure(run.rounds, [record.moved_share for record in self.records], self.result.settled),
            "Each round starts from the result of the previous round. The first movement is measured from the first "
            "template, so it is the largest; when vertices no longer move, another round changes nothing.",
            alt=f"Movement of vertices in {counted(len(run.rounds), 'round')}: "
            + listed([percent_of(moved) for moved in run.rounds]),
            chart=True,
        )
        rows: list[list[Cell]] = []
        for k, moved in enumerate(run.rounds):
            cpu = [record.cpu_s[k] for record in self.records if len(record.cpu_s) > k]
            rows.append(
                [
                    *[Cell(f"Round {k + 1}", float(k + 1)), _cell(100 * moved)],
                    number(sum(cpu), 1),
                    number(median(cpu), 1),
                    number(max(cpu, default=nan), 1),
                ]
            )
        return [
            Text(run.template),
            figure,
            Table(
                [
                    Head("Round"),
                    *(
                        Head(head, "number")
                        for head in [
                            "Moved (RMS), % of size",
                            "CPU seconds, all scans",
                            "a scan, median",
                            "a scan, most",
                        ]
                    ),
                ],
                rows,
                "Movement and time by round",
            ),
            Text("CPU seconds are those of the scans in correspondence; choosing the template is not counted.", "soft"),
        ]

    def settings(self) -> list[Block]:
        """Return settings, versions and hashes."""
        run = self.result.run
        rows = [("Report", f"shapespace {__version__}"), ("Correspondence", f"shapespace {run.version}")]
        rows += [("First template", run.template), ("Vertices made", f"{run.vertices:,}")]
        rows += [(words(key), setting(value)) for key, value in run.settings.items() if key != "vertices"]
        return [
            Facts(rows, "Settings and versions"),
            Folded(
                "Content hashes (SHA-256)",
                [
                    text_table(
                        ("Scan", "File", "Hash"),
                        [
                            [r.name, r.path or DASH, r.hash or DASH]
                            for r in list(self.result.records.values())[:MOST_ROWS]
                        ],
                        "Content hashes of the scans",
                    )
                ],
            ),
        ]


def _cell(value: float) -> Cell:
    """Return a number of any size with three digits or so."""
    return Cell(plain(value) if isfinite(value) else DASH, value)
