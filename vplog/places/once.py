"""A value made on first use."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

Value = TypeVar("Value")


class Once(Generic[Value]):
    """A value made by the first call, from whichever thread; the others wait for it."""

    def __init__(self, make: Callable[[], Value]) -> None:
        self._make, self._made, self._lock = make, list[Value](), threading.Lock()

    def __call__(self) -> Value:
        if not self._made:
            with self._lock:
                if not self._made:
                    self._made.append(self._make())
        return self._made[0]
