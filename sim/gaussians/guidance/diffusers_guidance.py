# SPDX-License-Identifier: MIT
"""A guidance from a local diffusion model: the folder that diffusers' save_pretrained wrote.

Stable Diffusion 1 and 2 and SDXL, text-to-image or inpainting, and unconditional pixel models. Nothing is downloaded or
sent, nothing is unpickled, and no code from the folder runs: the networks are built by classes chosen here, from its
configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ...errors import InputError
from .pretrained_models import (
    PRECISIONS,
    TextConditioning,
    TextEncoders,
    import_library,
    library_errors,
    load_model,
    read_json,
    torch_device,
)
from .score_distillation import WEIGHTINGS, Array, NoiseSchedule, RenderedView


class DiffusionNetworks(Protocol):
    """The networks of a diffusers pipeline: image → z, and noisy z → prediction. Tensors (1, C, H, W)."""

    @property
    def step(self) -> int:
        """Pixels that the sides of an image must be multiples of."""
        ...

    @property
    def size(self) -> int:
        """Side in pixels of the images that the model was trained on."""
        ...

    def latents(self, picture: Any) -> Any:
        """Return z of ``picture`` (1, 3, H, W) scaled to -1..1; differentiable, float32."""
        ...

    def output(self, noisy: Any, timestep: int, text: str) -> Any:
        """Return the network's prediction for ``noisy``, of its shape: ε, v or x as it was trained."""
        ...


@dataclass(frozen=True, eq=False)
class PixelNetworks:
    """An unconditional UNet on pixels (Ho et al. 2020): z is the image itself."""

    unet: Any
    where: str

    def __post_init__(self) -> None:
        config = self.unet.config
        if config.in_channels != 3 or config.out_channels not in (3, 6):
            raise InputError(f"{self.where}: works on {config.in_channels} channels: give a model of RGB images")
        if config.num_class_embeds is not None or config.class_embed_type is not None:
            raise InputError(f"{self.where}: is conditioned on a class: give a model without classes")

    @property
    def step(self) -> int:
        """Pixels that the sides must be multiples of, so that the UNet can halve them."""
        return int(2 ** (len(self.unet.config.block_out_channels) - 1))

    @property
    def size(self) -> int:
        """Side in pixels of the training images. Raises InputError where the configuration lacks it."""
        return _sample_size(self.unet.config.sample_size, self.where)

    def latents(self, picture: Any) -> Any:
        """Return ``picture`` itself."""
        return picture

    def output(self, noisy: Any, timestep: int, text: str) -> Any:
        """Return the prediction for ``noisy``; ``text`` is ignored."""
        # Models with learned variance return it in the remaining channels.
        return self.unet(noisy.to(self.unet.dtype), timestep).sample[:, :3].to(noisy.dtype)


