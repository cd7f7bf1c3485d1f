# SPDX-License-Identifier: MIT
"""Constitutive models, one class in one file each; every file of this folder that defines one is found by itself.

``base.py`` describes what a model is, ``tensors.py`` holds device functions that several share. A model's module
imports no Taichi: only its ``device`` does, when the engine asks for it.
"""

import importlib
import pkgutil

from .base import (
    COHERENT,
    DAMPED,
    FIBRED,
    FLUID,
    GRANULAR,
    OWN,
    RELAXING,
    RIGID,
    ROW,
    SHAPED,
    STABLE_WAVENUMBER,
    DeformableMaterial,
    DeviceFunctions,
    Parameter,
    RigidMaterial,
    bounding_speed,
    cohesion_of,
    model_of,
    models,
    number_models,
)
from .fixed_corotated import ElasticMaterial
from .fluid import FluidMaterial
from .neo_hookean import NeoHookeanMaterial
from .sand import SandMaterial
from .snow import SnowMaterial
from .von_mises import VonMisesMaterial

__all__ = [
    "COHERENT",
    "DAMPED",
    "FIBRED",
    "FLUID",
    "GRANULAR",
    "OWN",
    "RELAXING",
    "RIGID",
    "ROW",
    "SHAPED",
    "STABLE_WAVENUMBER",
    "DeformableMaterial",
    "DeviceFunctions",
    "ElasticMaterial",
    "FluidMaterial",
    "NeoHookeanMaterial",
    "Parameter",
    "RigidMaterial",
    "SandMaterial",
    "SnowMaterial",
    "VonMisesMaterial",
    "bounding_speed",
    "cohesion_of",
    "model_of",
    "models",
]

for _module in pkgutil.iter_modules(__path__):
    if _module.name != "tensors":
        importlib.import_module(f"{__name__}.{_module.name}")
number_models()
