# SPDX-License-Identifier: MIT
# ruff: noqa: ANN001, ANN201
# mypy: disable-error-code="untyped-decorator, no-untyped-def, valid-type, index, attr-defined"
# (Taichi reads the annotations itself: kernels and their functions cannot state that they return nothing or a tuple;
# arguments without a type are as wide as what is passed.)
"""Splats → ellipses in the image, and gradients of the ellipses → gradients of the splats. One splat a thread.

Zwicker et al. 2001, EWA Volume Splatting, as in Kerbl et al. 2023, eq. 5: Σ' = J V Σ Vᵀ Jᵀ + LOW_PASS·1. All in double
precision: it is little work, and a needle's Σ' has entries that differ by many powers of ten. docs/splats.md has the
derivation.
"""

from typing import NamedTuple

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ...mpm.kernels.kernel_bundles import kernel
from ...scene.model import Camera

dvec2 = ti.types.vector(2, ti.f64)
dvec3 = ti.types.vector(3, ti.f64)
dvec4 = ti.types.vector(4, ti.f64)
dmat23 = ti.types.matrix(2, 3, ti.f64)
dmat3 = ti.types.matrix(3, 3, ti.f64)

Doubles = ti.types.ndarray(dtype=ti.f64, ndim=1)
Table = ti.types.ndarray(dtype=ti.f64, ndim=2)
Reals2 = ti.types.ndarray(dtype=ti.f32, ndim=2)
Places = ti.types.ndarray(dtype=ti.i64, ndim=1)

LOW_PASS = 0.3
"""Pixels² added to every ellipse's covariance, so that none falls between pixels (Kerbl et al. 2023)."""

NEAREST = 0.01
"""Near plane: metres in front of the camera from which a splat's centre is drawn."""

FURTHEST = 1e9
"""Largest coordinate of a drawn splat's centre in metres: beyond, a double has no digits left."""

BESIDE = 0.15
"""Fraction of the image's width (height) outside the image from which J is that of the edge: further out, the linear
approximation of the projection inflates splats that are barely in view (Kerbl's 1.3 times the tangent of the field)."""

CUT_OFF = 1.0 / 512.0
"""Alpha below which a splat is not drawn."""

FX, FY, CX, CY, LEFT, RIGHT, TOP, BOTTOM, AXES, PLACE = 0, 1, 2, 3, 4, 5, 6, 7, 8, 17
"""Offsets in the array of a camera: focal lengths and principal point, pixels; the bounds of x/z and y/z between which
J follows a centre; rows of V; position in the world, metres."""

MIDDLE, ACROSS, SLANT, ALONG, REACH, OPACITY, COLOUR, DEPTH, ELLIPSE = 0, 2, 3, 4, 5, 6, 7, 10, 11
"""Offsets in the array of an ellipse, and its length. For (dx, dy) pixels from its centre, (u, v) = (ACROSS·dx +
SLANT·dy, ALONG·dy) is the offset in standard deviations; it is drawn where u² + v² < REACH, nowhere if REACH is 0."""

SUMS = 9
"""Numbers for each pair of splat and tile: Σg, Σgu, Σgv, Σguu, Σguv, Σgvv with g = α ∂L/∂α, and ∂L/∂colour."""


class SplatArrays(NamedTuple):
    """N splats, or the gradient of a loss by each of their numbers."""

    centres: Table
    """(N, 3) m, world."""

    scales: Table
    """(N, 3) standard deviations along the splat's axes, m."""

    rotations: Table
    """(N, 4) unit quaternions w, x, y, z."""

    opacities: Doubles
    """(N,) 0 to 1."""

    colours: Table
    """(N, 3) sRGB."""


class ProjectionLimits(NamedTuple):
    """``LOW_PASS`` (pixels²), ``NEAREST`` (m) and ``FURTHEST`` (m)."""

    low_pass: ti.f64
    nearest: ti.f64
    furthest: ti.f64


class PairSums(NamedTuple):
    """Pairs of splats and tiles, splat by splat."""

    ranked: Places
    """(M,) drawn splats, nearest first."""

    starts: Places
    """(M + 1,) first pair of a drawn splat."""

    sums: Reals2
    """(P, SUMS) gradient of a pair, see ``SUMS``."""


