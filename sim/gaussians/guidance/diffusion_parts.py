# SPDX-License-Identifier: MIT
"""The networks of a diffusers pipeline, as score distillation needs them: picture → z, and noisy z → its noise."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

from ...errors import InputError
from .local_model import library
from .prompts import TextEncoders, Told


class Parts(Protocol):
    """Tensors have a batch of one: (1, C, H, W)."""

    @property
    def step(self) -> int:
        """Pixels of which the sides of a picture must be multiples."""
        ...

    @property
    def size(self) -> int:
        """Pixels of a side of the pictures that the model was trained on."""
        ...

    def latents(self, picture: Any) -> Any:
        """z of ``picture`` (1, 3, H, W) scaled to -1..1; differentiable, in 32 bits."""
        ...

    def output(self, noisy: Any, timestep: int, text: str) -> Any:
        """What the network says of ``noisy``, of its shape: ε, v or x as it was trained."""
        ...


@dataclass(frozen=True, eq=False)
class PixelParts:
    """A UNet on pixels that is told nothing (Ho et al. 2020): z is the picture itself."""

    unet: Any
    where: str

    def __post_init__(self) -> None:
        config = self.unet.config
        if config.in_channels != 3 or config.out_channels not in (3, 6):
            raise InputError(f"{self.where}: works on {config.in_channels} channels: give a model of RGB pictures")
        if config.num_class_embeds is not None or config.class_embed_type is not None:
            raise InputError(f"{self.where}: must be told a class: give a model without classes")

    @property
    def step(self) -> int:
        """What the UNet can halve as often as it does."""
        return int(2 ** (len(self.unet.config.block_out_channels) - 1))

    @property
    def size(self) -> int:
        """As ``Parts`` says. Raises InputError where the model does not."""
        return _side(self.unet.config.sample_size, self.where)

    def latents(self, picture: Any) -> Any:
        """``picture`` itself."""
        return picture

    def output(self, noisy: Any, timestep: int, text: str) -> Any:
        """As ``Parts`` says, whatever ``text``."""
        # A model that has learned its variance too gives it in the channels behind.
        return self.unet(noisy.to(self.unet.dtype), timestep).sample[:, :3].to(noisy.dtype)


@dataclass(frozen=True, eq=False)
class LatentParts:
    """A UNet on latents that is told a text (Rombach et al. 2022), with classifier-free guidance (Ho, Salimans 2021).

    An inpainting model is told that all of the picture is to be painted: it is then one from text to image.
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
                f"{self.where}: its UNet takes {takes} channels and its latents have {latent}: give a model from "
                f"text to image ({latent}) or one for inpainting ({2 * latent + 1})"
            )
        if getattr(self.vae.config, "latents_mean", None) or getattr(self.vae.config, "latents_std", None):
            raise InputError(
                f"{self.where}: normalises each latent channel for itself: give Stable Diffusion 1, 2 or XL"
            )

    @property
    def _factor(self) -> int:
        return int(2 ** (len(self.vae.config.block_out_channels) - 1))

    @property
    def step(self) -> int:
        """What the UNet can halve as often as it does."""
        return int(self._factor * 2 ** (len(self.unet.config.block_out_channels) - 1))

    @property
    def size(self) -> int:
        """As ``Parts`` says. Raises InputError where the model does not."""
        return self._factor * _side(self.unet.config.sample_size, self.where)

    def latents(self, picture: Any) -> Any:
        """The mean that the encoder gives, without its own noise: ∂z/∂picture is then a plain derivative."""
        shift = getattr(self.vae.config, "shift_factor", None) or 0.0
        return (self.vae.encode(picture).latent_dist.mean - shift) * self.vae.config.scaling_factor

    def output(self, noisy: Any, timestep: int, text: str) -> Any:
        """As ``Parts`` says, with classifier-free guidance between ``text`` and the negative prompt."""
        told = self._told_output(noisy, timestep, self.texts.told(text))
        if self.guidance_scale == 1:
            return told
        # One after the other rather than as a batch: half of the memory for the same time.
        untold = self._told_output(noisy, timestep, self.texts.told(self.negative_prompt))
        return untold + self.guidance_scale * (told - untold)

    def _told_output(self, noisy: Any, timestep: int, told: Told) -> Any:
        dtype, channels = self.unet.dtype, noisy.shape[1]
        given = noisy if self.unet.config.in_channels == channels else self._with_hole(noisy)
        more = None
        if told.pooled is not None:
            # SDXL's micro-conditioning: original size, corner of the crop, target size.
            height, width = (side * self._factor for side in noisy.shape[2:])
            sizes = noisy.new_tensor([[height, width, 0, 0, height, width]])
            more = {"text_embeds": told.pooled.to(dtype), "time_ids": sizes.to(dtype)}
        answer = self.unet(
            given.to(dtype), timestep, encoder_hidden_states=told.hidden.to(dtype), added_cond_kwargs=more
        )
        return answer.sample.to(noisy.dtype)

    def _with_hole(self, noisy: Any) -> Any:
        """``noisy`` with the channels that tell an inpainting model: all is hole, and behind it a grey picture."""
        torch = library("torch", self.where)
        height, width = noisy.shape[2:]
        if (height, width) not in self._blank:
            grey = self.latents(noisy.new_zeros((1, 3, height * self._factor, width * self._factor)))
            self._blank[height, width] = torch.cat([torch.ones_like(noisy[:, :1]), grey], dim=1)
        return torch.cat([noisy, self._blank[height, width]], dim=1)


def _side(size: Any, where: str) -> int:
    """The model's own size in its pixels; the larger of two where it has two."""
    sides = size if isinstance(size, list | tuple) else [size]
    if not all(isinstance(side, int) and side > 0 for side in sides):
        raise InputError(f"{where}: says {size!r} of its sample_size: give a size in the options")
    return int(max(sides))
