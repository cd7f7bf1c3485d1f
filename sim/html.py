# SPDX-License-Identifier: MIT
"""Self-contained HTML pages and SVG pictures: templates and escaped elements; ``page_style`` has their CSS.

Pages come from Jinja templates, drawings from ``element``. Either way what is not ``Markup`` is escaped, and the result
also parses as XML.
"""

from __future__ import annotations

import base64
import hashlib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from .errors import InputError
from .files import read_bytes

if TYPE_CHECKING:
    from jinja2 import Environment

_FORBIDDEN = re.compile("[^\t\n\r\x20-\x7e\xa0-\ud7ff\ue000-\ufdcf\ufdf0-\ufffd\U00010000-\U0010fffd]")
"""Characters that XML or HTML forbids: controls, lone surrogates and Unicode noncharacters."""

_DIRECTION = re.compile("[\u200e\u200f\u202a-\u202e\u2066-\u2069]")
"""Bidirectional control characters: one in a name would reorder the text around it."""

_CLOSED = frozenset({"meta", "br", "img", "rect", "line", "circle", "path", "image"})
"""Void elements, written ``<name />``; HTML requires an end tag for all others."""

_NAMESPACE = "http://www.w3.org/2000/svg"
_BORDER = 20.0
"""Margin around a picture in its own file."""

Attribute = str | float | None


class Markup(str):
    """Text that is markup already and is not escaped again."""

    __slots__ = ()

    def __html__(self) -> str:
        """Itself: Jinja does not escape it."""
        return self


def clean(value: object) -> str:
    """Return ``value`` as text with forbidden characters replaced and bidirectional controls removed."""
    return _FORBIDDEN.sub("\ufffd", _DIRECTION.sub("", str(value)))


def text(value: object) -> Markup:
    """Return ``value`` escaped; ``Markup`` stays as it is."""
    return value if isinstance(value, Markup) else Markup(escape(clean(value), quote=True))


def shortened(value: object, length: int) -> str:
    """Return ``value`` on one line, truncated to ``length`` characters with an ellipsis."""
    line = " ".join(clean(value).split()) or "(no name)"
    return line if len(line) <= length else line[: max(length - 1, 1)] + "…"


_FLAG = re.compile(r"(?<!\S)--[a-z][a-z-]*")


def prose(value: object) -> Markup:
    """Return ``value`` escaped, with command-line flags kept on one line: browsers break ``--flag`` at its hyphens."""
    return Markup(_FLAG.sub(lambda flag: f'<span class="flag">{flag[0]}</span>', text(value)))


def join(parts: Iterable[Markup | str | None]) -> Markup:
    """Return the parts concatenated; None is skipped."""
    return Markup("".join(text(part) for part in parts if part is not None))


def element(tag: str, *children: Markup | str | None, **attributes: Attribute) -> Markup:
    """Return an element. ``class_`` is class, ``stroke_width`` is stroke-width; None attributes are skipped."""
    written = "".join(
        f' {name.rstrip("_").replace("_", "-")}="{_attribute(value)}"'
        for name, value in attributes.items()
        if value is not None
    )
    if tag in _CLOSED:
        return Markup(f"<{tag}{written} />")
    return Markup(f"<{tag}{written}>{join(children)}</{tag}>")


def _attribute(value: str | float) -> str:
    return short_number(value) if isinstance(value, int | float) else text(value)


def short_number(value: float) -> str:
    """Return a coordinate rounded to 0.1 without trailing zeros; "0" where it is not finite."""
    if not math.isfinite(value):
        return "0"
    written = f"{value:.1f}"
    return "0" if written == "-0.0" else written.removesuffix(".0")


def page_head(title: str, style: str, *, script: str | None = None) -> Markup:
    """Return the ``<head>`` of a page that has the CSS ``style`` and may load nothing.

    script: the only one that the page may run, which may play media files beside it; None: it runs nothing.
    """
    runs = "" if script is None else f"script-src {_allowed(script)}; "
    plays = "" if script is None else "media-src 'self' file:; "
    policy = (
        f"default-src 'none'; style-src {_allowed(style)}; {runs}img-src data:; {plays}base-uri 'none'; "
        "form-action 'none'"
    )
    return element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="referrer", content="no-referrer"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", title),
        element("style", Markup(style)),
    )


