"""List the candidate closures of a finished run: how many have each verdict, and the five with the most inliers.

python examples/list_closures.py RUN
"""

import sys

import vplog

run = vplog.open_run(sys.argv[1])
closures = run.closures  # a pyarrow.Table
for verdict in closures["verdict"].value_counts().to_pylist():
    print(f"{verdict['counts']:6} {verdict['values']}")
for closure in closures.sort_by([("inliers", "descending")]).slice(0, 5).to_pylist():
    gap_s = (closure["query_stamp_ns"] - closure["match_stamp_ns"]) / 1e9
    print(f"{closure['query']} to {closure['match']}: {closure['inliers']} inliers, {gap_s:.1f} s apart")
print(f"of {len(run.keyframes)} keyframes")
