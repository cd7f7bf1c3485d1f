#!/bin/sh
# SPDX-License-Identifier: GPL-3.0-or-later
# venv.sh PYTHON VENV: a virtual environment with the project and everything it needs, made again when the
# interpreter or the requirements changed.
set -eu
venv=$2
# The interpreter may be that of the very environment that is made anew, where it is active: take what it stands on.
python=$("$1" -c 'import sys; print(getattr(sys, "_base_executable", sys.executable))')
# Exactly what was tested, by hash, where this interpreter and platform have a lock; LOCKED=0 takes the newest instead.
lock=$("$python" setup/lock.py --name)
[ "${LOCKED:-1}" = 1 ] && [ -f "$lock" ] || lock=
wanted="$("$python" -c 'import sys; print(sys.version)' | head -n 1) $(cat pyproject.toml ${lock:+"$lock"} | cksum)"
[ -f "$venv/.ready" ] && [ "$(cat "$venv/.ready")" = "$wanted" ] && exit 0
echo "setting up $venv with $("$python" --version) (downloads about 700 MB the first time)"
rm -rf "$venv"
"$python" -m venv "$venv" || {
    echo "Python's venv module is missing; on Debian and Ubuntu: sudo apt-get install python3-venv" >&2
    exit 1
}
if [ -n "$lock" ]; then
    "$venv/bin/pip" install -q --disable-pip-version-check --require-hashes --no-deps -r "$lock"
    "$venv/bin/pip" install -q --disable-pip-version-check --no-deps --no-build-isolation -e .
else
    "$venv/bin/pip" install -q --disable-pip-version-check -e '.[blender,dev]'
fi
"$venv/bin/python" -c 'import bpy' >/dev/null
printf '%s\n' "$wanted" >"$venv/.ready"
