"""The state of a message: whole, or without its payload or fields for a cause.

It follows from the encoding of the channel, or from decoding. Tables have it in `state`;
answers count messages that are not whole, and name the cause.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from hybridlog.wording import counted, unfit
from hybridlog_storage.messages import EXPIRED, EXPIRED_IDS, NOT_COPIED, ORIGINAL_ENCODING, REDUCED

if TYPE_CHECKING:
    from hybridlog_storage.catalog import ChannelEntry, RecordingEntry


class State(StrEnum):
    """The states, as tables have them."""

    WHOLE = "whole"
    """With its payload, which fits its definition."""

    REDUCED = "reduced"
    """Without its payload, which was dropped under pressure; its fields are stored."""

    UNREADABLE = "unreadable"
    """With a payload that does not fit its definition."""

    EXPIRED = "expired"
    """Without its payload, which was deleted to make room; its fields are stored."""

    NOT_COPIED = "not_copied"
    """Without its payload, which was not copied yet; its fields are stored."""


CAUSES: Final = {
    State.REDUCED: "dropped under pressure",
    State.EXPIRED: "deleted to make room",
    State.NOT_COPIED: "not copied yet (`hybridlog copy` without --only-fields brings what is left)",
}
"""Reasons why messages have no payload."""
GONE: Final = (State.EXPIRED, State.NOT_COPIED)
"""States of expired messages, in the order in which answers name them."""
_STATES: Final = {REDUCED: State.REDUCED, EXPIRED: State.EXPIRED, NOT_COPIED: State.NOT_COPIED}


def state_of(encoding: str) -> State:
    """The state of the messages of a channel, by its encoding; some may still be unreadable."""
    return _STATES.get(encoding, State.WHOLE)


def encoding_of(encoding: str, metadata: Mapping[str, str]) -> str:
    """The encoding of the payloads of a channel, which may be gone."""
    return encoding if state_of(encoding) is State.WHOLE else metadata.get(ORIGINAL_ENCODING, "")


def shown_channels(channels: Iterable[ChannelEntry]) -> list[ChannelEntry]:
    """The channels of a recording that people are told: not those that are empty by expiry."""
    known = {channel.id: channel for channel in channels}
    return [
        channel
        for number, channel in known.items()
        if channel.stats.messages
        or not {number + EXPIRED_IDS, number + 2 * EXPIRED_IDS} & known.keys()
    ]


def expired_messages(entry: RecordingEntry) -> dict[State, int]:
    """Number of messages of a recording whose payloads are gone, by state; none is 0."""
    found: Counter[State] = Counter()
    for channel in entry.channels:
        found[state_of(channel.message_encoding)] += channel.stats.messages
    return {state: found[state] for state in GONE if found[state]}


def without_payload(messages: int, state: State) -> str:
    """A number of messages without payload: `1 message has no payload, which was dropped ...`."""
    has = "has" if messages == 1 else "have"
    return f"{counted(messages, 'message')} {has} no payload, which was {CAUSES[state]}"


def without_fields(messages: int, state: State, cause: str = "") -> str:
    """A number of rows of a table without fields, in words; `cause` as of `without_payload`."""
    if state is State.UNREADABLE:
        return f"{unfit(messages)}; the fields are null, and error says why"
    have, its = ("has", "its payload was") if messages == 1 else ("have", "their payloads were")
    return f"{counted(messages, 'message')} {have} no long arrays: {its} {cause or CAUSES[state]}"
