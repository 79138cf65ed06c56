"""Completion of recordings and topics, and the scripts that teach it to a shell.

The names come from directories and the catalog: nothing is repaired, no MongoDB is started.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Final

from hybridlog_storage.errors import HybridlogError, UsageError

if TYPE_CHECKING:
    import click
    from click.shell_completion import ShellComplete

    from hybridlog.snapshot import Snapshot
    from hybridlog_storage.disk.directory import StoreDirectory

VARIABLE: Final = "_HYBRIDLOG_COMPLETE"
"""Environment variable in which a shell asks for completions."""
_SCRIPTS: Final = {
    "bash": ".local/share/hybridlog/completion.bash",
    "zsh": ".zfunc/_hybridlog",
    "fish": ".config/fish/completions/hybridlog.fish",
}
"""Path of the script of each shell, relative to the home directory."""
_STARTUP: Final = {
    "bash": (".bashrc", 'source "$HOME/.local/share/hybridlog/completion.bash"'),
    "zsh": (".zshrc", 'fpath+="$HOME/.zfunc"; autoload -Uz compinit; compinit'),
}
"""Startup file of a shell and the line in it that loads the script; fish needs none."""


def complete_recording(context: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
    """Labels of recordings that begin with what was typed."""
    with _nothing_on_error():
        return [i for i in _store(context).labels() if i.startswith(incomplete)]
    return []


def complete_tag(context: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
    """Tags of recordings: keys, and values after the equals sign."""
    with _nothing_on_error():
        tags = _snapshot(_store(context)).tags
        if "=" in incomplete:
            key = incomplete.partition("=")[0]
            offered = [f"{key}={value}" for value in tags.get(key, ())]
        else:
            offered = list(tags)
        return sorted(tag for tag in offered if tag.startswith(incomplete))
    return []


def complete_type(context: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
    """Types of messages, whole or by the name behind the package."""
    from contextlib import closing

    from hybridlog.maintenance.opening import open_catalog

    with _nothing_on_error():
        directory = _store(context)
        with closing(open_catalog(directory)) as catalog:
            schemas = catalog.schemas(_snapshot(directory).schemas)
        names = {schema.name for schema in schemas.values()}
        names |= {name.rpartition("/")[2] for name in names if incomplete}
        return sorted(name for name in names if name.startswith(incomplete))
    return []


def complete_running(context: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
    """Ids of running recorders that begin with what was typed."""
    from hybridlog.live.control_server import running

    with _nothing_on_error():
        return [name for name in running(_store(context).path) if name.startswith(incomplete)]
    return []


def complete_field(context: click.Context, param: click.Parameter, incomplete: str) -> list[str]:
    """Topics, with the colon that a field follows."""
    if ":" in incomplete:
        return []
    return [f"{topic}:" for topic in complete_topic(context, param, incomplete)]


def complete_condition(
    context: click.Context, param: click.Parameter, incomplete: str
) -> list[str]:
    """Topics, with the colon and space that a predicate follows."""
    if ":" in incomplete:
        return []
    return [f"{topic}: " for topic in complete_topic(context, param, incomplete)]


def complete_topic(context: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
    """Topics that begin with what was typed; without a slash, short names as well.

    A short name is offered when it stands for one topic only. With `--recording`, the
    topics of those recordings are offered.
    """
    with _nothing_on_error():
        given = context.params.get("recording") or ()
        topics = _topics(_store(context), (given,) if isinstance(given, str) else tuple(given))
        found = {topic for topic in topics if topic.startswith(incomplete)}
        if incomplete and not incomplete.startswith("/"):
            found.update(n for n in _short_names(topics) if n.startswith(incomplete))
        return sorted(found)
    return []


def complete_path(context: click.Context, _: click.Parameter, incomplete: str) -> list[str]:
    """Fields of the topics of the command, for the last name in a list or a predicate."""
    last = re.findall(r"[\w.]*$", incomplete)[0]
    before = incomplete.removesuffix(last)
    # The parser leaves words where a value is missing, as that of the option that is completed.
    given = [*context.args, *(context.params.get("words") or ())]
    given += context.params.get("topic") or ()
    if not context.resilient_parsing:  # what is completed was taken for a topic
        given = [topic for topic in given if topic != incomplete]
    with _nothing_on_error():
        from hybridlog.frames.names import SUMMARIES, is_summary
        from hybridlog.store import Store

        with Store(_store(context, read_only=True), mongo="none", recover=False) as store:
            known = (store.topic(*given).field_types() if given else None) or {}
        array = last.rpartition(".")[0]
        summaries = (f"{array}.{name}" for name in SUMMARIES)
        names = [*known, *(name for name in summaries if is_summary(name, known))]
        return [f"{before}{name}" for name in names if name.startswith(last)]
    return []


def _store(context: click.Context, *, read_only: bool = False) -> StoreDirectory:
    from hybridlog_storage.lazy import import_numpy_late

    import_numpy_late()
    from hybridlog.store import store_path
    from hybridlog_storage.remote import directory_of

    value: Path | None = context.params.get("store")
    # The shell has not expanded the tilde of the line that is being completed.
    path = store_path(None if value is None else os.path.expanduser(value))  # noqa: PTH111
    return directory_of(path, read_only=read_only)


def _topics(directory: StoreDirectory, recordings: Sequence[str]) -> set[str]:
    """Topics in the catalog, of some recordings or of all; nothing is repaired for it."""
    snapshot = _snapshot(directory)
    named = [
        place
        for name in recordings
        for place in snapshot.called(name) or snapshot.matching(name) or snapshot.named(name)
    ]
    if not named:
        return set(snapshot.topics)
    return {topic for place in named for topic in snapshot.topics_of(snapshot.summaries[place])}


def _snapshot(directory: StoreDirectory) -> Snapshot:
    """The recordings in the catalog, with what is flushed; nothing is repaired for it."""
    from contextlib import closing

    from hybridlog.entries import summary_of
    from hybridlog.maintenance.opening import open_catalog, snapshot_of

    with closing(open_catalog(directory)) as catalog:
        found = snapshot_of(catalog, catalog.summaries())
        for summary in [found.summaries[place] for place in found.unfinished]:
            from hybridlog.record.running import RunningRecording

            known = catalog.recording(summary.id)
            if known is None:
                continue
            running = RunningRecording(directory, summary.label, partial(itemgetter(1), known))
            running.follow()
            if running.entry is not None:
                now = summary_of(running.entry, summary.look)
                found = found.with_changes([now], {now.topics: running.topics})
        return found


def _short_names(topics: set[str]) -> Iterator[str]:
    """Short names that stand for one topic only: `scan` for `/robot/scan`."""
    owners: dict[str, int] = {}
    for topic in topics:
        parts = topic.strip("/").split("/")
        for start in range(len(parts)):
            name = "/".join(parts[start:])
            owners[name] = owners.get(name, 0) + 1
    yield from (name for name, count in owners.items() if count == 1)


@contextmanager
def _nothing_on_error() -> Iterator[None]:
    """Swallow errors: a shell that completes a line cannot show them."""
    try:
        yield
    except (HybridlogError, OSError):
        return


def show_completion(context: click.Context) -> str:
    """The completion script of the user's shell."""
    return _script(context, _shell()).source()


