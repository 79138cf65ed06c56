"""The journal of a run of the studies: JSON lines, one as soon as it is known.

A journal is all that a report needs, and all that a run that was stopped needs to go
on: what is in it is not done again.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from benchmarks.disturbance import share_taken

Status = Literal["ok", "missing", "failed"]
NAME = "samples.jsonl"


@dataclass(frozen=True, slots=True)
class Sample:
    """One run of one backend.

    Attributes:
        study: `throughput`, `ceiling`, `persistence`, `speed-up`, `queries`, `reading`.
        case: What was asked of it, by name: `{"size": 5000, "rate": 4}`.
        backend: Name of the backend.
        repetition: From 0.
        status: `ok`; `missing` when the backend is not installed or does not start;
            `failed` when it stopped in the middle.
        values: What was measured, by name; units stand in the names (`wall_s`,
            `payload_bytes`). Of a failure, what was measured until then.
        reason: Of a status that is not `ok`: why, and the cure.
    """

    study: str
    case: Mapping[str, Any]
    backend: str
    repetition: int
    status: Status = "ok"
    values: Mapping[str, Any] = field(default_factory=dict)
    reason: str = ""

    @property
    def key(self) -> str:
        """Equal for two samples of the same run."""
        return json.dumps(
            [self.study, dict(self.case), self.backend, self.repetition], sort_keys=True
        )


class Journal:
    """Samples in a directory, appended as they come.

    Args:
        directory: Made when it is not there.
    """

    def __init__(self, directory: Path) -> None:
        directory.mkdir(parents=True, exist_ok=True)
        self.path = directory / NAME
        self.headers: list[dict[str, Any]] = []
        self.samples: dict[str, Sample] = {}
        """By key, the last of each; of several that succeeded, that which the machine
        disturbed least."""
        self._successes: Counter[str] = Counter()
        for line in self._lines():
            kind = line.pop("kind")
            if kind == "run":
                self.headers.append(line)
            elif kind == "sample":
                self._keep(Sample(**line))

    def begin(self, header: Mapping[str, Any]) -> None:
        """Note that a run starts, with machine, versions, settings and seeds."""
        self.headers.append(dict(header))
        self._append({"kind": "run", **header})

    def add(self, sample: Sample) -> None:
        """Note a sample; it is on the disk when this returns."""
        self._keep(sample)
        self._append(
            {
                "kind": "sample",
                "study": sample.study,
                "case": dict(sample.case),
                "backend": sample.backend,
                "repetition": sample.repetition,
                "status": sample.status,
                "values": dict(sample.values),
                "reason": sample.reason,
            }
        )

    def has(self, sample: Sample) -> bool:
        """Whether a run has been done; failures and missing backends are tried again."""
        known = self.samples.get(sample.key)
        return known is not None and known.status == "ok"

    def successes(self, sample: Sample) -> int:
        """How often a run has been done to its end."""
        return self._successes[sample.key]

    def _keep(self, sample: Sample) -> None:
        if sample.status == "ok":
            self._successes[sample.key] += 1
            known = self.samples.get(sample.key)
            if (
                known is not None
                and known.status == "ok"
                and share_taken(known.values) < share_taken(sample.values)
            ):
                return
        self.samples[sample.key] = sample

    def _append(self, line: Mapping[str, Any]) -> None:
        data = json.dumps(line, allow_nan=False).encode() + b"\n"
        descriptor = os.open(
            self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644
        )
        try:
            os.write(descriptor, data)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)

    def _lines(self) -> Iterator[dict[str, Any]]:
        if not self.path.is_file():
            return
        whole = self.path.read_bytes()
        kept = whole[: whole.rfind(b"\n") + 1]
        if len(kept) != len(whole):
            # A line that was cut off in the middle; the next one must start on its own.
            os.truncate(self.path, len(kept))
        for line in kept.splitlines():
            yield json.loads(line)
