# SPDX-License-Identifier: MIT
"""Masks of other programs: written as they write them, read back; and garbage of every kind."""

import contextlib
import json
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from physgen.sim.errors import InputError
from physgen.sim.importers.coco_masks import mask_from_polygons, mask_from_rle
from physgen.sim.importers.masks import read_masks
from physgen.sim.npz import read_npy, read_npz
from PIL import Image

WIDTH, HEIGHT = 60, 40
Y, X = np.mgrid[:HEIGHT, :WIDTH]
DISC = (X - 20) ** 2 + (Y - 15) ** 2 < 100
RECTANGLE = (X >= 35) & (X < 55) & (Y >= 5) & (Y < 38)
MASKS = np.stack([DISC, RECTANGLE])


def runs_of(mask):
    """Lengths of the runs down the columns, zeros first."""
    flat = mask.T.ravel()
    edges = np.flatnonzero(np.diff(flat)) + 1
    runs = np.diff([0, *edges, flat.size]).tolist()
    return [0, *runs] if flat[0] else runs


def packed(runs):
    """COCO's text: 5 bits a character, differences to the run two before from the fourth on."""
    text = ""
    for i, run in enumerate(runs):
        value = run - runs[i - 2] if i > 2 else run
        while True:
            bits, value = value & 31, value >> 5
            more = not (value == -1 if bits & 16 else value == 0)
            text += chr(48 + (bits | 32 * more))
            if not more:
                break
    return text


def rle(mask, *, as_text=True):
    runs = runs_of(mask)
    return {"size": list(mask.shape), "counts": packed(runs) if as_text else runs}


def check(found, names=("object_0", "object_1"), kinds=(None, None)):
    assert [m.name for m in found] == list(names) and [m.kind for m in found] == list(kinds)
    for item, truth in zip(found, MASKS, strict=True):
        assert item.mask.dtype == bool and (item.mask == truth).all()
    assert found[1].box == (35, 5, 55, 38)


def read(path, **more):
    return read_masks(path, WIDTH, HEIGHT, "photo.jpg", **more)


def test_a_string_of_the_coco_tools():
    # pycocotools.mask.encode of a 3x4 mask whose columns are 010, 110, 000, 001 gives b"11115O".
    truth = np.array([[0, 1, 0, 0], [1, 1, 0, 0], [0, 0, 0, 1]], dtype=bool)
    assert runs_of(truth) == [1, 1, 1, 2, 6, 1]
    # 1, 1, 1, then 2 - 1 = 1, 6 - 1 = 5, 1 - 2 = -1, which is 31 of five bits, with its sign bit set.
    assert (mask_from_rle({"size": [3, 4], "counts": "11115O"}, "x") == truth).all()


@settings(max_examples=100, deadline=None)
@given(npst.arrays(np.bool_, st.tuples(st.integers(1, 40), st.integers(1, 40))), st.booleans())
def test_runs_come_back(mask, as_text):
    assert (mask_from_rle(rle(mask, as_text=as_text), "x") == mask).all()


def test_large_runs_come_back():
    mask = np.zeros((2000, 1500), dtype=bool)
    mask[100:1900, 700:702] = mask[5, 5] = True
    assert (mask_from_rle(rle(mask), "x") == mask).all()


def test_a_folder_as_sam_writes_it(tmp_path):
    for i, mask in enumerate(MASKS):
        Image.fromarray(mask.astype(np.uint8) * 255).save(tmp_path / f"{i}.png")
    Image.fromarray(np.zeros((HEIGHT, WIDTH, 3), np.uint8)).save(tmp_path / "0matting.png")
    (tmp_path / "metadata.csv").write_text("id,area,bbox_x0,bbox_y0\n0,305,1,2\n1,600,1,2")
    check(read(tmp_path))
    # In the order of numbers: 2 before 10.
    for i in (10, 2):
        Image.fromarray(DISC).save(tmp_path / f"{i}.png")
    assert [m.name for m in read(tmp_path)] == ["object_0", "object_1", "object_2", "object_10"]


