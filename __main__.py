# SPDX-License-Identifier: GPL-3.0-or-later
"""``python -m physgen``: the ``physgen`` command, where its script is not on the path."""

import sys

from .batch.cli import main

if __name__ == "__main__":
    sys.exit(main())
