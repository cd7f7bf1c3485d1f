# SPDX-License-Identifier: GPL-3.0-or-later
"""Files of frames, sequences of them, contact sheets, and what ``physgen encode`` refuses."""

import itertools
import json
import subprocess
import sys

import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.batch import cli
from physgen.physgen_addon.frames.contact_sheet import played, write_contact_sheet
from physgen.physgen_addon.frames.frame_files import Part, encoded, read_layers, read_picture, write_exr, write_png
from physgen.physgen_addon.frames.frame_index import FrameIndex, gather_frames
from physgen.physgen_addon.render.render_options import FrameFormat
from physgen.sim.errors import InputError
from physgen.sim.srgb import bytes_to_linear
from PIL import Image

PIXELS = np.random.default_rng(3).integers(0, 256, (12, 20, 3), dtype=np.uint8)
LINEAR = bytes_to_linear(PIXELS)


@pytest.mark.parametrize("bits", [8, 16])
def test_png_keeps_every_pixel(tmp_path, bits):
    path = tmp_path / "new" / "0001.png"
    write_png(path, encoded(LINEAR, bits))
    assert np.array_equal(read_picture(path), PIXELS)
    with Image.open(path) as image:
        assert np.abs(np.asarray(image.convert("RGB")).astype(int) - PIXELS).max() <= (bits == 16)
    spec = oiio.ImageInput.open(str(path)).spec()
    assert (spec.format, spec["oiio:ColorSpace"].startswith("s")) == (oiio.TypeDesc(f"uint{bits}"), True)


def test_exr_parts_come_back_with_their_names_and_what_is_said_of_them(tmp_path):
    far = np.full((12, 20, 1), 1e10, np.float32)
    beauty = Part(name="beauty", channels=("R", "G", "B"), pixels=LINEAR)
    depth = Part(name="depth", channels=("depth.Z",), pixels=far, bits=32, attributes={"physgen:note": "größer"})
    write_exr(tmp_path / "0001.exr", [beauty, depth], fps=23.976)
    assert np.array_equal(read_picture(tmp_path / "0001.exr"), PIXELS)
    source = oiio.ImageInput.open(str(tmp_path / "0001.exr"))
    first = source.spec()
    assert (first["name"], first.channelnames, first.format) == ("beauty", ("R", "G", "B"), oiio.HALF)
    assert tuple(first["FramesPerSecond"]) == (24000, 1001)
    assert first["chromaticities"][:2] == pytest.approx((0.64, 0.33))
    assert "rec709" in first["oiio:ColorSpace"]
    assert source.seek_subimage(1, 0)
    second = source.spec()
    assert (second["name"], second["physgen:note"], second.format) == ("depth", "größer", oiio.FLOAT)
    assert np.array_equal(source.read_image(1, 0, 0, 1, oiio.FLOAT), far)
    source.close()
    # No time of writing: the same picture is the same file.
    assert not first.get_string_attribute("DateTime")


FULL_DISK = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from physgen.physgen_addon.frames.frame_files import Part, write_exr, write_png
from physgen.sim.errors import InputError
noise = np.random.default_rng(0).integers(0, 256, (90, 90, 3), dtype=np.uint8)
part = Part(name="beauty", channels=("R", "G", "B"), pixels=noise / np.float32(255))
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (4000, 4000))
writers = {"a.png": lambda path: write_png(path, noise), "a.exr": lambda path: write_exr(path, [part], fps=24)}
for name, write in writers.items():
    try:
        write(Path(sys.argv[1]) / name)
    except InputError as error:
        assert "free space" in str(error), error
        continue
    sys.exit(f"{name} was taken for written")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no limit on the size of a file")
