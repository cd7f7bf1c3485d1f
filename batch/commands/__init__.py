# SPDX-License-Identifier: GPL-3.0-or-later
"""The verbs of ``physgen``: the flags of each, and what each runs.

photo_commands.py      from a photo to its video; render_commands.py frames and videos
scene_commands.py      scenes and bakes; simulation_flags.py the flags of both
compose_commands.py    ``compose``, ``fit-splats``
diagnosis_commands.py  from a recording to its cause
evaluation_commands.py  how real a video is
install_commands.py    ``doctor``, ``models``
flags.py               flags of objects and reconstruction
"""
