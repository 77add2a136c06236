"""A finished run in other tools' formats, each read back by the tool that owns it; what cannot be is one line."""

from __future__ import annotations

import importlib.util
import json
import shutil
import struct
import sys
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import duckdb
import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.rerun import rerun
from tests.results.example import read_map
from vplog.data import Gps, Trajectory, Verdict
from vplog.geometry import geodesy, se3
from vplog.places.bobb import BobbSettings, BobbState
from vplog.places.bobb_paper import PaperBobbSettings, PaperBobbState
from vplog.results import tables
from vplog.results.contracts import LAYOUTS
from vplog.results.mcap_read import read_pictures, read_topics
from vplog.results.messages import loop_closure_class
from vplog.results.poses import write_kitti
from vplog.verbs.export import FORMATS

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.data import Floats
    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]


@pytest.fixture
def exported(verb: Verb, finished: Path, tmp_path: Path) -> Callable[[str], Path]:
    """Export the run in a format; the file."""

    def write(kind: str) -> Path:
        path = tmp_path / f"run.{kind}"
        found = verb("export", finished, "--format", kind, "-o", path, "--json").json
        assert found["written"][0] == str(path)
        return path

    return write


def after(folder: Path) -> tuple[Any, Floats]:
    trajectory, _ = tables.read_trajectory(folder / "trajectory.parquet")
    return trajectory.stamp_ns, trajectory.world_from_body


@pytest.mark.parametrize("kind", ["tum", "euroc"])
def test_evo_reads_stamped_poses(exported: Callable[[str], Path], finished: Path, kind: str) -> None:
    from evo.tools import file_interface

    read = {"tum": file_interface.read_tum_trajectory_file, "euroc": file_interface.read_euroc_csv_trajectory}[kind]
    found = read(str(exported(kind)))
    stamp_ns, poses = after(finished)
    np.testing.assert_allclose(found.timestamps, stamp_ns / 1e9, rtol=0, atol=1e-6)
    np.testing.assert_allclose(found.poses_se3, poses, atol=1e-8)


def test_evo_reads_kitti_poses_and_their_times_lie_beside(exported: Callable[[str], Path], finished: Path) -> None:
    from evo.tools import file_interface

    path = exported("kitti")
    stamp_ns, poses = after(finished)
    found = file_interface.read_kitti_poses_file(str(path))
    np.testing.assert_allclose(found.poses_se3, poses, atol=1e-6)
    lines = (path.parent / "run.times.txt").read_text().split()
    assert [int(line.replace(".", "")) for line in lines] == stamp_ns.tolist()


def test_steps_are_whole_far_from_the_origin(tmp_path: Path) -> None:
    """UTM's northings need more than the digits of a float."""
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, :3, 3] = [[691234.5, 5412345.5 + 0.013 * row, 500.0] for row in range(50)]
    write_kitti(tmp_path / "a.txt", Trajectory(np.arange(50), poses))
    found = np.loadtxt(tmp_path / "a.txt").reshape(-1, 3, 4)[:, :, 3]
    np.testing.assert_allclose(found, poses[:, :3, 3], atol=1e-4, rtol=0)
    near = (poses[:, :3, 3] - se3.far_origin(poses)).astype(np.float32)
    np.testing.assert_allclose(np.diff(near[:, 1]), 0.013, atol=1e-4)
    assert not se3.far_origin(np.tile(np.eye(4), (2, 1, 1))).any()


def test_gtsam_reads_the_graph(exported: Callable[[str], Path], finished: Path) -> None:
    import gtsam

    path = exported("g2o")
    assert path.read_bytes() == (finished / "graph.g2o").read_bytes()
    graph, values = gtsam.readG2o(str(path), True)
    _, world = tables.read_keyframes(finished / "keyframes.parquet")
    edges, _, _ = tables.read_edges(finished / "edges.parquet", world)
    assert values.size() == len(world)
    assert graph.size() == len(edges.kind)
    for row in (0, len(world) - 1):
        np.testing.assert_allclose(values.atPose3(row).matrix(), world[row], atol=1e-6)


def enu(where: Floats, origin: tuple[float, float, float]) -> Floats:
    """(T, 3) m about an origin, of longitudes, latitudes and altitudes: by the way in, not the way out."""
    all_rows = np.vstack([np.array([[origin[1], origin[0], origin[2]]]), where])
    unknown = np.full((len(all_rows), 3, 3), np.nan)
    gps = Gps(np.arange(len(all_rows)), all_rows[:, 1], all_rows[:, 0], all_rows[:, 2], unknown)
    return geodesy.local_enu(gps).enu_m[1:]


def test_geojson_is_the_path_on_earth(exported: Callable[[str], Path], finished: Path) -> None:
    tree = json.loads(exported("geojson").read_text())
    assert tree["type"] == "FeatureCollection"
    line, *closures = tree["features"]
    assert line["geometry"]["type"] == "LineString"
    where = np.array(line["geometry"]["coordinates"])
    _, world = tables.read_keyframes(finished / "keyframes.parquet")
    found = enu(where, (where[0, 1], where[0, 0], where[0, 2]))
    steps = np.linalg.norm(np.diff(found, axis=0), axis=1)
    np.testing.assert_allclose(steps, np.linalg.norm(np.diff(world[:, :3, 3], axis=0), axis=1), atol=3e-3)
    ledger = tables.read_closures(finished / "closures.parquet")
    accepted = [row for row, verdict in enumerate(ledger.verdict) if verdict is Verdict.ACCEPTED]
    assert [one["properties"]["closure"] for one in closures] == accepted
    row = closures[0]["properties"]
    ends = closures[0]["geometry"]["coordinates"]
    assert ends == [line["geometry"]["coordinates"][row[name]] for name in ("match", "query")]


def test_geoparquet_says_where_every_sample_is(exported: Callable[[str], Path], finished: Path) -> None:
    """By the specification 1.1.0: the header's required keys, WKB of Point Z, the box that holds them all."""
    path = exported("geoparquet")
    table = pq.read_table(path)
    about = json.loads(table.schema.metadata[b"geo"])
    assert (about["version"], about["primary_column"]) == ("1.1.0", "geometry")
    column = about["columns"]["geometry"]
    assert (column["encoding"], column["geometry_types"]) == ("WKB", ["Point Z"])
    points = np.array([struct.unpack("<BIddd", one) for one in table["geometry"].to_pylist()])
    assert set(map(tuple, points[:, :2])) == {(1.0, 1001.0)}
    where = points[:, 2:]
    np.testing.assert_allclose(column["bbox"], [*where.min(0), *where.max(0)])
    stamp_ns, poses = after(finished)
    assert table["stamp_ns"].to_pylist() == stamp_ns.tolist()
    found = enu(where, (where[0, 1], where[0, 0], where[0, 2]))
    turn, _ = se3.umeyama(poses[:, :3, 3], found)
    np.testing.assert_allclose(se3.transform(turn, poses[:, :3, 3]), found, atol=1e-4)
    [(rows,)] = duckdb.execute("select count(*) from read_parquet(?)", [str(path)]).fetchall()
    assert rows == len(stamp_ns)


def test_kml_has_the_lines_of_geojson(exported: Callable[[str], Path]) -> None:
    tree = json.loads(exported("geojson").read_text())
    names = {"k": "http://www.opengis.net/kml/2.2"}
    marks = ElementTree.fromstring(exported("kml").read_text()).findall("k:Document/k:Placemark", names)  # noqa: S314
    assert len(marks) == len(tree["features"])
    for mark, feature in zip(marks, tree["features"], strict=True):
        found = [one.split(",") for one in str(mark.findtext("k:LineString/k:coordinates", None, names)).split()]
        expected = np.array(feature["geometry"]["coordinates"])[:, :2]
        np.testing.assert_allclose(np.array(found, float), expected, atol=1e-8)


def test_utm_is_the_path_in_metres(exported: Callable[[str], Path], finished: Path) -> None:
    lines = [line.split(",") for line in exported("utm").read_text().splitlines()]
    assert lines[0] == ["stamp_ns", "easting_m", "northing_m", "altitude_m", "zone"]
    stamp_ns, poses = after(finished)
    assert [int(line[0]) for line in lines[1:]] == stamp_ns.tolist()
    metres = np.array([line[1:4] for line in lines[1:]], float)
    steps = [np.linalg.norm(np.diff(one, axis=0), axis=1) for one in (metres, poses[:, :3, 3])]
    # the scale of the projection is .9996 to 1.001 within a zone
    np.testing.assert_allclose(steps[0], steps[1], rtol=1.1e-3, atol=4e-3)
    assert len({line[4] for line in lines[1:]}) == 1


