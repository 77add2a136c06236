"""The verbs of maps of many drives: each a plain function of its arguments."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from vplog.cli_options import at_least_one, local, pipeline_of, place, topics_of
from vplog.cli_print import Progress, print_answers, print_batch, print_json, print_map

if TYPE_CHECKING:
    import argparse
    from collections.abc import Callable


def export_map(arguments: argparse.Namespace) -> None:
    """The places of one run or many, in one Parquet file."""
    from vplog.export import export_map as write_map

    found = write_map(arguments.runs, arguments.output)
    if arguments.json:
        print_json(found)
    else:
        print(f"{found['map']}: {found['places']} places of {len(found['drives'])} drives")


def batch(arguments: argparse.Namespace) -> None:
    """Many recorded drives to one map that grows, each drive in a process of its own."""
    from vplog.batch import run_batch
    from vplog.errors import ResultError

    with Progress(arguments) as progress:
        found = run_batch(
            arguments.logs, arguments.map, pipeline_of(arguments), arguments.library, topics_of(arguments),
            arguments.jobs, arguments.threads, progress,
        )  # fmt: skip
    if arguments.json:
        print_json(found)
    else:
        print_batch(found)
    if found["failed"]:
        raise ResultError(
            f"{found['failed']} of {len(found['drives'])} drives failed; {arguments.map}/failures.json says why."
        )


def info_map(arguments: argparse.Namespace) -> None:
    """The drives, places and library of a map, and what failed."""
    from vplog.maps.info import describe_map

    found = describe_map(arguments.map)
    if arguments.json:
        print_json(found)
    else:
        print_map(found)


def query_map(arguments: argparse.Namespace) -> None:
    """The places of a map that are most like each view of a log."""
    from vplog.maps.query import query_map as find_places

    with Progress(arguments) as progress:
        found = find_places(
            arguments.map, arguments.log, topics_of(arguments), arguments.top, arguments.sequence, arguments.output,
            arguments.threads, progress,
        )  # fmt: skip
    if arguments.json:
        print_json(found)
    else:
        print_answers(found)


def add_maps(
    add: Callable[..., argparse.ArgumentParser], common: argparse.ArgumentParser, topics: argparse.ArgumentParser,
    threads: argparse.ArgumentParser, settings: argparse.ArgumentParser,
) -> None:  # fmt: skip
    """The verb `batch`, and the verb `map` with its own verbs."""
    _add_batch(add("batch", batch, topics, threads, settings))
    maps = add("map", info_map).add_subparsers(required=True, metavar="VERB")
    sub = maps.add_parser("info", help="what a map holds", description=info_map.__doc__, parents=[common])
    sub.set_defaults(verb=info_map)
    sub.add_argument("map", type=local, metavar="MAP")
    text = "where a log's views are in a map"
    sub = maps.add_parser("query", help=text, description=query_map.__doc__, parents=[common, topics, threads])
    sub.set_defaults(verb=query_map)
    sub.add_argument("map", type=local, metavar="MAP")
    sub.add_argument("log", type=place, metavar="LOG")
    sub.add_argument("--top", type=at_least_one, default=10, metavar="K", help="places for each view (default: 10)")
    sub.add_argument(
        "--sequence", type=at_least_one, metavar="L", help="views in a window, odd; 1: none (default: as the map's)"
    )
    sub.add_argument("-o", "--output", type=Path, metavar="FILE.parquet", help="write the answers")
    text = "the places of one run or many, in one file"
    sub = maps.add_parser("export", help=text, description=export_map.__doc__, parents=[common])
    sub.set_defaults(verb=export_map)
    sub.add_argument("runs", type=place, nargs="+", metavar="RUN")
    sub.add_argument("-o", "--output", type=Path, required=True, metavar="FILE.parquet", help="file to write")


def _add_batch(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("logs", type=place, nargs="+", metavar="LOG", help="a drive each")
    sub.add_argument("-o", "--map", type=local, required=True, metavar="MAP", help="folder of the map")
    sub.add_argument("--jobs", type=at_least_one, default=1, metavar="N", help="drives at once (default: 1)")
    sub.add_argument(
        "--library", type=place, metavar="LIB", help="reference library (default: the map's, or one of the logs)"
    )
