"""`hybridlog copy`."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog.cli import options, output
from hybridlog.cli.options import (
    Amount,
    AsJson,
    Choosing,
    InStore,
    Quiet,
    argument,
    command,
    option,
)
from hybridlog.cli.output import Bar
from hybridlog.cli.signals import watch
from hybridlog.wording import parse_size
from hybridlog_storage.errors import (
    StoreError,
    TopicError,
    UsageError,
)

if TYPE_CHECKING:
    from hybridlog.maintenance.copying import CopyOptions, CopyReport
    from hybridlog.query.choice import Choice
    from hybridlog.store import Store


_RUNNING: Final = frozenset({"open", "unfinished"})


_RATE: Final = Amount(lambda text: parse_size(text.removesuffix("/s")), "1B/s")


class _Copy(Choosing, InStore, AsJson, Quiet):
    names: tuple[str, ...] = options.names_argument()  # type: ignore[misc]
    to: str | None = argument("A directory, ssh://user@host/path, or s3://bucket/path.", "[TO]")
    source: Path | None = option(
        "Instead of TO: copy from this store, a directory or s3://bucket/path, into the one here.",
        "STORE",
        name="--from",
    )
    only_fields: bool = option("Fields first; a later copy adds the payloads.")
    then_expire: bool = option(
        "Delete payloads here once their copy is proved there; pinned ones stay."
    )
    limit_rate: float | None = option("Bytes a second at most, such as 5MB/s.", "RATE", type=_RATE)
    check: bool = option("Prove copies that are there already, too, and mend them.")
    watch: bool = option("Go on with what ends later, until Ctrl-C.")
    ssh: str | None = option(
        "The ssh program, with options; without, ssh.",
        "COMMAND",
        envvar="HYBRIDLOG_SSH",
        show_envvar=True,
    )


@command(_Copy, "copy")
def copy_command(given: _Copy) -> None:
    """Copy recordings to or from another store.

    It is a directory, a server over ssh, or a bucket. Every byte is proved there before a
    recording is seen. After a cut, run it again: it goes on where it stopped. A recording that is
    there already is not copied again.
    """
    from hybridlog.maintenance.copying import CopyOptions

    if given.source is not None:
        given = _from_elsewhere(given, given.source)
    if given.to is None:
        raise UsageError("Name the place to copy to, or with --from STORE the one to copy from.")
    how = CopyOptions(
        given.only_fields, given.then_expire, given.limit_rate, given.ssh, given.check
    )
    with given.opened() as store:
        if given.watch:
            look = partial(_look, store, given, how, set[str]())
            watch(store.directory.place, look)
            return
        report = _copied(store, given, given.choice, how)
    if left := [*report.refused.values(), *report.problems]:
        sys.stdout.flush()
        raise StoreError(" ".join(left))


def _from_elsewhere(given: _Copy, source: Path) -> _Copy:
    """The same as a copy by the other store, to the one here."""
    from hybridlog.store import store_path
    from hybridlog_storage.settings import NONE

    if given.mongo is not None:
        with given.opened(create=True):
            pass
    names = given.names if given.to is None else (*given.names, given.to)
    to = str(store_path(given.store))
    changed = {"names": names, "to": to, "store": source, "mongo": NONE}
    return _Copy(**{**vars(given), **changed})


def _copied(
    store: Store,
    given: _Copy,
    chosen: Choice | list[str],
    how: CopyOptions,
    *,
    is_short: bool = False,
) -> CopyReport:
    """Copy recordings and print what was copied, also if an error ends it."""
    from hybridlog.maintenance.copying import CopyReport

    assert given.to is not None
    report, there = CopyReport(), "there" if given.source is None else "here"
    lacking = f"; payloads that were deleted {there} were not copied"
    try:
        with Bar("copy") as bar:
            store.copy(given.to, chosen, how, bar.part, report)
    finally:
        if sys.exception() is None or report != CopyReport():
            lines = [f"copied {name}" for name in report.copied]
            lines += (
                f"{name} is {there} already{lacking if name in report.lacking else ''}"
                for name in (() if is_short else report.known)
            )
            if report.freed_bytes > 0:  # of a few messages, fields may take more than payloads
                lines.append(f"{output.size(report.freed_bytes)} freed")
            output.tell(asdict(report), lines, at_once=is_short)
    return report


def _look(store: Store, given: _Copy, how: CopyOptions, done: set[str]) -> Iterator[StoreError]:
    """Copy what has ended and is not `done`; yields why something was not copied."""
    store.shared.recover()
    chosen = store.choose(given.choice).summaries
    new = [one.id for one in chosen if one.id not in done and one.status not in _RUNNING]
    if not new:
        return
    try:
        report = _copied(store, given, new, how, is_short=True)
    except TopicError:
        return  # one was removed since it was chosen
    done.update({*new}.difference(report.held))
    problems = [*report.refused.values(), *report.problems]
    if report.held:
        raise StoreError(" ".join(problems))
    yield from map(StoreError, problems)
