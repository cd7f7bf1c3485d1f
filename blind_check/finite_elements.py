# SPDX-License-Identifier: MIT
"""A soft body of tetrahedra and its explicit finite elements, sharing no code with the engine or the fits."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from ..sim.errors import SimulationError
from ..sim.events import IsCancelled, never

Array = NDArray[np.float64]

# Five tetrahedra per cell, mirrored in neighbouring cells so that faces match.
_EVEN = ((0, 1, 2, 4), (3, 1, 7, 2), (5, 1, 4, 7), (6, 2, 7, 4), (1, 2, 4, 7))
_ODD = ((1, 0, 5, 3), (2, 0, 3, 6), (4, 0, 6, 5), (7, 3, 5, 6), (0, 3, 6, 5))


@dataclass(frozen=True, kw_only=True)
class Solid:
    """Tetrahedral mesh of N nodes, M elements. nodes: (N, 3) m; tetrahedra: (M, 4); faces: (F, 3) outward surface.

    volume: (M,) m³. gradient: (3M, N) sparse, row j M + e gives the derivative along axis j in element e.
    share: (N,) m³ of each node. spacing: m, of the grid it came from.
    """

    nodes: Array
    tetrahedra: NDArray[np.int64]
    faces: NDArray[np.int64]
    volume: Array
    gradient: sp.csr_array
    share: Array
    spacing: float

    @property
    def centres(self) -> Array:
        """Return the element centres (M, 3) m."""
        return np.asarray(self.nodes[self.tetrahedra].mean(axis=1))


def tetrahedral_box(size: tuple[float, float, float], cells: tuple[int, int, int]) -> Solid:
    """Return a box of ``size`` m about the origin with ``cells`` cells along x, y, z."""
    axes = [np.linspace(-s / 2, s / 2, n + 1) for s, n in zip(size, cells, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return _solid(nodes, _tetrahedra(cells), size[0] / cells[0])


def tetrahedral_sphere(radius: float, cells: int) -> Solid:
    """Return a sphere of ``radius`` m: a cube of ``cells`` (even) cells along each edge, mapped to a sphere.

    Odd numbers leave flat tetrahedra at the cube's corners.
    """
    line = np.linspace(-1, 1, cells + 1)
    nodes = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1).reshape(-1, 3)
    length = np.abs(nodes).max(axis=1, keepdims=True)
    outward = nodes / np.maximum(length, 1e-12)
    # Each shell of the cube becomes a sphere with evenly spread nodes (Nowell's map).
    x2, y2, z2 = (outward**2).T
    shape = np.column_stack(
        [
            np.sqrt(np.maximum(1 - y2 / 2 - z2 / 2 + y2 * z2 / 3, 0)),
            np.sqrt(np.maximum(1 - x2 / 2 - z2 / 2 + x2 * z2 / 3, 0)),
            np.sqrt(np.maximum(1 - x2 / 2 - y2 / 2 + x2 * y2 / 3, 0)),
        ]
    )
    return _solid(radius * length * outward * shape, _tetrahedra((cells, cells, cells)), 2 * radius / cells)


def _tetrahedra(cells: tuple[int, int, int]) -> NDArray[np.int64]:
    nx, ny, nz = cells
    number = np.arange((nx + 1) * (ny + 1) * (nz + 1)).reshape(nx + 1, ny + 1, nz + 1)
    found = []
    for i, j, k in itertools.product(range(nx), range(ny), range(nz)):
        corner = [number[i + (c & 1), j + (c >> 1 & 1), k + (c >> 2)] for c in range(8)]
        found += [[corner[c] for c in tet] for tet in (_ODD if (i + j + k) % 2 == 0 else _EVEN)]
    return np.array(found, dtype=np.int64)


def _solid(nodes: Array, tetrahedra: NDArray[np.int64], spacing: float) -> Solid:
    edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
    signed = np.linalg.det(edges) / 6
    turned = tetrahedra.copy()
    turned[signed < 0, 2:] = turned[signed < 0][:, [3, 2]]
    edges = nodes[turned[:, 1:]] - nodes[turned[:, :1]]
    volume = np.linalg.det(edges) / 6
    slopes = np.linalg.inv(edges)  # column a: gradient of the shape function of corner a + 1
    slopes = np.concatenate([-slopes.sum(axis=2, keepdims=True), slopes], axis=2)  # (M, 3, 4)
    count = len(turned)
    rows = np.arange(3 * count).reshape(3, count).T[:, :, None]
    rows = np.broadcast_to(rows, (count, 3, 4))
    columns = np.broadcast_to(turned[:, None, :], (count, 3, 4))
    gradient = sp.csr_array((slopes.ravel(), (rows.ravel(), columns.ravel())), shape=(3 * count, len(nodes)))
    share = np.bincount(turned.ravel(), weights=np.repeat(volume / 4, 4), minlength=len(nodes))
    return Solid(
        nodes=nodes,
        tetrahedra=turned,
        faces=_surface(turned),
        volume=volume,
        gradient=gradient,
        share=share,
        spacing=spacing,
    )


def _surface(tetrahedra: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the faces that belong to one tetrahedron only, outward."""
    faces = np.concatenate([tetrahedra[:, list(c)] for c in ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return np.asarray(faces[first[count == 1]])


def surface_mesh(solid: Solid) -> tuple[Array, NDArray[np.int64]]:
    """Return the surface mesh: (V, 3) m and (F, 3)."""
    used, faces = np.unique(solid.faces, return_inverse=True)
    return solid.nodes[used], faces.reshape(-1, 3)


Single = NDArray[np.float32]
"""Half the memory traffic: rounding, 1e-8 m per step, is far below tracking noise."""

BodyForce = Callable[[float], Array]
"""time s → force per mass (3,) in m/s²."""

GRAVITY = 9.81
_LEAST_VOLUME = 0.08
"""Lower bound of an element's volume ratio: the logarithm is undefined for inverted ones."""


@dataclass(frozen=True, kw_only=True)
class SoftWorld:
    """World parameters. youngs_modulus: Pa; gradient: (3,) relative change per half extent, rest axes, or None.

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
        """Return the Young's modulus (M,) Pa of each element."""
        place = solid.centres / (np.ptp(solid.nodes, axis=0) / 2)
        slope = 0.0 if self.gradient is None else place @ self.gradient
        return np.asarray(self.youngs_modulus * (1 + slope) * np.ones(len(solid.volume)))


@dataclass(frozen=True, kw_only=True)
class SoftMotion:
    """Motion of S trials, T frames, N nodes. nodes: (S, T, N, 3) m; energy: (S, T) J elastic; loss: (S, T) W viscous.

    flow: (S, M) accumulated plastic strain at the end.
    """

    nodes: Array
    energy: Array
    loss: Array
    flow: Array


def stable_step(solid: Solid, world: SoftWorld) -> float:
    """Return the longest stable leapfrog step in s, with a margin for compression, by power iteration at rest."""
    stiff = world.young(solid) + (world.fibre[0] if world.fibre is not None else 0.0)
    nu = world.poisson_ratio
    wave = stiff * (1 - nu) / ((1 + nu) * (1 - 2 * nu))
    mass = world.density * solid.share
    # Upper bound of the stiffness: the P-wave modulus on each gradient.
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
    # Plastically deformed elements stay thin, and thin elements are stiff.
    room = 0.6 if world.yield_stress is None else 0.4
    return float(room * 2 / rate * (np.sqrt(1 + damped * damped) - damped))


def _penalty(solid: Solid, world: SoftWorld) -> Array:
    """Return contact stiffnesses (N,) N/m: twice the stiffness of a layer of cells, by nodal area."""
    return 2 * world.youngs_modulus * solid.spacing * np.cbrt(solid.share / solid.share.max()) ** 2


def simulate_soft(
    solid: Solid,
    world: SoftWorld,
    position: Array,
    velocity: Array,
    times: Array,
    cancelled: IsCancelled = never,
) -> SoftMotion:
    """Return the motion of S trials from ``position`` and ``velocity`` (S, N, 3) at ``times[0]``. times: (T,) s, even.

    Raises SimulationError when it diverges.
    """
    stepper = _Stepper(solid, world, position, velocity)
    interval = float(times[1] - times[0])
    steps = int(np.ceil(interval / stable_step(solid, world)))
    dt = interval / steps
    frames, trials = len(times), len(position)
    nodes = np.zeros((trials, frames, len(solid.nodes), 3))
    energy, loss = np.zeros((trials, frames)), np.zeros((trials, frames))
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
    """Leapfrog stepper. x, v: (3, N, S). Element fields are (3 i, 3 j, M, S): derivative of x_i along rest axis j."""

    def __init__(self, solid: Solid, world: SoftWorld, position: Array, velocity: Array) -> None:
        self._solid, self._world, self._trials = solid, world, len(position)
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
        self.flow: Single = np.zeros((self._count, self._trials), dtype=np.float32)
        self._loss = np.zeros(self._trials)
        self._yielded: Single | None = None
        if world.yield_stress is not None:
            self._yielded = np.zeros((3, 3, self._count, self._trials), dtype=np.float32)
            self._yielded[np.arange(3), np.arange(3)] = 1.0

    def start(self, dt: float) -> None:
        """Shift velocities half a step back, between the positions."""
        self._v -= np.float32(0.5 * dt) * self._acceleration(0.0, dt)

    def step(self, time: float, dt: float) -> None:
        self._v += np.float32(dt) * self._acceleration(time, dt)
        self.x += np.float32(dt) * self._v

    def _acceleration(self, time: float, dt: float) -> Single:
        stress = self._stress(time)
        accel: Single = np.empty_like(self.x)
        for i in range(3):
            accel[i] = self._adjoint @ stress[i].reshape(3 * self._count, self._trials)
        accel /= -self._mass
        accel[2] -= np.float32(GRAVITY)
        if self._world.force is not None:
            accel += self._world.force(time).astype(np.float32)[:, None, None]
        self._contact(accel, dt)
        return accel

    def _contact(self, accel: Single, dt: float) -> None:
        rows, trials = np.nonzero(self.x[2] < 0)
        if len(rows) == 0:
            return
        press = self._penalty[rows] * -self.x[2, rows, trials] / self._mass[rows, 0]
        accel[2, rows, trials] += press
        # Coulomb: enough to stop slip within the step, at most mu times the pressure.
        slip = self._v[:2, rows, trials] + np.float32(dt) * accel[:2, rows, trials]
        size = np.sqrt((slip**2).sum(axis=0))
        most = np.minimum(self._world.friction * press, size / dt)
        accel[:2, rows, trials] -= (most / np.maximum(size, 1e-12)) * slip

    def _along(self, of_nodes: Single) -> Single:
        """Return the gradient (3, 3, M, S) of a nodal field (3, N, S)."""
        out: Single = np.empty((3, 3, self._count, self._trials), dtype=np.float32)
        for i in range(3):
            out[i] = (self._gradient @ of_nodes[i]).reshape(3, self._count, self._trials)
        return out

    def _stress(self, time: float) -> Single:
        """Return the first Piola-Kirchhoff stress (3, 3, M, S)."""
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
        """Return the neo-Hookean energy (S,) J, ignoring plastic flow."""
        f = self._along(self.x).astype(np.float64)
        _, volume = _cofactor(f)
        log = np.log(np.maximum(volume, _LEAST_VOLUME))
        density = 0.5 * self._mu * ((f**2).sum(axis=(0, 1)) - 3) - self._mu * log + 0.5 * self._lame * log**2
        return np.asarray((density * self._solid.volume[:, None]).sum(axis=0))

    def lost(self) -> Array:
        """Return the viscous loss (S,) W."""
        return self._loss


def _product(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Return matrix products of (3, 3, …) fields, written out since einsum is slow here."""
    out = np.empty((3, 3, *np.broadcast_shapes(a.shape[2:], b.shape[2:])), dtype=np.result_type(a, b))
    for i in range(3):
        for j in range(3):
            out[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
    return out


def _cofactor(f: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return cofactors (3, 3, M, S) and determinants (M, S) of ``f``."""
    out = np.empty_like(f)
    for i in range(3):
        a, b = f[(i + 1) % 3], f[(i + 2) % 3]
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            out[i, j] = a[k] * b[m] - a[m] * b[k]
    return out, f[0, 0] * out[0, 0] + f[0, 1] * out[0, 1] + f[0, 2] * out[0, 2]
