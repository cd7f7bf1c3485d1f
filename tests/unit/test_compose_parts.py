# SPDX-License-Identifier: MIT
"""Options, rates and cameras of the composition."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from physgen.sim.errors import InputError
from physgen.sim.gaussians.compose.compose_options import ComposeOptions
from physgen.sim.gaussians.compose.composition import AGREEMENT_GAIN, MAX_STEP, StepScale, scaled_reference
from physgen.sim.gaussians.compose.composition_parts import Reference
from physgen.sim.gaussians.views.posed_images import orbit_cameras


@pytest.mark.parametrize(
    "changes, said",
    [
        ({"method": "sgd"}, "method is 'sgd'"),
        ({"steps": 0}, "steps is 0"),
        ({"ssim_share": float("nan")}, "ssim_share is nan"),
        ({"keep_strain": 2.0}, "keep_strain is 2.0"),
        ({"seat": 0.1}, "seat is 0.1"),
    ],
)
def test_options_out_of_range_are_named(changes, said):
    with pytest.raises(InputError, match=said):
        ComposeOptions(**changes)


@given(st.floats(1e-12, 1e12), st.integers(0, 2**32 - 1))
def test_steps_do_not_depend_on_the_unit_of_the_loss(unit, seed):
    gradients = np.random.default_rng(seed).normal(size=(300, 3))
    one = StepScale(first=0.1, last=0.5, steps=10).steps_down(gradients, 0)
    np.testing.assert_allclose(StepScale(first=0.1, last=0.5, steps=10).steps_down(unit * gradients, 0), one, rtol=1e-9)
    # Downhill, and the fastest hundredth as far as was asked for.
    assert (np.sum(one * gradients, axis=1) < 0).all()
    assert np.quantile(np.linalg.norm(one, axis=1), 0.99) == pytest.approx(0.1, rel=1e-6)


def test_the_factor_is_kept_and_fades():
    rate, gradients = StepScale(first=1.0, last=0.1, steps=11), np.ones((50, 3))
    first = rate.steps_down(gradients, 0)
    np.testing.assert_allclose(rate.steps_down(0.5 * gradients, 0), 0.5 * first)
    np.testing.assert_allclose(rate.steps_down(gradients, 10), 0.1 * first)
    far = rate.steps_down(1e6 * gradients, 0)
    np.testing.assert_allclose(np.linalg.norm(far, axis=1), MAX_STEP)
    np.testing.assert_array_equal(StepScale(first=0.0, last=1.0, steps=3).steps_down(gradients, 0), 0.0)
    np.testing.assert_array_equal(rate.steps_down(0 * gradients, 3), 0.0)


def test_steps_grow_while_they_agree_and_shrink_while_they_swing():
    gradients = np.random.default_rng(0).normal(size=(40, 3))
    rate = StepScale(first=0.1, last=1.0, steps=40, adapts=True)
    lengths = [np.linalg.norm(rate.steps_down(gradients, step)) for step in range(8)]
    ratios = np.array(lengths) / lengths[0]
    # The fastest of them reach their bound of four first steps before the others do.
    np.testing.assert_allclose(ratios[:5], np.exp(AGREEMENT_GAIN * np.arange(5)), rtol=1e-3)
    assert MAX_STEP - 0.1 < ratios[-1] <= MAX_STEP
    swinging = StepScale(first=0.1, last=1.0, steps=40, adapts=True)
    lengths = [np.linalg.norm(swinging.steps_down((-1) ** step * gradients, step)) for step in range(8)]
    np.testing.assert_allclose(lengths / lengths[0], np.exp(-AGREEMENT_GAIN * np.arange(8)), rtol=1e-9)


@given(st.floats(1e-9, 1e9), st.integers(0, 2**32 - 1))
def test_adapted_steps_do_not_depend_on_the_unit_of_the_loss(unit, seed):
    random = np.random.default_rng(seed)
    gradients = [random.normal(size=(30, 3)), np.zeros((30, 3)), *random.normal(size=(4, 30, 3))]
    one, other = (StepScale(first=0.1, last=0.5, steps=6, adapts=True) for _ in range(2))
    for step, gradient in enumerate(gradients):
        np.testing.assert_allclose(
            other.steps_down(unit * gradient, step), one.steps_down(gradient, step), rtol=1e-6, atol=1e-12
        )


@given(st.integers(0, 2**32 - 1))
def test_an_orbit_sees_everything(seed):
    random = np.random.default_rng(seed)
    points = random.normal(size=(60, 3)) * random.uniform(0.01, 2.0, 3) + random.normal(size=3)
    for camera in orbit_cameras(points, 64):
        seen = camera.project(points)
        assert (seen[:, 2] > 0).all()
        assert seen[:, :2].min() > 0 and seen[:, :2].max() < 64
        above = camera.position - points.mean(axis=0)
        assert above[2] > 0


def test_a_reference_is_made_smaller_with_its_camera():
    camera = orbit_cameras(np.eye(3), 400)[0]
    pixels = np.zeros((400, 400, 3))
    pixels[:, 200:] = 1.0
    small = scaled_reference(Reference(camera=camera, pixels=pixels, backdrop=np.ones((400, 400, 3))), 100)
    assert small.pixels.shape == (100, 100, 3) and small.pixels[:, 50:].min() == 1.0
    point = np.array([[0.3, 0.2, 0.5]])
    np.testing.assert_allclose(small.camera.project(point)[:, :2], camera.project(point)[:, :2] / 4)
    again = Reference(camera=camera, pixels=pixels, backdrop=pixels)
    assert scaled_reference(again, 400) is again
    with pytest.raises(InputError, match="reference pixels have shape"):
        Reference(camera=camera, pixels=pixels[:10], backdrop=pixels)
