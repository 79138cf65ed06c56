from __future__ import annotations

import os
import stat
import tomllib
from pathlib import Path

import pytest

from hybridlog_storage.errors import StoreError, UsageError
from hybridlog_storage.settings import (
    FORMAT,
    StoreSettings,
    read_settings,
    with_password,
    without_password,
    write_settings,
)

GOOD = f"format = {FORMAT}\nstore_id = 'x'\n"


def write(store: Path, text: str | bytes) -> Path:
    (store / "hybridlog.toml").write_bytes(text.encode() if isinstance(text, str) else text)
    return store


@pytest.mark.parametrize(
    "settings",
    [
        StoreSettings("ab12"),
        StoreSettings("ab12", "mongodb://me@h1:1,h2/db?tls=true"),
        StoreSettings("ab12", arrays=("/scan", "/points")),
        StoreSettings(
            "ab12",
            retention={"quota": "2GB", "topic": {"/c/**": "7d", "/b": "1h"}, "never-tag": ["a=b"]},
        ),
        StoreSettings("ab12", arrays=("Größe \U0001f600 \x7f\"'\\",)),
    ],
)
def test_what_is_written_is_read(tmp_path: Path, settings: StoreSettings) -> None:
    write_settings(tmp_path, settings)
    assert read_settings(tmp_path) == settings
    values = tomllib.loads((tmp_path / "hybridlog.toml").read_text("utf-8"))
    assert values["format"] == FORMAT == 4
    assert [p.name for p in tmp_path.iterdir()] == ["hybridlog.toml"]


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_the_umask_says_who_may_read_it(tmp_path: Path, umask: int, mode: int) -> None:
    before = os.umask(umask)
    try:
        write_settings(tmp_path, StoreSettings("x"))
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "hybridlog.toml").stat().st_mode) == mode


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "format"),
        (b"format = 'one'", "format"),
        (b"format = true\nstore_id = 'x'", "format"),
        (b"format = 0", "format"),
        (b"format = 2\nstore_id = 'x'", "format 2, and"),
        (b"format = 5\nstore_id = 'x'", "format 5.*that wrote it"),
        (b"format = 4", "store_id"),
        (b"format = 4\nstore_id = ''", "store_id"),
        (b"format = 4\nstore_id = 5", "store_id"),
        (b"format = 4\nstore_id = 'x'\nmongo = 1", "mongo"),
        (b"format = 4\nstore_id = 'x'\nmongo = 'nowhere'", "mongo"),
        (b"format = 4\nstore_id = 'x'\narrays = '/scan'", "arrays"),
        (b"format = 4\nstore_id = 'x'\nretention = 5", "retention"),
        (b"format = [", "damaged"),
        (b"\xff\xfe", "damaged"),
        (b"format = " + b"[" * 100_000, "damaged"),
        (b"#" * (2 << 20), "too large"),
    ],
)
def test_settings_that_are_none(tmp_path: Path, content: bytes, words: str) -> None:
    with pytest.raises(StoreError, match=words):
        read_settings(write(tmp_path, content))


def test_what_is_unknown_is_ignored(tmp_path: Path) -> None:
    write(tmp_path, GOOD + "colour = 'blue'\n")
    assert read_settings(tmp_path) == StoreSettings("x")


def test_the_way_to_the_store_may_be_a_symlink(tmp_path: Path) -> None:
    (tmp_path / "store").mkdir()
    (tmp_path / "link").symlink_to("store")
    write_settings(tmp_path / "link", StoreSettings("x"))
    assert read_settings(tmp_path / "link") == read_settings(tmp_path / "store")


# --- passwords ---

SECRET = "hunter2"

