"""The settings of a store: its file `hybridlog.toml`.

The file may come from another user, or be read by others of a group. So it holds no
password, and a URI in it counts only for its owner.
"""

from __future__ import annotations

import json
import os
import re
import tomllib
from pathlib import Path
from typing import Annotated, Any, Final, TypeGuard
from urllib.parse import quote

from msgspec import Meta, Struct, ValidationError, convert
from msgspec.structs import replace

from hybridlog_storage.disk import files
from hybridlog_storage.errors import StoreError, UsageError, unreadable

FORMAT: Final = 4
"""Store format of this version."""
NAME: Final = "hybridlog.toml"
EMBEDDED: Final = "embedded"
"""In place of a URI: the MongoDB that comes with hybridlog."""
NONE: Final = "none"
"""In place of a URI: no MongoDB."""

MAX_SETTINGS: Final = 1 << 20
"""Bytes of the file."""
_HOST = r"(?:\[[^\s@/\[\]]+\]|[^\s@:/?\[\]]+)(?::\d{1,5})?"
_OPTION = r"[^\s=&;]+=[^\s&;]*"
_URI: Final = re.compile(
    r"(mongodb(?:\+srv)?://)(?:([^\s@:/?]*)(:[^\s@/?]*)?@)?"  # user, password
    rf"({_HOST}(?:,{_HOST})*(?:/[^\s@/:?]*)?)"
    rf"(?:\?(|{_OPTION}(?:&{_OPTION})*|{_OPTION}(?:;{_OPTION})*))?"
)
_SECRET: Final = re.compile("(?i)[^=]*(password|passphrase)|[^=]*=.*token")
"""An option of a URI that holds a password or a token."""
LOGIN_CURE: Final = (
    "Name the user in the URI, mongodb://USER@host/NAME, and give the password in "
    "HYBRIDLOG_MONGO_PASSWORD: a server that --mongo or HYBRIDLOG_MONGO_URI names gets it."
)
"""The cure for a password that is missing or readable by others."""


class StoreSettings(Struct, frozen=True):
    """The content of `hybridlog.toml`.

    Attributes:
        mongo: URI, without a password, of the MongoDB to use; `none` to use no MongoDB; None for
            the embedded one.
        arrays: Topics whose tables have arrays in full.
        retention: The table `[retention]`, as it stands there.
    """

    store_id: Annotated[str, Meta(min_length=1)]
    mongo: str | None = None
    arrays: tuple[str, ...] = ()
    retention: dict[str, Any] = {}


def read_settings(path: Path) -> StoreSettings:
    """Read the settings of a store."""
    file = path / NAME
    try:
        return settings_of(files.read_file(file, MAX_SETTINGS), str(path))
    except FileNotFoundError:
        reason = "there is no such directory" if not path.exists() else f"it has no {NAME}"
        raise StoreError(
            f"{path} is not a hybridlog store: {reason}. `hybridlog record FILE --store {path}` "
            "makes one; --store or HYBRIDLOG_STORE says where to look."
        ) from None
    except OSError as error:
        raise unreadable(error, file) from error


def is_own(path: Path) -> bool:
    """True if the settings of a store are a file of this user."""
    return files.status(path / NAME).st_uid == os.geteuid()


def settings_of(content: bytes, store: str) -> StoreSettings:
    """The settings in the content of the file of a store."""
    file = f"{store}/{NAME}"
    if len(content) > MAX_SETTINGS:
        raise StoreError(f"{file} is too large to be settings.")
    try:
        values = tomllib.loads(content.decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise StoreError(f"{file} is damaged: {error}. Restore it or correct it.") from error
    version = values.get("format")
    if type(version) is not int or version < 1:
        raise StoreError(f"{file} names no format version; it should say `format = {FORMAT}`.")
    if version != FORMAT:
        raise StoreError(
            f"The store {store} is of format {version}, and this hybridlog knows format {FORMAT}. "
            "Use the hybridlog that wrote it."
        )
    try:
        found = convert(values, StoreSettings)
    except ValidationError as error:
        raise StoreError(f"{file} is malformed: {error}") from error
    return replace(found, mongo=_stored_uri(file, found.mongo))


def write_settings(path: Path, settings: StoreSettings) -> None:
    """Write the settings of a store, without a password in its URI."""
    files.write_file(path / NAME, settings_text(settings))


def settings_text(settings: StoreSettings) -> bytes:
    """The content of the file, without a password in the URI."""
    lines = [f"format = {FORMAT}", f"store_id = {_quoted(settings.store_id)}"]
    if settings.mongo is not None:
        mongo = without_password(settings.mongo) if is_uri(settings.mongo) else settings.mongo
        lines.append(f"mongo = {_quoted(mongo)}")
    if settings.arrays:
        lines.append(f"arrays = {_as_toml(settings.arrays)}")
    if settings.retention:
        lines.append("\n[retention]")
        lines += [f"{_quoted(k)} = {_as_toml(v)}" for k, v in settings.retention.items()]
    return ("\n".join(lines) + "\n").encode()


def is_uri(mongo: str | None) -> TypeGuard[str]:
    """True if a setting names a server, not the embedded MongoDB or none."""
    return mongo not in {None, EMBEDDED, NONE}


def without_password(uri: str) -> str:
    """A connection string with the user's name, but without secrets."""
    found = _URI.fullmatch(uri)
    if found is None or not uri.isprintable():
        raise UsageError(
            "The URI is not a MongoDB connection string. Write mongodb://host:port/NAME, and "
            "percent-encode user name, password and socket path."
        )
    scheme, user, secret, place, options = found.groups("")
    mark = ";" if ";" in options else "&"
    public = mark.join(option for option in options.split(mark) if not _SECRET.match(option))
    if not secret and public == options:
        return uri
    return f"{scheme}{user}{'@' if user else ''}{place}{'?' if public else ''}{public}"


def with_password(uri: str) -> str:
    """A connection string with the password of HYBRIDLOG_MONGO_PASSWORD.

    A URI without a user, or with a password of its own, is unchanged.
    """
    found, password = _URI.fullmatch(uri), os.environ.get("HYBRIDLOG_MONGO_PASSWORD")
    if not password or found is None or not found[2] or found[3]:
        return uri
    at = found.end(2)
    return f"{uri[:at]}:{quote(password, safe='')}{uri[at:]}"


def _stored_uri(file: str, mongo: str | None) -> str | None:
    if not is_uri(mongo):
        return None if mongo == EMBEDDED else mongo
    try:
        clean = without_password(mongo)
    except UsageError as error:
        raise StoreError(f"{file}: mongo cannot be used. {error}") from None
    if clean != mongo:
        raise StoreError(
            f"{file} holds a password, which others may read there. Take it out of `mongo`: write "
            f"{clean}. {LOGIN_CURE}"
        )
    return mongo


def _as_toml(value: object) -> str:
    """A value of TOML on one line."""
    if isinstance(value, dict):
        pairs = (f"{_quoted(key)} = {_as_toml(inner)}" for key, inner in value.items())
        return f"{{{', '.join(pairs)}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_as_toml, value))}]"
    if isinstance(value, str):
        return _quoted(value)
    return str(value).lower() if isinstance(value, bool) else str(value)


def _quoted(text: str) -> str:
    """A string of TOML."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