def install_completion(context: click.Context) -> str:
    """Write the completion script to where the user's shell loads it.

    Returns:
        What was done, for people.

    Raises:
        UsageError: A file cannot be written.
    """
    shell = _shell()
    path = Path.home() / _SCRIPTS[shell]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(_script(context, shell).source(), encoding="utf-8")
        if shell in _STARTUP:
            name, line = _STARTUP[shell]
            _append_once(Path.home() / name, line)
    except OSError as error:
        raise UsageError(
            f"{error.filename} cannot be written: {error.strerror}. "
            "`hybridlog --show-completion` prints the script."
        ) from error
    return f"Completion for {shell} is installed in {path}. Open a new terminal to use it."


def _append_once(path: Path, line: str) -> None:
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    if line not in text.splitlines():
        path.write_text(f"{text.rstrip()}\n{line}\n".lstrip(), encoding="utf-8")


def _shell() -> str:
    shell = Path(os.environ.get("SHELL", "")).name
    if shell not in _SCRIPTS:
        raise UsageError(
            f"Completion works in {', '.join(_SCRIPTS)}: set the variable SHELL to one of them."
        )
    return shell


def _script(context: click.Context, shell: str) -> ShellComplete:
    from click.shell_completion import get_completion_class

    kind = get_completion_class(shell)
    assert kind is not None
    return kind(context.command, {}, "hybridlog", VARIABLE)
