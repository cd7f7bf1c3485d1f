# SPDX-License-Identifier: MIT
"""Bakes packed for the way: small, near enough, frame 1 exact, and damage is one clear error."""

import dataclasses
import struct
import zlib

import numpy as np
import pytest
import trimesh
from physgen.batch.cli import main
from physgen.sim.app.pack_bake import PACKED_FILE, PackedCache, pack_bake, unpack_bake
from physgen.sim.cache.bake_check import check_bake
from physgen.sim.cache.bake_folder import Bake, BakedObject, load_bake, save_manifest
from physgen.sim.cache.pc2 import Pc2Writer
from physgen.sim.errors import InputError

from ..conftest import complete_manifest

BALL = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
FRAMES = 48


def wobble(sample):
    """A ball that falls, turns and wobbles, in metres."""
    t = sample / 24
    wave = 1 + 0.2 * np.exp(-2 * t) * np.sin(20 * t) * np.array([1, -0.5, -0.5])
    turn = trimesh.transformations.rotation_matrix(3 * t, (0, 1, 1))[:3, :3]
    ripple = 0.002 * np.sin(120 * BALL.vertices[:, :1] + 30 * t) * t
    return (BALL.vertices * wave + ripple) @ turn.T + [0.4 * t, 0, -0.5 * t * t]


@pytest.fixture
def baked(tmp_path):
    root = tmp_path / "bake"
    root.mkdir()
    with Pc2Writer(root / "ball.pc2", vertex_count=len(BALL.vertices)) as writer:
        for sample in range(FRAMES):
            writer.append(wobble(sample))
        checksum = writer.checksum("ball.pc2", ended=True)
    item = BakedObject(name="ball", file="ball.pc2", vertices=len(BALL.vertices))
    manifest = complete_manifest(item, frames=FRAMES, checksums=(checksum,))
    (root / "metrics.json").write_text("{}")
    save_manifest(root, manifest)
    return Bake(root=root, manifest=manifest)


def test_packed_it_is_small_and_near_enough(baked, tmp_path):
    size = pack_bake(baked, out=tmp_path / "packed")
    # A tenth is wanted, and missed where bodies ripple (docs/measurements.md); without folding it is a fifth.
    assert size < 0.18 * (baked.root / "ball.pc2").stat().st_size
    found = unpack_bake(tmp_path / "packed", out=tmp_path / "again")
    assert dataclasses.replace(found.manifest, checksums=baked.manifest.checksums) == baked.manifest
    assert (found.vertices("ball", 1) == baked.vertices("ball", 1)).all()
    for frame in range(2, FRAMES + 1):
        away = np.linalg.norm(found.vertices("ball", frame) - baked.vertices("ball", frame), axis=1)
        assert away.max() < 1e-3 * 0.1
    assert all(state.good for state in check_bake(found))


def test_files_packed_before_numbers_were_folded_still_open(tmp_path):
    """Two samples of two points, a millimetre a step, the second by the speed of the first, which is none."""
    first = np.array([[0, 0, 0], [1, 2, 3]], "<f4")
    rest = np.array([[-1, 300, 0], [5, 0, -2]], "<i2")
    planes = rest.T.copy().view(np.uint8).reshape(-1, 2).T.tobytes()
    content = struct.pack("<12siif3dd", b"PHYSGENPACK1", 2, 2, 1.0, 0.0, 0.0, 0.0, 1e-3)
    for kind, data in ((0, zlib.compress(first.tobytes())), (2, zlib.compress(planes))):
        content += struct.pack("<BI", kind, len(data)) + data
    (tmp_path / "old.packed").write_bytes(content)
    _, second = PackedCache(tmp_path / "old.packed").samples()
    np.testing.assert_allclose(second, first + 1e-3 * rest, atol=1e-6)


def test_the_command_packs_and_unpacks(baked, tmp_path):
    assert main(["pack", str(baked.root), "--out", str(tmp_path / "p")]) == 0
    assert main(["pack", str(tmp_path / "p"), "--unpack", "--out", str(tmp_path / "u")]) == 0
    assert load_bake(tmp_path / "u").last_frame == FRAMES
    assert main(["pack", str(baked.root), "--out", str(tmp_path / "p")]) == 3  # is there already
    assert main(["pack", str(baked.root), "--unpack", "--out", str(tmp_path / "v")]) == 3  # is not packed
    assert not (tmp_path / "v").exists()


def test_what_is_damaged_is_refused_and_leaves_nothing(baked, tmp_path):
    pack_bake(baked, out=tmp_path / "packed")
    path = tmp_path / "packed" / "ball.pc2.packed"
    whole, random = path.read_bytes(), np.random.default_rng(0)
    for _ in range(40):
        content = bytearray(whole)
        for at in random.integers(0, len(content), 3):
            content[at] ^= int(random.integers(1, 256))
        path.write_bytes(content[: random.integers(20, len(content) + 1)])
        with pytest.raises(InputError, match="not what was packed"):
            unpack_bake(tmp_path / "packed", out=tmp_path / "again")
        # The reader itself is no less careful.
        try:
            for sample in PackedCache(path).samples():
                assert sample.shape == BALL.vertices.shape
        except InputError:
            pass
    path.unlink()
    with pytest.raises(InputError, match="missing"):
        unpack_bake(tmp_path / "packed", out=tmp_path / "again")
    (tmp_path / "packed" / PACKED_FILE).write_text('{"format": "physgen-packed-bake/1", "sums": {}, "manifest": 3}')
    with pytest.raises(InputError):
        unpack_bake(tmp_path / "packed", out=tmp_path / "again")
    assert not (tmp_path / "again").exists()


def test_an_unfinished_bake_is_not_packed(baked, tmp_path):
    with pytest.raises(InputError, match="only a complete bake"):
        pack_bake(
            Bake(root=baked.root, manifest=dataclasses.replace(baked.manifest, state="cancelled")), out=tmp_path / "p"
        )
