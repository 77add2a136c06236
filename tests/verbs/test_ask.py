"""`vplog ask`: the questions that move the map most, with pictures and a file to answer in, and then the next ones."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Verdict
from vplog.results import tables
from vplog.results.run_record import read_run_json
from vplog.run.decisions import read_decisions

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said


def test_questions_are_asked_and_once_answered_the_next_ones(
    finished: Path, verb: Callable[..., Said], tmp_path: Path
) -> None:
    ask = "ask", finished, "--count", 2, "-o", tmp_path / "asked"
    first = verb(*ask, "--json").json
    closures = tables.read_closures(finished / "closures.parquet")
    keyframes, _ = tables.read_keyframes(finished / "keyframes.parquet")
    assert len(first["questions"]) == 2
    expected_m = [one["p_wrong"] * one["moved_m"] for one in first["questions"]]
    assert expected_m == sorted(expected_m, reverse=True)
    for one in first["questions"]:
        assert one["closures"][0] == one["closure"]
        assert one["query_stamp_ns"] == keyframes.stamp_ns[closures.query[one["closure"]]]
        assert one["verdict"] == closures.verdict[one["closure"]].value
        assert Path(one["picture"]).read_bytes().startswith(b"\xff\xd8")
    path = Path(first["decisions"])
    assert path == tmp_path / "asked" / "decisions.csv"
    lines = path.read_text().splitlines()
    assert [line.split(",")[2] for line in lines[1:]].count("") == 2
    assert read_decisions(path, keyframes).accepted == []

    lines[1] = lines[1].replace(",,,,", ',reject,me,today,"another, like it"')
    path.write_text("\n".join(lines))
    again = verb(*ask, "--json").json
    rows = {row for one in again["questions"] for row in one["closures"]}
    answered = first["questions"][0]["closures"]
    assert rows.isdisjoint(answered)
    assert again["decided"] == len(answered)
    words = shlex.split(again["command"])
    log, library = read_run_json(finished / "run.json")["log"], ["--decisions", str(path)]
    assert words == ["vplog", "run", log, "-o", str(finished), *library], "all settings are the defaults"
    assert '"another, like it"' in path.read_text()
    pairs = sorted((int(closures.query[row]), int(closures.match[row])) for row in answered)
    assert read_decisions(path, keyframes).rejected == pairs
    said = verb(*ask)
    assert "--decisions" in said.out
    assert str(again["questions"][0]["query_stamp_ns"]) in said.out


def test_nothing_is_asked_where_all_is_decided(finished: Path, verb: Callable[..., Said], tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    (run / "run.json").write_text(json.dumps({**read_run_json(run / "run.json"), "scale": "unknown"}))
    assert "no metres" in verb("ask", run, "-o", tmp_path / "asked", "--json").json["warnings"][0]
    closures = tables.read_closures(run / "closures.parquet")
    keyframes, _ = tables.read_keyframes(run / "keyframes.parquet")
    posed = np.isfinite(closures.match_from_query[:, 0, 0])
    closures.verdict[:] = [
        Verdict.ACCEPTED_BY_DECISION if one else verdict for one, verdict in zip(posed, closures.verdict, strict=True)
    ]
    tables.write_closures(run / "closures.parquet", closures, keyframes, tables.TableMetadata({}, ""))
    assert "no closure is left" in verb("ask", run).out
    assert len(read_decisions(run / "questions" / "decisions.csv", keyframes).accepted) == posed.sum()
    tables.write_closures(
        run / "closures.parquet", closures.rows(np.arange(0)), keyframes, tables.TableMetadata({}, "")
    )
    assert "not of one run" in verb("ask", run).error
