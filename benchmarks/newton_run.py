# SPDX-License-Identifier: GPL-3.0-or-later
"""Newton's side of ``peers``: the implicit MPM of newton-physics on one CPU thread, in a Python that has ``newton``.

Reads one JSON object from standard input and prints one. Imports nothing of this project, which that Python may lack.
"""

import json
import sys
import time
from typing import Any

import newton
import numpy as np
import warp as wp
from newton.solvers import SolverImplicitMPM


def column(task: dict[str, Any], builder: Any) -> tuple[Any, Any]:
    """Return model and options of a column of sand above a ground."""
    SolverImplicitMPM.register_custom_attributes(builder)
    points = np.load(task["points"], allow_pickle=False)
    each = task["cell"] ** 3 / 8
    builder.add_particles(
        pos=points.tolist(),
        vel=np.zeros_like(points).tolist(),
        mass=[task["density"] * each] * len(points),
        radius=[0.5 * each ** (1 / 3)] * len(points),
    )
    builder.add_ground_plane(cfg=newton.ModelBuilder.ShapeConfig(mu=task["ground_friction"]))
    model = builder.finalize()
    model.set_gravity((0.0, 0.0, -task["gravity"]))
    model.mpm.friction.fill_(task["friction"])
    options = SolverImplicitMPM.Config()
    options.voxel_size = task["cell"]
    return model, options


def stage(task: dict[str, Any], builder: Any) -> tuple[Any, Any, dict[str, list[int]]]:
    """Return model and options of a USD file, and the first and last particle of each body."""
    from pxr import Usd

    opened = Usd.Stage.Open(task["usd"])
    found = builder.add_usd(opened, load_visual_shapes=False)
    options = SolverImplicitMPM.Config.create_from_usd(opened.GetPrimAtPath(found["particle_scene_path"]))
    ranges = {path: list(map(int, pair)) for path, pair in found["path_particle_map"].items()}
    return builder.finalize(), options, ranges


def main() -> None:
    """Simulate the task on standard input, write where its particles end, and print what it cost."""
    task = json.load(sys.stdin)
    wp.config.quiet = True
    wp.set_device("cpu")
    builder = newton.ModelBuilder()
    ranges: dict[str, list[int]] = {}
    if "usd" in task:
        model, options, ranges = stage(task, builder)
    else:
        model, options = column(task, builder)
    solver = SolverImplicitMPM(model, config=options)
    now, then = model.state(), model.state()
    first, speeds = now.particle_q.numpy().copy(), now.particle_qd.numpy().copy()
    step = 1.0 / task["steps_per_second"]

    def advance(steps: int) -> None:
        nonlocal now, then
        for _ in range(steps):
            solver.step(now, then, None, None, step)
            solver.project_outside(then, then, step)
            now, then = then, now

    # Compiles; the second start is a whole new state, as particles remember their strain.
    advance(1)
    now, then = model.state(), model.state()
    now.particle_q.assign(first)
    now.particle_qd.assign(speeds)
    began = time.process_time()
    advance(round(task["seconds"] / step))
    spent = time.process_time() - began
    np.save(task["out"], now.particle_q.numpy())
    print(json.dumps({"version": newton.__version__, "cpu_s": spent, "ranges": ranges}))


if __name__ == "__main__":
    main()
