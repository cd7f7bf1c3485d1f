# SPDX-License-Identifier: MIT
"""LaMa through onnxruntime: real models of a few operators."""

import struct

import numpy as np
import pytest
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.adapters import resolve
from physgen.sim.reconstruct.adapters.onnx_adapter import square_around

from .onnx_models import FLOAT, FLOAT16, constant, model

pytest.importorskip("onnxruntime")


def mean_model(size, *, scale=1.0, kind=FLOAT, names=("image", "mask"), batch=1):
    """Fills with the mean colour of what is known: ReduceMean(image (1 - mask)) / ReduceMean(1 - mask), in the hole."""
    nodes = [
        ("Sub", ["one", names[1]], "known"),
        ("Mul", [names[0], "known"], "visible"),
        ("GlobalAveragePool", ["visible"], "sum"),
        ("GlobalAveragePool", ["known"], "share"),
        ("Div", ["sum", "share"], "mean"),
        ("Mul", ["mean", names[1]], "inside"),
        ("Add", ["visible", "inside"], "both"),
        ("Mul", ["both", "scale"], "output"),
    ]
    constants = [constant("one", [1.0], kind), constant("scale", [scale], kind)]
    inputs = [(names[1], kind, [batch, 1, *size]), (names[0], kind, [batch, 3, *size])]
    return model(nodes, constants, inputs, [("output", kind, [batch, 3, *size])])


def constant_model(value, size=(64, 64), shape=None):
    """Gives the colour ``value`` everywhere, whatever it sees."""
    nodes = [("Mul", ["image", "zero"], "black"), ("Add", ["black", "value"], "output")]
    constants = [constant("zero", [0.0]), constant("value", np.reshape(value, (1, 3, 1, 1)))]
    inputs = [("image", FLOAT, [1, 3, *size]), ("mask", FLOAT, [1, 1, *size])]
    return model(nodes, constants, inputs, [("output", FLOAT, shape or [1, 3, *size])])


def stacked_model():
    """Picture and mask in one: gives 1 - the mask as all three colours."""
    # A 1x1 convolution picks the fourth channel: weights (3, 4, 1, 1).
    weights = np.zeros((3, 4, 1, 1))
    weights[:, 3] = -1.0
    nodes = [("Conv", ["input", "weights"], "minus"), ("Add", ["minus", "one"], "output")]
    sides = [1, 4, "height", "width"]
    return model(
        nodes,
        [constant("weights", weights), constant("one", [1.0])],
        [("input", FLOAT, sides)],
        [("output", FLOAT, [1, 3, "height", "width"])],
    )


@pytest.fixture
def load(tmp_path):
    def write(content):
        path = tmp_path / "model.onnx"
        path.write_bytes(content)
        return resolve("inpainter", f"lama:{path}")

    return write


def smooth(height=150, width=200):
    """A picture without edges, so that any edge comes from a filling."""
    y, x = np.mgrid[:height, :width]
    return np.stack([60 + x * 0.5, 90 + y * 0.4, 200 - x * 0.3], axis=-1).astype(np.uint8)


def hole_in(picture, rows, columns):
    hole = np.zeros(picture.shape[:2], dtype=bool)
    hole[rows, columns] = True
    return hole


@pytest.mark.parametrize("size", [(64, 64), ("h", "w")])
@pytest.mark.parametrize(("scale", "kind"), [(1.0, FLOAT), (255.0, FLOAT), (255.0, FLOAT16)])
def test_sizes_ranges_and_precisions(load, size, scale, kind):
    picture = np.full((90, 120, 3), (200, 100, 50), np.uint8)
    hole = hole_in(picture, slice(30, 50), slice(40, 70))
    seen = picture.copy()
    seen[hole] = (0, 255, 0)
    filled = load(mean_model(size, scale=scale, kind=kind))(seen, hole)
    assert (filled[~hole] == seen[~hole]).all()
    # Half a step of rounding, and of 16 bits at 200.
    assert np.abs(filled[hole].astype(int) - (200, 100, 50)).max() <= (1 if kind == FLOAT else 2)


def test_a_dark_picture_is_not_taken_for_another_range(load):
    picture = np.full((80, 80, 3), 1, np.uint8)
    hole = hole_in(picture, slice(20, 40), slice(20, 40))
    for scale in (1.0, 255.0):
        assert load(mean_model((64, 64), scale=scale))(picture, hole)[hole].max() <= 2


def test_picture_and_mask_in_one(load):
    picture = np.full((70, 90, 3), 255, np.uint8)
    hole = hole_in(picture, slice(10, 60), slice(20, 70))
    filled = load(stacked_model())(picture, hole)
    assert filled[35, 45].max() < 30, "black in the middle of the hole, where its border's white does not reach"
    assert (filled[~hole] == 255).all()


