"""The verbs of what is finished: of a run, and of a pose graph from anywhere."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog import api
from vplog.cli import parser, printing
from vplog.cli.parser import call, flag, option, place
from vplog.cli.printing import print_json, print_result
from vplog.cli.progress import Progress, one_stage
from vplog.errors import ResultError, SettingsError
from vplog.execution.execution import Execution

if TYPE_CHECKING:
    from vplog.verbs.evaluate_run import TruthOptions

_TRUTH = "TUM file, the log's own GPS, or the truth that comes with it"
_SOLVERS = ("gnc", "pcm", "dcs", "cauchy", "geman_mcclure", "lm")
"""The kinds of graph/solve.py, here too since that imports numpy."""
_ALIGNMENTS = ("se3", "sim3", "origin")
"""Alignments of evaluate/trajectory.py, here too since that imports numpy."""
_FOLDERS = ("colmap", "nerfstudio")
_FORMATS = ("tum", "kitti", "euroc", "g2o", "geojson", "geoparquet", "kml", "utm", "rrd", "foxglove-layout", *_FOLDERS)
"""Formats of export.py, here too since that imports numpy."""
_VIEWERS = ("rerun", "report", "foxglove")
"""Viewers of open_run.py, here too since that imports numpy."""
_BINARY = ("geoparquet", "rrd")


def evaluate(arguments: argparse.Namespace) -> None:
    """Evaluate a run, of one or several drives, or the drives of a map against ground truth."""
    from vplog.verbs.evaluate_run import FIGURES, broken_limits
    from vplog.verbs.limits import read_limits

    limits = read_limits(arguments.fail_on, FIGURES, "limit of a figure and a number: 'ate_m>1', 'recall<0.5'")
    with one_stage(arguments, "evaluate"):
        found = call(api.evaluate, arguments, run=arguments.place)
    print_result(arguments, found, printing.print_evaluated_map if "groups" in found else printing.print_evaluation)
    if sentences := broken_limits(found, limits):
        raise ResultError(" ".join(sentences))


def explain(arguments: argparse.Namespace) -> None:
    """Explain one candidate closure of a run in words and a picture of both frames."""
    from vplog.verbs.explain import explain as explain_closure

    with one_stage(arguments, "explain"):
        found = explain_closure(
            arguments.run, arguments.closure, arguments.output, arguments.log, words_only=arguments.no_picture
        )
    print_result(arguments, found, printing.print_explanation)


def ask(arguments: argparse.Namespace) -> None:
    """Ask about the closures of a run whose verdicts are doubtful and would move its map most."""
    from vplog.verbs.ask import ask as ask_about

    with one_stage(arguments, "ask"):
        found = ask_about(arguments.run, arguments.count, arguments.output)
    print_result(arguments, found, printing.print_questions)


def optimize(arguments: argparse.Namespace) -> None:
    """Solve a pose graph from a g2o file, planar or spatial, robust against false loop closures."""
    from vplog.verbs.optimize import optimize as optimize_graph

    with one_stage(arguments, "solve"):
        done = optimize_graph(arguments.graph, arguments.output, arguments.method, arguments.certify)
    print_result(arguments, done.record, printing.print_optimised)


def report(arguments: argparse.Namespace) -> None:
    """Write the report of a finished run again, against a truth where one is given."""
    from vplog.verbs.report import report as write_report

    with one_stage(arguments, "report"):
        found = write_report(
            arguments.run, arguments.output, arguments.truth, arguments.log, parser.topics_of(arguments),
            _truth_options(arguments), Execution(arguments.threads),
        )  # fmt: skip
    print_result(arguments, found, lambda found: print(found["report"]))


def diff(arguments: argparse.Namespace) -> None:
    """Compare two runs of one drive, or two maps: settings, closures, trajectories, scores and times."""
    from vplog.maps.diff import diff_maps
    from vplog.verbs.diff import check_limits, exceeded, write_page
    from vplog.verbs.diff import diff as diff_runs

    runs = [*([arguments.baseline] if arguments.baseline else []), *arguments.runs]
    if len(runs) != 2:
        arguments.refuse(f"two runs are compared, BASELINE RUN or RUN --baseline BASELINE, and {len(runs)} were given")
    check_limits(arguments.fail_on)
    maps = [(run / "map.json").is_file() for run in runs]
    if any(maps) and (not all(maps) or arguments.output or arguments.truth):
        arguments.refuse("a map is compared with a map, without --truth and -o")
    if not arguments.truth and any(getattr(arguments, name) is not None for name in _TRUTH_OPTIONS):
        arguments.refuse("--distance-m, --heading-deg, --align and --truth-offset-s need a truth: give --truth")
    with one_stage(arguments, "compare"):
        truth = arguments.truth, parser.topics_of(arguments), _truth_options(arguments)
        found = diff_maps(runs[0], runs[1]) if all(maps) else diff_runs(runs[0], runs[1], *truth)
        if arguments.output is not None:
            write_page(arguments.output, found, *truth)
    print_result(arguments, found, printing.print_diff)
    if sentences := exceeded(found, arguments.fail_on):
        raise ResultError(" ".join(sentences))


def export(arguments: argparse.Namespace) -> None:
    """Write a finished run in the format of another tool."""
    from vplog.verbs.export import export as export_run

    if arguments.truth is not None and arguments.format != "rrd":
        raise SettingsError(f"--truth is shown in rrd alone, not in {arguments.format}. Leave it out.")
    if arguments.output is parser.STDOUT and arguments.format in _FOLDERS:
        raise SettingsError(f"{arguments.format} is a folder, which stdout does not take. Name one with -o.")
    if arguments.output.is_dir() and arguments.format not in _FOLDERS:
        raise SettingsError(f"{arguments.output} is a folder, and {arguments.format} a file. Name one with -o.")
    with _file_or_stdout(arguments, arguments.format in _BINARY) as path, Progress(arguments) as progress:
        execution = Execution(arguments.threads, progress)
        found = export_run(arguments.run, arguments.format, path, arguments.log, execution, arguments.truth)
    printing.warn(found["warnings"])
    if arguments.json:
        print_json(found)
    elif path == arguments.output:
        print("\n".join(found["written"]))


def open_run(arguments: argparse.Namespace) -> None:
    """Open a finished run in rerun, in Foxglove, or its report in the browser."""
    from vplog.verbs.open_run import opening

    with opening(arguments.run, arguments.viewer) as opened:
        found = {"run": arguments.run, "viewer": opened.viewer, "path": opened.path, "opened": opened.start is not None}
        print_result(arguments, found | {"why": opened.why}, printing.print_opened)
        sys.stdout.flush()  # the viewer may stay for hours
        if opened.start is not None and not opened.start():
            raise ResultError(f"{opened.viewer} did not open {opened.path}. Choose another with --with.")


_TRUTH_OPTIONS = ("distance_m", "heading_deg", "align", "truth_offset_s")


def _truth_options(arguments: argparse.Namespace) -> TruthOptions:
    from vplog.verbs.evaluate_run import TruthOptions

    return TruthOptions(**{name: value for name in _TRUTH_OPTIONS if (value := getattr(arguments, name)) is not None})


def _add_truth_options(verb: argparse.ArgumentParser) -> None:
    sub = verb.add_argument_group("places and alignment of the truth")
    option(sub, "--distance-m", parser.positive, "M", "largest distance within one place (default: 6)")
    option(sub, "--heading-deg", parser.positive, "DEG", "largest angle between optical axes (default: 45)")
    sub.add_argument(
        "--align", choices=_ALIGNMENTS, help="alignment of the ATE (default: se3; sim3 of a run without metres)"
    )
    option(sub, "--truth-offset-s", parser.seconds, "S", "add to the truth's stamps (default: 0)")


@contextmanager
def _file_or_stdout(arguments: argparse.Namespace, binary: bool = False) -> Iterator[Path]:
    """The file to write: the one that -o names; for `-` a scratch file that goes to stdout when it is whole."""
    if arguments.output is not parser.STDOUT:  # ./- is a file
        yield arguments.output
        return
    from vplog.storage.scratch import scratch

    if arguments.json:
        raise SettingsError("-o - and --json both write to stdout. Leave out one, or name a file with -o.")
    if binary and sys.stdout.isatty():
        raise SettingsError(f"{arguments.format} is binary and stdout a terminal. Name a file with -o, or use a pipe.")
    with scratch("stdout") as folder:
        yield folder / "out"
        sys.stdout.buffer.write((folder / "out").read_bytes())
        sys.stdout.buffer.flush()


def add_results(
    add: Callable[..., argparse.ArgumentParser], topics: argparse.ArgumentParser, threads: argparse.ArgumentParser
) -> None:
    sub = add("evaluate", evaluate, topics)
    option(sub, "place", place, "RUN|MAP")
    text = f"{_TRUTH} (default: auto); of a map also a manifest with a column truth"
    option(sub, "--truth", str, "FILE.tum|gps|auto", text, default="auto")
    option(sub, "--log", place, "LOG", "the run's log, where it has moved since, for the truth that comes with it")
    text = "exit status 1 where a drive fails this, as 'ate_m>1' or 'recall<0.5'; repeatable"
    option(sub, "--fail-on", str, "LIMIT", text, action="append", default=[])
    _add_truth_options(sub)
    _add_explain(add("explain", explain))
    sub = add("ask", ask)
    option(sub, "run", place, "RUN")
    option(sub, "--count", parser.at_least_one, "N", "questions (default: 10)", default=10)
    text = "folder of their pictures and of decisions.csv, to be answered in (default: RUN/questions)"
    option(sub, "-o --output", parser.local, "FOLDER", text)
    sub = add("report", report, topics, threads)
    option(sub, "run", place, "RUN")
    option(sub, "--truth", str, "FILE.tum|gps|auto", _TRUTH)
    _add_truth_options(sub)
    option(sub, "--log", place, "LOG", "the run's log, for its truth, and for pictures that result.mcap lacks")
    option(sub, "-o --output", parser.output_file, "FILE.html", "page (default: RUN/report.html)")
    sub = add("diff", diff, topics)
    sub.set_defaults(refuse=sub.error)
    option(sub, "runs", place, "RUN", nargs="+")
    option(sub, "--baseline", place, "RUN", "the run to compare with (default: the first of two)")
    option(sub, "--truth", str, "FILE.tum|gps|auto", _TRUTH)
    _add_truth_options(sub)
    text = "also write the report of RUN with what changed: closures gained and lost, both trajectories"
    option(sub, "-o --output", parser.output_file, "FILE.html", text)
    text = "exit status 1 where a change fails this, as 'recall<-0.01' or 'seconds>20%%'; repeatable"
    option(sub, "--fail-on", str, "LIMIT", text, action="append", default=[])
    sub = add("export", export, threads)
    option(sub, "run", place, "RUN")
    sub.add_argument("--format", required=True, choices=_FORMATS, help="format to write")
    text = "file to write, a folder for colmap and nerfstudio; - writes a file to stdout"
    option(sub, "-o --output", parser.output_or_stdout, "FILE|FOLDER|-", text, required=True)
    option(sub, "--log", place, "LOG", "the run's log, where it has moved since")
    option(sub, "--truth", str, "FILE.tum|auto", "truth that rrd shows beside the solution")
    sub = add("open", open_run)
    option(sub, "run", place, "RUN")
    text = "viewer (default: rerun where it is installed, else the report in the browser)"
    sub.add_argument("--with", choices=_VIEWERS, dest="viewer", help=text)
    sub = add("optimize", optimize)
    option(sub, "graph", parser.local_file, "GRAPH.g2o")
    option(sub, "-o --output", _graph, "OUT", "the graph at its solved poses, as g2o", required=True)
    sub.add_argument("--method", choices=_SOLVERS, default="gnc", help="robust method, or lm (default: gnc)")
    text = "report whether the solution is the global optimum of the accepted edges"
    sub.add_argument("--certify", action="store_true", help=text)


def _add_explain(sub: argparse.ArgumentParser) -> None:
    option(sub, "run", place, "RUN")
    which: Any = sub.add_mutually_exclusive_group(required=True)
    text = "row of closures.parquet, or its two keyframes, by row or by stamp in ns"
    option(which, "--closure", _closure, "K|QUERY:MATCH", text)
    flag(which, "--worst", "the used closure that the solved trajectory is furthest from, else the nearest miss")
    option(sub, "-o --output", parser.output_file, "PICTURE.png", "picture, .png or .svg (default: RUN/closure-K.png)")
    option(sub, "--log", place, "LOG", "the run's log, where it has moved since")
    flag(sub, "--no-picture", "no picture; the log is not needed")


def _graph(text: str) -> Path:
    return place(text) if "://" in text else parser.output_file(text)


def _closure(text: str) -> tuple[int, ...]:
    parts = text.split(":")
    if len(parts) > 2 or not all(re.fullmatch("-?[0-9]{1,20}", part) for part in parts):
        what = "must be a row of closures.parquet (K), or two keyframes by row or stamp in ns (QUERY:MATCH)"
        raise argparse.ArgumentTypeError(f"{what}, not {text!r}")
    return tuple(int(part) for part in parts)
