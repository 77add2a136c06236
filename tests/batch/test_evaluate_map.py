"""Drives of a map against their truth."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from evo.core import sync
from evo.core.trajectory import PoseTrajectory3D
from evo.tools import file_interface

import vplog
from vplog.batch.evaluate_map import _means
from vplog.errors import SettingsError, TruthError
from vplog.evaluate.trajectory import ate
from vplog.evaluate.truth import read_truth
from vplog.geometry import se3
from vplog.maps.joining.joint_record import read_joint, write_joint
from vplog.maps.storage import map_store
from vplog.results import tables
from vplog.verbs.evaluate_run import FIGURES, broken_limits
from vplog.verbs.limits import read_limits

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said

    from vplog.verbs.demo.record import Demo


def test_drives_are_evaluated_each_and_by_tag(
    halves: Path, drive: Demo, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    root, manifest = Path(shutil.copytree(halves, tmp_path / "map")), tmp_path / "drives.csv"
    tags = {"before": {"light": "day"}, "after": {"light": "night", "vehicle": "v1"}}
    with map_store.writing(root) as store:
        for name, own in tags.items():
            map_store.annotate(store, name, {"tags": own, "truth": str(drive.truth)})
    found = verb("evaluate", root, "--json").json
    alone = {name: vplog.evaluate(root / f"runs/drive={name}", drive.truth) for name in tags}
    figures = {one["drive"]: (one["tags"], one["false_closures"], one["error"]) for one in found["drives"]}
    assert figures == {name: (tags[name], one["closures"]["accepted_false"], "") for name, one in alone.items()}
    ates = {one["drive"]: one["ate_m"] for one in found["drives"]}
    groups = found["groups"]
    assert groups["light=night"] == {**groups["vehicle=v1"], "ate_m": ates["after"]}
    assert (
        groups["all"]["ate_m"]
        == groups[f"vplog {vplog.__version__}"]["ate_m"]
        == pytest.approx(np.mean([*ates.values()]))
    )

    manifest.write_text(f"log,name,truth\nx.mcap,before,{drive.truth}\ny.mcap,,gps\n")
    limit = f"ate_m>{min(ates['before'], alone['before']['ate_after']['rmse_m']) / 2}"
    said = verb("evaluate", root, "--truth", manifest, "--fail-on", limit, "--fail-on", "false_closures>99")
    assert (said.code, said.err.count("before has ate_m")) == (1, 1)
    assert "after has" not in said.err
    assert f"{manifest} names no truth of it." in said.out
    positions = tmp_path / "positions.tum"
    lines = [line.split() for line in drive.truth.read_text().splitlines() if not line.startswith("#")]
    positions.write_text("".join(f"{' '.join(line[:4])} 0 0 0 1\n" for line in lines))
    said = verb("evaluate", root, "--truth", positions)
    assert [f"vplog: warning: {', '.join(sorted(alone))}: The truth has no orient" in said.err, said.code] == [True, 0]
    manifest.write_text("log,truth\nx.mcap,gps\n")
    assert "No drive of" in verb("evaluate", root, "--truth", manifest).error
    run = (root / "runs/drive=before", "--truth", drive.truth, "--fail-on")
    assert verb("evaluate", *run, "ate_m<0").code == 0
    assert "The run has ate_m" in verb("evaluate", *run, limit).err
    assert "Did you mean ate_m?" in verb("evaluate", *run, "ate_n<0").error
    assert "is no limit" in verb("evaluate", *run, "ate_m<5%").error


def joint_trajectories(root: Path) -> dict[str, Path]:
    """The tables of the drives of the only component of a map."""
    found = sorted(root.glob("joint/component=*/drive=*/trajectory.parquet"))
    return {path.parent.name.removeprefix("drive="): path for path in found}


def evo_ates(root: Path, truth: Path) -> list[float]:
    """ATE of all joint trajectories and of each, all with the alignment of all that evo finds."""
    paths = joint_trajectories(root)
    parts = [tables.read_trajectory(path)[0] for path in paths.values()]
    parts.sort(key=lambda part: int(part.stamp_ns[0]))
    poses = PoseTrajectory3D(
        poses_se3=[pose for part in parts for pose in part.world_from_body],
        timestamps=np.concatenate([part.stamp_ns for part in parts]) / 1e9,
    )
    reference, estimate = sync.associate_trajectories(file_interface.read_tum_trajectory_file(truth), poses)
    estimate.align(reference)
    error = np.linalg.norm(estimate.positions_xyz - reference.positions_xyz, axis=1)
    stamps = estimate.timestamps
    rows = [(stamps >= part.stamp_ns[0] / 1e9) & (stamps <= part.stamp_ns[-1] / 1e9) for part in parts]
    return [float(np.sqrt((error[one] ** 2).mean())) for one in (slice(None), *rows)]


@pytest.mark.parametrize("shift_m", [0.0, 5.0])
def test_joined_drives_are_scored_by_their_joint_poses_in_one_alignment(
    shift_m: float, halves: Path, drive: Demo, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    """A drive that the joint graph puts elsewhere counts as wrong, though each drive by itself is as good as before."""
    root = Path(shutil.copytree(halves, tmp_path / "map"))
    path = joint_trajectories(root)["after"]
    after, odometry = tables.read_trajectory(path)
    moved = replace(after, world_from_body=se3.pose(np.eye(3), np.array([0.0, 0.0, shift_m])) @ after.world_from_body)
    tables.write_trajectory(path, moved, odometry, tables.TableMetadata({}, ""))
    found = vplog.evaluate(root, drive.truth)
    [component] = found["components"]
    ates = {one["drive"]: one["ate_m"] for one in found["drives"]}
    assert [component["ate_after"]["rmse_m"], ates["before"], ates["after"]] == pytest.approx(
        evo_ates(root, drive.truth)
    )
    assert (max(ates.values()) > 1.0) == (shift_m > 0.0)
    [joins] = root.glob("joint/component=*/joins.parquet")
    [(pair, ledger)] = tables.read_joins(joins).items()
    [judged] = component["joins"]
    assert (judged["query_drive"], judged["match_drive"]) == pair
    assert judged["accepted"] == ledger.accepted.sum() > 0
    assert judged["accepted_false"] == 0
    counts = [(one["between"], one["false_between"]) for one in found["drives"]]
    assert counts == [(judged["accepted"], 0)] * 2
    said = verb("evaluate", root, "--truth", drive.truth).out
    assert f"{judged['accepted']} closures between them, {judged['accepted_true']} true, 0 false" in said


def test_joined_drives_with_truths_of_their_own_are_aligned_each(halves: Path, drive: Demo, tmp_path: Path) -> None:
    """Nobody says that two files have one frame."""
    manifest, other = tmp_path / "drives.csv", Path(shutil.copy(drive.truth, tmp_path / "other.tum"))
    manifest.write_text(f"log,name,truth\nx.mcap,before,{drive.truth}\ny.mcap,after,{other}\n")
    found = vplog.evaluate(halves, manifest)
    assert found["components"] == []
    known = read_truth(drive.truth)
    for one in found["drives"]:
        joint = tables.read_trajectory(joint_trajectories(halves)[one["drive"]])[0]
        assert one["ate_m"] == pytest.approx(ate(joint, known).rmse_m)
        assert any("another truth" in warning for warning in one["warnings"])
        assert one["false_between"] is None


def test_closures_between_drives_are_counted_wherever_a_map_is_shown(
    halves: Path, drive: Demo, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    root = Path(shutil.copytree(halves, tmp_path / "map"))
    [joins] = root.glob("joint/component=*/joins.parquet")
    [ledger] = tables.read_joins(joins).values()
    expected = {"before": ledger.accepted.sum(), "after": ledger.accepted.sum()}
    info = verb("map", "info", root, "--json").json
    assert {one["drive"]: one["between"] for one in info["drives"]} == expected
    assert f"by {expected['after']} closures" in verb("map", "info", root).out
    [component] = verb("map", "join", root, "--json").json["components"]
    assert component["between"] == expected
    logs = [halves.parent / f"{name}.mcap" for name in expected]
    batch = verb("batch", *logs, "-o", root, "--json").json
    assert {one["drive"]: one["between"] for one in batch["drives"]} == expected
    assert f"by {expected['after']} closures" in verb("batch", *logs, "-o", root).out
    alone = verb("batch", *logs, "-o", root, "--no-join", "--json").json
    assert [one["between"] for one in alone["drives"]] == [None, None]
    joint_trajectories(root)["after"].write_bytes(b"damaged")
    rows = {one["drive"]: one for one in vplog.evaluate(root, drive.truth)["drives"]}
    assert "trajectory.parquet is damaged. Join the drives again" in rows["after"]["error"]
    assert rows["before"]["ate_m"] < 1.0
    joins.write_bytes(b"damaged")
    assert "joins.parquet is damaged. Join the drives again" in verb("evaluate", root, "--truth", drive.truth).error
    record = read_joint(root)
    for one in record["groups"]:
        del one["components"][0]["between"]  # as an older vplog wrote it
    write_joint(root, record)
    assert [one["between"] for one in verb("map", "info", root, "--json").json["drives"]] == [None, None]
    assert verb("map", "info", root).code == 0


def test_a_moved_log_is_followed_and_a_damaged_drive_is_named(halves: Path, drive: Demo, tmp_path: Path) -> None:
    root, moved, manifest = Path(shutil.copytree(halves, tmp_path / "map")), tmp_path / "moved.mcap", tmp_path / "d.csv"
    with map_store.writing(root) as store:
        map_store.annotate(store, "after", {"log": str(moved)})
    manifest.write_text(f"log,name,truth\n{moved},x,gps\ny.mcap,after,{drive.truth}\n")
    with pytest.raises(TruthError, match=f"Of after: The log of the run {moved} no longer exists"):
        vplog.evaluate(root, manifest)
    (root / "runs/drive=before/keyframes.parquet").unlink()
    manifest.write_text(f"log,truth\n{moved},{drive.truth}\n")
    rows = vplog.evaluate(root, manifest)["drives"]
    assert [(one["drive"], bool(one["error"])) for one in rows] == [("before", True), ("after", False)]


def test_where_no_closure_was_judged_none_is_known_to_be_false() -> None:
    assert _means([dict.fromkeys(FIGURES, None)])["false_closures"] is None


def test_a_limit_of_what_a_truth_without_orientations_leaves_open_says_so() -> None:
    """A TUM file was given, of positions alone."""
    found = {"ate_after": {"rmse_m": 1.0}, "rpe_after": None, "drift_after": None, "closures": None}
    for name in ("rpe_m", "drift_m"):
        with pytest.raises(SettingsError, match=f"{name} is not known.* one with orientations"):
            broken_limits(found, read_limits([f"{name}>1"], FIGURES, "a run"))
