"""What the paper says, where its text has numbers, and what of it cannot be repeated."""

from __future__ import annotations

from typing import Final

QUERY_MS: Final = {
    "mongo_json": ("<1", "40", "32", "2,680"),
    "mongo_json_indexed": ("<1", "12", "44", "668"),
    "postgres": ("21.49", "232.25", "347.27", "19,900"),
    "postgres_indexed": ("1.14", "225.45", "352.11", "19,500"),
    "sqlite_udf": ("1.20", "2,414.52", "1,547.70", "485,000"),
}
"""Milliseconds of Table 1, by system, for Q1 to Q4."""

MACHINE: Final = "an Intel Core i7-4770 with 16 GB of memory and one hard disk"

NOT_RUN: Final = (
    (
        "The paper's machine",
        "It was an i7-4770 with 16 GB of memory and one local hard disk. Absolute figures "
        "here are of another machine; only orders and ratios can be compared.",
    ),
    (
        "The paper's figures 3, 4 and 5 as numbers",
        "They are pictures; the text has no numbers for them. Beside ours stand the "
        "sentences that the paper draws from them.",
    ),
    (
        "MIT Stata Center data set",
        "Two PR2 recordings of many gigabytes; they do not come with this project. "
        "`mit_like` is made after the published set-up of the robot; `--logs FILE` takes "
        "the real ones where you have them.",
    ),
    (
        "HCR data set",
        "Recordings of a user study; they were never published. `hcr_like` has the "
        "topics, types and rates that the paper names.",
    ),
    (
        "Dietrich's Cassandra logger",
        "Cassandra's server needs a Java runtime and has no Python wheel, so it cannot be "
        "installed and started like the others. The design (opaque blobs by time) is close "
        "to a plain MCAP file, which is measured.",
    ),
    (
        "Spark Streaming and VoltDB",
        "The paper names them for live statistics on clusters. It measures neither, and "
        "neither keeps a log on one robot's computer.",
    ),
    (
        "ROS itself",
        "The paper publishes through ROS. Here a process of its own publishes on the same "
        "schedule through the same queues of ten, so no ROS is needed and its sockets are "
        "not measured.",
    ),
)
"""What this benchmark leaves out, and why."""
