"""Reference libraries of a drive's own keyframes or of frames of several logs, and their coverage of a drive."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np

from vplog import logs
from vplog.data import Bytes, Ints, Keyframes, Reference
from vplog.errors import LibraryError, SettingsError
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import warn
from vplog.features.extraction import extract_frames
from vplog.geometry.masking import masked
from vplog.places.coverage import (
    STRONGEST,
    Coverage,
    choose_by_coverage,
    coverage_warning,
    frames_needed,
    measure_coverage,
)
from vplog.places.library import WordSettings
from vplog.places.library import build_library as index_words
from vplog.places.library_files import (
    check_descriptors,
    load_references,
    name_extractor,
    read_library_record,
    read_sources,
)
from vplog.places.plugin import PluginSettings
from vplog.places.reference_choice import FRAMES_A_REFERENCE, PAPER_SIZE, LibrarySettings, choose, evenly
from vplog.places.self_recognition import MOST, NO_IMAGE, add_until_enough, further, lacking
from vplog.results.staging import check_contents, recover, staged
from vplog.run.cache.codecs import images_codec, json_codec
from vplog.run.cache.steps import step
from vplog.storage.folders import check_regular

if TYPE_CHECKING:
    from vplog.features.extractors import FeatureSettings
    from vplog.places import PlaceSettings
    from vplog.run.cache.feature_shards import Extracted
    from vplog.stages import Log, PlaceState


class Describing(Protocol):
    """The settings that a library is made with, as the pipeline has them."""

    @property
    def features(self) -> FeatureSettings: ...
    @property
    def library(self) -> LibrarySettings: ...
    @property
    def places(self) -> PlaceSettings: ...


def check_library(folder: Path | None, pipeline: Describing) -> None:
    """Before any work: is what was given a library, and made as this run describes places? Raises LibraryError."""
    if folder is None:
        return
    recover(folder)
    places = pipeline.places.recogniser() if isinstance(pipeline.places, PluginSettings) else pipeline.places
    record = read_library_record(folder)
    made = places.read(record["settings"], f"{folder}/library.json")
    for name, value in places:
        left_open = value is None or name in made.LOCATIONS  # None leaves it to the library
        if not left_open and getattr(made, name) != value:
            raise LibraryError(
                f"{folder} was made with places.{name}={getattr(made, name)}, and this run has {value}. "
                f"Build another with `vplog library`, or run with --set places.{name}={getattr(made, name)}."
            )
    check_extractor(folder, pipeline.features)


def check_extractor(folder: Path, features: FeatureSettings) -> None:
    """Raises LibraryError where the library's local features are none that compare with these."""
    own, extractor = features.identity(), read_library_record(folder).get("extractor")
    if not isinstance(extractor, dict):  # of an earlier version
        references = load_references(folder)
        check_descriptors(references, features(references[0].image))
        return
    for name in ("kind", "sha256"):  # other settings find more or fewer features, which compare
        if extractor.get(name) != own.get(name):
            raise LibraryError(
                f"{folder} was made with features.{name}={extractor.get(name)}, and this run has {own.get(name)}: "
                "descriptors do not compare. Build another with `vplog library`, or run with its settings of features."
            )


@step("choose", lambda *_: images_codec(), without=("log",))  # the features stand for the log's images
def own_images(
    log: Log, keyframes: Keyframes, features: Extracted, settings: LibrarySettings, *, execution: Execution
) -> list[tuple[int, Bytes]]:
    """Rows and images of the keyframes that become the drive's own references; these images are read once more."""
    if settings.choose == "coverage":
        rows = choose_by_coverage(len(features), lambda row: features[row].descriptors, settings, execution)
    else:
        most = len(keyframes.stamp_ns) // FRAMES_A_REFERENCE

        def reference(row: int) -> Reference:
            return own_references(keyframes, features, [(row, NO_IMAGE)])[0]

        rows = choose(keyframes.stamp_ns, settings)
        if settings.size is None:
            rows = add_until_enough(rows, keyframes.stamp_ns, settings, most, reference, execution)
    frames = log.frames(keyframes.stamp_ns[rows])
    return [(row, masked(encoded.decode()).image) for row, encoded in zip(rows.tolist(), frames, strict=True)]


