# SPDX-License-Identifier: MIT
"""Results of the composition benchmark as a table, as JSON and as a contact sheet."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

SIDE, LABEL = 192, 18
"""Pixels of a picture's side, and of the line of words above it."""

Picture = NDArray[np.floating]
Pixels = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, eq=False)
class Line:
    """One asset. Pictures are (H, W, 3) sRGB, 0 to 1; None leaves a place empty."""

    title: str
    truth: Picture
    start: Picture
    methods: Mapping[str, Picture | None]
    """By the method's name, in the order in which they are shown; every line has the same."""

    captions: Mapping[str, str] = field(default_factory=dict)
    """Captions of the methods' images, such as the PSNR."""


def contact_sheet(lines: Sequence[Line], path: Path) -> None:
    """Write the rows of ``lines`` as one PNG."""
    Image.fromarray(np.concatenate([_row(line) for line in lines])).save(path)


def _row(line: Line) -> Pixels:
    shown: list[tuple[str, Picture | None]] = [(line.title, line.truth), ("start", line.start)]
    shown += [(f"{name}  {line.captions.get(name, '')}".rstrip(), picture) for name, picture in line.methods.items()]
    return np.concatenate([_labelled(words, picture) for words, picture in shown], axis=1)


def _labelled(words: str, picture: Picture | None) -> Pixels:
    """(LABEL + SIDE, SIDE, 3): ``words`` above ``picture``."""
    tile = np.full((LABEL + SIDE, SIDE, 3), 255, np.uint8)
    cv2.putText(tile, words[:34], (5, LABEL - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.36, (60, 60, 60), 1, cv2.LINE_AA)
    if picture is not None:
        height, width = picture.shape[:2]
        scale = SIDE / max(height, width)
        method = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        size = (round(width * scale), round(height * scale))
        small = cv2.resize(np.asarray(picture, np.float32), size, interpolation=method)
        top, left = LABEL + (SIDE - size[1]) // 2, (SIDE - size[0]) // 2
        tile[top : top + size[1], left : left + size[0]] = np.rint(np.clip(small, 0, 1) * 255)
    tile[:, -1] = tile[-1] = 225
    return tile


METHODS = ("pse-sds", "sds", "ppps", "ppps+sds")
"""The paper's, and its three ablations."""

WINNER = METHODS[0]

PAPER_ABLATION_DB = {"pse-sds": 29.79, "sds": 29.13, "ppps": 25.02, "ppps+sds": 20.74}
"""PhyCAGE, Table 2: mean PSNR at the reference view on the authors' own assets."""

PAPER_COMPARISON_DB = {"Ours": 30.70, "Part123": 17.52, "ComboVerse": 16.22}
"""PhyCAGE, Table 1: the same against earlier work."""

WANTED_DB = PAPER_COMPARISON_DB["Ours"]
WANTED_PENETRATION = 0.01
"""At most this share of the penetration volume may be left."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """One method on one asset."""

    asset: str
    method: str

    psnr_reference: float
    """dB between the rendered composition and the input picture."""

    ssim_reference: float

    psnr_held_out: float
    """dB, the mean over the held-out views."""

    ssim_held_out: float

    penetration_before: float
    """Cubic metres of O1 within the foregrounds at the start."""

    penetration_after: float

    penetrating_before: float
    """Share of O1's points within the foregrounds at the start, 0 to 1."""

    penetrating_after: float

    stays_together: bool
    """Whether the asset is still one after 1 s of gravity."""

    cpu_s: float

    clip: float | None = None
    """CLIP score in % between held-out views and the input picture (the paper's CLIP_mv), with a user's weights."""

    @property
    def left(self) -> float:
        """Share of the penetration volume that is left; of none, nothing is left, or infinitely much."""
        if self.penetration_before > 0:
            return self.penetration_after / self.penetration_before
        return 0.0 if self.penetration_after <= 0 else math.inf


@dataclass(frozen=True, kw_only=True)
class Mean:
    """One method over all assets."""

    method: str
    assets: int
    psnr_reference: float
    ssim_reference: float
    psnr_held_out: float
    ssim_held_out: float
    left: float
    """Mean over the assets of the share of penetration volume left."""

    worst_left: float
    penetrating_after: float
    stay_together: int
    """Assets that do."""

    cpu_s: float
    clip: float | None


def means(rows: Sequence[Row]) -> tuple[Mean, ...]:
    """Of every method that has rows: ``METHODS`` first, then others by when they first occur."""
    found = dict.fromkeys(row.method for row in rows)
    order = [method for method in METHODS if method in found] + [m for m in found if m not in METHODS]
    return tuple(_mean([row for row in rows if row.method == method]) for method in order)


def _mean(rows: Sequence[Row]) -> Mean:
    def over(name: str) -> float:
        return math.fsum(getattr(row, name) for row in rows) / len(rows)

    scores = [row.clip for row in rows if row.clip is not None]
    return Mean(
        method=rows[0].method,
        assets=len(rows),
        psnr_reference=over("psnr_reference"),
        ssim_reference=over("ssim_reference"),
        psnr_held_out=over("psnr_held_out"),
        ssim_held_out=over("ssim_held_out"),
        left=over("left"),
        worst_left=max(row.left for row in rows),
        penetrating_after=over("penetrating_after"),
        stay_together=sum(row.stays_together for row in rows),
        cpu_s=over("cpu_s"),
        clip=math.fsum(scores) / len(scores) if len(scores) == len(rows) else None,
    )


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """Something that is wanted, and whether it is so."""

    wanted: str
    found: str
    good: bool


def verdicts(rows: Sequence[Row]) -> tuple[Verdict, ...]:
    """Return the requirements on the means with verdicts; empty without rows of PSE-SDS."""
    by_method = {mean.method: mean for mean in means(rows)}
    if WINNER not in by_method:
        return ()
    best = by_method[WINNER]
    others = [by_method[method] for method in METHODS[1:] if method in by_method]
    rival = max(others, key=lambda mean: mean.psnr_reference, default=None)
    ours = sorted((m for m in METHODS if m in by_method), key=lambda m: -by_method[m].psnr_reference)
    papers = sorted((m for m in METHODS if m in by_method), key=lambda m: -PAPER_ABLATION_DB[m])
    result = [
        Verdict(
            wanted=f"PSE-SDS at the reference view at least {WANTED_DB:.1f} dB",
            found=f"{best.psnr_reference:.2f} dB",
            good=best.psnr_reference >= WANTED_DB,
        ),
        Verdict(
            wanted=f"PSE-SDS leaves at most {WANTED_PENETRATION:.0%} of the penetration volume",
            found=f"{best.left:.2%}, {best.worst_left:.2%} at worst",
            good=best.left <= WANTED_PENETRATION,
        ),
    ]
    if rival is not None:
        ahead = best.psnr_reference - rival.psnr_reference
        result.insert(
            0, Verdict(wanted="PSE-SDS wins on PSNR", found=f"{ahead:+.2f} dB over {rival.method}", good=ahead > 0)
        )
        result.append(
            Verdict(wanted=f"the paper's order, {' > '.join(papers)}", found=" > ".join(ours), good=ours == papers)
        )
    return tuple(result)


HEAD = (
    "asset",
    "method",
    "PSNR",
    "SSIM",
    "held out",
    "SSIM",
    "before cm3",
    "after cm3",
    "left",
    "points in",
    "together",
    "CPU s",
)
MEAN_HEAD = ("method", "PSNR", "paper", "SSIM", "held out", "SSIM", "left", "worst", "points in", "together", "CPU s")


def cells(row: Row) -> tuple[str, ...]:
    """Return the cells of ``row`` in the table, under ``HEAD``."""
    return (
        row.asset,
        row.method,
        f"{row.psnr_reference:.2f}",
        f"{row.ssim_reference:.3f}",
        f"{row.psnr_held_out:.2f}",
        f"{row.ssim_held_out:.3f}",
        f"{1e6 * row.penetration_before:.3g}",
        f"{1e6 * row.penetration_after:.3g}",
        f"{row.left:.2%}",
        f"{row.penetrating_before:.1%} to {row.penetrating_after:.1%}",
        "yes" if row.stays_together else "NO",
        f"{row.cpu_s:.0f}",
    )


def mean_cells(mean: Mean) -> tuple[str, ...]:
    """The same of a method's means, under ``MEAN_HEAD``."""
    paper = PAPER_ABLATION_DB.get(mean.method)
    return (
        mean.method,
        f"{mean.psnr_reference:.2f}",
        "-" if paper is None else f"{paper:.2f}",
        f"{mean.ssim_reference:.3f}",
        f"{mean.psnr_held_out:.2f}",
        f"{mean.ssim_held_out:.3f}",
        f"{mean.left:.2%}",
        f"{mean.worst_left:.2%}",
        f"{mean.penetrating_after:.2%}",
        f"{mean.stay_together}/{mean.assets}",
        f"{mean.cpu_s:.0f}",
    )


def text(rows: Sequence[Row]) -> str:
    """For a terminal: every row, the means beside the paper's Table 2, its Table 1, and what is wanted."""
    earlier = ", ".join(f"{name} {value:.2f}" for name, value in PAPER_COMPARISON_DB.items())
    parts = [
        _aligned([HEAD, *(cells(row) for row in rows)], left=2),
        _aligned([MEAN_HEAD, *(mean_cells(mean) for mean in means(rows))], left=1),
        f"paper, Table 1, dB: {earlier}",
        "\n".join(f"{'yes' if v.good else 'NO ':3}  {v.wanted}: {v.found}" for v in verdicts(rows)),
    ]
    return "\n\n".join(part for part in parts if part)


def markdown(rows: Sequence[Row]) -> str:
    """The same for a page: means, the paper's figures, all rows."""
    earlier = ", ".join(f"{name} {value:.2f}" for name, value in PAPER_COMPARISON_DB.items())
    tables = [
        _piped([MEAN_HEAD, *(mean_cells(mean) for mean in means(rows))], left=1),
        f"The column *paper* is PhyCAGE's Table 2 in dB, on the authors' own assets; its Table 1: {earlier}.",
        _piped([HEAD, *(cells(row) for row in rows)], left=2),
    ]
    return "\n\n".join(tables) + "\n"


def document(rows: Sequence[Row]) -> dict[str, Any]:
    """For JSON: rows, means, verdicts and the paper's figures. What is not finite becomes null."""
    return {
        "rows": [_plain({**asdict(row), "left": row.left}) for row in rows],
        "means": [_plain(asdict(mean)) for mean in means(rows)],
        "verdicts": [asdict(verdict) for verdict in verdicts(rows)],
        "paper": {"table_1_psnr_db": PAPER_COMPARISON_DB, "table_2_psnr_db": PAPER_ABLATION_DB},
    }


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def _aligned(lines: Sequence[Sequence[str]], *, left: int) -> str:
    """Columns side by side, the first ``left`` of them flush left."""
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    shown = []
    for line in lines:
        padded = [c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(zip(line, widths, strict=True))]
        shown.append("  ".join(padded).rstrip())
    return "\n".join(shown)


def _piped(lines: Sequence[Sequence[str]], *, left: int) -> str:
    rule = ["---" if i < left else "---:" for i in range(len(lines[0]))]
    return "\n".join("| " + " | ".join(line) + " |" for line in (lines[0], rule, *lines[1:]))
