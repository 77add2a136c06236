"""The library that all drives of a map are described with."""

from __future__ import annotations

import shutil
from typing import TYPE_CHECKING

from vplog import logs
from vplog.errors import LibraryError, VplogError
from vplog.libraries import build_library, check_library
from vplog.maps import store as map_store
from vplog.places.stored import read_library_record
from vplog.references import PAPER_SIZE

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from vplog.logs import TopicChoice
    from vplog.maps.store import Store
    from vplog.pipeline import Pipeline

    Progress = Callable[[str, int, int], None]


def map_library(
    store: Store, paths: Sequence[Path], given: Path | None, pipeline: Pipeline, topics: TopicChoice, threads: int,
    progress: Progress,
) -> str:  # fmt: skip
    """The hash of the map's library, which is put into the map where it has none yet.

    Raises LibraryError where another one is given, or where the settings describe places otherwise.
    """
    settings = pipeline.model_dump(mode="json")
    if not (store.root / "map.json").exists():
        store.write_head(map_store.Head(None, settings))
    known = store.head().library
    if known is not None and not store.library(known).is_dir():
        raise LibraryError(f"{store} has lost its library {known[:12]}. Make the map anew in another folder.")
    made = store.staging / "library"
    if given is not None:
        check_library(given, pipeline)
        digest = str(read_library_record(given)["hash"])
        if known not in (None, digest):
            raise LibraryError(
                f"{given} has hash {digest[:12]}, and the places of {store} are described with library "
                f"{known[:12]}: they would not compare. Leave --library out, or make another map."
            )
        if known is None:
            digest = pipeline.places.load(given, threads).hash  # held against what it says of itself
            shutil.copytree(given, made)
    elif known is None:
        digest = build_library(_that_can_be_read(paths, topics), made, pipeline, topics, threads, progress).hash
    else:
        check_library(store.library(known), pipeline)
        digest = known
    if known is None:
        map_store.add_library(store, made, digest)
    return digest


def _that_can_be_read(paths: Sequence[Path], topics: TopicChoice) -> list[Path]:
    """The first logs, as many as a library has references, without those that tell no frames: their own run says why.

    Raises LogError of the first where none has any.
    """
    sound, first = [], None
    for path in paths:
        try:
            if len(logs.open(path, topics).stamps()):
                sound.append(path)
        except VplogError as error:
            first = first or error
        if len(sound) == PAPER_SIZE:
            break
    if not sound:
        raise first or LibraryError("None of the logs has a frame, so there is nothing to build a library from.")
    return sound
