# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs from a photo to its video: ``run``, ``propose``, ``reconstruct``, ``correct``, ``import``, ``light`` and
``render``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from ...physgen_addon.frames.frame_index import INDEX_FILE
from ...physgen_addon.render.render_options import require_video_name
from ...sim.app.bake_options import BakeOptions
from ...sim.app.default_motion import tells_motion
from ...sim.app.propose import LEAST_CLEAR, PICTURE_FILE, choose, propose
from ...sim.app.reconstruct import correct, reconstruct, require_physics
from ...sim.app.reconstruct_record import require_request
from ...sim.cache.bake_folder import load_bake
from ...sim.errors import InputError
from ...sim.events import Event, IsCancelled, never
from ...sim.folder_lock import lock_beside
from ...sim.importers import DEFAULT_UP_AXIS, SPLAT_UP_AXES
from ...sim.reconstruct.adapters.adapter_registry import FOLDERS, chosen_segmenter
from ...sim.reconstruct.models import model_folder
from ...sim.reconstruct.models.known_models import known_model
from ...sim.reconstruct.reconstruct_options import object_names
from ...sim.scene.folder import load_scene
from ...sim.scene.overrides import check_overrides
from ...sim.trust import Agreed, Claim
from ...sim.validation import to_json
from .. import stages
from ..terminal import Terminal
from .flags import (
    add_anyway_flag,
    add_environment_flags,
    add_object_flags,
    add_reasoning_flags,
    add_reconstruction_flags,
    add_sun_flags,
    box_text,
    chat_request,
    corrected_requests,
    given_anew,
    light_request,
    object_requests,
    reconstruct_options,
)
from .render_commands import add_render_flags, render_options
from .simulation_flags import add_bake_flags, add_physics_flags, bake_options, physics_options


