"""Opens a store: connects directory, database, segments and reader."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from functools import partial
from pathlib import Path
from typing import (
    TYPE_CHECKING,
    Any,
    Self,
    TypeAlias,
    cast,
)

from hybridlog.index.access import again_if_lost
from hybridlog.index.of_store import Index
from hybridlog.maintenance import edit as edits
from hybridlog.opened import OpenStore
from hybridlog.query.choice import Choice, During, Tags, Texts, choose
from hybridlog.query.query import Query, narrowed, of_now
from hybridlog.query.question import Clock, Question
from hybridlog.recordings import Recordings
from hybridlog.session import Asked, Session
from hybridlog_storage.catalog import RecordingEntry, RecordingSummary
from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.errors import (
    StoreError,
    TopicError,
    UsageError,
)
from hybridlog_storage.remote import address_of, directory_of
from hybridlog_storage.settings import EMBEDDED, NONE

if TYPE_CHECKING:
    from hybridlog.across.align import Aligned
    from hybridlog.across.sync import Synced
    from hybridlog.attachments import StoredAttachment, StoredMetadata
    from hybridlog.contract import Contract
    from hybridlog.contract.diff import Difference
    from hybridlog.contract.judge import Result
    from hybridlog.formats.reading import Source
    from hybridlog.live import LiveOptions, LiveRecording
    from hybridlog.maintenance.copying import CopyOptions, CopyReport
    from hybridlog.maintenance.keep import KeepReport
    from hybridlog.maintenance.report import Progress
    from hybridlog.maintenance.sizes import Sizes
    from hybridlog.maintenance.verify import Verification
    from hybridlog.query.answers.statistics import TopicCheck
    from hybridlog.query.times import DurationLike, TimeLike
    from hybridlog.record.recorder import RecordOptions, RecordReport
    from hybridlog.sql.engine import SqlAnswer, SqlEngine
    from hybridlog.tf.tree import FrameTree
    from hybridlog.training.lerobot import LerobotOptions, LerobotReport

DEFAULT_STORE = "hybridlog-store"
Names: TypeAlias = "Iterable[str | RecordingEntry]"
"""Recordings by name or id, or their entries."""


def store_path(path: str | Path | None = None) -> Path:
    """Path of the store: the argument, else `HYBRIDLOG_STORE`, else `./hybridlog-store`."""
    return Path(path or os.environ.get("HYBRIDLOG_STORE") or DEFAULT_STORE)


def open_store(
    path: str | Path | None = None,
    *,
    mongo: str | None = None,
    create: bool = False,
    require_database: bool = False,
    progress: Progress | None = None,
    read_only: bool = False,
) -> Store:
    """Open a store.

    Args:
        path: Its directory; by default `HYBRIDLOG_STORE` or `./hybridlog-store`.
        mongo: URI of the MongoDB that holds the index, `embedded`, or `none` for no index; by
            default `HYBRIDLOG_MONGO_URI`, the store's own setting, or the embedded MongoDB.
        create: Create the store if it does not exist.
        require_database: Connect to MongoDB now, not when a question needs it.
        progress: Called while an index is brought up to date.
        read_only: Never write a byte in it, and use no MongoDB; so it is, too, where
            `HYBRIDLOG_READ_ONLY` is set.

    Raises:
        StoreError: It is not a store, or has another format.
        DatabaseError: MongoDB does not answer and `require_database` is set.
    """
    where = store_path(path)
    read_only = read_only or "HYBRIDLOG_READ_ONLY" in os.environ
    wanted = NONE if read_only else mongo or os.environ.get("HYBRIDLOG_MONGO_URI")
    if address_of(where) is not None:
        directory = directory_of(where, read_only=read_only)
        if mongo not in {None, NONE}:
            raise UsageError("A store in a bucket is asked without MongoDB: leave out --mongo.")
        if require_database:
            raise StoreError(
                f"{directory.place} is a store in a bucket, which has no index in MongoDB. Do this "
                "in a store on a disk."
            )
        wanted = NONE
    elif create:
        directory = StoreDirectory.create(where, mongo=None if mongo == EMBEDDED else mongo)
    else:
        directory = StoreDirectory(where, read_only=read_only)
    if create:
        directory.check_writable()
    shared = OpenStore(directory, wanted, progress)
    try:
        shared.now()
        if require_database:
            shared.index.connect()
    except BaseException:
        shared.close()
        raise
    return Store(shared)


def _session_of(address: str | Path, mongo: str | None) -> Session:
    """The state of a store that another process opens for itself."""
    return open_store(address, mongo=mongo).session


class Store:
    """A directory of recordings and the database that indexes them.

    Opened by `hybridlog.open`. A context manager; several threads may read from one store.

    Attributes:
        directory: The store's directory.
    """

    def __init__(self, shared: OpenStore) -> None:
        self.directory, self.shared = shared.directory, shared
        self._source: Asked = shared
        self._sql: SqlEngine | None = None

    def __enter__(self) -> Self:
        """Return this store."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    @property
    def session(self) -> Session:
        """The store at the moment that a question is about: now, or that of a snapshot.

        Raises:
            UsageError: It was opened before this process was forked.
        """
        return self._source.now()

    def _itself(self) -> OpenStore:
        """The open store; a snapshot, or one of before a fork, is refused."""
        self.shared.check_process()
        if self._source is not self.shared:
            raise UsageError("A snapshot of a store only answers: change the store itself.")
        return self.shared

    def _to_change(self) -> OpenStore:
        """The open store, about to be changed: what crashes have left is finished first."""
        self._itself().recover()
        return self.shared

    def __repr__(self) -> str:
        return f"<Store {self.directory.place}>"

    def _repr_html_(self) -> str:
        """The store in a notebook: its latest recordings."""
        from hybridlog.drawing.notebook import recordings_html

        return recordings_html(f"Store {self.directory.place}", self.recordings().summaries)

    # The index.

    @property
    def index(self) -> Index:
        """Makes and describes the index."""
        return Index(self.shared)

    def refresh(self) -> None:
        """Drop the snapshot of the catalog, to see new recordings of other processes."""
        self._itself().invalidate()

    def snapshot(self) -> Store:
        """The store at one moment, which all questions to it see; it needs not be closed.

        A running recording is as it was when the first question asked about it.
        """
        found = copy(self)
        vars(found).update(_source=self.session, _sql=None)
        return found

    def close(self) -> None:
        """Close files and connections; of a snapshot, those of its own. May be called again."""
        if self.shared.is_closed or self.shared.is_inherited:  # or another's to close
            return
        if self._sql is not None:
            self._sql.close()
        if self._source is self.shared:
            self.shared.close()

    # Recordings and topics.

    def recordings(
        self,
        name: Texts = None,
        *,
        tag: Tags = None,
        has: Texts = None,
        type: Texts = None,  # noqa: A002 - the word of the command line
        during: During = None,
        where: Texts = None,
        older_than: DurationLike | None = None,
    ) -> Recordings:
        """The recordings that satisfy all conditions, oldest first, perhaps none.

        Args:
            name: Name, id, the beginning of one, or a glob for names (`monday*`); one of several
                must match.
            tag: `"robot=7"`, or `"robot"` for any value, or a dictionary.
            has: Topics that they have: full or short names, globs, `re:`.
            type: Types of messages: `sensor_msgs/Imu`, `Imu`, a glob.
            during: Range `[begin, end)` of log time that they overlap; None leaves a side open.
            where: `"scan: ranges.min < 0.5"`: holds for at least one message of the topic.
            older_than: `"30d"`: their last message is at least this old.

        Raises:
            TopicError: A name without wildcards means no recording, or several.
            TimeError: `during` is no range of absolute times.
            WhereError: A predicate cannot be parsed, or does not fit the fields.
        """
        choice = Choice.of(
            name,
            tag=tag,
            has=has,
            type=type,
            during=during,
            where=where,
            older_than=older_than,
        )
        return self.choose(choice)

    def choose(self, choice: Choice) -> Recordings:
        """The recordings that satisfy a choice; see `recordings`."""
        from hybridlog.query.planner import recordings_with_any

        return Recordings(self._source, *choose(self.session, choice, recordings_with_any))

    def entry(self, recording: str) -> RecordingEntry:
        """The entry of a recording, by its id or its name.

        Raises:
            TopicError: It does not exist.
        """
        return self.session.entry(recording)

    def topics(self, *types: str) -> list[str]:
        """Names of all topics, sorted, also of those whose messages are all lost.

        `types` leave those of some types: `LaserScan`, full names, globs; TopicError without any.
        """
        return self.recordings().topics(*types) if types else self.session.topics_of()

    def attachments(self, recording: str | RecordingEntry) -> list[StoredAttachment]:
        """The attachments of a recording's log, in their order.

        TopicError without such a recording, SegmentError for a damaged segment.
        """
        from hybridlog.attachments import attachments_of

        session = self.session
        return [each for e in session.select([recording]) for each in attachments_of(session, e)]

    def metadata(self, recording: str | RecordingEntry) -> list[StoredMetadata]:
        """The metadata records of a recording's log, in their order.

        TopicError without such a recording, SegmentError for a damaged segment.
        """
        from hybridlog.attachments import metadata_of

        session = self.session
        return [each for e in session.select([recording]) for each in metadata_of(session, e)]

    # Questions.

    def topic(self, *names: str) -> Query:
        """Make a query about topics: full names, clear short ones (`scan`), globs, `re:EXPRESSION`.

        TopicError if a name matches no topic, or several; the message lists candidates.
        """
        if not all(isinstance(name, str) for name in names):
            raise UsageError("Topics are names: topic('scan', 'odom').")
        return Query(self._source, self.session.question(names))

    def all_topics(self) -> Query:
        """Make a query about all topics."""
        session = self.session
        return Query(self._source, session.about(session.topics_of()))

    def query(self, topics: Sequence[str], recordings: Names | None = None) -> Query:
        """A question about topics by their full names, in some recordings or all.

        TopicError if no recording chosen has any of the topics.
        """
        if isinstance(topics, str):
            raise UsageError(f"query takes a list of names; topic({topics!r}) takes a name.")
        session = self.session
        ids = None if recordings is None else [one.id for one in session.named(recordings)]
        return Query(self._source, session.about(topics, ids))

    def tf(
        self, recording: Texts = None, *, of: str | None = None, topics: Sequence[str] = ()
    ) -> FrameTree:
        """The coordinate frames of a recording, and the transforms between them.

        Args:
            recording: Its name or id; None if the store has one alone.
            of: A topic: the tree is of `tf` and `tf_static` of its innermost namespace that has
                them, and for frames that these lack, of the root.
            topics: Topics with transforms instead.

        Raises:
            TopicError: Not one recording; no transforms, or those of several namespaces.
        """
        from hybridlog.tf.reader import Trees

        now = self.snapshot()
        chosen = now.recordings(recording).check()
        only = chosen.topic(*topics).topics if topics else ()
        trees = Trees(now.session, chosen.summaries, only)
        return trees.tree(of if of is None else chosen.topic(of).topics[0])

    def check(self, recording: Texts = None) -> list[TopicCheck]:
        """How regularly the topics of recordings, None for all, came, the worst first.

        See `Query.check`; TopicError if no recording matches.
        """
        return self.snapshot().recordings(recording).check().all_topics().check()

    def judge(self, contract: Contract | str | Path, recording: Texts = None) -> list[Result]:
        """The results of the rules of a contract, a file in YAML, on recordings; None for all.

        UsageError if it breaks its schema, TopicError if no recording matches.
        """
        from hybridlog.contract import Contract
        from hybridlog.contract.judge import judge

        rules = contract if isinstance(contract, Contract) else Contract.read(contract)
        now = self.snapshot()
        chosen = now.recordings(recording).check().summaries
        return [result for one in chosen for result in judge(now.session, rules, one)]

    def diff(
        self,
        a: Texts,
        b: Texts,
        *,
        topics: Sequence[str] = (),
        between: tuple[TimeLike | None, TimeLike | None] | None = None,
        tolerance: float = 0.0,
        counters: bool = False,
    ) -> list[Difference]:
        """Compare two recordings, or two choices of recordings, by topic; TopicError without any.

        Args:
            a: Name, id or glob; several recordings are compared together.
            b: The same.
            topics: Only these; empty for all.
            between: Only messages of this range of each; None for the time that both have, and
                what only one has is one difference.
            tolerance: Numbers are equal that differ by at most this share of the greater one.
            counters: Also counters and stamps in messages, which differ always.
        """
        from hybridlog.contract.diff import diff

        now = self.snapshot()
        sides = (now.recordings(one).check() for one in (a, b))
        return diff(*sides, topics=topics, between=between, tolerance=tolerance, counters=counters)

    def align(
        self,
        base: str | Query,
        others: str | Query | Sequence[str | Query],
        *,
        how: str = "asof",
        tolerance: DurationLike | None = None,
        fields: Mapping[str, Sequence[str]] | None = None,
        clock: str = "log",
        across_recordings: bool = False,
    ) -> Aligned:
        """Make a table of topics side by side: a row for each message of one topic.

        Columns are `log_time`, `recording` if there are several, the fields of each topic behind
        its name (`odom.pose.pose.position.x`), and of each other topic `scan.distance`, the time
        of its message minus that of the row. Without a message near enough they are null.

        Args:
            base: The topic whose messages are the rows, by name, or a query about one.
            others: The topics beside it, by names, or queries, such as with `where`.
            how: `asof`: the last message not after the row. `nearest`: the nearest one, the
                earlier of two. `interpolate`: between the last one and the next one.
            tolerance: Greatest distance in time; None for any.
            fields: Paths of the fields wanted, by topic name; None for all, or a query's own.
            clock: The time that is compared: `log`, `publish` or `header`.
            across_recordings: Messages of `others` may be of any recording of their queries,
                which `scan.recording` names; by default, of the row's.

        Raises:
            TopicError: no such topic or field, or a topic does not have the clock.
            UsageError: an unknown way or clock, a base of several topics, a query of another
                store, or one with limit, every or reverse.
            TimeError: the tolerance is no duration.
        """
        from hybridlog.across.align import side_by_side

        beside = [others] if isinstance(others, str | Query) else others
        if not isinstance(fields or {}, Mapping):
            raise UsageError("Fields are given by topic: fields={'scan': ['ranges.min']}.")
        chosen = dict(fields or {})
        now = self.snapshot()
        queries = [_query_of(now, one, chosen) for one in (base, *beside)]
        if chosen:
            raise TopicError(f"{', '.join(chosen)} of fields is no topic of this alignment.")
        questions = [query.question for query in queries]
        return side_by_side(
            now.session,
            questions[0],
            questions[1:],
            how=how,
            tolerance=tolerance,
            clock=clock,
            across_recordings=across_recordings,
        )

    def to_lerobot(
        self,
        query: Query,
        features: str | Path | Mapping[str, Any],
        path: str | Path,
        options: LerobotOptions | None = None,
        progress: Callable[[str, int], None] | None = None,
        **choices: Any,
    ) -> LerobotReport:
        """Write a training set in the format of LeRobot 3.0; one question gives the same bytes.

        Args:
            query: The recordings and their range.
            features: Which fields and images: the path of a map in YAML, or its values.
            path: Directory of the set.
            options: Options of the set.
            progress: Called with the name of each episode and the number of its frames.
            choices: Fields of `LerobotOptions`, instead of `options`.

        Raises:
            UsageError: The directory has something else, there is a gap, or no episode.
            TopicError: A recording lacks a topic.
            PayloadError: No picture can be shown.
            MissingDependencyError: PyAV is not installed.
        """
        from hybridlog.training.episodes import FeatureMap
        from hybridlog.training.lerobot import LerobotOptions, write_lerobot

        given = FeatureMap.given(features)
        chosen = options or LerobotOptions(**choices)
        return write_lerobot(of_now(query), given, path, chosen, progress=progress)

    def sync(
        self,
        topics: Sequence[str | Query],
        tolerance: DurationLike | None = None,
        clock: str = "header",
    ) -> Synced:
        """Make sets of messages of a recording with about the same time, as `ApproximateTime` does.

        Args:
            topics: Two or more, by names, or queries.
            tolerance: Longest duration of a set; None for any.
            clock: The time that is compared: `header`, as in ROS, `log` or `publish`.

        Raises:
            TopicError: no such topic, or one does not have the clock.
            UsageError: fewer than two topics, an unknown clock, or a limit, every or reverse.
            TimeError: the tolerance is no duration.
        """
        from hybridlog.across.sync import Synced

        if isinstance(topics, str):
            raise UsageError("Topics are a list: sync(['scan', 'odom']).")
        now = self.snapshot()
        queries = [_query_of(now, one, {}) for one in topics]
        questions = [narrowed(query, topic).question for query in queries for topic in query.topics]
        if clock not in {"log", "publish", "header"}:
            raise UsageError(f"Unknown clock {clock!r}; choose log, publish or header.")
        again = partial(_session_of, self.directory.address, self.shared.index.wanted)
        return Synced(now.session, again, questions, tolerance, cast("Clock", clock))

    def sql(
        self,
        query: str,
        params: Sequence[Any] | Mapping[str, Any] | None = None,
        *,
        recordings: Choice | Names | None = None,
        between: During = None,
        memory: int | None = None,
        timeout: float | None = None,
    ) -> SqlAnswer:
        """Ask in SQL. Needs the extra `sql`, and no MongoDB.

        Args:
            query: A query on views of topics (`base__scan`, or `scan` where that is
                unambiguous) and on `recordings`, `topics`, `losses` and `marks`.
            params: Values of `?` or `$name` in it.
            recordings: The recordings that views and tables show, or what they must satisfy;
                None for all.
            between: Range `[begin, end)` of log time, as for `Query.between`, of the messages
                that views show, and of the beginnings of marks.
            memory: Bytes that DuckDB may use by its own count, from 64 MiB; 1 GiB by default.
            timeout: Seconds that the answer may take; None for no limit.

        Returns:
            Has `to_arrow()`, `to_batches()`, `to_pandas()`, `to_polars()` and `rows()`.

        Raises:
            UsageError: The query is refused.
            TopicError: No recording satisfies the choice.
            TimeError: `between` is no range of time, or outside all recordings.
            MissingDependencyError: DuckDB is not installed.
        """
        from hybridlog.sql.engine import SqlEngine

        self.shared.check_process()
        self._sql = self._sql or SqlEngine(self._source)
        ids = None if recordings is None else tuple(one.id for one in self._chosen(recordings))
        scope = Question((), ids, Choice.of(during=between).during)
        return self._sql.query(query, params, timeout, memory=memory, scope=scope)

    # Changes.

    def record(
        self,
        log: str | Path | Source,
        options: RecordOptions | None = None,
        progress: Callable[[int, int], None] | None = None,
        **choices: Any,
    ) -> RecordReport:
        """Record a ROS 1 bag, a ROS 2 bag or an MCAP file.

        Args:
            log: Its path, or an opened source that was not read yet.
            options: Options of the recording.
            progress: Called with bytes read and messages stored.
            choices: Fields of `RecordOptions`, instead of `options`.

        Raises:
            SourceError: Nothing could be read.
            AlreadyRecordedError: Its content is in the store already.
        """
        from hybridlog.follow.child import LOOK_S, FollowerProcess
        from hybridlog.formats.log_set import open_source
        from hybridlog.formats.reading import fingerprint
        from hybridlog.record.recorder import RecordOptions, record

        shared = self._itself()
        shared.recover()
        with open_source(Path(log)) if isinstance(log, str | Path) else log as source:
            report = record(
                source,
                self.directory,
                self.shared.catalog,
                FollowerProcess.of_short(shared, "Recording a log", LOOK_S),
                shared.newest,
                fingerprint=fingerprint(source.files),
                options=options or RecordOptions(**choices),
                progress=progress,
            )
        shared.recorded(report)
        return report

    def start(self, name: str, options: LiveOptions | None = None, **choices: Any) -> LiveRecording:
        """Start a live recording, which takes messages one by one.

        Args:
            name: Name of the recording.
            options: Options of the recording.
            choices: Fields of `LiveOptions`, instead of `options`.
        """
        from hybridlog.follow.child import FollowerProcess
        from hybridlog.live import LiveOptions, LiveRecording
        from hybridlog.live.recording import follow_interval_s

        chosen, shared = options or LiveOptions(**choices), self._itself()
        shared.recover()
        interval_s = follow_interval_s(chosen)
        follow = FollowerProcess.of_short(shared, "Starting a recording", interval_s)
        return LiveRecording(shared, follow, name, chosen)

    def sizes(self, recordings: Names | None = None) -> Sizes:
        """Bytes of recordings and topics in segments and tables; TopicError if one is not there."""
        from hybridlog.maintenance.sizes import sizes_of

        return sizes_of(self.directory, self.session.select(recordings))

    @again_if_lost
    def verify(
        self,
        recordings: Names | None = None,
        progress: Progress | None = None,
        *,
        repair: bool = False,
    ) -> Verification:
        """Compare every byte of recordings, None for all, with their manifests.

        With `repair`, all repairs that lose no data are made first; `progress` is called after
        each chunk.
        """
        from hybridlog.maintenance.verify import verify

        if repair:
            self._to_change()
        self.refresh()
        names = None if recordings is None else self._with_unreadable(recordings)
        return verify(self.shared, names, progress, repairs=repair)

    def _with_unreadable(self, names: Names) -> dict[str, str]:
        """Names of recordings by id, where ids of those that cannot be read stand for them."""
        unreadable, names = self.shared.repairs.unreadable, [*names]
        found = {one: one for one in names if isinstance(one, str) and one in unreadable}
        others = self.session.select(
            [one for one in names if not isinstance(one, str) or one not in found]
        )
        return found | {one.id: one.name for one in others}

    def keep(
        self,
        rules: Mapping[str, Any] | None = None,
        *,
        dry_run: bool = False,
    ) -> KeepReport:
        """Delete what rules of retention do not let stay: payloads, then what is left of them.

        Args:
            rules: As the table `[retention]` in `hybridlog.toml` has them, such as
                `{"quota": "200GB"}`; None for that table.
            dry_run: True to say what would go, and delete nothing.

        Raises:
            UsageError: A rule is malformed.
            StoreError: Another process deletes here, too; or the store is read-only.
        """
        from hybridlog.maintenance.keep import Keeper, KeepReport
        from hybridlog.maintenance.retention import Rules

        self.shared.check_process()
        wanted = Rules.of(self.directory.settings.retention if rules is None else rules)
        if self.directory.is_remote or not dry_run:
            self.directory.check_writable()
        keeper = Keeper(self.directory, partial(edits.remove_if, self.shared))
        if dry_run:
            return KeepReport(keeper.plan(wanted))
        self._to_change()
        try:
            return keeper.keep(wanted)
        finally:
            self.refresh()

    def pin(
        self,
        recording: str | RecordingEntry,
        begin: TimeLike | None = None,
        end: TimeLike | None = None,
        topics: Sequence[str] | None = None,
        reason: str = "",
    ) -> str:
        """Pin `[begin, end)` of a recording, which is never deleted to make room.

        Log times are as for `Query.between`, None for no bound; `topics` are full names, None for
        all. Returns the name of the pin; TimeError for a range that is empty, or outside.
        """
        return edits.pin(self._to_change(), recording, (begin, end), topics, reason)

    def unpin(self, *names: str) -> None:
        """Remove pins; UsageError if there is none of a name."""
        edits.unpin(self._to_change(), names)

    def remove(self, recording: str) -> None:
        """Delete a recording, by name or id; StoreError if it is being written."""
        shared = self._to_change()
        edits.remove_if(shared, shared.now().entry(recording).id)

    def edit(
        self,
        recording: str | RecordingEntry,
        *,
        name: str | None = None,
        note: str | None = None,
        tag: Mapping[str, str] | None = None,
        untag: Iterable[str] = (),
    ) -> RecordingEntry:
        """Change what is said about a recording.

        Args:
            recording: Its name or id, or its entry.
            name: Another name; if another recording has it, it gets a number behind it.
            note: A note, which `info` shows.
            tag: Tags to set; keys that exist get the new values.
            untag: Keys of tags to remove.

        Raises:
            UsageError: A tag to remove does not exist, or something is empty or no text.
        """
        gone = [untag] if isinstance(untag, str) else [*untag]
        return edits.edit(
            self._to_change(), recording, name=name, note=note, tag=tag or {}, untag=gone
        )

    def mark(
        self,
        recording: str,
        moment: TimeLike,
        note: str,
        tags: Mapping[str, str] | None = None,
        *,
        until: TimeLike | None = None,
    ) -> RecordingEntry:
        """Set a mark at a time of a recording, which answers like a message on `/hybridlog/marks`.

        Args:
            recording: Name or id; it may be running.
            moment: Log time, as for `Query.between`.
            note: Text of the mark.
            tags: Tags of the mark.
            until: Log time of its end, for what lasted; None for a moment.

        Raises:
            TimeError: A time is invalid or outside the recording, or `until` before `moment`.
            StoreError: It has 10,000 marks already, or the store cannot be written.
        """
        return edits.mark(self._to_change(), recording, (moment, until), note, tags or {})

    def unmark(self, recording: str, note: str, moment: TimeLike | None = None) -> RecordingEntry:
        """Remove marks of a text that somebody set, at a log time, None for any.

        TimeError for an invalid time, UsageError without such a mark.
        """
        return edits.unmark(self._to_change(), recording, moment, note)

    def copy(
        self,
        to: str | Path,
        recordings: Choice | Names | None = None,
        options: CopyOptions | None = None,
        progress: Progress | None = None,
        report: CopyReport | None = None,
    ) -> CopyReport:
        """Copy recordings to another store; what is there already is not copied again.

        Every byte is proved there before a recording is seen; those that are damaged or have not
        ended are refused. After an interruption the next call goes on.

        Args:
            to: The other store: a directory, which is made, `ssh://user@host/path`, or a place in
                a bucket such as `s3://lab/store`.
            recordings: The recordings, or what they must satisfy; None for all.
            options: What is copied of them, and how.
            progress: Called with the bytes copied of all that are to be copied.
            report: Takes the result as it grows, so that it is known after an error, too.

        Raises:
            StoreError: The place is not reached, or cannot be written.
            DiskFullError: It has no room; what arrived stays.
        """
        from hybridlog.maintenance.copying import Copying, CopyOptions, CopyReport

        found = report or CopyReport()
        copying = Copying(self.shared, to, options or CopyOptions(), found, progress)
        self._to_change()
        copying.run(self._chosen(recordings))
        return found

    def _chosen(self, recordings: Choice | Names | None) -> Sequence[RecordingSummary]:
        """Recordings that are to be copied."""
        if isinstance(recordings, Choice):
            chosen = self.choose(recordings)
            return (chosen if recordings.is_everything else chosen.check()).summaries
        if recordings is None:
            return self.session.look().summaries
        names = [recordings] if isinstance(recordings, str) else recordings
        ids = {entry.id for entry in self.session.select(names)}
        return [one for one in self.session.look().summaries if one.id in ids]


def _query_of(store: Store, name: str | Query, fields: dict[str, Sequence[str]]) -> Query:
    """A query about a topic, with its share of the fields, which is taken out of them."""
    query = store.topic(name) if isinstance(name, str) else name
    if query.source.now().shared is not store.shared:
        place = query.source.now().directory.place
        raise UsageError(f"A query of {place} cannot be joined with another store's.")
    for key in [*fields]:
        if key == name or store.topic(key).topics == query.topics:
            query = query.fields(*fields.pop(key))
    return query
