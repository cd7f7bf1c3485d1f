# SPDX-License-Identifier: MIT
# ruff: noqa: ANN201, SIM102
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple.)
"""Stress of the particles by their constitutive models; the models themselves are in ``sim/constitutive``.

Besides the models' own stress:

    fibres       psi += k/2 (s - 1)^2, s = |F a|: tau += k (s - 1) / s  F a (F a)^T      Bonet and Burton 1998
    damping      tau += t (2 mu D + lambda tr D)      Kelvin–Voigt, with one retardation time t for shear and volume
    relaxing     tau += q mu (B - I),  dB/dt = L B + B L^T - (B - I) / t      a spring of q mu in series with a dashpot
                 beside the law: Zener's standard linear solid, as Oldroyd 1950 writes it for large strain; B is kept
                 per particle (``conformation``), I at rest, positive definite whatever the step

D is the symmetric part of the velocity gradient. Plastic models map the trial principal stretches s back onto the yield
surface: F <- U diag(s_new / s) U^T F, which keeps everything else, so no right singular vectors are needed. Maps of the
Hencky strain that keep its axes and scale its deviator need no U either while the strain is moderate: ln b and the
powers of b are series in its deviator.
"""

import functools
from typing import Any, NamedTuple

import taichi as ti

from ...constitutive import (
    DAMPED,
    FIBRED,
    FLUID,
    GRANULAR,
    RELAXING,
    ROW,
    STABLE_WAVENUMBER,
    ElasticMaterial,
    models,
)
from ...constitutive.tensors import (
    LEAST_STRETCH,
    MOST_SERIES,
    eigen_symmetric,
    hencky_stress,
    isotropic,
    log_series,
    mat3,
    power_series,
    vec3,
    vec4,
)
from .kernel_arrays import ParticleArrays, WorldArrays
from .kernel_bundles import func


class DeviceModel(NamedTuple):
    """A model as the kernels see it: its number and its ``DeviceFunctions``."""

    number: int
    stress: Any
    return_map: Any
    radial_return: Any
    advance_volume: Any


class LawSet(NamedTuple):
    """The models that occur in worlds; known to the compiler, which makes kernels of their own for each set."""

    solid: tuple[DeviceModel, ...]
    """Models with a stress that follows from F."""

    stretch_plastic: tuple[DeviceModel, ...]
    """Models with a return map of principal stretches."""

    hencky_plastic: tuple[DeviceModel, ...]
    """Models with a return map of the Hencky strain."""

    volumetric: tuple[DeviceModel, ...]
    """Models that advance a volume ratio in place of F: fluids."""

    log_volume: bool
    """Whether some model's history variable is the ln of a volume ratio that det F does not contain."""

    flowing: bool
    """Whether there are granular materials or fluids."""

    only_flowing: bool
    """Whether there is nothing else."""

    damped: bool
    """Whether some solid has a damping time."""

    fibred: bool
    """Whether some solid has fibres."""

    relaxing: bool
    """Whether some solid has a branch that relaxes."""

    only_elastic: bool
    """Whether there is nothing but plain fixed-corotated elasticity, for which the kernels are simplest."""


FLOWING = (GRANULAR, FLUID)
FLOWING_BITS = sum(1 << model.number for model in models() if model.cohesion in FLOWING)
FLUIDS = tuple(model.number for model in models() if model.device().advance_volume is not None)
HENCKY = tuple(model.number for model in models() if model.device().radial_return is not None)
PLASTIC = (*HENCKY, *(model.number for model in models() if model.device().return_map is not None))
LOG_VOLUMES = tuple(model.number for model in models() if model.memory_is_log_volume)
"""Numbers of models by property."""

RELAXING_SHARE, RELAXATION_TIME = ROW - 2, ROW - 1
"""Numbers of the branch that relaxes in a material's row."""

ONLY_ELASTIC = 1 << ElasticMaterial.number
"""The set of laws of worlds that hold nothing but plain fixed-corotated solids."""