def add_run(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen run``."""
    parser.add_argument("photo", type=Path, metavar="PHOTO", help="JPEG, PNG, TIFF or WebP")
    add_anyway_flag(parser)
    add_object_flags(parser)
    add_reconstruction_flags(parser)
    add_reasoning_flags(parser)
    add_physics_flags(parser)
    add_bake_flags(parser)
    add_render_flags(parser)
    # None: not given, so chosen with the motion where that is chosen too.
    parser.set_defaults(frames=None, slow=None)
    text = "do not choose a default motion: objects stay at rest"
    parser.add_argument("--still", action="store_true", help=text)
    text = "the video, .mp4 or .webm (default: the photo's name with .mp4, in the current folder)"
    parser.add_argument("--out", type=Path, metavar="VIDEO.mp4", help=text)
    parser.add_argument(
        "--work", type=Path, metavar="DIR", help="folder for scene, bake and frames (default: beside the video)"
    )


def add_reconstruct(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen reconstruct``."""
    parser.add_argument("photo", type=Path, metavar="PHOTO", help="JPEG, PNG, TIFF or WebP")
    add_anyway_flag(parser)
    add_object_flags(parser)
    add_reconstruction_flags(parser)
    add_reasoning_flags(parser)
    add_physics_flags(parser)
    text = "where no motion is given, choose the one that `physgen run` would (default: everything is at rest)"
    parser.add_argument("--default-motion", action="store_true", help=text)
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE", help="the scene folder")


def add_propose(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen propose``."""
    parser.add_argument("photo", type=Path, metavar="PHOTO", help="JPEG, PNG, TIFF or WebP")
    text = "folder for the numbered picture and the list (default: NAME_proposals in the current folder)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=text)
    text = "model whose objects come first (default: the installed one); none: without learned weights"
    parser.add_argument("--segmenter", metavar="NAME", help=text)


def add_correct(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen correct``."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder reconstructed from a photo")
    add_anyway_flag(parser)
    add_object_flags(parser, boxes=False)
    add_reconstruction_flags(parser)
    text = (
        "agree to what the scene's record asks for outside its folder: adapters to run, files to read; each is shown "
        "first, and remembered (docs/security.md). Your own scenes do not need it"
    )
    parser.add_argument("--trust", action="store_true", help=text)


def add_import(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen import``."""
    what = "PhysGen3D or PhysGen folder (docs/reconstruction.md), splats (PLY), MJCF or URDF"
    parser.add_argument("folder", type=Path, metavar="SOURCE", help=what)
    parser.add_argument("--out", type=Path, required=True, metavar="SCENE", help="the scene folder")
    scale = "largest extent of the first object; sets the scene's scale (default: that of its simulation, else 0.15)"
    parser.add_argument("--size", type=float, metavar="METRES", help=scale)
    up = f"up axis of a splat file, or its down axis (default: {DEFAULT_UP_AXIS})"
    parser.add_argument("--up", choices=SPLAT_UP_AXES, help=up)
    settings = "PhysGen3D's simulation settings, with velocities and friction (default: searched for)"
    parser.add_argument("--settings", type=Path, metavar="FILE.yaml", help=settings)


def add_light(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen light``."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    add_environment_flags(parser)
    add_sun_flags(parser)


def add_render(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen render``."""
    parser.add_argument("scene", type=Path, metavar="SCENE", help="scene folder")
    parser.add_argument("--bake", type=Path, required=True, metavar="BAKE", help="bake folder")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the frames")
    parser.add_argument("--frames", metavar="RANGE", help="1-48, 1,5,9 or 1-48x2 (default: all baked frames)")
    parser.add_argument("--video", type=Path, metavar="VIDEO", help="also encode a video: .mp4 or .webm")
    add_anyway_flag(parser)
    add_render_flags(parser)


def fetch_models(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> None:
    """Install the models that the command names, as ``--download`` asks for. Raises InputError where it names none."""
    if not options.download:
        return
    named = [name for name in (options.segmenter, str(options.depth), options.inpainter) if name in FOLDERS]
    if not named or options.weights is not None:
        raise InputError(
            f"--download: is for {', '.join(FOLDERS)} without --weights; name one by --segmenter, --depth or "
            "--inpainter"
        )
    for model in map(known_model, named):
        status = model_folder.model_status(model)
        if status.is_installed and status.problem is None:
            continue
        for line in model.description():
            terminal({"event": "notice", "stage": "models", "message": line})
        model_folder.install(model, on_event=terminal, cancelled=cancelled)


def run_run(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen run``; the exit code."""
    unnamed = options.out is None
    if options.out is None:
        options.out = Path(f"{options.photo.stem}.mp4")
    require_video_name(options.out)
    work = options.work or options.out.resolve().with_name(options.out.resolve().stem + "_work")
    if unnamed and options.out.exists() and not (work / "frames" / INDEX_FILE).is_file():
        # As cameras call the recording beside a photo.
        raise InputError(f"{options.out}: is there already, and no earlier run made it; name the video with --out")
    physics = physics_options(options)
    given = tells_motion(physics.velocities, physics.spins, physics.overrides)
    if options.still and given:
        raise InputError("--still: a motion is given as well (--velocity, --spin or --set); leave one of them out")
    fetch_models(options, terminal, cancelled)
    use_found_boxes(options, work / "proposals", terminal, cancelled)
    request = stages.RunRequest(
        photo=options.photo,
        objects=object_requests(options, work / "scene"),
        video=options.out,
        work=work,
        physics=physics,
        reconstruct=reconstruct_options(options),
        ask=chat_request(options),
        bake=bake_options(options),
        render=render_options(options),
        choices=stages.Choices(
            motion=not (options.still or given), frames=options.frames is None, slow=options.slow is None
        ),
    )
    stages.photo_to_video(request, terminal, cancelled)
    terminal(
        {"event": "done", "video": str(request.video), "scene": str(request.work / "scene"), "work": str(request.work)}
    )
    terminal.line(f"video: {request.video}\nscene: {request.work / 'scene'}")
    return 0


def run_reconstruct(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen reconstruct``; the exit code."""
    settings, ask = reconstruct_options(options), chat_request(options)
    fetch_models(options, terminal, cancelled)
    beside = options.out.resolve()
    use_found_boxes(options, beside.with_name(f"{beside.name}_proposals"), terminal, cancelled)
    requests = object_requests(options, options.out)
    physics = physics_options(options)
    require_physics(len(requests), physics)
    check_overrides(object_names(requests), physics.overrides)
    done: Event = {"event": "done", "scene": str(options.out)}
    with lock_beside(options.out):
        scene = reconstruct(
            options.photo,
            requests,
            out=options.out,
            options=settings,
            physics=physics,
            ask=ask,
            on_event=terminal,
            cancelled=cancelled,
        )
        if options.default_motion and not tells_motion(physics.velocities, physics.spins, physics.overrides):
            choices = stages.Choices(motion=True, frames=True, slow=True)
            _, clip = stages.choose_motion(scene, BakeOptions(), choices, terminal)
            done["clip"] = {"frames": clip.frames, "slow": clip.slow}
    terminal(done)
    terminal.line(f"scene: {options.out}")
    return 0


def run_propose(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen propose``; the exit code."""
    out = options.out or Path(f"{options.photo.stem}_proposals")
    found = propose(options.photo, out=out, segmenter=_finder(options), on_event=terminal, cancelled=cancelled)
    terminal({"event": "done", "proposals": [to_json(item) for item in found], "out": str(out)})
    for number, item in enumerate(found, start=1):
        terminal.line(f"{number:>2}  --box {box_text(item.box)}  score {item.score:.2f}")
    terminal.line(f"picture: {out / PICTURE_FILE}")
    return 0


def _finder(options: argparse.Namespace) -> str | None:
    """The model that finds objects: the segmenter, but none that has to be shown boxes."""
    segmenter = chosen_segmenter(options.segmenter)
    return None if segmenter in FOLDERS else segmenter


def use_found_boxes(
    options: argparse.Namespace, folder: Path, terminal: Terminal, cancelled: IsCancelled = never
) -> None:
    """Set the boxes in ``options`` to those of objects found in the photo, if no object was given; say so.

    folder: for the numbered picture. Raises InputError where nothing stands out, and for ``--pick`` beside boxes.
    """
    if options.box or options.mask or options.masks is not None or options.only:
        if options.pick:
            raise InputError("--pick: chooses among objects that are found without a box; leave out one of the two")
        return
    finder = _finder(options)
    found = propose(options.photo, out=folder, segmenter=finder, on_event=terminal, cancelled=cancelled)
    wanted = max(len(options.name), len(options.size), len(options.velocity), len(options.spin))
    wanted = max(wanted, len(options.preset) if len(options.preset) > 1 else 0)
    chosen = choose(found, options.pick, wanted, least_clear=LEAST_CLEAR if finder is None else 0.0)
    options.box = [item.box for item in (found[index] for index in chosen)]
    numbers = ", ".join(str(index + 1) for index in chosen)
    boxes = " ".join(box_text(box) for box in options.box)
    message = (
        f"no --box given: using {numbers} of the {len(found)} objects found (--box {boxes}); all are numbered in "
        f"{folder / PICTURE_FILE}: choose others with --pick, or draw a --box"
    )
    terminal({"event": "notice", "stage": "propose", "message": message})


def run_correct(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen correct``; the exit code."""
    scene = load_scene(options.scene)
    earlier = require_request(scene, shown_first(terminal) if options.trust else None, given_anew(options))
    fetch_models(options, terminal, cancelled)
    requests, settings = corrected_requests(options, earlier.objects), reconstruct_options(options, earlier.options)
    correct(scene, earlier=earlier, objects=requests, options=settings, on_event=terminal, cancelled=cancelled)
    terminal({"event": "done", "scene": str(options.scene)})
    terminal.line(f"scene: {options.scene}")
    return 0


def shown_first(terminal: Terminal) -> Agreed:
    """Return the answer of ``--trust``: yes, once every line was shown."""

    def agreed(source: Path, claims: Sequence[Claim]) -> bool:
        for line in (f"{source} asks for this, and --trust agrees to it:", *(claim.line() for claim in claims)):
            terminal({"event": "notice", "stage": "trust", "message": line})
        return True

    return agreed


def run_import(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen import``; the exit code."""
    from ...sim.app.import_folder import import_folder

    import_folder(
        options.folder,
        out=options.out,
        size_m=options.size,
        settings=options.settings,
        up=options.up,
        on_event=terminal,
        cancelled=cancelled,
    )
    terminal({"event": "done", "scene": str(options.out)})
    terminal.line(f"scene: {options.out}")
    return 0


def run_light(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen light``; the exit code."""
    from ...sim.app.set_light import set_light

    request = light_request(options)
    light = set_light(load_scene(options.scene), request=request, on_event=terminal).model.light
    terminal({"event": "done", "scene": str(options.scene), "light": to_json(light)})
    terminal.line(f"scene: {options.scene}")
    return 0


def run_render(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen render``; the exit code."""
    done = stages.run_render(
        load_scene(options.scene),
        load_bake(options.bake),
        options.out,
        render_options(options),
        frames=options.frames,
        video=options.video,
        on_event=terminal,
        cancelled=cancelled,
    )
    terminal(done)
    terminal.line(f"frames: {options.out}" + (f"\nvideo: {options.video}" if options.video else ""))
    return 0
