"""The journal of a run of the studies: JSON lines, one as soon as it is known."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal

from hybridlog_storage.errors import UsageError

Status = Literal["ok", "missing", "failed"]
Scale = Literal["full", "tiny"]
"""How much is measured: for publication, or only that it works."""
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


class Journal:
    """The samples of a run, in a directory."""

    def __init__(self, directory: Path, header: Mapping[str, Any] | None = None) -> None:
        self.path = directory / NAME
        self.header: dict[str, Any] = {}
        self.samples: list[Sample] = []
        if header is None:
            self._read()
            return
        directory.mkdir(parents=True, exist_ok=True)
        try:
            self.path.touch(exist_ok=False)
        except FileExistsError:
            raise UsageError(f"{directory} has results already: name another --out.") from None
        self.header = dict(header)
        self._append({"kind": "run", **header})

    def add(self, sample: Sample) -> None:
        """Note a sample; it is on the disk when this returns."""
        self.samples.append(sample)
        self._append({"kind": "sample", **asdict(sample)})

    def _append(self, line: Mapping[str, Any]) -> None:
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, allow_nan=False) + "\n")
            file.flush()
            os.fsync(file.fileno())

    def _read(self) -> None:
        try:
            for line in map(json.loads, self.path.read_text("utf-8").splitlines()):
                if line.pop("kind") == "run":
                    self.header = line
                else:
                    self.samples.append(Sample(**line))
        except FileNotFoundError:
            raise UsageError(f"{self.path} does not exist; --out DIR says where it is.") from None