def test_a_folder_with_names(tmp_path):
    Image.fromarray(DISC).save(tmp_path / "coffee_cup.png")
    Image.fromarray(RECTANGLE.astype(np.uint16) * 65535).save(tmp_path / "object-2.png")
    check(read(tmp_path), ("coffee_cup", "object-2"), ("coffee cup", None))


@pytest.mark.parametrize(
    "array",
    [
        MASKS,
        MASKS[:, None].astype(np.float32),
        MASKS.astype(np.uint8) * 255,
        np.where(MASKS, 3.5, -7.25).astype(np.float16),
        np.asfortranarray(MASKS.astype(">i4")),
        (MASKS[0] * 1 + MASKS[1] * 2).astype(np.uint8),
    ],
    ids=["bool", "probability", "grey", "logits", "fortran", "numbers"],
)
def test_arrays(tmp_path, array):
    np.save(tmp_path / "m.npy", array)
    np.savez_compressed(tmp_path / "m.npz", masks=array, boxes=np.ones((2, 4)), names=np.array(["a", None], object))
    numbers = ("object_1", "object_2") if array.ndim == 2 else ("object_0", "object_1")
    for name in ("m.npy", "m.npz"):
        check(read(tmp_path / name), numbers)


def test_named_arrays(tmp_path):
    np.savez(tmp_path / "m.npz", red_ball=DISC, box=RECTANGLE[None], scores=np.ones(2), points=np.ones((5, 2)))
    check(read(tmp_path / "m.npz"), ("red_ball", "box"), ("red ball", "box"))


def test_a_picture_with_a_number_an_object(tmp_path):
    Image.fromarray((DISC * 3 + RECTANGLE * 7).astype(np.uint8)).save(tmp_path / "m.png")
    check(read(tmp_path / "m.png"), ("object_3", "object_7"))
    Image.fromarray(DISC.astype(np.uint8) * 255).save(tmp_path / "black_white.png")
    (only,) = read(tmp_path / "black_white.png")
    assert only.name == "black_white" and (only.mask == DISC).all()


def annotations(**more):
    return [
        {"segmentation": rle(mask), "area": int(mask.sum()), "bbox": [0, 0, 1, 1], "predicted_iou": 0.9, **more}
        for mask in MASKS
    ]


def test_sam_s_json(tmp_path):
    path = tmp_path / "m.json"
    path.write_text(json.dumps(annotations()))
    check(read(path))
    # SA-1B: the picture beside them.
    image = {"image_id": 1, "width": WIDTH, "height": HEIGHT, "file_name": "sa_1.jpg"}
    path.write_text(json.dumps({"image": image, "annotations": annotations()}))
    check(read(path))
    # Grounded SAM 2: names, and the size beside them.
    grounded = {"image_path": "a/b.jpg", "annotations": annotations(class_name="mug"), "img_width": WIDTH}
    path.write_text(json.dumps({**grounded, "img_height": HEIGHT, "box_format": "xyxy"}))
    check(read(path), ("mug", "mug_2"), ("mug", "mug"))


def coco(**changes):
    corners = [35, 5, 55, 5, 55, 38, 35, 38]
    return {
        "info": {},
        "images": [
            {"id": 7, "file_name": "train/photo.jpg", "width": WIDTH, "height": HEIGHT},
            {"id": 8, "file_name": "other.jpg", "width": 9, "height": 9},
        ],
        "categories": [{"id": 3, "name": "orange"}, {"id": 4, "name": "book"}],
        "annotations": [
            {"id": 1, "image_id": 7, "category_id": 3, "segmentation": rle(DISC, as_text=False), "iscrowd": 1},
            {"id": 2, "image_id": 8, "category_id": 3, "segmentation": rle(np.ones((9, 9), bool))},
            {"id": 3, "image_id": 7, "category_id": 4, "segmentation": [corners]},
        ],
        **changes,
    }


