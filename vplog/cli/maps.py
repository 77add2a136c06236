"""The verbs of maps of many drives: each a plain function of its arguments."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from vplog import api
from vplog.cli import parser, printing
from vplog.cli.parser import call, flag, option, place
from vplog.cli.printing import print_result
from vplog.cli.progress import Progress, one_stage
from vplog.errors import ResultError, SettingsError, plural
from vplog.execution.cores import limited
from vplog.execution.execution import Execution

Verb = Callable[[argparse.Namespace], None]


def export_map(arguments: argparse.Namespace) -> None:
    """Write the places of a map or of runs to one Parquet file: all, or those of some drives or in a box on earth."""
    from vplog.maps.export import export_map as write_map

    with Progress(arguments) as progress:
        execution, kind = Execution(progress=progress), arguments.format
        found = write_map(arguments.sources, arguments.output, arguments.drive, arguments.box, kind, execution)
    print_result(arguments, found, printing.print_export)


def merge_maps(arguments: argparse.Namespace) -> None:
    """Copy drives of maps, or places of exported files, into another map with the same library."""
    from vplog.maps.merge import merge_maps as merge

    with Progress(arguments) as progress:
        found = merge(arguments.maps, arguments.target, Execution(progress=progress), arguments.drive)
    print_result(arguments, found, printing.print_merge)


def join_map(arguments: argparse.Namespace) -> None:
    """Find closures between the drives of a map and solve those that they join, as a batch does at its end."""
    from vplog.maps.joining.join import join_map as join

    with Progress(arguments) as progress:
        found = join(arguments.map, Execution(arguments.threads, progress), whole=arguments.whole)
    print_result(arguments, found, printing.print_joined)


def remove_drives(arguments: argparse.Namespace) -> None:
    """Remove drives from a map."""
    from vplog.maps.remove import remove_drives as remove

    with one_stage(arguments, "remove"):
        found = remove(arguments.map, arguments.drives)
    print_result(arguments, found, printing.print_removed)


def show_log(arguments: argparse.Namespace) -> None:
    """Show the last snapshots of a map on an object store, newest first: each is one change of a writer."""
    from vplog.maps.snapshots import snapshots_of

    print_result(arguments, snapshots_of(arguments.map), printing.print_snapshots)


def vacuum(arguments: argparse.Namespace) -> None:
    """Remove what no snapshot of a map on an object store, and no version of Delta tables, needs any more: replaced
    files, and those of killed writers."""
    from vplog.maps.snapshots import vacuum_map

    with one_stage(arguments, "vacuum"):
        found = vacuum_map(arguments.map, arguments.hours)
    print_result(arguments, found, printing.print_vacuumed)


def write_delta(arguments: argparse.Namespace) -> None:
    """Make the tables of a map Delta Lake tables, too, which DuckDB, Spark, Polars and Databricks read at a version, in
    whole drives. From then on every change of the map is one of theirs."""
    from vplog.maps.snapshots import write_delta as write

    with one_stage(arguments, "delta"):
        found = write(arguments.map)
    print_result(arguments, found, printing.print_delta)


def compact_map(arguments: argparse.Namespace) -> None:
    """Put small files of a map together: on an object store those of its drives, and everywhere those of its Delta
    tables, into files of up to 100 MB. Every answer stays as it was; what was replaced `map vacuum` removes."""
    from vplog.maps.snapshots import compact_map as compact

    with one_stage(arguments, "compact"):
        found = compact(arguments.map)
    print_result(arguments, found, printing.print_compacted)


def condense_map(arguments: argparse.Namespace) -> None:
    """Copy a map to another without the places and references that recognition can do without, at a stated loss."""
    from vplog.maps.condensation.condense import condense_map as condense

    with Progress(arguments) as progress:
        execution = Execution(arguments.threads, progress)
        found = condense(arguments.map, arguments.target, arguments.loss, arguments.distance_m, execution)
    print_result(arguments, found, printing.print_condensed)


def redescribe_map(arguments: argparse.Namespace) -> None:
    """Copy a map to another, its drives described with another library; their logs are read again."""
    with Progress(arguments) as progress:
        from vplog.batch.engine import BatchOptions
        from vplog.batch.redescribe import redescribe_map as redescribe

        execution = Execution(arguments.threads, progress)
        options = call(BatchOptions, arguments)
        found = redescribe(arguments.map, arguments.library, arguments.target, execution, options)
    wrong = f"{found['failed']} of {plural(len(found['drives']), 'drive')} missing in {found['map']}."
    _end(arguments, found, printing.print_redescribed, wrong)


def batch(arguments: argparse.Namespace) -> None:
    """Compute many recorded drives into one growing map, each drive in its own process, here or on a Ray cluster."""
    if arguments.dry_run and arguments.metrics is not None:
        raise SettingsError("--dry-run computes nothing that --metrics could count. Leave out one of them.")
    if arguments.cost_per_cpu_hour is not None and not arguments.dry_run:
        raise SettingsError("--cost-per-cpu-hour is for --dry-run. Leave it out, or add that.")
    if arguments.metrics is not None:
        from vplog.storage.scratch import check_file_output

        check_file_output(arguments.metrics)
    with Progress(arguments) as progress:
        found = call(api.batch, arguments, progress=progress, on_drive=progress.print_drive)
    if arguments.dry_run:
        print_result(arguments, found, printing.print_dry_run)
        if failed := [one["log"] for one in found["drives"] if one["state"] == "failed"]:
            raise ResultError(
                f"{len(failed)} of {plural(len(found['drives']), 'drive')} would fail: {failed[0]} first."
            )
        return
    if arguments.metrics is not None:
        from vplog.batch.metrics import write_metrics

        write_metrics(arguments.metrics, found)
    drives = plural(len(found["drives"]), "drive")
    wrong = f"{found['failed']} of {drives} failed; `vplog map info {arguments.map}` has the reasons."
    _end(arguments, found, printing.print_batch, wrong)


def _end(
    arguments: argparse.Namespace, found: dict[str, Any], shown: Callable[[dict[str, Any]], None], wrong: str
) -> None:
    """Print the result of a batch. Raises ResultError where drives failed, even where stdout is closed."""
    try:
        print_result(arguments, found, shown)
    finally:
        if found["failed"]:
            raise ResultError(wrong)
        if found["join_error"]:
            text = f"The drives are in {found['map']}, but not joined: {found['join_error'].rstrip('.')}."
            raise ResultError(f"{text} Then join them: vplog map join {found['map']}")


def info_map(arguments: argparse.Namespace) -> None:
    """Show the drives, places and library of a map, and what failed."""
    from vplog.maps.info import describe_map

    with one_stage(arguments, "check" if arguments.check else "read"):
        found = describe_map(arguments.map, check=arguments.check)
    print_result(arguments, found, printing.print_map)
    if wrong := found["damaged_files"]:
        raise ResultError(
            f"{plural(len(wrong), 'damaged file')} in {arguments.map}: vplog batch LOG -o MAP computes drives again."
        )


def query_map(arguments: argparse.Namespace) -> None:
    """Find the places of a map most like each view of a log, or a picture, here or on the workers of a Ray cluster."""
    with Progress(arguments) as progress:
        found = call(api.Map(arguments.map).query, arguments, progress=progress)
    print_result(arguments, found.record, printing.print_answers)


def localize(arguments: argparse.Namespace) -> None:
    """Find the pose of pictures, or of the frames of a log, in a run or a map, with covariance and verdict."""
    with Progress(arguments) as progress:
        found = call(api.localize, arguments, progress=progress)
    print_result(arguments, found, printing.print_localized)


def serve_map(arguments: argparse.Namespace) -> None:
    """Answer queries and localisations over HTTP, read only, until Ctrl-C: POST an image to /query or /localize. A map
    that changes meanwhile is read again. There is no login: other machines come through a proxy that has one."""
    from vplog.maps.storage.download_cache import cache_in

    try:
        from vplog.maps.service.http import Limits, serve
    except ImportError:
        raise SettingsError("FastAPI or uvicorn is not installed. Install both: pip install fastapi uvicorn") from None
    from vplog.maps.service.open_state import NewestState

    cache = None if isinstance(arguments.map, Path) else cache_in(arguments.cache, arguments.cache_gb)
    with Progress(arguments) as progress:
        newest = NewestState(arguments.map, cache, Execution(arguments.threads, progress))

    def ready(url: str) -> None:
        now = newest.now
        counts = f"{plural(now.places, 'place')} of {plural(len(now.drives), 'drive')}"
        printing.print_status(f"{arguments.map}: {counts} at {url}, until Ctrl-C")

    limits = call(Limits, arguments)
    try:
        with limited(arguments.threads):
            serve(newest, arguments.host, arguments.port, limits, arguments.calibration, ready)
    except OSError as error:
        where, why = f"{arguments.host}:{arguments.port}", os.strerror(error.errno) if error.errno else str(error)
        raise SettingsError(f"Cannot listen on {where}: {why}. Choose another --port or --host.") from None


def index_map(arguments: argparse.Namespace) -> None:
    """Bring the index that queries search up to date with the drives of a map, as the next query would."""
    from vplog.maps.search.query import index_map as update
    from vplog.maps.storage.download_cache import cache_in

    cache = None if isinstance(arguments.map, Path) else cache_in(arguments.cache, arguments.cache_gb)
    with Progress(arguments) as progress:
        found = update(arguments.map, Execution(arguments.threads, progress), cache)
    print_result(arguments, found, printing.print_index)


def add_maps(
    add: Callable[..., argparse.ArgumentParser], group: Callable[..., argparse.ArgumentParser],
    common: argparse.ArgumentParser, topics: argparse.ArgumentParser, threads: argparse.ArgumentParser,
) -> None:  # fmt: skip
    """The verbs `batch` and `localize`, and the verb `map` with its own verbs."""
    _add_batch(add("batch", batch, topics, threads, parser.settings_options(None, "that of the map, else default")))
    sub = add("localize", localize, topics, threads)
    option(sub, "map", place, "MAP|RUN")
    option(sub, "pictures", place, "IMAGE|LOG", "images, a folder of them, or one log", nargs="+")
    text = "places that each picture is verified against (default: 10)"
    option(sub, "--top", parser.at_least_one, "K", text, default=10)
    option(sub, "-o --output", parser.output_file, "FILE.parquet|FILE.tum", "write the poses, or a log's trajectory")
    text = "Inspect, search, export, merge, join or change a map of many drives."
    maps = group("map", text).add_subparsers(required=True, metavar="VERB")

    def verb(name: str, run: Verb, text: str, *parents: argparse.ArgumentParser, of_map: bool = True) -> Any:
        sub = maps.add_parser(name, help=text, description=run.__doc__, parents=[common, *parents])
        sub.set_defaults(verb=run)
        if of_map:
            option(sub, "map", place, "MAP")
        return sub

    sub = verb("info", info_map, "what a map holds")
    flag(sub, "--check", "check every file against its sha256; a line for each damaged one, and exit status 1")
    _add_query(verb("query", query_map, "find where a log's views are in a map", topics, threads))
    sub = verb("index", index_map, "build the index that queries search", threads)
    parser.cache_options(sub, "what is read of a map by URL is kept")
    _add_serve(verb("serve", serve_map, "answer queries and localisations over HTTP"))
    _add_export(verb("export", export_map, "the places of a map or of runs, in one file", of_map=False))
    sub = verb("merge", merge_maps, "copy drives of maps into another map", of_map=False)
    option(sub, "maps", place, "MAP|FILE.parquet", "maps, or places that `map export` wrote", nargs="+")
    option(sub, "--drive", str, "ID", "only this drive; repeatable", action="append", default=[])
    option(sub, "-o --target", place, "MAP", "target map", required=True)
    sub = verb("join", join_map, "find closures between the drives of a map and solve them together", threads)
    flag(sub, "--whole", "solve joint graphs to which drives were added again as a whole")
    sub = verb("remove", remove_drives, "remove drives")
    option(sub, "drives", str, "DRIVE", "as `map info` names them", nargs="+")
    verb("log", show_log, "the last changes of a map on an object store")
    sub = verb("vacuum", vacuum, "remove what was replaced on an object store and in Delta tables")
    text = "age of what is removed, longer than any reader runs (default: 168, a week)"
    option(sub, "--hours", parser.number(lambda value: value >= 24, "at least 24"), "H", text, default=168.0)
    verb("delta", write_delta, "keep the tables as Delta Lake tables, for other tools")
    verb("compact", compact_map, "put small files together, up to 100 MB")
    sub = verb("condense", condense_map, "leave out the places and references that recognition can do without", threads)
    option(sub, "-o --target", place, "MAP2", "the new map", required=True)
    text = "recall at rank one that the map's own queries may lose (default: 0.01)"
    option(sub, "--loss", parser.number(lambda value: 0 <= value < 1, "from 0, below 1"), "SHARE", text, default=0.01)
    text = "distance within which an answer is right, in m (default: three times the spacing of keyframes)"
    option(sub, "--distance-m", parser.positive, "M", text)
    sub = verb("redescribe", redescribe_map, "describe the drives of a map with another library", threads)
    option(sub, "--library", place, "LIB|LOG", "the library, or a log to make one from", required=True)
    option(sub, "-o --target", place, "MAP2", "the new map", required=True)
    _add_workers(sub)


def _add_query(sub: argparse.ArgumentParser) -> None:
    option(sub, "log", place, "LOG|IMAGE")
    option(sub, "--top", parser.at_least_one, "K", "places for each view (default: 10)", default=10)
    option(sub, "--sequence", parser.at_least_one, "L", "views in a window, odd; 1: none (default: as the map's)")
    option(sub, "--drive", str, "ID", "search only this drive; repeatable", action="append", default=[], dest="drives")
    where = sub.add_mutually_exclusive_group()
    text = "search only drives that may have places in this box, in degrees (write --box=-33.9,...)"
    option(where, "--box", _box, "LAT0,LON0,LAT1,LON1", text)
    text = "search only drives that may have places within M metres of a point"
    option(where, "--near", _near, "LAT,LON,M", text, dest="box")
    text = "search only drives that may have places within M metres of the log's satellite fixes"
    option(where, "--near-fixes", parser.positive, "M", text, dest="near_fixes_m")
    option(sub, "-o --output", parser.output_file, "FILE.parquet", "write the answers")
    text = "the map as it was at a version of `map log`, or at a time (2026-01-31T12:00, UTC); on an object store"
    option(sub, "--as-of", str, "VERSION|TIME", text)
    text = "who searches: this process, or Ray workers that see the map under the same path (default: local)"
    sub.add_argument("--engine", choices=("local", "ray"), default="local", help=text)
    option(sub, "--address", str, "HOST:PORT", "Ray cluster (default: one of this machine's cores)")
    parser.cache_options(sub, "what is read of a map by URL is kept")


def _add_serve(sub: argparse.ArgumentParser) -> None:
    option(sub, "--host", str, "ADDRESS", "address to listen on (default: 127.0.0.1)", default="127.0.0.1")
    option(sub, "--port", parser.at_least(0), "N", "port; 0: any free one (default: 8080)", default=8080)
    text = "queries that are worked on at once, beside one localisation (default: 2)"
    option(sub, "--threads", parser.at_least_one, "N", text, default=2)
    text = "requests that are open at once; more are refused with 503 (default: 64)"
    option(sub, "--waiting", parser.at_least_one, "N", text, default=64)
    option(sub, "--megabytes", parser.positive, "MB", "longest body of a request (default: 16)", default=16.0)
    text = "camera of pictures that come without fx, fy, cx and cy: camera_info, Kalibr camchain or EuRoC sensor.yaml"
    option(sub, "--calibration", place, "FILE", text)
    parser.cache_options(sub, "what is read of a map by URL is kept")


def _add_export(sub: argparse.ArgumentParser) -> None:
    option(sub, "sources", place, "MAP|RUN", nargs="+")
    option(sub, "--drive", str, "ID", "only this drive; repeatable", action="append", default=[])
    text = "only places in this box, in degrees; LON0 > LON1 crosses the antimeridian (write --box=-33.9,...)"
    option(sub, "--box", _box, "LAT0,LON0,LAT1,LON1", text)
    sub.add_argument("--format", choices=("parquet", "geoparquet"), default="parquet", help="(default: parquet)")
    option(sub, "-o --output", parser.output_file, "FILE.parquet", "file to write", required=True)


def _near(text: str) -> tuple[float, float, float, float]:
    try:
        latitude, longitude, radius_m = (float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError("must be three numbers, LAT,LON,M") from None
    if not (-90 <= latitude <= 90 and -180 <= longitude <= 180 and 0 < radius_m < 1e8):
        raise argparse.ArgumentTypeError("must have LAT within -90..90, LON within -180..180 and M above 0")
    from vplog.maps.geo_bounds import box_around

    return box_around(latitude, longitude, latitude, longitude, radius_m)


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


def _add_workers(verb: argparse.ArgumentParser) -> None:
    """Who computes drives."""
    sub = verb.add_argument_group("workers")
    text = "drives at once (default: 1; over Ray as many as the cluster has cores for)"
    option(sub, "--jobs", parser.at_least_one, "N", text)
    text = "processes of this machine, or tasks of a Ray cluster (default: local)"
    sub.add_argument("--engine", choices=("local", "ray"), default="local", help=text)
    text = "HOST:PORT of a Ray cluster, or auto (default: one on this machine for the time of the batch)"
    option(sub, "--address", str, "HOST:PORT", text)
    text = "retries of a drive whose worker was killed, or had an error of network, disk or memory (default: 2)"
    option(sub, "--retries", parser.at_least(0), "N", text, default=2)
    text = "longest time of a drive, which then fails; local processes only"
    option(sub, "--drive-timeout", parser.positive, "S", text, dest="drive_timeout_s")
    text = "largest resident memory of a drive in MB, as --drive-timeout"
    option(sub, "--drive-memory", parser.positive, "MB", text, dest="drive_memory_mb")


def _add_batch(sub: argparse.ArgumentParser) -> None:
    text = "one drive each, folders or prefixes of them, patterns, @LIST.txt, or a manifest: drives.csv, drives.parquet"
    option(sub, "logs", place, "LOG", text, nargs="+")
    option(sub, "-o --map", place, "MAP", "folder, s3://, gs:// or az:// of the map", required=True)
    _add_workers(sub)
    text = "write states, faults and seconds as Prometheus's textfile collector reads them"
    option(sub, "--metrics", parser.output_file, "FILE.prom", text)
    flag(sub, "--dry-run", "say which drives would be computed, with bytes, CPU hours and cost, and write nothing")
    option(sub, "--cost-per-cpu-hour", parser.not_negative, "COST", "price of an hour of a core, for --dry-run")
    flag(sub, "--no-join", "do not look for closures between the drives at the end", "join")
    text = "cache results of stages, 0.35 MB a keyframe, so that other settings read no images; local maps only"
    flag(sub, "--keep-cache", text)
    option(sub, "--library", place, "LIB", "reference library (default: the map's, else one of the first logs)")
