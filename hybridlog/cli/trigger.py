"""`hybridlog trigger`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from hybridlog.cli import options, output
from hybridlog.cli.answers import print_cost
from hybridlog.cli.open_store import opened_store
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    from hybridlog.live.rehearsal import Rehearsal


@click.command()
@click.argument("name", metavar="[NAME]", required=False, help="The reason, in a word.")
@options.running
@options.store
@click.option(
    "--rehearse",
    metavar="TOPIC: PREDICATE",
    help="Instead: how often this trigger would have fired on what is stored, and what it "
    "would have kept.",
)
@click.option(
    "--since",
    metavar="T",
    help="With --rehearse: only from this time on, or from so long ago: 30d.",
)
@click.option(
    "--before",
    metavar="DURATION",
    help="With --rehearse: time before the trigger, as of record --ring; without, 10s.",
)
@click.option(
    "--after", metavar="DURATION", help="With --rehearse: time after the trigger; without, 0."
)
@options.mongo
@options.as_json
@options.quiet
@options.verbose
def trigger_command(
    *,
    name: str | None,
    recording: tuple[str, ...],
    store: Path | None,
    rehearse: str | None,
    since: str | None,
    before: str | None,
    after: str | None,
    mongo: str | None,
    as_json: bool,
    quiet: bool,
) -> None:
    """Make a recorder write its ring, or rehearse a trigger.

    A rehearsal says how often a predicate would have fired on what is stored.
    """
    if rehearse is None:
        if since is not None or before is not None or after is not None or as_json:
            raise UsageError("--since, --before, --after and --json are for --rehearse.")
        _fire(name or "", recording, store, quiet=quiet)
        return
    if name is not None:
        raise UsageError("A rehearsal triggers nothing: leave out NAME.")
    with opened_store(store, mongo, quiet=quiet or as_json) as opened:
        found = opened.rehearse(
            rehearse,
            since=since,
            before=before or "10s",
            after=after or 0,
            recordings=recording or None,
        )
        labels = {summary.id: summary.label for summary in opened.summaries()}
    if as_json:
        output.print_json(_as_dict(found, labels))
    else:
        _print(found)
    if not quiet:
        for remark in found.remarks:
            output.note(remark)
        if not found.recordings:
            output.note("No recording is from that time.")
        print_cost(found.counters, found.counters.elapsed_s, count=True)


def _fire(name: str, recording: tuple[str, ...], store: Path | None, *, quiet: bool) -> None:
    from hybridlog.live.control_server import choose, request
    from hybridlog.store import store_path

    if not name.strip():
        raise UsageError("A trigger needs a name: give the reason in a word.")
    path = store_path(store)
    for recorder in choose(path, recording):
        answer = request(path, recorder, "trigger", reason=name)
        if not quiet:
            output.note(f"{answer['recording']} writes a snapshot.")


def _as_dict(found: Rehearsal, labels: dict[str, str]) -> dict[str, object]:
    return {
        "trigger": found.trigger,
        "recordings": found.recordings,
        "fired": found.fired,
        "messages": found.messages,
        "payload_bytes": found.payload_bytes,
        "stored_bytes": found.stored_bytes,
        "snapshots": [
            {
                "recording": labels[one.recording],
                "begin_ns": one.begin_ns,
                "end_ns": one.end_ns,
                "messages": one.messages,
            }
            for one in found.snapshots
        ],
    }


def _print(found: Rehearsal) -> None:
    share = 100 * found.payload_bytes / found.stored_bytes if found.stored_bytes else 0.0
    kept = f"{output.counted(found.messages, 'message')}, {output.size(found.payload_bytes)}"
    rows = [
        ("trigger", found.trigger),
        ("recordings", str(found.recordings)),
        ("fired", output.counted(found.fired, "time")),
        ("snapshots", str(len(found.snapshots))),
        ("kept", f"{kept} of {output.size(found.stored_bytes)} of payload ({share:.3g} %)"),
    ]
    width = max(len(heading) for heading, _ in rows)
    for heading, text in rows:
        output.say(f"{heading:<{width}}  {text}")
