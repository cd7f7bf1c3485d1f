# SPDX-License-Identifier: MIT
"""All pictures of a diagnosis, as the page shows them and as files of their own."""

from __future__ import annotations

from dataclasses import dataclass

from ...page.markup import Picture, side_by_side
from ..capture import Capture
from ..diagnosis import Diagnosis
from .gap import bars_picture, growth_picture
from .object_picture import object_pictures
from .ranking import ranking_picture
from .timeline import is_root, timeline_picture
from .tracks_picture import MAX_TAKES, tracks_legend, tracks_pictures

_WIDE, _NARROW = 912.0, 340.0


@dataclass(frozen=True, kw_only=True)
class Pictures:
    """root: whether the timeline's vertical scale is a square root. tracks_seen: how the tracks are seen."""

    timeline_wide: Picture
    timeline_narrow: Picture
    root: bool
    objects: list[Picture]
    tracks: list[Picture]
    tracks_key: Picture
    tracks_seen: str
    bars: Picture
    growth: Picture
    ranking: Picture

    def files(self) -> dict[str, Picture]:
        """File name → picture."""
        found = {
            "timeline.svg": self.timeline_wide,
            "object.svg": side_by_side(
                self.objects,
                columns=2,
                gap=24,
                title="Where on the objects the simulation lacks something",
                description=" ".join(f"{p.title}: {p.description}" for p in self.objects),
            ),
            "ranking.svg": self.ranking,
            "gap.svg": side_by_side(
                [self.bars, self.growth],
                columns=2,
                gap=40,
                title="How far the gap closes",
                description=f"{self.bars.description} {self.growth.description}",
            ),
        }
        if self.tracks:
            found["tracks.svg"] = side_by_side(
                [*self.tracks, self.tracks_key],
                columns=3,
                gap=20,
                title="Observed and simulated motion",
                description=" ".join(f"{p.title}: {p.description}" for p in self.tracks),
            )
        return found


def draw(diagnosis: Diagnosis, capture: Capture) -> Pictures:
    """All pictures."""
    in_pixels = any(trial.pixels is not None for trial in capture.trials)
    tracks = tracks_pictures(diagnosis, capture)
    seen = "As the camera saw it." if in_pixels else "Seen from the side, across the main direction of motion."
    if len(diagnosis.trials) > len(tracks) >= MAX_TAKES:
        seen += f" The first {len(tracks)} takes of {len(diagnosis.trials)}."
    return Pictures(
        timeline_wide=timeline_picture(diagnosis, capture, width=_WIDE),
        timeline_narrow=timeline_picture(diagnosis, capture, width=_NARROW),
        root=is_root(diagnosis, capture),
        objects=object_pictures(diagnosis, capture),
        tracks=tracks,
        tracks_key=tracks_legend(diagnosis),
        tracks_seen=seen,
        bars=bars_picture(diagnosis),
        growth=growth_picture(diagnosis, capture),
        ranking=ranking_picture(diagnosis, width=640),
    )
