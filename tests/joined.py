"""Three drives run together: the small drive cut in two, and one from elsewhere."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mcap.reader import make_reader
from mcap.writer import Writer

from vplog.demo import SMALL, make_drive
from vplog.execution.execution import Execution
from vplog.pipeline import load_pipeline
from vplog.sessions.joint_run import run_joint

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.demo.record import Drive

QUICK = ("features.max_features=600", "library.size=12", "pictures.closures=0", "pictures.megapixels=0")
LOGS = {"before": "before.mcap", "after": "after.mcap", "drive": "elsewhere/drive.mcap"}
"""File of each drive, beside the folder of the joint run."""


def cut(log: Path, at_ns: int, folder: Path, mounted: bool = True) -> list[Path]:
    """The messages of a log before and from a time on, in a file each; one knows how the camera sits, or both."""
    files = [folder / "before.mcap", folder / "after.mcap"]
    with log.open("rb") as stream, files[0].open("wb") as one, files[1].open("wb") as other:
        writers = [Writer(one), Writer(other)]
        channels: list[dict[int, int]] = [{}, {}]
        for writer in writers:
            writer.start(profile="ros2")
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            for part, writer in enumerate(writers):
                if not (mounted and channel.topic == "/tf_static") and (message.log_time >= at_ns) != bool(part):
                    continue
                if channel.id not in channels[part]:
                    known = writer.register_schema(schema.name, schema.encoding, schema.data)
                    channels[part][channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known)
                writer.add_message(channels[part][channel.id], message.log_time, message.data, message.publish_time)
        for writer in writers:
            writer.finish()
    return files


def run_together(drive: Drive, folder: Path) -> Path:
    """The folder of the joint run."""
    parts = cut(drive.log, int(drive.stamp_ns[-14]), folder)
    elsewhere = make_drive(folder / "elsewhere", SMALL.model_copy(update={"seed": SMALL.seed + 1})).log
    run_joint([*parts, elsewhere], folder / "out", load_pipeline("default", QUICK), execution=Execution(2))
    return folder / "out"
