# SPDX-License-Identifier: MIT
"""Soft bodies by explicit finite elements: neo-Hookean tetrahedra, leapfrog, penalty contact with Coulomb friction.

Law: tau = mu (b - I) + lambda ln J I, Kirchhoff stress (Bonet and Wood, Nonlinear Continuum Mechanics, 2nd ed., 6.4).
Nothing damps it unless ``viscosity_s`` does. All takes advance together, as columns of one array.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SimulationError
from ...events import IsCancelled, never
from .soft_solid import Array, Solid

Single = NDArray[np.float32]
"""Half the memory to move: rounding, 1e-8 m a step, stays far below any tracker's noise."""

BodyForce = Callable[[float], Array]
"""time s → force per mass (3,) in m/s²."""

GRAVITY = 9.81
_LEAST_VOLUME = 0.08
"""An element is not let below that share of its volume: the logarithm has no value for one turned inside out."""


@dataclass(frozen=True, kw_only=True)
class SoftWorld:
    """youngs_modulus: Pa; gradient: (3,) its relative change per half extent along the rest axes, or None.

    viscosity_s: Kelvin-Voigt time, S_v = viscosity (2 mu Ė + lambda tr Ė).
    yield_stress: Pa, von Mises, or None. fibre: (extra modulus in Pa, unit axis (3,)) in the rest frame, or None.
    growth: rate in 1/s at which the stress-free length grows. fading: rate in 1/s at which stiffness decays.
    """

    density: float
    youngs_modulus: float
    poisson_ratio: float
    friction: float
    viscosity_s: float = 0.0
    yield_stress: float | None = None
    fibre: tuple[float, Array] | None = None
    growth: float = 0.0
    fading: float = 0.0
    force: BodyForce | None = None
    gradient: Array | None = None

    def young(self, solid: Solid) -> Array:
        """(M,) Pa of each element."""
        place = solid.centres / (np.ptp(solid.nodes, axis=0) / 2)
        slope = 0.0 if self.gradient is None else place @ self.gradient
        return np.asarray(self.youngs_modulus * (1 + slope) * np.ones(len(solid.volume)))


@dataclass(frozen=True, kw_only=True)
class SoftMotion:
    """T frames, N nodes, S takes. nodes: (S, T, N, 3) m; energy: (S, T) J elastic; loss: (S, T) W of the viscosity.

    flow: (S, M) plastic strain gathered till the end.
    """

    nodes: Array
    energy: Array
    loss: Array
    flow: Array


