# SPDX-License-Identifier: GPL-3.0-or-later
"""Entry points without a user interface: the ``physgen`` command, and scripts for Blender in background mode.

cli.py                 the command, whose verbs are in ``commands``; early_stop.py its first steps, terminal.py what it
                       says
stages.py              stages as processes of their own, and all of them in a row
demo.py                ``make demo``
bake.py, diagnose.py, reconstruct.py
                       stages that Python or Blender start; headless.py what they share
render.py, encode.py, export.py
                       stages that need Blender; blender_script.py what they share
"""
