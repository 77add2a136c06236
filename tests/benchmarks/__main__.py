"""`python -m tests.benchmarks [WHAT...] [--json]`, from the top; `--help` lists what there is.

Prints every ratio with its bar, and what it was measured on. The exit status is 0 only when every bar is reached.
Pose graph back ends on random worlds have arguments of their own: `python -m tests.benchmarks backend --help`, and
`second --help` for the worlds of a second, independent generator.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from tests.benchmarks import backend, second_worlds
from tests.benchmarks.ask import ask
from tests.benchmarks.batch import PARTS, batch
from tests.benchmarks.city import city
from tests.benchmarks.compaction import compaction
from tests.benchmarks.condense import condense
from tests.benchmarks.discovery import discovery
from tests.benchmarks.graphs import graphs
from tests.benchmarks.images import drives
from tests.benchmarks.large_graphs import large
from tests.benchmarks.localize import SCENES, localize
from tests.benchmarks.mining import describing, mining
from tests.benchmarks.night import night
from tests.benchmarks.reading import LARGE_GB, SMALL_GB, reading
from tests.benchmarks.scale import scale
from tests.benchmarks.search import free_memory_gb, growth, search
from tests.benchmarks.serve import hostile, serve
from tests.benchmarks.sparse import sparse
from tests.benchmarks.speed import speed
from vplog.pipeline import load_pipeline, pipeline_folder
from vplog.places.bobb import BobbSettings
from vplog.places.bobb_paper import PaperBobbSettings

if TYPE_CHECKING:
    from collections.abc import Iterator

    from tests.benchmarks.measure import Figure
    from vplog.pipeline import Pipeline

MINING_BARS = {"default": 0.40, "fast": 0.25}
"""Mining on one thread, as a share of SIFT."""
DESCRIBE_BAR = 0.7
"""Frames a second with mining, as a share of those without, on all cores."""
READING_BARS = (0.9, 1.1)
"""Least speed as a share of a bare mcap and cv2 loop, and most memory on a large log as a share of that on a small."""
DISCOVERY_BAR = 1000.0
"""Times faster than the algorithm as the paper lists it."""
SEARCH_BARS = (4.0, 40.0)
"""Times faster than a scan of binary codes, and of vectors of floats."""
SIZES = (10_000, 100_000, 1_000_000, 10_000_000)
SHORT = ("mining", "describe", "discovery", "search", "growth", "scale", "graphs", "reading")
"""What is measured if nothing is named."""
LONG = (
    *("serve", "hostile", "large", "sparse", "speed", "batch", "localize"),
    *("condense", "compaction", "ask", "city", "night"),
)
"""What is measured where it is named."""
LARGEST_NEEDS_GB = 12.0
"""Memory that must be free for the largest map: the places, the index, and what the system needs beside."""


def main() -> int:
    if sys.argv[1:2] == ["backend"]:
        return backend.main(sys.argv[2:])
    if sys.argv[1:2] == ["second"]:
        return second_worlds.main(sys.argv[2:])
    arguments = _arguments()
    figures = []
    for figure in _measure(arguments):
        figures.append(figure)
        if not arguments.json:
            _show(figure)
    missed = [figure.name for figure in figures if not figure.passed]
    if arguments.json:
        machine = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count()}
        print(json.dumps({"machine": machine, "figures": [figure.as_json() for figure in figures]}, indent=1))
    else:
        print(f"missed: {', '.join(missed)}" if missed else "every bar is reached")
    return 1 if missed else 0


def _arguments() -> argparse.Namespace:
    kinds = (*SHORT, *LONG)
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks", description=__doc__)
    named = f"of {', '.join(kinds)}; the default is {', '.join(SHORT)}. Or backend, second (own --help)"
    parser.add_argument("what", nargs="*", metavar="WHAT", help=named)
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--rounds", type=int, default=5, help="turns of each pair; medians are told")
    parser.add_argument("--images", type=int, default=20, help="images of each drive")
    parser.add_argument("--seeds", type=int, default=3, help="of the false closures put into pose graphs")
    parser.add_argument("--poses", type=int, nargs="+", default=[100_000, 1_000_000], help="of the large pose graphs")
    parser.add_argument("--drives", type=int, nargs="+", default=[300, 1000], help="of the joined cities")
    parser.add_argument("--fixes", action="store_true", help="give the drives of `night` a place on earth")
    parser.add_argument("--places", type=int, default=1_000_000, help="size of the map that is searched")
    parser.add_argument(
        "--folder",
        type=Path,
        help="keep the map of `scale` here, and what `condense` makes (default: made anew, then removed)",
    )
    parser.add_argument("--codes", action="store_true", help="`scale` beside a graph of codes, too")
    parser.add_argument("--vectors", action="store_true", help="`scale` beside a graph of vectors, too")
    parser.add_argument("--only", nargs="+", choices=PARTS, default=[], help="parts of `batch`")
    parser.add_argument("--kills", type=int, default=10, help="of a batch, at random moments")
    parser.add_argument("--set", nargs="+", default=[], metavar="A.B=C", help="settings of the drives of `batch`")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=[], help="of `localize`")
    parser.add_argument("--questions", type=int, default=60, help="that `ask` asks at most, of each graph")
    parser.add_argument("--runs", type=Path, nargs="+", default=[], help="finished runs that `ask` misplaces places of")
    arguments = parser.parse_args()
    unknown = sorted(set(arguments.what) - set(kinds))
    if unknown:
        parser.error(f"no benchmark {', '.join(unknown)}; there are {', '.join(kinds)}")
    arguments.what = arguments.what or list(SHORT)
    return arguments


def _measure(arguments: argparse.Namespace) -> Iterator[Figure]:
    what, rounds = set(arguments.what), arguments.rounds
    if what & {"mining", "describe", "discovery"}:
        sources = drives(arguments.images)
        for name, pipeline in _pipelines():
            for images in sources:
                if "mining" in what:
                    yield mining(images, pipeline, name, MINING_BARS[name], rounds)
                if "describe" in what:
                    yield describing(images, pipeline, name, DESCRIBE_BAR, rounds, os.cpu_count() or 1)
        if "discovery" in what:
            extractor = load_pipeline("default").features
            yield from discovery(sources[0], extractor, BobbSettings(), PaperBobbSettings(), DISCOVERY_BAR)
    if "search" in what:
        yield from search(arguments.places, BobbSettings(), 20, rounds, SEARCH_BARS)
    if "growth" in what:
        possible = [size for size in SIZES if size < SIZES[-1] or free_memory_gb() >= LARGEST_NEEDS_GB]
        yield from growth(tuple(possible), BobbSettings(), 20)
    if "scale" in what:
        with tempfile.TemporaryDirectory() as made:
            folder = arguments.folder or Path(made)
            yield from scale(arguments.places, folder, 20, os.cpu_count() or 1, arguments.codes, arguments.vectors)
    if "reading" in what:
        yield from reading(rounds, *READING_BARS, (SMALL_GB, LARGE_GB))
    if "graphs" in what:
        yield from graphs(arguments.seeds, rounds)
    if not what.isdisjoint(LONG):
        yield from _long(arguments)


def _long(arguments: argparse.Namespace) -> Iterator[Figure]:
    if "sparse" in arguments.what:
        yield from sparse()
    if "speed" in arguments.what:
        yield from speed()
    if "large" in arguments.what:
        yield from large(arguments.poses)
    if "batch" in arguments.what:
        yield from batch(arguments.only, arguments.kills, arguments.set)
    if "condense" in arguments.what:
        with tempfile.TemporaryDirectory() as made:
            yield from condense(arguments.folder or Path(made))
    if "serve" in arguments.what:
        with tempfile.TemporaryDirectory() as made:
            yield from serve(arguments.places, arguments.folder or Path(made))
    if "hostile" in arguments.what:
        with tempfile.TemporaryDirectory() as made:
            yield from hostile(Path(made))
    if "compaction" in arguments.what:
        yield from compaction()
    if "city" in arguments.what:
        yield from city(arguments.drives)
    if "night" in arguments.what:
        yield from night(arguments.drives, arguments.fixes)
    if "ask" in arguments.what:
        yield from ask(arguments.questions, arguments.seeds, arguments.runs)
    if "localize" in arguments.what:
        with tempfile.TemporaryDirectory() as made:
            yield from localize(arguments.scenes, Path(made))


def _pipelines() -> Iterator[tuple[str, Pipeline]]:
    """The default, and the fast one where it is shipped."""
    for name in MINING_BARS:
        if (pipeline_folder() / f"{name}.yaml").is_file():
            yield name, load_pipeline(name)


def _show(figure: Figure) -> None:
    bar = "" if figure.bar is None else f"{'<=' if figure.at_most else '>='} {figure.bar:g}"
    verdict = "" if figure.bar is None else "pass" if figure.passed else "MISSED"
    facts = ", ".join(f"{name} {value}" for name, value in figure.facts.items())
    print(f"{figure.name:<72} {figure.ratio:>10.3g}  {bar:<8} {verdict}\n    {facts}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
