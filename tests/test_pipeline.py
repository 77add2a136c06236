"""A whole run on the small drive: every file, read back with the tools that users have."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import duckdb
import gtsam
import numpy as np
import pyarrow.parquet as pq
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from mcap.reader import make_reader

from vplog.data import Verdict
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.pipeline import load_pipeline, pipeline_schema, run
from vplog.results import tables
from vplog.results.run_record import read_run_json
from vplog.run.reference_library import build_library
from vplog.run.run_folder import CacheOptions
from vplog.verbs.evaluate_run import TruthOptions, evaluate, evaluate_poses, relative_to_references

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said

    from vplog.verbs.demo.record import Demo

TABLES = ("keyframes", "descriptors", "closures", "edges", "trajectory")
FILES = (*(f"{name}.parquet" for name in TABLES), "trajectory.tum", "graph.g2o", "result.mcap")
LIBRARY = ("library/library.json", "library/references.parquet", "library/features.parquet")
QUICK = (
    "features.max_features=250", "features.max_megapixels=0.04", "features.min_features=0", "propose.per_query=2",
    "library.size=5", "places.neighbours=8", "verify.calibration.pairs=0",
)  # fmt: skip
"""Settings for runs of which only the course matters."""
CLOSE = (*QUICK, "propose.gap_keyframes=15", "propose.gap_steps=15")
"""With closures on the tiny drive too."""


def record_of(folder: Path) -> dict[str, Any]:
    return read_run_json(folder / "run.json")


def contents(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in (*FILES, *LIBRARY)}


def columns(folder: Path, table: str) -> dict[str, np.ndarray]:
    """A table as pyarrow alone reads it; matrices are lists, or None."""
    read = pq.read_table(folder / f"{table}.parquet")
    return {name: read[name].to_numpy() for name in read.schema.names}


def test_a_run_folder_holds_every_file_and_no_scratch_but_its_cache(finished: Path) -> None:
    assert all(len(data) for data in contents(finished).values())
    assert [path.name for path in finished.rglob(".*")] == [".cache"]
    assert {path.suffix for path in (finished / ".cache").iterdir()} == {".stage", ".json"}


def test_a_run_says_how_sure_it_is(finished: Path) -> None:
    """Whether its solution is the global optimum, and of every keyframe its covariance."""
    certificate = record_of(finished)["certificate"]
    assert certificate["verdict"] == "certified"
    assert certificate["smallest_eigenvalue"] > 0
    assert "does not say whether the closures kept are true" in certificate["reason"]
    covariance = tables.read_keyframe_covariance(finished / "keyframes.parquet")
    assert not covariance[0].any()
    assert (np.linalg.eigvalsh(covariance[1:]) > 0).all()
    _, poses = tables.read_keyframes(finished / "keyframes.parquet")
    references, covariances = relative_to_references(finished, record_of(finished), poses)
    assert references[0] == 0
    np.testing.assert_allclose(next(covariances), covariance, atol=1e-8)


def test_a_run_of_before_shared_errors_were_recorded_has_no_nees(finished: Path, drive: Demo) -> None:
    record, truth = record_of(finished), str(drive.truth)
    score = evaluate_poses(finished, record, truth, TruthOptions()).record["poses"]
    assert score["nees"] > 0
    assert score["reason"] == ""
    for covariance in (None, {"sigma_factors": "?"}, {"sigma_factors": [1.0] * 4, "shared_scales": [{}]}):
        score = evaluate_poses(finished, record | {"covariance": covariance}, truth, TruthOptions()).record["poses"]
        assert score["nees"] is None
        assert "lacks the errors" in score["reason"]


def test_run_json_says_what_was_run_and_how_it_went(finished: Path, drive: Demo) -> None:
    record = record_of(finished)
    assert record["finished"] is True
    assert record["warnings"] == []
    assert record["settings"] == load_pipeline("default").model_dump(mode="json")
    assert record["inputs"] == {"drive.mcap": hashlib.sha256(drive.log.read_bytes()).hexdigest()}
    assert {"python", "numpy", "gtsam", "pyarrow"} <= record["versions"].keys()
    assert "unknown" not in record["versions"].values()
    stages = record["stages"]
    names = "read extract choose learn cover describe propose verify p_false solve write report"
    assert list(stages) == names.split()
    for stage in stages.values():
        assert stage["result"] == "computed"
        assert stage["seconds"] >= 0
        assert stage["peak_memory_mb"] > 10
    counts = record["counts"]
    assert counts["frames"] == counts["keyframes"] == len(drive.stamp_ns)
    assert counts["candidates"] == sum(counts["verdicts"].values())


def test_settings_of_a_run_give_the_run_again(finished: Path, tmp_path: Path) -> None:
    """What run.json holds is a pipeline file."""
    file = tmp_path / "again.yaml"
    file.write_text(json.dumps(record_of(finished)["settings"]))
    assert load_pipeline(str(file)) == load_pipeline("default")


@pytest.mark.usefixtures("computed_anew")
def test_the_same_bytes_from_any_number_of_threads_and_over_an_old_run(
    drive: Demo, finished: Path, tiny: Demo, tmp_path: Path
) -> None:
    """One thread and two on all that a run does, four and three on a smaller one that is run over another."""
    run(drive.log, tmp_path / "one", load_pipeline("default"), execution=Execution(1), cache=CacheOptions(use=False))
    for name, data in contents(finished).items():
        assert (tmp_path / "one" / name).read_bytes() == data, f"{name} differs between one thread and two"
    out, quick = tmp_path / "over", load_pipeline("default", CLOSE)
    run(tiny.log, out, quick, execution=Execution(3))
    three = contents(out)
    (out / ".cache" / ".extract-000000.stage.1.part").write_bytes(b"left by a run that was killed")
    run(tiny.log, out, quick, execution=Execution(4), cache=CacheOptions(use=False))
    for name, data in contents(out).items():
        assert three[name] == data, f"{name} differs between three threads and four"
    assert not (out / ".cache").exists()


def test_closures_take_out_the_drift(finished: Path, drive: Demo) -> None:
    found = evaluate(finished, str(drive.truth))
    assert found["ate_before"]["rmse_m"] > 1.5
    assert found["ate_after"]["rmse_m"] < found["ate_before"]["rmse_m"] / 5
    assert found["closures"]["recall"] > 0.7
    assert found["closures"]["opposite"] == 0


def test_gps_sees_the_drift_go_too(finished: Path) -> None:
    """The fixes have 1.5 m of noise, which stays in what they measure."""
    found = evaluate(finished, "gps")
    assert found["ate_after"]["rmse_m"] < found["ate_before"]["rmse_m"]


def test_evo_reads_the_trajectory_and_finds_the_same_error(
    finished: Path, drive: Demo, verb: Callable[..., Said]
) -> None:
    from evo.core import metrics, sync
    from evo.tools import file_interface

    said = verb("evaluate", finished, "--truth", drive.truth, "--json").json["ate_after"]
    truth, estimate = sync.associate_trajectories(
        file_interface.read_tum_trajectory_file(drive.truth),
        file_interface.read_tum_trajectory_file(finished / "trajectory.tum"),
    )
    estimate.align(truth)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((truth, estimate))
    theirs = ape.get_all_statistics()
    assert said["count"] == estimate.num_poses
    for name in ("rmse", "mean", "median", "max"):
        assert said[f"{name}_m"] == pytest.approx(theirs[name], abs=1e-6)


def test_evo_ape_says_the_same(finished: Path, drive: Demo, tmp_path: Path) -> None:
    done = subprocess.run(
        [Path(sys.executable).with_name("evo_ape"), "tum", drive.truth, finished / "trajectory.tum", "--align"],
        capture_output=True, text=True, check=True, env={**os.environ, "HOME": str(tmp_path)},
    )  # fmt: skip
    rmse = re.search(r"rmse\s+([\d.]+)", done.stdout)
    assert rmse, done.stdout
    assert float(rmse[1]) == pytest.approx(evaluate(finished, str(drive.truth))["ate_after"]["rmse_m"], abs=1e-6)


def test_trajectory_passes_through_the_keyframes(finished: Path) -> None:
    """At a keyframe's stamp, between two samples, the path is at the keyframe's solved pose."""
    trajectory, odometry = tables.read_trajectory(finished / "trajectory.parquet")
    keyframes, world_from_body = tables.read_keyframes(finished / "keyframes.parquet")
    inside = (keyframes.stamp_ns >= odometry.stamp_ns[0]) & (keyframes.stamp_ns <= odometry.stamp_ns[-1])
    stamps = keyframes.stamp_ns[inside]
    after = np.clip(np.searchsorted(odometry.stamp_ns, stamps), 1, len(odometry.stamp_ns) - 1)
    share = (stamps - odometry.stamp_ns[after - 1]) / (odometry.stamp_ns[after] - odometry.stamp_ns[after - 1])
    poses = trajectory.world_from_body
    here = se3.interpolate(poses[after - 1], poses[after], share)
    apart = se3.log(se3.between(here, world_from_body[inside]))
    moved = np.linalg.norm(world_from_body[:, :3, 3] - keyframes.odom_from_body[:, :3, 3], axis=1)
    assert inside.sum() > 40
    assert np.linalg.norm(apart[:, 3:], axis=1).max() < 0.02 < moved.max() / 10
    assert np.linalg.norm(apart[:, :3], axis=1).max() < 0.005


def test_trajectory_has_every_odometry_sample_in_both_forms(finished: Path) -> None:
    trajectory, odometry = tables.read_trajectory(finished / "trajectory.parquet")
    assert len(odometry.stamp_ns) == record_of(finished)["counts"]["odometry"]
    lines = [line.split() for line in (finished / "trajectory.tum").read_text().splitlines() if line[0] != "#"]
    assert [line[0] for line in lines] == [f"{s // 10**9}.{s % 10**9:09d}" for s in trajectory.stamp_ns.tolist()]
    positions = np.array([line[1:4] for line in lines], float)
    np.testing.assert_allclose(positions, trajectory.world_from_body[:, :3, 3], atol=1e-9)


def test_gtsam_reads_the_graph(finished: Path) -> None:
    graph, values = gtsam.readG2o(str(finished / "graph.g2o"), True)
    keyframes, edges = columns(finished, "keyframes"), columns(finished, "edges")
    assert (values.size(), graph.size()) == (len(keyframes["keyframe"]), len(edges["a"]))
    poses = np.array([values.atPose3(key).matrix() for key in range(values.size())])
    _, solved = tables.read_keyframes(finished / "keyframes.parquet")
    np.testing.assert_allclose(poses, solved, atol=1e-9)
    weights = edges["weight"]
    kept = sum(graph.at(i).error(values) for i in np.flatnonzero(weights > 0.5).tolist())
    assert kept == pytest.approx(record_of(finished)["solution"]["error_after"], rel=1e-4)


def test_duckdb_joins_the_tables(finished: Path) -> None:
    def ask(query: str) -> list[tuple[Any, ...]]:
        named = re.sub(r"\[(\w+)\]", lambda name: f"read_parquet('{finished / name[1]}.parquet')", query)
        return duckdb.connect().execute(named).fetchall()

    for table in TABLES:
        [(rows,)] = ask(f"select count(*) from [{table}]")  # noqa: S608 - names from this file
        assert rows > 0
    [(rows, wrong)] = ask(
        """select count(*), count(*) filter (q.stamp_ns != c.query_stamp_ns or m.stamp_ns != c.match_stamp_ns)
        from [closures] c join [keyframes] q on q.keyframe = c.query join [keyframes] m on m.keyframe = c.match"""
    )
    assert (rows, wrong) == (record_of(finished)["counts"]["candidates"], 0)
    [(accepted,)] = ask("select count(*) from [closures] where verdict = 'accepted'")
    [(loops,)] = ask("select count(*) from [edges] where kind = 'loop'")
    [(described,)] = ask("select count(*) from [descriptors] join [keyframes] using (keyframe, stamp_ns)")
    [(nodes,)] = ask("select count(*) from [keyframes]")
    assert accepted == loops > 0
    assert described == nodes


def test_every_candidate_obeys_the_gap(finished: Path) -> None:
    ledger, settings = columns(finished, "closures"), record_of(finished)["settings"]["propose"]
    keyframes, _ = tables.read_keyframes(finished / "keyframes.parquet")
    steps = np.linalg.norm(np.diff(keyframes.odom_from_body[:, :3, 3], axis=0), axis=1)
    path = np.concatenate([[0.0], np.cumsum(steps)])
    least_m = settings["gap_steps"] * np.median(steps)
    least_rows = min(settings["gap_keyframes"], len(path) // 4)
    query, match = ledger["query"], ledger["match"]
    assert len(query)
    assert (path[query] - path[match] >= least_m * (1 - 1e-6)).all()
    assert (query - match >= least_rows).all()
    assert (ledger["rank"] < settings["per_query"]).all()
    order = list(zip(query.tolist(), ledger["rank"].tolist(), strict=True))
    assert order == sorted(set(order)), "ordered by query, then rank, each rank once"


def test_accepted_closures_are_whole_and_the_others_are_not_in_the_graph(finished: Path) -> None:
    ledger = tables.read_closures(finished / "closures.parquet")
    accepted = np.array([verdict == Verdict.ACCEPTED for verdict in ledger.verdict])
    assert 0 < accepted.sum() < len(ledger)
    for values in (ledger.match_from_query, ledger.information, ledger.residual_before, ledger.residual_after):
        assert np.isfinite(values[accepted]).all()
    assert (np.linalg.eigvalsh(ledger.information[accepted]) > 0).all()
    assert (ledger.weight[accepted] >= 0.5).all()
    assert np.isnan(ledger.weight[~accepted]).all()
    assert np.isnan(ledger.residual_after[~accepted]).all()


def test_a_closure_that_the_solver_rejects_has_no_weight(drive: Demo, finished: Path, tmp_path: Path) -> None:
    """A gate this narrow turns away closures that are right."""
    shutil.copytree(finished / ".cache", tmp_path / ".cache")  # all but the solve is as it was
    strict = load_pipeline("default", ["solve.kind=pcm", "solve.gate_probability=0.001"])
    ledger = run(drive.log, tmp_path, strict, execution=Execution(4)).closures
    assert record_of(tmp_path)["stages"]["verify"]["result"] == "reused"
    rejected = np.array([verdict == Verdict.REJECTED_BY_SOLVER for verdict in ledger.verdict])
    assert rejected.any()
    assert (ledger.weight[rejected] == 0).all()
    assert np.isfinite(ledger.match_from_query[rejected]).all()
    assert np.isfinite(ledger.residual_after[rejected]).all()
    edges = columns(tmp_path, "edges")
    assert (edges["weight"][edges["kind"] == "loop"] == 0).sum() == rejected.sum()


def test_a_library_of_another_drive_is_used_and_named(tiny: Demo, tmp_path: Path) -> None:
    pipeline = load_pipeline("default", [*QUICK, "library.size=10"])
    state = build_library([tiny.log], tmp_path / "library", pipeline, execution=Execution(4))
    known = json.loads((tmp_path / "library" / "library.json").read_text())
    assert known["references"] == 10
    record = run(tiny.log, tmp_path / "run", pipeline, tmp_path / "library", execution=Execution(4)).record
    about = record["library"]
    assert (about["hash"], about["from"], about["references"]) == (known["hash"], str(tmp_path / "library"), 10)
    assert about["coverage"]["explained"] > 0.5
    assert state.hash == known["hash"]
    assert not (tmp_path / "run" / "library").exists()
    for name in TABLES:
        header = tables.read_metadata(tmp_path / "run" / f"{name}.parquet")
        assert header["vplog.library"] == known["hash"]
        assert json.loads(header["vplog.settings"]) == pipeline.model_dump(mode="json")
    column, named = tables.read_descriptors(tmp_path / "run" / "descriptors.parquet")
    assert named == known["hash"]
    restored = state.from_arrow(column)
    assert state.to_arrow(restored).equals(column)


def test_a_log_that_changes_while_it_is_read_has_its_report_all_the_same(
    tiny: Demo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its pictures are in the cache until the run ends, and nothing stays there."""
    log, written = Path(shutil.copy(tiny.log, tmp_path)), tables.write_trajectory

    def touched(*given: Any) -> None:
        os.utime(log, ns=(0, 0))
        written(*given)

    monkeypatch.setattr(tables, "write_trajectory", touched)
    done = run(log, tmp_path / "run", load_pipeline("default", [*CLOSE, "pictures.megapixels=0.05"]))
    assert any("changed while it was read" in text for text in done.record["warnings"])
    assert '"thumbnails":{"' in (tmp_path / "run/report.html").read_text(encoding="utf-8").replace(" ", "")
    assert not (tmp_path / "run/.cache").exists()


