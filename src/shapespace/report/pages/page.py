"""A self-contained page: style, scripts, pictures and payloads inside; a failed section leaves the others intact."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cache, partial
from importlib.resources import files
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, TypeVar

from shapespace.errors import ShapespaceError
from shapespace.lazy import Defer, call_later
from shapespace.report import figures
from shapespace.report.blocks.blocks import Block, Cell, Figure, Image, Section, Text, Turning
from shapespace.report.blocks.wording import anchor
from shapespace.report.render import scene

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

    from shapespace.report.render.thumbnails import Still
    from shapespace.schemas import Orientation

LARGEST_REPORT_BYTES = 8_000_000
"""A report stays below this size, so that it can be mailed."""

_SHELL_BYTES = 250_000  # bytes of scripts and styles of a page
_RESERVE_BYTES = 700_000  # bytes that stay free for tables and text after the last picture

Step = Callable[[str, int], None]
"""Called with the name of a finished item and the expected number of items, for a progress bar."""

_T = TypeVar("_T")
Make: TypeAlias = Callable[[], Block | Sequence[Block]]
"""Makes a part of a page."""


@dataclass(frozen=True)
class Chapter:
    """A part of the page in its navigation: its heading, the function that makes it, and a shorter text of its link."""

    heading: str
    make: Make
    link: str = ""


@dataclass(frozen=True, eq=False)
class OrderedPicture:
    """A drawing that another process may make while this one continues with the page.

    Args:
        draw: function that returns the drawing.
        still: function that waits for the encoded drawing, and raises the errors of `draw`.
    """

    draw: Callable[[], Drawing]
    still: Callable[[], Still]


def _draw(name: str, *args: Any, **options: Any) -> Drawing:
    return getattr(figures, name)(*args, **options)


def _drawn_still(draw: Callable[[], Drawing], *, lossless: bool) -> Still:
    return figures.encode_webp(draw(), lossless=lossless)


class Page:
    """Builder of a page: embedded data, the number of bytes so far, and the reasons of sections that failed.

    Args:
        on_step: called after each picture.
        defer: function that starts the drawing of ordered pictures.
    """

    planned: int = 1
    """Expected number of pictures."""

    def __init__(self, on_step: Step | None = None, defer: Defer = call_later) -> None:
        self._on_step = on_step
        self._defer = defer
        self._payloads: list[str] = []
        self._anchors: set[str] = set()
        self._loaded: dict[object, Any] = {}
        self.spent = _SHELL_BYTES

    @property
    def left(self) -> int:
        """Number of bytes that may still be embedded."""
        return LARGEST_REPORT_BYTES - self.spent

    def once(self, key: object, load: Callable[[], _T]) -> _T:
        """Return the value that `load` returned when it was first called for `key`."""
        if key not in self._loaded:
            self._loaded[key] = load()
        return self._loaded[key]

    def step(self, name: str) -> None:
        """Report a finished item to the progress bar."""
        if self._on_step is not None:
            self._on_step(name, self.planned)

    def anchor(self, text: str) -> str:
        """Return a name for a place in the page, made of `text` and taken only once."""
        name = base = anchor(text)
        count = 1
        while name in self._anchors:
            count += 1
            name = f"{base}-{count}"
        self._anchors.add(name)
        return name

    def section(
        self, heading: str, make: Make, level: int = 3, anchor: str | None = None, link: str = "", *,
        folded: bool = False, status: Cell | None = None,
    ) -> Section:  # fmt: skip
        """Return a section, or its heading and why it could not be made."""
        anchor = anchor or self.anchor(heading)
        return Section(
            heading=heading,
            anchor=anchor,
            body=self.tried(make),
            level=level,
            link=link or heading,
            folded=folded,
            status=status,
        )

    def tried(self, make: Make) -> Sequence[Block]:
        """Return the result of `make`, or the reason why it failed."""
        try:
            made = make()
        except ShapespaceError as error:
            return [self.failed(error)]
        return made if isinstance(made, Sequence) else [made]

    def failed(self, error: ShapespaceError) -> Text:
        """Return the reason why a part of the page could not be made."""
        return Text(f"This part could not be made. {error}", "broken")

    def oriented(self, orientation: Orientation | None) -> AbstractContextManager[None]:
        """Return a context in which surfaces are drawn in the views of an analysis."""
        return figures.oriented(orientation)

    def order(self, name: str, *args: object, chart: bool = False, **options: Any) -> OrderedPicture:
        """Return a drawing for `figure` that is made in another process, if there is one.

        A picture of the same objects is made once. Its module, which is slow to import, is not imported here.

        Args:
            name: name of the function in `report.figures` that draws it.
            args: objects that it draws.
            chart: whether it is a chart, which is encoded without loss.
            options: further arguments of the function.
        """

        def order() -> OrderedPicture:
            draw = partial(_draw, name, *args, **options)  # refers to the objects, so that their identities stay valid
            return OrderedPicture(draw, self._defer(_drawn_still, draw, lossless=chart))

        return self.once((name, *map(id, args)), order)

    def figure(self, figure: Drawing | OrderedPicture, caption: str, *, alt: str, chart: bool = False) -> Figure:
        """Return a drawing with its caption; `alt` describes the drawing."""
        still = self.still(figure, alt, lossless=chart)
        self.step(caption)
        return Figure(still, caption, "chart" if chart else "drawing")

    def still(self, figure: Drawing | OrderedPicture, alt: str, *, lossless: bool = False) -> Image:
        """Return a drawing as an image of this page, such as the still picture of a widget."""
        if isinstance(figure, OrderedPicture):
            return self.image(figure.still(), alt)
        return self.image(figures.encode_webp(figure, lossless=lossless), alt)

    def image(self, still: Still, alt: str) -> Image:
        """Return a picture as an image of this page."""
        self.spent += 4 * -(-len(still[0]) // 3)
        return Image(*still, alt)

    def turning(
        self,
        widget: Literal["modes", "morph", "fit", "scatter", "morphospace"],
        payload: bytes,
        poster: Image,
        caption: str,
        *,
        label: str,
        still: str,
    ) -> Turning | Figure:
        """Return a widget, or only its still picture if the page would grow too large.

        Args:
            widget: name of the widget, see `blocks.Turning`.
            payload: data that the widget shows, from `report.render.scene`.
            poster: still picture.
            caption: caption of the widget and of the still picture.
            label: description for screen readers.
            still: description of the still picture, printed with it only.
        """
        name = f"payload-{len(self._payloads) + 1}"
        if not self._payloads:
            self.spent += len(scene.scripts()) + len(scene.style())
        text = scene.payload_html(name, payload)
        self.step(caption)
        if len(text) > self.left - _RESERVE_BYTES:
            why = f"It does not turn, so that this file stays below {LARGEST_REPORT_BYTES // 1_000_000} MB."
            return Figure(poster, f"{caption} {still} {why}")
        self.spent += len(text)
        self._payloads.append(text)
        return Turning(widget, name, poster, caption, label, still)

    def html(self, title: str, lead: Sequence[Block], made: str, chapters: Sequence[Chapter]) -> str:
        """Return the complete page.

        Args:
            title: title of the page.
            lead: blocks below the title.
            made: sentence on the version and the source of the page.
            chapters: chapters of the page in order.
        """
        from markupsafe import Markup

        # Their places come first, so that no part inside takes the name of a chapter.
        places = [self.anchor(chapter.heading) for chapter in chapters]
        sections = [
            self.section(chapter.heading, chapter.make, 2, anchor, chapter.link)
            for chapter, anchor in zip(chapters, places, strict=True)
        ]
        style, early, scripts = _asset("report.css"), _script(_asset("theme.js")), [_script(_asset("report.js"))]
        if self._payloads:
            from shapespace.report.render import scene

            style += scene.style()
            scripts.insert(0, _script(scene.scripts()))
        policy = (
            "default-src 'none'; img-src data: blob:; "
            f"style-src {_hash(style)}; script-src {' '.join(_hash(text) for text in (early, *scripts))}; "
            "base-uri 'none'; form-action 'none'"
        )
        return (
            _environment()
            .get_template("page.html")
            .render(
                title=title,
                lead=lead,
                made=made,
                sections=sections,
                # Ours, and hashed by the policy above: these alone are not escaped.
                policy=Markup(policy),
                style=Markup(style),
                early=Markup(early),
                scripts=[Markup(text) for text in scripts],
                payloads=[Markup(text) for text in self._payloads],
            )
        )


def rendered(blocks: Sequence[Block]) -> str:
    """Return blocks as HTML."""
    from markupsafe import Markup

    macros: Any = template("blocks.html").module
    return Markup("").join(getattr(macros, type(block).__name__)(block) for block in blocks)


def template(name: str) -> Any:
    """Return a template of ours, which escapes all that it is given."""
    return _environment().get_template(name)


@cache
def _environment() -> Any:  # what Jinja2 keeps for templates is untyped
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made: Any = Environment(
        loader=PackageLoader("shapespace.report"),
        autoescape=True,
        trim_blocks=True,
        lstrip_blocks=True,
        undefined=StrictUndefined,
    )
    made.globals["blocks"] = rendered
    return made


@cache
def _asset(name: str) -> str:
    return files("shapespace.report").joinpath("assets", name).read_text(encoding="utf-8")


def _script(text: str) -> str:
    """Return a script of this package with `</script` and `<!--` escaped; both occur in its strings only."""
    return text.replace("</script", "<\\/script").replace("<!--", "<\\!--")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
