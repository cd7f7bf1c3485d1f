# SPDX-License-Identifier: MIT
"""Diffusion and CLIP models from local folders: tiny ones with random weights, written by the libraries themselves."""

from __future__ import annotations

import json
import math
import shutil
import socket

import numpy as np
import pytest
from physgen.sim.errors import InputError
from physgen.sim.gaussians.guidance.diffusers_guidance import DiffusersGuidance, DiffusersOptions
from physgen.sim.gaussians.guidance.pretrained_models import CLIP_MEAN, CLIP_STD, ClipScores
from physgen.sim.gaussians.guidance.score_distillation import RenderedView
from physgen.sim.scene.model import IDENTITY4, Camera

torch = pytest.importorskip("torch")
diffusers = pytest.importorskip("diffusers")
transformers = pytest.importorskip("transformers")

LATENT = 4
TEXT = {
    "vocab_size": 520,
    "hidden_size": 16,
    "intermediate_size": 24,
    "num_hidden_layers": 3,
    "num_attention_heads": 2,
    "max_position_embeddings": 20,
    "bos_token_id": 0,
    "eos_token_id": 1,
    "pad_token_id": 1,
    "projection_dim": 12,
}


def tokenizer(folder):
    """Of single characters, as CLIP's own falls back to."""
    folder.mkdir(parents=True)
    letters = [chr(c) for c in range(33, 127)]
    vocabulary = ["<|startoftext|>", "<|endoftext|>", "fr", *letters, *[f"{c}</w>" for c in letters]]
    (folder / "vocab.json").write_text(json.dumps({word: i for i, word in enumerate(vocabulary)}))
    (folder / "merges.txt").write_text("#version: 0.2\nf r\n")
    settings = {"tokenizer_class": "CLIPTokenizer", "model_max_length": 20, "pad_token": "<|endoftext|>"}
    (folder / "tokenizer_config.json").write_text(json.dumps(settings))
    return transformers.CLIPTokenizer.from_pretrained(folder)


def unet(channels, **changes):
    torch.manual_seed(1)
    return diffusers.UNet2DConditionModel(
        sample_size=8,
        in_channels=channels,
        out_channels=LATENT,
        block_out_channels=(8, 16),
        layers_per_block=1,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        norm_num_groups=4,
        attention_head_dim=4,
        **{"cross_attention_dim": 16, **changes},
    )


def vae():
    torch.manual_seed(2)
    return diffusers.AutoencoderKL(
        block_out_channels=(8, 8),
        down_block_types=("DownEncoderBlock2D",) * 2,
        up_block_types=("UpDecoderBlock2D",) * 2,
        norm_num_groups=4,
        latent_channels=LATENT,
        scaling_factor=0.3,
    )


def scheduler(**changes):
    given = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear", **changes}
    return diffusers.DDPMScheduler(**given)


def written(kind, folder, place, **changes):
    """The pipeline of ``kind`` as it is when it has been saved in ``folder``."""
    words, alone = tokenizer(place / f"words {kind}"), {"safety_checker": None, "feature_extractor": None}
    torch.manual_seed(3)
    text = transformers.CLIPTextModel(transformers.CLIPTextConfig(**TEXT))
    if kind == "pixels":
        torch.manual_seed(1)
        network = diffusers.UNet2DModel(
            sample_size=16,
            block_out_channels=(8, 8),
            layers_per_block=1,
            down_block_types=("DownBlock2D", "AttnDownBlock2D"),
            up_block_types=("AttnUpBlock2D", "UpBlock2D"),
            norm_num_groups=4,
        )
        pipe = diffusers.DDPMPipeline(network, scheduler(beta_schedule="linear", beta_end=0.02, **changes))
    elif kind == "text":
        pipe = diffusers.StableDiffusionPipeline(
            vae(), text, words, unet(LATENT), diffusers.PNDMScheduler.from_config(scheduler(**changes).config), **alone
        )
    elif kind == "inpaint":
        pipe = diffusers.StableDiffusionInpaintPipeline(
            vae(), text, words, unet(2 * LATENT + 1), scheduler(**changes), **alone
        )
    else:
        second = transformers.CLIPTextModelWithProjection(transformers.CLIPTextConfig(**TEXT))
        more = {"addition_embed_type": "text_time", "addition_time_embed_dim": 4, "cross_attention_dim": 32}
        network = unet(LATENT, projection_class_embeddings_input_dim=12 + 6 * 4, **more)
        pipe = diffusers.StableDiffusionXLPipeline(
            vae(), text, second, words, words, network, scheduler(**changes), add_watermarker=False
        )
    pipe.save_pretrained(folder, safe_serialization=True)
    return pipe


