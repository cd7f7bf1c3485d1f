#!/bin/sh
# SPDX-License-Identifier: GPL-3.0-or-later
# The shared libraries that `import bpy` loads even without a display. Installed when root, otherwise named.
# EGL, with which EEVEE draws without a display, likewise, but nothing fails for want of it.
set -eu
[ "$(uname -s)" = Linux ] || exit 0
missing=""
present=$({ ldconfig -p || /sbin/ldconfig -p; } 2>/dev/null)
for pair in libX11.so.6:libx11-6 libXrender.so.1:libxrender1 libXfixes.so.3:libxfixes3 libXi.so.6:libxi6 \
    libxkbcommon.so.0:libxkbcommon0 libSM.so.6:libsm6 libICE.so.6:libice6 libGL.so.1:libgl1 libXext.so.6:libxext6; do
    case "$present" in *"${pair%%:*}"*) ;; *) missing="$missing ${pair##*:}" ;; esac
done
optional=""
case "$present" in *libEGL.so.1*) ;; *) optional=" libegl1 libgl1-mesa-dri" ;; esac

install() {
    export DEBIAN_FRONTEND=noninteractive
    apt-get install -y -q --no-install-recommends "$@" >/dev/null 2>&1 ||
        { apt-get update -q >/dev/null && apt-get install -y -q --no-install-recommends "$@" >/dev/null; }
}

if [ -n "$missing" ]; then
    if ! command -v apt-get >/dev/null; then
        echo "Blender's Python module needs these libraries (Debian's names):$missing" >&2
        echo "Install them with your system's package manager, then run make again." >&2
        exit 1
    fi
    if [ "$(id -u)" -ne 0 ]; then
        echo "Blender's Python module needs system libraries that are missing here. Run this, then make again:" >&2
        echo "  sudo apt-get install$missing$optional" >&2
        exit 1
    fi
    echo "installing system libraries:$missing"
    # shellcheck disable=SC2086  # a list of package names
    install $missing
fi
[ -n "$optional" ] || exit 0
if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null; then
    echo "installing system libraries for EEVEE:$optional"
    # shellcheck disable=SC2086  # a list of package names
    install $optional && exit 0
fi
echo "Rendering with EEVEE also needs these libraries (Debian's names), Cycles does not:$optional" >&2
