# SPDX-License-Identifier: GPL-3.0-or-later
"""Render a baked scene into its photo, with Blender as a Python module or inside Blender:

    python batch/render.py SCENE --bake BAKE --out DIR [--frames 1-48x2] [--video out.mp4] [--json]
    blender -b --factory-startup --python-exit-code 1 -P batch/render.py -- SCENE --bake BAKE --out DIR …

Exit codes: 0 done, 2 usage, 3 bad input, 5 rendering failed, 130 cancelled; complete frames are kept.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import importlib.util
import json
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn, TextIO

ROOT = Path(__file__).resolve().parents[1]


def _package() -> str:
    """Name of the package that this file belongs to; run as a plain file it has none yet, so it is loaded as physgen.

    Loaded from this very tree, because another version may be installed beside it.
    """
    if __package__:
        return __package__.rpartition(".")[0]
    name = "physgen"
    found = sys.modules.get(name)
    if found is None or Path(str(found.__file__)).resolve().parent != ROOT:
        spec = importlib.util.spec_from_file_location(
            name, ROOT / "__init__.py", submodule_search_locations=[str(ROOT)]
        )
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        sys.modules[name] = module
        spec.loader.exec_module(module)
    return name


def _load(module: str) -> ModuleType:
    return importlib.import_module(f"{_package()}.{module}")


def build_parser() -> argparse.ArgumentParser:
    """The script's arguments."""
    parser = argparse.ArgumentParser(prog="render.py", description="Baked scene → frames, video.", allow_abbrev=False)
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("--bake", type=Path, required=True, metavar="BAKE", help="bake folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of the frames")
    parser.add_argument("--frames", metavar="RANGE", help="1-48, 1,5,9 or 1-48x2 (default: all that are baked)")
    _load("batch.render_arguments").add_render_options(parser)
    parser.add_argument("--video", type=Path, metavar="VIDEO.mp4", help="also encode the frames")
    parser.add_argument("--parent", type=int, metavar="PID", help="stop in good order when this parent process is gone")
    parser.add_argument("--json", action="store_true", help="progress and result as JSON lines")
    return parser


@contextlib.contextmanager
def _events_apart_from_chatter() -> Iterator[TextIO]:
    """The real standard output, while everything that Blender's C code prints there goes to standard error."""
    sys.stdout.flush()
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        with os.fdopen(os.dup(kept), "w", encoding="utf-8", buffering=1) as stream:
            yield stream
    finally:
        sys.stdout.flush()
        os.dup2(kept, 1)
        os.close(kept)


def _show(event: dict[str, Any], stream: TextIO, as_json: bool) -> None:
    if as_json:
        stream.write(json.dumps(event, ensure_ascii=False) + "\n")
    elif event["event"] == "progress":
        eta = event.get("eta_s")
        left = f", about {eta:.0f} s left" if eta else ""
        stream.write(f"{event['stage']} {event['done']}/{event['total']}{left}\n")
    elif "message" in event:
        stream.write(f"{event['message']}\n")
    stream.flush()


def _report(error: Any, as_json: bool, stream: TextIO) -> int:
    """Say what the PhysGenError ``error`` says; the exit code it stands for."""
    if as_json:
        _show({"event": "error", "kind": type(error).__name__, "message": str(error)}, stream, True)
    else:
        sys.stderr.write(f"error: {error}\n")
    return int(error.exit_code)


def run(options: argparse.Namespace, stream: TextIO, stop: threading.Event) -> int:
    """Render as ``options`` ask; the exit code."""
    errors = _load("sim.errors")

    def cancelled() -> bool:
        return stop.is_set() or (options.parent is not None and os.getppid() != options.parent)

    def on_event(event: dict[str, Any]) -> None:
        _show(event, stream, options.json)

    started = time.monotonic()
    try:
        try:
            import bpy  # noqa: F401
        except ImportError as error:
            raise errors.RenderError(
                f"Blender as a Python module is not usable ({error}); run `make setup`, or run this file in Blender"
            ) from error
        frames, settings = _load("physgen_addon.bridge.frames"), _load("batch.render_arguments").render_options(options)
        folder = _load("sim.scene.folder").load_scene(options.scene)
        paths = frames.render_frames(
            folder, options.bake, options.out, settings, on_event, cancelled, frames=options.frames
        )
        done = {"event": "done", "frames": len(paths), "out": str(options.out)}
        if options.video is not None:
            manifest = _load("sim.cache.manifest").load_manifest(options.bake)
            ledger = _load("physgen_addon.bridge.ledger").Ledger(options.out)
            if ledger.has_video(options.video, paths, manifest.fps):
                on_event({"event": "notice", "stage": "encode", "message": f"up to date: {options.video}"})
            else:
                _load("physgen_addon.bridge.video").encode(paths, options.video, fps=manifest.fps, on_event=on_event)
                ledger.record_video(options.video, paths, manifest.fps)
            done["video"] = str(options.video)
    except errors.PhysGenError as error:
        return _report(error, options.json, stream)
    except OSError as error:
        # Of the temporary folder, most likely: layers and textures pass through it.
        message = f"{error.filename or tempfile.gettempdir()}: {error.strerror or error}; free space, then run again"
        return _report(errors.RenderError(message), options.json, stream)
    done["seconds"] = round(time.monotonic() - started, 1)
    _show(done, stream, options.json)
    if not options.json:
        stream.write(f"{done['frames']} frames in {done['out']}, {done['seconds']:.0f} s\n")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry; the exit code. Inside Blender the arguments come after ``--``."""
    if arguments is None:
        arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
    options = build_parser().parse_args(arguments)
    cancelled = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: cancelled.set())
    with _events_apart_from_chatter() as stream:
        return run(options, stream, cancelled)


def leave(code: int) -> NoReturn:
    """End the process with ``code``.

    Blender as a Python module crashes now and then while Python takes it down, after all work is done and said; a
    farm would take that for a failed render. So Python does not take it down.
    """
    bpy: Any = sys.modules.get("bpy")
    if bpy is not None and not bpy.app.binary_path:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    # SystemExit would leave Blender's own exit code at 0 unless it is raised at the very end of the script.
    sys.exit(code)


if __name__ == "__main__":
    leave(main())
