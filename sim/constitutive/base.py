# SPDX-License-Identifier: MIT
"""Base of the constitutive models: common parameters, the engine's numbers, the registry. No Taichi.

A model is one dataclass in one file of this folder. Its fields are its parameters in SI units, checked in
``__post_init__``; its class attributes say what it is called and how the engine treats it; ``device`` returns its
device functions, which import Taichi only when they are called for. A subclass that states ``law`` is registered.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

Array = NDArray[np.float64]

SHAPED, COHERENT, GRANULAR, FLUID = "shaped", "coherent", "granular", "fluid"
"""Cohesion of a material: returns to a shape (its own or a yielded one); holds together; grains; fluid."""

RIGID = "rigid"
"""Law of bodies that do not deform."""

DAMPED, FIBRED, RELAXING = 1 << 30, 1 << 29, 1 << 28
"""Bits in a set of laws: some solid in it has a damping time, has fibres, has a branch that relaxes. Model i has the
bit 1 << i."""

OWN = 4
ROW = 2 + OWN + 4 + 2
"""Numbers of a material in the kernels' table: model, damping time in s, four of the model's own, the fibres' modulus
over 2 mu, their axis (3), the relaxing share and its time in s."""

STABLE_WAVENUMBER = 2.0 / 0.58
"""Largest wavenumber that the grid carries, 1/cells: waves of speed c are stable up to c dt = 0.58 cells."""


class Parameter(NamedTuple):
    """A field that a model adds to the material of a scene."""

    name: str
    default: float
    low: float
    high: float
    unit: str
    """Unit for messages, in words: "pascals", "a strain"."""


class DeviceFunctions(NamedTuple):
    """Device functions of a model: ``stress`` or a return map, and ``advance_volume`` where F does not matter.

    Moduli and results carry the particle's volume at rest V0. two_mu, lam: the model's ``shear_number`` and
    ``bulk_number`` times V0; own: the model's own numbers. Stiffness: rho0 c² V0 of the fastest wave in the present
    state, which bounds the substep; too small a value makes a body unstable.
    """

    stress: Any = None
    """(F, C, memory, two_mu, lam, own) → Kirchhoff stress, stiffness, longitudinal viscosity (Pa s times V0)."""

    return_map: Any = None
    """(stretch, memory, two_mu, lam, own) → elastic principal stretches, memory, principal Kirchhoff stress, stiffness,
    for trial principal stretches (3). The map changes F <- U diag(s_new / s) U^T F and keeps everything else."""

    radial_return: Any = None
    """(volume, shear, memory, own) → elastic volume, share of the deviator that is kept, memory: of the Hencky strain
    ln V, with its trace and the norm of its deviator. The stress is 2 mu e + lambda tr e."""

    advance_volume: Any = None
    """(memory, dt, C) → memory, the ln of the volume ratio after dt; of fluids, whose F stays the identity."""


_MODELS: dict[str, type[DeformableMaterial]] = {}


@dataclass(frozen=True, kw_only=True)
class DeformableMaterial:
    """Parameters that all models share. Raises InputError on a value out of range."""

    density: float
    """Mass density in kg/m³; above 0."""

    youngs_modulus: float
    """Young's modulus E in Pa; above 0."""

    poisson_ratio: float
    """Poisson's ratio; 0 up to, but not, 0.5. The substep goes to zero as it nears 0.5."""

    damping_time: float = 0.0
    """Kelvin–Voigt retardation time viscosity / modulus in s; 0 (none) or more. A vibration of angular frequency w
    decays at the rate damping_time w² / 2; long times cost substeps."""

    fibre_modulus: float = 0.0
    """Extra Young's modulus in Pa along ``fibre_axis``, 0 (none) to 1e12: fibres that pull and push, psi = k/2 (s-1)²
    with their stretch s."""

    fibre_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Unit vector of the fibres in the undeformed body, world axes."""

    relaxing_share: float = 0.0
    """Shear modulus of a spring that is in series with a dashpot beside the law (Zener's standard linear solid), over
    the law's own, 0 (none) to 20. What is deformed fast is 1 + share times as stiff in shear as at rest; the loss
    factor is largest, share / (2 sqrt(1 + share)), at the angular frequency 1 / (relaxation_time sqrt(1 + share))."""

    relaxation_time: float = 0.01
    """Seconds in which the stress of that spring falls to 1/e, 1e-5 to 100."""

    law: ClassVar[str]
    """Name of the model in scenes and presets."""

    number: ClassVar[int]
    """Number of the model in the kernels: its place in ``models()``."""

    rank: ClassVar[int] = 100
    """Place of the model in lists that people read, lowest first."""

    label: ClassVar[str] = ""
    """Name in Blender's list of laws; empty: ``law`` in title case."""

    hint: ClassVar[str] = ""
    """Tooltip in that list, in an artist's words; empty: the first line of the class's docstring."""

    cohesion: ClassVar[str] = SHAPED
    """One of SHAPED, COHERENT, GRANULAR, FLUID. Granular and fluid materials keep their particles' own velocities in
    the transfers, and are shown as particles or surfaces, as coherent ones are once they tear."""

    plastic: ClassVar[bool] = False
    """Whether F holds the elastic part of the deformation only, so that skins follow the particles' positions."""

    memory_is_log_volume: ClassVar[bool] = False
    """Whether the history variable is the ln of a volume ratio that det F does not contain."""

    reads: ClassVar[tuple[str, ...]] = ("youngs_modulus", "poisson_ratio", "damping_time")
    """Fields of a scene's material that become parameters, besides the density."""

    hidden: ClassVar[tuple[str, ...]] = ()
    """Those of ``reads`` that Blender's panel leaves out."""

    parameters: ClassVar[tuple[Parameter, ...]] = ()
    """Fields that the model adds to a scene's material, for a model whose parameters no other one has."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "law" in cls.__dict__:
            _MODELS[cls.law] = cls

    def __post_init__(self) -> None:
        self._above_zero("density", "youngs_modulus")
        self._in_range("poisson_ratio", 0.0, math.nextafter(0.5, 0.0), "give 0 or more and less than 0.5")
        self._in_range("damping_time", 0.0, 1e3, "give seconds from 0 to 1000")
        self._in_range("fibre_modulus", 0.0, 1e12, "give pascals from 0 to 1e12")
        self._in_range("relaxing_share", 0.0, 20.0, "give 0 (none) to 20")
        self._in_range("relaxation_time", 1e-5, 100.0, "give seconds from 1e-5 to 100")
        axis = self.fibre_axis
        if len(axis) != 3 or not abs(math.hypot(*axis) - 1.0) < 1e-3:
            raise InputError(f"material fibre_axis is {axis!r}: give a unit vector")

    def _above_zero(self, *fields: str) -> None:
        for field in fields:
            value = getattr(self, field)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"material {field} is {value!r}: give a finite number above 0")

    def _in_range(self, field: str, low: float, high: float, remedy: str) -> None:
        value = getattr(self, field)
        if not (math.isfinite(value) and low <= value <= high):
            raise InputError(f"material {field} is {value!r}: {remedy}")

    @staticmethod
    def device() -> DeviceFunctions:
        """Device functions of the model; imports Taichi."""
        raise NotImplementedError

    def elastic_energy(self, volumes: Array, deformation: Array, memories: Array) -> float:
        """Return the energy in J stored by particles of volumes (N,) m³ at rest.

        deformation: elastic gradients (N, 3, 3); memories: history variables (N,).
        """
        raise NotImplementedError

    def own_numbers(self) -> tuple[float, ...]:
        """Up to ``OWN`` numbers of the model for its device functions, without unit: divide a stress by 2 mu."""
        return ()

    def fibre_energy(self, volumes: Array, deformation: Array) -> float:
        """Return the energy in J stored in the fibres."""
        if not self.fibre_modulus > 0:
            return 0.0
        along = np.linalg.norm(deformation @ np.asarray(self.fibre_axis), axis=1)
        return float(volumes @ (0.5 * self.fibre_modulus * (along - 1) ** 2))

    def relaxing_energy(self, volumes: Array, conformations: Array) -> float:
        """Return the energy in J of the springs that relax, share mu/2 (tr B - 3 - ln det B), with B (N, 3, 3)."""
        determinants = np.maximum(np.linalg.det(conformations), 1e-12)
        stored = np.trace(conformations, axis1=1, axis2=2) - 3 - np.log(determinants)
        return float(volumes @ (0.5 * self.relaxing_share * self.shear_modulus * stored))

    @property
    def shear_modulus(self) -> float:
        """First Lamé parameter of shear, mu in Pa."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def lame_lambda(self) -> float:
        """Lamé parameter lambda in Pa."""
        nu = self.poisson_ratio
        return self.youngs_modulus * nu / ((1 + nu) * (1 - 2 * nu))

    @property
    def wave_speed(self) -> float:
        """Speed in m/s of fast longitudinal waves in the undeformed material, along fibres:
        sqrt((lambda + 2 (1 + relaxing_share) mu + k) / rho).

        The first substep and the estimate of cost depend on it.
        """
        shear = (1.0 + self.relaxing_share) * self.shear_modulus
        return math.sqrt((self.lame_lambda + 2 * shear + self.fibre_modulus) / self.density)

    @property
    def diffusivity(self) -> float:
        """Longitudinal kinematic viscosity in m²/s, (zeta + 4/3 eta) / rho."""
        return self.damping_time * (self.lame_lambda + 2 * self.shear_modulus + self.fibre_modulus) / self.density

    @property
    def shear_number(self) -> float:
        """Factor of the deviatoric part in the kernels, in Pa (or Pa s): 2 mu, in fluids 2 eta."""
        return 2 * self.shear_modulus

    @property
    def bulk_number(self) -> float:
        """Factor of the volumetric part in the kernels, in Pa: lambda, in fluids the bulk modulus."""
        return self.lame_lambda

    @property
    def laws(self) -> int:
        """Bits of this material in a set of laws."""
        damped = DAMPED if self.damping_time > 0 and self.cohesion != FLUID else 0
        relaxing = RELAXING if self.relaxing_share > 0 and self.cohesion != FLUID else 0
        return (1 << self.number) | damped | relaxing | (FIBRED if self.fibre_modulus > 0 else 0)

    @property
    def row(self) -> tuple[float, ...]:
        """This material's ``ROW`` numbers in the kernels' table."""
        own = self.own_numbers()
        fibres = self.fibre_modulus / (2 * self.shear_modulus)
        numbers = (float(self.number), self.damping_time, *own, *(0.0,) * (OWN - len(own)), fibres, *self.fibre_axis)
        return (*numbers, self.relaxing_share, self.relaxation_time)


@dataclass(frozen=True, kw_only=True)
class RigidMaterial:
    """A body that does not deform. Raises InputError on a value out of range."""

    density: float
    """Mass density in kg/m³; above 0."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.density) and self.density > 0):
            raise InputError(f"material density is {self.density!r}: give a finite number above 0")


def models() -> tuple[type[DeformableMaterial], ...]:
    """Return all registered models by ``rank``."""
    return tuple(sorted(_MODELS.values(), key=lambda model: (model.rank, model.law)))


def cohesion_of(law: str) -> str:
    """Cohesion of the model called ``law``, or RIGID. Raises InputError if there is none."""
    return RIGID if law == RIGID else model_of(law).cohesion


def number_models() -> None:
    """Number the registered models; once, when all are known."""
    for number, model in enumerate(models()):
        model.number = number


def model_of(law: str) -> type[DeformableMaterial]:
    """Return the model called ``law``. Raises InputError if there is none."""
    if law not in _MODELS:
        raise InputError(f"law is {law!r}: choose one of {', '.join(model.law for model in models())}")
    return _MODELS[law]


def bounding_speed(wave_speed: float, diffusivity: float) -> float:
    """Speed in cells/s of the undamped wave that bounds the substep as this wave with this viscosity (cells²/s) does.

    Symplectic Euler with explicit viscosity is stable where (w dt)² + 2 dt nu k² < 4, with w = c k at the grid's
    largest wavenumber k; solved for dt and compared with the undamped limit.
    """
    half = 0.5 * diffusivity * STABLE_WAVENUMBER
    return half + math.sqrt(half * half + wave_speed * wave_speed)


def principal_stretches(deformation: Array) -> tuple[Array, Array]:
    """Return the singular values (N, 3) of deformation gradients (N, 3, 3), and their determinants (N,)."""
    return np.linalg.svd(deformation, compute_uv=False), np.linalg.det(deformation)


def hencky_strains(stretches: Array) -> Array:
    """Return the logarithms (N, 3) of principal stretches; those below 1e-3 count as 1e-3."""
    return np.log(np.maximum(stretches, 1e-3))
