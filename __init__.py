# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry of the Blender extension; everything is delegated to ``physgen_addon``.

The same folder is the Python package ``physgen`` after ``pip install -e .``. Importing it costs nothing and needs
no Blender.
"""


def register() -> None:
    """Called by Blender when the extension is enabled."""
    from . import physgen_addon

    physgen_addon.register()


def unregister() -> None:
    """Called by Blender when the extension is disabled."""
    from . import physgen_addon

    physgen_addon.unregister()
