# SPDX-License-Identifier: MIT
"""Requests and options of a reconstruction, with their ranges."""

from __future__ import annotations

import math
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from ..errors import InputError
from ..scene.equirectangular import FRAMES
from ..scene.model import SceneObject, Vector
from ..trust import UntrustedSpec
from ..validation import DEVICES, GROUND, quantity, require, require_quantities

SHAPES = ("auto", "inflated", "box", "cylinder", "sphere")
BACKS = ("auto", "symmetric", "flat")
UP_AXES = ("auto", "+x", "-x", "+y", "-y", "+z", "-z")
WITHOUT = "none"
"""A segmenter's name that stands for the weight-free way, also where a model is installed."""
Pixel = tuple[float, float]
Stroke = tuple[Pixel, ...]
MAX_STROKE_PLACES = 20_000
"""Places of all strokes of an object together."""


@dataclass(frozen=True, kw_only=True)
class ObjectRequest:
    """One object of the photo. Pixels are those of the upright photo (EXIF rotation applied).

    box: x0, y0, x1, y1, x1 and y1 exclusive; loose is fine. None uses the bounding box of ``mask``; one of the two is
        required.
    mask: a picture of the photo's size or aspect ratio, bright where the object is visible; replaces the segmentation.
    keep, drop: strokes over what certainly is, or is not, the object: polylines of pixels, for a box only.
    name: names the object's files; None gives object_1, object_2, … by position.
    kind: what the object is, in a word or two ("orange", "book"); sets material, thickness and roughness where these
        are not given. None: unknown.
    size_m: largest extent in metres, 1e-4 to 1e3; the first one given sets the scale of the whole scene.
    preset: material preset (presets/materials); None uses that of ``kind``, else medium.
    velocity: m/s; spin: rad/s; both at time 0.
    shape: ``box``, ``cylinder`` or ``sphere`` fits one; ``inflated`` inflates the mask; ``auto`` decides.
    back: the unseen side of an inflated body: mirrors the front (``symmetric``), or nothing (``flat``).
    thickness: depth over width of the body, 0.02 to 3; 1 makes a sphere of a disc. None estimates it.
    mesh: OBJ, GLB, PLY or STL file that is fitted to the photo in place of a reconstructed body.
    mesh_up: which axis of ``mesh`` points up; ``auto`` follows the file's format, or tries all.
    mesh_points: points on ``mesh`` (its own coordinates) and their pixels in the photo, to start the fit from.
    """

    box: tuple[float, float, float, float] | None = None
    mask: Path | None = None
    keep: tuple[Stroke, ...] = ()
    drop: tuple[Stroke, ...] = ()
    name: str | None = None
    kind: str | None = None
    size_m: float | None = quantity(None, 1e-4, 1e3, "metres")
    preset: str | None = None
    velocity: Vector = (0.0, 0.0, 0.0)
    spin: Vector = (0.0, 0.0, 0.0)
    shape: str = "auto"
    back: str = "auto"
    thickness: float | None = quantity(None, 0.02, 3.0, "a ratio")
    mesh: Path | None = None
    mesh_up: str = "auto"
    mesh_points: tuple[tuple[Vector, Pixel], ...] = ()

    def __post_init__(self) -> None:
        if self.box is None:
            require(self.mask is not None, "box", None, "give x0,y0,x1,y1 around the object, or a mask")
        else:
            require(
                len(self.box) == 4 and all(math.isfinite(v) for v in self.box),
                "box",
                self.box,
                "give x0,y0,x1,y1 as four finite numbers of pixels",
            )
        for name in ("keep", "drop"):
            _require_strokes(name, getattr(self, name))
        require_quantities(self, "")
        for name, choices in (("shape", SHAPES), ("back", BACKS), ("mesh_up", UP_AXES)):
            require(getattr(self, name) in choices, name, getattr(self, name), f"choose {', '.join(choices)}")
        for place, pixel in self.mesh_points:
            good = len(place) == 3 and len(pixel) == 2 and all(math.isfinite(v) for v in (*place, *pixel))
            require(good, "mesh_points", (place, pixel), "give x,y,z on the mesh and x,y in the photo")


@dataclass(frozen=True)
class Proposal:
    """An object that was found in a photo without a box.

    box: x0, y0, x1, y1 around it, loose, in pixels of the upright photo. score: 0 to 1, how likely it is an object.

    >>> import physgen
    >>> physgen.ObjectRequest(box=physgen.Proposal((215, 960, 475, 1190), 0.9).box).box
    (215, 960, 475, 1190)
    """

    box: tuple[float, float, float, float]
    score: float


def _require_strokes(name: str, strokes: Sequence[Stroke]) -> None:
    for stroke in strokes:
        good = len(stroke) > 0 and all(len(p) == 2 and all(math.isfinite(v) for v in p) for p in stroke)
        require(good, name, stroke if len(stroke) < 4 else "a stroke", "give finite pixels x,y,x,y,… along the stroke")
    count = sum(map(len, strokes))
    require(count <= MAX_STROKE_PLACES, name, f"{count} places", f"give at most {MAX_STROKE_PLACES} in all")


