"""The report: all it tells is in it, nothing from outside runs in it, a real browser shows it without a complaint."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import html.parser
import json
import re
import shutil
import subprocess
import sys
from html import unescape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from vplog.data import USED, Closures, Verdict
from vplog.evaluate.body_truth import BodyTruth
from vplog.evaluate.closures import score_closures
from vplog.evaluate.truth import read_truth
from vplog.loops.propose import ProposeSettings, candidate_stops
from vplog.results import mcap_read, tables
from vplog.results.report.charts import coverage, histogram, over_time
from vplog.results.report.page import TruthComparison
from vplog.results.report.page import page as write_page
from vplog.results.run_record import read_run_json
from vplog.run.decisions import read_decisions
from vplog.run.report import gather

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said

    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
HOSTILE = "</script><script>document.title='owned';console.error('owned')</script><img src=x onerror=alert(1)>"


class Page(html.parser.HTMLParser):
    """Tags, and where anything is fetched from."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.sources: list[str] = []
        self.ids: list[str] = []
        self.scripts = 0
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in ("meta", "link", "img", "path", "input", "br", "!doctype"):
            self.open.append(tag)
        self.scripts += tag == "script"
        self.sources += [value or "" for name, value in attrs if name in ("src", "href", "action")]
        self.ids += [value or "" for name, value in attrs if name == "id"]
        assert not [name for name, _ in attrs if name.startswith("on")]

    def handle_endtag(self, tag: str) -> None:
        if tag != "path":
            assert self.open.pop() == tag


