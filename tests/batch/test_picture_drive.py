"""Folders of pictures without odometry or times as drives of a map: they are found again by file name."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import pyarrow.parquet as pq
import pytest

from tests.pictures import day_and_dusk

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said

    from vplog.verbs.demo.record import Demo

FRAMES = 14
QUICK = ("--set", "features.max_features=250", "--set", "features.max_megapixels=0.06", "--set", "library.size=8")


@pytest.fixture(scope="module")
def pictures(drive: Demo, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folders `day`, whose images are in folders of their own, and `dusk`, the same views with noise."""
    root = tmp_path_factory.mktemp("pictures")
    for number, (image, dusk) in enumerate(day_and_dusk(drive.log, FRAMES)):
        for folder, picture in ((root / "day" / f"place {number}", image), (root / "dusk", dusk)):
            folder.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / f"view_{number}.png"), picture)
    return root


def test_pictures_are_put_into_a_map_and_found(pictures: Path, tmp_path: Path, verb: Callable[..., Said]) -> None:
    root = tmp_path / "map"
    said = verb("batch", pictures / "day", "-o", root, "--json", *QUICK)
    assert said.code == 0, said.err
    (found,) = said.json["drives"]
    assert (found["state"], found["keyframes"], found["error"]) == ("computed", FRAMES, "")
    assert verb("batch", pictures / "day", "-o", root, "--json", *QUICK).json["drives"][0]["state"] == "unchanged"
    answers = verb("map", "query", root, pictures / "dusk", "--top", 1, "--json").json
    assert (answers["sequence"], answers["views"]) == (1, FRAMES)
    assert not answers["warnings"]
    names = [(one["query_name"], one["match_name"]) for one in answers["answers"]]
    right = sum(match == f"place {at}/view_{at}.png" for at, (_, match) in enumerate(names))
    assert [query for query, _ in names] == [f"view_{number}.png" for number in range(FRAMES)]
    assert right >= FRAMES - 2
    assert all(one["evidence"].startswith("keypoints") for one in answers["answers"])
    assert "place 3/view_3.png" in verb("map", "query", root, pictures / "dusk").out
    assert verb("map", "info", root, "--check").code == 0
    assert verb("map", "export", root, "-o", tmp_path / "places.parquet").code == 0
    assert pq.read_metadata(tmp_path / "places.parquet").num_rows == FRAMES


def test_a_dry_run_sees_that_a_picture_has_changed(pictures: Path, tmp_path: Path, verb: Callable[..., Said]) -> None:
    folder, root = Path(shutil.copytree(pictures / "dusk", tmp_path / "dusk")), tmp_path / "map"
    command = ("batch", folder, "-o", root, "--json", *QUICK)
    assert verb(*command).code == 0
    assert verb(*command, "--dry-run").json["compute"] == 0
    shutil.copyfile(folder / "view_1.png", folder / "view_2.png")
    assert verb(*command, "--dry-run").json["compute"] == 1


def test_pictures_are_joined_with_no_drive(
    pictures: Path, drive: Demo, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    said = verb("batch", pictures / "day", pictures / "dusk", "-o", tmp_path / "map", "--json", *QUICK).json
    assert not said["joined"]["components"]
    assert sum("has no odometry" in warning for warning in said["joined"]["warnings"]) == 2
    assert verb("map", "join", tmp_path / "map").code == 0


def test_a_recording_needs_odometry_as_before(pictures: Path, verb: Callable[..., Said], tmp_path: Path) -> None:
    assert "has no odometry" in verb("run", pictures / "dusk", "-o", tmp_path / "run").error
    assert "vplog batch" in verb("info", pictures / "dusk").out
