"""Compute drives into one map, then find where the views of a log are in it.

python examples/batch_and_query.py MAP QUERY LOG... [SETTING=VALUE ...]

Every drive is computed in a process of its own; this script needs no `if __name__ == "__main__"` for that.
"""

import sys

import vplog

place, query, *rest = sys.argv[1:]
logs = [text for text in rest if "=" not in text]
settings = [text for text in rest if "=" in text]
done = vplog.batch(logs, place, settings=settings)
for drive in done["drives"]:
    print(drive["drive"], drive["state"], drive["error"])
answers = vplog.open_map(place).query(query, top=3)
for answer in answers.table.slice(0, 9).to_pylist():
    print(*(answer[name] for name in ("query", "rank", "drive", "keyframe", "score")))
