"""Compare place recognisers on one drive that comes back to where it was, its own odometry the truth.

python examples/compare_recognisers.py LOG [SETTING=VALUE ...]
"""

import sys

import vplog

log, *settings = sys.argv[1:]
found = vplog.compare(
    log, methods=["bobb", "bovf", "gist"], truth="poses", min_gap=15, library_size=12, settings=settings
)
for name, figures in found.record["methods"].items():
    print(f"{name:6} recall at 1: {figures['r_at_1']:.2f}, {figures['bits']} bits a place")
