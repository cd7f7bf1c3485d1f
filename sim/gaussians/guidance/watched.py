# SPDX-License-Identifier: MIT
"""A guidance whose bad answers do no harm: what is not finite is left out, and too much of it ends the run in words."""

from __future__ import annotations

import numpy as np

from ...errors import InputError, PhysGenError, SimulationError
from .protocol import Array, Guidance, Seen

BAD_IN_A_ROW = 5
"""Steps in a row without an answer after which an optimisation is not worth its time."""
MOST_NOTES = 20


class Watched:
    """A guidance of the same protocol around ``guidance``; one for each optimisation, because it counts.

    An answer with numbers that are not finite becomes a zero gradient and a line in ``notes``, which name the step's
    timestep and subject. The ``most``-th of them in a row raises SimulationError: the optimiser still has the state
    from before it. An answer of a wrong shape, and whatever its code raises, is an error at once that names the
    guidance.
    """

    def __init__(self, guidance: Guidance, *, name: str = "", most: int = BAD_IN_A_ROW) -> None:
        """name: what messages call it; by default its own attribute ``name``, else its class."""
        if most < 1:
            raise InputError(f"most is {most!r}: give how many bad answers in a row end a run, 1 or more")
        self._guidance = guidance
        self._most = most
        self.name = name or str(getattr(guidance, "name", "")) or type(guidance).__name__
        self.asked = 0
        """Gradients asked for so far."""
        self.bad = 0
        """Of those, how many were not finite."""
        self.bad_in_a_row = 0
        self.notes: list[str] = []
        """What a user should know, at most ``MOST_NOTES`` lines; ``bad`` counts on."""

    def gradient(self, seen: Seen, timestep: int, random: np.random.Generator) -> Array:
        """(H, W, 3) as ``Guidance`` says, always finite. Raises InputError and SimulationError."""
        self.asked += 1
        answer = checked_gradient(self._guidance, seen, timestep, random, name=self.name)
        if answer is not None:
            self.bad_in_a_row = 0
            return answer
        self.bad += 1
        self.bad_in_a_row += 1
        if self.bad_in_a_row >= self._most:
            raise SimulationError(
                f"guidance {self.name}: {self.bad_in_a_row} gradients in a row were not finite ({self.bad} of "
                f"{self.asked} in all), last at timestep {timestep} of {seen.subject!r}; what was reached before is "
                "kept. Use it in 32 bits, with a lower guidance scale, or another guidance"
            )
        if len(self.notes) < MOST_NOTES:
            self.notes.append(
                f"guidance {self.name}: its gradient at timestep {timestep} of {seen.subject!r} was not finite; this "
                "step goes without it"
            )
        return np.zeros(seen.picture.shape)


def checked_gradient(
    guidance: Guidance, seen: Seen, timestep: int, random: np.random.Generator, *, name: str
) -> Array | None:
    """What ``guidance`` answers, (H, W, 3); None where it is not finite.

    Raises InputError on another shape or what is no number, SimulationError with its words where its code fails.
    """
    try:
        answer = np.asarray(guidance.gradient(seen, timestep, random))
    except PhysGenError:
        raise
    # It may be anybody's code: whatever it raises is told with its name.
    except Exception as error:
        raise SimulationError(f"guidance {name}: failed ({type(error).__name__}: {str(error)[:300]})") from error
    if answer.shape != seen.picture.shape or answer.dtype.kind != "f":
        raise InputError(
            f"guidance {name}: gave {answer.shape} {answer.dtype}, expected floats {seen.picture.shape}, a gradient "
            "for each number of the picture"
        )
    return answer.astype(np.float64) if np.isfinite(answer).all() else None