def own_references(keyframes: Keyframes, features: Extracted, images: Sequence[tuple[int, Bytes]]) -> list[Reference]:
    """References of a drive's own keyframes, by row and image."""
    stamps = keyframes.stamp_ns.tolist()
    return [Reference(image, features[row], keyframes.drive, stamps[row]) for row, image in images]


@step("choose")
def given_references(library: Path, *, execution: Execution) -> list[Reference]:
    """The references of a library in a folder. Raises LibraryError."""
    return load_references(library, execution)


@step("learn", items=lambda places, references, library: len(references))
def learn(
    places: PlaceSettings, references: list[Reference], library: Path | None, *, execution: Execution
) -> PlaceState:
    """The recogniser with its library: the folder given, or one of these references."""
    if library is not None:
        return places.load(library, execution)
    return places.learn(references, execution)


@step("cover", lambda *_: json_codec(lambda tree: Coverage(**tree), asdict))
def cover(
    keyframes: Keyframes, references: list[Reference], given: bool, features: Extracted, *, execution: Execution
) -> Coverage:
    """Coverage of the drive by the references, with a warning where it is low; over no frames where the library has no
    features (`places.features: 0`)."""
    check_descriptors(references, features[0])
    if not any(len(one.features) for one in references):
        return Coverage(0.0, 0.0, 0)
    library = index_words(references, WordSettings(), execution, own=False)
    coverage = measure_coverage(keyframes, features.__getitem__, library, execution)
    if doubt := coverage_warning(coverage, len(features), given, len(library)):
        warn(doubt)
    return coverage


def build_library(
    paths: Sequence[Path],
    out: Path,
    pipeline: Describing,
    topics: logs.TopicChoice | None = None,
    execution: Execution = Execution(),
    *,
    force: bool = True,
) -> PlaceState:
    """`library_of_logs` of the logs at these paths, opened with the same topics."""
    return library_of_logs([logs.open(path, topics) for path in paths], out, pipeline, execution, force=force)


def library_of_logs(
    opened: Sequence[Log],
    out: Path,
    pipeline: Describing,
    execution: Execution = Execution(),
    *,
    force: bool = True,
) -> PlaceState:
    """A library of frames of the logs: an equal share of each, or by coverage those that explain the frames of all.

    The warnings of the logs are passed to `warn`. A library that `out` holds stays until the new one is whole;
    without `force` one with references of other logs is not replaced.
    Raises VplogError where that cannot be.
    """
    settings = pipeline.library
    with staged(out, lambda: _library_in(out, None if force else opened)) as made:
        by_coverage = settings.choose == "coverage"
        stamps = _stamps_by_coverage(opened, pipeline, execution) if by_coverage else _shares(opened, pipeline)
        references = _extracted(opened, stamps, pipeline, execution)
        if not by_coverage and settings.size is None:
            _add_until_enough(references, opened, stamps, pipeline, execution)
        for line in dict.fromkeys(line for log in opened for line in log.warnings):
            warn(line)
        state = pipeline.places.learn(references, execution)
        state.save(made)
        name_extractor(made, pipeline.features.identity())
    return state


def _library_in(out: Path, opened: Sequence[Log] | None) -> list[str]:
    """The files of a library in a folder that a new one may replace: one of these logs, or any. Raises SettingsError
    where it may not."""
    names = ["library.json", "features.parquet", "references.parquet"]
    if out.absolute().name == "library" and (out.absolute().parent / "run.json").is_file():
        raise SettingsError(f"{out} is the library of the run in {out.absolute().parent}. Choose another with -o.")
    check_regular(out, "library.json")
    check_contents(out, "a library", all((out / name).is_file() for name in names))
    if opened is not None and (out / "library.json").is_file():
        _check_same_logs(out, opened)
    return names


