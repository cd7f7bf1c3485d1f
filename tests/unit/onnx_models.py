# SPDX-License-Identifier: MIT
"""Real ONNX models of a few operators, written byte by byte.

The package that makes such files is 9 MB for what takes thirty lines: a model is nested protocol buffers (onnx.proto,
field numbers below).
"""

import numpy as np

FLOAT, FLOAT16 = 1, 10


def varint(value):
    parts = []
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    return bytes([*parts, value])


def field(number, value):
    """One field: a message or text, or a whole number."""
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    value = value.encode() if isinstance(value, str) else value
    return varint(number << 3 | 2) + varint(len(value)) + value


def tensor_type(name, kind, shape):
    dims = b"".join(field(1, field(2, d) if isinstance(d, str) else field(1, d)) for d in shape)
    return field(1, name) + field(2, field(1, field(1, kind) + field(2, dims)))


def constant(name, values, kind=FLOAT):
    values = np.asarray(values, dtype=np.float32 if kind == FLOAT else np.float16)
    dims = b"".join(field(1, d) for d in values.shape)
    return dims + field(2, kind) + field(8, name) + field(9, values.tobytes())


def node(operator, inputs, output):
    return b"".join(field(1, i) for i in inputs) + field(2, output) + field(4, operator)


def model(nodes, constants, inputs, outputs):
    """nodes: (operator, inputs, output); inputs, outputs: (name, element kind, shape)."""
    graph = b"".join(field(1, node(*n)) for n in nodes) + field(2, "graph")
    graph += b"".join(field(5, c) for c in constants)
    graph += b"".join(field(11, tensor_type(*i)) for i in inputs) + b"".join(
        field(12, tensor_type(*o)) for o in outputs
    )
    return field(1, 8) + field(7, graph) + field(8, field(1, "") + field(2, 13))


def colour_segmenter(weights=(1.0, -0.5, -0.5), bias=-0.2, sharpness=40.0, side=1024):
    """IS-Net's form: opacity 1 where the weighted sum of (value - 128) / 256 exceeds -bias; by default where it is
    red."""
    kernel = sharpness * np.reshape(weights, (1, 3, 1, 1))
    nodes = [
        ("Conv", ["input", "weights"], "sum"),
        ("Add", ["sum", "bias"], "logit"),
        ("Sigmoid", ["logit"], "alpha"),
    ]
    constants = [constant("weights", kernel), constant("bias", np.reshape([sharpness * bias], (1, 1, 1, 1)))]
    inputs, outputs = [("input", FLOAT, [1, 3, side, side])], [("alpha", FLOAT, [1, 1, side, side])]
    return model(nodes, constants, inputs, outputs)


def constant_segmenter(value, side=1024):
    """IS-Net's form, with the same answer everywhere: such as NaN."""
    nodes = [("Conv", ["input", "zero"], "black"), ("Add", ["black", "value"], "alpha")]
    constants = [constant("zero", np.zeros((1, 3, 1, 1))), constant("value", np.reshape([value], (1, 1, 1, 1)))]
    return model(nodes, constants, [("input", FLOAT, [1, 3, side, side])], [("alpha", FLOAT, [1, 1, side, side])])
