"""The program from Python: what it offers, from a script, a notebook and a worker process, by path and by URL."""

from __future__ import annotations

import inspect
import multiprocessing
import os
import pydoc
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

import vplog
from tests.batch.test_batch import QUICK
from tests.maps.bucket import serving
from vplog import errors
from vplog.execution.process_pool import OwnProcesses
from vplog.results.run_record import read_run_json
from vplog.storage.remote_path import local_output, located

TOP = Path(vplog.__file__).parents[1]


def python(*arguments: object, folder: Path) -> str:
    """What a program says on stdout."""
    environment = {**os.environ, "PYTHONPATH": str(TOP), "MPLBACKEND": "Agg"}
    command = [sys.executable, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


class Tiny(NamedTuple):
    log: Path
    truth: Path


@pytest.fixture(scope="module")
def tiny(tiny_drives: list[Path]) -> Tiny:
    return Tiny(tiny_drives[0] / "drive.mcap", tiny_drives[0] / "truth.tum")


@pytest.fixture(scope="module")
def run(tiny: Tiny, tmp_path_factory: pytest.TempPathFactory) -> vplog.RunFolder:
    """Named by text. It has pictures of its keyframes."""
    out = tmp_path_factory.mktemp("run") / "out"
    return vplog.run(str(tiny.log), str(out), settings=[*QUICK, "pictures.megapixels=0.15"], threads=2)


def test_import_loads_the_version_alone() -> None:
    code = "import sys, vplog; print(*[name for name in sys.modules if name.startswith('vplog.')])"
    assert python("-c", code, folder=TOP).split() == ["vplog.version"]


def test_every_public_name_is_there_and_documented() -> None:
    assert sorted(vplog.__all__) == list(vplog.__all__)
    assert set(vplog.__all__) <= set(dir(vplog))
    for name in vplog.__all__:
        assert inspect.getdoc(getattr(vplog, name)), name
    with pytest.raises(AttributeError, match="no attribute 'rum'"):
        _ = vplog.rum


def test_help_reads_as_documentation() -> None:
    text = pydoc.plain(pydoc.render_doc(vplog))
    for name in ("run", "open_log", "open_run", "evaluate", "compare", "batch", "open_map", "localize"):
        assert f"\n    {name}(" in text, name
    assert "Unpack" not in text


def test_errors_are_one_tree_and_all_of_it_is_public() -> None:
    tree = {name: one for name, one in vars(errors).items() if inspect.isclass(one) and issubclass(one, Exception)}
    assert all(issubclass(one, vplog.VplogError) for one in tree.values())
    assert {name for name in vplog.__all__ if name.endswith("Error")} == set(tree)


@pytest.mark.parametrize("name", ["run", "evaluate", "batch"])
def test_a_folder_of_the_same_name_leaves_the_function(name: str) -> None:
    __import__(f"vplog.{name}")
    assert inspect.isfunction(getattr(vplog, name))
    assert inspect.ismodule(sys.modules[f"vplog.{name}"])


def test_tables_are_those_of_the_files(run: vplog.RunFolder) -> None:
    again = vplog.open_run(run.folder)
    assert again.record == read_run_json(run.folder / "run.json")
    assert again.record["counts"] == run.record["counts"]
    assert len(run.trajectory) == run.record["counts"]["odometry"]
    assert len(run.closures) == run.record["counts"]["candidates"]
    assert run.keyframes.equals(again.table("keyframes"))
    assert len(run.table("descriptors")) == len(run.keyframes)
    frame = run.closures.to_pandas()
    assert list(frame.columns) == run.closures.column_names
    with pytest.raises(vplog.ResultError, match="Did you mean closures"):
        run.table("clsures")


def test_images_are_those_of_the_run_or_of_the_log(run: vplog.RunFolder, tiny: Tiny) -> None:
    rows = [len(run.keyframes) - 1, 0, 3]
    reduced, recorded = dict(run.images(rows)), dict(run.images(rows, from_log=True))
    assert list(reduced) == list(recorded) == sorted(rows)
    log = vplog.open_log(tiny.log)
    for row, stamp_ns in zip(sorted(rows), np.asarray(run.keyframes["stamp_ns"])[sorted(rows)], strict=True):
        [frame] = log.frames(np.array([stamp_ns]))
        np.testing.assert_array_equal(recorded[row], frame.decode().image)
        assert reduced[row].dtype == np.uint8
        assert reduced[row].shape[0] <= recorded[row].shape[0]
    with pytest.raises(vplog.ResultError, match="has keyframes 0"):
        list(run.images([len(run.keyframes)]))


def test_a_run_folder_does_not_lead_out_of_itself(tmp_path: Path) -> None:
    record = {"drives": [{"name": "a", "folder": "../other"}]}
    with pytest.raises(vplog.ResultError, match="outside its folder"):
        _ = vplog.RunFolder(tmp_path, record).drives


def test_paths_and_urls_give_the_same(tiny: Tiny, run: vplog.RunFolder) -> None:
    with serving():
        for name, source in (("log.mcap", tiny.log), ("truth.tum", tiny.truth)):
            with local_output(located(f"s3://bucket/{name}")) as out:
                out.write_bytes(source.read_bytes())
        sent = vplog.run("s3://bucket/log.mcap", "s3://bucket/run", settings=run.record["settings"], threads=1)
        assert sent.trajectory.equals(run.trajectory)
        again = vplog.open_run("s3://bucket/run")
        assert again.closures.equals(run.closures)
        found = vplog.evaluate("s3://bucket/run", "s3://bucket/truth.tum")
        copy = again.folder
        del again
        assert not copy.exists()
    assert found["ate_after"] == vplog.evaluate(run, tiny.truth)["ate_after"]
    assert found["ate_after"] == vplog.evaluate(str(run.folder), str(tiny.truth))["ate_after"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda log, out: vplog.run(log, out, "defalt"), "Did you mean default"),
        (lambda log, out: vplog.run(log, out, settings={"features.max_featurs": 3}), "Did you mean"),
        (lambda log, out: vplog.run(log, out, topics={"imag": "/a"}), "Did you mean"),
        (lambda log, out: vplog.run([], out), "No log is given"),
        (lambda log, out: vplog.run(f"{log}.none", out), "no such file"),
        (lambda log, out: vplog.run(log, "ftp://a/b"), "ftp:// is not known"),
        (lambda _, out: vplog.open_run(out), "run.json"),
        (lambda _, out: vplog.open_map(out), "map"),
        (lambda log, out: vplog.compare(log, methods="bob", truth="poses", min_gap=3), "bob"),
        (lambda log, out: vplog.batch([log, log], out, topics={"odometry_file": "a.tum"}), "is of one drive"),
    ],
)
def test_mistakes_are_one_line(call: Any, message: str, tiny: Tiny, tmp_path: Path) -> None:
    with pytest.raises(vplog.VplogError, match=message) as error:
        call(tiny.log, tmp_path / "out")
    assert "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()


def test_files_among_the_topics_are_found_from_any_folder(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from vplog.api import _topics

    monkeypatch.chdir(tmp_path)
    choice = _topics({"image": "/a", "odometry_file": "poses.tum"})
    assert choice is not None
    assert (choice.image, choice.odometry_file) == ("/a", tmp_path / "poses.tum")


def test_from_a_worker_process(tiny: Tiny, run: vplog.RunFolder, tmp_path: Path) -> None:
    """The function goes there by name, and what it gives comes back."""
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        done = pool.submit(vplog.run, tiny.log, tmp_path / "run", settings=QUICK).result()
    assert done.trajectory.equals(run.trajectory)
    with pytest.raises(vplog.ResultError, match="from_log=True"):  # of a run without pictures
        list(done.images())


def test_a_daemonic_process_is_refused_a_batch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(multiprocessing.current_process()._config, "daemon", True)  # pyrefly: ignore[missing-attribute]
    with pytest.raises(vplog.SettingsError, match="daemonic"):
        OwnProcesses(1).begin()
