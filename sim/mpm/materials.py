# SPDX-License-Identifier: MIT
"""What matter bodies are made of: one class a constitutive law, with its numbers in SI units. No Taichi.

The equations are in ``laws`` (and ``constitutive`` for fixed-corotated elasticity); docs/physics.md cites them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from ..errors import InputError

FIXED_COROTATED, NEO_HOOKEAN, VON_MISES, SNOW, SAND, FLUID = range(6)
"""Numbers of the laws in the kernels; law i has the bit 1 << i in a set of laws."""

ONLY_ELASTIC = 1 << FIXED_COROTATED
"""The set of laws of worlds that hold nothing but fixed-corotated solids, for which the kernels are simplest."""

LAW_NAMES = ("fixed_corotated", "neo_hookean", "von_mises", "snow", "sand", "fluid")

FLOWING = (1 << SAND) | (1 << FLUID)
"""Laws of matter that flows."""

DAMPED = 1 << len(LAW_NAMES)
"""Bit in a set of laws that says that some solid in it has a damping time."""

FIBRED = DAMPED << 1
"""Bit in a set of laws that says that some solid in it has fibres."""

OWN = 4
ROW = 2 + OWN + 4
"""Numbers that a material has in the kernels' table: law, damping time in s, four of the law's own, the fibres' modulus
over 2 mu, their axis (3)."""

STABLE_WAVENUMBER = 2.0 / 0.58
"""Largest wavenumber that the grid carries, 1/cells: waves of speed c are stable up to c dt = 0.58 cells."""


@dataclass(frozen=True, kw_only=True)
class ElasticMaterial:
    """Isotropic elastic solid. Raises InputError on a value out of range."""

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

    law: ClassVar[int] = FIXED_COROTATED

    def __post_init__(self) -> None:
        self._above_zero("density", "youngs_modulus")
        _in_range(self, "poisson_ratio", 0.0, math.nextafter(0.5, 0.0), "give 0 or more and less than 0.5")
        _in_range(self, "damping_time", 0.0, 1e3, "give seconds from 0 to 1000")
        _in_range(self, "fibre_modulus", 0.0, 1e12, "give pascals from 0 to 1e12")
        axis = self.fibre_axis
        if len(axis) != 3 or not abs(math.hypot(*axis) - 1.0) < 1e-3:
            raise InputError(f"material fibre_axis is {axis!r}: give a unit vector")

    def _above_zero(self, *fields: str) -> None:
        for field in fields:
            value = getattr(self, field)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"material {field} is {value!r}: give a finite number above 0")

    @property
    def shear_modulus(self) -> float:
        """First half of the Lamé parameters, mu in Pa."""
        return self.youngs_modulus / (2 * (1 + self.poisson_ratio))

    @property
    def lame_lambda(self) -> float:
        """Second half of the Lamé parameters, lambda in Pa."""
        nu = self.poisson_ratio
        return self.youngs_modulus * nu / ((1 + nu) * (1 - 2 * nu))

    @property
    def wave_speed(self) -> float:
        """Speed in m/s of longitudinal waves in undeformed matter, sqrt((lambda + 2 mu + k) / rho), along fibres."""
        return math.sqrt((self.lame_lambda + 2 * self.shear_modulus + self.fibre_modulus) / self.density)

    @property
    def diffusivity(self) -> float:
        """Longitudinal kinematic viscosity in m²/s, (zeta + 4/3 eta) / rho."""
        return self.damping_time * self.wave_speed**2

    @property
    def shear_number(self) -> float:
        """What the kernels multiply with the deviatoric part, in Pa (or Pa s): 2 mu, in fluids 2 eta."""
        return 2 * self.shear_modulus

    @property
    def bulk_number(self) -> float:
        """What the kernels multiply with the volumetric part, in Pa: lambda, in fluids the bulk modulus."""
        return self.lame_lambda

    @property
    def laws(self) -> int:
        """Bits of this material in a set of laws."""
        damped = DAMPED if self.damping_time > 0 and self.law != FLUID else 0
        return (1 << self.law) | damped | (FIBRED if self.fibre_modulus > 0 else 0)

    @property
    def row(self) -> tuple[float, ...]:
        """This material's ``ROW`` numbers in the kernels' table; the law's own are without unit."""
        own = self._own()
        fibres = self.fibre_modulus / (2 * self.shear_modulus)
        return (float(self.law), self.damping_time, *own, *(0.0,) * (OWN - len(own)), fibres, *self.fibre_axis)

    def _own(self) -> tuple[float, ...]:
        return ()

    @property
    def flows(self) -> bool:
        """Whether the matter forgets its shape, so that its elastic deformation says nothing about its skin."""
        return self.law not in (FIXED_COROTATED, NEO_HOOKEAN)


@dataclass(frozen=True, kw_only=True)
class NeoHookeanMaterial(ElasticMaterial):
    """Elastic solid for large strain whose energy grows without bound as it is crushed."""

    law: ClassVar[int] = NEO_HOOKEAN


