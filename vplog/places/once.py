"""A value that takes long to make and is not always needed."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Generic, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable

Value = TypeVar("Value")


class Once(Generic[Value]):
    """Made when it is first asked for, by whichever thread; the others wait for it."""

    def __init__(self, make: Callable[[], Value]) -> None:
        self._make, self._made, self._lock = make, list[Value](), threading.Lock()

    def __call__(self) -> Value:
        if not self._made:
            with self._lock:
                if not self._made:
                    self._made.append(self._make())
        return self._made[0]
