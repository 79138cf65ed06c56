"""`hybridlog copy` and `import`."""

from __future__ import annotations

import sys
from contextlib import closing
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

from hybridlog.cli import options, output
from hybridlog.cli.binder import argument, command, option
from hybridlog.cli.open_store import opened_store
from hybridlog.cli.options import AsJson, Choosing, InStore, Quiet
from hybridlog.cli.progress import LateBar
from hybridlog.cli.signals import if_stopped
from hybridlog.wording import parse_size
from hybridlog_storage.errors import BucketError, ResourceError, StoreError, TopicError, UsageError
from hybridlog_storage.stopping import pause

if TYPE_CHECKING:
    from hybridlog.maintenance.copying import CopyOptions, CopyReport
    from hybridlog.query.choice import Choice
    from hybridlog.store import Store

_WATCH_S = 2.0  # between two looks at a store that is followed
_RUNNING: Final = frozenset({"open", "unfinished"})
_RETRY_S = 10.0  # after a broken connection


@dataclass(frozen=True, kw_only=True)
class _Copy(Choosing, InStore, AsJson, Quiet):
    names: tuple[str, ...] = options.names_argument()  # type: ignore[misc]
    to: str = argument("A directory, ssh://user@host/path, or s3://bucket/path.", "TO")
    only_fields: bool = option("Fields first; a later copy adds the payloads.")
    then_expire: bool = option(
        "Delete payloads here once their copy is proved there; pinned ones stay."
    )
    limit_rate: str | None = option("Bytes a second at most, such as 5MB/s.", "RATE")
    check: bool = option("Read copies that are there already, too, and mend them in a bucket.")
    watch: bool = option("Go on with what ends later, until Ctrl-C.")
    ssh: str | None = option(
        "The ssh program, with options; without, ssh.",
        "COMMAND",
        envvar="HYBRIDLOG_SSH",
        show_envvar=True,
    )
    program: str = option("hybridlog on the server.", "PATH", default="hybridlog")
    receive: bool = option("Be the other side of a copy: run by it on the server.")


@command(_Copy, "copy")
def copy_command(given: _Copy) -> None:
    """Copy recordings to a directory, a server over ssh, or a bucket.

    Every byte is proved there before a recording gets its name. After a cut, run it again: it
    goes on where it stopped. A recording that is there already is not copied again.
    """
    from hybridlog.maintenance.copying import CopyOptions

    if given.receive:
        _receive(Path(given.to))
        return
    rate = _rate(given.limit_rate)
    how = CopyOptions(
        given.only_fields, given.then_expire, rate, given.ssh, given.program, check=given.check
    )
    with (
        given.opened(is_lasting=given.watch) as store,
        if_stopped("What arrived stays there: run the command again."),
    ):
        if given.watch:
            _watch(store, given, how)
        report = _copied(store, given, given.choice, how)
    _check(report)


def _bar(what: str, given: _Copy | _Import) -> closing[LateBar]:
    return closing(LateBar(what, quiet=given.quiet or given.as_json))


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

    report = CopyReport()
    try:
        with _bar("copy", given) as bar:
            store.copy(given.to, chosen, how, bar, report)
    except BaseException:
        if report != CopyReport():
            _print(report, given, is_short=is_short)
        raise
    _print(report, given, is_short=is_short)
    return report


def _watch(store: Store, given: _Copy, how: CopyOptions) -> NoReturn:
    """Copy what ends, until a signal ends the command."""
    done: set[str] = set()
    seen = None
    while True:
        now = {(one.id, one.status) for one in store.summaries()}
        ended = [
            one.id for one in store.choose(given.choice).summaries if one.status not in _RUNNING
        ]
        new = [one for one in ended if one not in done] if now != seen else []
        try:
            held: list[str] = []
            if new:
                report = _copied(store, given, new, how, is_short=True)
                sys.stdout.flush()
                output.notes([*report.refused.values(), *report.problems])
                held = report.held
            done.update(one for one in new if one not in held)
            seen = None if held else now
            pause(_RETRY_S if held else _WATCH_S)
        except TopicError:
            pause(_WATCH_S)  # one was removed since it was chosen
        except (StoreError, BucketError, ResourceError) as error:
            output.note(f"{error} Trying again in {_RETRY_S:.0f} s.")
            pause(_RETRY_S)


def _receive(path: Path) -> None:
    """Do what the copy on the other side of standard input asks."""
    from hybridlog.maintenance.ssh import serve

    with (
        opened_store(path, None, create=True, quiet=True) as opened,
        opened.receiving() as place,
        open(0, "rb", buffering=0, closefd=False) as requests,
    ):
        serve(place, requests, sys.stdout.buffer)


def _print(
    report: CopyReport,
    given: _Copy | _Import,
    words: tuple[str, str] = ("copied", "there"),
    *,
    is_short: bool = False,
) -> None:
    """Print what was copied.

    Args:
        report: The result.
        given: The options.
        words: What was done with the recordings, and where they are.
        is_short: Leave out what is there already; JSON is one line.
    """
    if given.as_json:
        (output.print_json_line if is_short else output.print_json)(asdict(report))
    elif not given.quiet:
        for label in report.copied:
            output.say(f"{words[0]} {label}")
        for label in () if is_short else report.known:
            lacks = label in report.lacking
            more = f"; payloads that were deleted {words[1]} were not copied" if lacks else ""
            output.say(f"{label} is {words[1]} already{more}")
        if report.freed_bytes:
            output.say(f"{output.size(report.freed_bytes)} freed")


def _check(report: CopyReport) -> None:
    """Fail if something was not copied, or did not expire.

    Raises:
        StoreError: It was not.
    """
    left = [*report.refused.values(), *report.problems]
    if left:
        sys.stdout.flush()
        raise StoreError(" ".join(left))


def _rate(text: str | None) -> float | None:
    """Bytes a second.

    Raises:
        UsageError: The text is no rate, or it is 0.
    """
    rate = None if text is None else parse_size(text.removesuffix("/s"))
    if rate == 0:
        raise UsageError("--limit-rate must be more than 0.")
    return rate


@dataclass(frozen=True, kw_only=True)
class _Import(Choosing, InStore, AsJson, Quiet):
    other: Path = argument("Directory of the other store.", "STORE")


@command(_Import, "import")
def import_command(given: _Import) -> None:
    """Copy recordings in from another store.

    Every byte is checked. After an interruption, run it again: it goes on where it stopped.
    """
    with (
        given.opened(create=True) as store,
        if_stopped("What arrived stays here: run the command again."),
        _bar("import", given) as bar,
    ):
        report = store.import_from(given.other, given.choice, bar)
    _print(report, given, ("imported", "here"))
    _check(report)
