"""The verbs that weigh recognisers against each other: each a plain function of its arguments."""

from __future__ import annotations

import argparse
from functools import partial
from typing import TYPE_CHECKING

from vplog.cli.options import at_least, at_least_one, local, option, pipeline_of, place, positive, topics_of
from vplog.cli.printing import Progress, print_comparison, print_result, print_study
from vplog.execution.execution import Execution

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.evaluate.place_truth import TruthChoice


def compare(arguments: argparse.Namespace) -> None:
    """Compare recognisers on two drives, or on one that revisits places."""
    from vplog.benchmark.compare import CompareOptions
    from vplog.benchmark.compare import compare as compare_methods
    from vplog.benchmark.recogniser_specs import split_methods

    with Progress(arguments) as progress:
        done = compare_methods(
            arguments.query,
            arguments.map,
            split_methods(arguments.methods),
            _truth(arguments),
            pipeline_of(arguments),
            CompareOptions(
                arguments.library, arguments.library_size, arguments.library_seed, arguments.min_gap,
                arguments.sequence, arguments.output, topics_of(arguments),
            ),
            Execution(arguments.threads, progress),
        )  # fmt: skip
    print_result(arguments, done.record, print_comparison)


def study(arguments: argparse.Namespace) -> None:
    """Run the paper's experiments on two or more drives of one route, or on one that revisits places."""
    from vplog.benchmark.recogniser_specs import split_methods
    from vplog.benchmark.study.experiments import METHODS, StudyOptions
    from vplog.benchmark.study.study import study as run_study

    with Progress(arguments) as progress:
        found = run_study(
            arguments.logs,
            _truth(arguments),
            pipeline_of(arguments),
            arguments.output,
            StudyOptions(
                METHODS if arguments.methods is None else split_methods(arguments.methods), arguments.sizes,
                arguments.seeds, arguments.library_size, arguments.min_gap, arguments.only, topics_of(arguments),
            ),
            Execution(arguments.threads, progress),
        )  # fmt: skip
    print_result(arguments, found, partial(print_study, arguments.output))


def _truth(arguments: argparse.Namespace) -> TruthChoice:
    from vplog.evaluate.place_truth import TruthChoice

    return TruthChoice(arguments.truth, arguments.tolerance, arguments.distance_m, arguments.heading_deg)


def add_studies(
    add: Callable[..., argparse.ArgumentParser],
    topics: argparse.ArgumentParser,
    threads: argparse.ArgumentParser,
    settings: argparse.ArgumentParser,
) -> None:
    truth = _truth_options()
    _add_comparison(add("compare", compare, topics, threads, settings, truth))
    _add_study(add("study", study, topics, threads, settings, truth))


def _truth_options() -> argparse.ArgumentParser:
    sub = argparse.ArgumentParser(add_help=False)
    text = "pairs `query,match`, frame i is frame i, poses in one frame, the odometry of the drives, or their GPS"
    option(sub, "--truth", str, "FILE.csv|index|FILE.tum[,MAPFILE.tum]|poses|gps", text, required=True)
    option(sub, "--tolerance", at_least(0), "N", "index: frames either side (default: 0)")
    option(sub, "--distance-m", positive, "M", "poses, gps: same place within (default: 6)")
    option(sub, "--heading-deg", positive, "DEG", "poses: and turned by at most (default: 45)")
    option(sub, "--min-gap", at_least_one, "N", "a drive against itself: matches are N frames older or more")
    option(sub, "--library-size", at_least_one, "L", "its images (default: 100)", default=100)
    return sub


def _add_comparison(sub: argparse.ArgumentParser) -> None:
    option(sub, "query", place, "QUERY", "drive whose frames are recognised")
    option(sub, "map", place, "MAP", "drive that is searched (default: QUERY)", nargs="?")
    text = "recognisers or pipelines, each with :setting=value as needed"
    option(sub, "--methods", str, "A,B", text, required=True)
    option(sub, "--sequence", at_least_one, "L", "also match sequences of L frames")
    option(sub, "--library", place, "LOG|LIB", "reference images for all methods (default: MAP)")
    option(sub, "--library-seed", at_least(0), "S", "of that choice (default: 0)", default=0)
    option(sub, "-o --output", local, "OUT", "folder for compare.json, scores and curves")


def _add_study(sub: argparse.ArgumentParser) -> None:
    option(sub, "logs", place, "LOG", "drives, each query and map in turn", nargs="+")
    option(sub, "--methods", str, "A,B", "recognisers as in compare (default: all those of the paper)")
    sizes = (10, 20, 50, 100)
    option(sub, "--sizes", _counts, "L,L", "library sizes (default: 10,20,50,100)", default=sizes)
    option(sub, "--seeds", at_least_one, "N", "libraries per figure (default: 3)", default=3)
    text = "pairs, sizes, library, conditions, bits, ablations, references, examples, sequence (default: all)"
    option(sub, "--only", lambda text: text.split(","), "E,E", text)
    option(sub, "-o --output", place, "OUT", "folder for study.json and the figures", required=True)


def _counts(text: str) -> tuple[int, ...]:
    return tuple(at_least_one(part) for part in text.split(","))
