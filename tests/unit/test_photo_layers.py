# SPDX-License-Identifier: MIT
"""One thing in front of another, and one on another: the whole reconstruction."""

import numpy as np
import pytest
from physgen.sim.errors import InputError
from physgen.sim.reconstruct import ObjectRequest, ReconstructOptions, reconstruct_photo
from physgen.sim.reconstruct.segmentation.object_masks import _distinct
from physgen.sim.scene.folder import load_scene
from physgen.sim.scene.meshes import load_object_mesh
from PIL import Image

QUICK = ReconstructOptions(mesh_vertices=1200, pitch_deg=25.0, patch_radius=3, sun=False)
ROWS, COLUMNS = np.mgrid[:200, :280] + 0.5


@pytest.fixture(autouse=True)
def quick_backgrounds(first_fill):
    """What is behind them is not looked at."""


def photo_of(*layers):
    """Layers (mask, colour) over a floor, the last one in front."""
    rng = np.random.default_rng(5)
    image = np.full((200, 280, 3), (196.0, 186, 170)) + rng.normal(scale=4, size=(200, 280, 1))
    for mask, colour in layers:
        image[mask] = np.array(colour) + rng.normal(scale=5, size=(int(mask.sum()), 3))
    return Image.fromarray(np.clip(image, 0, 255).astype(np.uint8))


def mask_of(path):
    return np.asarray(Image.open(path)) > 0


def overlap(first, second):
    return (first & second).sum() / (first | second).sum()


def test_part_hidden_by_a_ball_is_completed(tmp_path):
    crate = (np.abs(COLUMNS - 150) < 45) & (np.abs(ROWS - 85) < 40)
    ball = (COLUMNS - 110) ** 2 + (ROWS - 118) ** 2 < 26**2
    photo_of((crate, (60, 90, 170)), (ball, (200, 60, 40))).save(tmp_path / "photo.png")
    requests = [
        ObjectRequest(box=(97, 38, 203, 132), name="crate", shape="inflated"),
        ObjectRequest(box=(78, 86, 142, 150), name="ball", shape="inflated"),
    ]
    said = []
    reconstruct_photo(tmp_path / "photo.png", requests, tmp_path / "scene", QUICK, said.append)
    scene = load_scene(tmp_path / "scene").model
    assert [item.occlusion_order for item in scene.objects] == [1, 0]
    full = mask_of(tmp_path / "scene" / "full" / "crate.png")
    seen = mask_of(tmp_path / "scene" / "masks" / "crate.png")
    assert overlap(seen, crate & ~ball) > 0.95
    assert overlap(full & ~seen, crate & ball) > 0.7
    assert not (tmp_path / "scene" / "full" / "ball.png").exists()
    messages = " ".join(event.get("message", "") for event in said)
    assert "ball is in front of crate" in messages and "% of it is hidden" in messages


@pytest.mark.long
def test_a_toy_on_a_chair_stands_on_the_chair(tmp_path):
    chair = (np.abs(COLUMNS - 140) < 60) & (np.abs(ROWS - 110) < 55)
    toy = (COLUMNS - 140) ** 2 + (ROWS - 85) ** 2 < 20**2
    photo_of((chair, (120, 80, 50)), (toy, (230, 200, 60))).save(tmp_path / "photo.png")
    requests = [
        ObjectRequest(box=(70, 48, 210, 172), name="chair", size_m=0.8, shape="box"),
        ObjectRequest(box=(112, 58, 168, 112), name="toy", shape="inflated"),
    ]
    reconstruct_photo(tmp_path / "photo.png", requests, tmp_path / "scene", QUICK)
    folder = load_scene(tmp_path / "scene")
    full = mask_of(tmp_path / "scene" / "full" / "chair.png")
    assert overlap(full, chair) > 0.95
    heights = [load_object_mesh(folder, item).vertices[:, 2].min() for item in folder.model.objects]
    assert heights[0] == pytest.approx(0.0, abs=1e-6)
    # Somewhere up the chair, not on the floor behind it.
    assert 0.05 < heights[1] < 0.8


def test_of_outlines_that_overlap_the_one_within_the_other_keeps_its_pixels():
    chair, toy = np.zeros((2, 40, 40), dtype=bool)
    chair[5:35, 5:35] = True
    toy[10:20, 10:20] = True
    first, second = _distinct([chair, toy], ["chair", "toy"], [False, False])
    assert (second == toy).all() and (first == (chair & ~toy)).all()
    with pytest.raises(InputError, match="same object"):
        _distinct([chair, chair | toy], ["a", "b"], [False, False])


@pytest.mark.long
def test_the_order_that_was_told_counts(tmp_path):
    left = (np.abs(COLUMNS - 90) < 30) & (np.abs(ROWS - 100) < 40)
    right = (np.abs(COLUMNS - 190) < 30) & (np.abs(ROWS - 110) < 40)
    photo_of((left, (60, 90, 170)), (right, (200, 60, 40))).save(tmp_path / "photo.png")
    boxes = {"a": (52, 52, 128, 148), "b": (152, 62, 228, 158)}
    requests = [ObjectRequest(box=box, name=name, shape="inflated") for name, box in boxes.items()]
    told = ReconstructOptions(mesh_vertices=800, pitch_deg=25.0, patch_radius=3, sun=False, order=("a", "b"))
    scene = reconstruct_photo(tmp_path / "photo.png", requests, tmp_path / "scene", told).model
    assert [item.occlusion_order for item in scene.objects] == [0, 1]