def test_coco_takes_the_photo_s_own(tmp_path):
    path = tmp_path / "m.json"
    path.write_text(json.dumps(coco()))
    check(read(path), ("orange", "book"), ("orange", "book"))
    (only,) = read(path, only=["book"])
    assert only.name == "book" and (only.mask == RECTANGLE).all()
    with pytest.raises(InputError, match="no mask 'pear'; it has orange, book"):
        read(path, only=["pear"])
    with pytest.raises(InputError, match=r"none of its 2 images has the file name 'x\.jpg'"):
        read_masks(path, WIDTH, HEIGHT, "x.jpg")


def test_polygons_take_the_pixels_whose_centres_they_hold():
    # A right triangle of half the square, and a square with corners between pixel centres.
    triangle = mask_from_polygons([[0, 0, 10, 0, 0, 10]], 10, 10, "x")
    assert abs(int(triangle.sum()) - 50) <= 5 and triangle[0, 8] and not triangle[8, 8]
    assert mask_from_polygons([[2.6, 2.6, 5.4, 2.6, 5.4, 5.4, 2.6, 5.4]], 9, 9, "x").sum() == 4
    parts = mask_from_polygons([[0, 0, 4, 0, 4, 4, 0, 4], [2, 2, 6, 2, 6, 6, 2, 6], [90, 0, 99, 0, 99, 9]], 8, 8, "x")
    assert parts.sum() == 28, "the union, and what is outside is cut"


def test_masks_of_another_size_keep_their_area(tmp_path):
    np.save(tmp_path / "m.npy", MASKS.repeat(3, axis=1).repeat(3, axis=2))
    check(read(tmp_path / "m.npy"))
    np.save(tmp_path / "m.npy", MASKS[:, ::2, ::2])
    small = read(tmp_path / "m.npy")
    assert abs(small[1].mask.sum() / RECTANGLE.sum() - 1) < 0.1
    np.save(tmp_path / "m.npy", MASKS[:, :, ::2])
    with pytest.raises(InputError, match="has 30x40 pixels, the photo 60x40"):
        read(tmp_path / "m.npy")