def stable_step(solid: Solid, world: SoftWorld) -> float:
    """Longest step in s that leapfrog can take, with room for compression; power iteration on the rest stiffness."""
    stiff = world.young(solid) + (world.fibre[0] if world.fibre is not None else 0.0)
    nu = world.poisson_ratio
    wave = stiff * (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    mass = world.density * solid.share
    # An upper bound of the true stiffness: as if all of it were the P-wave modulus on each gradient.
    weight = np.tile(wave * solid.volume, 3)
    rng = np.random.default_rng(0)
    x = rng.normal(size=len(solid.nodes))
    value = 1.0
    for _ in range(30):
        x = (solid.gradient.T @ (weight * (solid.gradient @ x))) / mass
        value = float(np.linalg.norm(x))
        x /= value
    contact = float((_penalty(solid, world) / mass).max())
    rate = np.sqrt(max(value, contact))
    damped = world.viscosity_s * rate / 2
    # Elements that flow stay thin, and thin elements are stiff.
    room = 0.6 if world.yield_stress is None else 0.4
    return float(room * 2 / rate * (np.sqrt(1 + damped * damped) - damped))


def _penalty(solid: Solid, world: SoftWorld) -> Array:
    """(N,) N/m: a layer as stiff as twice the body's cells, in proportion to a node's area."""
    return 2 * world.youngs_modulus * solid.spacing * np.cbrt(solid.share / solid.share.max()) ** 2


def move_soft(
    solid: Solid,
    world: SoftWorld,
    position: Array,
    velocity: Array,
    times: Array,
    cancelled: IsCancelled = never,
) -> SoftMotion:
    """Motion of S takes from ``position`` and ``velocity`` (S, N, 3) at ``times[0]``. times: (T,) s, evenly spaced.

    Raises SimulationError when it diverges.
    """
    stepper = _Stepper(solid, world, position, velocity)
    interval = float(times[1] - times[0])
    steps = int(np.ceil(interval / stable_step(solid, world)))
    dt = interval / steps
    frames, takes = len(times), len(position)
    nodes = np.zeros((takes, frames, len(solid.nodes), 3))
    energy, loss = np.zeros((takes, frames)), np.zeros((takes, frames))
    nodes[:, 0] = position
    stepper.start(dt)
    for frame in range(1, frames):
        if cancelled():
            break
        for step in range(steps):
            stepper.step(float(times[frame - 1] - times[0]) + step * dt, dt)
        nodes[:, frame] = stepper.x.transpose(2, 1, 0)
        energy[:, frame], loss[:, frame] = stepper.energy(), stepper.lost()
        if not np.isfinite(nodes[:, frame]).all():
            raise SimulationError("the finite elements diverged: the body is too soft for its impact")
    return SoftMotion(nodes=nodes, energy=energy, loss=loss, flow=stepper.flow.T.astype(np.float64))


class _Stepper:
    """x, v: (3, N, S). Fields of the elements are (3 i, 3 j, M, S): derivative of x_i along the rest axis j."""

    def __init__(self, solid: Solid, world: SoftWorld, position: Array, velocity: Array) -> None:
        self._solid, self._world, self._takes = solid, world, len(position)
        self.x: Single = np.ascontiguousarray(position.transpose(2, 1, 0), dtype=np.float32)
        self._v: Single = np.ascontiguousarray(velocity.transpose(2, 1, 0), dtype=np.float32)
        self._count = len(solid.volume)
        young = world.young(solid)
        nu = world.poisson_ratio
        self._mu = (young / (2 * (1 + nu)))[:, None].astype(np.float32)
        self._lame = (young * nu / ((1 + nu) * (1 - 2 * nu)))[:, None].astype(np.float32)
        self._mass = (world.density * solid.share)[:, None].astype(np.float32)
        self._gradient = solid.gradient.astype(np.float32)
        self._adjoint = (solid.gradient.T.tocsr() * np.tile(solid.volume, 3)[None, :]).tocsr().astype(np.float32)
        self._penalty = _penalty(solid, world).astype(np.float32)
        self.flow: Single = np.zeros((self._count, self._takes), dtype=np.float32)
        self._loss = np.zeros(self._takes)
        self._yielded: Single | None = None
        if world.yield_stress is not None:
            self._yielded = np.zeros((3, 3, self._count, self._takes), dtype=np.float32)
            self._yielded[np.arange(3), np.arange(3)] = 1.0

    def start(self, dt: float) -> None:
        """Half a step back, so that velocities lie between the positions."""
        self._v -= np.float32(0.5 * dt) * self._acceleration(0.0, dt)

    def step(self, time: float, dt: float) -> None:
        self._v += np.float32(dt) * self._acceleration(time, dt)
        self.x += np.float32(dt) * self._v

    def _acceleration(self, time: float, dt: float) -> Single:
        stress = self._stress(time)
        accel: Single = np.empty_like(self.x)
        for i in range(3):
            accel[i] = self._adjoint @ stress[i].reshape(3 * self._count, self._takes)
        accel /= -self._mass
        accel[2] -= np.float32(GRAVITY)
        if self._world.force is not None:
            accel += self._world.force(time).astype(np.float32)[:, None, None]
        self._contact(accel, dt)
        return accel

    def _contact(self, accel: Single, dt: float) -> None:
        rows, takes = np.nonzero(self.x[2] < 0)
        if len(rows) == 0:
            return
        press = self._penalty[rows] * -self.x[2, rows, takes] / self._mass[rows, 0]
        accel[2, rows, takes] += press
        # Coulomb: as much as stops the slip within the step, at most mu times the pressure.
        slip = self._v[:2, rows, takes] + np.float32(dt) * accel[:2, rows, takes]
        size = np.sqrt((slip**2).sum(axis=0))
        most = np.minimum(self._world.friction * press, size / dt)
        accel[:2, rows, takes] -= (most / np.maximum(size, 1e-12)) * slip

    def _along(self, of_nodes: Single) -> Single:
        """Gradient of a field (3, N, S) of the nodes: (3, 3, M, S)."""
        out: Single = np.empty((3, 3, self._count, self._takes), dtype=np.float32)
        for i in range(3):
            out[i] = (self._gradient @ of_nodes[i]).reshape(3, self._count, self._takes)
        return out

    def _stress(self, time: float) -> Single:
        """First Piola-Kirchhoff stress (3, 3, M, S)."""
        world = self._world
        f = self._along(self.x)
        if world.growth:
            f *= np.float32(1 / (1 + world.growth * time))
        cofactor, volume = _cofactor(f)
        np.maximum(volume, np.float32(_LEAST_VOLUME), out=volume)
        mu, lame = self._mu, self._lame
        if world.fading:
            mu, lame = (m * np.float32(np.exp(-world.fading * time)) for m in (mu, lame))
        if self._yielded is None:
            p: Single = mu * f
            p += (lame * np.log(volume) - mu) / volume * cofactor
        else:
            p = self._plastic(f, cofactor / volume, mu, lame * np.log(volume) - mu)
        if world.fibre is not None:
            extra, axis = world.fibre
            along = np.einsum("ijms,j->ims", f, axis.astype(np.float32))
            strain = np.float32(0.5) * ((along**2).sum(axis=0) - 1)
            p += axis.astype(np.float32)[None, :, None, None] * (np.float32(extra) * strain * along)[:, None]
        if world.viscosity_s:
            p += self._viscous(f, mu, lame)
        return p

    def _viscous(self, f: Single, mu: Single, lame: Single) -> Single:
        strain = _product(f.transpose(1, 0, 2, 3), self._along(self._v))
        strain = np.float32(0.5) * (strain + strain.transpose(1, 0, 2, 3))
        s = 2 * mu * strain
        s[np.arange(3), np.arange(3)] += lame * (strain[0, 0] + strain[1, 1] + strain[2, 2])
        s *= np.float32(self._world.viscosity_s)
        self._loss = ((s * strain).sum(axis=(0, 1)) * self._solid.volume[:, None]).sum(axis=0)
        return _product(f, s)

    def _plastic(self, f: Single, inverse: Single, mu: Single, pressure: Single) -> Single:
        """Radial return on b = F Cp^-1 F^T (Simo, Comput. Methods Appl. Mech. Eng. 99, 1992), which keeps Cp^-1.

        inverse: F^-T.
        """
        assert self._yielded is not None and self._world.yield_stress is not None
        b = _product(_product(f, self._yielded), f.transpose(1, 0, 2, 3))
        mean = (b[0, 0] + b[1, 1] + b[2, 2]) / 3
        shear = mu * np.sqrt(1.5 * np.maximum((b**2).sum(axis=(0, 1)) - 3 * mean**2, 0))
        over = shear > self._world.yield_stress
        if over.any():
            keep = self._world.yield_stress / shear[over]
            part = b[:, :, over] * keep
            part[np.arange(3), np.arange(3)] += (1 - keep) * mean[over]
            self.flow[over] += (1 - keep) * shear[over] / (3 * np.broadcast_to(mu, shear.shape)[over])
            b[:, :, over] = part
            back = inverse[:, :, over]
            self._yielded[:, :, over] = _product(_product(back.transpose(1, 0, 2), part), back)
        p = mu * _product(b, inverse)
        p += pressure * inverse
        return p

    def energy(self) -> Array:
        """(S,) J stored by the neo-Hookean law, plastic flow left aside."""
        f = self._along(self.x).astype(np.float64)
        _, volume = _cofactor(f)
        log = np.log(np.maximum(volume, _LEAST_VOLUME))
        density = 0.5 * self._mu * ((f**2).sum(axis=(0, 1)) - 3) - self._mu * log + 0.5 * self._lame * log**2
        return np.asarray((density * self._solid.volume[:, None]).sum(axis=0))

    def lost(self) -> Array:
        """(S,) W."""
        return self._loss


def _product(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Matrix products of (3, 3, …) fields. Written out: einsum walks these by single numbers."""
    out = np.empty((3, 3, *np.broadcast_shapes(a.shape[2:], b.shape[2:])), dtype=np.result_type(a, b))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


def _cofactor(f: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Cofactors (3, 3, M, S) and determinants (M, S) of ``f``."""
    out = np.empty_like(f)
    for i in range(3):
        a, b = f[(i + 1) % 3], f[(i + 2) % 3]
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            out[i, j] = a[k] * b[m] - a[m] * b[k]
    return out, f[0, 0] * out[0, 0] + f[0, 1] * out[0, 1] + f[0, 2] * out[0, 2]
