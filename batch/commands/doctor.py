# SPDX-License-Identifier: GPL-3.0-or-later
"""``physgen doctor``: check the installation."""

from __future__ import annotations

import importlib.metadata
import shutil
import subprocess
import sys
import tempfile

from ...sim.app.stage_process import NO_WINDOW, child_environment
from ...sim.gaussians.guidance.pretrained_models import INSTALL, PACKAGES, missing_packages, package_version
from ...sim.reconstruct.adapters.adapter_registry import VARIABLE, adapters_file, list_adapters, onnxruntime_version

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
            [sys.executable, "-c", code],
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