def bomb(path):
    """A kilobyte that unpacks to a gigabyte of array."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("masks.npy", "w") as stream:
        np.lib.format.write_array_header_1_0(
            stream, {"descr": "|u1", "fortran_order": False, "shape": (2 * 10**4, 10**4, 10)}
        )
        stream.write(bytes(10**6))


BAD = {
    "nothing.npy": (lambda p: p.write_bytes(b""), "not readable as .npy"),
    "objects.npy": (lambda p: np.save(p, np.array([print])), "holds object"),
    "text.npy": (lambda p: np.save(p, np.array(["a"])), "holds <U1"),
    "vector.npy": (lambda p: np.save(p, np.ones(5)), r"shape \(5,\)"),
    "short.npy": (lambda p: (np.save(p, MASKS), p.write_bytes(p.read_bytes()[:500])), "needs 4800"),
    "nan.npy": (lambda p: np.save(p, np.full((2, HEIGHT, WIDTH), np.nan)), "not finite"),
    "empty.npy": (lambda p: np.save(p, MASKS & False), "mask object_0 is empty"),
    "many.npy": (lambda p: np.save(p, np.ones((5000, 2, 3), bool)), "5000 masks"),
    "bomb.npz": (bomb, "MiB allowed"),
    "garbage.npz": (lambda p: p.write_bytes(b"PK\3\4 garbage"), "not readable as .npz"),
    "none.npz": (lambda p: np.savez(p, scores=np.ones(3)), "contains no mask"),
    "object.json": (lambda p: p.write_text("{}"), "expected a list of masks"),
    "number.json": (lambda p: p.write_text("[3]"), "expected a list of masks"),
    "box.json": (lambda p: p.write_text('[{"bbox": [1, 2, 3, 4]}]'), "no segmentation"),
    "runs.json": (lambda p: p.write_text('[{"segmentation": {"size": [4, 4], "counts": [3, 4]}}]'), "do not add up"),
    "minus.json": (
        lambda p: p.write_text('[{"segmentation": {"size": [4, 4], "counts": [20, -4]}}]'),
        "non-negative integers",
    ),
    "huge.json": (
        lambda p: p.write_text('[{"segmentation": {"size": [99999999, 99999999], "counts": [1]}}]'),
        "expected height and width",
    ),
    "cut.json": (lambda p: p.write_text('[{"segmentation": {"size": [4, 4], "counts": "P"}}]'), "middle of a number"),
    "chain.json": (
        lambda p: p.write_text(json.dumps([{"segmentation": {"size": [4, 4], "counts": "o" * 99}}])),
        "contain an unexpected",
    ),
    "polygon.json": (lambda p: p.write_text('[{"segmentation": [[1, 2, 3]]}]'), "at least three points"),
    "deep.json": (lambda p: p.write_text("[" * 10**5), "not readable as JSON"),
    "garbage.png": (lambda p: p.write_bytes(b"\x89PNG\r\n\x1a\n garbage"), "not a readable image"),
    "black.png": (lambda p: Image.new("L", (WIDTH, HEIGHT)).save(p), "is empty"),
    "folder": (lambda p: p.mkdir(), "contains no PNG"),
    "masks.exr": (lambda p: p.write_bytes(b""), "give a folder of PNGs"),
}


@pytest.mark.parametrize("name", BAD)
def test_garbage_is_named(tmp_path, name):
    write, words = BAD[name]
    write(tmp_path / name)
    with pytest.raises(InputError, match=words) as caught:
        read(tmp_path / name)
    assert name in str(caught.value)


def test_missing_files_are_named(tmp_path):
    with pytest.raises(InputError, match="no such file or folder"):
        read(tmp_path / "x.png")


json_values = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=8),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.dictionaries(
            st.sampled_from(["segmentation", "size", "counts", "images", "annotations", "categories", "file_name"]),
            inner,
            max_size=4,
        )
    ),
    max_leaves=12,
)


@settings(max_examples=200, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(json_values)
def test_any_json_is_refused_or_read(tmp_path, value):
    (tmp_path / "m.json").write_text(json.dumps(value))
    with contextlib.suppress(InputError):
        for item in read(tmp_path / "m.json"):
            assert item.mask.shape == (HEIGHT, WIDTH) and item.mask.any()


@settings(max_examples=150, deadline=None)
@given(
    st.lists(st.integers(-2, 12) | st.integers(), max_size=2) | st.just([3, 4]),
    st.text(st.characters(min_codepoint=40, max_codepoint=115), max_size=9) | st.lists(st.integers(-1, 13), max_size=6),
)
def test_any_runs_are_refused_or_fill_their_size(size, counts):
    with contextlib.suppress(InputError):
        mask = mask_from_rle({"size": size, "counts": counts}, "x")
        assert list(mask.shape) == size and mask.dtype == bool


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_any_damage_to_arrays_is_refused_or_read(tmp_path, data):
    np.save(tmp_path / "m.npy", MASKS[:, :4, :4])
    np.savez_compressed(tmp_path / "m.npz", masks=MASKS[:, :4, :4])
    path = tmp_path / data.draw(st.sampled_from(["m.npy", "m.npz"]))
    content = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 6))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(content[: data.draw(st.integers(0, len(content)) | st.just(len(content)))])
    with contextlib.suppress(InputError):
        found = read_npy(path, 10**6) if path.suffix == ".npy" else read_npz(path, 10**6)
        assert all(a.dtype.kind in "biuf" for a in (found.values() if isinstance(found, dict) else [found]))
