# SPDX-License-Identifier: MIT
"""Self-contained HTML pages and SVG pictures: templates, escaped elements, colour themes and the page style.

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


FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', 'DejaVu Sans', sans-serif"

PALETTES: dict[str, dict[str, str]] = {
    "light": {
        "paper": "#ffffff",
        "panel": "#f4f6f8",
        "ink": "#1a1e24",
        "quiet": "#545d68",
        "rule": "#d3d9e0",
        "observed": "#3a424c",
        "nominal": "#b8480a",
        "found": "#0a5fb4",
        "other": "#737d89",
        "nominal-tint": "#f6dccb",
        "found-tint": "#d3e5f8",
        "flight": "#d6e6f7",
        "impact": "#f3b5a4",
        "contact": "#f3e0a8",
        "rest": "#e2e5ea",
        "unnamed": "#f4f6f8",
    },
    "dark": {
        "paper": "#14171c",
        "panel": "#1d2229",
        "ink": "#e9ecf0",
        "quiet": "#a9b2bd",
        "rule": "#39414b",
        "observed": "#c9d0d8",
        "nominal": "#ff9a57",
        "found": "#6db5ff",
        "other": "#87919d",
        "nominal-tint": "#4c2f1c",
        "found-tint": "#1b3a5a",
        "flight": "#20394f",
        "impact": "#7d3a2a",
        "contact": "#55481b",
        "rest": "#333941",
        "unnamed": "#1d2229",
    },
}

_RULES = (
    (".picture .paper", "fill", "paper"),
    (".picture .panel", "fill", "panel"),
    (".picture .ink", "fill", "ink"),
    (".picture .quiet", "fill", "quiet"),
    (".picture .rule", "stroke", "rule"),
    (".picture .tick", "stroke", "quiet"),
    (".picture .curve", "stroke", "ink"),
    (".picture .area", "fill", "ink"),
    (".picture .halo", "stroke", "paper"),
    *((f".picture .{name}-fill", "fill", name) for name in ("observed", "nominal", "found", "other", "rule")),
    *((f".picture .{name}-line", "stroke", name) for name in ("observed", "nominal", "found", "other")),
    *((f".picture .{name}-tint", "fill", f"{name}-tint") for name in ("nominal", "found")),
    *((f".picture .phase-{name}", "fill", name) for name in ("flight", "impact", "contact", "rest", "unnamed")),
)

_FIXED = (
    f".picture text{{font-family:{FONT};font-size:12px}}"
    ".picture .strong{font-weight:600}"
    ".picture .line{fill:none;stroke-linejoin:round;stroke-linecap:round}"
    ".picture .area{fill-opacity:.16}"
    ".picture .halo{stroke-width:3px;paint-order:stroke;stroke-linejoin:round}"
    ".picture .dot{fill-opacity:.75}"
)


def picture_style() -> str:
    """Return the CSS of all pictures. Dark only on screens: paper stays white."""
    return f"{_FIXED}{_colours('light')}@media screen and (prefers-color-scheme: dark){{{_colours('dark')}}}"


def _colours(name: str) -> str:
    palette = PALETTES[name]
    return "".join(f"{selector}{{{what}:{palette[colour]}}}" for selector, what, colour in _RULES)


_PAGE = """
*{box-sizing:border-box}
html{-webkit-text-size-adjust:100%;text-size-adjust:100%}
body{margin:0;background:var(--paper);color:var(--ink);line-height:1.55;font-size:16px;overflow-wrap:break-word}
main,header,footer{max-width:960px;margin:0 auto;padding:0 24px}
header{padding-top:48px}
.eyebrow{margin:0;color:var(--quiet);font-size:14px}
h1{margin:8px 0 0;font-size:34px;line-height:1.18;letter-spacing:-.015em;text-wrap:balance}
h2{margin:0 0 4px;font-size:22px;line-height:1.3;letter-spacing:-.01em}
h3{margin:28px 0 8px;font-size:16px}
p{margin:8px 0;max-width:70ch}
.lead{margin-top:14px;font-size:19px;line-height:1.5}
.quiet{color:var(--quiet)}
section{margin-top:56px;padding-top:24px;border-top:1px solid var(--rule)}
figure{margin:20px 0 0}
figcaption{color:var(--quiet);font-size:14px;max-width:75ch;margin-top:8px}
.facts{display:grid;grid-template-columns:repeat(auto-fit,minmax(190px,1fr));gap:12px;margin:28px 0 0;padding:0}
.facts div{background:var(--panel);border-radius:8px;padding:14px 16px}
.facts dt{color:var(--quiet);font-size:14px}
.facts dd{margin:2px 0 0;font-size:24px;line-height:1.25;font-weight:600;font-variant-numeric:tabular-nums}
.facts dd{overflow-wrap:anywhere}
.facts dd small{display:block;font-size:14px;font-weight:400;color:var(--quiet);line-height:1.45;margin-top:2px}
.notes{margin:24px 0 0;padding:14px 18px;border-radius:8px;background:var(--panel);border-left:4px solid var(--nominal)}
.notes h2{font-size:16px;letter-spacing:0}
.notes ul{margin:6px 0 0;padding-left:20px}
.notes li{margin:4px 0;max-width:75ch}
.picture{display:block;max-width:100%;height:auto}
.strip{display:grid;grid-template-columns:repeat(8,1fr);gap:2px}
.strip img{display:block;width:100%;height:auto}
.narrow{display:none}
.tiles{display:grid;grid-template-columns:repeat(auto-fill,minmax(270px,1fr));gap:24px 20px}
.tiles+.tiles{margin-top:24px}
.tiles svg{width:100%;max-width:400px}
.pair{display:grid;grid-template-columns:1fr 1fr;gap:32px 40px;align-items:start}
.bar{display:inline-block;max-width:none;vertical-align:middle;margin-right:8px}
table{border-collapse:collapse;width:100%;font-size:14px;margin-top:16px;font-variant-numeric:tabular-nums}
caption{text-align:left;color:var(--quiet);padding-bottom:6px}
th,td{text-align:left;vertical-align:top;padding:8px 14px 8px 0;border-bottom:1px solid var(--rule)}
thead th{color:var(--quiet);font-weight:500}
tbody th{font-weight:600}
.ranking .probability,.ranking .number,.flag{white-space:nowrap}
.ranking .numbers{min-width:16em}
.scroll{overflow-x:auto}
.mark{display:block;color:var(--quiet);font-weight:400;font-size:13px}
details{margin-top:14px}
summary{cursor:pointer;color:var(--found);width:fit-content;padding:4px 0}
summary:focus-visible{outline:2px solid var(--found);outline-offset:3px;border-radius:3px}
pre{margin:14px 0;padding:14px 16px;background:var(--panel);border-radius:8px;overflow-x:auto;font-size:14px;
line-height:1.5}
pre,code,kbd{font-family:ui-monospace,SFMono-Regular,Consolas,'DejaVu Sans Mono',monospace}
code{font-size:.92em}
kbd{font-size:.9em;background:var(--panel);
border:1px solid var(--rule);border-radius:5px;padding:2px 7px;white-space:nowrap}
.next{font-size:19px;line-height:1.5}
ul.plain{padding-left:20px;max-width:72ch}
ul.plain li{margin:5px 0}
footer{margin-top:56px;padding-top:18px;padding-bottom:48px;color:var(--quiet);font-size:14px}
@media screen and (max-width:720px){
main,header,footer{padding-left:16px;padding-right:16px}
header{padding-top:28px}
h1{font-size:27px}
.lead,.next{font-size:17px}
section{margin-top:40px}
.wide{display:none}
.narrow{display:block;width:100%;max-width:480px}
.pair{grid-template-columns:1fr}
.strip{grid-template-columns:repeat(4,1fr)}
.ranking thead{position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%)}
.ranking,.ranking caption,.ranking tbody,.ranking tr,.ranking th,.ranking td{display:block}
.ranking tr{padding:12px 0;border-bottom:1px solid var(--rule)}
.ranking th,.ranking td{border:0;padding:2px 0}
.ranking td:not(.probability)::before{content:attr(data-label) ': ';color:var(--quiet)}
.ranking td.numbers{padding-left:0;min-width:0}
.cards tr{display:grid;grid-template-columns:repeat(auto-fit,minmax(100px,1fr));gap:4px 14px}
.cards th{grid-column:1/-1}
.ranking.cards td:not(.probability)::before{content:attr(data-label);display:block;font-size:13px}
}
@media print{
body{font-size:10pt;line-height:1.4}
h1{font-size:22pt}
.lead,.next{font-size:12pt}
.tiles{grid-template-columns:repeat(3,1fr);gap:12pt}
.facts{grid-template-columns:repeat(3,1fr)}
header{padding-top:0}
main,header,footer{max-width:none;padding-left:0;padding-right:0}
section{margin-top:16pt;padding-top:8pt}
table{font-size:9pt}
th,td{padding:4pt 8pt 4pt 0}
.mark{font-size:8pt}
.ranking .numbers{min-width:0}
h3{margin:12pt 0 4pt}
h2,h3,figcaption{break-after:avoid}
.tiles svg,.pair svg,tr,.facts div,pre{break-inside:avoid}
.facts div,.notes,pre{border:1px solid var(--rule)}
details.more::details-content{content-visibility:visible;block-size:auto}
details:not(.more):not([open]){display:none}
summary{color:var(--quiet)}
}
"""


def page_style() -> str:
    """Return the CSS of a page and its pictures; it needs no escaping in HTML or XML."""
    return (
        f"{_variables('light')}body{{font-family:{FONT}}}"
        f"@media screen and (prefers-color-scheme:dark){{{_variables('dark')}}}{_PAGE.strip()}\n{picture_style()}"
    )


def _variables(palette: str) -> str:
    chosen = {
        k: v
        for k, v in PALETTES[palette].items()
        if k in ("paper", "panel", "ink", "quiet", "rule", "nominal", "found")
    }
    return f":root{{color-scheme:{palette};" + "".join(f"--{k}:{v};" for k, v in chosen.items()) + "}"
