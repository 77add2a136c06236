"""Decisions of a person on closures: pairs of keyframes that are rejected, or known inliers, whatever geometry says."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from vplog.data import Closures, Keyframes, Verdict
from vplog.errors import SettingsError
from vplog.evaluate.truth_tables import read_lines
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import warn
from vplog.loops.candidate import lenient
from vplog.loops.propose import Proposals
from vplog.loops.verify import verify_between
from vplog.run.cache.codecs import closures_codec
from vplog.run.cache.steps import Steps, step
from vplog.run.keyframes import row_of
from vplog.run.verification import DriveFeatures, calibrated, for_verification, merged
from vplog.settings import FileName, Settings
from vplog.storage.scratch import replacing

_COLUMNS = ["query", "match", "decision", "who", "when", "reason"]
_REQUIRED = 3
_CHOICES = ("accept", "reject", "add", "same", "")
_MOST_ACCEPTED = 10_000
"""Pairs that may be accepted: each that geometry rejected is verified again, some milliseconds apiece."""
_FORM = (
    f"Decisions are a CSV with the header `{','.join(_COLUMNS)}`: two keyframes, by row or by stamp in ns, and accept, "
    "reject or add, same as the line before, or nothing where it is open; the last three may be left out."
)


class DecisionSettings(Settings):
    """Closures that a person decided on."""

    LOCATIONS: ClassVar = frozenset({"file"})

    file: FileName = ""
    """A CSV of pairs of keyframes to accept, reject or add: `vplog run --decisions`; report.html writes one."""

    def check_single_drive(self) -> None:
        """Raises SettingsError: for a computation of several drives, whose keyframes no row or stamp names alone."""
        if self.file:
            raise SettingsError("Decisions are for one drive at a time: run each by itself with --decisions.")


@dataclass(frozen=True, eq=False)
class Decisions:
    """Pairs of keyframe rows (query, match), the query the later one, by whether the pair is a closure."""

    accepted: list[tuple[int, int]]
    rejected: list[tuple[int, int]]


@dataclass(frozen=True)
class Decided:
    """A line of a file of decisions."""

    pair: tuple[int, int]
    """Keyframe rows of query and match, the query the later one."""
    decision: str
    """`accept`, `reject` or `add`."""
    about: list[str]
    """Who, when and reason."""
    where: str
    """The file and line."""


def read_decisions(path: Path, keyframes: Keyframes) -> Decisions:
    """The decisions in a CSV. Raises SettingsError with the place of the first line that does not fit."""
    found = dict[tuple[int, int], tuple[bool, str]]()
    for one in decided_lines(path, keyframes):
        accepted = one.decision != "reject"
        if found.setdefault(one.pair, (accepted, one.where))[0] is not accepted:
            raise SettingsError(f"{one.where} decides otherwise than {found[one.pair][1]} on one pair. Leave one out.")
    pairs = {choice: sorted(pair for pair, (one, _) in found.items() if one is choice) for choice in (True, False)}
    if len(pairs[True]) > _MOST_ACCEPTED:
        raise SettingsError(f"{path} accepts {len(pairs[True])} pairs, and at most {_MOST_ACCEPTED} can be.")
    return Decisions(pairs[True], pairs[False])


def decided_lines(path: Path, keyframes: Keyframes) -> Iterator[Decided]:
    """The lines of a CSV that decide on a pair. Raises SettingsError with the place of the first that does not fit."""
    lines, before = read_lines(path, (_COLUMNS, _COLUMNS[:_REQUIRED]), _FORM, SettingsError), ""
    if next(lines, None) is None:
        raise SettingsError(f"{path} is empty. {_FORM}")
    for where, cells in lines:
        if cells[2] not in _CHOICES:
            raise SettingsError(f"{where} does not hold a decision in the third field. {_FORM}")
        rows = [row_of(keyframes, cell) for cell in cells[:2]]
        if None in rows:
            raise SettingsError(
                f"{where}: {cells[rows.index(None)]!r} is no keyframe of {keyframes.drive}. Its rows are "
                f"0..{len(keyframes.stamp_ns) - 1}; stamps are in ns, as in keyframes.parquet."
            )
        match, query = sorted(row for row in rows if row is not None)
        if query - match < 2:
            raise SettingsError(f"{where}: keyframes {match} and {query} are joined by odometry. Leave the line out.")
        before = before if cells[2] == "same" else cells[2]
        if before:
            yield Decided((query, match), before, cells[_REQUIRED:], where)


def write_decisions(path: Path, keyframes: Keyframes, lines: Iterable[Sequence[Any]]) -> None:
    """Write lines of two keyframe rows, a decision, who, when and reason; keyframes by their stamps, as other settings
    choose other rows."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(_COLUMNS)
    for query, match, *rest in lines:
        table.writerow([*keyframes.stamp_ns[[query, match]].tolist(), *rest, *[""] * (len(_COLUMNS) - 2 - len(rest))])
    with replacing(path, parents=True) as stream:
        stream.write(text.getvalue().encode())


