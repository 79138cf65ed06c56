"""A command of click with help that wraps between words, and errors that say what was meant."""

from __future__ import annotations

import difflib
import shlex
import textwrap
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import Any, Final

import click

from hybridlog_storage.errors import TopicError

_FIRST: Final = ("topic", "between", "where", "fields", "output", "form")
_SECTIONS: Final[dict[str, tuple[str, ...]]] = {
    "Live recording": (),
    "With lerobot": (
        "features", "propose_map", "fps", "episodes_by", "task", "task_topic", "vcodec", "on_gap",
    ),
    "Choosing recordings": (
        "recording", "tag", "has", "types", "during", "last", "older_than", "conditions",
    ),
    "Common options": (
        "force", "strict", "as_json", "quiet", "verbose", "store", "mongo", "_click_default_help",
    ),
}  # fmt: skip
"""Sections of help behind the options of a command alone, and what is in them everywhere."""
_NEAR: Final = 0.75  # likeness of an option that is suggested
_NAMED: Final = {"recording": "-r", "topic": "-t", "fields": "--fields"}
"""Options whose values people type as arguments, and how they are written."""


class _Formatter(click.HelpFormatter):
    """Breaks the long terms of a list of options at blanks and behind `|`."""

    def write_dl(
        self, rows: Iterable[tuple[str, str]], col_max: int = 30, col_spacing: int = 2
    ) -> None:
        room = self.width - self.current_indent
        shown = [(term if len(term) <= room else _folded(term, room), text) for term, text in rows]
        super().write_dl(shown, col_max, col_spacing)


def _folded(term: str, room: int) -> str:
    lines = textwrap.wrap(
        term.replace("|", "| "),
        room,
        subsequent_indent=" " * 8,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join(line.replace("| ", "|") for line in lines)


class Context(click.Context):
    """A context whose help is wrapped between words."""

    formatter_class = _Formatter


class Command(click.Command):
    """A command that says which option a word was meant for."""

    context_class = Context

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The parameters: those that most people need first, those of all commands last."""
        order = {name: n - len(_FIRST) for n, name in enumerate(_FIRST)}
        order |= {name: n for n, name in enumerate(chain(*_SECTIONS.values()), 1)}
        return sorted(super().get_params(ctx), key=lambda one: order.get(one.name or "", 0))

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the options in sections: those of the command alone first."""
        known = {name: title for title, names in _SECTIONS.items() for name in names}
        rows: dict[str, list[tuple[str, str]]] = {title: [] for title in ("Options", *_SECTIONS)}
        for one in self.get_params(ctx):
            record = one.get_help_record(ctx)
            if record is not None and isinstance(one, click.Option):
                title = getattr(one, "section", known.get(one.name or "", "Options"))
                rows[title].append(record)
        for title, found in rows.items():
            if found:
                with formatter.section(title):
                    formatter.write_dl(found)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Read the words; one too many may be the value of an option."""
        ctx.allow_extra_args = True
        try:
            extra = super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            near = difflib.get_close_matches(
                error.option_name, error.possibilities or (), cutoff=_NEAR
            )
            raise click.NoSuchOption(error.option_name, possibilities=near, ctx=ctx) from None
        if extra and not ctx.resilient_parsing:
            word = extra[0]
            raise click.UsageError(
                f"There is no place for {word!r} here.{self._meant(ctx, word)}", ctx
            )
        return extra

    def invoke(self, ctx: click.Context) -> Any:
        """Run; a word that is no topic or recording may be the value of an option."""
        try:
            return super().invoke(ctx)
        except TopicError as error:
            for argument in self.params:
                given = ctx.params.get(argument.name or "")
                if not isinstance(argument, click.Argument) or hasattr(error, "__notes__"):
                    continue
                for word in given if isinstance(given, tuple) else [str(given or "")]:
                    if f"'{word}'" not in str(error):
                        continue
                    if Path(word).is_file():
                        record = f"`hybridlog record {shlex.quote(word)}`"
                        error.add_note(f"{word} is a file: {record} makes it a recording.")
                    elif hint := self._meant(ctx, word, argument):
                        error.add_note(hint.strip())
            raise

    def _meant(
        self, context: click.Context, word: str, argument: click.Argument | None = None
    ) -> str:
        """The options that a word may belong to, asked about: the store has such a thing."""
        taken = (argument.metavar or "").casefold() if argument is not None else ""
        options = {one.name: one for one in self.params if isinstance(one, click.Option)}
        topic, _, field = word.rpartition(":")
        with_topic = {"fields": f"{context.info_name} {topic} --fields {field}"} if topic else {}
        found = [
            with_topic.get(name, f"{short} {word}")
            for name, short in _NAMED.items()
            if name in options and name not in taken and options[name].shell_complete(context, word)
        ]
        return f" Did you mean {' or '.join(found)}?" if found else ""


class Pair(click.Option):
    """An option with two values, neither of which is the next option."""

    def type_cast_value(self, ctx: click.Context, value: Any) -> Any:
        """Refuse an option as a value."""
        for pair in filter(None, (value or ()) if self.multiple else (value,)):
            for place, one in enumerate(pair):
                if isinstance(one, str) and one[:1] == "-" and not one[1:2].isdigit():
                    name, words = self.opts[0], str(self.metavar).split()
                    shown = " ".join([name, *pair[:place], *words[place:]])
                    raise click.UsageError(f"{name} takes two values: {shown}", ctx)
        return super().type_cast_value(ctx, value)
