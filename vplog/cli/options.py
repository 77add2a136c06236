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


def local(text: str) -> Path:
    """A folder that is written to bit by bit, which storage by URL is not."""
    if "://" in text:
        raise argparse.ArgumentTypeError(f"must be a local folder, not {text}")
    return _path(text)


def local_file(text: str) -> Path:
    """A single file that is written by those who do not send what they write."""
    if "://" in text:
        raise argparse.ArgumentTypeError(f"must be a local file, not {text}")
    return _path(text)


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


def at_least_one(text: str) -> int:
    return at_least(1)(text)


def not_negative(text: str) -> float:
    value = _number(text)
    if not 0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number of 0 or more, not {text!r}")
    return value


def positive(text: str) -> float:
    value = _number(text)
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"must be a number above 0, not {text!r}")
    return value


def _number(text: str) -> float:
    """NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan
