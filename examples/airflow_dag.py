"""A DAG for Airflow 3: every night the drives of a manifest into one map, then a check of it against the truth.

Copy it into the folder of DAGs. Its workers need vplog: run `pip install .` in a checkout.
If a drive failed or the mean ATE is too large, the task fails.
"""

from datetime import datetime

from airflow.sdk import dag, task

import vplog

MANIFEST, MAP = "s3://fleet/drives.csv", "s3://fleet/maps/city"
MOST_ATE_M = 1.0


@task(retries=2)
def compute() -> int:
    done = vplog.batch([MANIFEST], MAP, jobs=4, drive_timeout_s=4 * 3600)
    if failed := [f"{one['drive']}: {one['error']}" for one in done["drives"] if one["state"] == "failed"]:
        raise RuntimeError("\n".join(failed))
    return len(done["drives"])


@task
def check() -> float:
    ate_m = vplog.evaluate(MAP)["groups"]["all"]["ate_m"]
    if ate_m is None or ate_m > MOST_ATE_M:
        raise RuntimeError(f"mean ATE {ate_m} m")
    return ate_m


@dag(schedule="@daily", start_date=datetime(2026, 1, 1), catchup=False)
def fleet_map() -> None:
    compute() >> check()


fleet_map()