@dataclass(frozen=True, kw_only=True)
class ReconstructOptions:
    """Options of the reconstruction. The defaults suit a phone photo of objects on a table or floor.

    max_size: longest side of the working photo in pixels, 64 to 8192; larger photos are scaled down to it.
    fov_deg: angle of view along the photo's longer side, 5 to 150 degrees; None uses EXIF, else the vanishing points,
        else 50.
    horizon_y: height of the horizon as a fraction of the photo's height from the top, -10 to 0.95; may lie outside the
        photo. None estimates it.
    pitch_deg: angle of the optical axis below the horizontal, -20 to 85 degrees; an alternative to ``horizon_y``.
    roll_deg: rotation of the camera about its axis, -45 to 45 degrees; positive where the horizon falls to the right.
        None estimates it, 0 where nothing determines it.
    depth: depth map of the photo (.exr, .npy, .npz, .png of 16 bits, .pfm); determines ground and order.
    order: names of the objects from the front to the back; () estimates it.
    default_size_m: largest extent in metres of the first object when no object has a size, 1e-4 to 1e3.
    grabcut_iterations: iterations of GrabCut, 1 to 20.
    shadow_threshold: fixed grey value 0 to 255 below which ground is shadow (the paper uses 50); None compares with the
        ground around the object.
    hole_dilation: side in pixels of the dilation kernel for a photo of 1024 pixels, 0 to 300 (paper A.2: 50).
    patch_radius: PatchMatch compares patches of (2 r + 1)² pixels, 1 to 10.
    inpaint_pixels: largest number of pixels that PatchMatch searches for one hole, 1e4 to 1e8.
    seed: seed of PatchMatch; equal inputs give equal backgrounds.
    inpainter: an adapter (docs/extending.md) that replaces PatchMatch; None for the built-in inpainting. Likewise
        depth_estimator: the depth map; mesher: meshes of single objects.
    segmenter: an adapter that makes masks from boxes; None an installed model (``physgen models``), without one the
        weight-free way; ``none`` the weight-free way. Adapters that came with a file (``UntrustedSpec``) are not run
        (docs/security.md).
    mesh_vertices: target number of vertices of each object, 500 to 200000.
    friction: Coulomb coefficient of the ground, 0 to 10; None uses a model's answer, else 0.4.
    environment: .hdr or .exr file that replaces the environment estimated from the photo (sim/scene/environment).
    environment_frame: direction of its middle column: ``ahead`` of the camera, level; along the ``camera``'s axis, as
        maps by DiffusionLight are; or along +X of the ``world``.
    sun: False for none; True estimates it from the shadows, unless ``environment`` has one.
    report: also write ``report.html``, a page of pictures of every stage.
    """

    max_size: int = quantity(1920, 64, 8192, "pixels")
    fov_deg: float | None = quantity(None, 5, 150, "degrees")
    horizon_y: float | None = quantity(None, -10, 0.95, "a fraction of the photo's height")
    pitch_deg: float | None = quantity(None, -20, 85, "degrees")
    roll_deg: float | None = quantity(None, -45, 45, "degrees")
    depth: Path | None = None
    order: tuple[str, ...] = ()
    default_size_m: float = quantity(0.15, 1e-4, 1e3, "metres")
    grabcut_iterations: int = quantity(6, 1, 20, "rounds")
    shadow_threshold: float | None = quantity(None, 0, 255, "a grey value")
    hole_dilation: float = quantity(50.0, 0, 300, "pixels")
    patch_radius: int = quantity(4, 1, 10, "pixels")
    inpaint_pixels: int = quantity(2_800_000, 1e4, 1e8, "pixels")
    seed: int = quantity(0, 0, 2**32 - 1, "a whole number")
    inpainter: UntrustedSpec | str | None = None
    segmenter: UntrustedSpec | str | None = None
    depth_estimator: UntrustedSpec | str | None = None
    mesher: UntrustedSpec | str | None = None
    mesh_vertices: int = quantity(12_000, 500, 200_000, "vertices")
    friction: float | None = quantity(None, 0, 10, "a coefficient")
    environment: Path | None = None
    environment_frame: str = "ahead"
    sun: bool = True
    report: bool = False

    def __post_init__(self) -> None:
        require_quantities(self, "")
        frames = f"choose {', '.join(FRAMES)}"
        require(self.environment_frame in FRAMES, "environment_frame", self.environment_frame, frames)
        if self.horizon_y is not None and self.pitch_deg is not None:
            raise InputError(
                f"horizon_y is {self.horizon_y!r} and pitch_deg is {self.pitch_deg!r}: give one of them, not both"
            )


def object_names(objects: Sequence[ObjectRequest]) -> list[str]:
    """Return the names of ``objects``. Raises InputError for a name that is invalid, reserved or occurs twice.

    The objects' files are called by it, also on Windows and macOS.
    """
    names = [item.name or f"object_{number}" for number, item in enumerate(objects, start=1)]
    for name in names:
        # The scene model validates names; do it before any work is done.
        SceneObject(name=name, mesh="-", size_m=1.0)
        taken = "the ground is called that" if name == GROUND else "Windows has no file of that name"
        require(name.casefold() not in DEVICES | {GROUND}, "object.name", name, f"{taken}; choose another")
    folded = [unicodedata.normalize("NFC", name).casefold() for name in names]
    if len(set(folded)) < len(folded):
        raise InputError(f"objects are named {names!r}: give every object a name of its own")
    return names
