# SPDX-License-Identifier: MIT
"""Elements of HTML and SVG as text. What is not ``Markup`` already is escaped; the result also parses as XML."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from html import escape

_FORBIDDEN = re.compile("[^\t\n\r\x20-\x7e\xa0-\ud7ff\ue000-\ufdcf\ufdf0-\ufffd\U00010000-\U0010fffd]")
"""Characters that XML or HTML does not allow: controls, lone surrogates, and what Unicode sets aside."""

_DIRECTION = re.compile("[\u200e\u200f\u202a-\u202e\u2066-\u2069]")
"""Marks that turn the direction of writing: a name that holds one would turn the text around it."""

_CLOSED = frozenset({"meta", "br", "img", "rect", "line", "circle", "path", "image"})
"""Written ``<name />``; every other element gets an end tag, since HTML has no other way to end it."""

_NAMESPACE = "http://www.w3.org/2000/svg"
_BORDER = 20.0
"""Around a picture in a file of its own."""

Attribute = str | float | None


class Markup(str):
    """Text that is markup already and is not escaped again."""

    __slots__ = ()


def clean(value: object) -> str:
    """``value`` as text that any page may hold: forbidden characters replaced, marks of direction removed."""
    return _FORBIDDEN.sub("\ufffd", _DIRECTION.sub("", str(value)))


def text(value: object) -> Markup:
    """``value`` as text of a page; ``Markup`` stays as it is."""
    return value if isinstance(value, Markup) else Markup(escape(clean(value), quote=True))


def shortened(value: object, length: int) -> str:
    """The first ``length`` characters of ``value`` on one line, with an ellipsis where more was cut off."""
    line = " ".join(clean(value).split()) or "(no name)"
    return line if len(line) <= length else line[: max(length - 1, 1)] + "…"


def join(parts: Iterable[Markup | str | None]) -> Markup:
    """The parts one after the other; None is left out."""
    return Markup("".join(text(part) for part in parts if part is not None))


def element(tag: str, *children: Markup | str | None, **attributes: Attribute) -> Markup:
    """An element. ``class_`` is class, ``stroke_width`` is stroke-width; an attribute that is None is left out."""
    written = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{_attribute(value)}"'
        for name, value in attributes.items()
        if value is not None
    )
    if tag in _CLOSED:
        return Markup(f"<{tag}{written} />")
    return Markup(f"<{tag}{written}>{join(children)}</{tag}>")


def _attribute(value: str | float) -> str:
    return short(value) if isinstance(value, int | float) else text(value)


def short(value: float) -> str:
    """A coordinate to a tenth of a unit, without needless digits; 0 for what is no number."""
    if not math.isfinite(value):
        return "0"
    written = f"{value:.1f}"
    return "0" if written == "-0.0" else written.removesuffix(".0")


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A drawing of width × height units, one unit a CSS pixel at full size.

    title, description: what it shows, and what is to be seen in it, for those who cannot see it.
    """

    width: float
    height: float
    title: str
    description: str
    body: Markup

    def inline(self, identifier: str, class_: str = "") -> Markup:
        """For a page that has the pictures' style; ``identifier`` is unique in it."""
        return self._svg(identifier, class_)

    def file(self, style: str) -> str:
        """A file of its own, with ``style`` inside."""
        head = element("style", Markup(style))
        # A file stands on whatever a viewer puts behind it, so it brings its own paper.
        x, y, width, height = -_BORDER, -_BORDER, self.width + 2 * _BORDER, self.height + 2 * _BORDER
        paper = element("rect", x=x, y=y, width=width, height=height, class_="paper")
        body = self._svg("picture", "", border=_BORDER, extra=join([head, paper]), namespace=_NAMESPACE)
        return f'<?xml version="1.0" encoding="UTF-8"?>\n{body}\n'

    def _svg(
        self,
        identifier: str,
        class_: str,
        *,
        border: float = 0.0,
        extra: Markup | None = None,
        namespace: str | None = None,
    ) -> Markup:
        width, height = self.width + 2 * border, self.height + 2 * border
        return element(
            "svg",
            element("title", self.title, id=f"{identifier}-title"),
            element("desc", self.description, id=f"{identifier}-desc"),
            extra,
            self.body,
            xmlns=namespace,
            viewBox=f"{short(-border)} {short(-border)} {short(width)} {short(height)}",
            width=width,
            height=height,
            role="img",
            aria_labelledby=f"{identifier}-title {identifier}-desc",
            class_=f"picture {class_}".strip(),
        )


def label(
    content: Markup | str,
    x: float,
    y: float,
    *,
    class_: str = "ink",
    anchor: str | None = None,
    size: float | None = None,
) -> Markup:
    """A line of text in a picture; anchor: ``middle`` or ``end`` (at its start without)."""
    return element("text", content, x=x, y=y, class_=class_, text_anchor=anchor, font_size=size)


def moved(x: float, y: float, *children: Markup | None) -> Markup:
    """The children, moved by (x, y)."""
    return element("g", *children, transform=f"translate({short(x)} {short(y)})")


def side_by_side(pictures: list[Picture], *, columns: int, gap: float, title: str, description: str) -> Picture:
    """One picture of several, row by row."""
    columns = max(1, min(columns, len(pictures)))
    rows = [pictures[i : i + columns] for i in range(0, len(pictures), columns)]
    width = max((p.width for p in pictures), default=200.0)
    parts, y = [], 0.0
    for row in rows:
        for column, picture in enumerate(row):
            names = element("title", picture.title), element("desc", picture.description)
            parts.append(moved(column * (width + gap), y, *names, picture.body))
        y += max(p.height for p in row) + gap
    return Picture(
        width=columns * (width + gap) - gap,
        height=max(y - gap, 20.0),
        title=title,
        description=description,
        body=join(parts),
    )
