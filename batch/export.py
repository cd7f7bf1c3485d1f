# SPDX-License-Identifier: GPL-3.0-or-later
"""Export a baked scene as Alembic, with Blender as a Python module or inside Blender:

    python batch/export.py SCENE --bake BAKE --out FILE.abc [--json]
    blender -b --factory-startup --python-exit-code 1 -P batch/export.py -- SCENE --bake BAKE --out FILE.abc

Exit codes: 0 done, 2 usage, 3 bad input, 5 Blender failed, 130 cancelled; FILE is whole or not there.
"""

from __future__ import annotations

import argparse
import runpy
import sys
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

# The tree is imported inside functions: Blender may lack packages that it imports in turn.
if TYPE_CHECKING:
    from ..sim.cache.bake_folder import Bake
    from ..sim.errors import Cancelled
    from ..sim.scene.folder import Scene

ENDINGS = (".abc",)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the script's own arguments."""
    parser = argparse.ArgumentParser(prog="export.py", description="Baked scene → Alembic.", allow_abbrev=False)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("--bake", type=Path, required=True, metavar="BAKE", help="bake folder")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="new file, .abc")
    return parser


def work(options: argparse.Namespace, on_event: Any, cancelled: Any) -> tuple[dict[str, Any], str]:
    """Export; return the ``done`` event, and the same in words."""
    from ..sim.app.export_usd import require_target
    from ..sim.cache.bake_check import unchanged_bake
    from ..sim.cache.bake_folder import load_bake
    from ..sim.errors import Cancelled
    from ..sim.scene.folder import load_scene, unchanged_scene

    scene, bake = load_scene(options.scene), load_bake(options.bake)
    require_target(scene, bake, options.out, ENDINGS)
    with unchanged_scene(scene), unchanged_bake(bake):
        for trouble in _show(scene, bake):
            on_event({"event": "notice", "stage": "export", "message": trouble})
        if cancelled():
            raise Cancelled(f"export cancelled; {options.out} was not written")
        _write(options.out)
    frames = bake.last_frame - bake.first_frame + 1
    done = {"event": "done", "stage": "export", "out": str(options.out), "frames": frames}
    return done, f"{frames} frames: {options.out}"


def _show(scene: Scene, bake: Bake) -> list[str]:
    """Import ``scene`` into the empty Blender scene and let it play ``bake``; return problems of single objects."""
    import bpy

    from ..physgen_addon.playback import bake_record, show_bake
    from ..physgen_addon.playback.capture_view import set_rate
    from ..physgen_addon.scene_io.export_animation import export_names
    from ..physgen_addon.scene_io.import_scene import import_scene

    # By the name that the tree has in this process: the importers read the extension's properties.
    import_module("..", __package__).register()
    bpy.ops.wm.read_homefile(use_empty=True)
    shown = bpy.context.scene
    import_scene(shown, scene.root)
    set_rate(shown, bake.manifest.fps)
    first = shown.physgen.simulation.frame_start
    looks = show_bake.looks_of(shown, export_names(shown))
    return show_bake.show(
        shown, bake_record.BakeRecord(folder=str(bake.root.resolve()), frame_start=first, looks=looks)
    )


def _write(file: Path) -> None:
    """Run Blender's exporter. Raises RenderError where it fails."""
    import bpy

    from ..sim.app.export_usd import new_file
    from ..sim.errors import RenderError

    with new_file(file) as partial:
        try:
            finished = bpy.ops.physgen.export_alembic(filepath=str(partial.resolve())) == {"FINISHED"}
        except RuntimeError as error:
            raise RenderError(f"{file}: {str(error).strip()}") from error
        if not (finished and partial.is_file()):
            raise RenderError(f"{file}: Blender's exporter has written nothing; see its messages")


def give_up(options: argparse.Namespace) -> Cancelled:
    """Remove incomplete files when Blender does not stop in time; return the error to report."""
    from ..sim.atomic import remove_unfinished
    from ..sim.errors import Cancelled
    from ..sim.folder_lock import release_all

    remove_unfinished()
    release_all()
    return Cancelled(f"export cancelled; {options.out} was not written")


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code. Inside Blender the arguments follow ``--``."""
    from .blender_script import run_script

    return run_script(build_parser(), work, give_up, arguments, stage="export")


if __name__ == "__main__":
    if __package__:
        from .headless import leave

        leave(main)
    else:
        # A script belongs to no package: run it again as a module of its tree.
        launch = Path(__file__).resolve().parents[1] / "sim" / "app" / "launch.py"
        runpy.run_path(str(launch))["main"](["batch.export", *sys.argv[1:]])
