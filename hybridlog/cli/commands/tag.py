"""`hybridlog tag`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hybridlog.cli import options, output
from hybridlog.cli.options import (
    AsJson,
    Choosing,
    InStore,
    Quiet,
    argument,
    command,
    option,
    recordings_of,
)
from hybridlog.query.choice import Choice
from hybridlog_storage.errors import UsageError

if TYPE_CHECKING:
    pass


class _Tag(Choosing, InStore, AsJson, Quiet):
    words: tuple[str, ...] = argument(
        "A recording, as for --recording, unless options choose; and tags to set. Without "
        "tags, show them.",
        "[RECORDING] [KEY=VALUE]...",
    )
    remove: tuple[str, ...] = option("Remove this tag.", "KEY")


@command(_Tag)
def tag_command(given: _Tag) -> None:
    """Set, show or remove the tags of recordings."""
    choice, pairs = given.choice, given.words
    if choice.is_everything and not pairs:
        raise UsageError("Name a recording, or choose some: -r 'monday*', --has TOPIC.")
    if choice.is_everything:
        choice, pairs = Choice.of(pairs[0]), pairs[1:]
    with given.opened() as store:
        chosen = recordings_of(store, choice).summaries
        tags = options.parse_tags(pairs)
        found = {}
        for one in chosen:
            # Of several recordings, some may lack a tag.
            keys = [key for key in given.remove if len(chosen) == 1 or key in one.tags]
            changed = store.edit(one.id, tag=tags, untag=keys) if keys or tags else one
            found[one.name] = changed.tags
    lines = (
        f"{'' if len(found) == 1 else f'{name}: '}{key}={value}"
        for name, own in found.items()
        for key, value in sorted(own.items())
    )
    output.tell(found, lines)
