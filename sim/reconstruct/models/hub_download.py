# SPDX-License-Identifier: MIT
"""As a process of its own: ``hub_download.py REPOSITORY FOLDER FILE …`` fetches these files of a model, no others.

By ``huggingface_hub``, a part of what ``transformers`` installs; elsewhere in PhysGen it is told to stay offline.
"""

from __future__ import annotations

import importlib
import sys


def main(arguments: list[str]) -> int:
    """Fetch; the exit code."""
    repository, folder, *names = arguments
    hub = importlib.import_module("huggingface_hub")
    for name in names:
        hub.hf_hub_download(repository, name, local_dir=folder)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
