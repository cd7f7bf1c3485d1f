# SPDX-License-Identifier: MIT
"""Depth maps of other programs: read, told apart, and the ground found in them."""

import functools
import io
import math
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.camera import ground_camera as cameras
from physgen.sim.reconstruct.camera.depth_map import read_depth
from physgen.sim.reconstruct.camera.ground_plane import fit_ground_plane
from PIL import Image

WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
PITCH, ROLL = math.radians(28), math.radians(-4)
CAMERA_HEIGHT = 0.6


def scene(noise=0.0, seed=0, pitch=PITCH, roll=ROLL):
    """Depth (H, W) in metres of a ground with a box in front of it and a wall far behind, and the mask of the box."""
    camera = cameras.camera_above_ground(WIDTH, HEIGHT, FOCAL, pitch, roll)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    depth = cameras.ground_depth(camera, camera.rays(np.stack([columns, rows], axis=-1))) * CAMERA_HEIGHT
    depth = np.minimum(depth, 2.5)
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[45:85, 60:100] = True
    depth[mask] = depth[84, 80]
    rng = np.random.default_rng(seed)
    return depth * np.exp(noise * rng.standard_normal(depth.shape)), mask


def points_of(depth):
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    x, y = (columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL
    return np.stack([x * depth, y * depth, depth], axis=-1).astype(np.float32)


def write_exr(path, values):
    values = np.asarray(values, np.float32).reshape(HEIGHT, WIDTH, -1)
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), oiio.ImageSpec(WIDTH, HEIGHT, values.shape[2], "float"))
    assert output.write_image(np.ascontiguousarray(values))
    output.close()


def write_pfm(path, values):
    data = np.asarray(values, "<f4")[::-1]
    path.write_bytes(f"Pf\n{WIDTH} {HEIGHT}\n-1.0\n".encode() + data.tobytes())


def write(path, depth):
    depth = np.asarray(depth, np.float32)
    if path.suffix == ".npy":
        np.save(path, depth)
    elif path.suffix == ".npz":
        np.savez_compressed(path, depth=depth)
    elif path.suffix == ".exr":
        write_exr(path, depth)
    elif path.suffix == ".pfm":
        write_pfm(path, depth)
    else:
        Image.fromarray((depth * 1000 + 0.5).astype(np.uint16)).save(path)


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".exr", ".pfm", ".png"])
def test_every_format_holds_the_same_depth(tmp_path, suffix):
    depth, _ = scene()
    path = tmp_path / f"metric{suffix}"
    write(path, depth)
    read = read_depth(path, WIDTH, HEIGHT)
    assert not read.disparity
    assert read.metric
    assert np.abs(read.values - depth).max() < 1e-3
    assert read_depth(path, 2 * WIDTH, 2 * HEIGHT).values.shape == (2 * HEIGHT, 2 * WIDTH)


def test_depth_without_a_unit_is_not_taken_for_metres(tmp_path):
    write(tmp_path / "map.npy", scene()[0])
    assert not read_depth(tmp_path / "map.npy", WIDTH, HEIGHT).metric


def test_point_maps_bring_their_focal_length(tmp_path):
    depth, _ = scene()
    np.save(tmp_path / "points.npy", points_of(depth))
    read = read_depth(tmp_path / "points.npy", 3 * WIDTH, 3 * HEIGHT)
    assert read.focal == pytest.approx(3 * FOCAL, rel=1e-4)
    assert not read.disparity


def test_moge_output_is_read(tmp_path):
    depth, mask = scene()
    known = ~mask
    intrinsics = np.array([[FOCAL / WIDTH, 0, 0.5], [0, FOCAL / HEIGHT, 0.5], [0, 0, 1]], np.float32)
    points = np.where(known[..., None], points_of(depth), np.inf)
    np.savez(tmp_path / "moge.npz", points=points, depth=points[..., 2], mask=known, intrinsics=intrinsics)
    read = read_depth(tmp_path / "moge.npz", WIDTH, HEIGHT)
    assert read.focal == pytest.approx(FOCAL, rel=1e-5)
    assert np.isnan(read.values[mask]).all()
    assert np.abs(read.values[known] - depth[known]).max() < 1e-5


def test_disparity_is_told_by_what_lies_below(tmp_path):
    depth, _ = scene(0.01)
    np.save(tmp_path / "map.npy", 40 / depth - 3)
    assert read_depth(tmp_path / "map.npy", WIDTH, HEIGHT).disparity
    np.save(tmp_path / "map.npy", depth)
    assert not read_depth(tmp_path / "map.npy", WIDTH, HEIGHT).disparity


@pytest.mark.parametrize(("pitch_deg", "roll_deg"), [(12.0, 0.0), (28.0, -6.0), (55.0, 5.0)])
@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_ground_of_a_depth_map(tmp_path, pitch_deg, roll_deg, noise):
    depth, mask = scene(noise, 1, math.radians(pitch_deg), math.radians(roll_deg))
    write(tmp_path / "metric.npy", depth)
    plane = fit_ground_plane(read_depth(tmp_path / "metric.npy", WIDTH, HEIGHT), FOCAL, [mask])
    assert plane is not None
    off_pitch, off_roll = math.degrees(plane.pitch) - pitch_deg, math.degrees(plane.roll) - roll_deg
    assert abs(off_pitch) < max(0.2, 2 * math.degrees(plane.pitch_sigma))
    assert abs(off_roll) < max(0.2, 2 * math.degrees(plane.roll_sigma))
    assert math.degrees(plane.pitch_sigma) < 3.0
    assert plane.camera_height == pytest.approx(CAMERA_HEIGHT, rel=0.03)


