"""The candidate closures of a finished run as a pandas data frame: what became of them, and the best by inliers.

python examples/closures_to_pandas.py RUN
"""

import sys

import vplog

run = vplog.open_run(sys.argv[1])
closures = run.closures.to_pandas()
keyframes = run.keyframes.to_pandas()
closures["gap_s"] = (closures["query_stamp_ns"] - closures["match_stamp_ns"]) / 1e9
print(closures["verdict"].value_counts().to_string())
best = closures.sort_values("inliers", ascending=False).head(5)
print(best[["query", "match", "inliers", "gap_s", "weight"]].to_string(index=False))
print(f"of {len(keyframes)} keyframes")
