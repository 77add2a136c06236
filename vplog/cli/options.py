"""What arguments mean: the types of the command line, and the options that several verbs share."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.errors import VplogError

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.logs import TopicChoice
    from vplog.pipeline import Pipeline

STDOUT = Path("-")
_ROLES = ("image", "depth", "right", "camera-info", "odometry", "gps")
_MOST = 10**9
"""Largest count an option may have: far above any drive, and whole in every number type."""


def place(text: str) -> Path:
    """What an argument names: a path, or what is read and written by URL (vplog/storage/remote_path.py)."""
    if "://" not in text:
        return _path(text)
    from vplog.storage.remote_path import located

    try:
        return located(text)
    except VplogError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _local(what: str) -> Callable[[str], Path]:
    def path(text: str) -> Path:
        if "://" in text:
            raise argparse.ArgumentTypeError(f"must be a local {what}, not {text}")
        return _path(text)

    return path


local = _local("folder")
"""A folder that is written to bit by bit, which storage by URL is not."""
local_file = _local("file")
"""A single file that is written by those who do not send what they write."""


def local_file_or_stdout(text: str) -> Path:
    """A single local file, or `-`, the standard output."""
    return STDOUT if text == "-" else local_file(text)


def _path(text: str) -> Path:
    if text == "-":
        raise argparse.ArgumentTypeError("stdin and stdout cannot be used here: name a path (./- for a file named -)")
    return Path(text)


def option(
    sub: argparse.ArgumentParser,
    names: str,
    kind: Callable[[str], Any],
    metavar: str,
    text: str | None = None,
    **more: Any,
) -> None:
    """An option, or an argument, that takes a value."""
    sub.add_argument(*names.split(), type=kind, metavar=metavar, help=text, **more)


def flag(sub: argparse.ArgumentParser, name: str, text: str, dest: str | None = None) -> None:
    """An option without a value; with `dest` it switches that off."""
    sub.add_argument(
        name, action="store_false" if dest else "store_true", dest=dest or name[2:].replace("-", "_"), help=text
    )


def pipeline_of(arguments: argparse.Namespace) -> Pipeline:
    from vplog.pipeline import load_pipeline

    return load_pipeline(arguments.pipeline, arguments.set)


def topics_of(arguments: argparse.Namespace) -> TopicChoice:
    from vplog.logs import TopicChoice

    chosen = {role.replace("-", "_"): getattr(arguments, f"{role.replace('-', '_')}_topic") for role in _ROLES}
    return TopicChoice(**chosen, odometry_file=arguments.odometry_file, calibration_file=arguments.calibration_file)


def topic_options() -> argparse.ArgumentParser:
    topics = argparse.ArgumentParser(add_help=False)
    for role in _ROLES:
        option(topics, f"--{role}-topic", str, "TOPIC", f"use this {role} topic")
    option(topics, "--odometry-file", resolved, "FILE.tum", "use these poses as the odometry")
    text = "camera_info YAML, Kalibr camchain or EuRoC sensor.yaml"
    option(topics, "--calibration", resolved, "FILE.yaml", text, dest="calibration_file")
    return topics


def settings_options(unless_given: str | None, called: str) -> argparse.ArgumentParser:
    """`--pipeline`, with what it is unless given, and what help calls that; and `--set`."""
    settings = argparse.ArgumentParser(add_help=False)
    option(settings, "--pipeline", str, "P", f"shipped name or .yaml file (default: {called})", default=unless_given)
    option(settings, "--set", str, "A.B=C", "change one setting; repeatable", action="append", default=[])
    return settings


def resolved(text: str) -> Path:
    """A file that run.json names, so that the run is understood from any folder."""
    return Path(text).resolve()


def at_least(least: int) -> Callable[[str], int]:
    def whole_number(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if not least <= value <= _MOST:
            raise argparse.ArgumentTypeError(f"must be a whole number from {least} to {_MOST}, not {text!r}")
        return value

    return whole_number


at_least_one = at_least(1)


def _number(fits: Callable[[float], bool], words: str) -> Callable[[str], float]:
    def number(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not fits(value):
            raise argparse.ArgumentTypeError(f"must be a number {words}, not {text!r}")
        return value

    return number


not_negative = _number(lambda value: 0 <= value < math.inf, "of 0 or more")
positive = _number(lambda value: 0 < value < math.inf, "above 0")
