# SPDX-License-Identifier: GPL-3.0-or-later
"""Compositor nodes of a photo scene: untouched they give the product's frame, touched they change their layer alone."""

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")
from physgen.physgen_addon.frames.frame_files import read_picture, write_frame
from physgen.physgen_addon.render import look_nodes
from physgen.physgen_addon.render.render_options import FrameFormat
from physgen.physgen_addon.render.renderer import DataLayers
from physgen.sim.composite.compositing import FrameLayers, ObjectLayer, compose
from physgen.sim.errors import InputError
from physgen.sim.srgb import linear_to_bytes

pytestmark = [
    pytest.mark.skipif(not look_nodes.available(), reason="compositor node groups are Blender 5.0's"),
    pytest.mark.usefixtures("addon"),
]

WIDTH, HEIGHT = 48, 32
NAMES = ["cup", "ball é"]


def layers(seed):
    """A frame with everything that is hard: soft outlines, shadows deeper than any is divided by, whites, grain."""
    rng = np.random.default_rng(seed)

    def noise(*channels):
        return rng.random((HEIGHT, WIDTH, *channels), dtype=np.float32)

    y, x = np.mgrid[:HEIGHT, :WIDTH]
    alpha = np.clip(9.5 - np.hypot(x - 14 - seed, y - 15), 0, 1) + np.clip(6.5 - np.hypot(x - 36, y - 16), 0, 1)
    alpha = alpha.astype(np.float32)
    objects = ObjectLayer(texture=noise(3) * alpha[..., None], alpha=alpha, light=0.5 + noise(3))
    shadow = np.where(y[..., None] < 8, 0.03 * noise(3), 0.1 + noise(3)).astype(np.float32)
    ground = (noise(3) * shadow + 0.01).astype(np.float32)
    beauty = (compose(objects, ground) + 0.04 * (noise(3) - 0.5)).astype(np.float32)
    number = np.where(alpha > 0.5, np.where(x < 26, 1, 2), 0).astype(np.float32)
    data = DataLayers(depth=noise(), object_id=number, flow=noise(4))
    return FrameLayers(ground=ground, shadow=shadow, objects=objects, beauty=beauty), data


def a_clip(folder, count=3):
    folder.mkdir()
    frames, truth = [], []
    for number in range(5, 5 + count):
        found, data = layers(number)
        path = folder / f"{number:04d}.exr"
        write_frame(path, found, data, FrameFormat(kind="exr-layers"), fps=24.0, names=NAMES)
        frames.append(path)
        truth.append(found)
    return frames, truth


def a_scene():
    scene = bpy.context.scene
    scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = WIDTH, HEIGHT, 100
    scene.view_settings.view_transform = "Standard"
    return scene


def rendered(scene, frame, folder):
    """What Blender's own Render Image writes, (H, W, 3) of 8 bits."""
    scene.frame_set(frame)
    scene.render.image_settings.file_format, scene.render.filepath = "PNG", str(folder / "out.png")
    bpy.ops.render.render(write_still=True)
    return read_picture(folder / "out.png").astype(int)


def node(tree, label):
    return next(item for item in tree.nodes if item.label == label)


def test_untouched_nodes_give_the_frame_itself(tmp_path):
    frames, truth = a_clip(tmp_path / "frames")
    scene = a_scene()
    look_nodes.add_look_nodes(scene, frames, first_frame=11)
    for frame, found in zip((11, 13), (truth[0], truth[2]), strict=True):
        difference = np.abs(rendered(scene, frame, tmp_path) - linear_to_bytes(found.beauty).astype(int))
        assert difference.max() <= 1, (frame, difference.max(), np.argwhere(difference > 1)[:5])