_HARMLESS = re.compile(
    rb"\s*<!DOCTYPE html>\s*<html lang=\"en\">\s*<head><meta charset=\"utf-8\" />"
    rb"<meta http-equiv=\"Content-Security-Policy\" content=\"default-src &#x27;none&#x27;; "
    rb"style-src &#x27;sha256-[A-Za-z0-9+/=]{44}&#x27;; img-src data:; base-uri &#x27;none&#x27;; "
    rb"form-action &#x27;none&#x27;\" />"
)
"""Beginning of a page of ``page_head`` without a script. Nothing precedes the policy, so a browser holds all that
follows to it, whoever wrote that."""
MOST_PAGE_BYTES = 2**28


def require_harmless(page: Path) -> None:
    """Raise InputError unless the file ``page`` is one that runs nothing, loads nothing and leads nowhere by itself,
    so that a browser may show it even if it came from somebody else."""
    try:
        content = read_bytes(page, MOST_PAGE_BYTES, what="page")
    except FileNotFoundError:
        raise InputError(f"{page}: there is no such page; run the command again that makes it") from None
    head = _HARMLESS.match(content)
    rest = b"" if head is None else content[head.end() :].lower()
    # Browsers look up the host of <link rel="preconnect"> whatever the policy says; ours have no links of this kind.
    if head is None or b"http-equiv" in rest or b"<link" in rest:
        raise InputError(f"{page}: is not as PhysGen writes it and may run scripts, so it is not opened; make it anew")


def _allowed(text: str) -> str:
    """Return the source expression of a policy that allows exactly ``text``."""
    return "'sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode("ascii") + "'"


def render(template: Path, **values: object) -> str:
    """Return the page that the Jinja file ``template`` makes of ``values``; a name that is missing raises.

    Every value is escaped, and cleaned as ``clean`` does it, unless it is ``Markup``.
    """
    return _environment(template.parent).get_template(template.name).render(values)


@cache
def _environment(folder: Path) -> Environment:
    # Imported here: Blender's own Python, which only reads pages, has no Jinja.
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    return Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=lambda value: value if hasattr(value, "__html__") else clean(value),
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A drawing of width × height CSS pixels, with a title and a description for screen readers."""

    width: float
    height: float
    title: str
    description: str
    body: Markup

    def inline(self, identifier: str, class_: str = "") -> Markup:
        """Return the picture for a page with ``picture_style``; ``identifier`` must be unique in the page."""
        return self._svg(identifier, class_)

    def file(self, style: str) -> str:
        """Return the content of an SVG file with ``style`` inside."""
        head = element("style", Markup(style))
        # Viewers differ in the background behind a file, so it draws its own.
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
            viewBox=f"{short_number(-border)} {short_number(-border)} {short_number(width)} {short_number(height)}",
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
    """Return a line of text in a picture; anchor: ``middle``, ``end`` or None (start)."""
    return element("text", content, x=x, y=y, class_=class_, text_anchor=anchor, font_size=size)


def translated(x: float, y: float, *children: Markup | None) -> Markup:
    """Return the children translated by (x, y)."""
    return element("g", *children, transform=f"translate({short_number(x)} {short_number(y)})")


def side_by_side(pictures: list[Picture], *, columns: int, gap: float, title: str, description: str) -> Picture:
    """Return one picture of several, row by row."""
    columns = max(1, min(columns, len(pictures)))
    rows = [pictures[i : i + columns] for i in range(0, len(pictures), columns)]
    width = max((p.width for p in pictures), default=200.0)
    parts, y = [], 0.0
    for row in rows:
        for column, picture in enumerate(row):
            names = element("title", picture.title), element("desc", picture.description)
            parts.append(translated(column * (width + gap), y, *names, picture.body))
        y += max(p.height for p in row) + gap
    return Picture(
        width=columns * (width + gap) - gap,
        height=max(y - gap, 20.0),
        title=title,
        description=description,
        body=join(parts),
    )