@dataclass(frozen=True, eq=False)
class LatentNetworks:
    """A text-conditioned UNet on latents (Rombach et al. 2022), with classifier-free guidance (Ho, Salimans 2021).

    An inpainting model gets a mask of the whole image, which makes it a text-to-image model.
    """

    unet: Any
    vae: Any
    texts: TextEncoders
    guidance_scale: float
    negative_prompt: str
    where: str
    _blank: dict[tuple[int, int], Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        latent, takes = self.vae.config.latent_channels, self.unet.config.in_channels
        if takes not in (latent, 2 * latent + 1):
            raise InputError(
                f"{self.where}: its UNet takes {takes} channels and its latents have {latent}: give a text-to-image "
                f"model ({latent}) or one for inpainting ({2 * latent + 1})"
            )
        if getattr(self.vae.config, "latents_mean", None) or getattr(self.vae.config, "latents_std", None):
            raise InputError(f"{self.where}: normalises latent channels separately: give Stable Diffusion 1, 2 or XL")

    @property
    def _factor(self) -> int:
        return int(2 ** (len(self.vae.config.block_out_channels) - 1))

    @property
    def step(self) -> int:
        """Pixels that the sides must be multiples of, so that the UNet can halve them."""
        return int(self._factor * 2 ** (len(self.unet.config.block_out_channels) - 1))

    @property
    def size(self) -> int:
        """Side in pixels of the training images. Raises InputError where the configuration lacks it."""
        return self._factor * _sample_size(self.unet.config.sample_size, self.where)

    def latents(self, picture: Any) -> Any:
        """Return the mean of the encoder's distribution, without sampling: ∂z/∂picture is then deterministic."""
        shift = getattr(self.vae.config, "shift_factor", None) or 0.0
        return (self.vae.encode(picture).latent_dist.mean - shift) * self.vae.config.scaling_factor

    def output(self, noisy: Any, timestep: int, text: str) -> Any:
        """Return the prediction with classifier-free guidance between ``text`` and the negative prompt."""
        positive = self._conditioned(noisy, timestep, self.texts.encode(text))
        if self.guidance_scale == 1:
            return positive
        # One after the other rather than as a batch: half the memory for the same time.
        negative = self._conditioned(noisy, timestep, self.texts.encode(self.negative_prompt))
        return negative + self.guidance_scale * (positive - negative)

    def _conditioned(self, noisy: Any, timestep: int, text: TextConditioning) -> Any:
        dtype, channels = self.unet.dtype, noisy.shape[1]
        given = noisy if self.unet.config.in_channels == channels else self._with_full_mask(noisy)
        more = None
        if text.pooled is not None:
            # SDXL's micro-conditioning: original size, corner of the crop, target size.
            height, width = (side * self._factor for side in noisy.shape[2:])
            sizes = noisy.new_tensor([[height, width, 0, 0, height, width]])
            more = {"text_embeds": text.pooled.to(dtype), "time_ids": sizes.to(dtype)}
        answer = self.unet(
            given.to(dtype), timestep, encoder_hidden_states=text.hidden.to(dtype), added_cond_kwargs=more
        )
        return answer.sample.to(noisy.dtype)

    def _with_full_mask(self, noisy: Any) -> Any:
        """Return ``noisy`` with an inpainting model's extra channels: a mask of everything, over a grey image."""
        torch = import_library("torch", self.where)
        height, width = noisy.shape[2:]
        if (height, width) not in self._blank:
            grey = self.latents(noisy.new_zeros((1, 3, height * self._factor, width * self._factor)))
            self._blank[height, width] = torch.cat([torch.ones_like(noisy[:, :1]), grey], dim=1)
        return torch.cat([noisy, self._blank[height, width]], dim=1)


def _sample_size(size: Any, where: str) -> int:
    """Return the model's own size in its pixels; the larger of two where it has two."""
    sides = size if isinstance(size, list | tuple) else [size]
    if not all(isinstance(side, int) and side > 0 for side in sides):
        raise InputError(f"{where}: has the sample_size {size!r}: set size in the options")
    return int(max(sides))


PIXEL_PIPELINES = ("DDPMPipeline", "DDIMPipeline")
TEXT_PIPELINES = ("StableDiffusionPipeline", "StableDiffusionImg2ImgPipeline", "StableDiffusionInpaintPipeline")
XL_PIPELINES = ("StableDiffusionXLPipeline", "StableDiffusionXLImg2ImgPipeline", "StableDiffusionXLInpaintPipeline")
PREDICTIONS = ("epsilon", "v_prediction", "sample")

_REMEDY = "give the folder that a diffusers pipeline wrote with save_pretrained"


@dataclass(frozen=True, kw_only=True)
class DiffusersOptions:
    """Options of ``DiffusersGuidance``. Raises InputError on a value out of range."""

    prompt: str = ""
    """Text prompt, up to 2000 characters; empty: the subject's name. Ignored by unconditional pixel models."""

    negative_prompt: str = ""
    """Negative prompt, up to 2000 characters."""

    guidance_scale: float = 7.5
    """Scale of classifier-free guidance, 1 (off, and twice as fast) to 200. PhyCAGE uses 7.5 to 12.5, DreamFusion
    100."""

    size: int | None = None
    """Longer side in pixels of the model's input, 8 to 4096; None: what it was trained on. Images are scaled to it, and
    the gradient back."""

    device: str = "cpu"
    """PyTorch device: "cpu", "cuda", "cuda:1", "mps"."""

    precision: str = "float32"
    """Of the UNet and the text encoders: "float32", "float16" or "bfloat16". The image encoder always uses float32:
    SDXL's overflows in 16 bits."""

    weighting: str = "variance"
    """w(t), see ``score_distillation.NoiseSchedule``."""

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
    """``Guidance`` from the pipeline in ``folder``; only its networks, tokenizers and noise schedule are read.

    Raises InputError where the optional extra is missing, the folder is not a supported pipeline, its weights are
    pickled or incomplete, or memory is insufficient.
    """

    def __init__(self, folder: Path, options: DiffusersOptions | None = None) -> None:
        self.options = options or DiffusersOptions()
        self.name = f"diffusion model {folder}"
        kind = _pipeline_class(folder, self.name)
        self._torch = import_library("torch", self.name)
        self._device = torch_device(self._torch, self.options.device, self.name)
        self.schedule, self._prediction = _noise_schedule(folder, self.name, self.options.weighting)
        self._parts = self._load(folder, *kind)

    def gradient(self, seen: RenderedView, timestep: int, random: np.random.Generator) -> Array:
        """Return the gradient (H, W, 3) as ``Guidance`` defines it, exact through resizing and encoder."""
        alpha, weight = self.schedule.alpha(timestep), self.schedule.weight(timestep)
        text = self.options.prompt or seen.subject
        torch = self._torch
        with library_errors(self.name, "give a smaller size, precision float16 on a GPU, or a smaller model"):
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
        """Return ε̂ given what the network was trained to predict (Salimans and Ho 2022, §4)."""
        if self._prediction == "v_prediction":
            return math.sqrt(alpha) * output + math.sqrt(1 - alpha) * noisy
        if self._prediction == "sample":
            return (noisy - math.sqrt(alpha) * output) / math.sqrt(1 - alpha)
        return output

    def _scaled(self, picture: Any) -> Any:
        """Return ``picture`` (1, 3, H, W) at the model's size, its sides rounded to multiples of ``step``."""
        height, width = picture.shape[2:]
        scale, step = (self.options.size or self._parts.size) / max(height, width), self._parts.step
        sides = tuple(max(step, round(side * scale / step) * step) for side in (height, width))
        if sides == (height, width):
            return picture
        return self._torch.nn.functional.interpolate(
            picture, size=sides, mode="bilinear", antialias=True, align_corners=False
        )

    def _load(self, folder: Path, kind: str, index: dict[str, Any]) -> DiffusionNetworks:
        diffusers, torch, options = import_library("diffusers", self.name), self._torch, self.options
        dtype = getattr(torch, options.precision)
        with library_errors(self.name):
            pixels, latents, encoder = diffusers.UNet2DModel, diffusers.UNet2DConditionModel, diffusers.AutoencoderKL
        if kind in PIXEL_PIPELINES:
            unet = load_model(pixels, folder / "unet", self.name, device=self._device, dtype=dtype)
            return PixelNetworks(unet, self.name)
        return LatentNetworks(
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


def _pipeline_class(folder: Path, where: str) -> tuple[str, dict[str, Any]]:
    """Return the pipeline's class name, one of those supported, and its index. Raises InputError."""
    if folder.is_file():
        raise InputError(f"{where}: is a file: {_REMEDY}; convert a single file of weights with diffusers first")
    if not folder.is_dir():
        raise InputError(f"{where}: no such folder; provide the model yourself, nothing is downloaded")
    index = read_json(folder / "model_index.json", where, _REMEDY)
    kind = index.get("_class_name")
    known = (*TEXT_PIPELINES, *XL_PIPELINES, *PIXEL_PIPELINES)
    if kind not in known:
        raise InputError(f"{where}: is a {str(kind)[:80]}: give one of {', '.join(known)}")
    encoder = index.get("text_encoder", [])
    if index.get("requires_aesthetics_score") or encoder is None or (isinstance(encoder, list) and None in encoder):
        raise InputError(f"{where}: is a refiner, which continues another model's images: give the base model")
    return str(kind), index


def _noise_schedule(folder: Path, where: str, weighting: str) -> tuple[NoiseSchedule, str]:
    """Return its noise schedule and prediction type; samplers differ in their steps, not in the training noise."""
    config = read_json(folder / "scheduler" / "scheduler_config.json", where, _REMEDY)
    if "beta_schedule" not in config:
        raise InputError(
            f"{where}: its scheduler {str(config.get('_class_name'))[:60]} has no beta_schedule: give a model "
            "trained on discrete timesteps (DDPM), not one of flows or of continuous noise"
        )
    prediction = config.get("prediction_type", "epsilon")
    if prediction not in PREDICTIONS:
        raise InputError(f"{where}: predicts {str(prediction)[:60]!r}: give a model of {', '.join(PREDICTIONS)}")
    diffusers = import_library("diffusers", where)
    with library_errors(where):
        scheduler = diffusers.DDPMScheduler.from_pretrained(str(folder / "scheduler"), local_files_only=True)
        alphas = scheduler.alphas_cumprod.double().numpy()
    # The last ᾱ of schedules rescaled to end in pure noise is 0; nothing can be distilled there.
    return NoiseSchedule(alphas_cumprod=alphas[alphas > 0], weighting=weighting), str(prediction)
