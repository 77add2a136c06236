"""Parts of logs, and three drives run together: the small drive cut in two, and one from elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mcap.reader import make_reader
from mcap.writer import Writer

from vplog.execution.execution import Execution
from vplog.maps.joining.joint_run import run_joint
from vplog.pipeline import load_pipeline
from vplog.verbs.demo import SMALL, make_drive

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from mcap.records import Message

    from vplog.verbs.demo.record import Demo

QUICK = (
    "features.max_features=400", "features.max_megapixels=0.05", "library.size=12", "places.neighbours=8",
    "verify.calibration.pairs=0", "pictures.closures=0", "pictures.megapixels=0",
)  # fmt: skip
LOGS = {"before": "before.mcap", "after": "after.mcap", "drive": "elsewhere/drive.mcap"}
"""File of each drive, beside the folder of the joint run."""


def rewritten(log: Path, to: Path, change: Callable[[str, Message], bytes | None]) -> Path:
    """An MCAP log with change(topic, message) as the data of every message, without those where that is None."""
    with log.open("rb") as stream, to.open("wb") as file:
        writer, channels = Writer(file), dict[int, int]()
        writer.start(profile="ros2")
        for schema, channel, message in make_reader(stream).iter_messages():
            if (data := change(channel.topic, message)) is None:
                continue
            if channel.id not in channels:
                known = 0 if schema is None else writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known)
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
        writer.finish()
    return to


def copied(log: Path, to: Path, wanted: Callable[[str, int], bool]) -> Path:
    """The messages of an MCAP log that are wanted by topic and log time (ns), in a file of their own."""
    return rewritten(log, to, lambda topic, message: message.data if wanted(topic, message.log_time) else None)


def cut(log: Path, at_ns: int, folder: Path, mounted: bool = True) -> list[Path]:
    """The messages of a log before and from a time on, in a file each; one knows how the camera sits, or both."""

    def told(topic: str) -> bool:
        return mounted and topic == "/tf_static"

    return [
        copied(log, folder / "before.mcap", lambda topic, ns: told(topic) or ns < at_ns),
        copied(log, folder / "after.mcap", lambda topic, ns: told(topic) or ns >= at_ns),
    ]


def run_together(drive: Demo, folder: Path) -> Path:
    """The folder of the joint run."""
    parts = cut(drive.log, int(drive.stamp_ns[-14]), folder)
    elsewhere = make_drive(folder / "elsewhere", SMALL.model_copy(update={"seed": SMALL.seed + 1})).log
    run_joint([*parts, elsewhere], folder / "out", load_pipeline("default", QUICK), execution=Execution(2))
    return folder / "out"