@functools.cache
def law_set(laws: int) -> LawSet:
    """The models of the bits ``laws``, as ``DeformableMaterial.laws`` sets them."""
    present = [model for model in models() if laws >> model.number & 1]
    device = [DeviceModel(model.number, *model.device()) for model in present]
    return LawSet(
        solid=tuple(model for model in device if model.stress is not None and model.advance_volume is None),
        stretch_plastic=tuple(model for model in device if model.return_map is not None),
        hencky_plastic=tuple(model for model in device if model.radial_return is not None),
        volumetric=tuple(model for model in device if model.advance_volume is not None),
        log_volume=any(model.memory_is_log_volume for model in present),
        flowing=any(model.cohesion in FLOWING for model in present),
        only_flowing=bool(present) and all(model.cohesion in FLOWING for model in present),
        damped=bool(laws & DAMPED),
        fibred=bool(laws & FIBRED),
        relaxing=bool(laws & RELAXING),
        only_elastic=laws == ONLY_ELASTIC,
    )


@ti.func
def is_one_of(law: ti.i32, numbers: ti.template()):
    """Whether ``law`` is one of the model numbers ``numbers``, at least one."""
    found = law == numbers[0]
    for number in ti.static(numbers[1:]):
        found = found or law == number
    return found


@ti.func
def is_fluid(law: ti.i32):
    """Whether model number ``law`` advances a volume ratio in place of F."""
    return is_one_of(law, FLUIDS)


@ti.func
def flows(law: ti.i32):
    """Whether model number ``law`` is granular or fluid."""
    return (FLOWING_BITS >> law) & 1 == 1


@func
def law_of(p: ti.i32, worlds: WorldArrays, particles: ParticleArrays):
    """Number of the model of particle ``p``."""
    return ti.cast(worlds.materials[particles.material[p] * ROW], ti.i32)


@func
def own_numbers(row: ti.i32, worlds: WorldArrays):
    """The model's own numbers of the material at ``row``."""
    return vec4(
        worlds.materials[row + 2], worlds.materials[row + 3], worlds.materials[row + 4], worlds.materials[row + 5]
    )


@ti.func
def map_back(law: ti.i32, laws: ti.template(), F: mat3, memory: ti.f32, two_mu: ti.f32, lam: ti.f32, own: vec4):
    """Return mapping of the plastic models: F, memory, Kirchhoff stress, stiffness."""
    mapped = F
    remembered = memory
    tau = mat3(0.0)
    stiffness = 0.0
    b = F @ F.transpose()
    # b = mean (1 + Y): where Y is small, as in all that flows slowly, series in it need no principal axes.
    mean = ti.max(b.trace() * (1.0 / 3.0), 1e-30)
    Y = b * (1.0 / mean)
    for i in ti.static(range(3)):
        Y[i, i] -= 1.0
    square = Y @ Y
    p = 0.5 * square.trace()
    if ti.static(len(laws.hencky_plastic) > 0):
        if is_one_of(law, HENCKY):
            if p < MOST_SERIES and mean > LEAST_STRETCH**2:
                mapped, remembered, tau, stiffness = return_in_series(
                    law, laws, F, mean, Y, square, memory, two_mu, lam, own
                )
            else:
                mapped, remembered, tau, stiffness = return_along_axes(law, laws, F, b, memory, two_mu, lam, own)
    if ti.static(len(laws.stretch_plastic) > 0):
        if not is_one_of(law, HENCKY):
            squares, axes = eigen_symmetric(b)
            stretch = ti.sqrt(ti.max(squares, LEAST_STRETCH**2))
            kept = stretch
            for model in ti.static(laws.stretch_plastic):
                if law == model.number:
                    kept, remembered, principal, stiffness = model.return_map(stretch, memory, two_mu, lam, own)
                    tau = isotropic(principal, axes)
            mapped = scaled(F, squares, axes, stretch, kept)
    return mapped, remembered, tau, stiffness


@ti.func
def return_in_series(
    law: ti.i32,
    laws: ti.template(),
    F: mat3,
    mean: ti.f32,
    Y: mat3,
    square: mat3,
    memory: ti.f32,
    two_mu: ti.f32,
    lam: ti.f32,
    own: vec4,
):
    """``map_back`` in Hencky strain ln b / 2 for b = mean (1 + Y), with ``square`` Y², by series in Y."""
    p, q = 0.5 * square.trace(), Y.determinant()
    log = log_series(p, q)
    skewed = 3.0 * log[0] + 2.0 * p * log[2]  # tr ln(1 + Y)
    volume = 0.5 * (3.0 * ti.log(mean) + skewed)
    norm2 = 2.0 * p * log[1] * log[1] + 6.0 * q * log[1] * log[2] + (2.0 / 3.0) * p * p * log[2] * log[2]
    shear = 0.5 * ti.sqrt(ti.max(norm2, 0.0))
    elastic, kept, remembered = volume, 1.0, memory
    for model in ti.static(laws.hencky_plastic):
        if law == model.number:
            elastic, kept, remembered = model.radial_return(volume, shear, memory, own)
    mapped = F
    if elastic != volume or kept != 1.0:
        # exp((elastic - volume) / 3 - (1 - kept) dev e) with dev e = (ln(1 + Y) - skewed / 3) / 2
        power = power_series(0.5 * (kept - 1.0), p, q)
        scale = ti.exp((elastic - volume) * (1.0 / 3.0) + (1.0 - kept) * skewed * (1.0 / 6.0))
        change = (scale * power[1]) * Y + (scale * power[2]) * square
        for i in ti.static(range(3)):
            change[i, i] += scale * power[0]
        mapped = change @ F
    deviator = (0.5 * kept * log[1]) * Y + (0.5 * kept * log[2]) * square
    for i in ti.static(range(3)):
        deviator[i, i] -= kept * log[2] * p * (1.0 / 3.0)
    tau, stiffness = hencky_stress(elastic, deviator, kept * shear, two_mu, lam)
    return mapped, remembered, tau, stiffness


@ti.func
def return_along_axes(
    law: ti.i32,
    laws: ti.template(),
    F: mat3,
    b: mat3,
    memory: ti.f32,
    two_mu: ti.f32,
    lam: ti.f32,
    own: vec4,
):
    """The same by the principal axes, for whatever F."""
    squares, axes = eigen_symmetric(b)
    stretch = ti.sqrt(ti.max(squares, LEAST_STRETCH**2))
    strain = ti.log(stretch)
    volume = strain.sum()
    deviator = strain - volume * (1.0 / 3.0)
    shear = deviator.norm()
    elastic, kept, remembered = volume, 1.0, memory
    for model in ti.static(laws.hencky_plastic):
        if law == model.number:
            elastic, kept, remembered = model.radial_return(volume, shear, memory, own)
    left = stretch
    if elastic != volume or kept != 1.0:
        left = ti.exp(elastic * (1.0 / 3.0) + kept * deviator)
    mapped = scaled(F, squares, axes, stretch, left)
    tau, stiffness = hencky_stress(elastic, isotropic(kept * deviator, axes), kept * shear, two_mu, lam)
    return mapped, remembered, tau, stiffness


@ti.func
def scaled(F: mat3, squares: vec3, axes: mat3, stretch: vec3, kept: vec3):
    """F with its principal stretches ``stretch`` (roots of ``squares`` along ``axes``) replaced by ``kept``."""
    mapped = F
    if (kept != stretch).any() or squares.min() < LEAST_STRETCH**2:
        mapped = isotropic(kept / stretch, axes) @ F
        if squares.min() < LEAST_STRETCH**2:
            mapped = isotropic(kept, axes)
    return mapped


@func
def relaxed_branch(p: ti.i32, row: ti.i32, dt: ti.f32, step: mat3, worlds: WorldArrays, particles: ParticleArrays):
    """Strain of the branch that relaxes, of particle ``p`` of the material at ``row``, after ``dt`` in which the
    displacements have the gradient ``step``."""
    one = ti.Matrix.identity(ti.f32, 3)
    kept = ti.exp(-dt / worlds.materials[row + RELAXATION_TIME])
    return one + kept * (step @ particles.conformation[p] @ step.transpose() - one)


@func
def deform(laws: ti.template(), p: ti.i32, dt: ti.f32, C: mat3, worlds: WorldArrays, particles: ParticleArrays):
    """Deformation gradient of particle ``p`` after ``dt``; of fluids only the volume changes, in ``memory``."""
    Fp = particles.F[p]
    if ti.static(laws.relaxing):
        row = particles.material[p] * ROW
        if worlds.materials[row + RELAXING_SHARE] > 0.0:
            step = ti.Matrix.identity(ti.f32, 3) + dt * C
            particles.conformation[p] = relaxed_branch(p, row, dt, step, worlds, particles)
    if ti.static(len(laws.volumetric) > 0):
        law = law_of(p, worlds, particles)
        if is_fluid(law):
            for model in ti.static(laws.volumetric):
                if law == model.number:
                    particles.memory[p] = model.advance_volume(particles.memory[p], dt, C)
        else:
            Fp += dt * C @ Fp
    else:
        Fp += dt * C @ Fp
    return Fp


@func
def respond(
    laws: ti.template(),
    p: ti.i32,
    Fp: mat3,
    C: mat3,
    fixed: vec4,
    worlds: WorldArrays,
    particles: ParticleArrays,
):
    """Kirchhoff stress of particle ``p`` and the stiffness m c^2 that bounds the substep; F and memory are mapped back.

    Both carry the particle's volume, as ``fixed`` (the particle's ``constants``) does.
    """
    row = particles.material[p] * ROW
    law = ti.cast(worlds.materials[row], ti.i32)
    tau = mat3(0.0)
    stiffness = 0.0
    viscosity = 0.0
    for model in ti.static(laws.solid):
        if law == model.number:
            own = own_numbers(row, worlds)
            tau, stiffness, viscosity = model.stress(Fp, C, particles.memory[p], fixed[1], fixed[2], own)
    if ti.static(len(laws.stretch_plastic) + len(laws.hencky_plastic) > 0):
        if is_one_of(law, PLASTIC):
            own = own_numbers(row, worlds)
            mapped, remembered, stress, modulus = map_back(law, laws, Fp, particles.memory[p], fixed[1], fixed[2], own)
            tau, stiffness = stress, modulus
            particles.F[p] = mapped
            particles.memory[p] = remembered
    for model in ti.static(laws.volumetric):
        if law == model.number:
            own = own_numbers(row, worlds)
            tau, stiffness, viscosity = model.stress(Fp, C, particles.memory[p], fixed[1], fixed[2], own)
    if ti.static(laws.fibred):
        fibres = worlds.materials[row + 6] * fixed[1]
        if fibres > 0.0:
            along = Fp @ vec3(worlds.materials[row + 7], worlds.materials[row + 8], worlds.materials[row + 9])
            stretch = along.norm() + 1e-12
            tau += (fibres * (stretch - 1.0) / stretch) * along.outer_product(along)
            stiffness += fibres * stretch * stretch
    if ti.static(laws.relaxing):
        share = worlds.materials[row + RELAXING_SHARE]
        if share > 0.0:
            B = particles.conformation[p]
            mu = 0.5 * share * fixed[1]
            tau += mu * B
            for i in ti.static(range(3)):
                tau[i, i] -= mu
            # As in neo-Hookean matter; the largest square of a stretch where the two others are about 1.
            stiffness += mu * (ti.max(B.trace() - 2.0, 1.0) + 1.0)
    if ti.static(laws.damped):
        time = worlds.materials[row + 1]
        if time > 0.0 and not is_fluid(law):
            tau += (0.5 * time * fixed[1]) * (C + C.transpose())
            for i in ti.static(range(3)):
                tau[i, i] += time * fixed[2] * C.trace()
            viscosity = time * (fixed[1] + fixed[2])
    if ti.static(laws.damped or len(laws.volumetric) > 0):
        if viscosity > 0.0:
            # See constitutive.bounding_speed.
            half = (0.5 * STABLE_WAVENUMBER) * viscosity / fixed[0]
            speed = half + ti.sqrt(half * half + stiffness / fixed[0])
            stiffness = fixed[0] * speed * speed
    return tau, stiffness
