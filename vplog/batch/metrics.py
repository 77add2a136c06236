"""The outcome of a batch as metrics, in Prometheus's text format, as node_exporter's textfile collector reads it."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

from vplog.storage.scratch import replacing

_HELP = {
    "drives": "Drives of the last batch, by state.",
    "faults": "Failed drives of the last batch, by kind of fault.",
    "drive_seconds": "Seconds that the drives computed in the last batch took together.",
    "seconds": "Seconds that the last batch took.",
    "end_time_seconds": "End of the last batch, in seconds since 1970.",
}


def write_metrics(path: Path, found: dict[str, Any]) -> None:
    """Write the metrics of what `run_batch` answers. Raises ResultError."""
    drives = found["drives"]
    states, faults = (sorted(Counter(one[name] for one in drives if one[name]).items()) for name in ("state", "fault"))
    values: dict[str, dict[str, float]] = {
        "drives": {f'state="{state}"': count for state, count in states},
        "faults": {f'fault="{fault}"': count for fault, count in faults},
        "drive_seconds": {"": sum(one["seconds"] for one in drives)},
        "seconds": {"": found["seconds"]},
        "end_time_seconds": {"": time.time()},
    }
    name = str(found["map"]).replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")
    lines = []
    for metric, rows in values.items():
        lines += [f"# HELP vplog_batch_{metric} {_HELP[metric]}", f"# TYPE vplog_batch_{metric} gauge"]
        for label, value in rows.items():
            labels = ",".join(filter(None, (f'map="{name}"', label)))
            lines.append(f"vplog_batch_{metric}{{{labels}}} {round(value, 3)}")
    with replacing(path) as stream:
        stream.write(("\n".join(lines) + "\n").encode())
