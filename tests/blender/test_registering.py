# SPDX-License-Identifier: GPL-3.0-or-later
"""Enabling the extension needs bpy and numpy, under whatever name Blender gives the package."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("bpy")
ROOT = Path(__file__).resolve().parents[2]

ENABLE = """
import importlib.abc, importlib.util, sys, types  # noqa: E402
import bpy  # noqa: E402

class Forbidden(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        heavy = ("scipy", "PIL", "trimesh", "skimage", "cv2", "taichi", "OpenImageIO", "patchmatch", "physgen")
        if name.split(".")[0] in heavy:
            raise ModuleNotFoundError(f"{name} is not there", name=name)

sys.meta_path.insert(0, Forbidden())
for name in ("bl_ext", "bl_ext.user_default"):
    sys.modules[name] = types.ModuleType(name)
    sys.modules[name].__path__ = []
name, root = "bl_ext.user_default.physgen", sys.argv[1]
spec = importlib.util.spec_from_file_location(name, root + "/__init__.py", submodule_search_locations=[root])
extension = importlib.util.module_from_spec(spec)
sys.modules[name] = extension
spec.loader.exec_module(extension)
extension.register()
panels = [kind for kind in bpy.types.Panel.__subclasses__() if getattr(kind, "bl_category", "") == "PhysGen"]
for panel in panels:
    if hasattr(panel, "poll"):
        panel.poll(bpy.context)
extension.unregister()
extension.register()
print(len(panels), "panels")
"""


def test_the_extension_is_enabled_without_anything_but_numpy():
    done = subprocess.run([sys.executable, "-c", ENABLE, str(ROOT)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert int(done.stdout.split()[-2]) >= 4
