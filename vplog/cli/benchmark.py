"""The verbs that weigh recognisers against each other: each a plain function of its arguments."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from vplog.cli.options import at_least, at_least_one, local, pipeline_of, place, positive, topics_of
from vplog.cli.printing import Progress, print_comparison, print_json, print_result, print_study
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
    from vplog.benchmark.study.study import METHODS, StudyOptions
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
    if arguments.json:
        print_json(found)
    else:
        print_study(arguments.output, found)


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
    sub.add_argument(
        "--truth",
        required=True,
        metavar="FILE.csv|index|FILE.tum[,MAPFILE.tum]|poses|gps",
        help="pairs `query,match`, frame i is frame i, poses in one frame, the odometry of the drives, or their GPS",
    )
    sub.add_argument("--tolerance", type=at_least(0), metavar="N", help="index: frames either side (default: 0)")
    sub.add_argument("--distance-m", type=positive, metavar="M", help="poses, gps: same place within (default: 6)")
    sub.add_argument("--heading-deg", type=positive, metavar="DEG", help="poses: and turned by at most (default: 45)")
    sub.add_argument(
        "--min-gap", type=at_least_one, metavar="N", help="a drive against itself: matches are N frames older or more"
    )
    sub.add_argument("--library-size", type=at_least_one, default=100, metavar="L", help="its images (default: 100)")
    return sub


def _add_comparison(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("query", type=place, metavar="QUERY", help="drive whose frames are recognised")
    sub.add_argument("map", type=place, nargs="?", metavar="MAP", help="drive that is searched (default: QUERY)")
    sub.add_argument(
        "--methods", required=True, metavar="A,B", help="recognisers or pipelines, each with :setting=value as needed"
    )
    sub.add_argument("--sequence", type=at_least_one, metavar="L", help="also match sequences of L frames")
    sub.add_argument("--library", type=place, metavar="LOG|LIB", help="reference images for all methods (default: MAP)")
    sub.add_argument("--library-seed", type=at_least(0), default=0, metavar="S", help="of that choice (default: 0)")
    sub.add_argument("-o", "--output", type=local, metavar="OUT", help="folder for compare.json, scores and curves")


def _add_study(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("logs", type=place, nargs="+", metavar="LOG", help="drives, each query and map in turn")
    sub.add_argument("--methods", metavar="A,B", help="recognisers as in compare (default: all those of the paper)")
    sub.add_argument(
        "--sizes", type=_counts, default=(10, 20, 50, 100), metavar="L,L", help="library sizes (default: 10,20,50,100)"
    )
    sub.add_argument("--seeds", type=at_least_one, default=3, metavar="N", help="libraries per figure (default: 3)")
    sub.add_argument(
        "--only", type=lambda text: text.split(","), metavar="E,E",
        help="pairs, sizes, library, conditions, bits, ablations, references, examples, sequence (default: all)",
    )  # fmt: skip
    sub.add_argument(
        "-o", "--output", type=place, required=True, metavar="OUT", help="folder for study.json and the figures"
    )


def _counts(text: str) -> tuple[int, ...]:
    return tuple(at_least_one(part) for part in text.split(","))
