"""Saving and loading of recognisers whose library is its references, learned again when loaded."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

from vplog.errors import LibraryError
from vplog.places import library_files
from vplog.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable
    from pathlib import Path

    from vplog.data import Reference
    from vplog.execution.execution import Execution


class RelearnedSettings(Settings):
    """Settings of a recogniser that is saved as its references."""

    def load(self, folder: Path, execution: Execution) -> Any:
        """A library saved by its state. Raises LibraryError where it is damaged or gives another hash."""
        return relearn(type(self), folder, execution)


class ReferencesState:
    """A state that follows from settings and references: its hash, and how it is saved."""

    settings: Any
    references: list[Reference]

    @property
    def hash(self) -> str:
        return self._hash

    @cached_property
    def _hash(self) -> str:
        return library_files.references_hash(self.references, self.settings)

    def save(self, folder: Path) -> None:
        library_files.save_references(self.references, self.settings, folder)


def keep_references(references: Iterable[Reference], features: int | None = None) -> list[Reference]:
    """The references, with their strongest features alone where a number is given. Raises LibraryError for none."""
    kept = [reference if features is None else library_files.strongest(reference, features) for reference in references]
    if not kept:
        raise LibraryError("A library needs at least one reference image; none was given.")
    return kept


def relearn(settings: Any, folder: Path, execution: Execution, learn: Callable[..., Any] | None = None) -> Any:
    """State of a folder written by `stored.save_references`, whose own settings count; `settings` is their class, and
    `learn` of its methods the one that makes the state.

    Raises LibraryError where the folder is damaged or gives another hash.
    """
    record = library_files.read_library_record(folder)
    made = settings.read(record["settings"], f"{folder}/library.json")
    state = (learn or settings.learn)(made, library_files.load_references(folder, execution), execution)
    if state.hash != record["hash"]:
        raise LibraryError(
            f"{folder}: the content does not have the hash in library.json; build it again with `vplog library`."
        )
    return state
