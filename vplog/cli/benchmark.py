"""The verbs that compare recognisers: each a plain function of its arguments."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial

from vplog import api
from vplog.cli import parser, printing
from vplog.cli.parser import call, option, place
from vplog.cli.printing import print_result
from vplog.cli.progress import Progress
from vplog.errors import SettingsError
from vplog.execution.execution import Execution


def compare(arguments: argparse.Namespace) -> None:
    """Compare recognisers on two drives, or on one that revisits places."""
    groups = ("features", "places") + (("sequence",) if arguments.sequence is not None else ())
    ignored = [one for one in arguments.set if one.partition(".")[0] not in groups]
    if ignored:
        raise SettingsError(
            f"--set {ignored[0]}: only features, places and, with --sequence, sequence count here; see --library-size "
            "and --library-seed."
        )
    with Progress(arguments) as progress:
        done = call(api.compare, arguments, progress=progress)
    print_result(arguments, done.record, printing.print_comparison)


def study(arguments: argparse.Namespace) -> None:
    """Run the paper's experiments on two or more drives of one route, or on one that revisits places."""
    from vplog.benchmark.feature_cache import CacheChoice
    from vplog.benchmark.recogniser_specs import split_methods
    from vplog.benchmark.study.experiments import METHODS, StudyOptions
    from vplog.benchmark.study.study import study as run_study
    from vplog.evaluate.place_truth import TruthChoice

    truth = call(TruthChoice, arguments, source=arguments.truth)
    methods = METHODS if arguments.methods is None else split_methods(arguments.methods)
    cache = CacheChoice(arguments.cache, arguments.cache_gb)
    options = call(StudyOptions, arguments, methods=methods, cache=cache)
    with Progress(arguments) as progress:
        execution = Execution(arguments.threads, progress)
        found = run_study(arguments.logs, truth, parser.pipeline_of(arguments), arguments.output, options, execution)
    print_result(arguments, found, partial(printing.print_study, arguments.output))


def add_studies(add: Callable[..., argparse.ArgumentParser], *parents: argparse.ArgumentParser) -> None:
    _add_comparison(add("compare", compare, *parents, _truth_options(required=False)))
    _add_study(add("study", study, *parents, _truth_options(required=True)))


def _truth_options(required: bool) -> argparse.ArgumentParser:
    parent = argparse.ArgumentParser(add_help=False)
    sub = parent.add_argument_group("truth, library and cache")
    text = (
        "equal numbers in file names or frames, a table `query,match` or `image,label`, VPR-Bench's array, folders as "
        "labels, positions in file names, poses in one frame, the odometry of the drives, or their GPS"
    )
    if not required:
        text += " (default: none, so answers and no scores)"
    kinds = "index|FILE.csv|FILE.npy|labels|utm|FILE.tum[,MAPFILE.tum]|poses|gps"
    option(sub, "--truth", str, kinds, text, required=required)
    option(sub, "--tolerance", parser.at_least(0), "N", "index: numbers either side (default: 0)")
    option(sub, "--distance-m", parser.positive, "M", "poses, utm, gps: same place within (default: 6; utm: 25)")
    option(sub, "--heading-deg", parser.positive, "DEG", "poses, utm: and turned by at most (default: 45; utm: any)")
    option(sub, "--min-gap", parser.at_least_one, "N", "a drive against itself: matches are N frames older or more")
    text, size = ("default: 100", 100) if required else ("default: all of MAP to 1600; of its own past an eighth", None)
    option(sub, "--library-size", parser.at_least_one, "L", f"reference images of the library ({text})", default=size)
    parser.cache_options(sub, "features are kept between calls")
    return parent


def _add_comparison(sub: argparse.ArgumentParser) -> None:
    option(sub, "query", place, "QUERY", "drive whose frames are recognised")
    option(sub, "map", place, "MAP", "drive that is searched (default: QUERY)", nargs="?")
    text = "recognisers or pipelines, each with :setting=value as needed"
    option(sub, "--methods", str, "A,B", text, required=True)
    option(sub, "--sequence", parser.at_least_one, "L", "also match sequences of L frames")
    option(sub, "--library", place, "LOG|LIB", "reference images for all methods (default: MAP)")
    text = "seed of the random choice of these images (default: 0)"
    option(sub, "--library-seed", parser.at_least(0), "S", text, default=0)
    option(sub, "-o --output", parser.local, "OUT", "folder for compare.json, answers.csv, scores and figures")


def _add_study(sub: argparse.ArgumentParser) -> None:
    option(sub, "logs", place, "LOG", "drives, each query and map in turn", nargs="+")
    option(sub, "--methods", str, "A,B", "recognisers as in compare (default: all those of the paper)")
    sizes = (10, 20, 50, 100)
    option(sub, "--sizes", _counts, "L,L", "library sizes (default: 10,20,50,100)", default=sizes)
    option(sub, "--seeds", parser.at_least_one, "N", "libraries per figure (default: 3)", default=3)
    text = "pairs, sizes, library, conditions, bits, ablations, references, examples, sequence (default: all)"
    option(sub, "--only", lambda text: text.split(","), "E,E", text)
    option(sub, "-o --output", place, "OUT", "folder for study.json and the figures", required=True)


def _counts(text: str) -> tuple[int, ...]:
    return tuple(parser.at_least_one(part) for part in text.split(","))
