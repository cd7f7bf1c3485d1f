# SPDX-License-Identifier: GPL-3.0-or-later
"""``physgen doctor``: what the program needs and whether this machine has it."""

from __future__ import annotations

import importlib.metadata
import shutil
import subprocess
import sys
import tempfile

from ..sim.app.process import NO_WINDOW, child_environment
from ..sim.gaussians.guidance.local_model import INSTALL, PACKAGES, missing_packages, package_version
from ..sim.reconstruct.adapters.found import found_adapters, onnxruntime_version
from ..sim.reconstruct.adapters.names import VARIABLE, adapters_file

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
    """Name, whether it is fine, and what was found or what to do."""
    version = ".".join(str(n) for n in sys.version_info[:3])
    findings: list[Finding] = [
        ("python", sys.version_info[:2] in ((3, 11), (3, 13)), f"{version}; bpy has builds for 3.11 and 3.13")
    ]
    findings += [_package(name) for name in _PACKAGES]
    # In processes of their own: a broken library may crash, and Taichi and bpy do not share one.
    findings.append(_import("blender", _BPY_PROBE, "run `make setup`; it names the system libraries that are missing"))
    findings.append(
        _import(
            "simulation",
            _TAICHI_PROBE,
            "reinstall taichi",
        )
    )
    free = shutil.disk_usage(tempfile.gettempdir()).free / 2**30
    findings.append(
        ("temporary space", free > _MINIMUM_FREE_GIB, f"{free:.1f} GiB free; at least {_MINIMUM_FREE_GIB:g} are needed")
    )
    return findings + adapter_findings() + [diffusion_finding()]


def adapter_findings() -> list[Finding]:
    """A user's own models, and what runs them: looked at, not run. Missing is only what the user asked for by name."""
    version = onnxruntime_version()
    text = version or "not installed; models in .onnx files need it: install physgen[onnx]"
    findings = [("onnxruntime (optional)", True, text)]
    adapters = found_adapters()
    findings += [(f"{item.stage} {item.name}", item.usable, item.text) for item in adapters]
    if not adapters:
        place = adapters_file() or f"{VARIABLE} names no file"
        findings.append(("adapters (optional)", True, f"none has a name ({place}; docs/adapters.md)"))
    return findings


def diffusion_finding() -> Finding:
    """What runs a user's own diffusion and CLIP models. It is optional, and not imported: that takes seconds."""
    missing = missing_packages()
    if missing:
        text = f"no {', '.join(missing)}; your own diffusion or CLIP models need it: {INSTALL}"
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
            [sys.executable, "-c", code],
            capture_output=True,
            text=True,
            timeout=120,
            env=child_environment(),
            check=False,
            creationflags=NO_WINDOW,
        )
    except subprocess.TimeoutExpired:
        return name, False, f"no answer within 120 s; {remedy}"
    if result.returncode == 0:
        return name, True, result.stdout.strip().splitlines()[-1]
    return name, False, f"{(result.stderr.strip().splitlines() or ['crashed'])[-1]}; {remedy}"