def _check_same_logs(out: Path, opened: Sequence[Log]) -> None:
    """Raises SettingsError where a library has a reference that is a frame of none of these logs, by name and stamp."""
    remedy = "Choose another folder with -o, or replace that library with --force."
    try:
        sources = read_sources(out)
    except LibraryError as error:
        raise SettingsError(f"{error} So its logs are not known. {remedy}") from None
    others = sources - {(log.name, stamp) for log in opened for stamp in log.stamps().tolist()}
    if others:
        names, given = (", ".join(sorted(one)) for one in ({name for name, _ in others}, {log.name for log in opened}))
        raise SettingsError(f"{out} is a library of {names}, and {given} is another log or has changed. {remedy}")


def _extracted(
    opened: Sequence[Log], stamps_ns: Sequence[Ints], pipeline: Describing, execution: Execution
) -> list[Reference]:
    """References of the frames of each log with these stamps, without those that do not decode."""
    references = []
    for log, stamps in zip(opened, stamps_ns, strict=True):
        frames = extract_frames(log.frames(stamps), pipeline.features, execution)
        for stamp_ns, frame, features, _ in execution.counted(f"extract {log.name}", frames, len(stamps)):
            if frame is not None and features is not None:
                references.append(Reference(masked(frame).image, features, log.name, stamp_ns))
    return references


def _add_until_enough(
    references: list[Reference], opened: Sequence[Log], first: Sequence[Ints], pipeline: Describing,
    execution: Execution,
) -> None:  # fmt: skip
    """Add as many frames again to those with the `first` stamps of each log whose references are recognised too seldom,
    as long as there are such logs."""
    stamps = [log.stamps() for log in opened]
    rows = [np.flatnonzero(np.isin(one, chosen)) for one, chosen in zip(stamps, first, strict=True)]
    most = min(sum(map(len, stamps)) // FRAMES_A_REFERENCE, MOST)
    while (total := sum(map(len, rows))) < most and (drives := lacking(references, execution)):
        old_of = [len(old) if log.name in drives else 0 for log, old in zip(opened, rows, strict=True)]
        share = min(1.0, (most - total) / max(sum(old_of), 1))
        added = [
            further(one, old, pipeline.library, min(round(share * count), len(one) - len(old)))
            for one, old, count in zip(stamps, rows, old_of, strict=True)
        ]
        if not any(map(len, added)):
            break
        wanted = [one[new] for one, new in zip(stamps, added, strict=True)]
        references += _extracted(opened, wanted, pipeline, execution)
        rows = [np.union1d(old, new) for old, new in zip(rows, added, strict=True)]


def _shares(opened: Sequence[Log], pipeline: Describing) -> list[Ints]:
    """Stamps of an equal share of references for each log."""
    size, result = pipeline.library.size or PAPER_SIZE, []
    for number, log in enumerate(opened):
        share = size * (number + 1) // len(opened) - size * number // len(opened)
        seeded = pipeline.library.model_copy(update={"size": share, "seed": pipeline.library.seed + number})
        result.append(log.stamps()[choose(log.stamps(), seeded)])
    return result


def _stamps_by_coverage(opened: Sequence[Log], pipeline: Describing, execution: Execution) -> list[Ints]:
    """Stamps of the references of each log that explain the frames of all best; equally many of each are compared."""
    each = -(-frames_needed(pipeline.library.size) // len(opened))
    descriptors, owners, stamps_ns = [], [], []
    for number, log in enumerate(opened):
        stamps = log.stamps()[evenly(len(log.stamps()), each)]
        frames = extract_frames(log.frames(stamps), pipeline.features, execution)
        for stamp_ns, _, features, _ in execution.counted(f"compare frames of {log.name}", frames, len(stamps)):
            if features is not None:
                descriptors.append(features.descriptors[:STRONGEST].copy())
                owners.append(number)
                stamps_ns.append(stamp_ns)
    rows = choose_by_coverage(len(descriptors), descriptors.__getitem__, pipeline.library, execution)
    owner, stamp = np.array(owners, np.int64)[rows], np.array(stamps_ns, np.int64)[rows]
    return [stamp[owner == number] for number in range(len(opened))]
