# SPDX-License-Identifier: MIT
"""A guidance by a diffusion model of a user's own: the folder that diffusers' save_pretrained wrote.

Stable Diffusion 1 and 2 and SDXL, from text to image or for inpainting, and unconditional models of pixels. Nothing is
downloaded or sent, nothing is unpickled, and no code out of the folder runs: the networks are built by classes chosen
here, from its numbers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import InputError
from .diffusion_parts import LatentParts, Parts, PixelParts
from .local_model import PRECISIONS, chosen_device, library, load_model, read_json, told
from .prompts import TextEncoders
from .protocol import Array, Seen
from .schedule import WEIGHTINGS, NoiseSchedule

PIXEL_PIPELINES = ("DDPMPipeline", "DDIMPipeline")
TEXT_PIPELINES = ("StableDiffusionPipeline", "StableDiffusionImg2ImgPipeline", "StableDiffusionInpaintPipeline")
XL_PIPELINES = ("StableDiffusionXLPipeline", "StableDiffusionXLImg2ImgPipeline", "StableDiffusionXLInpaintPipeline")
PREDICTIONS = ("epsilon", "v_prediction", "sample")

_WHOLE = "give the folder that a diffusers pipeline wrote with save_pretrained"


@dataclass(frozen=True, kw_only=True)
class DiffusersOptions:
    """How a diffusion model is asked. Raises InputError on a value out of range."""

    prompt: str = ""
    """What the pictures show, in words, up to 2000 characters; empty: the subject's name. Models of pixels are told
    nothing."""

    negative_prompt: str = ""
    """What they do not show, up to 2000 characters."""

    guidance_scale: float = 7.5
    """How much more what is told counts than what is likely anyway: 1 (no more, and twice as fast) to 200. PhyCAGE uses
    7.5 to 12.5, DreamFusion 100."""

    size: int | None = None
    """Pixels of the longer side of what the model sees, 8 to 4096; None: what it was trained on. Pictures are scaled to
    it, and the gradient back."""

    device: str = "cpu"
    """Where it computes, in PyTorch's words: "cpu", "cuda", "cuda:1", "mps"."""

    precision: str = "float32"
    """Of the UNet and the text encoders: "float32", "float16" or "bfloat16". The encoder of pictures always has
    float32: SDXL's overflows in 16 bits."""

    weighting: str = "variance"
    """w(t), as ``schedule.NoiseSchedule`` says."""

    def __post_init__(self) -> None:
        for name in ("prompt", "negative_prompt"):
            text = getattr(self, name)
            if not isinstance(text, str) or len(text) > 2000:
                raise InputError(f"guidance option {name} is {str(text)[:40]!r}…: give up to 2000 characters")
        if not (math.isfinite(self.guidance_scale) and 1 <= self.guidance_scale <= 200):
            raise InputError(f"guidance option guidance_scale is {self.guidance_scale!r}: give 1 to 200; 7.5 is usual")
        if self.size is not None and not (isinstance(self.size, int) and 8 <= self.size <= 4096):
            raise InputError(
                f"guidance option size is {self.size!r}: give 8 to 4096 pixels, or none for the model's own"
            )
        for name, choices in (("precision", PRECISIONS), ("weighting", WEIGHTINGS)):
            if getattr(self, name) not in choices:
                raise InputError(
                    f"guidance option {name} is {getattr(self, name)!r}: choose one of {', '.join(choices)}"
                )


