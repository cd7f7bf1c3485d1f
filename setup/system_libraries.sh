#!/bin/sh
# The shared libraries that `import bpy` loads even without a display. Installed when root, otherwise named.
set -eu
[ "$(uname -s)" = Linux ] || exit 0
missing=""
present=$({ ldconfig -p || /sbin/ldconfig -p; } 2>/dev/null)
for pair in libX11.so.6:libx11-6 libXrender.so.1:libxrender1 libXfixes.so.3:libxfixes3 libXi.so.6:libxi6 \
    libxkbcommon.so.0:libxkbcommon0 libSM.so.6:libsm6 libICE.so.6:libice6 libGL.so.1:libgl1 libXext.so.6:libxext6; do
    case "$present" in *"${pair%%:*}"*) ;; *) missing="$missing ${pair##*:}" ;; esac
done
[ -n "$missing" ] || exit 0
if ! command -v apt-get >/dev/null; then
    echo "Blender's Python module needs these libraries (Debian's names):$missing" >&2
    echo "Install them with your system's package manager, then run make again." >&2
    exit 1
fi
if [ "$(id -u)" -ne 0 ]; then
    echo "Blender's Python module needs system libraries that are missing here. Run this, then make again:" >&2
    echo "  sudo apt-get install$missing" >&2
    exit 1
fi
echo "installing system libraries:$missing"
export DEBIAN_FRONTEND=noninteractive
# shellcheck disable=SC2086  # a list of package names
apt-get install -y -q --no-install-recommends $missing >/dev/null 2>&1 ||
    { apt-get update -q >/dev/null && apt-get install -y -q --no-install-recommends $missing >/dev/null; }
