"""Run on a drive and compare the result with the truth.

python examples/run_and_evaluate.py LOG TRUTH.tum OUT [SETTING=VALUE ...]
"""

import sys

import vplog

log, truth, out, *settings = sys.argv[1:]
run = vplog.run(log, out, settings=settings)
found = vplog.evaluate(run, truth)
for when in ("before", "after"):
    print(f"ATE {when:6} {found[f'ate_{when}']['rmse_m']:6.2f} m")
print(f"{run.record['counts']['verdicts'].get('accepted', 0)} closures accepted; see {run.folder}/report.html")
