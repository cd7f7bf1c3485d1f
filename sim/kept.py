# SPDX-License-Identifier: MIT
"""What was worked out of an object, kept as long as the object lives: a warm process never works it out twice."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Owner = TypeVar("Owner")
Result = TypeVar("Result")


class Kept(Generic[Owner, Result]):
    """Results of a function of an immutable object, by whatever else it depends on.

    most: how many results are kept of one object; the oldest goes first.
    """

    def __init__(self, most: int = 4) -> None:
        self._most = most
        self._of: weakref.WeakKeyDictionary[Owner, dict[Hashable, Result]] = weakref.WeakKeyDictionary()

    def get(self, owner: Owner, key: Hashable, make: Callable[[], Result]) -> Result:
        """The result for ``owner`` and ``key``; ``make`` works it out the first time. What it raises is not kept."""
        results = self._of.setdefault(owner, {})
        if key not in results:
            made = make()
            while len(results) >= self._most:
                del results[next(iter(results))]
            results[key] = made
        return results[key]