CASES = {
    "pixels": ("pixels", {}),
    "pixels told v": ("pixels", {"prediction_type": "v_prediction"}),
    "text": ("text", {}),
    "text told v": ("text", {"prediction_type": "v_prediction"}),
    "text told x": ("text", {"prediction_type": "sample"}),
    "inpaint": ("inpaint", {}),
    "xl": ("xl", {}),
}


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Pipelines and their folders by name, each written when it is first asked for."""
    place, kept = tmp_path_factory.mktemp("models"), {}

    def model(name):
        if name not in kept:
            kind, changes = CASES[name]
            spot = place / name
            kept[name] = (written(kind, spot / "pipeline", spot, **changes), spot / "pipeline")
        return kept[name]

    return model


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refused(*_, **__):
        raise AssertionError("something wants to go online")

    monkeypatch.setattr(socket.socket, "connect", refused)
    monkeypatch.setattr(socket, "getaddrinfo", refused)


def seen(size=(16, 16), subject="frog", seed=0):
    picture = np.random.default_rng(seed).uniform(0, 1, (*size, 3))
    camera = Camera(width=size[1], height=size[0], fx=9.0, fy=9.0, cx=8.0, cy=8.0, world_from_camera=IDENTITY4)
    return RenderedView(picture=picture, camera=camera, subject=subject)


def latents(pipe, picture):
    """z of a (1, 3, H, W) tensor from 0 to 1, as the pipeline itself makes it, in the tensor's precision."""
    if not hasattr(pipe, "vae"):
        return 2 * picture - 1
    return pipe.vae.to(picture.dtype).encode(2 * picture - 1).latent_dist.mode() * pipe.vae.config.scaling_factor


def residual(name, pipe, picture, moment, seed, scale):
    """ε̂ - ε by diffusers' own text encoding, noising and denoising."""
    ddpm = diffusers.DDPMScheduler.from_config(pipe.scheduler.config, clip_sample=False)
    with torch.no_grad():
        clean = latents(pipe, picture)
        noise = torch.tensor(np.random.default_rng(seed).standard_normal(tuple(clean.shape)), dtype=torch.float32)
        noisy = ddpm.add_noise(clean, noise, torch.tensor([moment]))
        if not hasattr(pipe, "vae"):
            output = pipe.unet(noisy, moment).sample
        else:
            given, outputs = noisy, []
            if name == "inpaint":
                grey = latents(pipe, torch.full_like(picture, 0.5))
                given = torch.cat([noisy, torch.ones_like(noisy[:, :1]), grey], dim=1)
            told = pipe.encode_prompt("frog", device="cpu", num_images_per_prompt=1, do_classifier_free_guidance=True)
            for i in (1, 0):
                more = None
                if name == "xl":
                    sizes = torch.tensor([[16.0, 16, 0, 0, 16, 16]])
                    more = {"text_embeds": told[2 + i], "time_ids": sizes}
                outputs.append(pipe.unet(given, moment, encoder_hidden_states=told[i], added_cond_kwargs=more).sample)
            output = outputs[0] + scale * (outputs[1] - outputs[0])
        clear = ddpm.step(output, moment, noisy).pred_original_sample
        alpha = float(ddpm.alphas_cumprod[moment])
        return (noisy - math.sqrt(alpha) * clear) / math.sqrt(1 - alpha) - noise, alpha


@pytest.mark.parametrize("name", CASES)
def test_gradient_is_the_formula_and_its_derivative_is_exact(models, name):
    pipe, folder = models(name)
    shown, moment = seen(), 60
    guidance = DiffusersGuidance(folder, DiffusersOptions(guidance_scale=7.5))
    answer = guidance.gradient(shown, moment, np.random.default_rng(4))
    picture = torch.tensor(shown.picture.transpose(2, 0, 1)[None])
    wanted, alpha = residual(name, pipe, picture.float(), moment, 4, 7.5)
    assert guidance.schedule.weight(moment) == pytest.approx(1 - alpha, rel=1e-4)
    # Finite differences of Σ w (ε̂ - ε) z in 64 bits, with the residual held, along random ways.
    random = np.random.default_rng(7)
    for _ in range(4):
        way = random.normal(size=answer.shape)
        step = torch.tensor(1e-5 * way.transpose(2, 0, 1)[None])
        with torch.no_grad():
            change = (latents(pipe, picture + step) - latents(pipe, picture - step)) / 2e-5
        numeric = float((1 - alpha) * (wanted.double() * change).sum())
        scale = float(np.linalg.norm(answer) * np.linalg.norm(way))
        assert abs(float(np.sum(answer * way)) - numeric) < 1e-4 * scale