def test_the_table_counts_not_the_floor_beyond(tmp_path):
    table, mask = scene()
    camera = cameras.camera_above_ground(WIDTH, HEIGHT, FOCAL, PITCH, ROLL)
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    floor = cameras.ground_depth(camera, camera.rays(np.stack([columns, rows], axis=-1))) * 1.5
    # The table's edge is just behind the object: half of the picture is floor.
    depth = np.where(rows < 62, np.minimum(floor, 20.0), table)
    depth[mask] = table[mask]
    write(tmp_path / "metric.npy", depth)
    plane = fit_ground_plane(read_depth(tmp_path / "metric.npy", WIDTH, HEIGHT), FOCAL, [mask])
    assert plane.camera_height == pytest.approx(CAMERA_HEIGHT, rel=0.05)


def test_disparity_with_unknown_shift_is_honest_about_the_pitch(tmp_path):
    depth, mask = scene(0.005)
    np.save(tmp_path / "disp.npy", 7 / depth + 2)
    plane = fit_ground_plane(read_depth(tmp_path / "disp.npy", WIDTH, HEIGHT), FOCAL, [mask])
    assert abs(plane.roll - ROLL) < 2 * plane.roll_sigma
    assert abs(plane.pitch - PITCH) < 2 * plane.pitch_sigma
    assert plane.pitch_sigma > 2 * plane.roll_sigma
    assert not plane.metric


def test_no_ground_where_everything_is_a_wall(tmp_path):
    rng = np.random.default_rng(0)
    np.save(tmp_path / "metric.npy", 2.0 + 0.001 * rng.standard_normal((HEIGHT, WIDTH)))
    assert fit_ground_plane(read_depth(tmp_path / "metric.npy", WIDTH, HEIGHT), FOCAL, []) is None
    np.save(tmp_path / "metric.npy", rng.uniform(0.2, 5, (HEIGHT, WIDTH)))
    assert fit_ground_plane(read_depth(tmp_path / "metric.npy", WIDTH, HEIGHT), FOCAL, []) is None


def test_files_that_are_not_depth_maps_are_refused(tmp_path):
    depth, _ = scene()
    np.save(tmp_path / "map.npy", depth)
    with pytest.raises(InputError, match="aspect ratio"):
        read_depth(tmp_path / "map.npy", HEIGHT, WIDTH)
    np.save(tmp_path / "flat.npy", np.ones((HEIGHT, WIDTH)))
    with pytest.raises(InputError, match="no depth"):
        read_depth(tmp_path / "flat.npy", WIDTH, HEIGHT)
    np.savez(tmp_path / "other.npz", colour=depth)
    with pytest.raises(InputError, match="colour"):
        read_depth(tmp_path / "other.npz", WIDTH, HEIGHT)
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(tmp_path / "eight.png")
    with pytest.raises(InputError, match="8 bits"):
        read_depth(tmp_path / "eight.png", WIDTH, HEIGHT)
    with pytest.raises(InputError, match="no such file"):
        read_depth(tmp_path / "missing.exr", WIDTH, HEIGHT)
    with pytest.raises(InputError, match="jpg"):
        read_depth(tmp_path / "map.jpg", WIDTH, HEIGHT)
    np.save(tmp_path / "objects.npy", np.array([[{"a": 1}]], dtype=object), allow_pickle=True)
    with pytest.raises(InputError):
        read_depth(tmp_path / "objects.npy", WIDTH, HEIGHT)


def test_headers_that_ask_for_too_much_memory(tmp_path):
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": (10**7, 10**7)})
    (tmp_path / "vast.npy").write_bytes(header.getvalue())
    with pytest.raises(InputError, match="million"):
        read_depth(tmp_path / "vast.npy", WIDTH, HEIGHT)
    with zipfile.ZipFile(tmp_path / "vast.npz", "w") as archive:
        archive.writestr("depth.npy", header.getvalue())
    with pytest.raises(InputError, match="million"):
        read_depth(tmp_path / "vast.npz", WIDTH, HEIGHT)
    (tmp_path / "vast.pfm").write_bytes(b"Pf\n99999999 99999999\n-1\n")
    with pytest.raises(InputError, match="million"):
        read_depth(tmp_path / "vast.pfm", WIDTH, HEIGHT)


@functools.cache
def sound_file(suffix):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"map{suffix}"
        write(path, scene()[0])
        return path.read_bytes()


@settings(max_examples=80, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    suffix=st.sampled_from([".npy", ".npz", ".exr", ".pfm", ".png"]),
    edits=st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), max_size=10),
    # Headers are where the harm is.
    early=st.lists(st.tuples(st.integers(0, 160), st.integers(0, 255)), max_size=4),
    cut=st.floats(0, 1),
    garbage=st.binary(max_size=40),
)
def test_garbage_is_an_input_error_or_a_map(tmp_path, suffix, edits, early, cut, garbage):
    data = bytearray(sound_file(suffix))
    for place, value in edits:
        data[int(place * (len(data) - 1))] = value
    for place, value in early:
        data[min(place, len(data) - 1)] = value
    data = data[: int(cut * len(data)) + 1] + garbage if cut < 0.9 else data
    path = tmp_path / f"fuzz{suffix}"
    path.write_bytes(bytes(data))
    try:
        read = read_depth(path, WIDTH, HEIGHT)
    except InputError:
        return
    assert read.values.shape == (HEIGHT, WIDTH)
    fit_ground_plane(read, FOCAL, [])
