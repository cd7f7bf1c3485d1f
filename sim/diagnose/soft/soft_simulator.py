# SPDX-License-Identifier: MIT
"""Batched simulation of one soft body: world parameters and rigid start states in, tracked points out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...mpm.kernels.runtime import ensure_started
from ...mpm.solver_options import SolverOptions
from ..work import Work
from .body_mesh import BodyMesh
from .free_flight import Inertia, State
from .soft_candidates import WorldParameters

if TYPE_CHECKING:
    from .element_kernels import NodeState, TrackArrays

Array = NDArray[np.float64]

Laws = tuple[bool, bool, bool]
"""Whether worlds have viscosity, a yield stress, fibres: each set of laws is a kernel of its own."""

CONTACT = 3.0
"""Ground stiffness per area, times cell width over Young's modulus: little penetration at ordinary impact speeds, no
much shorter step than the material's own."""

CRUSHED = 0.15
"""Same as in ``element_kernels``, which this module imports late."""

SAFETY = 0.55
"""Fraction of the longest stable step at rest, since compressed material is stiffer. At 0.7 some bounces of a soft cube
gain energy without failing."""

RETRIES = 2
"""Retries of failed worlds with a shorter step."""

FARTHEST = 1e3
"""Distance in m beyond which a simulation counts as failed."""

SPARED = 2.0
"""Square of the highest frequency of a single cell over that of the median cell; see ``_spared``."""

DROPPED = 0.1
"""Share below which a sliver gets no stiffness at all: its strain would be rounding error."""

MOST_BYTES = 256 * 2**20
"""Memory limit of one launch; more worlds are split into several."""


@dataclass(frozen=True, kw_only=True)
class SimulationJob:
    """One world, from the undeformed rigid ``start`` under ``world`` to rising ``times`` (T,) after start.time.

    Times are true times: ``laws.rate`` is not applied here.
    """

    start: State
    world: WorldParameters
    times: Array


@dataclass(frozen=True, kw_only=True)
class NodeHistory:
    """Positions and internal accelerations of all nodes at a job's times, (T, N, 3)."""

    places: Array
    accelerations: Array