def test_the_same_random_numbers_give_the_same_answer_and_words_count(models):
    _, folder = models("text")
    guidance = DiffusersGuidance(folder)
    first, again, other = (
        guidance.gradient(seen(subject=subject), 20, np.random.default_rng(1)) for subject in ("frog", "frog", "cup")
    )
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.01 * np.abs(first).max()
    told = DiffusersGuidance(folder, DiffusersOptions(prompt="cup"))
    np.testing.assert_array_equal(told.gradient(seen(), 20, np.random.default_rng(1)), other)


def test_other_sizes_are_scaled_there_and_the_gradient_back(models):
    pipe, folder = models("text")
    shown = seen((21, 30))
    answer = DiffusersGuidance(folder, DiffusersOptions(size=24)).gradient(shown, 60, np.random.default_rng(4))
    assert answer.shape == (21, 30, 3) and np.isfinite(answer).all() and np.abs(answer).max() > 0
    # 30 becomes 24, 21 becomes 16.8 and then 16, a multiple of the 4 pixels that encoder and UNet can halve.
    picture = torch.tensor(shown.picture.transpose(2, 0, 1)[None], dtype=torch.float32)
    scaled = torch.nn.functional.interpolate(picture, size=(16, 24), mode="bilinear", antialias=True)
    wanted, alpha = residual("text", pipe, scaled, 60, 4, 7.5)
    picture.requires_grad_()
    scaled = torch.nn.functional.interpolate(picture, size=(16, 24), mode="bilinear", antialias=True)
    (numeric,) = torch.autograd.grad(latents(pipe, scaled), picture, grad_outputs=(1 - alpha) * wanted)
    np.testing.assert_allclose(answer, numeric[0].numpy().transpose(1, 2, 0), atol=1e-4 * np.abs(answer).max())


def test_half_precision_stays_near(models):
    _, folder = models("xl")
    exact, half = (
        DiffusersGuidance(folder, DiffusersOptions(precision=precision)).gradient(seen(), 60, np.random.default_rng(1))
        for precision in ("float32", "bfloat16")
    )
    assert np.linalg.norm(exact - half) < 0.05 * np.linalg.norm(exact)


def edited(folder, place, name, **changes):
    """A copy of ``folder`` whose JSON file ``name`` says something else."""
    shutil.copytree(folder, place)
    file = place / name
    file.write_text(json.dumps({**json.loads(file.read_text()), **changes}))
    return place


