"""Files that only grow: the same bytes whether the page cache is in the way or not."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hybridlog_storage.disk import append_file, files
from hybridlog_storage.disk.append_file import BLOCK, AppendFile
from hybridlog_storage.messages import Buffer
from tests.calls import Calls
from tests.storage.steps import Steps, through

Refusal = Callable[[pytest.MonkeyPatch], None]


def never(_: pytest.MonkeyPatch) -> None:
    """The system takes direct writes, if it can."""


def at_opening(patch: pytest.MonkeyPatch) -> None:
    """It knows the flag, and says no when the file is opened."""

    class Refusing(files.System):
        def open(
            self, name: str, flags: int, mode: int = 0o666, *, dir_fd: int | None = None
        ) -> int:
            fd = super().open(name, flags & ~append_file.DIRECT, mode, dir_fd=dir_fd)
            if flags & append_file.DIRECT:
                os.close(fd)
                raise OSError(errno.EINVAL, "no direct writes here")
            return fd

    patch.setattr(files, "system", Refusing())


def at_writing(patch: pytest.MonkeyPatch) -> None:
    """It opens the file, and says no when it is written."""

    class Refusing(files.System):
        def pwritev(self, fd: int, parts: Sequence[memoryview], position: int) -> int:
            if fcntl.fcntl(fd, fcntl.F_GETFL) & append_file.DIRECT:
                raise OSError(errno.EINVAL, "no direct writes here")
            return super().pwritev(fd, parts, position)

    patch.setattr(files, "system", Refusing())


def in_steps(patch: pytest.MonkeyPatch) -> None:
    """It takes one block at a time."""

    class Slow(files.System):
        def pwritev(self, fd: int, parts: Sequence[memoryview], position: int) -> int:
            return super().pwritev(fd, [parts[0][:BLOCK]], position)

    patch.setattr(files, "system", Slow())


def without(patch: pytest.MonkeyPatch) -> None:
    """There is no such flag at all."""
    patch.setattr(append_file, "DIRECT", 0)


@pytest.mark.parametrize("refusal", [never, at_opening, at_writing, in_steps, without])
@settings(max_examples=25)
@given(
    parts=st.lists(
        st.lists(
            st.one_of(
                st.integers(0, 3 * BLOCK),
                st.sampled_from([BLOCK - 1, BLOCK, BLOCK + 1, (1 << 20) - 1, (1 << 20) + 5]),
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


class Full(files.System):
    """A disk that takes the first bytes of what is written, and then no more."""

    full = False

    def writev(self, fd: int, parts: Sequence[memoryview]) -> int:
        if not self.full:
            return super().writev(fd, parts)
        super().writev(fd, [parts[0][:100]])
        raise OSError(errno.ENOSPC, "full")

    def pwritev(self, fd: int, parts: Sequence[memoryview], position: int) -> int:
        if not self.full:
            return super().pwritev(fd, parts, position)
        super().pwritev(fd, [parts[0][:BLOCK]], position)
        raise OSError(errno.ENOSPC, "full")


@pytest.mark.parametrize("refusal", [never, at_opening])
@pytest.mark.parametrize("can_cut", [True, False])
@pytest.mark.parametrize("before", [0, 100, BLOCK, 5000, 2 * BLOCK])
def test_what_is_appended_after_a_failed_write_stands_behind_what_was_whole(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    calls: Calls,
    refusal: Refusal,
    can_cut: bool,
    before: int,
) -> None:
    """Once there is room again; also where the system did not even cut the file."""
    path = tmp_path / "file"
    refusal(monkeypatch)
    file = AppendFile.create(path)
    file.append([b"a" * before])
    system = Full()
    calls.system(system)
    if not can_cut:
        calls.fail(system, "truncate", OSError(errno.EIO, "no"))
    system.full = True
    for _ in range(2):
        with pytest.raises(OSError, match="full") as caught:
            file.append([b"b" * 9000])
        assert caught.value.errno == errno.ENOSPC
        assert file.position == before
    assert path.read_bytes()[:before] == b"a" * before
    system.full = False
    file.append([b"c" * 10])
    calls.system(files.System())
    file.append([b"d" * 20])
    file.finish(sync=False)
    assert path.read_bytes() == b"a" * before + b"c" * 10 + b"d" * 20


def test_the_file_gets_its_length_before_it_is_synced(tmp_path: Path) -> None:
    steps = Steps()
    with through(steps):
        file = AppendFile.create(tmp_path / "file")
        file.append([b"x" * 5000])
        file.finish(sync=True)
    assert (tmp_path / "file").stat().st_size == 5000
    assert [what for what, _ in steps.log if what != "write"][-1] == "sync"


def test_a_small_file_is_there_whole_or_not_at_all(tmp_path: Path) -> None:
    """At each step that fails; and nothing else is left."""
    steps = Steps()
    with through(steps):
        files.write_file(tmp_path / "f", b"old")
    assert [what for what, _ in steps.log] == [
        *("unlink", "create", "write", "sync", "rename", "sync")
    ]
    assert [name for _, name in steps.log][4:] == ["f", tmp_path.name]
    for number in range(len(steps.log)):
        failing = Steps(fail_from=number, fail_until=number + 1)
        with through(failing), pytest.raises(OSError, match="no space"):
            files.write_file(tmp_path / "f", b"new")
        want = b"new" if number == 5 else b"old"
        assert (tmp_path / "f").read_bytes() == want
        assert [path.name for path in tmp_path.iterdir()] == ["f"]
        (tmp_path / "f").write_bytes(b"old")
