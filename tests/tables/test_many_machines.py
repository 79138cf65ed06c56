"""Engines that run on many machines count what hybridlog counts; none is needed otherwise."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import hybridlog as hl
from benchmarks.simulator.write import write_bag

pytestmark = pytest.mark.exhaustive

POLARS = """
import polars as pl
rows = pl.scan_parquet(path).filter(pl.col("topic") == "/odom")
speed = pl.col("twist").struct["twist"].struct["linear"].struct["x"]
print(rows.filter(speed > 0.5).select(pl.len()).collect().item())
"""
DAFT = """
import daft
rows = daft.read_parquet(path).where(daft.col("topic") == "/odom")
print(rows.where(daft.col("twist")["twist"]["linear"]["x"] > 0.5).count_rows())
"""
RAY = """
import glob, ray
ray.init(include_dashboard=False, num_cpus=1, _node_ip_address="127.0.0.1")
rows = ray.data.read_parquet(glob.glob(path)).filter(lambda row: row["topic"] == "/odom")
print(rows.filter(lambda row: row["twist"]["twist"]["linear"]["x"] > 0.5).count())
"""
SPARK = """
from pyspark.sql import SparkSession
settings = {
    "spark.ui.enabled": "false",
    "spark.driver.host": "127.0.0.1",
    "spark.driver.bindAddress": "127.0.0.1",
    "spark.sql.legacy.parquet.nanosAsLong": "true",
}
rows = SparkSession.builder.master("local[1]").config(map=settings).getOrCreate().read.parquet(path)
print(rows.where("topic = '/odom' and twist.twist.linear.x > 0.5").count())
"""


@pytest.mark.parametrize(
    ("package", "job"),
    [("polars", POLARS), ("daft", DAFT), ("ray", RAY), ("pyspark", SPARK)],
    ids=lambda it: it if it.isalpha() else "",
)
def test_a_job_counts_as_hybridlog_does(package: str, job: str, tmp_path: Path) -> None:
    pytest.importorskip(package)
    with hl.open(tmp_path / "store", create=True, mongo="none") as store:
        for seed in (1, 2):
            write_bag(tmp_path / f"{seed}.bag", duration_s=10, seed=seed)
            store.record(tmp_path / f"{seed}.bag")
        right = store.topic("odom").where("twist.twist.linear.x > 0.5").count()
    path = tmp_path / "store" / "tables" / "nav_msgs_Odometry~*" / "*.parquet"
    done = subprocess.run(
        [sys.executable, "-c", f"path = {str(path)!r}\n{job}"],
        check=True,
        capture_output=True,
        text=True,
    )
    assert int(done.stdout.split()[-1]) == right > 0
