"""Assets for Dagster: a map of the drives of a manifest, and a check of it against the truth.

pip install . dagster dagster-webserver
dagster dev -f examples/dagster_assets.py
"""

import dagster as dg

import vplog

MANIFEST, MAP = "s3://fleet/drives.csv", "s3://fleet/maps/city"
MOST_ATE_M = 1.0


@dg.asset
def fleet_map(context) -> dg.MaterializeResult:
    def tell(drive) -> None:
        context.log.info(f"{drive.drive}: {drive.state} {drive.error}")

    done = vplog.batch([MANIFEST], MAP, jobs=4, drive_timeout_s=4 * 3600, on_drive=tell)
    return dg.MaterializeResult(metadata={"drives": len(done["drives"]), "failed": done["failed"]})


@dg.asset_check(asset=fleet_map)
def accuracy() -> dg.AssetCheckResult:
    ate_m = vplog.evaluate(MAP)["groups"]["all"]["ate_m"]
    return dg.AssetCheckResult(passed=ate_m is not None and ate_m <= MOST_ATE_M, metadata={"ATE in m": str(ate_m)})


defs = dg.Definitions(assets=[fleet_map], asset_checks=[accuracy])