def test_no_edge_where_filling_and_photo_meet(load):
    picture = smooth()
    hole = hole_in(picture, slice(40, 100), slice(60, 140))
    # A model that is 0.1 too bright, everywhere, as models are that see another exposure.
    colour = picture[70, 100] / 255 + 0.1
    filled = load(constant_model(colour, size=("h", "w")))(picture, hole).astype(int)
    jumps = np.abs(np.diff(filled[70], axis=0)).max(axis=1)
    unblended = np.abs(picture[70, 59].astype(int) - np.round(colour * 255)).max()
    assert unblended > 25, "what the edge would be"
    assert jumps.max() <= 0.4 * unblended
    assert np.abs(filled[70, 100] - colour * 255).max() < 2, "far inside it is the model's own"


def test_every_hole_is_filled_also_at_the_border(load):
    picture = smooth()
    hole = hole_in(picture, slice(0, 30), slice(0, 20)) | hole_in(picture, slice(110, 150), slice(160, 200))
    hole |= hole_in(picture, slice(60, 61), slice(90, 91))
    seen = picture.copy()
    seen[hole] = (255, 0, 255)
    filled = load(mean_model((64, 64)))(seen, hole)
    assert (filled[hole] != (255, 0, 255)).any(axis=1).all()
    assert np.abs(filled[60, 90].astype(int) - picture[60, 90]).max() < 40, "small holes look at their surroundings"
    again = load(mean_model((64, 64)))(seen, hole)
    assert (again == filled).all()


def test_a_hole_that_is_the_picture(load):
    picture = smooth(40, 50)
    hole = np.ones(picture.shape[:2], dtype=bool)
    filled = load(constant_model([0.2, 0.4, 0.6]))(picture, hole)
    assert np.abs(filled.astype(int) - (51, 102, 153)).max() <= 1
    assert (load(constant_model([0.2, 0.4, 0.6]))(picture, ~hole) == picture).all()


def test_the_square_around_a_hole_lies_in_the_picture():
    for rows, columns in ((slice(0, 5), slice(0, 90)), (slice(95, 100), slice(3, 4)), (slice(0, 100), slice(0, 150))):
        part = np.zeros((100, 150), dtype=bool)
        part[rows, columns] = True
        a, b = square_around(part, 64)
        assert 0 <= a.start < a.stop <= 100 and 0 <= b.start < b.stop <= 150
        assert part[a, b].sum() == part.sum()
        assert a.stop - a.start >= 64 and b.stop - b.start >= 64


BAD = {
    "no model": (b"not a model at all", "not a model that onnxruntime can read"),
    "nothing": (b"", "not a model that onnxruntime can read"),
    "three inputs": (
        model(
            [("Add", ["image", "mask"], "x"), ("Add", ["x", "more"], "output")],
            [],
            [("image", FLOAT, [1, 3, 64, 64]), ("mask", FLOAT, [1, 1, 64, 64]), ("more", FLOAT, [1, 3, 64, 64])],
            [("output", FLOAT, [1, 3, 64, 64])],
        ),
        r"takes image \[1, 3, 64, 64\]",
    ),
    "a classifier": (
        model([("Relu", ["x"], "output")], [], [("x", FLOAT, [1, 1000])], [("output", FLOAT, [1, 1000])]),
        r"expected a picture 1x3xHxW",
    ),
    "bytes": (
        model(
            [("Add", ["image", "mask"], "output")],
            [],
            [("image", 6, [1, 3, 64, 64]), ("mask", 6, [1, 1, 64, 64])],
            [("output", 6, [1, 3, 64, 64])],
        ),
        "of floats",
    ),
}


@pytest.mark.parametrize("what", BAD)
def test_other_models_are_refused_at_once(load, what):
    content, words = BAD[what]
    with pytest.raises(InputError, match=f"model.onnx: .*{words}"):
        load(content)


def test_a_model_that_answers_nonsense(load):
    picture = smooth(60, 60)
    hole = hole_in(picture, slice(20, 30), slice(20, 30))
    with pytest.raises(InputError, match="not finite"):
        load(constant_model([struct.unpack("<f", b"\0\0\xc0\x7f")[0]] * 3))(picture, hole)
    pooled = model(
        [("GlobalAveragePool", ["image"], "x"), ("Add", ["x", "mask"], "y"), ("GlobalAveragePool", ["y"], "output")],
        [],
        [("image", FLOAT, [1, 3, 64, 64]), ("mask", FLOAT, [1, 1, 64, 64])],
        [("output", FLOAT, [1, 3, 1, 1])],
    )
    with pytest.raises(InputError, match=r"returned \(1, 3, 1, 1\)"):
        load(pooled)(picture, hole)


def test_a_model_that_is_not_there(tmp_path):
    with pytest.raises(InputError, match="nothing is downloaded"):
        resolve("inpainter", f"lama:{tmp_path / 'no.onnx'}")
    with pytest.raises(InputError, match="not a segmenter"):
        resolve("segmenter", f"lama:{tmp_path / 'no.onnx'}")
