"""Folders of pictures as drives of a map: without odometry they can be found again, and no more than that."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog import logs
from vplog.data import Keyframes
from vplog.maps.import_places import write_places_run
from vplog.maps.search.query import describe_log
from vplog.results import tables
from vplog.run.odometry import gives_visual

if TYPE_CHECKING:
    from vplog.execution.execution import Execution
    from vplog.pipeline import Pipeline
    from vplog.stages import Log


def pictures_of(path: Path, topics: logs.TopicChoice) -> Log | None:
    """The log where it is a folder of images without odometry, or depth that gives one; None for any other."""
    log = logs.open(path, topics)
    if log.file_names() is None or log.odometry() is not None:
        return None
    return None if gives_visual(log) else log


def write_pictures(
    folder: Path, drive: str, log: Log, library: Path, pipeline: Pipeline, about: dict[str, Any], execution: Execution
) -> dict[str, Any]:
    """Describe every picture with the map's library, and write the run folder of the drive; its run.json, with `about`.

    Poses are not known: all are the identity, and the drive is joined with no other. Raises VplogError.
    """
    state = pipeline.places.load(library, execution)
    stamps, descriptors, warnings = describe_log(log, pipeline, state, execution)
    rows, names = np.searchsorted(log.stamps(), stamps).tolist(), log.file_names() or []
    account = {
        **about,
        "library": {"hash": state.hash, "from": str(library)},
        "names": [names[row] for row in rows],
        "warnings": [*log.warnings, *warnings],
    }
    header = tables.TableMetadata(pipeline.model_dump(mode="json"), state.hash)
    keyframes = Keyframes(drive, stamps, np.tile(np.eye(4), (len(stamps), 1, 1)))
    folder.mkdir(parents=True, exist_ok=True)
    return write_places_run(folder, keyframes, state.to_arrow(descriptors), header, account)
