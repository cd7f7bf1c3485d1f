# SPDX-License-Identifier: MIT
"""Score distillation: noise schedules, the ideal denoiser of a set of pictures, guidances that fail."""

from __future__ import annotations

import json
import math
import sys
from importlib import metadata

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.batch.commands.install_commands import diffusion_finding
from physgen.sim.errors import InputError, SimulationError
from physgen.sim.gaussians.guidance.diffusers_guidance import DiffusersGuidance, DiffusersOptions
from physgen.sim.gaussians.guidance.ideal_denoiser import IdealDenoiser
from physgen.sim.gaussians.guidance.pretrained_models import ClipScores
from physgen.sim.gaussians.guidance.score_distillation import (
    CheckedGuidance,
    NoiseSchedule,
    RenderedView,
    annealed_timestep,
    guidance_loss_gradient,
)
from physgen.sim.scene.model import Camera
from scipy.spatial.transform import Rotation
from scipy.special import logsumexp


def camera(size=(4, 5), turned=0.0):
    """Of (height, width) pixels, ``turned`` degrees about z."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("z", turned, degrees=True).as_matrix()
    matrix = tuple(tuple(float(v) for v in row) for row in pose)
    height, width = size
    return Camera(width=width, height=height, fx=9.0, fy=9.0, cx=width / 2, cy=height / 2, world_from_camera=matrix)


def pictures(count, size=(4, 5), seed=0):
    return np.random.default_rng(seed).uniform(0, 1, (count, *size, 3))


def seen(picture, turned=0.0, subject="frog"):
    return RenderedView(picture=picture, camera=camera(picture.shape[:2], turned), subject=subject)


def log_density(noisy, members, alpha, log_shares):
    """log p_t of ``noisy`` (D,) up to a constant: a Gaussian about each of √ᾱ ``members`` (M, D)."""
    distances = np.sum((noisy - math.sqrt(alpha) * members) ** 2, axis=1)
    return logsumexp(log_shares - distances / (2 * (1 - alpha)))


def test_default_schedule_is_stable_diffusions():
    schedule = NoiseSchedule()
    betas = (math.sqrt(0.00085) + (math.sqrt(0.012) - math.sqrt(0.00085)) * np.arange(1000) / 999) ** 2
    assert len(schedule) == 1000
    assert schedule.alpha(0) == pytest.approx(1 - 0.00085)
    assert schedule.alpha(999) == pytest.approx(math.exp(np.log1p(-betas).sum()))


def test_weights_are_those_of_the_papers():
    alpha = NoiseSchedule().alpha(60)
    assert NoiseSchedule().weight(60) == pytest.approx(1 - alpha)
    assert NoiseSchedule(weighting="constant").weight(60) == 1
    assert NoiseSchedule(weighting="signal-variance").weight(60) == pytest.approx(math.sqrt(alpha) * (1 - alpha))


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: NoiseSchedule(alphas_cumprod=np.linspace(0.1, 0.9, 20)), "strictly decreasing"),
        (lambda: NoiseSchedule(alphas_cumprod=np.full(20, np.nan)), "strictly decreasing"),
        (lambda: NoiseSchedule(alphas_cumprod=np.linspace(0.9, 0.0, 20)), "strictly decreasing"),
        (lambda: NoiseSchedule(alphas_cumprod=np.ones((3, 3))), "shape"),
        (lambda: NoiseSchedule(weighting="mine"), "weighting is 'mine'"),
        (lambda: NoiseSchedule().alpha(1000), "timestep is 1000"),
        (lambda: annealed_timestep(500, 500), "step is 500 of 500"),
        (lambda: annealed_timestep(0, 5, last=-1), "timesteps go from 100 to -1"),
    ],
)
def test_numbers_that_are_no_schedule_are_named(make, said):
    with pytest.raises(InputError, match=said):
        make()


def test_timesteps_fall_linearly_from_the_first_to_the_last():
    moments = [annealed_timestep(step, 500) for step in range(500)]
    assert (moments[0], moments[-1]) == (100, 20)
    np.testing.assert_allclose(moments, np.linspace(100, 20, 500), atol=0.5)
    assert annealed_timestep(0, 1) == 100


@pytest.mark.parametrize("moment", [0, 20, 100, 999])
@pytest.mark.parametrize("told", [False, True])
def test_the_score_is_the_gradient_of_the_log_density(moment, told):
    size, count = (2, 3), 4
    members = pictures(count, size)
    # Near each other, or early timesteps would tell them apart and the softmax would not be seen.
    members = 0.5 + 0.02 * (members - 0.5)
    denoiser = IdealDenoiser(members, cameras=[camera(size, 3.0 * i) for i in range(count)] if told else ())
    counted = denoiser.counted(seen(members[0], 0.5))
    assert list(counted) == [True, True, not told, not told]
    shares = np.where(counted, 0.0, -np.inf)
    alpha = denoiser.schedule.alpha(moment)
    flat = 2 * members.reshape(count, -1).astype(np.float32).astype(np.float64) - 1
    random = np.random.default_rng(1)
    noisy = math.sqrt(alpha) * flat.mean(axis=0) + math.sqrt(1 - alpha) * random.normal(size=flat.shape[1])
    step = 1e-5 * math.sqrt(1 - alpha)
    numeric = [
        (log_density(noisy + way, flat, alpha, shares) - log_density(noisy - way, flat, alpha, shares)) / (2 * step)
        for way in step * np.eye(noisy.size)
    ]
    score = -denoiser.noise(noisy.reshape(*size, 3), moment, counted).ravel() / math.sqrt(1 - alpha)
    np.testing.assert_allclose(score, numeric, rtol=1e-4, atol=1e-5 * np.abs(score).max())


@given(seed=st.integers(0, 2**32 - 1), moment=st.integers(0, 999), count=st.integers(1, 6), near=st.floats(0.001, 1))
def test_gradient_is_the_formula(seed, moment, count, near):
    members = 0.5 + near * (pictures(count, seed=seed) - 0.5)
    picture = 0.5 + near * (pictures(1, seed=seed + 1)[0] - 0.5)
    denoiser = IdealDenoiser(members)
    answer = denoiser.gradient(seen(picture), moment, np.random.default_rng(seed))
    alpha, noise = denoiser.schedule.alpha(moment), np.random.default_rng(seed).standard_normal(picture.size)
    flat = (2 * members.reshape(count, -1) - 1).astype(np.float32).astype(np.float64)
    noisy = math.sqrt(alpha) * (2 * picture.ravel() - 1) + math.sqrt(1 - alpha) * noise
    logits = -np.sum((noisy - math.sqrt(alpha) * flat) ** 2, axis=1) / (2 * (1 - alpha))
    mean = np.exp(logits - logsumexp(logits)) @ flat
    guess = (noisy - math.sqrt(alpha) * mean) / math.sqrt(1 - alpha)
    np.testing.assert_allclose(answer.ravel(), (1 - alpha) * (guess - noise) * 2, atol=1e-6)


def test_a_single_member_is_pulled_to_whatever_the_noise():
    member, picture = pictures(2)
    denoiser = IdealDenoiser(member[None])
    for seed in range(3):
        answer = denoiser.gradient(seen(picture), 60, np.random.default_rng(seed))
        alpha = denoiser.schedule.alpha(60)
        np.testing.assert_allclose(answer, 4 * math.sqrt(alpha * (1 - alpha)) * (picture - member), atol=1e-6)


def test_descent_ends_at_a_member():
    members = pictures(3)
    denoiser, random = IdealDenoiser(members), np.random.default_rng(5)
    picture = 0.6 * members[1] + 0.2 * (members[0] + members[2])
    for step in range(300):
        moment = annealed_timestep(step, 300)
        picture = picture - 0.2 * denoiser.gradient(seen(picture), moment, random)
    assert np.abs(picture - members[1]).max() < 1e-3


def test_views_and_subjects_choose_the_members():
    members = pictures(3)
    cameras = [camera(turned=turned) for turned in (0, 90, 180)]
    denoiser = IdealDenoiser(members, cameras=cameras)
    for turned, member in zip((0, 90, 180), members, strict=True):
        # The picture is another member's: without the camera, that one would be taken for it.
        other = members[0] if turned else members[2]
        answer = denoiser.gradient(seen(other, turned + 2), 20, np.random.default_rng(0))
        alone = IdealDenoiser(member[None]).gradient(seen(other), 20, np.random.default_rng(0))
        np.testing.assert_array_equal(answer, alone)
    with pytest.raises(InputError, match=r"rotated by 45\.0 degrees"):
        denoiser.gradient(seen(members[0], 45), 20, np.random.default_rng(0))
    named = IdealDenoiser(members[:2], subjects=["frog", "jersey"])
    answer = named.gradient(seen(members[0], subject="jersey"), 20, np.random.default_rng(0))
    assert np.abs(answer).max() > 0.1
    with pytest.raises(InputError, match="it has frog, jersey"):
        named.gradient(seen(members[0], subject="cup"), 20, np.random.default_rng(0))


def test_large_sets_are_exact_and_close_twins_are_told_apart():
    # Two pictures that differ in one pixel of 96²: their distances to the noise agree in six digits.
    size = (96, 96)
    members = np.repeat(pictures(1, size), 40, axis=0)
    members[7, 3, 4] = 1 - members[7, 3, 4]
    alpha = NoiseSchedule().alpha(20)
    clean = 2 * members[7] - 1
    noise = np.random.default_rng(0).standard_normal(clean.shape)
    noisy = math.sqrt(alpha) * clean + math.sqrt(1 - alpha) * noise
    mean = (noisy - math.sqrt(1 - alpha) * IdealDenoiser(members).noise(noisy, 20)) / math.sqrt(alpha)
    pixel, one, other = noisy[3, 4], clean[3, 4], 2 * members[0, 3, 4] - 1
    favour = (np.sum((pixel - math.sqrt(alpha) * other) ** 2) - np.sum((pixel - math.sqrt(alpha) * one) ** 2)) / (
        2 * (1 - alpha)
    )
    share = 1 / (1 + 39 * math.exp(-favour))
    np.testing.assert_allclose(mean[3, 4], share * one + (1 - share) * other, atol=1e-5)


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: IdealDenoiser(np.zeros((0, 4, 5, 3))), "shape"),
        (lambda: IdealDenoiser(np.zeros((4, 5, 3))), "shape"),
        (lambda: IdealDenoiser(np.full((1, 4, 5, 3), np.nan)), "picture 0"),
        (lambda: IdealDenoiser(np.full((1, 4, 5, 3), 255.0)), "picture 0"),
        (lambda: IdealDenoiser(np.broadcast_to(np.float32(0), (10**6, 256, 256, 3))), "GiB"),
        (lambda: IdealDenoiser(pictures(2), cameras=[camera()]), "1 cameras for 2"),
        (lambda: IdealDenoiser(pictures(2), subjects=["frog"]), "1 subjects for 2"),
        (lambda: IdealDenoiser(pictures(2), within=0), "within is 0"),
        (lambda: IdealDenoiser(pictures(1, (8, 8))).gradient(seen(pictures(1)[0]), 20, None), "at one size"),
        (lambda: seen(np.full((4, 5, 3), np.inf)), "not finite"),
        (lambda: RenderedView(picture=np.zeros((5, 4, 3)), camera=camera(), subject="frog"), "the camera's size"),
        (lambda: CheckedGuidance(IdealDenoiser(pictures(1)), most=0), "most is 0"),
    ],
)
def test_unusable_guidances_are_named(make, said):
    with pytest.raises(InputError, match=said):
        make()


class Scripted:
    """Gives what it is told to, one answer after another."""

    def __init__(self, *answers):
        self.answers = list(answers)

    def gradient(self, seen, timestep, random):
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return np.full(seen.picture.shape, answer)


def test_a_bad_answer_is_left_out_and_noted():
    watched, picture, random = CheckedGuidance(Scripted(1.0, np.nan, np.inf, 2.0, np.nan)), pictures(1)[0], None
    answers = [watched.gradient(seen(picture), 60, random).max() for _ in range(5)]
    assert answers == [1, 0, 0, 2, 0]
    assert (watched.calls, watched.bad, watched.bad_in_a_row) == (5, 3, 1)
    assert len(watched.notes) == 3 and "Scripted: its gradient at timestep 60 of 'frog'" in watched.notes[0]


def test_bad_answers_in_a_row_end_the_run_with_its_name():
    watched, picture = CheckedGuidance(Scripted(1.0, *[np.nan] * 5), name="mine"), pictures(1)[0]
    for _ in range(5):
        watched.gradient(seen(picture), 60, None)
    with pytest.raises(SimulationError, match=r"guidance mine: 5 gradients in a row .* \(5 of 6 in total\)"):
        watched.gradient(seen(picture), 60, None)


def test_a_wrong_shape_and_failing_code_are_told_at_once():
    class Flat:
        def gradient(self, seen, timestep, random):
            return np.zeros(3)

    with pytest.raises(InputError, match="guidance Flat: returned"):
        CheckedGuidance(Flat()).gradient(seen(pictures(1)[0]), 60, None)
    with pytest.raises(SimulationError, match=r"guidance Scripted: failed \(ValueError: oh"):
        CheckedGuidance(Scripted(ValueError("oh"))).gradient(seen(pictures(1)[0]), 60, None)
    with pytest.raises(InputError, match=r"^mine$"):
        CheckedGuidance(Scripted(InputError("mine"))).gradient(seen(pictures(1)[0]), 60, None)


def test_the_loss_takes_the_step_to_its_timestep_and_weighs():
    member, picture = pictures(2)
    denoiser = IdealDenoiser(member[None])
    given = {"guidance": denoiser, "random": np.random.default_rng(0), "steps": 500}
    answer = guidance_loss_gradient(picture, camera(), "frog", step=499, weight=0.5, **given)
    np.testing.assert_allclose(answer, 0.5 * denoiser.gradient(seen(picture), 20, np.random.default_rng(1)), atol=1e-12)
    # Not asked: it has no answer left.
    none = guidance_loss_gradient(picture, camera(), "frog", step=0, weight=0, **{**given, "guidance": Scripted()})
    assert not none.any()
    with pytest.raises(InputError, match="weight of the guidance is nan"):
        guidance_loss_gradient(picture, camera(), "frog", step=0, weight=math.nan, **given)


def test_doctor_says_what_a_diffusion_model_needs(monkeypatch):
    monkeypatch.setattr(metadata, "version", {"torch": "2.9", "diffusers": "0.35", "safetensors": "0.5"}.__getitem__)
    monkeypatch.setattr(metadata, "PackageNotFoundError", KeyError)
    _, fine, text = diffusion_finding()
    assert fine and "no transformers;" in text and "pip install 'physgen[diffusion]'" in text


def test_a_model_without_the_extra_names_it(tmp_path, monkeypatch):
    # As where it is not installed; nothing of the folder's weights is looked at before.
    for name in ("torch", "diffusers", "transformers"):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / "model_index.json").write_text('{"_class_name": "DDPMPipeline"}')
    (tmp_path / "config.json").write_text('{"model_type": "clip"}')
    for make in (DiffusersGuidance, ClipScores):
        with pytest.raises(InputError, match=r"needs torch .*pip install 'physgen\[diffusion\]'"):
            make(tmp_path)


@pytest.mark.parametrize("content", [b"", b"[]", b"\xff\xfe", b"[" * 10**5, b'"' + b"a" * 2**21 + b'"', b'{"a": NaN}'])
def test_an_index_that_is_none_is_told(tmp_path, content):
    (tmp_path / "model_index.json").write_bytes(content)
    with pytest.raises(InputError, match="diffusion model"):
        DiffusersGuidance(tmp_path)


@given(
    st.binary(max_size=200)
    | st.recursive(
        st.none() | st.floats() | st.text(max_size=5),
        lambda inner: st.dictionaries(st.sampled_from(["_class_name", "text_encoder", "x"]), inner) | st.lists(inner),
    ).map(lambda value: json.dumps(value).encode())
)
def test_any_index_is_told(tmp_path_factory, content):
    folder = tmp_path_factory.mktemp("any")
    (folder / "model_index.json").write_bytes(content)
    with pytest.raises(InputError):
        DiffusersGuidance(folder)


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"guidance_scale": 0.5}, "guidance_scale is 0.5"),
        ({"guidance_scale": math.nan}, "guidance_scale is nan"),
        ({"size": 5}, "size is 5"),
        ({"precision": "float8"}, "precision is 'float8'"),
        ({"weighting": "none"}, "weighting is 'none'"),
        ({"prompt": "a" * 2001}, "prompt is"),
    ],
)
def test_options_out_of_range_are_named(changes, said):
    with pytest.raises(InputError, match=said):
        DiffusersOptions(**changes)
