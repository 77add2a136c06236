"""The examples, run with what they tell the user to install, and with no more."""

from __future__ import annotations

import inspect
import json
import runpy
import shutil
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pytest

import vplog
from tests.batch.test_batch import QUICK
from tests.plain_install import TOP, requirements_in, run_in, run_scripts
from vplog.batch.worker import DriveState

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.verbs.demo.record import Demo

EXAMPLES = TOP / "examples"
CELLS = """
import json, sys
with open(sys.argv[1]) as file:
    cells = json.load(file)["cells"]
for cell in cells:
    if cell["cell_type"] == "code":
        exec("".join(cell["source"]))
"""
"""As a notebook has them: in order, in a main module that is no file."""


def requirements_of(name: str) -> list[str]:
    return requirements_in((EXAMPLES / name).read_text(encoding="utf-8"))


def test_examples(tiny: Demo, finished: Path, tmp_path: Path, environment: Callable[..., Path]) -> None:
    quick = ["features.max_features=50"]
    commands = {
        "run_and_evaluate.py": [tiny.log, tiny.truth, tmp_path / "run", *QUICK],
        "list_closures.py": [finished],
        "compare_recognisers.py": [tiny.log, "features.max_features=300"],
        "own_vectors.py": [tiny.log, tmp_path / "v.parquet", *quick],
        "plot_result.py": [finished, tmp_path / "picture.png"],
    }
    assert not any(map(requirements_of, commands))
    calls = [[EXAMPLES / name, *arguments] for name, arguments in commands.items()]
    out = run_scripts(environment(), calls, tmp_path)
    for text in ("ATE after", " accepted\n", "bovf   recall at 1", "v.parquet recall at 1"):
        assert text in out
    assert (tmp_path / "picture.png").stat().st_size > 1000
    network = [EXAMPLES / "own_network.py", tiny.log, tmp_path, *quick]
    installed = environment(*requirements_of("own_network.py"))
    assert "means.onnx recall at 1" in run_in(installed, "python", *network, folder=tmp_path)
    schedulers = {"airflow_dag.py", "dagster_assets.py"}  # they run below
    every = {path.name for path in EXAMPLES.glob("*.py")}
    assert every == {*commands, "own_network.py", "batch_and_query.py", *schedulers}


def test_a_batch_from_a_script_without_a_guard(tiny: Demo, tmp_path: Path, environment: Callable[..., Path]) -> None:
    """If the script ran again in the processes of the drives, these would fail."""
    command = [EXAMPLES / "batch_and_query.py", tmp_path / "map", tiny.log, tiny.log, *QUICK]
    lines = run_in(environment(), "python", *command, folder=tmp_path).splitlines()
    assert [line.split() for line in lines if "computed" in line] == [["drive", "computed"]]
    assert len(lines) == 10
    found = vplog.open_map(tmp_path / "map")
    assert [one["drive"] for one in found.info(check=True)["drives"]] == ["drive"]
    answers = found.query(tiny.log, 2, sequence=1)
    assert isinstance(answers.table, pa.Table)
    columns = answers.table.column_names  # the record has what decided the best ones, too
    assert answers.table.to_pylist() == [{name: one[name] for name in columns} for one in answers.record["answers"]]
    own = vplog.open_run(tmp_path / "map" / "runs" / "drive=drive")
    assert len(answers.table) == 2 * len(own.keyframes)


def test_the_notebook(environment: Callable[..., Path], tmp_path: Path) -> None:
    notebook = EXAMPLES / "tour.ipynb"
    assert requirements_in(notebook.read_text(encoding="utf-8")) == [".", "jupyterlab"]
    assert "frames" in run_in(environment(), "python", "-c", CELLS, notebook, folder=tmp_path)
    cells = json.loads(notebook.read_text(encoding="utf-8"))["cells"]
    assert not [cell for cell in cells if cell.get("outputs")], "outputs are not part of the checkout"


def test_the_plugin_passes_its_own_tests(environment: Callable[..., Path], tmp_path: Path) -> None:
    test = Path(shutil.copy(EXAMPLES / "recogniser_plugin" / "test_mean_colours.py", tmp_path))
    requirements = requirements_in(test.read_text(encoding="utf-8").partition("\npytest")[0])
    assert " passed" in run_in(environment(*requirements), "pytest", "-q", test, folder=tmp_path)


class Scheduler:
    """Stands for Airflow and for Dagster: calls what is decorated, and keeps what it answers."""

    def __init__(self) -> None:
        self.answers: dict[str, Any] = {}
        self.log = self

    def __getattr__(self, name: str) -> Any:
        """A class of Dagster: the values that it is made of."""
        return lambda **values: values

    def info(self, _: str) -> None: ...

    def asset(self, function: Callable[..., Any]) -> None:
        self.answers[function.__name__] = function(*[self] * len(inspect.signature(function).parameters))

    def task(self, function: Any = None, **_: Any) -> Any:
        if function is None:
            return self.task
        return lambda: self.answers.update({function.__name__: function()}) or self

    def __rshift__(self, _: object) -> None: ...

    def dag(self, **_: Any) -> Any:
        return lambda function: function

    def asset_check(self, **_: Any) -> Any:
        return self.asset


@pytest.mark.parametrize(
    ("name", "module", "answers"),
    [
        ("airflow_dag.py", "airflow.sdk", {"compute": 1, "check": 0.5}),
        (
            "dagster_assets.py",
            "dagster",
            {
                "fleet_map": {"metadata": {"drives": 1, "failed": 0}},
                "accuracy": {"passed": True, "metadata": {"ATE in m": "0.5"}},
            },
        ),
    ],
)
def test_examples_for_schedulers(
    name: str, module: str, answers: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the schedulers; what they call takes these arguments and answers so."""
    batch, evaluate = inspect.signature(vplog.batch), inspect.signature(vplog.evaluate)

    def computed(*arguments: Any, **more: Any) -> dict[str, Any]:
        on_drive = batch.bind(*arguments, **more).arguments.get("on_drive", lambda _: None)
        on_drive(DriveState("a", "a.mcap", "computed"))
        return {"drives": [{"drive": "a", "state": "computed", "error": ""}], "failed": 0}

    def evaluated(*arguments: Any, **more: Any) -> dict[str, Any]:
        evaluate.bind(*arguments, **more)
        return {"groups": {"all": {"ate_m": 0.5}}}

    scheduler: Any = Scheduler()
    monkeypatch.setattr(vplog, "batch", computed)
    monkeypatch.setattr(vplog, "evaluate", evaluated)
    monkeypatch.setitem(sys.modules, module.partition(".")[0], scheduler)
    monkeypatch.setitem(sys.modules, module, scheduler)
    runpy.run_path(str(EXAMPLES / name))
    assert scheduler.answers == answers
