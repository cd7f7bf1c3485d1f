# SPDX-License-Identifier: MIT
"""A video by itself and the page: closed forms, sanity videos, a network's flow, and a page that holds nothing else."""

import itertools
import re
import xml.etree.ElementTree as ElementTree

import cv2
import numpy as np
import physgen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from physgen.sim.composite.image_metrics import ssim, ssim_map
from physgen.sim.errors import InputError
from physgen.sim.evaluate.evaluation import Curve, Evaluation, Measure, Section, evaluation_json, table
from physgen.sim.evaluate.flow import between, dis_flow, network_flow
from physgen.sim.evaluate.report import chart, page

from .onnx_models import FLOAT, model

TEXTURE = cv2.GaussianBlur(np.random.default_rng(1).integers(0, 256, (140, 260, 3), dtype=np.uint8), (7, 7), 0)
TEXTURE = cv2.normalize(TEXTURE, None, 0, 255, cv2.NORM_MINMAX)


def moving(count=16, step=4):
    """A textured square that moves to the right over another texture."""
    for i in range(count):
        frame = (TEXTURE[:120, :240] // 8 + 60).astype(np.uint8)
        frame[40:80, 20 + step * i : 60 + step * i] = TEXTURE[90:130, 100:140]
        yield frame


def folder(path, frames):
    path.mkdir()
    for i, frame in enumerate(frames, 1):
        cv2.imwrite(str(path / f"{i:04d}.png"), frame)
    return path


def figures(path, frames, **options):
    settings_ = physgen.EvaluateOptions(fps=24.0)
    found = physgen.evaluate(folder(path, frames), out=path.with_name(f"{path.name}_out"), options=settings_, **options)
    return {item.name: item.value for item in found.measures}, found


def test_dis_flow_finds_a_shift_and_the_frame_between():
    a, b = TEXTURE[:120, 6:246], TEXTURE[:120, :240]
    flow = dis_flow()(a, b)
    assert np.median(flow[20:-20, 20:-20], axis=(0, 1)) == pytest.approx((6.0, 0.0), abs=0.1)
    made, true = between(a, b, dis_flow()), TEXTURE[:120, 3:243]
    inner = (slice(20, -20), slice(20, -20))
    assert (
        np.abs(made[inner].astype(int) - true[inner]).mean() < 0.1 * np.abs(a[inner].astype(int) - true[inner]).mean()
    )
    assert np.array_equal(between(a, a, dis_flow()), a)
    assert dis_flow()(a[:9, :9], b[:9, :9]).shape == (9, 9, 2)


def test_sanity_videos_by_themselves(tmp_path):
    smooth, found = figures(tmp_path / "smooth", moving())
    rng = np.random.default_rng(0)
    # The mean difference of successive frames, by hand.
    frames = [frame.astype(int) for frame in moving()]
    by_hand = np.mean([np.abs(b - a).mean() for a, b in itertools.pairwise(frames)])
    assert smooth["temporal_flickering"] == pytest.approx(1 - by_hand / 255)
    # 4 px a frame at 24 a second over 120 px, of a square that fills more than the fastest twentieth.
    assert smooth["motion_speed"] == pytest.approx(4 * 24 / 120, rel=0.1)
    assert smooth["dynamic_degree"] == 1 and smooth["background_psnr"] == np.inf
    assert [item.name for item in found.below_still] == [
        "temporal_flickering",
        "motion_smoothness",
        "interpolation_error",
    ]

    still, found = figures(tmp_path / "still", [next(moving())] * 9)
    assert still["temporal_flickering"] == still["motion_smoothness"] == still["background_ssim"] == 1
    assert still["motion_speed"] == still["dynamic_degree"] == still["moving_area"] == 0
    assert any("nothing moves" in text for text in found.notices) and not found.below_still

    # Backwards: nothing here knows which way time runs.
    back, _ = figures(tmp_path / "back", list(moving())[::-1])
    assert back["temporal_flickering"] == pytest.approx(smooth["temporal_flickering"])
    assert back["motion_speed"] == pytest.approx(smooth["motion_speed"], rel=0.15)

    noise, _ = figures(tmp_path / "noise", rng.integers(0, 256, (9, 120, 240, 3), dtype=np.uint8))
    # Two independent uniform values of 0 to 255 differ by 85 in the mean.
    assert noise["temporal_flickering"] == pytest.approx(1 - 85.33 / 255, abs=0.01)
    assert noise["interpolation_error"] > 5 * smooth["interpolation_error"]

    shaken = [np.roll(frame, (-1) ** i * 3, axis=1) for i, frame in enumerate(moving())]
    assert figures(tmp_path / "shaken", shaken)[0]["interpolation_error"] > 2 * smooth["interpolation_error"]

    repeated = [frame for frame in moving(8) for _ in range(2)]
    stutter, _ = figures(tmp_path / "stutter", repeated)
    assert stutter["interpolation_error"] > smooth["interpolation_error"]


def test_first_frame_and_background_are_compared_where_nothing_moves(tmp_path):
    frames = list(moving(6))
    cv2.imwrite(str(tmp_path / "photo.png"), frames[0])
    for i, frame in enumerate(frames[1:], 1):
        # Three grey levels off in a part that never moves.
        frame[:20] = np.clip(frame[:20].astype(int) + 3, 0, 255)
        frames[i] = frame
    found, evaluation = figures(tmp_path / "v", frames, photo=tmp_path / "photo.png")
    assert found["first_frame_psnr"] == np.inf and found["first_frame_ssim"] == pytest.approx(1)
    first = {m["name"]: m for m in evaluation_json(evaluation)["sections"][0]["measures"]}["first_frame_psnr"]
    assert first["value"] is None and first["note"] == "equal"
    assert 38 < found["background_psnr"] < 50
    without, _ = figures(tmp_path / "w", frames)
    assert without["first_frame_psnr"] is None
    cv2.imwrite(str(tmp_path / "wide.png"), np.hstack([frames[0], frames[0]]))
    _, evaluation = figures(tmp_path / "s", frames, photo=tmp_path / "wide.png")
    assert "stretched to the frame's" in next(m.note for m in evaluation.measures if m.name == "first_frame_psnr")
    everywhere = [np.full((60, 60, 3), 255 * (i % 2), np.uint8) for i in range(4)]
    found, evaluation = figures(tmp_path / "x", everywhere)
    assert found["background_psnr"] is None
    assert "never moves" in next(m.note for m in evaluation.measures if m.name == "background_psnr")


def test_a_video_of_one_frame_or_two_is_said(tmp_path):
    with pytest.raises(InputError, match="one frame long"):
        figures(tmp_path / "one", moving(1))
    two, found = figures(tmp_path / "two", moving(2))
    assert two["motion_smoothness"] is None and two["motion_speed"] is None
    assert next(m.note for m in found.measures if m.name == "motion_smoothness") == "needs three frames"
    short = physgen.EvaluateOptions(fps=24.0, seconds=0.04)
    with pytest.raises(InputError, match=r"seconds is 0.04: two has 24 frames per second; give 0.083 or more"):
        physgen.evaluate(tmp_path / "two", out=tmp_path / "short", options=short)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_map_of_structural_similarity_has_the_mean_of_the_figure(seed):
    a, b = np.random.default_rng(seed).random((2, 20, 24, 3))
    assert ssim_map(a, b).mean() == pytest.approx(ssim(a, b))
    assert np.abs(ssim_map(a, b)).max() <= 1 + 1e-9 and ssim_map(a, a) == pytest.approx(1)


def difference_network(path):
    """The difference of two pictures: of three channels, and so no flow."""
    shape = (1, 3, "h", "w")
    inputs = [("a", FLOAT, shape), ("b", FLOAT, shape)]
    path.write_bytes(model([("Sub", ["a", "b"], "flow")], [], inputs, [("flow", FLOAT, shape)]))
    return path


def test_a_network_of_another_form_is_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(InputError, match="not a model"):
        network_flow(tmp_path / "text.onnx")
    frame = TEXTURE[:64, :64]
    with pytest.raises(InputError, match=r"gave \(1, 3, 64, 64\); its last output has to be a finite \(1, 2, 64, 64\)"):
        network_flow(difference_network(tmp_path / "three.onnx"))(frame, frame)


HOSTILE = "<script>alert(1)</script>\"'&]]> \u202egnp\x00\ud800" + "x" * 300


def test_the_page_holds_nothing_foreign_and_nothing_of_its_own_but_style():
    times = np.arange(4.0)
    curves = tuple(
        Curve(name="m", title=HOSTILE, label=HOSTILE + str(i), times=times, values=times * i) for i in range(8)
    )
    odd = Curve(name="n", title="nothing known", times=times, values=np.full(4, np.nan))
    measures = (
        Measure(name="m", title=HOSTILE, value=float("inf"), better="higher", still=2.0, note=HOSTILE),
        Measure(name="n", title="unknown", value=None, note="why"),
    )
    section = Section(
        name="s", title=HOSTILE, text=HOSTILE, measures=measures, curves=(*curves, odd), notices=(HOSTILE,)
    )
    text = page(Evaluation(root=None, subject=HOSTILE, sections=(section,)), [TEXTURE[:40, :60]])
    ElementTree.fromstring(text[text.index("<html") :])
    assert "<script" not in text and "\u202e" not in text and "Content-Security-Policy" in text
    assert not re.findall(r'(?:src|href)="(?!data:image/jpeg)', text)
    assert "∞" in text and "why" in text and chart([odd]) is None
    rows = table(iter([["a"], ["=1+1"], [None]])).decode().splitlines()
    assert rows == ["a", "'=1+1", '""']
