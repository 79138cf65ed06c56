"""The journal of a run of the studies: JSON lines, one as soon as it is known.

A journal is all that a report needs, and all that a run that was stopped needs to go
on: what is in it is not done again.
"""

from __future__ import annotations

import json
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from benchmarks.disturbance import share_taken

Status = Literal["ok", "missing", "failed"]
Scale = Literal["full", "quick", "tiny"]
"""How much is measured: for publication, in a third of the time, or only that it works."""
NAME = "samples.jsonl"


@dataclass(frozen=True, slots=True)
class Sample:
    """One run of one backend.

    Attributes:
        study: Name of the part, such as `record`.
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


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """See that an error of the system's names a file: a full disk does not say which it is."""
    try:
        yield
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


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
        self.runs: dict[str, int] = {}
        """By the same keys: in which run each was taken, as a place in `headers`."""
        self._successes: Counter[str] = Counter()
        self._pending: dict[str, Any] | None = None
        self._end = 0
        """Of the last whole line. What is behind it was cut off in the middle, and goes when
        the next one is written: not before, since another process may be writing it."""
        self._read()

    def begin(self, header: Mapping[str, Any]) -> None:
        """Note with the first sample that a run started: machine, versions, settings, seeds."""
        self._pending = dict(header)

    def add(self, sample: Sample) -> None:
        """Note a sample; it is on the disk when this returns."""
        header, self._pending = self._pending, None
        if header is not None:
            self.headers.append(header)
            self._append({"kind": "run", **header})
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
        self.runs[sample.key] = len(self.headers) - 1

    def _append(self, line: Mapping[str, Any]) -> None:
        data = json.dumps(line, allow_nan=False).encode() + b"\n"
        with naming(self.path), self.path.open("ab") as file:
            file.truncate(self._end)
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        self._end += len(data)

    def _read(self) -> None:
        if not self.path.is_file():
            return
        whole = self.path.read_bytes()
        kept = whole[: whole.rfind(b"\n") + 1]
        self._end = len(kept)
        for number, line in enumerate(kept.splitlines(), 1):
            try:
                self._take(json.loads(line))
            except (ValueError, TypeError, KeyError, AttributeError) as error:
                raise ValueError(f"line {number}: {error}") from None

    def _take(self, line: dict[str, Any]) -> None:
        kind = line.pop("kind")
        if kind == "run":
            self.headers.append(line)
        elif kind == "sample":
            self._keep(Sample(**line))
