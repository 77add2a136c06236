"""Several drives in one map, on the small drive cut in two and on one from elsewhere."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import vplog
from tests.joined import QUICK, cut
from vplog.data import Trajectory
from vplog.evaluate.truth import read_truth
from vplog.geometry import se3
from vplog.geometry.tum import write_tum
from vplog.results import tables
from vplog.results.run_record import read_run_json, write_run_json
from vplog.run.provenance import OWN_LIBRARY
from vplog.verbs.evaluate_run import evaluate

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo


def test_the_halves_of_a_drive_are_put_together_and_a_drive_from_elsewhere_is_not(joint: Path, drive: Demo) -> None:
    record = read_run_json(joint / "run.json")
    assert record["finished"] is True
    assert [found["drives"] for found in record["maps"]] == [["before", "after"], ["drive"]]
    ties = {(tie["query_drive"], tie["match_drive"]): tie for tie in record["joins"]}
    assert ties["after", "before"]["kept"] >= 3
    assert ties["drive", "before"]["kept"] == ties["drive", "after"]["kept"] == 0
    assert any("drive has too few closures with other drives" in warning for warning in record["warnings"])

    known = read_truth(drive.truth)
    poses = {name: tables.read_keyframes(joint / name / "joint_keyframes.parquet") for name in ("before", "after")}
    first, _ = poses["before"]
    true_first = se3.interpolate_at(known.stamp_ns, known.world_from_body, first.stamp_ns[:1])[0]
    for keyframes, world_from_body in poses.values():
        true = se3.interpolate_at(known.stamp_ns, known.world_from_body, keyframes.stamp_ns)
        away = se3.between(poses["before"][1][0], world_from_body)[:, :3, 3]
        away -= se3.between(true_first, true)[:, :3, 3]
        assert np.linalg.norm(away, axis=1).max() < 1.5
    assert not (joint / "drive" / "joint_keyframes.parquet").exists()
    assert {path.name for path in joint.rglob(".*")} == {".cache"}


def test_a_killed_run_of_several_drives_is_gone_on_with(joint: Path, tmp_path: Path, verb: Callable[..., Said]) -> None:
    whole = read_run_json(joint / "run.json")
    out = shutil.copytree(joint, tmp_path / "out")
    asked = {**whole, "finished": False, "topics": {}, "drives": None, "library": {"from": OWN_LIBRARY}}
    (out / ".cache" / "run.json").write_text(json.dumps(asked))
    (out / "run.json").unlink()
    assert f"vplog run --resume -o {out}" in verb("evaluate", out, "--truth", "gps").error
    (out / "run.json").write_text(json.dumps({**whole, "drives": [*whole["drives"], {"folder": "gone"}]}))
    shutil.rmtree(out / ".cache" / "after")  # not come to yet
    (out / "gone").mkdir()
    stale = [out / "map7.g2o", out / "drive" / "joint_keyframes.parquet", out / "gone" / "graph.g2o"]
    for file in stale:
        file.write_text("of an earlier run")
    assert "Leave out the log" in verb("run", "--resume", whole["logs"][0], "-o", out).error
    stages = {name: record["stages"]["extract"]["result"] for name, record in _resumed(verb, out).items()}
    assert stages == {"before": "reused", "after": "computed", "drive": "reused"}
    assert tables_of(out) == tables_of(joint)
    assert not (out / "gone").exists()
    assert not (out / ".cache" / "run.json").exists()
    assert read_run_json(out / "after" / "run.json")["library"]["from"] == str(out / "library")


def _resumed(verb: Callable[..., Said], out: Path) -> dict[str, Any]:
    """run.json of each drive."""
    told = verb("run", "--resume", "-o", out, "--json").json
    return {drive["name"]: read_run_json(out / drive["folder"] / "run.json") for drive in told["drives"]}


def tables_of(out: Path) -> dict[str, bytes]:
    files = [*out.rglob("*.parquet"), *out.glob("*.g2o"), *out.rglob("*.tum")]
    return {file.relative_to(out).as_posix(): file.read_bytes() for file in files}


def test_odometry_of_a_drive_in_a_map_is_that_of_its_run(joint: Path) -> None:
    """To the last bit: it is not read back from a table of quaternions."""
    for name in ("before", "after"):
        alone, mapped = (pq.read_table(joint / name / f"{prefix}trajectory.parquet") for prefix in ("", "joint_"))
        columns = ["stamp_ns", *(column for column in alone.column_names if column.startswith("odom_"))]
        assert len(columns) > 7
        assert mapped.select(columns).equals(alone.select(columns))


def test_the_ledger_names_both_drives(joint: Path) -> None:
    table = pq.read_table(joint / "joins.parquet").to_pylist()
    assert {(row["query_drive"], row["match_drive"]) for row in table} <= {
        ("after", "before"), ("drive", "before"), ("drive", "after"),
    }  # fmt: skip
    kept = [row for row in table if row["weight"] == 1]
    assert len(kept) >= 3
    assert all(row["verdict"] == "accepted" and row["shared_references"] for row in kept)


def test_from_python_a_joint_run_has_a_run_for_each_drive(joint: Path) -> None:
    found = vplog.open_run(joint)
    assert list(found.drives) == [one["name"] for one in found.record["drives"]]
    drive = found.drives["before"]
    assert drive.table("joint_trajectory").schema.names == drive.trajectory.schema.names
    assert {"query_drive", "match_drive"} <= set(found.table("joins").column_names)
    with pytest.raises(vplog.ResultError, match="Give one of them"):
        _ = found.trajectory


def test_a_joint_run_is_evaluated_map_by_map(joint: Path, drive: Demo, verb: Callable[..., Said]) -> None:
    found = evaluate(joint, str(drive.truth))
    assert [len(one["drives"]) for one in found["maps"]] == [2, 1]
    assert found["maps"][0]["ate_after"]["rmse_m"] < 1.5
    pairs = {(pair["query_drive"], pair["match_drive"]): pair for pair in found["joins"]}
    joined = pairs["after", "before"]
    record = read_run_json(joint / "run.json")
    kept = {(tie["query_drive"], tie["match_drive"]): tie["kept"] for tie in record["joins"]}
    assert joined["accepted"] + joined["not_judged"] == kept["after", "before"]
    assert joined["precision"] == 1.0
    assert joined["criterion"]["distance_m"] == 6.0
    for one in found["maps"][0]["drives"]:
        assert one["closures"]["accepted_false"] == 0
        assert one["ate_after"]["alignment"] == "SE(3)"
    said = verb("evaluate", joint, "--truth", drive.truth).out
    assert "as one trajectory" in said
    assert "after to before:" in said
    assert "several drives" in verb("evaluate", joint, "--truth", "gps").error


def test_a_drive_that_the_truth_does_not_cover_is_named(
    joint: Path, drive: Demo, verb: Callable[..., Said], tmp_path: Path
) -> None:
    first_ns = int(tables.read_trajectory(joint / "after" / "trajectory.parquet")[0].stamp_ns[0])
    known = read_truth(drive.truth)
    rows = known.stamp_ns < first_ns
    write_tum(tmp_path / "short.tum", Trajectory(known.stamp_ns[rows], known.world_from_body[rows]))
    said = verb("evaluate", joint, "--truth", tmp_path / "short.tum")
    assert "after is left out" in said.err
    assert "before: " in said.out
    assert "before: The truth has no orientations" not in said.err
    identity = np.tile(np.eye(4), (len(known.stamp_ns), 1, 1))
    identity[:, :3, 3] = known.world_from_body[:, :3, 3]
    write_tum(tmp_path / "positions.tum", Trajectory(known.stamp_ns, identity))
    said = verb("evaluate", joint, "--truth", tmp_path / "positions.tum")
    assert said.err.count("before, after, drive: The truth has no orientations") == 1


def test_drives_of_a_map_at_the_same_time_need_a_truth_each(joint: Path, drive: Demo, tmp_path: Path) -> None:
    out = shutil.copytree(joint, tmp_path / "out")
    record = read_run_json(out / "run.json")
    record["maps"] = [{**record["maps"][0], "drives": ["before", "after", "drive"]}]
    write_run_json(out / "run.json", record)
    with pytest.raises(vplog.TruthError, match=r"before and drive of .* at the same time"):
        evaluate(out, str(drive.truth))


def test_verbs_of_one_drive_say_which_there_are(joint: Path, tmp_path: Path, verb: Callable[..., Said]) -> None:
    out = str(tmp_path / "out")
    for asked in (
        ("export", joint, "--format", "tum", "-o", out), ("report", joint), ("explain", joint, "--worst"),
        ("map", "export", joint, "-o", out),
    ):  # fmt: skip
        assert f"{joint} holds 3 drives. Give one of them: {joint}/before" in verb(*asked).error


def test_gps_of_several_drives_is_refused(drive: Demo, tmp_path: Path, verb: Callable[..., Said]) -> None:
    assert "one drive at a time" in verb("run", drive.log, drive.log, "-o", tmp_path, "--gps").error


def test_the_parts_of_one_recording_are_one_drive(drive: Demo, tmp_path: Path, verb: Callable[..., Said]) -> None:
    before, after = cut(drive.log, int(drive.stamp_ns[-14]), tmp_path, mounted=False)
    options = [f"--set={one}" for one in (*QUICK, "propose.per_query=2")]
    told = verb("run", after, before, "--one-drive", "-o", tmp_path / "run", "--threads", 2, "--json", *options).json
    assert told["counts"]["frames"] == len(drive.stamp_ns)
    assert sorted(told["inputs"]) == ["after.mcap", "before.mcap"]
    assert verb("evaluate", tmp_path / "run", "--truth", "gps", "--json").json["ate_after"]["rmse_m"] > 0
