# SPDX-License-Identifier: MIT
"""The CSS of pages and of the pictures in them: font, palettes for light and dark, what is drawn in which colour."""

from __future__ import annotations

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
