"""Every command about a recording that goes on, at rest and while segments are sealed."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

import hybridlog as hl
from hybridlog.cli import app
from tests.calls import Calls
from tests.cli.running import run
from tests.cli.within import Answer, answer
from tests.json_schemas import misfit, schema_of
from tests.running.commands import COMMANDS, EXEMPT, Asked, place_for
from tests.running.methods import LABEL, same
from tests.running.running import Running, begun
from tests.running.sequence import Known
from tests.some import in_turn

pytestmark = pytest.mark.mongo("embedded")

EVERY = [one for rules in COMMANDS.values() for one in rules]


def _id(one: Asked) -> str:
    return " ".join(one.words)


KINDS = ("one", "many")


def asked_in_turn(rules: list[Asked], every: int = 1) -> pytest.MarkDecorator:
    """Each rule, or every n-th, about one kind of recording; `-m exhaustive`: about each."""
    return pytest.mark.parametrize(
        ("one", "running"),
        in_turn(rules, KINDS, every),
        indirect=["running"],
        ids=lambda it: it if isinstance(it, str) else _id(it),
    )


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Running]]:
    """A recording of one segment, and one of many; they go on in all tests."""
    places = {kind: tmp_path_factory.mktemp("running") / "store" for kind in KINDS}
    with ExitStack() as stack:
        yield {kind: stack.enter_context(begun(place, kind)) for kind, place in places.items()}


@pytest.fixture
def running(request: pytest.FixtureRequest, both: dict[str, Running]) -> Running:
    return both[request.param]


def test_every_command_has_a_rule() -> None:
    """A new command needs a rule, or a reason why it has none."""
    assert sorted([*COMMANDS, *EXEMPT]) == sorted(app.COMMANDS)
    assert all(EXEMPT.values())
    assert all(one.words[0] == name for name, rules in COMMANDS.items() for one in rules)


@asked_in_turn(EVERY)
def test_at_rest(running: Running, one: Asked, tmp_path: Path) -> None:
    words, out = place_for(one.words, tmp_path / "out")
    done = answer(*words, store=running.path, code=one.code)
    found, wanted = one.read(done, out), one.right(running.flushed())
    assert same(found, wanted), (found, wanted, done.err)
    if "--json" in words:
        assert not misfit(done.json, schema_of(words))


@asked_in_turn([rules[0] for rules in COMMANDS.values()], every=4)
def test_in_a_process_of_its_own(running: Running, one: Asked, tmp_path: Path) -> None:
    words, out = place_for(one.words, tmp_path / "out")
    done = run(*words, store=running.path, code=one.code, before=lambda: None)
    found = one.read(Answer(done.out, done.err, done.code), out)
    wanted = one.right(running.flushed())
    assert same(found, wanted), (found, wanted, done.err)


@pytest.fixture
def seen(calls: Calls) -> list[dict[str, int]]:
    """What the recording has for each command, when it ends."""
    found: list[dict[str, int]] = []
    taken: list[hl.Store] = []

    def keep(then: hl.Store, *_: object) -> hl.Store:
        taken.append(then)
        return then

    def look(store: hl.Store, *_: object, **__: object) -> None:
        asked = [one for one in taken if one.shared is store.shared] or [store]
        found.append(dict(asked[0].entry(LABEL).messages_by_topic()))

    calls.change(hl.Store, "snapshot", keep)
    calls(app, "_repairs", look)
    return found


@asked_in_turn(EVERY, every=2)
def test_while_segments_are_sealed(
    running: Running, one: Asked, tmp_path: Path, seen: list[dict[str, int]]
) -> None:
    """A command is of one state: what it sees at its end is what it has answered about."""
    with running.writing(8, 0.004) as writing:
        asked = 0
        while writing.is_alive() or not asked:
            words, out = place_for(one.words, tmp_path / "out")
            before = running.before.entry(LABEL).messages_by_topic()
            done = answer(*words, store=running.path, code=one.code)
            assert all(seen[-1].get(topic, 0) >= count for topic, count in before.items())
            known = Known(running.sent, seen[-1])
            found, wanted = one.read(done, out), one.right(known)
            assert same(found, wanted), (found, wanted, done.err)
            asked += 1
