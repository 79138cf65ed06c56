"""`hybridlog verify` and `compact`."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.binder import command, option
from hybridlog.cli.options import AsJson, Choosing, InStore, Named, Quiet
from hybridlog.cli.progress import Stages, progress_bar
from hybridlog.cli.signals import if_stopped
from hybridlog.wording import listed
from hybridlog_storage.errors import DatabaseError, UsageError, WithoutMongoError

if TYPE_CHECKING:
    from hybridlog.maintenance.report import CompactedTopic
    from hybridlog.maintenance.verify import Verification


@dataclass(frozen=True, kw_only=True)
class _Verify(Named, InStore, AsJson, Quiet):
    repair: bool = option("Mend what can be mended without losing anything; list the rest.")
    moved: bool = option("With --repair: the store was moved to here, take its index over.")
    new_id: bool = option(
        "With --repair: the store is a copy, give it an id of its own, with the index at --mongo."
    )


@command(_Verify)
def verify_command(given: _Verify) -> None:
    """Read everything, check checksums and references.

    Exits with 1 when it finds a problem, and prints a cure for each. With --repair, it restores
    the names of segments, writes damaged summaries and journals again, and brings catalog and
    index up to date; it exits with 1 when only a copy can restore the rest.
    """
    if given.repair:
        _repair(given)
        return
    if given.moved or given.new_id:
        raise UsageError("--moved and --new-id are for --repair: give that, too.")
    started = time.monotonic()
    with given.opened(quiet=given.quiet) as store:
        chosen = given.recordings_in(store)
        total = sum(entry.stored_bytes for entry in chosen.summaries)
        with progress_bar("verify", total, quiet=given.quiet) as bar:
            result = store.verify(None if given.choice.is_everything else chosen, Stages(bar))
        why = store.session.unavailable
    elapsed = time.monotonic() - started
    if given.as_json:
        output.print_json({**asdict(result), "seconds": round(elapsed, 3)})
    else:
        _print(result, elapsed, quiet=given.quiet)
        running = [one.label for one in chosen.summaries if one.status == "open"]
        if running and not given.quiet:
            output.note(f"Still being recorded, and checked as far as sealed: {listed(running)}.")
    is_wanted = not isinstance(why, WithoutMongoError)
    if not result.index and is_wanted and (result.findings or why is None):
        output.note(f"The index was not compared: {why}")
    if result.findings:
        raise click.exceptions.Exit(1)
    if not result.index and is_wanted and why is not None:
        raise DatabaseError(f"The index was not compared: {why}")


def _print(result: Verification, elapsed: float, *, quiet: bool) -> None:
    for finding in result.findings:
        of = f"{finding.recording}: " if finding.recording else ""
        output.say(f"{of}{finding.place}: {finding.problem.removesuffix('.')}; {finding.cure}")
    if quiet:
        return
    verdict = "all is well" if result.index else "all is well in the files"
    if result.findings:
        verdict = output.counted(len(result.findings), "problem")
    output.say(
        f"{output.counted(result.recordings, 'recording')}, "
        f"{output.counted(result.chunks, 'chunk')}, "
        f"{output.counted(result.messages, 'message')}, "
        f"{output.size(result.bytes_read)} read in {elapsed:.2f} s: {verdict}"
        f"{output.without_documents(result.without_documents)}"
    )


def _repair(given: _Verify) -> None:
    """Mend what can be mended, and list what is left."""
    if given.moved and given.new_id:
        raise UsageError("A store was moved or it is a copy: give --moved or --new-id, not both.")
    if given.new_id:
        from hybridlog.maintenance.lease import become_another
        from hybridlog.store import store_path

        become_another(store_path(given.store), given.mongo)
        output.say("the store has a new id now")
    with given.opened(quiet=given.quiet) as store:
        if given.moved:
            store.session.take_over()
            output.say("the index belongs to the store at this place now")
        chosen = None if given.choice.is_everything else given.recordings_in(store)
        with progress_bar("repair", 0, quiet=given.quiet) as bar:
            done = store.verify(chosen, Stages(bar), repair=True)
    left = [one for one in done if not one.is_cured]
    if given.as_json:
        output.print_json([asdict(one) for one in done])
    else:
        for one in done:
            result = "mended" if one.is_cured else "left"
            of = f"{one.recording}: " if one.recording else ""
            output.say(f"{of}{one.place}: {result}: {one.done}")
        if not done and not given.quiet:
            output.say("nothing to mend")
    if left:
        raise click.exceptions.Exit(1)


@dataclass(frozen=True, kw_only=True)
class _Compact(Choosing, InStore, AsJson, Quiet):
    topic: tuple[str, ...] = options.topics()
    drop_mcap: bool = option("Take payloads that are in columns out of the segments.")
    dry_run: bool = option("Only say what would be done.")


@command(_Compact)
def compact_command(given: _Compact) -> None:
    """Write payloads into columns that any reader opens.

    Of ended recordings: laser scans, point clouds by their own fields, images, and other
    arrays of numbers. Every message is rebuilt from its columns and compared byte for byte
    before the columns are used. Without --topic, topics are chosen that consist of arrays
    mostly.
    """
    choice = given.choice
    with (
        given.opened(quiet=given.quiet) as store,
        if_stopped("Recordings that were finished have their columns; run it again."),
        progress_bar("compact", 0, quiet=given.quiet) as bar,
    ):
        found = store.compact(
            None if choice.is_everything else given.recordings_in(store),
            given.topic or None,
            drop_mcap=given.drop_mcap,
            dry_run=given.dry_run,
            progress=Stages(bar),
        )
    if given.as_json:
        output.print_json([asdict(one) for one in found])
        return
    for one in found:
        output.say(_told(one, dry_run=given.dry_run))
    if not found and not given.quiet:
        output.say("nothing to compact")


def _told(one: CompactedTopic, *, dry_run: bool) -> str:
    """A line about a topic."""
    parts = []
    if one.messages and dry_run:
        parts.append(f"{one.messages} messages would get columns")
    elif one.messages:
        parts.append(
            f"{one.messages} messages, {output.size(one.payload_bytes)}, in columns of "
            f"{output.size(one.column_bytes)}"
        )
    if one.dropped:
        parts.append(f"{one.dropped} messages taken out of the segments")
    if one.both:
        parts.append(f"{one.both} stay there, too: their chunks hold messages without columns")
    if one.kept:
        parts.append(f"{one.kept} without columns: {one.reason}")
    return f"{one.recording} {one.topic}: {'; '.join(parts)}"
