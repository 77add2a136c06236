"""A layout for Foxglove over a run's result.mcap: the map in 3D, camera and closure pictures, residuals over time."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

from vplog.data import Floats
from vplog.results.foxglove import MAP
from vplog.results.mcap import PICTURES, REFERENCE

_HIDDEN = ("/graph/rejected",)
"""Topics of the 3D panel that are there, but not shown until they are switched on: they are many lines."""
_FOV_DEG = 45.0
"""Vertical field of view of the camera of the 3D panel, Foxglove's own default."""


def foxglove_layout(topics: Collection[str], positions_m: Floats) -> dict[str, Any]:
    """The layout that Foxglove imports: panels by id, and the tree of splits that they lie in.

    `topics` are those of the file: there is no panel for what it lacks, nor one that asks servers for tiles of a map.
    `positions_m` (N, 3) are to be in view.
    """
    panels = {"3D!map": _map(positions_m)}
    images = [one for one in topics if one.startswith("/cam/") and one.endswith("/image")]
    shown = [one for one in (*images, PICTURES, REFERENCE) if one in topics]
    panels |= {f"Image!{one.rpartition('/')[0].strip('/')}": _image(one, topics) for one in shown}
    beside = [name for name in panels if name.startswith("Image!")]
    accepted = '/loop_closures{verdict=="accepted"}'
    sigmas = {name: f"{accepted}.{name}_sigma" for name in ("residual_before", "residual_after")}
    panels["Plot!residuals"] = _plot("Residual of closures in sigma", sigmas)
    panels["Plot!inliers"] = _plot("Inliers of closures", {"inliers": f"{accepted}.inliers"})
    upper = _split("row", "3D!map", _stack(beside), 60) if beside else "3D!map"
    lower = _split("row", "Plot!residuals", "Plot!inliers", 50)
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split("column", upper, lower, 70),
    }


def _map(positions_m: Floats) -> dict[str, Any]:
    """The 3D panel, its camera south of and above the drive, looking at its middle."""
    low, high = (positions_m.min(0), positions_m.max(0)) if len(positions_m) else (positions_m.sum(0),) * 2
    distance = 1.5 * max(float((high - low).max()), 5.0)  # of the side, so that it is in view at 45 degrees
    camera = {"distance": distance, "perspective": True, "phi": 45.0, "thetaOffset": 0.0, "fovy": _FOV_DEG}
    camera |= {"target": [0, 0, 0], "targetOffset": ((low + high) / 2).tolist(), "targetOrientation": [0, 0, 0, 1]}
    points = {
        f"/path/{name}_points": {"visible": True, "colorMode": "rgba-fields"} for name in ("optimised", "odometry")
    }
    return {
        "cameraState": camera | {"near": distance / 1000, "far": 100 * distance},
        "followMode": "follow-none",
        "followTf": MAP,
        "scene": {},
        "transforms": {},
        "topics": {**points, "/graph": {"visible": True}, **{one: {"visible": False} for one in _HIDDEN}},
        "layers": {},
    }


def _image(topic: str, topics: Collection[str]) -> dict[str, Any]:
    """An Image panel, with the calibration and the annotations that stand beside its topic."""
    base = topic.rpartition("/")[0]
    mode: dict[str, Any] = {"imageTopic": topic}
    if f"{base}/calibration" in topics:
        mode["calibrationTopic"] = f"{base}/calibration"
    if f"{base}/annotations" in topics:
        mode["annotations"] = {f"{base}/annotations": {"visible": True}}
    return {"imageMode": mode, "foxglovePanelTitle": topic}


def _plot(title: str, series: dict[str, str]) -> dict[str, Any]:
    paths = [
        {"value": path, "label": label, "enabled": True, "timestampMethod": "receiveTime", "showLine": False}
        for label, path in series.items()
    ]
    return {"foxglovePanelTitle": title, "paths": paths, "xAxisVal": "timestamp", "isSynced": True, "showLegend": True}


def _split(direction: str, first: Any, second: Any, percentage: int) -> dict[str, Any]:
    return {"direction": direction, "first": first, "second": second, "splitPercentage": percentage}


def _stack(panels: list[str]) -> Any:
    """Panels below each other, of equal height."""
    return panels[0] if len(panels) == 1 else _split("column", panels[0], _stack(panels[1:]), 100 // len(panels))
