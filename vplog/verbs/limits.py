"""Limits of figures, as `--fail-on` takes them: a figure, < <= > or >=, and a number."""

from __future__ import annotations

import operator
import re
from collections.abc import Sequence
from typing import NamedTuple

from vplog.errors import SettingsError, nearest

_LIMIT = re.compile(r"([a-z_]+)([<>]=?)([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d{1,2})?)(%?)")
_FAILS = {"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge}


class Limit(NamedTuple):
    """One limit."""

    text: str
    name: str
    sign: str
    bound: float
    percent: str
    """`%` where the bound is a percentage, else empty."""

    def fails(self, value: float) -> bool:
        return _FAILS[self.sign](value, self.bound)


def read_limits(limits: Sequence[str], names: Sequence[str], of: str, percent: bool = False) -> list[Limit]:
    """The limits of figures with these names, or of their changes in percent. Raises SettingsError for the first that
    is none; `of` says what a limit is and gives examples."""
    found = []
    for text in limits:
        match = _LIMIT.fullmatch(text.replace(" ", ""))
        if match is None or match[1] not in names or (match[4] and not percent):
            near = "" if match is None else nearest(match[1], names)
            raise SettingsError(f"--fail-on {text!r} is no {of}. Figures: {', '.join(names)}.{near}")
        found.append(Limit(text, match[1], match[2], float(match[3]), match[4]))
    return found
