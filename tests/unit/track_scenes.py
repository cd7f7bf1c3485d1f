# SPDX-License-Identifier: MIT
"""Tracking against videos whose truth is known: a textured cube or ball, drawn here, over a textured ground.

The drawing shares no code with the tracker: homographies for planes, rays for the ball, averaged over the exposure.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import trimesh
from physgen.sim.scene.folder import Scene, save_scene
from physgen.sim.scene.material import load_preset
from physgen.sim.scene.model import Camera, SceneModel, SceneObject
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 480, 360
SIDE = 0.10
FPS = 60.0
PITCH = np.radians(30.0)
LOOK_DOWN = (
    (1.0, 0.0, 0.0, 0.0),
    (0.0, -np.sin(PITCH), np.cos(PITCH), -0.5),
    (0.0, -np.cos(PITCH), -np.sin(PITCH), 0.35),
    (0.0, 0.0, 0.0, 1.0),
)
CAMERA = Camera(width=WIDTH, height=HEIGHT, fx=520.0, fy=520.0, cx=240.0, cy=180.0, world_from_camera=LOOK_DOWN)
REST_TURN = Rotation.from_euler("z", 0.5)
REST_PLACE = np.array([0.0, 0.0, SIDE / 2])


def texture(seed: int, size: int = 256, low: int = 30, high: int = 225) -> np.ndarray:
    """Blobs of several sizes, as on printed paper."""
    rng = np.random.default_rng(seed)
    total = sum(cv2.resize(rng.normal(size=(n, n)), (size, size), interpolation=cv2.INTER_CUBIC) for n in (6, 14, 30))
    total = (total - total.mean()) / total.std()
    return np.clip((low + high) / 2 + (high - low) / 3.2 * total, low, high).astype(np.float32)


@dataclasses.dataclass(frozen=True)
class Stage:
    """What is drawn. textures: of the cube's faces or the ball (first one)."""

    kind: str = "cube"
    textures: tuple = dataclasses.field(default_factory=lambda: tuple(texture(i) for i in range(6)))
    ground: np.ndarray = dataclasses.field(default_factory=lambda: texture(90, 512, 60, 160))
    camera: Camera = CAMERA

    def draw(self, turn: Rotation, place: np.ndarray, squash: float = 1.0, scale: int = 2) -> np.ndarray:
        """(H, W) float32 grey levels of the object at world pose (turn, place), a ball squashed along z."""
        camera = self.camera
        size = (camera.width * scale, camera.height * scale)
        picture = np.full(size[::-1], 90, np.float32)
        corners = np.array([[-0.6, -0.45, 0], [0.6, -0.45, 0], [0.6, 0.75, 0], [-0.6, 0.75, 0]])
        picture = self._plane(picture, self.ground, corners, size, scale)
        if self.kind == "cube":
            for axis in range(3):
                for sign in (-1, 1):
                    picture = self._face(picture, turn, place, axis, sign, size, scale)
        else:
            picture = self._ball(picture, turn, place, squash, scale)
        return cv2.resize(picture, (camera.width, camera.height), interpolation=cv2.INTER_AREA)

    def _plane(self, picture, image, corners, size, scale):
        n = image.shape[0]
        target = (self.camera.project(corners)[:, :2] * scale - 0.5).astype(np.float32)
        source = np.array([[-0.5, -0.5], [n - 0.5, -0.5], [n - 0.5, n - 0.5], [-0.5, n - 0.5]], np.float32)
        matrix = cv2.getPerspectiveTransform(source, target)
        drawn = cv2.warpPerspective(image, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        cover = np.zeros(picture.shape, np.uint8)
        cv2.fillConvexPoly(cover, np.round(target * 16).astype(np.int32), 1, shift=4)
        return np.where(cover > 0, drawn, picture)

    def _face(self, picture, turn, place, axis, sign, size, scale):
        normal = np.zeros(3)
        normal[axis] = sign
        world = turn.apply(normal)
        if (self.camera.position - (place + world * SIDE / 2)) @ world <= 0:
            return picture
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        corners = [normal + a * u + b * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        corners = turn.apply(np.array(corners) * SIDE / 2) + place
        shade = 0.75 + 0.25 * max(0.0, float(world @ [0.3, -0.5, 0.8]))
        return self._plane(picture, self.textures[2 * axis + (sign > 0)] * shade, corners, size, scale)

    def _ball(self, picture, turn, place, squash, scale):
        x, y, depth = self.camera.project(place)
        reach = 0.6 * SIDE * self.camera.fx / (depth - SIDE / 2)
        x0, y0 = (max(0, int((c - reach) * scale)) for c in (x, y))
        x1, y1 = (max(0, int((c + reach) * scale)) for c in (x, y))
        part = picture[y0:y1, x0:x1]
        if part.size == 0:
            return picture
        rows, columns = np.mgrid[y0 : y0 + part.shape[0], x0 : x0 + part.shape[1]]
        rays = self.camera.rays(np.stack([(columns + 0.5) / scale, (rows + 0.5) / scale], axis=-1))
        # Where the ball is round again.
        rays = rays / [1, 1, squash]
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        offset = (self.camera.position - place) / [1, 1, squash]
        b = rays @ offset
        inside = b**2 - offset @ offset + (SIDE / 2) ** 2
        points = offset + rays * (-b - np.sqrt(np.maximum(inside, 0)))[..., None]
        local = points @ turn.as_matrix() / (SIDE / 2)
        # Latitude and longitude about x, whose poles stay out of sight.
        n = self.textures[0].shape[0]
        across = ((np.arctan2(local[..., 2], local[..., 1]) / (2 * np.pi) + 0.5) * n).astype(np.float32)
        down = ((np.arcsin(np.clip(local[..., 0], -1, 1)) / np.pi + 0.5) * n).astype(np.float32)
        drawn = cv2.remap(self.textures[0], across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        picture = picture.copy()
        picture[y0:y1, x0:x1] = np.where(inside > 0, drawn, part)
        return picture


def toss(t: float) -> tuple[Rotation, np.ndarray]:
    """Rests for four frames, then flies up to the right and away, and tumbles."""
    t = max(0.0, t - 4.5 / FPS)
    place = REST_PLACE + np.array([0.25 * t, 0.1 * t, 1.6 * t - 4.905 * t**2])
    return Rotation.from_rotvec(np.array([1.5, 1.0, 2.0]) * t) * REST_TURN, place


def squashed(t: float) -> tuple[Rotation, np.ndarray, float]:
    """A soft ball that is pressed flat by a fifth while it stands, and comes back."""
    squash = 1 - 0.2 * np.sin(np.pi * np.clip(t * FPS - 3, 0, 20) / 20) ** 2
    return REST_TURN, REST_PLACE * [1, 1, squash], squash


def resting(t: float) -> tuple[Rotation, np.ndarray]:
    return REST_TURN, REST_PLACE


def film(stage, motion, frames, *, exposure=0.0, noise=2.0, fps=FPS, bar=None, seed=0):
    """Yields 8-bit grey frames. exposure: share of a frame's time, centred; bar: of time → x0, x1."""
    rng = np.random.default_rng(seed)
    pattern = texture(77, 512, 40, 200)
    for i in range(frames):
        parts = np.linspace(-0.5, 0.5, 5) * exposure if exposure else [0.0]
        picture = np.mean([stage.draw(*motion((i + part) / fps)) for part in parts], axis=0)
        if bar is not None:
            x0, x1 = bar(i / fps)
            a, b = max(0, round(x0)), min(picture.shape[1], round(x1))
            if b > a:
                picture[:, a:b] = pattern[: picture.shape[0], : b - a]
        yield np.clip(picture + rng.normal(0, noise, picture.shape), 0, 255).astype(np.uint8)


def write_video(path: Path, frames, *, fps=FPS, code="MJPG"):
    writer = None
    for frame in frames:
        if writer is None:
            size = (frame.shape[1], frame.shape[0])
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), fps, size)
            assert writer.isOpened()
        writer.write(cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR) if frame.ndim == 2 else frame)
    writer.release()
    return path


