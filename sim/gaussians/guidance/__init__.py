# SPDX-License-Identifier: MIT
"""Score distillation: gradients that make a rendered image more likely.

score_distillation.py  the Guidance protocol, noise schedules, the loss term, checks of a guidance's output
ideal_denoiser.py      the exact denoiser of a finite set of images
diffusers_guidance.py  a local diffusion model (optional extra)
pretrained_models.py   loading local weights safely, text encoders
pretrained_models.py         CLIP scores"""
