# SPDX-License-Identifier: GPL-3.0-or-later
"""What a Blender must have: to enable the extension nothing, to render what ``batch/blender_script.py`` promises."""

import subprocess
import sys

import pytest

pytest.importorskip("bpy")
from physgen.batch.blender_script import RENDER_MODULES
from physgen.sim.app.requirements import REQUIREMENTS


def run_without(modules, code):
    """Run ``code`` where none of ``modules`` can be imported."""
    # Blender's own add-ons come first; what they import is theirs.
    start = f"import sys, bpy; sys.modules.update(dict.fromkeys({sorted(modules)!r})); {code}"
    done = subprocess.run([sys.executable, "-c", start], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-2000:]


def test_enabling_needs_numpy_alone():
    run_without(set(REQUIREMENTS) - {"numpy"}, "import physgen; physgen.register(); physgen.unregister()")


def test_rendering_needs_no_more_than_it_says():
    code = "import physgen.physgen_addon.render.render_frames, physgen.physgen_addon.frames.video_encoding"
    run_without(set(REQUIREMENTS) - {"numpy", *RENDER_MODULES}, code)
