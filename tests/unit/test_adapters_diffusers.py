# SPDX-License-Identifier: MIT
"""Inpainting through diffusers: a tiny pipeline with random weights, written by the library itself."""

import json

import numpy as np
import pytest
from physgen.sim.errors import InputError
from physgen.sim.reconstruct.adapters import diffusers_adapter, resolve

KIND = "diffusers-inpaint"


def index(folder, **changes):
    content = {"_class_name": "StableDiffusionInpaintPipeline", "unet": ["diffusers", "UNet2DConditionModel"]}
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "model_index.json").write_text(json.dumps({**content, **changes}))
    return folder


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"_class_name": "DiffusionPipeline"}, "expected StableDiffusionInpaintPipeline"),
        ({"unet": ["evil", "Model"]}, "which is not opened"),
        ({"_class_name": 3}, "expected StableDiffusionInpaintPipeline"),
    ],
)
def test_what_is_no_inpainting_pipeline_is_refused_unopened(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        resolve("inpainter", f"{KIND}:{index(tmp_path / 'weights', **changes)}")


def test_a_folder_that_is_missing_or_damaged_is_told(tmp_path):
    with pytest.raises(InputError, match="there is no folder"):
        resolve("inpainter", f"{KIND}:{tmp_path / 'none'}")
    folder = index(tmp_path / "weights")
    (folder / "model_index.json").write_text("{")
    with pytest.raises(InputError, match=r"model_index\.json"):
        resolve("inpainter", f"{KIND}:{folder}")
    with pytest.raises(InputError, match="is an inpainter, not a segmenter"):
        resolve("segmenter", f"{KIND}:{folder}")


def test_without_weights_the_remedy_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("PHYSGEN_MODELS", str(tmp_path))
    with pytest.raises(InputError, match="--weights DIR"):
        resolve("inpainter", KIND)


def test_a_tiny_pipeline_fills_the_hole_and_nothing_else(tmp_path, monkeypatch):
    torch = pytest.importorskip("torch", reason="optional extra models")
    diffusers = pytest.importorskip("diffusers", reason="optional extra models")
    transformers = pytest.importorskip("transformers", reason="optional extra models")
    torch.manual_seed(1)
    letters = [chr(c) for c in range(33, 127)]
    words = ["<|startoftext|>", "<|endoftext|>", *letters, *[f"{c}</w>" for c in letters]]
    place = tmp_path / "tokenizer"
    place.mkdir()
    (place / "vocab.json").write_text(json.dumps({word: i for i, word in enumerate(words)}))
    (place / "merges.txt").write_text("#version: 0.2\n")
    (place / "tokenizer_config.json").write_text(
        json.dumps({"tokenizer_class": "CLIPTokenizer", "model_max_length": 20, "pad_token": "<|endoftext|>"})
    )
    text = transformers.CLIPTextConfig(
        vocab_size=len(words), hidden_size=16, intermediate_size=24, num_hidden_layers=1, num_attention_heads=2,
        max_position_embeddings=20, bos_token_id=0, eos_token_id=1, pad_token_id=1,
    )  # fmt: skip
    pipeline = diffusers.StableDiffusionInpaintPipeline(
        vae=diffusers.AutoencoderKL(
            block_out_channels=(8, 8), down_block_types=("DownEncoderBlock2D",) * 2,
            up_block_types=("UpDecoderBlock2D",) * 2, norm_num_groups=4, latent_channels=4,
        ),
        text_encoder=transformers.CLIPTextModel(text),
        tokenizer=transformers.CLIPTokenizer.from_pretrained(place),
        unet=diffusers.UNet2DConditionModel(
            sample_size=16, in_channels=9, out_channels=4, block_out_channels=(8, 16), layers_per_block=1,
            down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
            up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"), norm_num_groups=4, attention_head_dim=4,
            cross_attention_dim=16,
        ),
        scheduler=diffusers.DDIMScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear"),
        safety_checker=None, feature_extractor=None, requires_safety_checker=False,
    )  # fmt: skip
    folder = tmp_path / "weights"
    pipeline.save_pretrained(folder, safe_serialization=True)
    monkeypatch.setattr(diffusers_adapter, "STEPS", 3)
    inpainter = resolve("inpainter", f"{KIND}:{folder}")
    rows, columns = np.mgrid[:60, :90]
    pixels = np.stack([columns * 2, rows * 4, (rows + columns) % 256], axis=-1).astype(np.uint8)
    hole = (np.hypot(rows - 30, columns - 40) < 14) | ((abs(rows - 30) < 3) & (abs(columns - 80) < 3))
    given = pixels.copy()
    given[hole] = 255
    filled = inpainter(given, hole)
    assert (filled[~hole] == pixels[~hole]).all() and (filled[hole] != 255).any(axis=-1).mean() > 0.9
    assert (inpainter(given, hole) == filled).all()
