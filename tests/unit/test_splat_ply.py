# SPDX-License-Identifier: MIT
"""PLY files of splats: what is written, what other programs write, what is broken."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.gaussians.splat_ply import PROPERTIES, SH_C0, read_splat_file, read_splats, write_splats
from physgen.sim.gaussians.splats import Splats

INRIA = (
    *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"),
    *("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
)
ARRAYS = ("centres", "scales", "rotations", "opacities", "colours")


def some(count=7, seed=0):
    random = np.random.default_rng(seed)
    return Splats(
        centres=random.normal(size=(count, 3)),
        scales=random.uniform(0.001, 0.1, (count, 3)),
        rotations=random.normal(size=(count, 4)),
        opacities=random.uniform(0.05, 0.95, count),
        colours=random.uniform(0, 1, (count, 3)),
    )


def columns_of(splats):
    """What the format stores of ``splats``, by name."""
    found = dict(zip("xyz", splats.centres.T, strict=True))
    found |= {f"f_dc_{i}": (splats.colours[:, i] - 0.5) / SH_C0 for i in range(3)}
    found |= {f"scale_{i}": np.log(splats.scales[:, i]) for i in range(3)}
    found |= {f"rot_{i}": splats.rotations[:, i] for i in range(4)}
    found["opacity"] = np.log(splats.opacities / (1 - splats.opacities))
    return found


NAMES = {"f4": "float", "f8": "double", "u1": "uchar", "u4": "uint", "i4": "int", "u2": "ushort"}


def ply(columns, *, form="binary_little_endian", types=None, before="", after="", head=b"", tail=b"", newline="\n"):
    """A PLY file with ``columns`` by name as its vertices; ``before``, ``after``: further lines of its header."""
    types = types or {}
    count = len(next(iter(columns.values())))
    kinds = [types.get(name, "f4") for name in columns]
    lines = ["ply", f"format {form} 1.0", "comment by hand", *before.splitlines(), f"element vertex {count}"]
    lines += [f"property {NAMES[kind]} {name}" for name, kind in zip(columns, kinds, strict=True)]
    lines += [*after.splitlines(), "end_header", ""]
    if form == "ascii":
        body = "".join(
            " ".join(f"{v:.9g}" for v in row) + newline for row in zip(*columns.values(), strict=True)
        ).encode()
    else:
        order = "<" if form == "binary_little_endian" else ">"
        table = np.empty(count, [(name, order + kind) for name, kind in zip(columns, kinds, strict=True)])
        for name, values in columns.items():
            table[name] = values
        body = table.tobytes()
    return newline.join(lines).encode() + head + body + tail


def read(tmp_path, content, name="x.ply", **options):
    path = tmp_path / name
    path.write_bytes(content)
    return read_splat_file(path, **options)


def assert_same(found, wanted, rtol=2e-6):
    for name in ARRAYS:
        np.testing.assert_allclose(getattr(found, name), getattr(wanted, name), rtol=rtol, atol=1e-6, err_msg=name)


def test_splat_file_round_trip(tmp_path):
    splats = some(1000)
    write_splats(tmp_path / "a.ply", splats)
    file = read_splat_file(tmp_path / "a.ply")
    assert_same(file.splats, splats)
    assert file.notes == ()


def test_files_are_laid_out_as_inria_does(tmp_path):
    splats = some(5)
    write_splats(tmp_path / "a.ply", splats)
    header, _, body = (tmp_path / "a.ply").read_bytes().partition(b"end_header\n")
    lines = header.decode("ascii").splitlines()
    assert lines[:3] == ["ply", "format binary_little_endian 1.0", "element vertex 5"]
    assert lines[3:] == [f"property float {name}" for name in INRIA] and PROPERTIES == INRIA
    table = np.frombuffer(body, "<f4").reshape(5, len(INRIA))
    for name, values in columns_of(splats).items():
        np.testing.assert_allclose(table[:, INRIA.index(name)], values, rtol=1e-6, atol=1e-6)
    assert not table[:, 3:6].any()


def test_trimesh_reads_what_is_written(tmp_path):
    splats = some(5)
    write_splats(tmp_path / "a.ply", splats)
    cloud = trimesh.load(tmp_path / "a.ply", process=False)
    np.testing.assert_allclose(np.asarray(cloud.vertices), splats.centres, rtol=1e-6)


def test_solid_and_clear_splats_have_finite_logits(tmp_path):
    splats = some(2).changed(opacities=np.array([0.0, 1.0]))
    write_splats(tmp_path / "a.ply", splats)
    np.testing.assert_allclose(read_splats(tmp_path / "a.ply").opacities, [0, 1], atol=2e-6)
    with pytest.raises(InputError, match="no splats"):
        write_splats(tmp_path / "a.ply", splats.subset(np.zeros(2, bool)))
    with pytest.raises(InputError, match="float32"):
        write_splats(tmp_path / "b.ply", splats.changed(centres=np.full((2, 3), 1e39)))
    assert len(read_splats(tmp_path / "a.ply")) == 2 and sorted(p.name for p in tmp_path.iterdir()) == ["a.ply"]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", ["f4", "f8"])
def test_dialects_of_the_same_splats(tmp_path, form, kind):
    splats = some(300)
    columns = columns_of(splats)
    names = sorted(columns, reverse=True)
    columns = {"unknown": np.arange(300.0), **{name: columns[name] for name in names}, "f_rest_0": np.zeros(300)}
    types = dict.fromkeys(columns, kind) | {"unknown": "i4"}
    size = b"1\n2\n" if form == "ascii" else b"\1\2"
    content = ply(
        columns,
        form=form,
        types=types,
        before="element camera 2\nproperty uchar id",
        head=size,
        after="element face 1\nproperty list uchar int vertex_indices",
        tail=b"\3\0\0",
    )
    file = read(tmp_path, content)
    assert_same(file.splats, splats)
    assert len(file.notes) == 1 and "f_rest" in file.notes[0]


def test_rows_of_text_may_end_as_on_windows(tmp_path):
    splats = some(3)
    assert_same(read(tmp_path, ply(columns_of(splats), form="ascii", newline="\r\n")).splats, splats)


def test_long_files_are_read_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr("physgen.sim.gaussians.ply_format.BLOCK_BYTES", 1000)
    splats = some(500)
    for form in ("ascii", "binary_big_endian"):
        assert_same(read(tmp_path, ply(columns_of(splats), form=form)).splats, splats)


@pytest.mark.parametrize("kind, most", [("u1", 255), ("u2", 65535), ("f4", 1.0)])
def test_colours_as_point_clouds_have_them(tmp_path, kind, most):
    splats = some(4)
    columns = {k: v for k, v in columns_of(splats).items() if k[:4] != "f_dc" and k != "opacity"}
    columns |= {name: splats.colours[:, i] * most for i, name in enumerate(("red", "green", "blue"))}
    columns["alpha"] = splats.opacities * most
    file = read(tmp_path, ply(columns, types=dict.fromkeys(("red", "green", "blue", "alpha"), kind)))
    np.testing.assert_allclose(file.splats.colours, splats.colours, atol=1 / most if kind != "f4" else 1e-6)
    np.testing.assert_allclose(file.splats.opacities, splats.opacities, atol=1 / most if kind != "f4" else 1e-6)
    assert "red, green, blue" in file.notes[0] and "alpha" in file.notes[1]
    if kind == "f4":
        columns["red"] = columns["red"] * 255
        with pytest.raises(InputError, match=r"red ranges from .* uchar from 0 to 255"):
            read(tmp_path, ply(columns))


def packed(splats, bounds_of_colours=True):
    """``splats`` as SuperSplat keeps them: chunks of 256, bits rounded."""
    count = len(splats)
    chunks = -(-count // 256)
    values = np.concatenate([splats.centres, np.log(splats.scales), splats.colours], axis=1)
    low = np.stack([values[c * 256 : (c + 1) * 256].min(axis=0) for c in range(chunks)])
    high = np.stack([values[c * 256 : (c + 1) * 256].max(axis=0) for c in range(chunks)])
    if not bounds_of_colours:
        low[:, 6:], high[:, 6:] = 0, 1
    which = np.arange(count) // 256
    share = (values - low[which]) / (high[which] - low[which])

    def pack(columns, bits):
        word = np.zeros(count, np.uint64)
        for column, width in zip(columns, bits, strict=True):
            word = (word << np.uint64(width)) | np.rint(column * (2**width - 1)).astype(np.uint64)
        return word

    largest = np.abs(splats.rotations).argmax(axis=1)
    turned = splats.rotations * np.sign(splats.rotations[np.arange(count), largest])[:, None]
    rest = np.stack([np.delete(turned[i], largest[i]) for i in range(count)]) / np.sqrt(2) + 0.5
    columns = {
        "packed_position": pack(share[:, :3].T, (11, 10, 11)),
        "packed_rotation": pack([largest / 3, *rest.T], (2, 10, 10, 10)),
        "packed_scale": pack(share[:, 3:6].T, (11, 10, 11)),
        "packed_color": pack([*share[:, 6:].T, splats.opacities], (8, 8, 8, 8)),
    }
    groups = [("", "xyz"), ("scale_", "xyz"), *([("", "rgb")] if bounds_of_colours else [])]
    limits = []
    names = []
    for i, (prefix, axes) in enumerate(groups):
        for end, table in (("min", low), ("max", high)):
            names += [f"{end}_{prefix}{axis}" for axis in axes]
            limits.append(table[:, 3 * i : 3 * i + 3])
    before = "\n".join([f"element chunk {chunks}", *(f"property float {name}" for name in names)])
    head = np.concatenate(limits, axis=1).astype("<f4").tobytes()
    return ply(columns, types=dict.fromkeys(columns, "u4"), before=before, head=head)


@pytest.mark.parametrize("bounds", [True, False])
def test_packed_files_of_supersplat(tmp_path, bounds):
    splats = some(600)
    found = read(tmp_path, packed(splats, bounds)).splats
    np.testing.assert_allclose(found.centres, splats.centres, atol=0.51 * 7 / 1023)
    np.testing.assert_allclose(np.log(found.scales), np.log(splats.scales), atol=0.51 * 5 / 1023)
    np.testing.assert_allclose(found.colours, splats.colours, atol=0.51 / 255)
    np.testing.assert_allclose(found.opacities, splats.opacities, atol=0.51 / 255)
    assert np.abs((found.rotations * splats.rotations).sum(axis=1)).min() > 1 - 1e-5


def test_a_few_unusable_splats_are_left_out_and_told(tmp_path):
    columns = columns_of(some(400))
    columns["x"] = np.where(np.arange(400) == 17, np.nan, columns["x"])
    for i in range(4):
        columns[f"rot_{i}"] = np.where(np.arange(400) == 30, 0, columns[f"rot_{i}"])
    columns["scale_1"] = np.where(np.arange(400) == 31, 100, columns["scale_1"])
    file = read(tmp_path, ply(columns))
    assert len(file.splats) == 397
    assert file.notes == ("3 of 400 splats were left out, such as splat 17 with a centre that is not finite",)
    columns["opacity"] = np.where(np.arange(400) % 40 == 0, np.nan, columns["opacity"])
    with pytest.raises(InputError, match=r"13 of 400 .* splat 0 with an opacity that is not a number: export"):
        read(tmp_path, ply(columns))


def test_infinite_logits_are_solid_and_clear(tmp_path):
    columns = columns_of(some(2))
    columns["opacity"], columns["scale_0"] = np.array([np.inf, -np.inf]), np.array([-50.0, -2.0])
    file = read(tmp_path, ply(columns))
    np.testing.assert_array_equal(file.splats.opacities, [1, 0])
    assert file.splats.scales[0, 0] == 1e-7 and "1 splats thinner" in file.notes[0]


GOOD = columns_of(some(3))


def without(*names):
    return {name: values for name, values in GOOD.items() if name not in names}


FACES = "element face 1\nproperty list uchar int vertex_indices"
ONLY_PLACES = {name: GOOD[name] for name in "xyz"}


@pytest.mark.parametrize(
    "content, said",
    [
        (b"", 'does not begin with "ply"'),
        (b"solid x\n" * 9, 'does not begin with "ply"'),
        (b"ply\n", "its header has no end"),
        (b"ply\nformat ascii 1.0\n" + b"comment x\n" * 40_000, "longer than 256 KiB"),
        (b"ply\nelement vertex 0\nend_header\n", "names no format"),
        (b"ply\nformat ascii 1.0\nelement vertex -3\nend_header\n", "line 'element vertex -3'"),
        (b"ply\nformat ascii 1.0\nend_header\n", "no element vertex"),
        (ply(ONLY_PLACES), "a plain point cloud.*fit splats to it"),
        (ply(ONLY_PLACES, after=FACES), "a mesh.*sample splats on it"),
        (ply(without("rot_2")), "lack rot_2"),
        (ply(without("scale_2")), "lack scale_2"),
        (ply(without("f_dc_1")), "no colours"),
        (ply(without("y")), "lacks y"),
        (ply(GOOD)[:-1], "168 bytes, but 167 follow"),
        (ply(GOOD, form="ascii")[:100], "its header"),
        (ply(GOOD, before=FACES, head=b"\0"), "face with its lists comes before vertex"),
        (ply(GOOD, after="property list uchar int ids"), "rows of vertex hold lists"),
        (ply(GOOD, after="property float x"), "'x' twice"),
        (ply(GOOD, form="ascii").replace(b" ", b" a ", 100), "line"),
        (packed(some(3)).replace(b"min_x", b"min_q"), "without the bounds"),
        (packed(some(3)).replace(b"chunk 1", b"chunk 0"), "0 chunks of 256 for 3"),
    ],
)
def test_other_files_than_splats_are_refused(tmp_path, content, said):
    with pytest.raises(InputError, match=said):
        read(tmp_path, content)


def test_a_word_among_numbers_is_named_with_its_row(tmp_path):
    content = ply(GOOD, form="ascii")
    head, _, body = content.partition(b"end_header\n")
    rows = body.splitlines()
    for wrong in (b"x " + rows[1], rows[1].rpartition(b" ")[0], b"5", b"z" + rows[1]):
        with pytest.raises(InputError, match="row 1 of vertex does not hold 14 numbers"):
            read(tmp_path, b"\n".join([head + b"end_header", rows[0], wrong, rows[2], b"" * 2]) + b"\n" * 99)


@pytest.mark.parametrize("name, said", [("a.splat", "antimatter15"), ("a.SPZ", "Niantic"), ("b.ksplat", "SuperSplat")])
def test_other_formats_are_refused_by_name(tmp_path, name, said):
    with pytest.raises(InputError, match=said):
        read(tmp_path, b"anything", name)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("place", ["vertex", "camera"])
def test_enormous_headers_take_no_memory(tmp_path, form, place):
    content = ply(GOOD, form=form, before="element camera 1\nproperty uchar id")
    content = content.replace(b"camera 1", b"camera 1000000000000") if place == "camera" else content
    content = content.replace(b"vertex 3", b"vertex 1000000000000") if place == "vertex" else content
    tracemalloc.start()
    with pytest.raises(InputError, match=r"more than 2000000|follow"):
        read(tmp_path, content)
    with pytest.raises(InputError, match="follow"):
        read(tmp_path, content.replace(b"1000000000000", b"2000000"))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 2**20


def test_more_splats_than_wanted_are_refused(tmp_path):
    with pytest.raises(InputError, match="declares 3 splats, more than 2"):
        read(tmp_path, ply(GOOD), max_splats=2)
    with pytest.raises(InputError, match="no such file"):
        read_splats(tmp_path / "none.ply")
    with pytest.raises(InputError, match="holds no splats"):
        read(tmp_path, ply({name: values[:0] for name, values in GOOD.items()}))


SEEDS = [
    ply(GOOD),
    ply(GOOD, form="ascii"),
    ply(GOOD, form="binary_big_endian", before="element camera 0\nproperty uchar id", after=FACES, tail=b"\3\0"),
    packed(some(3)),
]
WORDS = [b"vertex", b"element", b"property", b"float", b"double", b"list uchar int", b"999999999999", b"0", b"-1"]
WORDS += [b"scale_0", b"packed_position", b"chunk", b"\n", b"nan", b"inf", b"1e999", b"end_header\n", b"\0\0\xc0\x7f"]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_files_are_refused_or_read(tmp_path, data):
    content = bytearray(data.draw(st.sampled_from(SEEDS)))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content)))
        length = data.draw(st.integers(0, 12))
        content[at : at + length] = data.draw(st.sampled_from(WORDS) | st.binary(max_size=8))
    try:
        file = read(tmp_path, bytes(content[: data.draw(st.just(len(content)) | st.integers(0, len(content)))]))
    except InputError as error:
        assert "x.ply: " in str(error) and len(str(error)) < 600
    else:
        assert 0 < len(file.splats) <= 2_000_000


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200))
def test_garbage_is_refused(tmp_path, content):
    for start in (b"", b"ply\nformat ascii 1.0\nelement vertex 2\n"):
        with pytest.raises(InputError):
            read(tmp_path, start + content)
