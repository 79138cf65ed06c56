"""Servers: who is reached how, and what is refused."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest

from hybridlog_storage.copy import Directory, copy
from hybridlog_storage.errors import HeldError, StoreError, UsageError
from hybridlog_storage.manifest import Manifest, Note, new_id, replace
from hybridlog_storage.server import Server
from tests.copying.by_hand import RECORDING, Makes, recording
from tests.copying.server import Sshd
from tests.copying.test_any_place import as_of
from tests.limits import Limit
from tests.places import begin


def test_urls(sshd: Sshd, tmp_path: Path) -> None:
    for wrong in (
        "ssh://server",
        "ssh://server/",
        "ssh:///store",
        "ssh://-oProxyCommand=x/store",
        "ssh://-x@server/store",
        "ssh://me:secret@server/store",
        "ssh://server:x/store",
        "ssh://server/store?x",
        "ssh://server/a%0Ab",
    ):
        with pytest.raises(UsageError):
            Server(wrong)
    with (
        pytest.raises(StoreError, match="flock and sha256sum"),
        Server("ssh://server/x", "sh -c 'exit 3'"),  # as of a login without a shell
    ):
        pass

    with pytest.raises(StoreError, match="not reached"), Server("ssh://127.0.0.1:1/x", sshd.ssh):
        pass
    with (
        pytest.raises(StoreError, match="no-such"),
        Server(sshd.url(tmp_path), "no-such"),
    ):
        pass
    missing = sshd.url(tmp_path / "missing" / "store")
    with pytest.raises(StoreError, match="missing/store"), Server(missing, sshd.ssh):
        pass


def test_a_copy_waits_for_another_one(make: Makes, limit: Limit) -> None:
    limit(copy_wait_s=0.2, server_copy_wait_s=1)
    for kind in ("directory", "shell"):
        source, target = make("directory"), make(kind)
        source.begin(recording())
        assert target.folder is not None
        with Directory(target.folder).working(RECORDING):
            with pytest.raises(HeldError):
                copy(source.source, target.place, RECORDING)
        copy(source.source, target.place, RECORDING)
        target.check(recording())


@pytest.mark.parametrize("kind", ["directory", "bucket", "shell"])
def test_no_edit_is_lost_while_it_is_copied_again_and_again(make: Makes, kind: str) -> None:
    source, target = make("directory"), make(kind)
    source.begin(recording())
    source.place.manifests.change(
        RECORDING, lambda now: replace(now, **as_of(recording(1, "open")))
    )
    copy(source.source, target.place, RECORDING)

    def note() -> None:
        manifests = target.manifests()
        for at in range(15):
            manifests.change(RECORDING, lambda now, at=at: noted(now, at))

    thread = threading.Thread(target=note)
    thread.start()
    for count in range(2, 6):
        later = recording(count, "open")
        source.place.manifests.change(
            RECORDING, lambda now, later=later: replace(now, **as_of(later))
        )
        copy(source.source, target.place, RECORDING)
    thread.join()
    found = target.check()
    assert [note.at for note in found.notes] == [*range(15)]
    assert found.files == recording().files


def noted(now: Manifest, at: int) -> Manifest:
    return replace(now, notes=(*now.notes, Note(at, "")))


def test_a_store_is_made_there(make: Makes) -> None:
    target = make("shell")
    assert isinstance(target.place, Server)
    settings = target.read("hybridlog.toml")
    target.place.begin()
    assert target.read("hybridlog.toml") == settings
    target.write("hybridlog.toml", b"format = 3\n")
    with pytest.raises(StoreError, match="of format 3"):
        target.place.begin()
    target.delete("hybridlog.toml")
    target.write("thesis.tex", b"")
    with pytest.raises(StoreError, match="holds files and is not"):
        target.place.begin()


def test_names_there(make: Makes) -> None:
    source, target = make("directory"), make("shell")
    assert isinstance(target.place, Server)
    assert target.place.names() == set()
    for name in ('a"b', "back\\slash", "\u00e4 \U0001f916", "tab\there"):
        one = replace(recording(), id=new_id("x"), name=name, files=())
        begin(source.place.manifests, one)
        copy(source.source, target.place, one.id)
    assert target.place.names() == {'a"b', "back\\slash", "\u00e4 \U0001f916", "tab\there"}
