"""The shell of a self-contained page: style, scripts, pictures and payloads inside; sections fail by themselves."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Literal

from shapespace.errors import ShapespaceError
from shapespace.report.markup import anchor, esc

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LARGEST_REPORT_BYTES = 8_000_000
"""A report stays below this size, so that it can be mailed."""

_SHELL_BYTES = 250_000
_RESERVE_BYTES = 700_000

Step = Callable[[str, int], None]
"""Told what was just made, and about how many such things there will be, for a progress bar."""


@dataclass(frozen=True)
class Section:
    """A part of the page that its navigation leads to.

    Args:
        heading: of the part.
        link: what the navigation calls it.
        make: returns its HTML.
    """

    heading: str
    link: str
    make: Callable[[], str]


class Page:
    """A page in the making: what it embeds, how large it is so far, and where its sections failed.

    Args:
        advice: what a reader can do about a result file that is wrong, such as `run the demo again`.
        planned: about how many pictures there will be.
        on_step: told of each picture.
    """

    def __init__(self, advice: str, planned: int, on_step: Step | None = None) -> None:
        self.advice = advice
        self._planned = planned
        self._on_step = on_step
        self._payloads: list[str] = []
        self._anchors: set[str] = set()
        self._spent = _SHELL_BYTES

    @property
    def left(self) -> int:
        """How many bytes may still be embedded."""
        return LARGEST_REPORT_BYTES - self._spent

    def spend(self, n_bytes: int) -> None:
        """Count bytes that are embedded by other means than this page's."""
        self._spent += n_bytes

    def step(self, what: str) -> None:
        """Tell the progress bar what was just made."""
        if self._on_step is not None:
            self._on_step(what, self._planned)

    def place(self, text: str) -> str:
        """Return a name for a place in the page, made of `text` and taken only once."""
        name = base = anchor(text)
        count = 1
        while name in self._anchors:
            count += 1
            name = f"{base}-{count}"
        self._anchors.add(name)
        return name

    def guarded(self, heading: str, make: Callable[[], str], level: int = 3, place: str | None = None) -> str:
        """Return a section, or its heading and why it could not be made."""
        place = place or self.place(heading)
        top = f'<h{level} id="{esc(place)}">{esc(heading)}</h{level}>\n'
        body = self.tried(make)
        return f'<section aria-labelledby="{esc(place)}">\n{top}{body}\n</section>'

    def tried(self, make: Callable[[], str]) -> str:
        """Return what `make` gives, or why it could not."""
        try:
            return make()
        except ShapespaceError as error:
            return f'<p class="broken">This part could not be made. {esc(str(error))}</p>\n'
        except Exception as error:
            # Result files can be wrong in more ways than can be listed, and one of them must not cost the rest.
            what = f"{type(error).__name__}: {error}"
            return (
                '<p class="broken">This part could not be made, because a result file does not have the expected form '
                f"({esc(what)}); {esc(self.advice)}.</p>\n"
            )

    def figure(self, figure: Figure, caption: str, *, alt: str, chart: bool = False) -> str:
        """Return a drawing with its caption; `alt` says what is seen in it."""
        from shapespace.report.figures import encode_webp

        data, size = encode_webp(figure, lossless=chart)
        return self.picture(data, size, caption, alt=alt, kind="chart" if chart else "drawing")

    def picture(
        self,
        data: bytes,
        size: tuple[int, int],
        caption: str,
        *,
        alt: str,
        kind: Literal["chart", "drawing", "plain"] = "plain",
    ) -> str:
        """Return WebP `data` of `size` pixels with its caption."""
        self.step(caption)
        return (
            f'<figure class="{kind}"><div class="plate">{self.image(data, size, alt=alt)}</div>\n'
            f"<figcaption>{esc(caption)}</figcaption></figure>\n"
        )

    def image(self, data: bytes, size: tuple[int, int], *, alt: str) -> str:
        """Return WebP `data` of `size` pixels as an image."""
        source = base64.b64encode(data).decode("ascii")
        self._spent += len(source)
        return (
            f'<img alt="{esc(alt)}" width="{size[0]}" height="{size[1]}" decoding="async" '
            f'src="data:image/webp;base64,{source}">'
        )

    def turning(
        self,
        widget: Literal["modes", "fit", "scatter"],
        payload: bytes,
        poster: str,
        caption: str,
        *,
        label: str,
        still: str,
    ) -> str:
        """Return something that turns where the browser can, and is a still on paper and without a script.

        Args:
            widget: a name of `Shapespace.widgets` in widgets.js.
            payload: what it shows, from `report.scene`.
            poster: HTML of the still, from `image`.
            caption: of both.
            label: what it is, for screen readers.
            still: what the still shows, told with it alone.
        """
        from shapespace.report import scene

        name = f"payload-{len(self._payloads) + 1}"
        if not self._payloads:
            self._spent += len(scene.scripts()) + len(scene.style())
        text = scene.payload_html(name, payload)
        self.step(caption)
        if len(text) > self.left - _RESERVE_BYTES:
            why = f"It does not turn, so that this file stays below {LARGEST_REPORT_BYTES // 1_000_000} MB."
            said = esc(f"{caption} {still} {why}")
            return (
                f'<figure class="plain"><div class="plate">{poster}</div>\n<figcaption>{said}</figcaption></figure>\n'
            )
        self._spent += len(text)
        self._payloads.append(text)
        return (
            f'<figure class="turning"><div class="widget" data-widget="{widget}" data-payload="{name}" role="group" '
            f'aria-label="{esc(label)}"></div>\n<div class="plate poster">{poster}</div>\n'
            f'<figcaption>{esc(caption)} <span class="still">{esc(still)}</span></figcaption></figure>\n'
        )

    def html(self, title: str, lead: str, made: str, sections: Sequence[Section]) -> str:
        """Return the whole page.

        Args:
            title: of the page, text.
            lead: HTML below the title.
            made: by what and when, text.
            sections: its parts in order.
        """
        places = [self.place(section.heading) for section in sections]
        body = "\n".join(
            self.guarded(section.heading, section.make, 2, place)
            for section, place in zip(sections, places, strict=True)
        )
        links = "".join(
            f'<li><a href="#{esc(place)}">{esc(section.link)}</a></li>'
            for section, place in zip(sections, places, strict=True)
        )
        style, early, late = _asset("report.css"), _script(_asset("theme.js")), _script(_asset("report.js"))
        scripts = [late]
        if self._payloads:
            from shapespace.report import scene

            style += scene.style()
            scripts = [_script(scene.scripts()), late]
        policy = (
            "default-src 'none'; img-src data: blob:; "
            f"style-src {_hash(style)}; script-src {' '.join(_hash(text) for text in (early, *scripts))}; "
            "base-uri 'none'; form-action 'none'"
        )
        return (
            '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
            f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
            '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            '<link rel="icon" href="data:,">\n'
            f"<title>{esc(title)}</title>\n<style>{style}</style>\n<script>{early}</script>\n</head>\n<body>\n"
            '<a class="skip" href="#content">Skip to the content</a>\n'
            f'<header>\n<button type="button" id="theme" hidden>Dark colours</button>\n<h1>{esc(title)}</h1>\n{lead}'
            f'<nav aria-label="Sections"><ul>{links}</ul></nav>\n</header>\n'
            f'<main id="content" tabindex="-1">\n{body}\n</main>\n'
            f"<footer>{esc(made)}</footer>\n"
            + "".join(self._payloads)
            + "".join(f"<script>{text}</script>\n" for text in scripts)
            + "</body>\n</html>\n"
        )


@cache
def _asset(name: str) -> str:
    return files("shapespace.report").joinpath("assets", name).read_text(encoding="utf-8")


def _script(text: str) -> str:
    """Return a script of ours so that it does not end its own element; the two marks occur in its strings only."""
    return text.replace("</script", "<\\/script").replace("<!--", "<\\!--")


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
