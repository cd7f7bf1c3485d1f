# SPDX-License-Identifier: MIT
"""Kernels that take bundles: called one by one and in a compiled graph."""

from typing import NamedTuple

import numpy as np
import pytest

ti = pytest.importorskip("taichi")

Scalars = ti.types.ndarray(dtype=ti.f32, ndim=1)


class Bodies(NamedTuple):
    count: ti.i32
    place: Scalars
    speed: Scalars


class Forces(NamedTuple):
    place: Scalars
    """Of the same name as a field of ``Bodies``."""


@pytest.fixture(scope="module")
def kernels():
    from physgen.sim.mpm.kernels import runtime
    from physgen.sim.mpm.kernels.kernel_bundles import func, kernel
    from physgen.sim.mpm.solver_options import SolverOptions

    runtime.ensure_started(SolverOptions())

    @func
    def moved(i: ti.i32, dt: ti.f32, bodies: Bodies):
        return bodies.place[i] + dt * bodies.speed[i]

    @kernel
    def advance(dt: ti.f32, bodies: Bodies, forces: Forces):
        for i in range(bodies.count):
            bodies.speed[i] += dt * forces.place[i]
            bodies.place[i] = moved(i, dt, bodies)

    @kernel
    def farthest(bodies: Bodies) -> ti.f32:
        most = 0.0
        ti.loop_config(serialize=True)
        for i in range(bodies.count):
            most = ti.max(most, bodies.place[i])
        return most

    return advance, farthest


def arrays(*values):
    made = [ti.ndarray(ti.f32, len(value)) for value in values]
    for array, value in zip(made, values, strict=True):
        array.from_numpy(np.asarray(value, dtype=np.float32))
    return made


def test_bundles_are_spread_over_the_signature_and_scalars_may_be_fields(kernels):
    advance, farthest = kernels
    place, speed, force = arrays([0.0, 1.0, 5.0], [1.0, 1.0, 1.0], [2.0, 0.0, 0.0])
    bodies = Bodies(2, place, speed)
    assert list(advance.arguments) == ["dt", "bodies_count", "bodies_place", "bodies_speed", "forces_place"]
    advance(0.5, bodies, Forces(force))
    assert place.to_numpy().tolist() == [1.0, 1.5, 5.0], "the third body is beyond the count"
    assert farthest(bodies) == 1.5


def test_a_graph_takes_bundles_by_the_kernels_parameter_names(kernels):
    from physgen.sim.mpm.kernels.kernel_bundles import Launcher

    advance, _ = kernels
    place, speed, force = arrays([0.0], [0.0], [1.0])
    launcher = Launcher([advance], repeats=3)
    launcher.bind({"dt": 1.0, "bodies": Bodies(1, place, speed), "forces": Forces(force), "unused": 7})()
    assert place.to_numpy().tolist() == [6.0]
    with pytest.raises(KeyError):
        launcher.bind({"dt": 1.0, "bodies": Bodies(1, place, speed)})
