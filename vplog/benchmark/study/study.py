"""The whole study: drives opened, experiments chosen, each written when it is done and not done twice."""

from __future__ import annotations

import itertools
import re
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from glob import escape
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from vplog import logs
from vplog.benchmark.compare import check_truth, every_image, protocol, same_drive
from vplog.benchmark.feature_cache import FeatureFolder
from vplog.benchmark.recogniser_specs import read_methods
from vplog.benchmark.study.evaluation_store import Bench
from vplog.benchmark.study.example_figures import PICTURES
from vplog.benchmark.study.experiments import KINDS_OF_BOXES, NUMBERS, StudyOptions, fitting_sizes
from vplog.benchmark.study.score_charts import CHARTS
from vplog.benchmark.traversals import candidate_stops
from vplog.errors import ResultError, SettingsError, TruthError, nearest
from vplog.evaluate.place_truth import PlaceTruth, TruthChoice, open_truth
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import collect_warnings
from vplog.pipeline import Pipeline
from vplog.places.vectors import VectorsSettings, vectors_files
from vplog.results.run_record import is_ours, read_run_json, write_run_json
from vplog.results.staging import check_contents, staged
from vplog.run.cache.code_hash import code_of
from vplog.run.feature_extraction import image_topics
from vplog.storage.folders import check_regular
from vplog.storage.input_hashes import hash_inputs
from vplog.storage.json_records import key_of, plain
from vplog.storage.urls import shown
from vplog.version import __version__

EXPERIMENTS = (*NUMBERS, *PICTURES)
"""All of them, in the order they are done."""
_WORK = ".study"
"""Folder in OUT of the experiments that an interrupted study finished: the next one with the same inputs takes them."""
_TWO_DRIVES = {
    "library": "which drive the library comes from",
    "conditions": "a change of condition between drives",
}
"""Subject of the experiments that need two drives."""
_OF_BOXES = ("sizes", "library", *PICTURES)
"""Experiments that need a method that makes boxes."""
_SCORES = ("vplog.benchmark.study.evaluation_store", "vplog.benchmark.recogniser_specs")
"""Modules that the scores of an evaluation depend on, with all that these import."""


def study(
    drives: Sequence[Path],
    truth: TruthChoice,
    pipeline: Pipeline,
    out: Path,
    options: StudyOptions = StudyOptions(),
    execution: Execution = Execution(),
) -> dict[str, Any]:
    """Experiments on drives of one route, each query and map in turn; the content of study.json.

    Raises VplogError with one line where that cannot be.
    """
    min_gap, topics = options.min_gap, options.topics
    if truth.is_labels:
        topics = every_image(topics)
    recognisers = read_methods(options.methods, pipeline)
    chosen = _choose(options.only, len(drives), any(one.kind in KINDS_OF_BOXES for one in recognisers.values()))
    _check_drives(drives, min_gap)
    with staged(out, lambda: _figures_in(out)) as made, ExitStack() as stack:
        warnings = stack.enter_context(collect_warnings())
        opened = [logs.open(path, topics) for path in drives]
        scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(dir=made)))
        names = short_names([log.name for log in opened])
        known, protocols = {}, []
        for other, query in [(0, 0)] if len(drives) == 1 else itertools.permutations(range(len(drives)), 2):
            of_pair = truth_of_pair(truth, query, other, len(drives))
            known[query, other] = open_truth(of_pair, opened[query], opened[other])
            warnings += check_truth(known[query, other], opened[query], opened[other], min_gap)
            protocols.append(_protocol(known[query, other], (names[query], names[other]), min_gap))
        hashes = [key_of(hash_inputs(path)) for path in drives]
        _check_same_drives(out, hashes)
        common = {
            "features": pipeline.features.model_dump(mode="json"),
            "topics": None if topics is None else topics.model_dump(mode="json"),
            "images": [None if topics is None else image_topics(topics, log.camera().name) for log in opened],
            "min_gap": min_gap,
            "truth_hash": _truth_hash(truth),
            "vectors": [
                [hash_inputs(file) for file in vectors_files(one.file)]
                for one in recognisers.values()
                if isinstance(one, VectorsSettings)
            ],
        }
        cached = stack.enter_context(options.cache.opened(scratch))
        folders = [
            FeatureFolder.of(*cached, path, topics, log, pipeline.features)
            for path, log in zip(drives, opened, strict=True)
        ]
        scoring = code_of(*_SCORES, *{type(one).__module__ for one in recognisers.values()})  # also of plug-ins
        bench = Bench(
            names, opened, hashes, recognisers, known, _covered(known, opened), pipeline, min_gap,
            {**common, "code": scoring}, out / "trials.json", scratch, folders, execution,
        )  # fmt: skip
        account = {
            "vplog": __version__,
            "drives": [
                {"name": name, "log": str(path), "frames": len(log.stamps()), "hash": digest}
                for name, path, log, digest in zip(names, drives, opened, hashes, strict=True)
            ],
            "truth": _shown(truth),
            "protocol": protocols,
            **common,
            "library_size": options.library_size,
            "sizes": sorted(set(options.sizes)),
            "seeds": options.seeds,
            "methods": {name: settings.model_dump(mode="json") for name, settings in recognisers.items()},
        }
        if "sizes" in chosen:
            fitting_sizes(bench, options)  # before the long part
        inputs = key_of({**account, "pipeline": pipeline.model_dump(mode="json"), "code": [code_of(__name__), scoring]})
        work = out / _WORK
        done, files = {}, dict[str, Path]()
        for folder in (out, work):
            for name, one in _finished(folder, inputs).items():
                done[name] = one
                files |= {file: folder / file for file in one["figures"]}
        work.mkdir(exist_ok=True)
        for name in chosen:
            if name not in done:
                done[name] = _do(name, bench, options, work)
                files |= {file: work / file for file in done[name]["figures"]}
                _write(work, account, inputs, done, [])
        for file, path in files.items():
            shutil.copy2(path, made / file)
        notes = [warning for log in opened for warning in log.warnings] + warnings
        notes += [warning for one in done.values() for warning in one.get("warnings", ())]
        result = _write(made, account, inputs, done, list(dict.fromkeys(notes)))
    shutil.rmtree(out / _WORK, ignore_errors=True)
    return result