def test_a_full_disk_leaves_no_half_of_a_frame(tmp_path):
    done = subprocess.run([sys.executable, "-c", FULL_DISK, str(tmp_path)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert not list(tmp_path.iterdir())


def test_unreadable_frames_are_named(tmp_path):
    write_png(tmp_path / "0001.png", PIXELS)
    content = (tmp_path / "0001.png").read_bytes()
    (tmp_path / "0001.png").write_bytes(content[: len(content) // 2])
    (tmp_path / "0002.exr").write_bytes(b"nothing")
    for name in ("0001.png", "0002.exr", "0003.png"):
        with pytest.raises(InputError, match=name):
            read_picture(tmp_path / name)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A PNG and an EXR of two parts, as bytes by suffix."""
    folder = tmp_path_factory.mktemp("whole")
    parts = [
        Part(name="a", channels=("R", "G", "B"), pixels=LINEAR),
        Part(name="b", channels=("b.Z",), pixels=LINEAR[..., :1]),
    ]
    write_png(folder / "1.png", PIXELS)
    write_exr(folder / "1.exr", parts, fps=24.0)
    return folder, {suffix: (folder / f"1{suffix}").read_bytes() for suffix in (".png", ".exr")}


@given(suffix=st.sampled_from([".png", ".exr"]), data=st.data())
def test_damaged_frames_are_refused_or_read_but_break_nothing(whole, suffix, data):
    folder, contents = whole
    content = bytearray(contents[suffix])
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = folder / f"damaged{suffix}"
    path.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    try:
        pixels = read_picture(path)
    except InputError as error:
        assert path.name in str(error) and "\n" not in str(error)
    else:
        assert pixels.ndim == 3 and pixels.shape[2] == 3 and pixels.dtype == np.uint8
    try:
        channels = read_layers(path)
    except InputError as error:
        assert path.name in str(error) and "\n" not in str(error)
    else:
        assert all(channel.ndim == 2 for channel in channels.values())


def test_bytes_that_are_no_text_in_a_damaged_header_are_named(whole):
    folder, contents = whole
    path = folder / "header.exr"
    path.write_bytes(contents[".exr"].replace(b"chlist", b"\xff\xfe\xfdist"))
    for read in (read_layers, read_picture):
        with pytest.raises(InputError, match=r"header\.exr"):
            read(path)


@pytest.mark.parametrize(
    ("values", "words"),
    [({"kind": "gif"}, "format is 'gif'"), ({"bits": 32}, "8 or 16"), ({"kind": "exr", "bits": 8}, "16 or 32")],
)
def test_formats_that_are_none(values, words):
    with pytest.raises(InputError, match=words):
        FrameFormat(**values)


def frames(folder, numbers, *, fps=None, suffix=".png"):
    """A folder of tiny frames as rendering leaves it, each of another grey."""
    ledger = FrameIndex(folder, suffix=suffix, fps=fps)
    for number in numbers:
        write_png(ledger.path(number), np.full((30, 40, 3), 9 * number, np.uint8))
        ledger.record(number, "inputs")
    return folder


def test_chunks_are_one_sequence(tmp_path):
    late, early = frames(tmp_path / "b", [4, 5], fps=30.0), frames(tmp_path / "a", [1, 2, 3], fps=30.0)
    found = gather_frames([late, early])
    assert found.numbers == (1, 2, 3, 4, 5)
    assert [path.parent for path in found.paths] == [early] * 3 + [late] * 2
    assert found.fps == found.own_fps == 30.0
    # Every other frame at half the rate: things move as fast as they did.
    thinned = gather_frames([late, early], frames="1-5x2")
    assert (thinned.numbers, thinned.own_fps) == ((1, 3, 5), 15.0)


def test_sequences_that_are_refused(tmp_path):
    whole = frames(tmp_path / "whole", range(1, 5), fps=24.0)
    gap = frames(tmp_path / "gap", [5, 9], fps=25.0)
    (tmp_path / "empty").mkdir()
    for folders, arguments, words in (
        ([whole, whole], {}, "frame 1 is there twice"),
        ([gap], {}, "frames 6, 7, 8 of 5 to 9: not in"),
        ([gap], {"frames": "5-7", "allow_gaps": False}, "frames 6, 7"),
        ([gap], {"frames": "6-7", "allow_gaps": True}, "none of them"),
        ([whole], {"frames": "3-9"}, "frames 1 to 4 are rendered"),
        ([whole, gap], {"allow_gaps": True}, "24 frames a second, .* at 25"),
        ([tmp_path / "empty"], {}, "holds no frames"),
        ([tmp_path / "none"], {}, "no folder of frames"),
    ):
        with pytest.raises(InputError, match=words):
            gather_frames(folders, **arguments)
    assert gather_frames([gap], allow_gaps=True).numbers == (5, 9)
    (whole / "0002.exr").write_bytes(b"")
    with pytest.raises(InputError, match=r"both 0002\.exr and 0002\.png"):
        gather_frames([whole])


def test_a_folder_holds_frames_of_one_kind(tmp_path):
    folder = frames(tmp_path / "out", [1])
    with pytest.raises(InputError, match=r"holds frames as 0001\.png; choose another folder"):
        FrameIndex(folder, suffix=".exr")


def test_a_recorded_name_that_no_frame_has_is_no_frame(tmp_path):
    """No file system has room for it: looking whether it is there would raise."""
    folder = frames(tmp_path / "out", [1])
    content = json.loads((folder / "frames.json").read_text())
    content["frames"]["1" * 400 + ".png"] = content["frames"]["0001.png"]
    (folder / "frames.json").write_text(json.dumps(content))
    assert [state.file for state in FrameIndex.of(folder).check()] == ["0001.png"]
    assert FrameIndex(folder).find("other") is None


@pytest.mark.parametrize("name", ["scene.json", "manifest.json", "capture.json"])
def test_frames_do_not_go_into_a_folder_of_something_else(tmp_path, name):
    """A scene with frames in it could not be corrected again."""
    (tmp_path / name).write_text("{}")
    with pytest.raises(InputError, match="not a folder of frames"):
        FrameIndex(tmp_path)
    # Those of an earlier version, which are there already.
    (tmp_path / "frames.json").write_text("{}")
    FrameIndex(tmp_path)


@given(
    content=st.binary(max_size=60)
    | st.builds(
        lambda v: json.dumps({"format": "physgen-frames/1", "fps": v}).encode(),
        st.none() | st.booleans() | st.floats() | st.text(max_size=5) | st.lists(st.integers(), max_size=2),
    )
)
def test_a_strange_ledger_knows_no_rate_and_breaks_nothing(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("strange")
    write_png(folder / "0001.png", PIXELS)
    (folder / "frames.json").write_bytes(content)
    fps = gather_frames([folder]).fps
    assert fps is None or 0 < fps < np.inf


@given(count=st.integers(1, 200), tiles=st.integers(1, 30))
def test_a_sheet_plays_every_frame_and_each_tile_ends_where_the_next_began(count, tiles):
    order = played(count, min(count, tiles))
    assert {frame for step in order for frame in step} == set(range(count))
    assert order[0][1:] == order[-1][:-1]
    assert order[0][0] == 0
    assert order[-1][-1] == count - 1
    for tile in zip(*order, strict=True):
        assert all(0 <= b - a <= 1 for a, b in itertools.pairwise(tile))


@pytest.mark.parametrize("suffix", [".png", ".webp"])
def test_a_sheet_shows_stills_that_move(tmp_path, suffix):
    found = gather_frames([frames(tmp_path / "f", range(1, 14))])
    write_contact_sheet(found.paths, found.numbers, tmp_path / f"sheet{suffix}", fps=25.0, columns=2, rows=2, width=84)
    with Image.open(tmp_path / f"sheet{suffix}") as sheet:
        assert sheet.n_frames == 4
        seen, times = [], []
        for index in range(4):
            sheet.seek(index)
            grey = np.asarray(sheet.convert("RGB"))
            # Upper right in each tile, away from its number.
            seen.append([int(grey[y, x, 0]) for y in (4, 38) for x in (35, 79)])
            times.append(sheet.info["duration"])
    expected = [[9 * (1 + frame) for frame in step] for step in played(13, 4)]
    assert np.abs(np.array(seen) - expected).max() <= (4 if suffix == ".webp" else 0)
    assert times == [900, 40, 40, 900]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--out", "clip.gif"], ".mp4, .webm, .png or .webp"),
        (["--out", "0009.png"], "is a frame's name"),
        (["--out", "clip.mp4", "--tiles", "3x2"], "--tiles: is for contact sheets"),
        (["--out", "clip.webm", "--fps", "nan"], "fps is nan"),
        (["--out", "sheet.png", "--tiles", "3"], "columns and rows"),
        (["--out", "sheet.png", "--tiles", "0x2"], "1x1 to 20x20"),
        (["--out", "sheet.png", "--width", "9"], "width is 9"),
        (["--out", "clip.mp4", "--frames", "1-4"], "frame 3 of 1 to 4"),
    ],
)
def test_encode_refuses_in_words(tmp_path, monkeypatch, capsys, arguments, words):
    monkeypatch.chdir(tmp_path)
    frames(tmp_path / "f", [1, 2, 4])
    gaps = [] if "1-4" in arguments else ["--allow-gaps"]
    assert cli.main(["encode", "f", *arguments, *gaps]) == 3
    assert words in capsys.readouterr().err


def test_encode_makes_a_sheet(tmp_path, capsys):
    folder = frames(tmp_path / "f", range(1, 4), fps=12.0)
    assert cli.main(["encode", str(folder), "--out", str(tmp_path / "s.png"), "--json"]) == 0
    done = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert done == {"event": "done", "out": str(tmp_path / "s.png"), "frames": 3, "fps": 12.0}