class DiffusersGuidance:
    """``Guidance`` by the pipeline in ``folder``; only its networks, tokenizers and noise schedule are read.

    Raises InputError where the optional extra is missing, the folder is none of a pipeline that is known, its weights
    are pickled or incomplete, or there is not enough memory.
    """

    def __init__(self, folder: Path, options: DiffusersOptions | None = None) -> None:
        self.options = options or DiffusersOptions()
        self.name = f"diffusion model {folder}"
        kind = _kind(folder, self.name)
        self._torch = library("torch", self.name)
        self._device = chosen_device(self._torch, self.options.device, self.name)
        self.schedule, self._prediction = _schedule(folder, self.name, self.options.weighting)
        self._parts = self._load(folder, *kind)

    def gradient(self, seen: Seen, timestep: int, random: np.random.Generator) -> Array:
        """As ``Guidance`` says; ∂z/∂picture goes through the scaling to the model's size and the encoder, exactly."""
        alpha, weight = self.schedule.alpha(timestep), self.schedule.weight(timestep)
        text = self.options.prompt or seen.subject
        torch = self._torch
        with told(self.name, "give a smaller size, precision float16 on a GPU, or a smaller model"):
            given = np.ascontiguousarray(np.moveaxis(seen.picture, 2, 0)[None], dtype=np.float32)
            picture = torch.tensor(given, device=self._device, requires_grad=True)
            with torch.enable_grad():
                clean = self._parts.latents(self._scaled(2 * picture - 1))
            with torch.no_grad():
                drawn = random.standard_normal(tuple(clean.shape)).astype(np.float32)
                noise = torch.tensor(drawn, device=self._device)
                noisy = math.sqrt(alpha) * clean + math.sqrt(1 - alpha) * noise
                guess = self._noise(self._parts.output(noisy, timestep, text), noisy, alpha)
                residual = weight * (guess - noise)
            (answer,) = torch.autograd.grad(clean, picture, grad_outputs=residual)
            return np.moveaxis(answer[0].cpu().numpy().astype(np.float64), 0, 2)

    def _noise(self, output: Any, noisy: Any, alpha: float) -> Any:
        """ε̂ from what the network was trained to say (Salimans and Ho 2022, §4)."""
        if self._prediction == "v_prediction":
            return math.sqrt(alpha) * output + math.sqrt(1 - alpha) * noisy
        if self._prediction == "sample":
            return (noisy - math.sqrt(alpha) * output) / math.sqrt(1 - alpha)
        return output

    def _scaled(self, picture: Any) -> Any:
        """``picture`` (1, 3, H, W) at the model's size, its sides rounded to what the networks can halve."""
        height, width = picture.shape[2:]
        scale, step = (self.options.size or self._parts.size) / max(height, width), self._parts.step
        sides = tuple(max(step, round(side * scale / step) * step) for side in (height, width))
        if sides == (height, width):
            return picture
        return self._torch.nn.functional.interpolate(
            picture, size=sides, mode="bilinear", antialias=True, align_corners=False
        )

    def _load(self, folder: Path, kind: str, index: dict[str, Any]) -> Parts:
        diffusers, torch, options = library("diffusers", self.name), self._torch, self.options
        dtype = getattr(torch, options.precision)
        with told(self.name):
            pixels, latents, encoder = diffusers.UNet2DModel, diffusers.UNet2DConditionModel, diffusers.AutoencoderKL
        if kind in PIXEL_PIPELINES:
            unet = load_model(pixels, folder / "unet", self.name, device=self._device, dtype=dtype)
            return PixelParts(unet, self.name)
        return LatentParts(
            unet=load_model(latents, folder / "unet", self.name, device=self._device, dtype=dtype),
            vae=load_model(encoder, folder / "vae", self.name, device=self._device, dtype=torch.float32),
            texts=TextEncoders(
                folder,
                self.name,
                two=kind in XL_PIPELINES,
                zero_empty=kind in XL_PIPELINES and bool(index.get("force_zeros_for_empty_prompt", True)),
                device=self._device,
                dtype=dtype,
            ),
            guidance_scale=options.guidance_scale,
            negative_prompt=options.negative_prompt,
            where=self.name,
        )


def _kind(folder: Path, where: str) -> tuple[str, dict[str, Any]]:
    """The pipeline's class, one of those known, and its index."""
    if folder.is_file():
        raise InputError(f"{where}: is a file: {_WHOLE}; one file with all weights is converted by diffusers first")
    if not folder.is_dir():
        raise InputError(f"{where}: there is no such folder; the model is yours to bring, nothing is downloaded")
    index = read_json(folder / "model_index.json", where, _WHOLE)
    kind = index.get("_class_name")
    known = (*TEXT_PIPELINES, *XL_PIPELINES, *PIXEL_PIPELINES)
    if kind not in known:
        raise InputError(f"{where}: is a {str(kind)[:80]}: give one of {', '.join(known)}")
    encoder = index.get("text_encoder", [])
    if index.get("requires_aesthetics_score") or encoder is None or (isinstance(encoder, list) and None in encoder):
        raise InputError(f"{where}: is a refiner, which goes on from another model's pictures: give the base model")
    return str(kind), index


def _schedule(folder: Path, where: str, weighting: str) -> tuple[NoiseSchedule, str]:
    """Its noise, whatever sampler it came with: samplers differ in their steps, not in what the model was taught."""
    config = read_json(folder / "scheduler" / "scheduler_config.json", where, _WHOLE)
    if "beta_schedule" not in config:
        raise InputError(
            f"{where}: its scheduler {str(config.get('_class_name'))[:60]} has no beta_schedule: give a model "
            "trained on discrete timesteps (DDPM), not one of flows or of continuous noise"
        )
    prediction = config.get("prediction_type", "epsilon")
    if prediction not in PREDICTIONS:
        raise InputError(f"{where}: predicts {str(prediction)[:60]!r}: give a model of {', '.join(PREDICTIONS)}")
    diffusers = library("diffusers", where)
    with told(where):
        scheduler = diffusers.DDPMScheduler.from_pretrained(str(folder / "scheduler"), local_files_only=True)
        alphas = scheduler.alphas_cumprod.double().numpy()
    # Rescaled to end in pure noise, the last ᾱ is 0; nothing can be distilled there.
    return NoiseSchedule(alphas_cumprod=alphas[alphas > 0], weighting=weighting), str(prediction)
