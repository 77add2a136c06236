"""Recognisers of other packages: found by entry point, imported when they are named, and held to the contract."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from vplog import logs
from vplog.benchmark.compare import CompareOptions, compare
from vplog.benchmark.recogniser_specs import read_method
from vplog.benchmark.study.experiments import StudyOptions
from vplog.benchmark.study.study import study
from vplog.errors import LibraryError, SettingsError
from vplog.evaluate.place_truth import TruthChoice
from vplog.execution.execution import Execution
from vplog.features.sift import SiftSettings
from vplog.pipeline import Pipeline, pipeline_from, run
from vplog.places.library_files import read_library_record
from vplog.run.cache.code_hash import code_of
from vplog.run.reference_library import build_library, check_library

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vplog.verbs.demo.record import Demo

NAME = "mean_colours"
SMALL = {"features": {"max_features": 100, "max_megapixels": 0.02}, "library": {"size": 4}}
EXAMPLE = Path(__file__).parents[2] / "examples" / "recogniser_plugin"


def install(folder: Path, monkeypatch: pytest.MonkeyPatch, module: str, points: dict[str, str]) -> None:
    """A distribution as pip leaves it: its module, and its metadata with entry points."""
    about = folder / f"{module}-1.0.dist-info"
    about.mkdir(parents=True)
    (about / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    lines = [f"{name} = {value}" for name, value in points.items()]
    (about / "entry_points.txt").write_text("\n".join(["[vplog.recognisers]", *lines, ""]))
    monkeypatch.syspath_prepend(str(folder))


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    folder = tmp_path / "site"
    install(folder, monkeypatch, NAME, {NAME: f"{NAME}:MeanColours"})
    (folder / f"{NAME}.py").write_text((EXAMPLE / f"{NAME}.py").read_text())
    yield
    sys.modules.pop(NAME, None)


@pytest.mark.usefixtures("installed")
def test_a_plugin_is_imported_when_it_is_named_and_not_before() -> None:
    Pipeline.read({"places": {"kind": "bobb"}}, "mine.yaml")
    read_method("gist", Pipeline())
    with pytest.raises(SettingsError, match=f"Methods: .*{NAME}"):
        read_method("nothing", Pipeline())
    assert NAME not in sys.modules
    found = read_method(f"{NAME}:blocks=2", Pipeline())
    assert NAME in sys.modules
    assert (found.kind, found.blocks) == (NAME, 2)
    with pytest.raises(SettingsError, match=r"Settings: kind, blocks\.$"):
        read_method(f"{NAME}:rows=2", Pipeline())


@pytest.mark.usefixtures("installed")
def test_compare_names_it_as_its_own(tiny: Demo, tmp_path: Path) -> None:
    options = CompareOptions(library_size=3, min_gap=5, out=tmp_path / "out")
    pipeline = Pipeline(features=SiftSettings(max_features=60, max_megapixels=0.01))
    done = compare(tiny.log, None, [NAME, f"{NAME}:blocks=2"], TruthChoice("poses"), pipeline, options)
    assert [one["bits"] for one in done.record["methods"].values()] == [8 * 8 * 3 * 16, 2 * 2 * 3 * 16]
    scores = np.load(next((tmp_path / "out").glob("scores-01*.npz")))["scores"]
    assert np.isfinite(scores[-1, :-5]).all()


@pytest.mark.usefixtures("installed")
def test_it_learns_from_whole_images_in_a_comparison(tiny: Demo, monkeypatch: pytest.MonkeyPatch) -> None:
    settings, seen = type(read_method(NAME, Pipeline())), list[Any]()
    monkeypatch.setattr(settings, "learn", lambda _, references, __: seen.extend(references) or 1 / 0)
    with pytest.raises(ZeroDivisionError):
        compare(tiny.log, None, [NAME], None, Pipeline(), CompareOptions(library_size=2, min_gap=5))
    assert [one.image.shape for one in seen] == [(one.features.height, one.features.width) for one in seen]


@pytest.mark.usefixtures("installed")
def test_a_study_depends_on_its_code(tiny: Demo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vplog.benchmark.study.study.code_of", lambda *modules: 1 / (NAME not in modules))
    options = StudyOptions(methods=[NAME], min_gap=5, only=["pairs"])
    with pytest.raises(ZeroDivisionError):
        study([tiny.log], TruthChoice("poses"), Pipeline(), tmp_path / "out", options)


@pytest.mark.usefixtures("installed")
def test_a_run_with_a_library_of_a_plugin(tiny: Demo, tmp_path: Path) -> None:
    pipeline = pipeline_from({**SMALL, "places": {"kind": NAME, "blocks": 2}}, "mine.yaml")
    build_library([tiny.log], tmp_path / "library", pipeline)
    again = Pipeline.read(pipeline.model_dump(mode="json"), "run.json")
    assert again == pipeline
    check_library(tmp_path / "library", again)
    others = pipeline_from({**SMALL, "places": {"kind": NAME, "blocks": 4}}, "mine.yaml")
    with pytest.raises(LibraryError, match=r"places\.blocks=2, and this run has 4"):
        check_library(tmp_path / "library", others)
    done = run(tiny.log, tmp_path / "out", pipeline, tmp_path / "library")
    assert done is not None
    assert read_library_record(tmp_path / "library")["hash"] == done.state.hash
    assert np.array(done.places).shape[1] == 12


@pytest.mark.parametrize(
    ("points", "code", "message"),
    [
        ({"other": "broken:X"}, "", "No plug-in 'broken'"),
        (
            {"broken": "broken:X"},
            "raise RuntimeError('no licence')",
            r"of broken \(broken:X\) cannot be imp",
        ),
        ({"broken": "broken:X"}, "", "cannot be imported: AttributeError"),
        ({"broken": "nowhere:X"}, "", "cannot be imported: ModuleNotFoundError"),
        ({"broken": "broken:X"}, "X = 3", "no subclass of vplog.settings.Settings"),
        (
            {"broken": "broken:X"},
            "from vplog.settings import Settings\n"
            "class X(Settings):\n    kind: str = 'x'\n    def learn(self): ...\n    def load(self): ...\n",
            "no field `kind` whose default is 'broken'",
        ),
    ],
)
def test_what_is_no_recogniser_is_one_line(
    points: dict[str, str], code: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path / "site", monkeypatch, "broken", points)
    (tmp_path / "site" / "broken.py").write_text(code)
    tree: dict[str, Any] = {"places": {"kind": "plugin", "name": "broken"}}
    with pytest.raises(SettingsError, match=message) as caught:
        pipeline_from(tree, "mine.yaml").places.learn([], Execution())
    assert "\n" not in str(caught.value)
    sys.modules.pop("broken", None)


def test_two_packages_of_one_name_are_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("first", "second"):
        install(tmp_path / module, monkeypatch, module, {"same": f"{module}:X"})
    with pytest.raises(SettingsError, match="first and second both have a plug-in same"):
        read_method("same", Pipeline())


def test_logs_keep_colour_for_it(tiny: Demo, tmp_path: Path) -> None:
    log = logs.open(tiny.log)
    frame = next(iter(log.frames(log.stamps()[:1])))
    assert frame.decode().colour is None
    colour = frame.decode(colour=True).colour
    assert colour is not None
    assert colour.shape == (*frame.decode().image.shape, 3)


def test_all_files_of_a_plugins_package_are_its_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    package = tmp_path / "streets"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "places.py").write_text("from streets import model\n")
    (package / "model.py").write_text("SIZE = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    try:
        importlib.import_module("streets.places")
        before = code_of("streets.places")["code"]
        (package / "model.py").write_text("SIZE = 2\n")
        code_of.cache_clear()
        assert code_of("streets.places")["code"] != before
    finally:
        code_of.cache_clear()
        for name in [name for name in sys.modules if name.partition(".")[0] == "streets"]:
            del sys.modules[name]
