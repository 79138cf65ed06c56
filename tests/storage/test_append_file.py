"""Files that only grow: the same bytes whether the page cache is in the way or not."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlog_storage import append_file
from hybridlog_storage.append_file import BLOCK, AppendFile
from hybridlog_storage.buffers import buffers
from hybridlog_storage.messages import Buffer

Refusal = Callable[[pytest.MonkeyPatch], None]


def never(_: pytest.MonkeyPatch) -> None:
    """The system takes direct writes, if it can."""


def at_opening(patch: pytest.MonkeyPatch) -> None:
    """It knows the flag, and says no when the file is opened."""
    real = os.open

    def refuse(path: Path, flags: int, *mode: int) -> int:
        if flags & append_file.DIRECT:
            os.close(real(path, flags & ~append_file.DIRECT, *mode))
            raise OSError(errno.EINVAL, "no direct writes here")
        return real(path, flags, *mode)

    patch.setattr(append_file.os, "open", refuse)


def at_writing(patch: pytest.MonkeyPatch) -> None:
    """It opens the file, and says no when it is written."""
    import fcntl

    real = os.pwritev

    def refuse(fd: int, pieces: list[memoryview], position: int) -> int:
        if fcntl.fcntl(fd, fcntl.F_GETFL) & append_file.DIRECT:
            raise OSError(errno.EINVAL, "no direct writes here")
        return real(fd, pieces, position)

    patch.setattr(append_file.os, "pwritev", refuse)


def in_steps(patch: pytest.MonkeyPatch) -> None:
    """It takes one block at a time."""
    real = os.pwritev

    def short(fd: int, pieces: list[memoryview], position: int) -> int:
        return real(fd, [pieces[0][:BLOCK]], position)

    patch.setattr(append_file.os, "pwritev", short)


def without(patch: pytest.MonkeyPatch) -> None:
    """There is no such flag at all."""
    patch.setattr(append_file, "DIRECT", 0)


@pytest.mark.parametrize("refusal", [never, at_opening, at_writing, in_steps, without])
@settings(max_examples=25, deadline=None)
@given(
    parts=st.lists(
        st.lists(
            st.one_of(
                st.integers(0, 3 * BLOCK),
                st.sampled_from([BLOCK - 1, BLOCK, BLOCK + 1, (4 << 20) - 1, (4 << 20) + 5]),
            ),
            max_size=4,
        ),
        max_size=5,
    )
)
def test_what_is_appended_is_what_is_there(
    tmp_path_factory: pytest.TempPathFactory, refusal: Refusal, parts: list[list[int]]
) -> None:
    path = tmp_path_factory.mktemp("file") / "file"
    expected = b""
    with pytest.MonkeyPatch.context() as patch:
        refusal(patch)
        file = AppendFile.create(path)
        for number, sizes in enumerate(parts):
            pieces: list[Buffer] = [bytes([number + 1]) * size for size in sizes]
            if sizes and sizes[-1] >= 1 << 18:
                # What is large lies in a buffer that starts at a block, as a chunk's content.
                pieces[-1] = content = buffers.take(sizes[-1])[: sizes[-1]].data
                content[:] = os.urandom(sizes[-1])
                before = len(expected) + sum(sizes[:-1])
                room = file.room_before(content, before)
                assert not room or (before + room) % BLOCK == 0
                pieces.insert(0, bytes(room))
            file.append(pieces)
            expected += b"".join(pieces)
            assert file.position == len(expected)
            # Whoever is killed now has lost nothing, and left no more than a block of zeros.
            now = path.read_bytes()
            assert now.startswith(expected)
            assert len(now) - len(expected) < BLOCK
            assert not any(now[len(expected) :])
        file.finish(sync=True)
    assert path.read_bytes() == expected


def test_an_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"mine")
    with pytest.raises(FileExistsError):
        AppendFile.create(tmp_path / "file")
    assert (tmp_path / "file").read_bytes() == b"mine"


def test_reopen_goes_on_at_the_end_and_cuts(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"0123456789")
    file = AppendFile.reopen(path)
    assert file.position == 10
    file.cut(4)
    file.append([b"ab", b"", b"c"])
    file.finish(sync=False)
    assert path.read_bytes() == b"0123abc"


def test_a_full_disk_is_the_systems_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = AppendFile.create(tmp_path / "file")
    file.append([b"x" * 5000])

    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(append_file.os, "pwritev", full)
    monkeypatch.setattr("hybridlog_storage.durability.os.writev", full)
    with pytest.raises(OSError, match="full") as caught:
        file.append([b"y" * 5000])
    assert caught.value.errno == errno.ENOSPC
    file.close()
    assert (tmp_path / "file").read_bytes().startswith(b"x" * 5000)
