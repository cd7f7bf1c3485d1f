# SPDX-License-Identifier: MIT
"""Colours of the pictures in light and dark surroundings, as a style that a page or a file of its own carries.

Rules with plain colours instead of CSS variables, so that drawing programs without them show the pictures as well.
Nominal and found are vermilion and blue, which people with any kind of colour blindness tell apart; every one of them
also has its own line or place. Contrast of text is at least 4.5 to 1.
"""

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
    """CSS of all pictures. Dark only on screens: paper stays white."""
    return f"{_FIXED}{_colours('light')}@media screen and (prefers-color-scheme: dark){{{_colours('dark')}}}"


def _colours(name: str) -> str:
    palette = PALETTES[name]
    return "".join(f"{selector}{{{what}:{palette[colour]}}}" for selector, what, colour in _RULES)