class SoftWorlds:
    """Batched worlds of the body ``mesh`` of ``density`` with tracked ``rest_points`` (K, 3). work: counts steps."""

    def __init__(
        self, mesh: BodyMesh, density: float, rest_points: Array, *, threads: int = 0, work: Work | None = None
    ) -> None:
        self.mesh = mesh
        self.density = density
        self.masses = density * mesh.node_volumes()
        self._areas = mesh.node_areas()
        self.inertia = Inertia.of(mesh.nodes, self.masses)
        self.holders, self.weights = mesh.locate(rest_points)
        self._cell = float(np.cbrt(6 * np.median(mesh.volumes)))
        self._options = SolverOptions(threads=threads)
        self._work = Work() if work is None else work
        self._shares = _spared(mesh, self.masses)
        self._rate = _fastest(mesh, self.masses, self._shares)
        half = np.ptp(mesh.nodes, axis=0) / 2
        self._middle = (mesh.nodes.max(axis=0) + mesh.nodes.min(axis=0)) / 2
        self._half = half

    def node_masses(self, world: WorldParameters) -> Array:
        """Return nodal masses (N,) kg, with the pellet of ``mass_offset``."""
        if world.fraction <= 0:
            return self.masses
        place = self.inertia.centre + np.asarray(world.offset)
        return concentrated_masses(self.mesh.nodes, self.masses, world.fraction, place)

    def inertia_of(self, world: WorldParameters) -> Inertia:
        """Return mass, centre and inertia under ``world``."""
        return self.inertia if world.fraction <= 0 else Inertia.of(self.mesh.nodes, self.node_masses(world))

    def step(self, world: WorldParameters) -> float:
        """Return the time step in s, stable for elastic waves, fibres and viscosity."""
        mu, lam = world.lame
        stiffness = (lam + 2 * mu) * (1 + float(np.abs(self._grade(world)[0] * self._half).sum())) + world.fibre
        omega = math.sqrt(stiffness) * self._rate
        ratio = 0.5 * world.damping * omega
        lighter = float(np.sqrt((self.node_masses(world) / self.masses).min())) if world.fraction > 0 else 1.0
        pressed = math.sqrt(self.contact_stiffness(world) * float((self._areas / self.masses).max()))
        return SAFETY * 2 / math.hypot(omega, pressed) * (math.sqrt(1 + ratio * ratio) - ratio) * lighter

    def contact_stiffness(self, world: WorldParameters) -> float:
        """Return the contact stiffness per area, N/m³."""
        return CONTACT * world.contact * world.factor * world.modulus / self._cell

    def inner_accelerations(self, places: Array, world: WorldParameters) -> Array:
        """Return elastic accelerations (T, N, 3) m/s² under ``world`` at ``places`` (no fibres, viscosity, yield)."""
        mesh, out = self.mesh, np.zeros_like(places)
        mu, lam = world.lame
        grade, at = self._grade(world)
        scale = self._shares * np.maximum(0.01, 1 + at + mesh.centres @ grade) * mesh.volumes
        for frame, x in enumerate(places):
            corners = x[mesh.cells]
            F = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2) @ mesh.shapes
            columns = np.moveaxis(F, 2, 0)
            cofactors = np.stack([np.cross(columns[i - 2], columns[i - 1]) for i in range(3)], axis=2)
            volume = np.maximum(np.einsum("ci,ci->c", columns[0], cofactors[:, :, 0]), CRUSHED)[:, None, None]
            back = cofactors / volume
            stress = mu * (F - back) + lam * np.log(volume) * back
            pull = -(scale[:, None, None] * stress) @ np.swapaxes(mesh.shapes, 1, 2)
            np.add.at(out[frame], mesh.cells[:, 1:], np.swapaxes(pull, 1, 2))
            np.add.at(out[frame], mesh.cells[:, 0], -pull.sum(axis=2))
        return out / self.node_masses(world)[:, None]

    def contact_difference(
        self, places: Array, following: Array, times: Array, world: WorldParameters, base: WorldParameters
    ) -> Array:
        """Return frictional accelerations (T, N, 3) m/s² at ``places`` (T, N, 3) that ``world`` have beyond ``base``.

        ``following`` (T + 1, N, 3) has one more frame, at ``times`` (T + 1,), for the sliding direction.
        """
        out = np.zeros_like(places)
        change = world.friction - base.friction
        if abs(change) < 0.1 * base.friction:
            return out
        depth = np.maximum(0.0, -places[:, :, 2])
        slide = np.gradient(following, times, axis=0)[:-1] * np.array([1.0, 1.0, 0.0])
        way = slide / np.maximum(np.linalg.norm(slide, axis=2, keepdims=True), 1e-3)
        out -= (change * self.contact_stiffness(world) * depth * self._areas / self.masses)[:, :, None] * way
        return out

    def smoothed(self, accelerations: Array) -> Array:
        """Return (T, N, 3) averaged over each node's cells, without the lattice's jitter."""
        total = np.zeros_like(accelerations)
        weight = np.zeros(len(self.masses))
        share = self.masses[self.mesh.cells]
        np.add.at(weight, self.mesh.cells, np.repeat(share.sum(axis=1, keepdims=True), 4, axis=1))
        for frame, a in enumerate(accelerations):
            mean = (share[:, :, None] * a[self.mesh.cells]).sum(axis=1)
            np.add.at(total[frame], self.mesh.cells, np.repeat(mean[:, None], 4, axis=1))
        return total / weight[:, None]

    def _grade(self, world: WorldParameters) -> tuple[Array, float]:
        """Return grade (3,) and at: stiffness is 1 + at + grade · X, from 1 - q at one end of the slope to 1 + q."""
        slope = np.asarray(world.slope)
        q = float(np.linalg.norm(slope))
        if q == 0:
            return np.zeros(3), 0.0
        along = self.mesh.nodes @ (slope / q)
        low, high = float(along.min()), float(along.max())
        grade = slope * 2 / (high - low)
        return grade, -q * (low + high) / (high - low)

    def run(self, jobs: Sequence[SimulationJob], *, keep: bool = False) -> tuple[list[Array], list[NodeHistory]]:
        """Return tracked points (T, K, 3) of each job; with ``keep`` also the nodes' histories."""
        points: list[Array | None] = [None] * len(jobs)
        histories: list[NodeHistory | None] = [None] * len(jobs)
        groups: dict[Laws, list[int]] = {}
        for i, job in enumerate(jobs):
            laws = job.world.damping > 0, job.world.yield_stress > 0, job.world.fibre > 0
            groups.setdefault(laws, []).append(i)
        for laws, members in groups.items():
            # Longest first: a free thread takes the next.
            members.sort(key=lambda i: -(jobs[i].times[-1] - jobs[i].start.time) / self.step(jobs[i].world))
            shorter = 1.0
            for _ in range(RETRIES + 1):
                for i, found, history in self._launch(jobs, members, laws, keep, shorter):
                    points[i], histories[i] = found, history
                # Crushed material is stiffer than the step allows for.
                members = [i for i in members if not is_plausible(points[i])]
                shorter *= 0.4
                if not members:
                    break
        return [p for p in points if p is not None], [h for h in histories if h is not None]

    def _launch(
        self, jobs: Sequence[SimulationJob], members: list[int], laws: Laws, keep: bool, shorter: float
    ) -> list[tuple[int, Array, NodeHistory | None]]:
        nodes, frames = len(self.mesh.nodes), max(len(jobs[i].times) for i in members)
        row = 8 * (9 * nodes + 3 * frames * len(self.holders) + (9 * len(self.mesh.cells) if laws[1] else 0))
        row += 48 * frames * nodes if keep else 0
        most = max(1, MOST_BYTES // row)
        out: list[tuple[int, Array, NodeHistory | None]] = []
        for start in range(0, len(members), most):
            chosen = members[start : start + most]
            out += self._launch_some([jobs[i] for i in chosen], chosen, frames, laws, keep, shorter)
        return out

    def _nodes(self, jobs: list[SimulationJob], yields: bool) -> NodeState:
        """The nodes of all ``jobs`` as they start; yields: whether the law has a plastic part."""
        from .element_kernels import NodeState

        mesh, count, nodes = self.mesh, len(jobs), len(self.mesh.nodes)
        x, v = np.zeros((count, nodes, 3)), np.zeros((count, nodes, 3))
        for i, job in enumerate(jobs):
            inertia = self.inertia_of(job.world)
            x[i] = job.start.points(inertia, mesh.nodes)
            v[i] = job.start.velocities(inertia, mesh.nodes)
        return NodeState(
            masses=np.stack([self.node_masses(job.world) for job in jobs]),
            x=x,
            v=v,
            f=np.zeros_like(x),
            plastic=np.tile(np.eye(3), (count if yields else 1, len(mesh.cells) if yields else 1, 1, 1)),
        )

    def _tracks(self, jobs: list[SimulationJob], frames: int, keep: bool) -> TrackArrays:
        """Room for the tracked points of all ``jobs`` in ``frames`` frames, and for all nodes if ``keep``."""
        from .element_kernels import TrackArrays

        count = len(jobs)
        times = np.zeros((count, frames))
        for i, job in enumerate(jobs):
            times[i, : len(job.times)] = job.times
        kept = (count, frames, len(self.mesh.nodes), 3) if keep else (1, 1, 1, 3)
        return TrackArrays(
            times=times,
            counts=np.array([[len(job.times)] for job in jobs], dtype=np.int32),
            holders=np.ascontiguousarray(self.holders, dtype=np.int32),
            weights=np.ascontiguousarray(self.weights),
            tracked=np.zeros((count, frames, len(self.holders), 3)),
            kept_x=np.zeros(kept),
            kept_f=np.zeros(kept),
        )

    def _launch_some(
        self,
        jobs: list[SimulationJob],
        names: list[int],
        frames: int,
        laws: Laws,
        keep: bool,
        shorter: float,
    ) -> list[tuple[int, Array, NodeHistory | None]]:
        ensure_started(self._options)
        from . import element_kernels as kernels

        mesh = self.mesh
        damped, yields, fibred = laws
        rows = np.stack([self._row(job, shorter) for job in jobs])
        for job, row in zip(jobs, rows, strict=True):
            spans = np.diff(job.times, prepend=row[kernels.START]) / row[kernels.STEP]
            self._work.add(len(mesh.cells) * int(np.maximum(np.ceil(spans - 1e-9), 1).sum()))
        tracks = self._tracks(jobs, frames, keep)
        kernels.advance_worlds(
            rows,
            damped,
            yields,
            fibred,
            keep,
            kernels.MeshArrays(
                cells=np.ascontiguousarray(mesh.cells, dtype=np.int32),
                shapes=np.ascontiguousarray(mesh.shapes),
                volumes=np.ascontiguousarray(mesh.volumes),
                centres=np.ascontiguousarray(mesh.centres),
                shares=self._shares,
                areas=self._areas,
            ),
            self._nodes(jobs, yields),
            tracks,
        )
        tracked, kept_x, kept_f = map(np.asarray, (tracks.tracked, tracks.kept_x, tracks.kept_f))
        return [
            (
                name,
                tracked[i, : len(job.times)],
                NodeHistory(places=kept_x[i, : len(job.times)], accelerations=kept_f[i, : len(job.times)])
                if keep
                else None,
            )
            for i, (name, job) in enumerate(zip(names, jobs, strict=True))
        ]

    def _row(self, job: SimulationJob, shorter: float) -> Array:
        from . import element_kernels as kernels

        world, row = job.world, np.zeros(kernels.WORLD_ROW)
        row[kernels.MU], row[kernels.LAMBDA] = world.lame
        row[kernels.GRADE : kernels.GRADE + 3], row[kernels.GRADE_AT] = self._grade(world)
        axis = np.asarray(world.axis)
        row[kernels.FIBRE] = world.fibre
        row[kernels.FIBRE_AXIS : kernels.FIBRE_AXIS + 3] = axis / np.linalg.norm(axis)
        row[kernels.DAMPING], row[kernels.YIELD] = world.damping, world.yield_stress
        row[kernels.FRICTION], row[kernels.CONTACT_STIFFNESS] = world.friction, self.contact_stiffness(world)
        row[kernels.GRAVITY : kernels.GRAVITY + 3] = world.gravity
        row[kernels.DRAG], row[kernels.LIFT] = world.drag, world.lift
        row[kernels.WIND : kernels.WIND + 3] = world.wind
        row[kernels.TETHER_STIFFNESS], row[kernels.TETHER_LENGTH] = world.tether_stiffness, world.tether_length
        row[kernels.TETHER_ANCHOR : kernels.TETHER_ANCHOR + 3] = world.tether_anchor
        row[kernels.TETHER_STRING] = float(world.tether_string)
        row[kernels.ADHESION], row[kernels.REACH] = world.adhesion, world.reach
        row[kernels.STEP], row[kernels.START] = shorter * self.step(world), job.start.time
        return row


def is_plausible(points: Array | None) -> bool:
    """Return whether a simulation succeeded: finite, and within ``FARTHEST``."""
    return points is not None and bool(np.isfinite(points).all()) and float(np.abs(points).max()) < FARTHEST


def concentrated_masses(nodes: Array, masses: Array, fraction: float, place: Array) -> Array:
    """Return masses (N,) with the share ``fraction`` concentrated about ``place``, as in sim/effects/mass_offset."""
    spread = float(np.cbrt(np.prod(np.ptp(nodes, axis=0)) / len(nodes)))
    r = (nodes - place) / spread
    base = np.log(masses) - 0.5 * np.einsum("ni,ni->n", r, r)
    b = np.zeros(3)
    weights = np.exp(base - base.max())
    for _ in range(60):
        exponent = base + r @ b
        weights = np.exp(exponent - exponent.max())
        weights /= weights.sum()
        centre = weights @ r
        if float(np.abs(centre).max()) < 1e-10:
            break
        cover = (r - centre).T @ (weights[:, None] * (r - centre))
        change = -np.linalg.lstsq(cover + 1e-9 * np.eye(3), centre, rcond=None)[0]
        b += change * min(1.0, 2.0 / max(float(np.linalg.norm(change)), 1e-12))
    return np.asarray((1 - fraction) * masses + fraction * masses.sum() * weights)


def _gradients(mesh: BodyMesh) -> Array:
    """Return shape function gradients (C, 4, 3)."""
    return np.concatenate([-mesh.shapes.sum(axis=1, keepdims=True), mesh.shapes], axis=1)


def _spared(mesh: BodyMesh, masses: Array) -> Array:
    """Return the stiffness share of each cell (C,): below 1 only in slivers, whose frequency would set the step."""
    squares = (_gradients(mesh) ** 2).sum(axis=2)
    rate = mesh.volumes * (squares / masses[mesh.cells]).sum(axis=1)
    share = np.minimum(1.0, SPARED * float(np.median(rate)) / rate)
    return np.where(share < DROPPED, 0.0, share)


def _fastest(mesh: BodyMesh, masses: Array, shares: Array) -> float:
    """Return the highest angular frequency in rad/s over the square root of the P-wave modulus in Pa, at rest.

    Power iteration on M^-1 K, with K bounded by the P-wave modulus: psi <= (lambda + 2 mu) / 2 |grad u|².
    """
    gradients, volumes = _gradients(mesh), mesh.volumes * shares
    u = np.random.default_rng(0).normal(size=len(mesh.nodes))
    value = 0.0
    for _ in range(60):
        slope = np.einsum("cni,cn->ci", gradients, u[mesh.cells])
        force = np.zeros_like(u)
        np.add.at(force, mesh.cells, volumes[:, None] * np.einsum("cni,ci->cn", gradients, slope))
        force /= masses
        value = float(np.linalg.norm(force) / np.linalg.norm(u))
        u = force / np.linalg.norm(force)
    return math.sqrt(1.05 * value)