def numbers_of(camera: Camera) -> NDArray[np.float64]:
    """Return ``camera`` as the array (20,) that the kernels read, laid out as ``FX`` to ``PLACE``."""
    pose = np.asarray(camera.world_from_camera, dtype=np.float64)
    wide, high = BESIDE * camera.width, BESIDE * camera.height
    edges = (
        (-wide - camera.cx) / camera.fx,
        (camera.width + wide - camera.cx) / camera.fx,
        (-high - camera.cy) / camera.fy,
        (camera.height + high - camera.cy) / camera.fy,
    )
    inner = (camera.fx, camera.fy, camera.cx, camera.cy)
    return np.concatenate([inner, edges, pose[:3, :3].T.ravel(), pose[:3, 3]])


@ti.func
def load3(table: Table, i):
    """Return row ``i`` of a table of three columns."""
    return dvec3(table[i, 0], table[i, 1], table[i, 2])


@ti.func
def view_of(camera: Doubles):
    """Return V, the rotation from world to camera axes."""
    view = dmat3(0.0)
    for r in ti.static(range(3)):
        for c in ti.static(range(3)):
            view[r, c] = camera[AXES + 3 * r + c]
    return view


@ti.func
def axes_of(q):
    """Return R of a unit quaternion w, x, y, z."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return dmat3(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )


@ti.func
def slopes_of(camera: Doubles, p):
    """Return J at ``p`` in camera axes; the clamped x/z and y/z it uses; for each 1 where not clamped, else 0."""
    ratio, free = dvec2(p[0] / p[2], p[1] / p[2]), dvec2(1.0)
    for c in ti.static(range(2)):
        least, most = camera[LEFT + 2 * c], camera[LEFT + 2 * c + 1]
        if ratio[c] < least or ratio[c] > most:
            ratio[c] = ti.min(ti.max(ratio[c], least), most)
            free[c] = 0.0
    across, along = camera[FX] / p[2], camera[FY] / p[2]
    return dmat23([across, 0.0, -across * ratio[0]], [0.0, along, -along * ratio[1]]), ratio, free


@ti.func
def whitening_of(m, low_pass):
    """Return ACROSS, SLANT and ALONG of the covariance m mᵀ + low_pass·1."""
    first = dvec3(m[0, 0], m[0, 1], m[0, 2])
    second = dvec3(m[1, 0], m[1, 1], m[1, 2])
    xx, xy, yy = first.dot(first), first.dot(second), second.dot(second)
    # Binet–Cauchy identity: xx yy - xy² without the cancellation.
    determinant = first.cross(second).norm_sqr() + low_pass * (xx + yy + low_pass)
    across = ti.sqrt((yy + low_pass) / determinant)
    return dvec3(across, -across * xy / (yy + low_pass), 1.0 / ti.sqrt(yy + low_pass))


@kernel
def project(camera: Doubles, ellipses: Table, splats: SplatArrays, limits: ProjectionLimits):
    """Write the ellipse of every splat."""
    for i in range(splats.centres.shape[0]):
        view = view_of(camera)
        centre = load3(splats.centres, i)
        within = ti.max(ti.abs(centre[0]), ti.abs(centre[1]), ti.abs(centre[2])) < limits.furthest
        p = view @ (centre - dvec3(camera[PLACE], camera[PLACE + 1], camera[PLACE + 2]))
        ellipses[i, DEPTH] = p[2]
        ellipses[i, REACH] = 0.0
        if within and p[2] > limits.nearest and splats.opacities[i] > CUT_OFF:
            q = dvec4(splats.rotations[i, 0], splats.rotations[i, 1], splats.rotations[i, 2], splats.rotations[i, 3])
            spread = axes_of(q)
            for r in ti.static(range(3)):
                for c in ti.static(range(3)):
                    spread[r, c] *= splats.scales[i, c]
            slopes, _, _ = slopes_of(camera, p)
            whitening = whitening_of(slopes @ view @ spread, limits.low_pass)
            ellipses[i, MIDDLE] = camera[FX] * p[0] / p[2] + camera[CX]
            ellipses[i, MIDDLE + 1] = camera[FY] * p[1] / p[2] + camera[CY]
            for c in ti.static(range(3)):
                ellipses[i, ACROSS + c] = whitening[c]
                ellipses[i, COLOUR + c] = splats.colours[i, c]
            ellipses[i, REACH] = 2.0 * ti.log(splats.opacities[i] / CUT_OFF)
            ellipses[i, OPACITY] = splats.opacities[i]


@ti.func
def quaternion_gradient(d_axes, q):
    """Return the gradient by a unit quaternion's four entries, through its normalisation, given that by R."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    d = d_axes
    # Of the nine entries in axes_of; off-diagonal ones occur in sums and differences of mirrored entries.
    more = dvec3(d[2, 1] + d[1, 2], d[0, 2] + d[2, 0], d[1, 0] + d[0, 1])
    less = dvec3(d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1])
    g = 2.0 * dvec4(
        x * less[0] + y * less[1] + z * less[2],
        w * less[0] + y * more[2] + z * more[1] - 2.0 * x * (d[1, 1] + d[2, 2]),
        w * less[1] + x * more[2] + z * more[0] - 2.0 * y * (d[0, 0] + d[2, 2]),
        w * less[2] + x * more[1] + y * more[0] - 2.0 * z * (d[0, 0] + d[1, 1]),
    )
    return g - g.dot(q) * q