def _protocol(known: PlaceTruth, names: tuple[str, str], min_gap: int | None) -> dict[str, Any]:
    """The rule by which a match is true in one pair of drives, as `compare.protocol` has it."""
    stops = candidate_stops(known.query_frames, known.map_frames, min_gap)
    found = protocol(known, known.pairs(known.query_frames, known.map_frames).below(stops), min_gap)
    return {"query": names[0], "map": names[1], **found, "text": f"{names[0]} in {names[1]}: {found['text']}"}


def _do(name: str, bench: Bench, options: StudyOptions, out: Path) -> dict[str, Any]:
    began = time.perf_counter()
    if name in NUMBERS:
        found = NUMBERS[name](bench, options)
        CHARTS[name](found, out)
        figures = [name]
    else:
        found, figures = PICTURES[name](bench, options, out)
    files = [f"{figure}.{kind}" for figure in figures for kind in ("png", "svg")]
    warnings = list(bench.warnings)
    return {"figures": files, **found, "warnings": warnings, "seconds": round(time.perf_counter() - began, 3)}


def _write(
    out: Path, account: dict[str, Any], inputs: str, done: dict[str, Any], warnings: list[str]
) -> dict[str, Any]:
    ordered = {name: done[name] for name in EXPERIMENTS if name in done}
    result = plain({**account, "inputs": inputs, "experiments": ordered, "warnings": warnings})
    write_run_json(out / "study.json", result)
    return result


def _finished(folder: Path, inputs: str) -> dict[str, Any]:
    """Experiments that study.json of a folder holds of the same inputs, with all their figures there."""
    found = _read(folder)
    return {
        name: one
        for name, one in _experiments(found)
        if found.get("inputs") == inputs and all((folder / file).is_file() for file in one["figures"])
    }


def _figures_in(out: Path) -> list[str]:
    """Results of an earlier study in `out`, which a new one replaces. Raises SettingsError where it holds other
    things."""
    check_contents(out, "a study", any(is_ours(out / name) for name in ("study.json", "trials.json")))
    check_regular(out)
    return [escape(file) for _, one in _experiments(_read(out)) for file in one["figures"]]


def _read(folder: Path) -> dict[str, Any]:
    """study.json of a folder; empty where it has none that is sound."""
    try:
        return read_run_json(folder / "study.json")
    except ResultError:
        return {}