def test_each_layer_is_graded_alone(tmp_path):
    frames, truth = a_clip(tmp_path / "frames", 1)
    scene = a_scene()
    tree = look_nodes.add_look_nodes(scene, frames, first_frame=1)
    before, found = rendered(scene, 1, tmp_path), truth[0]
    alpha, shadow = found.objects.alpha, np.maximum(found.shadow, look_nodes.LEAST_SHADOW)
    node(tree, "Objects Exposure").inputs["Exposure"].default_value = 1.0
    after = rendered(scene, 1, tmp_path)
    assert (after == before)[alpha == 0].all()
    wanted = found.beauty + found.objects.texture * found.objects.light
    assert np.abs(after - linear_to_bytes(wanted).astype(int)).max() <= 1
    node(tree, "Objects Exposure").inputs["Exposure"].default_value = 0.0
    node(tree, "Shadow Strength").inputs["Gamma"].default_value = 0.5
    after = rendered(scene, 1, tmp_path)
    assert (after == before)[alpha == 1].all()
    wanted = found.beauty + (1 - alpha[..., None]) * found.ground * (shadow**-0.5 - 1)
    assert np.abs(after - linear_to_bytes(wanted).astype(int)).max() <= 1


def test_masks_are_the_objects_own(tmp_path):
    frames, _ = a_clip(tmp_path / "frames", 1)
    scene = a_scene()
    tree = look_nodes.add_look_nodes(scene, frames, first_frame=1)
    first = next(item for item in tree.nodes if getattr(item, "node_tree", None) and "Mask cup" in item.outputs)
    out = next(item for item in tree.nodes if item.bl_idname == "NodeGroupOutput")
    number = layers(5)[1].object_id
    for index, name in enumerate(NAMES, start=1):
        tree.links.new(first.outputs[f"Mask {name}"], out.inputs["Image"])
        assert (rendered(scene, 1, tmp_path)[..., 0] == np.where(number == index, 255, 0)).all(), name


def test_again_keeps_what_was_added_and_another_tree_is_not_lost(tmp_path):
    frames, _ = a_clip(tmp_path / "frames", 2)
    scene = a_scene()
    other = bpy.data.node_groups.new("mine", "CompositorNodeTree")
    scene.compositing_node_group = other
    tree = look_nodes.add_look_nodes(scene, frames[:1], first_frame=1)
    assert other.use_fake_user and scene.compositing_node_group == tree
    mine = tree.nodes.new("CompositorNodeExposure")
    mine.label = "my own"
    links = len(tree.links)
    groups = len(bpy.data.node_groups)
    assert look_nodes.add_look_nodes(scene, frames, first_frame=1) == tree
    assert node(tree, "my own") and len(tree.links) == links and len(bpy.data.node_groups) == groups


def test_frames_without_layers_and_of_another_size_are_refused(tmp_path):
    found, data = layers(1)
    flat = tmp_path / "0001.exr"
    write_frame(flat, found, None, FrameFormat(kind="exr"), fps=24.0, names=NAMES)
    scene = a_scene()
    with pytest.raises(InputError, match=r"has no beauty, ground, .*EXR Layers"):
        look_nodes.add_look_nodes(scene, [flat], first_frame=1)
    write_frame(flat, found, data, FrameFormat(kind="exr-layers"), fps=24.0, names=NAMES)
    scene.render.resolution_percentage = 50
    with pytest.raises(InputError, match=r"has 48x32 pixels and the scene renders 24x16; .* Size of 50 %"):
        look_nodes.add_look_nodes(scene, [flat], first_frame=1)
    flat.write_bytes(b"nothing of the kind")
    with pytest.raises(InputError, match="is no EXR file"):
        look_nodes.add_look_nodes(scene, [flat], first_frame=1)
    assert scene.compositing_node_group is None


def test_the_panels_button_takes_the_frames_that_were_rendered(tmp_path):
    scene = a_scene()
    rendering, simulation = scene.physgen.rendering, scene.physgen.simulation
    assert not bpy.ops.physgen.look_nodes.poll()
    frames, truth = a_clip(tmp_path / "out", 3)
    scene.physgen.folder, rendering.output = str(tmp_path), str(tmp_path / "out")
    rendering.format, rendering.result, simulation.frame_start = "exr_layers", str(frames[0]), 21
    assert bpy.ops.physgen.look_nodes() == {"FINISHED"}
    difference = np.abs(rendered(scene, 25, tmp_path) - linear_to_bytes(truth[0].beauty).astype(int))
    assert difference.max() <= 1, "file 5 is the fifth sample, and the bake begins at frame 21"
    for path in frames:
        path.unlink()
    with pytest.raises(RuntimeError, match=r"no frames with layers"):
        bpy.ops.physgen.look_nodes()
