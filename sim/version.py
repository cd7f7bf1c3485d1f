# SPDX-License-Identifier: MIT
"""The program's version; ``pyproject.toml`` and ``blender_manifest.toml`` hold the same, which a test checks."""

VERSION = "0.1.0"