@pytest.mark.skipif(importlib.util.find_spec("rerun_cli") is None, reason="rerun-sdk is not installed")
def test_rerun_reads_its_own_with_its_blueprint(verb: Verb, drive: Demo, finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "run.rrd"
    assert verb("export", finished, "--format", "rrd", "-o", path, "--truth", drive.truth).code == 0
    rerun(tmp_path, "rrd", "verify", str(path))
    printed = rerun(tmp_path, "rrd", "print", str(path))
    chunks = printed.splitlines()
    assert "BlueprintActivationCommand" in printed
    assert sum("ViewBlueprint:class_identifier" in chunk for chunk in chunks) == 5  # all have something to show
    keyframes, _ = tables.read_keyframes(finished / "keyframes.parquet")
    accepted = int(tables.read_closures(finished / "closures.parquet").accepted.sum())
    for entity, rows, component in (
        ("/map/path/odometry", 1, "LineStrips3D:strips"),
        ("/map/path/optimised", 1, "LineStrips3D:strips"),
        ("/map/closures/accepted", 1, "LineStrips3D:strips"),
        ("/earth/optimised", 1, "GeoLineStrings:line_strings"),
        ("/map/body", len(keyframes.stamp_ns), "Transform3D:translation"),
        ("/map/body/camera", 1, "Pinhole:image_from_camera"),
        ("/map/body/camera/image", len(keyframes.stamp_ns), "EncodedImage:blob"),
        ("/map/path/truth", 1, "LineStrips3D:strips"),
        ("/closures/picture", len(read_pictures(finished / "result.mcap").pictures), "EncodedImage:blob"),
        ("/errors/sigma/after", accepted, "Scalars:scalars"),
        ("/errors/distance/odometry", len(keyframes.stamp_ns), "Scalars:scalars"),
        ("/errors/distance/truth", len(keyframes.stamp_ns), "Scalars:scalars"),
    ):
        found = [int(c.split("with ")[1].split()[0]) for c in chunks if f"- {entity} -" in c and component in c]
        assert sum(found) == rows, entity


def test_a_recording_that_cannot_be_written_leaves_the_one_before(verb: Verb, finished: Path, tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    pytest.importorskip("rerun")
    path = tmp_path / "run.rrd"
    path.write_bytes(b"before")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))  # files stop growing as on a full disk
    try:
        said = verb("export", finished, "--format", "rrd", "-o", path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert f"Cannot write {path}: " in said.error
    assert [path.read_bytes(), *tmp_path.iterdir()] == [b"before", path]
    missing = tmp_path / "missing" / "run.rrd"
    assert f"Cannot write {missing}: " in verb("export", finished, "--format", "rrd", "-o", missing).error


def test_without_rerun_one_line_says_what_to_install(
    verb: Verb, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    said = verb("export", finished, "--format", "rrd", "-o", tmp_path / "a.rrd")
    assert "pip install rerun-sdk" in said.error
    assert not list(tmp_path.iterdir())


def test_a_foxglove_layout_shows_topics_of_the_run_in_panels_that_lie_in_one_tree(
    exported: Callable[[str], Path], finished: Path
) -> None:
    """As Foxglove's own layouts: a config for every panel of the tree, `Type!id`, and no topic that is not there."""
    tree = json.loads(exported("foxglove-layout").read_text())
    panels = tree["configById"]

    def leaves(node: Any) -> list[str]:
        if isinstance(node, str):
            return [node]
        assert set(node) == {"direction", "first", "second", "splitPercentage"}
        assert node["direction"] in ("row", "column")
        return leaves(node["first"]) + leaves(node["second"])

    assert sorted(leaves(tree["layout"])) == sorted(panels)
    assert {name.partition("!")[0] for name in panels} == {"3D", "Image", "Plot"}
    topics = read_topics(finished / "result.mcap")
    images = [one["imageMode"] for name, one in panels.items() if name.startswith("Image!")]
    assert {one["imageTopic"] for one in images} == {one for one in topics if one.endswith(("/image", "/picture"))}
    named = [*panels["3D!map"]["topics"], *(one["calibrationTopic"] for one in images if "calibrationTopic" in one)]
    named += [topic for one in images for topic in one.get("annotations", ())]
    assert set(named) <= set(topics)
    fields = loop_closure_class().DESCRIPTOR.fields_by_name
    for path in (series["value"] for one in panels.values() for series in one.get("paths", ())):
        assert path.startswith("/loop_closures{")
        assert path.rpartition(".")[2] in fields


def test_a_truth_is_for_rerun_alone(verb: Verb, finished: Path, tmp_path: Path) -> None:
    said = verb("export", finished, "--format", "tum", "-o", tmp_path / "a.tum", "--truth", "auto")
    assert "--truth is shown in rrd alone" in said.error
    if importlib.util.find_spec("rerun"):
        said = verb("export", finished, "--format", "rrd", "-o", tmp_path / "a.rrd", "--truth", "auto")
        assert "its fixes alone, which rrd does not show. Give --truth FILE.tum" in said.error
        assert not (tmp_path / "a.rrd").exists()


def test_a_run_without_fixes_has_no_place_on_earth(verb: Verb, finished: Path, tmp_path: Path) -> None:
    from vplog.data import Camera
    from vplog.results.mcap import McapExtras, write_mcap

    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    (folder / "result.mcap").unlink()
    keyframes, world = tables.read_keyframes(folder / "keyframes.parquet")
    graph, _, _ = tables.read_edges(folder / "edges.parquet", world)
    ledger = tables.read_closures(folder / "closures.parquet")
    camera = Camera("c", None, "none", np.zeros(0), 4, 4, np.eye(4))
    write_mcap(
        folder / "result.mcap", keyframes, world, graph, ledger, tables.TableMetadata({}, ""), McapExtras(camera=camera)
    )
    for kind in ("geojson", "geoparquet", "kml", "utm"):
        assert (
            "fewer than three satellite fixes" in verb("export", folder, "--format", kind, "-o", tmp_path / "x").error
        )
    assert verb("export", folder, "--format", "tum", "-o", tmp_path / "x").code == 0


@pytest.mark.parametrize("kind", FORMATS)
def test_same_run_same_bytes(exported: Callable[[str], Path], kind: str) -> None:
    if kind == "rrd":
        pytest.skip("rerun's own writer puts times of writing into its file")
    assert exported(kind).read_bytes() == exported(kind).read_bytes()


def test_what_is_no_run_is_one_line(verb: Verb, tmp_path: Path, finished: Path) -> None:
    assert "run.json" in verb("export", tmp_path, "--format", "tum", "-o", tmp_path / "a").error
    assert "run.json" in verb("map", "export", finished, tmp_path, "-o", tmp_path / "a").error
    where = tmp_path / "not" / "there" / "a.tum"
    assert str(where) in verb("export", finished, "--format", "tum", "-o", where).error


# A map of places


def test_a_map_holds_the_places_of_a_run(verb: Verb, finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "map.parquet"
    found = verb("map", "export", finished, "-o", path, "--json").json
    column, library = tables.read_descriptors(finished / "descriptors.parquet")
    keyframes, world = tables.read_keyframes(finished / "keyframes.parquet")
    assert found == {
        "written": str(path),
        "left_out": [],
        "drives": [keyframes.drive],
        "places": len(column),
        "library": library,
    }
    table, places = read_map(path, column.type)
    assert places.equals(column)
    assert table["stamp_ns"].to_pylist() == keyframes.stamp_ns.tolist()
    np.testing.assert_allclose(table["world_tx"].to_numpy(), world[:, 0, 3], atol=1e-12)
    # fixed width throughout, which DuckDB sees as it is
    query = 'select drive, keyframe, octet_length(boxes), octet_length("references") from read_parquet(?)'
    rows = duckdb.execute(query, [str(path)]).fetchall()
    assert rows == [(keyframes.drive, row, 90, 20) for row in range(len(column))]


def test_a_map_of_drives_needs_one_library_and_names_of_their_own(verb: Verb, finished: Path, tmp_path: Path) -> None:
    other, column = tmp_path / "other", tables.read_descriptors(finished / "descriptors.parquet")[0]
    shutil.copytree(finished, other)
    assert "named" in verb("map", "export", finished, other, "-o", tmp_path / "m").error
    table = pq.read_table(other / "keyframes.parquet")
    names = table.schema.get_field_index("drive")
    renamed = table.set_column(names, table.schema.field(names), [["another"] * len(table)])
    pq.write_table(renamed, other / "keyframes.parquet")
    found = verb("map", "export", finished, other, "-o", tmp_path / "m", "--json").json
    assert (len(found["drives"]), found["places"]) == (2, 2 * len(column))
    both, places = read_map(tmp_path / "m", column.type)
    assert places.slice(len(column)).equals(column)
    assert both["drive"].to_pylist()[-1] == "another"
    table = pq.read_table(other / "descriptors.parquet")
    strange = table.replace_schema_metadata({**(table.schema.metadata or {}), b"vplog.library": b"other"})
    pq.write_table(strange, other / "descriptors.parquet")
    assert "one library" in verb("map", "export", finished, other, "-o", tmp_path / "m").error


def test_layouts_in_the_contract_are_those_of_the_code() -> None:
    kinds: list[tuple[str, type[Any], Any]] = [
        ("bobb", BobbState, BobbSettings()),
        ("bobb_paper", PaperBobbState, PaperBobbSettings()),
    ]
    for name, state, settings in kinds:
        made: Any = object.__new__(state)
        made.settings = settings
        told = [(part, text.replace("J", str(settings.references)).replace("I", str(settings.boxes)))
                for part, text, _ in LAYOUTS[name]]  # fmt: skip
        for part, (column, text) in zip(made.arrow_type, told, strict=True):
            base, _, length = text.removesuffix("]").partition("[")
            assert (part.name, str(part.type.value_type)) == (column, base)
            assert part.type.list_size == np.prod([int(one) for one in length.split("*")])


# Standard output


@pytest.mark.parametrize("kind", FORMATS)
def test_a_dash_is_standard_output(
    kind: str, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfdbinary: pytest.CaptureFixture
) -> None:
    """The bytes that a file would have."""
    from vplog.cli import main

    if kind == "rrd":
        pytest.importorskip("rerun")
    monkeypatch.chdir(tmp_path)
    for name in ("file", "-"):
        capfdbinary.readouterr()
        with pytest.raises(SystemExit) as stop:
            main.main(["export", str(finished), "--format", kind, "-o", name])
        written, said = capfdbinary.readouterr()
        assert (stop.value.code, said) == (0, b"")
    if kind == "rrd":  # which holds the time of its making
        assert written[:4] == (tmp_path / "file").read_bytes()[:4]
    else:
        assert written == (tmp_path / "file").read_bytes()
    assert not (tmp_path / "-").exists()


def test_a_dash_is_refused_where_it_cannot_be(
    verb: Verb, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "--json" in verb("export", finished, "--format", "tum", "-o", "-", "--json").error
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    assert "terminal" in verb("export", finished, "--format", "geoparquet", "-o", "-").error
    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    for words in (
        f"report {finished} -o -", f"explain {finished} --closure 0 -o -", "info A --html -", "run A -o -",
        "library A -o -", "demo -o -", "schemas -o -", "optimize A.g2o -o -", "batch A -o -", "map export M -o -",
        "map query M A -o -", "map merge M -o -", "map redescribe M --library L -o -", "compare A --methods bobb "
        "--truth index -o -", "study A --truth index -o -", "run - -o OUT", "info -", "evaluate - --truth gps",
    ):  # fmt: skip
        said = verb(*words.split())
        assert (said.code, said.out) == (2, ""), words
        assert "name a path" in said.err, words
    assert "-" in verb("evaluate", finished, "--truth", "-").error
    assert not list(tmp_path.iterdir())


def test_a_damaged_graph_is_refused(finished: Path, verb: Verb, tmp_path: Path) -> None:
    """It is text: one flipped bit is another number."""
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    data = bytearray((run / "graph.g2o").read_bytes())
    data[data.rindex(b"1")] ^= 2
    (run / "graph.g2o").write_bytes(data)
    said = verb("export", run, "--format", "g2o", "-o", tmp_path / "graph")
    assert "graph.g2o does not have the sha256" in said.error
    assert not (tmp_path / "graph").exists()
