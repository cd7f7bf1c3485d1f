#!/bin/sh
# SPDX-License-Identifier: GPL-3.0-or-later
# pick_python.sh [VERSION]
# Prints the newest interpreter that a Blender LTS line has a bpy build for: 3.13 (Blender 5.2) or 3.11 (Blender 4.5).
# pyenv's shims exist for versions that are not selected, so each candidate is asked for its version.
for version in ${1:-3.13 3.11}; do
    for candidate in "python$version" python3 python "$HOME/.pyenv/versions/$version".*/bin/python3; do
        found=$("$candidate" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null) || continue
        [ "$found" = "$version" ] && { command -v "$candidate"; exit 0; }
    done
done
cat >&2 <<'EOF'
PhysGen needs Python 3.13 (for Blender 5.2 LTS) or Python 3.11 (for Blender 4.5 LTS); neither was found.
  Debian 13:  sudo apt-get install python3 python3-venv        Debian 12: the same (3.11)
  elsewhere:  uv python install 3.13   or   pyenv install 3.13
then run make again, or name one: make PYTHON=/path/to/python3.13
EOF
exit 1