def make_scene(root: Path, stage: Stage, *, preset="wood", objects=("body",), **changes) -> Scene:
    """A perfect reconstruction: the mesh in millimetres, y up, in a frame of its own."""
    (root / "meshes").mkdir(parents=True)
    photo = np.clip(stage.draw(REST_TURN, REST_PLACE), 0, 255).astype(np.uint8)
    for name in ("photo.png", "background.png"):
        cv2.imwrite(str(root / name), photo)
    if stage.kind == "cube":
        mesh = trimesh.creation.box((100.0, 100.0, 100.0))
    else:
        mesh = trimesh.creation.icosphere(subdivisions=4, radius=50.0)
    mesh.export(root / "meshes/body.ply")
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = REST_TURN.as_matrix() * 1e-3, REST_PLACE
    items = tuple(
        SceneObject(
            name=name,
            mesh="meshes/body.ply",
            size_m=SIDE,
            world_from_mesh=tuple(map(tuple, matrix.tolist())),
            material=load_preset(preset),
        )
        for name in objects
    )
    return save_scene(root, SceneModel(**{"camera": stage.camera, "objects": items, **changes}))


def truth(trial, motion, camera=CAMERA) -> np.ndarray:
    """(T, K, 2): where the trial's rest points really are in the picture. The rest frame has the world's axes."""
    places = []
    for t in trial.times:
        turn, place, *squash = motion(t)
        moved = (turn * REST_TURN.inv()).apply(trial.rest_points) * [1, 1, *(squash or [1])]
        places.append(camera.project(moved + place)[:, :2])
    return np.array(places)


def errors(trial, motion) -> np.ndarray:
    """Distances in px of all points that are seen."""
    distance = np.linalg.norm(trial.pixels - truth(trial, motion), axis=2)
    return distance[np.isfinite(distance)]