def ledger(text: str) -> dict[str, Any]:
    """What the page's script works on."""
    found = re.search(r'<script type="application/json" id="audit">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


@pytest.fixture(scope="session")
def page(finished: Path) -> str:
    return (finished / "report.html").read_text(encoding="utf-8")


def test_the_page_is_whole_and_fetches_nothing(page: str) -> None:
    read = Page(page)
    assert not read.open
    assert len(set(read.ids)) == len(read.ids)
    for source in read.sources:
        assert source.startswith(("data:", "#")), source[:80]
        assert not source.startswith("#") or source[1:] in read.ids
    assert page.count("://") == 1 + len(re.findall(r'src="data:[^"]*://', page))  # the address of uPlot's sources
    assert len(page) < 10e6


def test_the_table_has_every_candidate(page: str, finished: Path) -> None:
    closures = tables.read_closures(finished / "closures.parquet")
    columns = ledger(page)["columns"]
    assert columns["row"] == list(range(len(closures)))
    assert columns["verdict"] == [verdict.value for verdict in closures.verdict]
    assert columns["inliers"] == closures.inliers.tolist()
    assert [weight is None for weight in columns["weight"]] == np.isnan(closures.weight).tolist()


def test_thumbnails_are_of_keyframes_of_closures_first(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    closures = tables.read_closures(finished / "closures.parquet")
    used = closures.accepted
    ends = set(closures.query[used].tolist()) | set(closures.match[used].tolist())
    assert ends <= set(gather(finished, {}).pictures.thumbnails)
    monkeypatch.setattr(sys.modules["vplog.run.report"], "_MOST_THUMBNAILS", 4)
    few = gather(finished, {}).pictures.thumbnails
    assert len(few) == 4
    assert set(few) <= ends
    for data in few.values():
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert 0 < image.size < 3 * 41_000


def test_every_closure_of_the_solution_has_a_view_of_its_matches(page: str, finished: Path) -> None:
    closures = tables.read_closures(finished / "closures.parquet")
    used, told = closures.of(*USED), ledger(page)
    views = {int(row): view for row, view in told["views"].items()}
    assert set(np.flatnonzero(used)) <= set(views)
    assert np.median([view["agree"] for row, view in views.items() if used[row]]) > 10
    assert len({closures.verdict[row] for row in views}) > 1  # nearest misses
    for view in views.values():
        assert len(base64.b64decode(view["lines"])) >= 4 * view["agree"]
        assert set(map(str, view["references"])) <= set(told["references"])
        assert [len(base64.b64decode(votes)) for votes in view["votes"]] in ([], [18 * 32, 18 * 32])
    record = read_run_json(finished / "run.json")["pictures"]
    assert record == {"drawn": record["drawn"], "views": len(views), "accepted_left_out": 0}


def test_the_page_holds_views_of_the_solution_first(finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vplog.results.report.page._MOST_VIEW_BYTES", 60_000)
    content = gather(finished, {})
    told = ledger(write_page(content))
    rows = [int(row) for row in told["views"]]
    assert 0 < len(rows) < len(content.pictures.views)
    assert content.closures.of(*USED)[rows].all()


def test_a_run_without_metres_has_no_length_in_metres(finished: Path) -> None:
    calibrations = read_run_json(finished / "run.json")["calibrations"]
    text = write_page(gather(finished, {"scale": "unknown", "calibrations": calibrations}))
    assert "<figcaption>Speed in units of the run/s</figcaption>" in text
    assert ledger(text)["unit"] == "units of the run"
    assert not re.search(r"[0-9.] m\b|in m\b", re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL))


def test_the_certificate_and_the_sigma_of_keyframes_are_told(page: str, finished: Path) -> None:
    assert read_run_json(finished / "run.json")["certificate"]["reason"].split(":")[0] in page
    covariance = tables.read_keyframe_covariance(finished / "keyframes.parquet")
    sigma_m = np.sqrt(np.linalg.eigvalsh(covariance[:, 3:, 3:])[:, -1])
    assert f"median {np.median(sigma_m):.3f} m, largest {sigma_m.max():.3f} m" in page


def test_lines_over_time_have_gaps_where_values_are_unknown() -> None:
    values = np.array([2.0, np.nan, 5.0])
    chart = over_time([("after", "z", values)], np.array([1.0, 2.0, 3.0]), "height", 7.0)
    assert chart is not None
    assert (chart.x, chart.lines) == ([0, 1, 2, 3, 7], [("after", "z", [None, 2, None, 5, None])])
    assert over_time([("after", "z", np.full(3, np.nan))], np.arange(3.0), "height", 2.0) is None


def test_references_are_numbered_by_their_first_use() -> None:
    chart = coverage(np.array([[7, -1], [2, 7], [-1, 9]]), np.array([0.0, 1.0, 2.0]), "references", 3.0)
    assert chart is not None
    assert chart.lines[0][2][1:-1] == [1, None, 2, 1, None, 3]
    assert coverage(np.full((2, 2), -1), np.arange(2.0), "references", 3.0) is None


def test_every_candidate_is_in_a_distribution() -> None:
    rng = np.random.default_rng(0)
    chart = histogram(rng.normal(size=50), np.r_[rng.normal(size=900), np.nan], "score", [("least", 9.0)])
    assert chart is not None
    assert [sum(filter(None, values)) for _, _, values in chart.lines] == [50, -900]
    assert chart.x[0] < 9.0 < chart.x[-1]


def drawn(text: str) -> dict[str, Any]:
    """Data of the page's charts by their label."""
    found = re.search(r'<script type="application/json" id="charts">(.*?)</script>', text, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


def test_the_drive_over_time(page: str, finished: Path) -> None:
    for name in ("Height, z in m", "Heading, yaw in degrees", "Speed in m/s", "Position, one sigma in m"):
        assert f"<figcaption>{name}</figcaption>" in page
    closures = tables.read_closures(finished / "closures.parquet")
    lines = drawn(page)["residual of closures in sigma, cut at 10"]["lines"]
    counts = {kind: sum(value is not None for value in values) for kind, _, values in lines}
    solved, used = np.isfinite(closures.residual_after), closures.of(*USED)
    assert counts == {"dot yes": (solved & used).sum(), "dot no": (solved & ~used).sum()}
    assert "error of keyframes in m" not in drawn(page)


def test_the_library_of_the_charts_is_that_of_the_lock(page: str) -> None:
    import vplog.results

    folder = Path(vplog.results.__file__).parent / "templates"
    version = json.loads((folder / "package-lock.json").read_text())["packages"]["node_modules/uplot"]["version"]
    assert f"/uPlot (v{version}) */" in (folder / "uPlot.iife.min.js").read_text()[:99]
    for line in (folder / "uPlot.sha256").read_text().splitlines():
        digest, name = line.split()
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
        assert (folder / name).read_text() in page


def test_warnings_stages_and_thresholds_are_told(page: str, finished: Path) -> None:
    record = read_run_json(finished / "run.json")
    for name in record["stages"]:
        if name != "report":  # it is written before it knows how long it took
            assert f"<td>{name}</td>" in page
    least = record["settings"]["verify"]["min_matches"]
    assert drawn(page)["feature matches"]["thresholds"] == [[f"least matches {least}", least]]
    assert sum(record["library"]["used"]) > 0
    for verdict in {Verdict(name) for name in record["counts"]["verdicts"]}:
        assert verdict.sentence in page


def test_the_page_of_a_run_and_of_its_folder_are_the_same(
    verb: Verb, page: str, finished: Path, tmp_path: Path
) -> None:
    """A run writes it from what it holds, the verb from the files."""
    assert verb("report", finished, "-o", tmp_path / "again.html").code == 0
    again = (tmp_path / "again.html").read_text(encoding="utf-8")
    assert ledger(again) == ledger(page)
    assert drawn(again)["feature matches"] == drawn(page)["feature matches"]


def test_same_run_same_bytes(verb: Verb, finished: Path, tmp_path: Path) -> None:
    files = []
    for name in ("one.html", "two.html"):
        assert verb("report", finished, "-o", tmp_path / name).code == 0
        files.append((tmp_path / name).read_bytes())
    assert files[0] == files[1]


def test_against_the_truth(verb: Verb, finished: Path, drive: Demo, tmp_path: Path) -> None:
    found = verb("report", finished, "--truth", drive.truth, "-o", tmp_path / "r.html", "--json").json
    text = (tmp_path / "r.html").read_text()
    assert found["bytes"] == (tmp_path / "r.html").stat().st_size
    assert "Precision and recall" in text
    assert "<figcaption>Error of keyframes in m</figcaption>" in text
    told = ledger(text)
    evaluation = verb("evaluate", finished, "--truth", drive.truth, "--json").json
    assert f"{evaluation['ate_after']['rmse_m']:.3f}" in text
    accepted = [verdict == "accepted" for verdict in told["columns"]["verdict"]]
    for name, count in (("true", "accepted_true"), ("same_place", "same_place")):
        yes = [one == "yes" for one in told["columns"][name]]
        assert sum(np.logical_and(yes, accepted)) == evaluation["closures"][count] > 0
    assert f"within {evaluation['closures']['criterion']['translation_m']:.2f} m and 5 deg" in text
    narrow = ("--distance-m", 0.01, "--heading-deg", 3)
    assert verb("report", finished, "--truth", drive.truth, "-o", tmp_path / "n.html", *narrow).code == 0
    assert "within 0.01 m and 3 deg" in (tmp_path / "n.html").read_text()
    assert "give --truth" in verb("report", finished, "-o", tmp_path / "n.html", *narrow).error
    gps = verb("report", finished, "--truth", "gps", "-o", tmp_path / "g.html")
    assert gps.code == 0
    assert "ATE rmse" in (tmp_path / "g.html").read_text()


@pytest.mark.parametrize("wrong", [0, 1, 3])
def test_accepted_closures_that_are_false_stand_out(finished: Path, wrong: int) -> None:
    """The legend names them, and the ledger has their truth beside the verdict."""
    verdicts = tables.read_closures(finished / "closures.parquet").verdict
    accepted = [row for row, verdict in enumerate(verdicts) if verdict is Verdict.ACCEPTED]
    true, known = np.ones(len(verdicts), bool), np.ones(len(verdicts), bool)
    true[accepted[:wrong]] = False
    known[accepted[-1]] = False
    text = write_page(gather(finished, {}, TruthComparison("truth.tum", {}, true=true, known=known)))
    assert ("closures in the solution that are false" in text) == bool(wrong)
    columns = ledger(text)["columns"]
    assert list(columns)[1:3] == ["verdict", "true"]
    assert [columns["true"][row] for row in accepted] == ["no"] * wrong + ["yes"] * (len(accepted) - 1 - wrong) + [None]


def test_the_curves_enclose_the_average_precision(finished: Path, drive: Demo) -> None:
    keyframes, _ = tables.read_keyframes(finished / "keyframes.parquet")
    closures, truth = tables.read_closures(finished / "closures.parquet"), read_truth(drive.truth)
    stop = candidate_stops(keyframes, ProposeSettings())
    score, found = score_closures(keyframes, closures, BodyTruth(truth), stop)
    for name, expected in (
        ("score", score.average_precision),
        ("inliers", score.average_precision_by_inliers),
    ):
        recall, precision, value = found.curves[name].T
        assert (np.diff(recall) >= 0).all()
        assert (np.diff(value) < 0).all()
        assert (np.diff(recall, prepend=0.0) * precision).sum() == pytest.approx(expected)


def test_pictures_come_from_the_log_where_the_run_kept_none(
    verb: Verb, finished: Path, drive: Demo, tmp_path: Path
) -> None:
    from vplog.results.mcap import write_mcap

    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    keyframes, world = tables.read_keyframes(folder / "keyframes.parquet")
    graph, _, _ = tables.read_edges(folder / "edges.parquet", world)
    closures = tables.read_closures(folder / "closures.parquet")
    (folder / "result.mcap").unlink()
    write_mcap(folder / "result.mcap", keyframes, world, graph, closures, tables.TableMetadata({}, ""))
    assert verb("report", folder).code == 0
    assert not ledger((folder / "report.html").read_text())["thumbnails"]
    assert verb("report", folder, "--log", drive.log).code == 0
    text = (folder / "report.html").read_text()
    told, views = ledger(text), mcap_read.read_pictures(finished / "result.mcap").views
    assert told["views"] == {str(row): view for row, view in views.items()}
    assert told["thumbnails"]
    (tmp_path / "empty").mkdir()
    cv2.imwrite(str(tmp_path / "empty" / "1.png"), np.zeros((80, 80), np.uint8))
    assert "stamps" in verb("report", folder, "--log", tmp_path / "empty").error


def test_damaged_and_unfinished_runs_are_one_line(verb: Verb, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    data = (folder / "result.mcap").read_bytes()
    (folder / "result.mcap").write_bytes(data[: len(data) // 2])
    assert "result.mcap cannot be read" in verb("report", folder).error
    (folder / "result.mcap").unlink()
    assert "does not exist" in verb("report", folder).error
    record = read_run_json(folder / "run.json")
    (folder / "run.json").write_text(json.dumps({**record, "finished": False}))
    assert "did not finish" in verb("report", folder).error
    assert "run.json" in verb("report", tmp_path).error


@pytest.fixture
def hostile(finished: Path, tmp_path: Path) -> Path:
    """A run whose names come from a stranger."""
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    record = read_run_json(folder / "run.json")
    record |= {"log": HOSTILE, "warnings": [HOSTILE], "noise": HOSTILE, "inputs": {HOSTILE: HOSTILE}}
    record["solution"]["reason"] = HOSTILE
    record["stages"] = {HOSTILE: {"seconds": HOSTILE}}
    (folder / "run.json").write_text(json.dumps(record))
    import pyarrow.parquet as pq

    table = pq.read_table(folder / "keyframes.parquet")
    at = table.schema.get_field_index("drive")
    pq.write_table(table.set_column(at, table.schema.field(at), [[HOSTILE] * len(table)]), folder / "keyframes.parquet")
    return folder


def test_what_strangers_wrote_is_text(verb: Verb, hostile: Path, page: str) -> None:
    assert verb("report", hostile).code == 0
    text = (hostile / "report.html").read_text()
    assert Page(text).scripts == Page(page).scripts == 4  # uPlot, two of data, ours
    assert "onerror=alert(1)&gt;" in text
    assert HOSTILE not in text


def test_losses_are_placed_in_time(verb: Verb, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    record = read_run_json(folder / "run.json")
    start = int(tables.read_keyframes(folder / "keyframes.parquet")[0].stamp_ns[0])
    spans = [[start + 1_000_000_000, start + 2_000_000_000], [start + 3_000_000_000, start + 3_500_000_000]]
    loss = {"reason": "cut", "topic": "/a<b", "messages": 450, "of": 1500, "spans_ns": spans, "detail": "no footer"}
    unknown = {"reason": "damaged_bytes", "topic": "", "messages": None, "of": None, "spans_ns": []}
    (folder / "run.json").write_text(json.dumps({**record, "losses": [loss, unknown]}))
    assert verb("report", folder).code == 0
    text = (folder / "report.html").read_text()
    assert "<td>/a&lt;b</td><td>450</td><td>1\u202f500</td><td>1.0 to 3.5</td>" in text
    assert "cut: no footer" in text
    assert "damaged_bytes" in text


def test_a_record_of_any_shape_is_shown_as_far_as_it_goes(verb: Verb, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    (folder / "run.json").write_text(
        json.dumps({"finished": True, "stages": [1], "library": {"used": "x"}, "warnings": 3})
    )
    assert verb("report", folder).code == 0
    Page((folder / "report.html").read_text())


# In a real browser


@pytest.fixture(scope="session")
def browser() -> str:
    found = [path for name in BROWSERS if (path := shutil.which(name))]
    if not found:
        pytest.skip(f"none of {', '.join(BROWSERS)} is installed")
    return found[0]


def opened(browser: str, page: Path, tmp_path: Path, *options: str) -> tuple[str, str]:
    """The page after its script has run, and what the browser's console said."""
    flags = [
        "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
        "--disable-background-networking", "--disable-component-update", f"--user-data-dir={tmp_path / 'profile'}",
        "--enable-logging=stderr", "--virtual-time-budget=2000",
    ]  # fmt: skip
    command = [browser, *flags, *options, page.as_uri()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120)
    return done.stdout, "\n".join(line for line in done.stderr.splitlines() if "CONSOLE" in line)


def driven(browser: str, page: str, tmp_path: Path, script: str, *options: str) -> Any:
    """What a script beside the page's own returns, as the page's policy would have it; no word on the console."""
    script = f"document.title = JSON.stringify((() => {{{script}}})())"
    source = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    page = page.replace("; script-src ", f"; script-src &#39;sha256-{source}&#39; ", 1)
    (tmp_path / "page.html").write_text(page.replace("</body>", f"<script>{script}</script></body>"))
    dom, console = opened(browser, tmp_path / "page.html", tmp_path, "--dump-dom", *options)
    assert not console
    found = re.search("<title>(.*?)</title>", dom, re.DOTALL)
    assert found is not None
    return json.loads(unescape(found[1]))


HELPERS = """
const $ = (id) => document.getElementById(id), shown = () => [...document.querySelectorAll("#rows tr[data-row]")];
const column = (name) => [...document.querySelectorAll("#closures th")].findIndex((th) => th.textContent === name);
const values = (name) => shown().map((tr) => tr.children[column(name)].textContent);
const set = (id, value) => {
  $(id).value = value; $(id).dispatchEvent(new Event(id === "search" ? "input" : "change"));
};
const press = (key) => document.body.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true }));
const pointer = (kind, x, y) => {
  const { left, top } = $("map").getBoundingClientRect();
  $("map").dispatchEvent(new PointerEvent(kind, { pointerId: 1, clientX: left + x, clientY: top + y, bubbles: true }));
};
$("map").setPointerCapture = () => {};
"""


def test_a_browser_fills_sorts_and_filters_the_ledger(browser: str, finished: Path, page: str, tmp_path: Path) -> None:
    closures = tables.read_closures(finished / "closures.parquet")
    least = int(np.median(closures.matches))
    found = driven(
        browser, page, tmp_path,
        f"""{HELPERS} set("filter", "accepted");
        [...document.querySelectorAll("#closures th button")].find((one) => one.textContent === "matches").click();
        const sorted = values("matches"), verdicts = values("verdict");
        set("filter", "");
        for (let n = 0; n < 40; n++) press("j");
        const box = $("ledger").getBoundingClientRect();
        const chosen = document.querySelector("[aria-selected=true]").getBoundingClientRect();
        const inView = chosen.top > box.top && chosen.bottom < box.bottom;
        $("ledger").scrollTop = 1e9; $("ledger").dispatchEvent(new Event("scroll"));
        const bottom = shown().at(-1).getBoundingClientRect().bottom - box.top - $("ledger").clientHeight;
        set("search", "matches>{least} keyframe={closures.query[-1]}");
        return [sorted, verdicts, values("row"), $("count").textContent, inView, bottom];""",
    )  # fmt: skip
    accepted = closures.of(Verdict.ACCEPTED)
    expected = sorted(closures.matches[accepted].tolist(), reverse=True)
    assert list(map(int, found[0])) == expected[: len(found[0])]
    assert len(found[0]) >= min(len(expected), 10)
    assert set(found[1]) == {"accepted"}
    at = (closures.query == closures.query[-1]) | (closures.match == closures.query[-1])
    rows = np.flatnonzero(at & (closures.matches > least))
    assert sorted(map(int, found[2])) == rows.tolist()
    assert found[3] == f"{len(rows)} of {len(closures)} candidates"
    assert found[4]
    assert abs(found[5]) < 4  # the last row ends where the box does


INNER_DOT = """() => {
  const { width, height } = document.getElementById("map"), row = 4 * width;
  const { data } = document.getElementById("map").getContext("2d").getImageData(0, 0, width, height);
  const green = (at) => data[at] === 26 && data[at + 1] === 138 && data[at + 2] === 60;
  for (let at = 3 * row; at < data.length - 3 * row; at += 4)
    if ([0, 8, -8, 2 * row, -2 * row].every((by) => green(at + by)))
      return { x: at % row / 4, y: Math.floor(at / row) };
}"""
"""Where on the map a dot of an accepted closure is."""


PAINTED = """all => all.map((one) => one.width > 99 && one.getContext("2d").getImageData(0, 0, one.width, one.height)
  .data.some((value) => value))"""
"""Whether something is drawn on each canvas."""


def test_closures_are_selected_and_rejected_and_the_next_run_knows(
    browser: str, finished: Path, drive: Demo, verb: Verb, tmp_path: Path
) -> None:
    """By mouse and keys as a person would: pan, filter, select from map, matrix, chart and ledger, reject, download."""
    sync_api = pytest.importorskip("playwright.sync_api")
    run = tmp_path / "run"
    shutil.copytree(finished, run)
    before = tables.read_closures(run / "closures.parquet")
    said: list[str] = []
    with sync_api.sync_playwright() as playwright, playwright.chromium.launch(
        executable_path=browser, args=["--no-sandbox", "--disable-gpu"]
    ) as chromium:  # fmt: skip
        page = chromium.new_page(viewport={"width": 1000, "height": 900}, color_scheme="light")
        page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: said.append(str(error)))
        page.goto((run / "report.html").as_uri())
        page.select_option("#filter", "accepted")
        page.fill("#search", "inliers>10")
        at = before.of(Verdict.ACCEPTED) & (before.inliers > 10)
        assert page.inner_text("#count") == f"{at.sum()} of {len(before)} candidates"
        fitted = page.evaluate(INNER_DOT)
        page.locator("#map").drag_to(
            page.locator("#map"), source_position={"x": 5, "y": 5}, target_position={"x": 35, "y": 25}
        )
        moved = page.evaluate(INNER_DOT)
        assert (moved["x"] - fitted["x"], moved["y"] - fitted["y"]) == (30, 20)
        titles = []
        for view in ("map", "3D", "time", "matrix"):
            page.select_option("#view", view)
            page.locator("#map").click(position=page.evaluate(INNER_DOT))
            titles.append(page.inner_text("#closure-title"))
            page.keyboard.press("j")
            assert page.inner_text("#closure-title") != titles[-1]
        charts = page.locator("figure.chart:has(.mark)")
        charts.first.locator(".u-over").click()
        titles.append(page.inner_text("#closure-title"))
        places = "all => new Set(all.map((one) => one.style.transform)).size"
        assert charts.locator(".u-cursor-x").evaluate_all(places) == 1
        assert charts.locator(".mark:visible").count() == 2 * charts.count()
        page.locator("#rows tr[data-row]").first.click()
        titles.append(page.inner_text("#closure-title"))
        pairs = [tuple(map(int, re.findall(r"\d+", one))) for one in titles]
        assert all(at[row] and [before.query[row], before.match[row]] == ends for row, *ends in pairs)
        assert page.input_value("#command").endswith(f"--closure {pairs[-1][1]}:{pairs[-1][2]}")
        assert page.inner_text("#no-picture") == ""
        painted = page.locator(".drawn canvas").evaluate_all(PAINTED)
        assert len(painted) > 1
        assert all(painted)
        page.fill("#search", "inliers>10")
        page.locator("#rows tr[data-row]").first.click()
        page.fill("#who", 'Jo "J", Doe')
        page.fill("#reason", "another door")
        page.locator("#closure-title").click()
        wrong = []
        for key in "rjrjrjru":
            if key == "r":
                wrong.append(re.findall(r"\d+", page.inner_text("#closure-title")))
            page.keyboard.press(key)
        page.fill("#add-query", "40")
        page.fill("#add-match", "2")
        page.click("#add")
        assert page.inner_text("#decided") == "4 decisions"
        with page.expect_download() as download:
            page.click("#download")
        download.value.save_as(tmp_path / "decisions.csv")
        rejected = sorted((int(query), int(match)) for _, query, match in wrong[:3])
        decisions = read_decisions(tmp_path / "decisions.csv", tables.read_keyframes(run / "keyframes.parquet")[0])
        assert (decisions.accepted, decisions.rejected) == ([(40, 2)], rejected)
        assert verb("run", drive.log, "-o", run, "--decisions", tmp_path / "decisions.csv").code == 0
        page.goto((run / "report.html").as_uri())
        page.select_option("#filter", "rejected_by_decision")
        cells = page.locator("#rows tr[data-row]").all_inner_texts()
        names = page.locator("#closures th").all_inner_texts()
        column = {name: [line.split("\t")[names.index(name)] for line in cells] for name in names}
        found = sorted(zip(map(int, column["query"]), map(int, column["match"]), strict=True))
        assert (found, set(column["decision"])) == (rejected, {"reject"})
    assert not said


def test_an_answer_to_a_question_is_for_all_of_its_run(browser: str, page: str, tmp_path: Path) -> None:
    asked, title, decided, decision = driven(
        browser, page, tmp_path,
        f"""{HELPERS} const question = document.querySelector("#questions tr[data-closure]");
        question.click(); press("r");
        return [question.dataset.closure, $("closure-title").textContent, $("decided").textContent,
          question.lastElementChild.textContent];""",
    )  # fmt: skip
    assert f"Closure {asked}: " in title
    members = ledger(page)["questions"][asked]
    assert (decided, decision) == (f"{len(members)} decision{'s' * (len(members) > 1)}", "reject")


def test_the_map_fits_a_window_that_becomes_narrower(browser: str, page: str, tmp_path: Path) -> None:
    """As a phone that is turned; a map that was moved stays where it was put."""
    fitted, moved = driven(
        browser, page, tmp_path,
        f"""{HELPERS} const narrow = (width) => {{
          document.body.style.width = width + "px"; window.dispatchEvent(new Event("resize"));
          const edge = document.createElement("canvas").getContext("2d", {{ willReadFrequently: true }});
          edge.drawImage($("map"), 8 - $("map").width, 0);
          return edge.getImageData(0, 0, 8, 150).data.filter((value, at) => at % 4 === 3 && value).length;
        }};
        const fitted = narrow(400);
        narrow(900); pointer("pointerdown", 5, 5); pointer("pointermove", 15, 5); pointer("pointerup", 15, 5);
        return [fitted, narrow(400)];""",
        "--window-size=1200,900",
    )  # fmt: skip
    assert fitted == 0
    assert moved > 0


def test_a_browser_runs_nothing_of_a_strangers(verb: Verb, browser: str, hostile: Path, tmp_path: Path) -> None:
    assert verb("report", hostile).code == 0
    dom, console = opened(browser, hostile / "report.html", tmp_path, "--dump-dom")
    assert not console
    assert "<title>owned" not in dom
    assert "<tr data-row=" in dom


def test_a_run_that_proposed_nothing_is_a_page_too(verb: Verb, browser: str, finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(finished, folder)
    closures = tables.read_closures(folder / "closures.parquet")
    none = Closures(**{field.name: getattr(closures, field.name)[:0] for field in dataclasses.fields(Closures)})
    keyframes, _ = tables.read_keyframes(folder / "keyframes.parquet")
    tables.write_closures(folder / "closures.parquet", none, keyframes, tables.TableMetadata({}, ""))
    assert verb("report", folder).code == 0
    dom, console = opened(browser, folder / "report.html", tmp_path, "--dump-dom")
    assert not console
    assert "Nothing was proposed" in dom


@pytest.mark.parametrize("size", ["1280,900", "500,900"])
def test_nothing_is_wider_than_the_window(browser: str, page: str, tmp_path: Path, size: str) -> None:
    """Tables scroll inside their box, so the page itself never scrolls sideways; dark paper where dark is asked for."""
    assert driven(
        browser, page, tmp_path, "return document.documentElement.scrollWidth <= innerWidth", f"--window-size={size}"
    )
    shots = []
    for scheme in ("0", "1"):  # blink's numbers of dark and light
        flags = (f"--window-size={size}", f"--blink-settings=preferredColorScheme={scheme}")
        opened(browser, tmp_path / "page.html", tmp_path, *flags, f"--screenshot={tmp_path / scheme}.png")
        shot = cv2.imread(f"{tmp_path / scheme}.png")
        assert shot is not None
        shots.append(float(shot[:, :4].mean()))
    dark, light = shots
    assert dark < 60
    assert light > 200
