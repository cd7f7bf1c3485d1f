# SPDX-License-Identifier: MIT
"""A video of a disc that slides down a board, drawn here with a known friction of 0.2, and what `explain` finds.

python examples/video_to_cause.py WORK
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import physgen

FPS, PIXELS_PER_METRE, ANGLE, FRICTION, EDGE = 120.0, 300.0, 25.0, 0.2, 0.05


def film(path: Path) -> None:
    """Write the video: a green disc, 10 cm wide and 5 cm high, on a board of 25 degrees; 120 fps, played at 30 fps."""
    angle = np.radians(ANGLE)
    way = np.array([np.cos(angle), np.sin(angle)])
    up = np.array([way[1], -way[0]])
    wall = np.full((360, 480, 3), (190, 200, 205), np.uint8)
    board = np.array([40.0, 60.0]) - way * 200, np.array([40.0, 60.0]) + way * 700
    cv2.line(wall, *(tuple(int(v) for v in p) for p in board), (60, 80, 110), 3)
    rng = np.random.default_rng(1)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, (480, 360))
    pull = 9.81 * (np.sin(angle) - FRICTION * np.cos(angle))
    for k in range(84):
        middle = board[0] + way * (230 + PIXELS_PER_METRE * 0.5 * pull * (k / FPS) ** 2)
        middle = middle + up * (2 + PIXELS_PER_METRE * EDGE / 2)
        half = PIXELS_PER_METRE * EDGE / 2
        corners = [middle + 2 * a * half * way + b * half * up for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        frame = wall.copy()
        cv2.fillConvexPoly(frame, np.round(np.array(corners) * 16).astype(np.int32), (40, 150, 50), cv2.LINE_AA, 4)
        writer.write(np.clip(frame + rng.normal(0, 1.5, frame.shape), 0, 255).astype(np.uint8))
    writer.release()


def main(work: Path) -> physgen.Explanation:
    """Film, explain and print; return the explanation."""
    work.mkdir(parents=True, exist_ok=True)
    film(work / "slide.avi")
    video = physgen.VideoTrial(path=work / "slide.avi", fps_override=FPS)
    found = physgen.explain(video, "cylinder:diameter=0.1,height=0.05", out=work / "why")
    print(found.summary)
    print(f"closed on withheld time: {found.closed:.2f}; see {found.video}")
    return found


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "work"))