SECRETS = [
    (f"mongodb://me:{SECRET}@h/db", "mongodb://me@h/db"),
    (f"mongodb://me:{SECRET}@h1:1,[::1]:2/?w=1", "mongodb://me@h1:1,[::1]:2/?w=1"),
    (f"mongodb+srv://me:{SECRET}@h", "mongodb+srv://me@h"),
    (f"mongodb://me:a:{SECRET}@%2Ftmp%2Fm.sock/", "mongodb://me@%2Ftmp%2Fm.sock/"),
    (f"mongodb://h/?tlsCertificateKeyFilePassword={SECRET}&w=1", "mongodb://h/?w=1"),
    (f"mongodb://h/?w=1;TLSCERTIFICATEKEYFILEPASSWORD={SECRET}", "mongodb://h/?w=1"),
    (
        f"mongodb://h/?authMechanismProperties=AWS_SESSION_TOKEN:{SECRET}",
        "mongodb://h/",
    ),
]

MALFORMED = [
    f"mongodb://me:{SECRET}/x@h/db",
    f"mongodb://me:12/{SECRET}@h/db",
    f"mongodb://me:{SECRET}?x@h/db",
    f"mongodb://me:12?{SECRET}@h/db",
    f"me:{SECRET}@h",
    f"http://me:{SECRET}@h",
    f"mongodb://me:{SECRET}",
    f"mongodb://h\n/{SECRET}",
    f"mongodb://h/?a=1&b=2;cpassword={SECRET}",
]


CLEAN = [
    "mongodb://h",
    "mongodb://h/",
    "mongodb://h/?",
    "mongodb://h/db?appName=a@b:c",
    "mongodb://me%40x@h/db",
    "mongodb://%2Ftmp%2Fm.sock/?directConnection=true",
    "mongodb://a,b:27018,[fe80::1]/x?w=1;j=true",
]


@pytest.mark.parametrize(("uri", "clean"), [*SECRETS, *((uri, uri) for uri in CLEAN)])
def test_a_password_is_not_kept(tmp_path: Path, uri: str, clean: str) -> None:
    assert without_password(uri) == clean
    assert without_password(clean) == clean
    write_settings(tmp_path, StoreSettings("x", uri))
    assert SECRET not in (tmp_path / "hybridlog.toml").read_text()
    assert read_settings(tmp_path).mongo == clean


@pytest.mark.parametrize(("uri", "clean"), SECRETS)
def test_a_password_in_a_store_is_refused(tmp_path: Path, uri: str, clean: str) -> None:
    with pytest.raises(StoreError, match="HYBRIDLOG_MONGO_PASSWORD") as caught:
        read_settings(write(tmp_path, f"{GOOD}mongo = '{uri}'"))
    assert SECRET not in str(caught.value)
    assert clean in str(caught.value)


@pytest.mark.parametrize("uri", MALFORMED)
def test_what_may_hold_a_password_anywhere_is_refused(tmp_path: Path, uri: str) -> None:
    with pytest.raises(UsageError, match="percent-encode") as told:
        without_password(uri)
    with pytest.raises(UsageError):
        write_settings(tmp_path, StoreSettings("x", uri))
    assert not list(tmp_path.iterdir())
    quoted = uri.replace("\n", "\\n")
    with pytest.raises(StoreError) as caught:
        read_settings(write(tmp_path, f'{GOOD}mongo = "{quoted}"'))
    assert SECRET not in f"{told.value} {caught.value}"


def test_the_embedded_one_needs_no_uri(tmp_path: Path) -> None:
    assert read_settings(write(tmp_path, GOOD + "mongo = 'embedded'")).mongo is None


def test_the_password_of_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    uri = "mongodb://me@h1,h2/db?tls=true"
    assert with_password(uri) == uri
    monkeypatch.setenv("HYBRIDLOG_MONGO_PASSWORD", "p@ss:/?#% ö")
    ready = "mongodb://me:p%40ss%3A%2F%3F%23%25%20%C3%B6@h1,h2/db?tls=true"
    assert with_password(uri) == ready
    assert without_password(ready) == uri
    from pymongo.uri_parser import parse_uri

    assert parse_uri(ready)["password"] == "p@ss:/?#% ö"
    for other in ("mongodb://h/db", "mongodb://me:own@h/db", "mongodb://%2Fm.sock/", "nonsense"):
        assert with_password(other) == other
