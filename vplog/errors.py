"""The error tree. Every message says what happened, where, and what to do next; only cli.py prints and exits."""

from __future__ import annotations

import difflib
import errno
import os
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path


_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO, errno.EMFILE)


class VplogError(Exception):
    """A known failure that a user can act on: one line, no traceback."""


class LogError(VplogError):
    """A log cannot be read, or holds nothing usable."""


class SettingsError(VplogError):
    """A pipeline file, a setting or an option does not fit."""


class LibraryError(VplogError):
    """A reference library is missing, damaged, or made with other settings."""


class GraphError(VplogError):
    """A pose graph cannot be built or solved."""


class TruthError(VplogError):
    """Ground truth is missing, unreadable, or does not cover the drive."""


class ResultError(VplogError):
    """A run folder cannot be written or read back."""


class NewerError(ResultError):
    """A file was written by a newer vplog in a way that this one does not read."""


def was_interrupted(error: BaseException | None) -> bool:
    """Whether Ctrl-C is behind an error: compiled code and imports that it stops raise others in its place."""
    return any(isinstance(one, KeyboardInterrupt) for one in causes(error))


def causes(error: BaseException | None) -> Iterator[BaseException]:
    """An error and those behind it, which `raise ... from None` hides from a traceback alone."""
    visited: set[int] = set()
    while error is not None and id(error) not in visited:
        yield error
        visited.add(id(error))
        error = error.__cause__ or error.__context__


def is_of_disk(error: BaseException) -> bool:
    """Whether an error, or what is behind it, is a disk that is full, failing, or not to be written to: another attempt
    or machine may do."""
    return any(isinstance(one, OSError) and one.errno in _DISK for one in causes(error))


def plural(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def nearest(name: str, choices: Iterable[str], key: Callable[[str], str] = str, cutoff: float = 0.6) -> str:
    """` Did you mean X?`, X the choice whose spelling (by `key`) is nearest to a mistyped name; empty where none is.

    `cutoff` is difflib's least similarity, 0..1; its own default 0.6 lets two swapped letters of three pass.
    """
    spelled: dict[str, str] = {}
    for choice in choices:
        spelled.setdefault(key(choice).lower(), choice)
    typed = name.lower()
    found = difflib.get_close_matches(typed, spelled, cutoff=cutoff)
    if not found:
        return ""
    ratios = [difflib.SequenceMatcher(None, one, typed).ratio() for one in found]
    tied, first = found[: ratios.count(ratios[0])], typed.lstrip("-")[:1]  # letter, which is seldom the wrong one
    return f" Did you mean {spelled[max(tied, key=lambda one: one.lstrip('-')[:1] == first)]}?"


def nearest_path(path: Path) -> str:
    """` Did you mean PATH?`: the entry with the name nearest to the first missing part of a path, or empty."""
    if "://" in str(path) or os.path.exists(path):  # noqa: PTH110 (false for a name that is too long)
        return ""
    while not os.path.exists(path.parent):  # noqa: PTH110
        path = path.parent
    try:
        entries = sorted(map(str, path.parent.iterdir()))
    except OSError:
        return ""
    return nearest(path.name, entries, key=os.path.basename, cutoff=0.75)
