# SPDX-License-Identifier: GPL-3.0-or-later
"""Which failures are worth another attempt."""

from __future__ import annotations

from ...sim.errors import InputError
from .task import Outcome

RETRIES = 2
"""How often a task is started again by default."""

WRONG_USAGE = 2
HOPELESS = (WRONG_USAGE, InputError.exit_code)
"""Exit codes that the same arguments and the same files give again."""


def is_worth_retrying(outcome: Outcome, *, attempts: int, retries: int = RETRIES) -> bool:
    """Whether a task that ended with ``outcome`` after ``attempts`` starts is started again.

    A task that was killed, or ended with a code that says neither wrong usage nor bad input, may work the next time:
    memory ran out, a driver crashed, a machine went away.
    """
    return outcome.state == "failed" and outcome.exit_code not in HOPELESS and attempts <= retries