def test_folders_that_cannot_be_used_are_told(models, tmp_path):
    _, text = models("text")
    _, pixels = models("pixels")
    index, noise = "model_index.json", "scheduler/scheduler_config.json"
    (tmp_path / "empty").mkdir()
    (tmp_path / "all.safetensors").write_bytes(b"")
    cases = [
        (tmp_path / "nowhere", "no such folder"),
        (tmp_path / "all.safetensors", "is a file"),
        (tmp_path / "empty", "has no model_index.json"),
        (edited(text, tmp_path / "a", index, _class_name="FluxPipeline"), "is a FluxPipeline: give one of"),
        (edited(text, tmp_path / "b", index, _class_name=["mine", "Mine"]), r"is a \['mine', 'Mine'\]"),
        (edited(text, tmp_path / "c", noise, prediction_type="flow"), "predicts 'flow'"),
        (edited(text, tmp_path / "d", noise, trained_betas=[0.5] * 3), "alphas_cumprod has shape"),
        (edited(text, tmp_path / "e", "unet/config.json", block_out_channels=[8, 32]), "cannot be used|lack"),
        (edited(pixels, tmp_path / "f", "unet/config.json", num_class_embeds=3), "lack|conditioned on a class"),
    ]
    whole = tmp_path / "g"
    shutil.copytree(text, whole)
    weights = whole / "unet/diffusion_pytorch_model.safetensors"
    weights.rename(whole / "unet/diffusion_pytorch_model.bin")
    cases.append((whole, r"diffusion_pytorch_model.bin is a pickle.*safe_serialization=True"))
    cut = tmp_path / "h"
    shutil.copytree(text, cut)
    data = (cut / "vae/diffusion_pytorch_model.safetensors").read_bytes()
    (cut / "vae/diffusion_pytorch_model.safetensors").write_bytes(data[: len(data) // 2])
    cases.append((cut, "cannot be used"))
    for part in ("vae", "text_encoder", "tokenizer", "scheduler"):
        lacking = tmp_path / f"no {part}"
        shutil.copytree(text, lacking)
        shutil.rmtree(lacking / part)
        cases.append((lacking, "has no|cannot be used"))
    for folder, said in cases:
        with pytest.raises(InputError, match=said):
            DiffusersGuidance(folder)
    flow = tmp_path / "flow"
    shutil.copytree(text, flow)
    (flow / noise).write_text(json.dumps({"_class_name": "FlowMatchEulerDiscreteScheduler"}))
    with pytest.raises(InputError, match="no beta_schedule"):
        DiffusersGuidance(flow)
    with pytest.raises(InputError, match="device 'abacus' cannot be used"):
        DiffusersGuidance(text, DiffusersOptions(device="abacus"))


def test_weights_of_another_model_are_not_left_random(models, tmp_path):
    _, folder = models("pixels")
    from safetensors.torch import load_file, save_file

    lacking = tmp_path / "lacking"
    shutil.copytree(folder, lacking)
    file = lacking / "unet/diffusion_pytorch_model.safetensors"
    tensors = load_file(file)
    del tensors["conv_in.weight"]
    save_file(tensors, file, metadata={"format": "pt"})
    with pytest.raises(InputError, match=r"lack 1 of the model's tensors \(conv_in.weight"):
        DiffusersGuidance(lacking)


def test_weights_of_a_variant_are_found(models, tmp_path):
    _, folder = models("pixels")
    shutil.copytree(folder, tmp_path / "half")
    weights = tmp_path / "half/unet/diffusion_pytorch_model.safetensors"
    weights.rename(weights.with_name("diffusion_pytorch_model.fp16.safetensors"))
    plain, variant = (
        DiffusersGuidance(place).gradient(seen(), 60, np.random.default_rng(0)) for place in (folder, tmp_path / "half")
    )
    np.testing.assert_array_equal(plain, variant)


def test_too_little_memory_is_told(models, monkeypatch):
    _, folder = models("pixels")
    guidance = DiffusersGuidance(folder)

    def full(*_, **__):
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20 GiB")

    monkeypatch.setattr(diffusers.UNet2DModel, "forward", full)
    with pytest.raises(InputError, match=r"not enough memory .* smaller size"):
        guidance.gradient(seen(), 60, np.random.default_rng(0))


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clip")
    torch.manual_seed(5)
    vision = {
        "hidden_size": 16,
        "intermediate_size": 24,
        "num_hidden_layers": 2,
        "num_attention_heads": 2,
        "image_size": 12,
        "patch_size": 4,
    }
    model = transformers.CLIPModel(transformers.CLIPConfig(text_config=TEXT, vision_config=vision, projection_dim=12))
    model.eval().save_pretrained(folder / "clip", safe_serialization=True)
    words = tokenizer(folder / "words")
    words.save_pretrained(folder / "clip")
    return model, words, folder / "clip"


def test_clip_scores_are_the_models_own(clip):
    model, words, folder = clip
    scores = ClipScores(folder)
    a, b = (np.random.default_rng(i).uniform(0, 1, (12, 12, 3)) for i in range(2))
    pixels = (np.stack([a, b]) - CLIP_MEAN) / CLIP_STD
    ids = words("a frog", padding="max_length", max_length=20, truncation=True, return_tensors="pt").input_ids
    with torch.no_grad():
        answer = model(input_ids=ids, pixel_values=torch.tensor(pixels.transpose(0, 3, 1, 2), dtype=torch.float32))
    alike = float(answer.image_embeds[0] @ answer.image_embeds[1])
    fits = float(answer.text_embeds[0] @ answer.image_embeds[0])
    assert scores.image(a, b) == pytest.approx(100 * alike, abs=1e-3)
    assert scores.text(a, "a frog") == pytest.approx(100 * fits, abs=1e-3)
    assert scores.image(a, a) == pytest.approx(100, abs=1e-3)
    # Twice as large, pixel for pixel the same: only the scaling in between may differ.
    assert scores.image(a, np.kron(a, np.ones((2, 2, 1)))) == pytest.approx(100, abs=1)
    assert -100 <= scores.text(np.ones((20, 33, 3)), "a frog that wears a jersey " * 20) <= 100


def test_clip_folders_that_cannot_be_used_are_told(clip, models, tmp_path):
    _, _, folder = clip
    with pytest.raises(InputError, match="no such folder"):
        ClipScores(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"has no config\.json"):
        ClipScores(models("text")[1])
    with pytest.raises(InputError, match="expected 'clip'"):
        ClipScores(edited(folder, tmp_path / "other", "config.json", model_type="siglip"))
    (tmp_path / "other/config.json").write_bytes((folder / "config.json").read_bytes())
    (tmp_path / "other/preprocessor_config.json").write_text('{"image_std": [1, 0, 1]}')
    with pytest.raises(InputError, match="gives image_std"):
        ClipScores(tmp_path / "other")
    with pytest.raises(InputError, match="picture has shape"):
        ClipScores(folder).image(np.zeros((4, 4)), np.zeros((4, 4)))
