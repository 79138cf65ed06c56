"""`hybridlog verify`."""

from __future__ import annotations

import time
from contextlib import nullcontext, suppress
from fnmatch import fnmatchcase
from typing import TYPE_CHECKING

from msgspec.structs import asdict, replace

from hybridlog.cli import output
from hybridlog.cli.options import (
    AsJson,
    Choosing,
    InStore,
    Quiet,
    command,
    names_argument,
    option,
    recordings_of,
)
from hybridlog.cli.output import Bar
from hybridlog.wording import listed
from hybridlog_storage.errors import TopicError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from hybridlog.store import Store
    from hybridlog_storage.catalog import RecordingSummary


class _Verify(Choosing, InStore, AsJson, Quiet):
    names: tuple[str, ...] = names_argument()  # type: ignore[misc]
    repair: bool = option("Mend what can be mended without losing anything; list the rest.")
    new_id: bool = option(
        "With --repair: the store is a copy, give it an id of its own, with the index at --mongo.",
        needs=("repair",),
    )


@command(_Verify)
def verify_command(given: _Verify) -> int:
    """Read everything, and check checksums.

    Exits with 1 when it finds a problem, and prints a cure for each. With --repair, it restores
    the names of segments, makes damaged summaries and lost manifests again, and brings catalog and
    index up to date before that.
    """
    if given.new_id:
        from hybridlog.maintenance.verify import become_another
        from hybridlog.store import store_path

        become_another(store_path(given.store), given.mongo)
        output.note("The store has a new id now.")
    started = time.monotonic()
    with given.opened(verifies=True) as store:
        chosen, unreadable = _chosen(given, store)
        ids = None if given.choice.is_everything else [*unreadable, *(one.id for one in chosen)]
        with Bar("verify") as bar:
            result = store.verify(ids, bar.part, repair=given.repair)
    elapsed = time.monotonic() - started
    if given.as_json:
        output.print_json({**asdict(result), "seconds": round(elapsed, 3)})
    else:
        lines = [(one.recording, one.place, f"mended: {one.done}") for one in result.repaired]
        lines += (
            (one.recording, one.place, f"{one.problem.removesuffix('.')}; {one.cure}")
            for one in result.findings
        )
        for line in lines:
            output.say(": ".join(filter(None, line)))
        many = len(result.findings)
        told = (
            f"{output.counted(result.recordings, 'recording')}, "
            f"{output.counted(result.chunks, 'chunk')}, "
            f"{output.counted(result.messages, 'message')}, "
            f"{output.size(result.bytes_read)} read in {elapsed:.2f} s: "
            f"{output.counted(many, 'problem') if many else 'all is well'}"
        )
        output.tell(None, [told])
        if running := [one.name for one in chosen if one.status == "open"]:
            said = f"Still being recorded, and checked as far as sealed: {listed(running)}."
            output.remarks([said])
    return 1 if result.findings else 0


def _chosen(given: _Verify, store: Store) -> tuple[Sequence[RecordingSummary], list[str]]:
    """The chosen recordings, and ids of chosen ones that cannot be read: their names are lost."""
    choice, known = given.choice, store.shared.repairs.unreadable
    unreadable = [one for one in known if any(fnmatchcase(one, name) for name in choice.name)]
    names = tuple(name for name in choice.name if name not in unreadable)
    if names or not unreadable:
        with suppress(TopicError) if unreadable else nullcontext():
            return recordings_of(store, replace(choice, name=names)).summaries, unreadable
    return (), unreadable
