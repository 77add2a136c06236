"""The verbs of maps of many drives: each a plain function of its arguments."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from vplog import api
from vplog.cli.options import (
    at_least,
    at_least_one,
    local,
    local_file,
    not_negative,
    place,
    settings_options,
    topics_of,
)
from vplog.cli.printing import (
    Progress,
    print_answers,
    print_batch,
    print_export,
    print_joined,
    print_json,
    print_line,
    print_map,
    print_merge,
    print_redescribed,
    print_result,
    warn,
)
from vplog.execution.execution import Execution

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any


def export_map(arguments: argparse.Namespace) -> None:
    """Write the places of a map or of runs to one Parquet file: all, or those of some drives or in a box on earth."""
    from vplog.maps.export import export_map as write_map

    with Progress(arguments) as progress:
        execution, kind = Execution(progress=progress), arguments.format
        found = write_map(arguments.sources, arguments.output, arguments.drive, arguments.box, kind, execution)
    print_result(arguments, found, print_export)


def merge_maps(arguments: argparse.Namespace) -> None:
    """Copy drives of maps, or places of exported files, into another map with the same library."""
    from vplog.maps.merge import merge_maps as merge

    with Progress(arguments) as progress:
        found = merge(arguments.maps, arguments.target, Execution(progress=progress), arguments.drive)
    print_result(arguments, found, print_merge)


def join_map(arguments: argparse.Namespace) -> None:
    """Find closures between the drives of a map and solve those that they join, as a batch does at its end."""
    from vplog.maps.joining.join import join_map as join

    with Progress(arguments) as progress:
        found = join(arguments.map, Execution(arguments.threads, progress))
    print_result(arguments, found, print_joined)


def remove_drives(arguments: argparse.Namespace) -> None:
    """Remove drives from a map."""
    from vplog.maps.remove import remove_drives as remove

    found = remove(arguments.map, arguments.drives)
    if arguments.json:
        print_json(found)
    else:
        print(f"{found['map']}: {len(found['removed'])} removed, {len(found['drives'])} drives left")
        if found["still_joined"]:
            print_line("to solve", f"{', '.join(found['still_joined'])} were joined with what is removed")
            print(f"next      vplog map join {shlex.quote(str(found['map']))}")
        warn(found["warnings"])


def redescribe_map(arguments: argparse.Namespace) -> None:
    """Copy a map to another, its drives described with another library; their logs are read again."""
    with api.drive_processes(arguments.engine, arguments.jobs) as processes, Progress(arguments) as progress:
        from vplog.batch.engine import BatchOptions
        from vplog.batch.redescribe import redescribe_map as redescribe

        execution = Execution(arguments.threads, progress)
        options = BatchOptions(arguments.jobs, arguments.engine, arguments.address, arguments.retries, processes)
        found = redescribe(arguments.map, arguments.library, arguments.target, execution, options)
    wrong = f"{found['failed']} of {len(found['drives'])} drives are not in {found['map']}."
    _end(arguments, found, print_redescribed, wrong)


def batch(arguments: argparse.Namespace) -> None:
    """Compute many recorded drives into one growing map, each drive in its own process, here or on a Ray cluster."""
    with Progress(arguments) as progress:
        found = api.batch(
            arguments.logs, arguments.map, arguments.pipeline, settings=arguments.set, topics=topics_of(arguments),
            library=arguments.library, jobs=arguments.jobs, threads=arguments.threads, engine=arguments.engine,
            address=arguments.address, retries=arguments.retries, join=arguments.join, keep_cache=arguments.keep_cache,
            progress=progress, tell=progress.tell_drive,
        )  # fmt: skip
    wrong = f"{found['failed']} of {len(found['drives'])} drives failed; {arguments.map}/failures.json says why."
    _end(arguments, found, print_batch, wrong)


def _end(
    arguments: argparse.Namespace, found: dict[str, Any], shown: Callable[[dict[str, Any]], None], wrong: str
) -> None:
    """Print what became of a batch. Raises ResultError where it is not all well, whether anyone reads that or not."""
    from vplog.errors import ResultError

    try:
        print_result(arguments, found, shown)
    finally:
        if found["failed"]:
            raise ResultError(wrong)
        if found["join_error"]:
            said = f"The drives are in {found['map']}, but not joined: {found['join_error'].rstrip('.')}."
            raise ResultError(f"{said} Then join them: vplog map join {found['map']}")


def info_map(arguments: argparse.Namespace) -> None:
    """Show the drives, places and library of a map, and what failed."""
    from vplog.errors import ResultError
    from vplog.maps.info import describe_map

    found = describe_map(arguments.map, check=arguments.check)
    print_result(arguments, found, print_map)
    if wrong := found["damaged_files"]:
        raise ResultError(
            f"{len(wrong)} damaged files in {arguments.map}: vplog batch LOG -o MAP computes drives again."
        )


def query_map(arguments: argparse.Namespace) -> None:
    """Find the places of a map most like each view of a log, here or on the workers of a Ray cluster."""
    with Progress(arguments) as progress:
        found = api.Map(arguments.map).query(
            arguments.log, arguments.top, topics=topics_of(arguments), sequence=arguments.sequence,
            out=arguments.output, engine=arguments.engine, address=arguments.address, cache=arguments.cache,
            cache_gb=arguments.cache_gb, threads=arguments.threads, progress=progress,
        )  # fmt: skip
    print_result(arguments, found.record, print_answers)


def index_map(arguments: argparse.Namespace) -> None:
    """Bring the index that queries search up to date with the drives of a map, as the next query would."""
    from vplog.maps.search.query import index_map as update
    from vplog.maps.storage.download_cache import cache_in

    cache = None if isinstance(arguments.map, Path) else cache_in(arguments.cache, arguments.cache_gb)
    with Progress(arguments) as progress:
        found = update(arguments.map, Execution(arguments.threads, progress), cache)
    if arguments.json:
        print_json(found)
    else:
        print(
            f"{found['map']}: {found['places']} places of {len(found['drives'])} drives in {len(found['segments'])} "
            f"files, {found['bytes'] / 1e6:.1f} MB"
        )
        warn(found["warnings"])


def add_maps(
    add: Callable[..., argparse.ArgumentParser], group: Callable[..., argparse.ArgumentParser],
    common: argparse.ArgumentParser, topics: argparse.ArgumentParser, threads: argparse.ArgumentParser,
) -> None:  # fmt: skip
    """The verb `batch`, and the verb `map` with its own verbs."""
    _add_batch(add("batch", batch, topics, threads, settings_options(None, "that of the map, else default")))
    text = "Inspect, search, export, merge, join or change a map of many drives."
    maps = group("map", text).add_subparsers(required=True, metavar="VERB")
    sub = maps.add_parser("info", help="what a map holds", description=info_map.__doc__, parents=[common])
    sub.set_defaults(verb=info_map)
    sub.add_argument("map", type=place, metavar="MAP")
    text = "check every file against its sha256; a line for each damaged one, and exit status 1"
    sub.add_argument("--check", action="store_true", help=text)
    text = "find where a log's views are in a map"
    sub = maps.add_parser("query", help=text, description=query_map.__doc__, parents=[common, topics, threads])
    sub.set_defaults(verb=query_map)
    sub.add_argument("map", type=place, metavar="MAP")
    sub.add_argument("log", type=place, metavar="LOG")
    sub.add_argument("--top", type=at_least_one, default=10, metavar="K", help="places for each view (default: 10)")
    sub.add_argument(
        "--sequence", type=at_least_one, metavar="L", help="views in a window, odd; 1: none (default: as the map's)"
    )
    sub.add_argument("-o", "--output", type=local_file, metavar="FILE.parquet", help="write the answers")
    text = "who searches: this process, or Ray workers that see the map under the same path (default: local)"
    sub.add_argument("--engine", choices=("local", "ray"), default="local", help=text)
    sub.add_argument("--address", metavar="HOST:PORT", help="Ray cluster (default: one of this machine's cores)")
    _add_cache(sub)
    text = "build the index that queries search"
    sub = maps.add_parser("index", help=text, description=index_map.__doc__, parents=[common, threads])
    sub.set_defaults(verb=index_map)
    sub.add_argument("map", type=place, metavar="MAP")
    _add_cache(sub)
    _add_export(maps, common)
    text = "copy drives of maps into another map"
    sub = maps.add_parser("merge", help=text, description=merge_maps.__doc__, parents=[common])
    sub.set_defaults(verb=merge_maps)
    sub.add_argument(
        "maps", type=place, nargs="+", metavar="MAP|FILE.parquet", help="maps, or places that `map export` wrote"
    )
    sub.add_argument("--drive", action="append", default=[], metavar="ID", help="only this drive; repeatable")
    sub.add_argument("-o", "--target", type=place, required=True, metavar="MAP", help="target map")
    text = "find closures between the drives of a map and solve them together"
    sub = maps.add_parser("join", help=text, description=join_map.__doc__, parents=[common, threads])
    sub.set_defaults(verb=join_map)
    sub.add_argument("map", type=place, metavar="MAP")
    sub = maps.add_parser("remove", help="remove drives", description=remove_drives.__doc__, parents=[common])
    sub.set_defaults(verb=remove_drives)
    sub.add_argument("map", type=place, metavar="MAP")
    sub.add_argument("drives", nargs="+", metavar="DRIVE", help="as `map info` names them")
    text = "describe the drives of a map with another library"
    sub = maps.add_parser("redescribe", help=text, description=redescribe_map.__doc__, parents=[common, threads])
    sub.set_defaults(verb=redescribe_map)
    sub.add_argument("map", type=place, metavar="MAP")
    text = "the library, or a log to make one from"
    sub.add_argument("--library", type=place, required=True, metavar="LIB|LOG", help=text)
    sub.add_argument("-o", "--target", type=place, required=True, metavar="MAP2", help="the new map")
    _add_workers(sub)


def _add_cache(sub: argparse.ArgumentParser) -> None:
    text = "folder that caches what is read of a map by URL (default: $VPLOG_CACHE, else ~/.cache/vplog)"
    sub.add_argument("--cache", type=local, metavar="DIR", help=text)
    text = "largest size of the cache in GB; least recently used files go first, 0 keeps none (default: 20)"
    sub.add_argument("--cache-gb", type=not_negative, metavar="GB", help=text)


def _add_export(maps: argparse._SubParsersAction[argparse.ArgumentParser], common: argparse.ArgumentParser) -> None:
    text = "the places of a map or of runs, in one file"
    sub = maps.add_parser("export", help=text, description=export_map.__doc__, parents=[common])
    sub.set_defaults(verb=export_map)
    sub.add_argument("sources", type=place, nargs="+", metavar="MAP|RUN")
    sub.add_argument("--drive", action="append", default=[], metavar="ID", help="only this drive; repeatable")
    sub.add_argument(
        "--box", type=_box, metavar="LAT0,LON0,LAT1,LON1",
        help="only places in this box, in degrees; LON0 > LON1 crosses the antimeridian (write --box=-33.9,...)",
    )  # fmt: skip
    sub.add_argument("--format", choices=("parquet", "geoparquet"), default="parquet", help="(default: parquet)")
    sub.add_argument("-o", "--output", type=local_file, required=True, metavar="FILE.parquet", help="file to write")


def _box(text: str) -> tuple[float, float, float, float]:
    try:
        south, west, north, east = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError("must be four numbers, LAT0,LON0,LAT1,LON1") from None
    if not -90 <= south <= north <= 90:
        raise argparse.ArgumentTypeError("must have LAT0 <= LAT1 within -90..90")
    if not (-180 <= west <= 180 and -180 <= east <= 180):
        raise argparse.ArgumentTypeError("must have LON0 and LON1 within -180..180")
    return south, west, north, east


def _add_workers(sub: argparse.ArgumentParser) -> None:
    """Who computes drives."""
    text = "drives at once (default: 1; over Ray as many as the cluster has cores for)"
    sub.add_argument("--jobs", type=at_least_one, metavar="N", help=text)
    text = "processes of this machine, or tasks of a Ray cluster (default: local)"
    sub.add_argument("--engine", choices=("local", "ray"), default="local", help=text)
    text = "HOST:PORT of a Ray cluster, or auto (default: one on this machine for the time of the batch)"
    sub.add_argument("--address", metavar="HOST:PORT", help=text)
    text = "retries of a drive whose worker was killed or had an I/O error (default: 2)"
    sub.add_argument("--retries", type=at_least(0), default=2, metavar="N", help=text)


def _add_batch(sub: argparse.ArgumentParser) -> None:
    sub.add_argument("logs", type=place, nargs="+", metavar="LOG", help="one drive each")
    sub.add_argument("-o", "--map", type=place, required=True, metavar="MAP", help="folder, s3:// or gs:// of the map")
    _add_workers(sub)
    text = "do not look for closures between the drives at the end"
    sub.add_argument("--no-join", dest="join", action="store_false", help=text)
    text = "cache results of stages, 0.35 MB a keyframe, so that other settings read no images; local maps only"
    sub.add_argument("--keep-cache", action="store_true", help=text)
    text = "reference library (default: the map's, else one of the first logs)"
    sub.add_argument("--library", type=place, metavar="LIB", help=text)