def test_result_mcap_decodes_by_the_schemas_it_carries(finished: Path) -> None:
    """As a viewer does it, which knows nothing of vplog."""
    classes: dict[int, Any] = {}
    messages: dict[str, list[tuple[int, Any]]] = {}
    last = 0
    with (finished / "result.mcap").open("rb") as stream:
        for schema, channel, message in make_reader(stream, validate_crcs=True).iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
            if schema.id not in classes:
                pool = descriptor_pool.DescriptorPool()
                for file in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(file)
                classes[schema.id] = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
            decoded = classes[schema.id].FromString(message.data)
            messages.setdefault(channel.topic, []).append((message.log_time, decoded))
            assert message.log_time >= last
            last = message.log_time
    keyframes, ledger = columns(finished, "keyframes"), columns(finished, "closures")
    closures = messages["/loop_closures"]
    assert len(closures) == len(ledger["query"])
    for row, (stamp_ns, message) in enumerate(closures):
        assert stamp_ns == message.timestamp.ToNanoseconds() == ledger["query_stamp_ns"][row]
        assert message.match_timestamp.ToNanoseconds() == ledger["match_stamp_ns"][row]
        assert message.verdict == ledger["verdict"][row]
        assert len(message.information) == (36 if ledger["information"][row] is not None else 0)
    assert [stamp for stamp, _ in messages["/tf"]] == keyframes["stamp_ns"].tolist()
    path = messages["/path/optimised"][-1][1]
    assert path.DESCRIPTOR.full_name == "foxglove.PosesInFrame"
    np.testing.assert_allclose([pose.position.x for pose in path.poses], keyframes["world_tx"], atol=1e-9)


def test_the_schema_of_a_pipeline_names_every_stage() -> None:
    assert set(pipeline_schema()["properties"]) == set(load_pipeline("default").model_dump())
