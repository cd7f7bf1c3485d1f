# SPDX-License-Identifier: GPL-3.0-or-later
"""``make demo``: a video from the coffee photo of scikit-image, made like that of any other photo."""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from ..physgen_addon.render.render_options import RenderOptions
from ..sim.app.add_drops import Drop
from ..sim.app.bake_options import BakeOptions
from ..sim.app.reconstruct import Physics
from ..sim.app.set_light import LightRequest
from ..sim.errors import InputError, PhysGenError
from ..sim.files import read_toml
from ..sim.reconstruct import ObjectRequest, ReconstructOptions
from ..sim.scene.model import Vector
from ..sim.validation import parse
from . import stages
from .terminal import Terminal, stop_signals

MAX_BYTES = 64 * 2**10
CONFIG = Path(__file__).resolve().parents[1] / "presets" / "demo" / "coffee.toml"


@dataclass(frozen=True, kw_only=True)
class ClipConfig:
    """Render options of the demo. samples, light_scale, orbit, motion_blur: as of ``RenderOptions``."""

    samples: int
    light_scale: float | None = None
    orbit: float = 0.0
    motion_blur: float = 0.5


@dataclass(frozen=True, kw_only=True)
class DemoConfig:
    """A photo from scikit-image and its physics; units as on the command line (docs/cli.md).

    overrides: ``OBJECT.FIELD=VALUE``, as of ``--set``. drops: what falls into the picture. clip: the render of
    ``make demo``; best: of ``make demo BEST=1``. light: as of ``physgen light``; None is the photo's estimate.
    """

    description: str
    photo: str
    boxes: tuple[tuple[float, float, float, float], ...]
    names: tuple[str, ...]
    sizes: tuple[float, ...]
    presets: tuple[str, ...]
    velocities: tuple[Vector, ...]
    pitch: float | None = None
    overrides: tuple[str, ...] = ()
    drops: tuple[Drop, ...] = ()
    light: LightRequest | None = None
    frames: int
    fps: float
    slow: float = 1.0
    quality: str = "standard"
    clip: ClipConfig
    best: ClipConfig


def load_config(path: Path = CONFIG) -> DemoConfig:
    """Return the demo's configuration. Raises InputError when it cannot be read."""
    try:
        return parse(DemoConfig, read_toml(path, MAX_BYTES, what="configuration"), str(path))
    except FileNotFoundError as error:
        raise InputError(f"{path}: {error}") from error


def shipped_photo(name: str) -> Path:
    """Return the path of a photo that scikit-image ships."""
    import skimage.data

    path = Path(skimage.data.__file__).with_name(f"{name}.png")
    if not path.is_file():
        raise InputError(f"{path}: scikit-image does not ship this photo; run `make setup` again")
    return path


def request(config: DemoConfig, out: Path, *, best: bool = False) -> stages.RunRequest:
    """Return the demo as a request from photo to video; best: the clip that the documentation shows."""
    clip = config.best if best else config.clip
    objects = tuple(
        ObjectRequest(box=box, name=name, size_m=size)
        for box, name, size in zip(config.boxes, config.names, config.sizes, strict=True)
    )
    return stages.RunRequest(
        photo=shipped_photo(config.photo),
        objects=objects,
        video=out / f"{config.photo}{'_best' if best else ''}.mp4",
        work=out,
        physics=Physics(presets=config.presets, velocities=config.velocities, overrides=config.overrides),
        reconstruct=ReconstructOptions(pitch_deg=config.pitch),
        bake=BakeOptions(frames=config.frames, fps=config.fps, slow=config.slow, quality=config.quality),
        render=RenderOptions(
            samples=clip.samples, light_scale=clip.light_scale, orbit=clip.orbit, motion_blur=clip.motion_blur
        ),
        drops=config.drops,
        light=config.light,
    )


def main() -> int:
    """Entry point of ``python -m physgen.batch.demo``; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("demo_out"))
    parser.add_argument("--best", action="store_true", help="the clip of the documentation: slower, better")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    started = time.monotonic()
    config = load_config()
    terminal = Terminal(as_json=options.json, expected_s=stages.expected_seconds(config.frames))
    terminal.line(config.description)
    try:
        with stop_signals() as stopped:
            video = stages.photo_to_video(request(config, options.out, best=options.best), terminal, stopped)
    except PhysGenError as error:
        terminal.error(type(error).__name__, str(error))
        return error.exit_code
    terminal({"event": "done", "video": str(video), "scene": str(options.out / "scene")})
    terminal.line(f"done in {time.monotonic() - started:.0f} s\nvideo: {video}\nscene: {options.out / 'scene'}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