@dataclass(frozen=True, kw_only=True)
class VonMisesMaterial(ElasticMaterial):
    """Ideally plastic solid: clay, metal."""

    yield_stress: float
    """Stress in Pa at which a bar in tension begins to flow; above 0."""

    law: ClassVar[int] = VON_MISES

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("yield_stress")

    def _own(self) -> tuple[float, ...]:
        return (math.sqrt(2 / 3) * self.yield_stress / (2 * self.shear_modulus),)


@dataclass(frozen=True, kw_only=True)
class SnowMaterial(ElasticMaterial):
    """Snow: breaks beyond a small stretch, packs and hardens beyond a small compression."""

    critical_compression: float = 0.025
    """Elastic compression of a principal stretch, theta_c; above 0, below 0.5."""

    critical_stretch: float = 0.0075
    """Elastic extension of a principal stretch, theta_s; above 0, below 0.5."""

    hardening: float = 10.0
    """xi: the moduli grow by exp(xi (1 - J_P)) as the snow is packed to the volume ratio J_P; 0 to 30."""

    law: ClassVar[int] = SNOW

    def __post_init__(self) -> None:
        super().__post_init__()
        for field in ("critical_compression", "critical_stretch"):
            _in_range(self, field, 1e-6, 0.5, "give a strain above 0 and up to 0.5")
        _in_range(self, "hardening", 0.0, 30.0, "give a number from 0 to 30")

    def _own(self) -> tuple[float, ...]:
        return (self.critical_compression, self.critical_stretch, self.hardening)


@dataclass(frozen=True, kw_only=True)
class SandMaterial(ElasticMaterial):
    """Dry granular matter that holds no tension and flows where shear exceeds friction."""

    friction_angle: float
    """Steepest slope that stands, in radians; above 0, up to 1.4. The Drucker–Prager cone is fitted to plane shear, in
    which a slope fails; a cone fitted to triaxial compression (Klár et al. 2016) would stand some 5 degrees steeper."""

    law: ClassVar[int] = SAND

    def __post_init__(self) -> None:
        super().__post_init__()
        _in_range(self, "friction_angle", 1e-3, 1.4, "give radians above 0 and up to 1.4")

    def _own(self) -> tuple[float, ...]:
        # |dev tau| <= -alpha tr tau is shear <= tan(angle) pressure in plane shear with alpha = sqrt(2)/3 tan(angle).
        stiff = (3 * self.lame_lambda + 2 * self.shear_modulus) / (2 * self.shear_modulus)
        return (math.sqrt(2) / 3 * math.tan(self.friction_angle) * stiff,)


@dataclass(frozen=True, kw_only=True)
class FluidMaterial(ElasticMaterial):
    """Weakly compressible Newtonian fluid. Young's modulus and Poisson's ratio do not count."""

    youngs_modulus: float = 1.0
    poisson_ratio: float = 0.0

    bulk_modulus: float
    """Pa, above 0. A hundred times density g depth keeps the compression under 1 %; water's own 2.2e9 costs much."""

    viscosity: float
    """Dynamic viscosity in Pa s, 0 or more; above 0 it costs substeps in proportion."""

    law: ClassVar[int] = FLUID

    def __post_init__(self) -> None:
        super().__post_init__()
        self._above_zero("bulk_modulus")
        _in_range(self, "viscosity", 0.0, 1e6, "give Pa s from 0 to 1e6")

    @property
    def wave_speed(self) -> float:
        """Speed of sound in m/s, sqrt(K / rho)."""
        return math.sqrt(self.bulk_modulus / self.density)

    @property
    def diffusivity(self) -> float:
        """Longitudinal kinematic viscosity in m²/s, 4/3 eta / rho."""
        return 4 / 3 * self.viscosity / self.density

    @property
    def shear_number(self) -> float:
        """2 eta in Pa s."""
        return 2 * self.viscosity

    @property
    def bulk_number(self) -> float:
        """The bulk modulus in Pa."""
        return self.bulk_modulus


@dataclass(frozen=True, kw_only=True)
class RigidMaterial:
    """A body that does not deform. Raises InputError on a value out of range."""

    density: float
    """Mass density in kg/m³; above 0."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.density) and self.density > 0):
            raise InputError(f"material density is {self.density!r}: give a finite number above 0")


def bounding_speed(wave_speed: float, diffusivity: float) -> float:
    """Speed in cells/s of the undamped wave that bounds the substep as this wave with this viscosity (cells²/s) does.

    Symplectic Euler with explicit viscosity is stable where (w dt)² + 2 dt nu k² < 4, with w = c k at the grid's
    largest wavenumber k; solved for dt and compared with the undamped limit.
    """
    half = 0.5 * diffusivity * STABLE_WAVENUMBER
    return half + math.sqrt(half * half + wave_speed * wave_speed)


def _in_range(material: object, field: str, low: float, high: float, remedy: str) -> None:
    value = getattr(material, field)
    if not (math.isfinite(value) and low <= value <= high):
        raise InputError(f"material {field} is {value!r}: {remedy}")
