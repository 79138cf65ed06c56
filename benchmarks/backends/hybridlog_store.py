"""hybridlog itself: payloads in segments, fields in its embedded MongoDB."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from msgspec.structs import replace

from benchmarks.backends.base import (
    ARM,
    GRIPPER,
    HALF_NS,
    VIEWPOINT,
    Backend,
    BackendFailedError,
    BackendMissingError,
    failing,
)
from benchmarks.usage import wait_for_mongods, working_below
from hybridlog_storage.errors import HybridlogError, MissingDependencyError
from hybridlog_storage.mongo.index_documents import collection_of

if TYPE_CHECKING:
    import pandas as pd
    from numpy.typing import NDArray

    from hybridlog.live import LiveRecording
    from hybridlog.store import Store
    from hybridlog_storage.messages import Channel


class Hybridlog(Backend):
    """A store with its default settings; each run is a recording of its own."""

    name = title = "hybridlog"
    answers = reads = True
    compression: Literal["zstd", "none"] = "zstd"

    def __init__(self, directory: Path) -> None:
        super().__init__(directory)
        self._opened: Store | None = None
        self._recording: LiveRecording | None = None
        self._channels: Sequence[Channel] = ()

    @property
    def path(self) -> Path:
        """Directory of the store."""
        return self.directory / "store"

    @property
    def store(self) -> Store:
        """The store; between `open` and `close`."""
        assert self._opened is not None
        return self._opened

    @classmethod
    def check(cls) -> None:
        from hybridlog_storage.mongo.mongod import find_mongod

        try:
            find_mongod()
        except MissingDependencyError as error:
            raise BackendMissingError(str(error)) from error

    def open(self, channels: Sequence[Channel]) -> None:
        self.check()
        import hybridlog as hl

        self._channels = channels
        fresh = not self.path.exists()
        try:
            self._opened = hl.open(self.path, mongo="embedded", create=True, require_database=True)
        except HybridlogError as error:
            raise BackendMissingError(f"hybridlog: {error}") from error
        if fresh:  # or it is opened to be asked
            from hybridlog.live.recording import LIVE_SETTINGS

            settings = replace(LIVE_SETTINGS, compression=self.compression)
            self._recording = self.store.start("benchmark", settings=settings)

    def insert(self, channel: int, log_time: int, payload: bytes) -> None:
        assert self._recording is not None
        try:
            self._recording.write(self._channels[channel], payload, log_time=log_time)
        except (HybridlogError, OSError) as error:
            raise BackendFailedError(f"hybridlog: {error}") from error

    def finish(self) -> None:
        recording, self._recording = self._recording, None
        if recording is None:
            return
        with failing("hybridlog", HybridlogError, OSError):
            report = recording.close()
        if report.missed:
            raise BackendFailedError(
                f"hybridlog: {report.missed} messages are stored, but not in the index: "
                f"{report.failure}"
            )

    def counts(self) -> Mapping[str, int]:
        """Payloads that were read back, by topic."""
        found = dict.fromkeys((channel.topic for channel in self._channels), 0)
        with failing("hybridlog", HybridlogError, OSError):
            store = self.store
            store.refresh()
            database = store.shared.index.database_for("Counting")
            for topic in set(found) & set(store.topics()):
                found[topic] = sum(len(batch) for batch, _ in store.query([topic]).batches())
                # Without a filter it would be an estimate once the server was killed.
                indexed = database.count(collection_of(topic), {"_id": {"$exists": True}})
                if indexed != found[topic]:
                    raise BackendFailedError(
                        f"hybridlog: {topic} has {found[topic]} payloads and {indexed} index "
                        "documents"
                    )
        return found

    def close(self) -> None:
        recording, self._recording = self._recording, None
        store, self._opened = self._opened, None
        if recording is not None:
            with suppress(HybridlogError, OSError):
                recording.close()
        if store is not None:
            store.close()
            wait_for_mongods(self.path)

    def processes(self) -> Sequence[int]:
        return working_below(self.path, "mongod") if self._opened is not None else ()

    def closings(self) -> int:
        return self.store.topic(GRIPPER).where("position == 0").count()

    def behind(self) -> int:
        return self.store.topic(VIEWPOINT).where("position.x <= 0").count()

    def positions(self) -> list[float]:
        axes = [f"position.{axis}" for axis in "xyz"]
        frame = self.store.topic(VIEWPOINT).where("position.x <= 0").fields(*axes).to_pandas()
        return [float(len(frame)), *map(float, frame[axes].sum())]

    def in_region(self) -> int:
        region = (
            "pose.position.z > 1 and -0.5 < pose.position.y < 0.5 and 0.5 < pose.position.x < 1"
        )
        return self.store.topic(ARM).where(region).count()

    def grasps(self) -> int:
        half = f"{HALF_NS}ns"
        closings = self.store.topic(GRIPPER).where("position == 0").windows(half, half)
        in_front = self.store.topic(VIEWPOINT).where("position.x >= 0")
        return len(closings.containing(in_front))

    def slice(self, topic: str, begin: int, end: int) -> NDArray[np.float32]:
        query = self.store.topic(topic).between(f"{begin}ns", f"{end}ns").fields("ranges")
        return np.stack(list(query.to_pandas()["ranges"]))

    def last(self, topic: str, time: int) -> NDArray[np.float32]:
        found: NDArray[np.float32] = self.store.topic(topic).at(f"{time}ns").decode().ranges
        return found

    def table(self, topic: str) -> pd.DataFrame:
        return self.store.topic(topic).to_pandas()


class HybridlogUncompressed(Hybridlog):
    """The same with chunks that are not compressed, as a ROS bag has them."""

    name, title = "hybridlog_uncompressed", "hybridlog, uncompressed"
    answers = reads = False
    compression = "none"