def _experiments(found: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """The experiments of a study.json whose figures are named as files of a study, by name."""
    earlier = found.get("experiments")
    for name, one in earlier.items() if isinstance(earlier, dict) else ():
        figures = one.get("figures") if isinstance(one, dict) else None
        if name in EXPERIMENTS and isinstance(figures, list) and all(map(_is_figure, figures)):
            yield name, one


def _is_figure(file: Any) -> bool:
    return isinstance(file, str) and PurePath(file).name == file and file.endswith((".png", ".svg"))


def _choose(only: Sequence[str] | None, drives: int, boxes: bool) -> list[str]:
    """Names of the experiments to do, where some method makes `boxes` or none. Raises SettingsError for one that is
    none, or that needs more drives or boxes."""
    missing = {} if boxes else dict.fromkeys(_OF_BOXES, f"boxes; add {' or '.join(KINDS_OF_BOXES)} to --methods")
    missing |= {name: f"{what}; give two drives or more" for name, what in _TWO_DRIVES.items() if drives < 2}
    for name in only or ():
        if name not in EXPERIMENTS:
            known = f"Experiments: {', '.join(EXPERIMENTS)}."
            raise SettingsError(f"--only {name}: there is no such experiment.{nearest(name, EXPERIMENTS)} {known}")
        if name in missing:
            raise SettingsError(f"--only {name} is about {missing[name]}.")
    return [name for name in EXPERIMENTS if name not in missing and (only is None or name in only)]


def _check_drives(drives: Sequence[Path], min_gap: int | None) -> None:
    for number, path in enumerate(drives):
        if any(same_drive(path, other) for other in drives[:number]):
            raise SettingsError(f"{path} is given twice. Give each drive once; it is query and map in turn.")
    if len(drives) == 1 and min_gap is None:
        raise SettingsError(
            f"{drives[0]} is the only drive, so its frames are matched with older ones. Say how many frames older: "
            "--min-gap 50. Or give more drives of the same route."
        )
    if len(drives) > 1 and min_gap is not None:
        raise SettingsError("--min-gap is for one drive, matched with its own past; leave it out, or give one drive.")


def _check_same_drives(out: Path, hashes: Sequence[str]) -> None:
    """Raises SettingsError where `out` holds the study of a drive that is not among these, by content."""
    earlier = _read(out).get("drives")
    if earlier is None and (out / "study.json").is_file():
        raise SettingsError(f"{out}/study.json is damaged, so its drives are not known. Choose another folder with -o.")
    for drive in earlier if isinstance(earlier, list) else ():
        if isinstance(drive, dict) and drive.get("hash") not in hashes:
            raise SettingsError(f"{out} holds a study of {drive.get('log')}. Choose another folder with -o.")


def truth_of_pair(truth: TruthChoice, query: int, other: int, drives: int) -> TruthChoice:
    """The choice for one pair: of a list of files, one for each drive, those of its two; of a table of pairs, which
    names one query and one map, that of the first drive in the second, or the same turned round.

    Raises TruthError where the list has another length, or a table of pairs would serve more than two drives.
    """
    if drives > 1 and truth.lists_pairs:
        if drives > 2:
            raise TruthError(
                f"--truth {shown(truth.source)} lists the pairs of one query and one map; here are {drives} drives. "
                "Use index, labels, utm, poses, gps, a table `image,label` or a TUM file for each drive."
            )
        return replace(truth, transposed=(query, other) == (1, 0))
    files = truth.source.split(",")
    if len(files) == 1 or Path(truth.source).is_file():
        return truth
    if len(files) != drives:
        raise TruthError(f"--truth has {len(files)} files for {drives} drives. Give one for all, or one for each.")
    return replace(truth, source=f"{files[query]},{files[other]}")


def short_names(names: Sequence[str]) -> list[str]:
    """Names without the words that all begin with, and different from each other.

    >>> short_names(["walk_day_left", "walk_night", "walk_night"])
    ['day_left', 'night', 'night (2)']
    """
    begin = 0
    if len(names) > 1:
        alike = itertools.takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
        shared = "".join(letters[0] for letters in alike)
        begin = max(shared.rfind(mark) for mark in "_- ") + 1
    result: list[str] = []
    for name in names:
        short = name[begin:] or name
        same = sum(re.sub(r" \(\d+\)$", "", other) == short for other in result)
        result.append(f"{short} ({same + 1})" if same else short)
    return result


def _covered(known: dict[tuple[int, int], Any], opened: Sequence[Any]) -> list[np.ndarray]:
    """Frames of each drive that the truth of all its pairs covers."""
    frames = [np.arange(len(log.stamps())) for log in opened]
    for (query, other), truth in known.items():
        frames[query] = np.intersect1d(frames[query], truth.query_frames)
        frames[other] = np.intersect1d(frames[other], truth.map_frames)
    return frames


def _shown(truth: TruthChoice) -> dict[str, Any]:
    """The choice as it is stored."""
    return {**asdict(truth), "source": shown(truth.source)}


def _truth_hash(truth: TruthChoice) -> str:
    """Hash of the choice, and of the files it names."""
    files = [Path(file) for file in {truth.source, *truth.source.split(",")} if Path(file).is_file()]
    return key_of([_shown(truth), [hash_inputs(file) for file in sorted(files)]])