@step("decide", lambda *_: closures_codec(), items=lambda closures, decisions, *_: len(decisions.accepted))
def decide(
    closures: Closures, decisions: Decisions, drive: DriveFeatures, *, steps: Steps, execution: Execution
) -> Closures:
    """The ledger with the verdicts of decisions. Accepted pairs without a pose are verified with loose thresholds."""
    row_at = _rows(closures)
    posed = set(np.flatnonzero(np.isfinite(closures.match_from_query[:, 0, 0])).tolist())
    missing = [pair for pair in decisions.accepted if row_at.get(pair) not in posed]
    if missing:
        views = for_verification(replace(drive, settings=lenient(drive.settings)))
        proposals, share = _proposals(missing, closures, row_at), calibrated(drive, steps)
        found = verify_between(proposals, views, views, execution, share)
        closures = _with(closures, found, row_at)
        row_at = _rows(closures)
    verdict = list(closures.verdict)
    for query, match in decisions.accepted:
        row = row_at[query, match]
        if np.isfinite(closures.match_from_query[row, 0, 0]):
            verdict[row] = Verdict.ACCEPTED_BY_DECISION
        else:
            warn(
                f"Decision to accept keyframes {query} and {match}: geometry finds no pose between them "
                f"({verdict[row].value}), so it has no effect."
            )
    candidates = [row_at[pair] for pair in decisions.rejected if pair in row_at]
    for row in candidates:
        verdict[row] = Verdict.REJECTED_BY_DECISION
    if others := len(decisions.rejected) - len(candidates):
        warn(f"{others} of the {len(decisions.rejected)} rejected pairs are no candidates.")
    return replace(closures, verdict=verdict)


def _rows(closures: Closures) -> dict[tuple[int, int], int]:
    """Ledger row of each pair of query and match."""
    return {pair: row for row, pair in enumerate(zip(closures.query.tolist(), closures.match.tolist(), strict=True))}


def _proposals(pairs: list[tuple[int, int]], closures: Closures, row_at: dict[tuple[int, int], int]) -> Proposals:
    """The pairs as candidates: as the ledger has them, or ranked behind those of their query with the least score."""
    query, match = np.array(pairs, np.int32).T
    rows = np.array([row_at.get(pair, -1) for pair in pairs])
    behind = np.bincount(closures.query, minlength=query.max() + 1)[query] + np.arange(len(pairs))
    ranked = {"rank": behind, "score": np.full(len(pairs), closures.score.min(initial=0.0)), "support": 0 * behind}
    known = {
        name: np.where(rows < 0, other, np.append(getattr(closures, name), 0)[rows]) for name, other in ranked.items()
    }
    types = {"rank": np.int32, "score": np.float32, "support": np.int32}
    columns: dict[str, Any] = {name: known[name].astype(kind) for name, kind in types.items()}
    return Proposals(query, match, **columns)


def _with(closures: Closures, found: Closures, row_at: dict[tuple[int, int], int]) -> Closures:
    """The ledger with the rows found: in place of those without a pose, or beside the others of their query."""
    pairs = list(zip(found.query.tolist(), found.match.tolist(), strict=True))
    posed = np.isfinite(found.match_from_query[:, 0, 0])
    fresh = np.flatnonzero(posed | np.array([pair not in row_at for pair in pairs]))
    gone = [row_at[pairs[row]] for row in fresh.tolist() if pairs[row] in row_at]
    stays = np.setdiff1d(np.arange(len(closures)), gone)
    found = replace(found.rows(fresh), p_false=np.full(len(fresh), np.nan))
    both = [closures.rows(stays), found]
    order = np.lexsort([np.concatenate([getattr(one, name) for one in both]) for name in ("rank", "query")])
    place = np.argsort(order, kind="stable")
    return merged(both, [place[: len(stays)], place[len(stays) :]])
