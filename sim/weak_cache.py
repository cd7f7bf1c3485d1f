# SPDX-License-Identifier: MIT
"""Results computed from an object, cached for the object's lifetime."""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

Owner = TypeVar("Owner")
Result = TypeVar("Result")


class WeakCache(Generic[Owner, Result]):
    """Cached results of a function of an immutable object and a key, dropped with the object.

    most: results cached per object; the oldest is dropped first.
    """

    def __init__(self, most: int = 4) -> None:
        self._most = most
        self._of: weakref.WeakKeyDictionary[Owner, dict[Hashable, Result]] = weakref.WeakKeyDictionary()

    def get(self, owner: Owner, key: Hashable, make: Callable[[], Result]) -> Result:
        """Return the result for ``owner`` and ``key``, computed by ``make`` on a miss. Exceptions are not cached."""
        results = self._of.setdefault(owner, {})
        if key not in results:
            made = make()
            while len(results) >= self._most:
                del results[next(iter(results))]
            results[key] = made
        return results[key]