@kernel
def project_back(camera: Doubles, ellipses: Table, splats: SplatArrays, pairs: PairSums, gradients: SplatArrays):
    """Sum the gradients of each drawn splat's pairs and propagate them to the splat's parameters.

    In the order of the tiles: the same sum each time.
    """
    for n in range(pairs.ranked.shape[0]):
        i = pairs.ranked[n]
        total, second, d_colour = dvec3(0.0), dvec3(0.0), dvec3(0.0)
        for slot in range(ti.cast(pairs.starts[n], ti.i32), ti.cast(pairs.starts[n + 1], ti.i32)):
            for c in ti.static(range(3)):
                total[c] += pairs.sums[slot, c]
                second[c] += pairs.sums[slot, 3 + c]
                d_colour[c] += pairs.sums[slot, 6 + c]
        view = view_of(camera)
        p = view @ (load3(splats.centres, i) - dvec3(camera[PLACE], camera[PLACE + 1], camera[PLACE + 2]))
        q = dvec4(splats.rotations[i, 0], splats.rotations[i, 1], splats.rotations[i, 2], splats.rotations[i, 3])
        axes = axes_of(q)
        spread = axes
        for r in ti.static(range(3)):
            for c in ti.static(range(3)):
                spread[r, c] *= splats.scales[i, c]
        slopes, ratio, free = slopes_of(camera, p)
        seen = slopes @ view
        across, slant, along = ellipses[i, ACROSS], ellipses[i, SLANT], ellipses[i, ALONG]
        # ∂L/∂middle = Wᵀ Σ g w and ∂L/∂Σ' = ½ Wᵀ (Σ g w wᵀ) W, with w = (u, v) = W (dx, dy).
        d_x = across * total[1]
        d_y = slant * total[1] + along * total[2]
        half_u = dvec2(across * second[0], slant * second[0] + along * second[1])
        half_v = dvec2(across * second[1], slant * second[1] + along * second[2])
        d_xx = 0.5 * half_u[0] * across
        d_xy = 0.5 * half_u[1] * across
        d_yy = 0.5 * (half_u[1] * slant + half_v[1] * along)
        # Σ' = M Mᵀ + …, M = J V R diag(s): ∂L/∂M = 2 ∂L/∂Σ' M.
        m = seen @ spread
        d_m = dmat23(0.0)
        for c in ti.static(range(3)):
            d_m[0, c] = 2.0 * (d_xx * m[0, c] + d_xy * m[1, c])
            d_m[1, c] = 2.0 * (d_xy * m[0, c] + d_yy * m[1, c])
        d_spread = seen.transpose() @ d_m
        d_axes = d_spread
        for c in ti.static(range(3)):
            along_axis = ti.cast(0.0, ti.f64)
            for r in ti.static(range(3)):
                along_axis += d_spread[r, c] * axes[r, c]
                d_axes[r, c] *= splats.scales[i, c]
            gradients.scales[i, c] = along_axis
            gradients.colours[i, c] = d_colour[c]
        d_q = quaternion_gradient(d_axes, q)
        for c in ti.static(range(4)):
            gradients.rotations[i, c] = d_q[c]
        gradients.opacities[i] = total[0] / ellipses[i, OPACITY]
        d_slopes = d_m @ spread.transpose() @ view.transpose()
        fx, fy = camera[FX] / p[2], camera[FY] / p[2]
        d_p = dvec3(
            fx * (d_x - free[0] * d_slopes[0, 2] / p[2]),
            fy * (d_y - free[1] * d_slopes[1, 2] / p[2]),
            (
                -fx * (d_x * p[0] + d_slopes[0, 0] - (1.0 + free[0]) * ratio[0] * d_slopes[0, 2])
                - fy * (d_y * p[1] + d_slopes[1, 1] - (1.0 + free[1]) * ratio[1] * d_slopes[1, 2])
            )
            / p[2],
        )
        d_centre = view.transpose() @ d_p
        for c in ti.static(range(3)):
            gradients.centres[i, c] = d_centre[c]
