"""Definitions of ROS 2 types, from the files of the message packages.

A definition is a complete text, as in bags of ROS 2: the `.msg` file and those of its
fields' types (`ros2msg`), or `.idl` files if a type has no `.msg` file (`ros2idl`). Type
names come from the network. They are looked up as files before a package is imported.
"""

from __future__ import annotations

import json
import os
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

MAX_FILE = 4 << 20
MAX_TYPES = 1000
MAX_TEXT = 8 << 20

_TYPE = re.compile(r"([A-Za-z]\w*)/(msg|srv|action)/([A-Za-z]\w*)", re.ASCII)
_INCLUDE = re.compile(
    rb'^\s*#include\s*[<"]([A-Za-z]\w*/(?:msg|srv|action)/[A-Za-z]\w*)\.idl', re.MULTILINE
)
_BYTES = re.compile(
    rb"^\s*(?:u?int8|byte|char)\[\]|sequence<\s*(?:u?int8|octet|char)\s*>", re.MULTILINE
)
_PRIMITIVE = frozenset(
    [
        "bool",
        "byte",
        "char",
        "float32",
        "float64",
        "int8",
        "uint8",
        "int16",
        "uint16",
        "int32",
        "uint32",
        "int64",
        "uint64",
        "string",
        "wstring",
    ]
)
_LINE = b"=" * 80 + b"\n"

# Services and actions have topics with types that their files define.
_PARTS = {
    "srv": ("_Event",),
    "action": ("_FeedbackMessage", "_SendGoal_Event", "_GetResult_Event"),
}


class UnknownTypeError(Exception):
    """A type has no usable definition; the message names reason and remedy."""


class TypeName(NamedTuple):
    """`package/folder/name`; `part` is a part of a service or an action."""

    package: str
    folder: str
    name: str
    part: str = ""


class Definition(NamedTuple):
    """A complete definition.

    Attributes:
        encoding: `ros2msg` or `ros2idl`.
        text: The definition with all definitions that it needs.
        has_bytes: Some field is a byte array of any length, as in images.
        type_hash: Hash of the installed type; empty in older releases.
    """

    encoding: str
    text: bytes
    has_bytes: bool
    type_hash: str = ""

    def of(self, type_hash: str) -> Definition:
        """The definition for a version of the type: empty if another one is installed."""
        is_other = type_hash and self.type_hash and type_hash != self.type_hash
        return self._replace(text=b"") if is_other else self


def parse_type(name: str) -> TypeName:
    """Parses the name of a type."""
    found = _TYPE.fullmatch(name)
    if found is None:
        raise UnknownTypeError(f"{name!r} is not a type name like package/msg/Name")
    package, folder, last = found.groups()
    for part in _PARTS.get(folder, ()):
        if last.endswith(part) and len(last) > len(part):
            return TypeName(package, folder, last[: -len(part)], part[1:])
    return TypeName(package, folder, last)


def share_folders() -> list[Path]:
    """Folders of the environment's packages: sourced workspaces, then installed wheels."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    folders = [Path(prefix) / "share" for prefix in [*prefixes, sys.prefix] if prefix]
    return list(dict.fromkeys(folders))


class Definitions:
    """Finds definitions in folders; earlier folders take precedence."""

    def __init__(self, folders: Iterable[Path]) -> None:
        self._folders = list(folders)

    def find(self, name: str) -> Definition:
        """The definition of a type."""
        root = parse_type(name)
        try:
            return self._collect(root, f".{root.folder}", "MSG", "ros2msg")
        except UnknownTypeError as error:
            try:
                return self._collect(root, ".idl", "IDL", "ros2idl")
            except UnknownTypeError:
                raise error from None

    def _collect(self, root: TypeName, suffix: str, word: str, encoding: str) -> Definition:
        text = self._read(root, suffix)
        parts = [text] if word == "MSG" else [_LINE, _title(word, root), text]
        known = {root[:3]}
        waiting = [(root.package, text)]
        size = len(text)
        for package, found in waiting:
            for need in _needs(found, package, word):
                if need[:3] in known:
                    continue
                known.add(need[:3])
                more = self._read(need, ".msg" if word == "MSG" else suffix)
                size += len(more)
                if len(known) > MAX_TYPES or size > MAX_TEXT:
                    raise UnknownTypeError("its definition needs too many other definitions")
                waiting.append((need.package, more))
                parts += [b"\n", _LINE, _title(word, need), more]
        return Definition(
            encoding,
            b"".join(parts),
            has_bytes=any(_BYTES.search(found) for _, found in waiting),
            type_hash=self._type_hash(root),
        )

    def _type_hash(self, root: TypeName) -> str:
        """The hash of an installed type, which a file beside its definition states."""
        try:
            described = json.loads(self._read(root, ".json"))
            hashes = {each["type_name"]: each["hash_string"] for each in described["type_hashes"]}
        except (UnknownTypeError, ValueError, LookupError, TypeError, RecursionError):
            return ""  # Humble has no hashes
        name = "/".join(root[:3]) + (f"_{root.part}" if root.part else "")
        found = hashes.get(name)
        return found if isinstance(found, str) else ""

    def _read(self, name: TypeName, suffix: str) -> bytes:
        """Reads the file of a type."""
        is_installed = False
        for folder in self._folders:
            package = folder / name.package
            is_installed = is_installed or package.is_dir()
            path = package / name.folder / f"{name.name}{suffix}"
            try:
                with path.open("rb") as file:
                    data = file.read(MAX_FILE + 1)
            except (FileNotFoundError, NotADirectoryError):
                continue
            except OSError as error:
                raise UnknownTypeError(f"{path} cannot be read: {error.strerror}") from error
            if len(data) > MAX_FILE:
                raise UnknownTypeError(f"{path} is too large for a definition")
            return data
        if not is_installed:
            raise UnknownTypeError(
                f"the package {name.package} is not installed beside rclpy; install it there, "
                "or source its workspace"
            )
        raise UnknownTypeError(
            f"the installed package {name.package} has no {name.folder}/{name.name}; source the "
            "workspace of its publisher"
        )


def _title(word: str, name: TypeName) -> bytes:
    short = f"{name.package}/{name.name}" if word == "MSG" else "/".join(name[:3])
    return f"{word}: {short}\n".encode()


def _needs(text: bytes, package: str, word: str) -> Iterator[TypeName]:
    """Types that a definition refers to, in order."""
    if word == "IDL":
        for found in _INCLUDE.findall(text):
            yield TypeName(*found.decode().split("/"))
        return
    for line in text.decode(errors="replace").splitlines():
        words = line.partition("#")[0].split(None, 1)
        if not words:
            continue
        base = re.split(r"[\[<]", words[0], maxsplit=1)[0]
        if base in _PRIMITIVE or base.startswith("-"):
            continue
        steps = base.split("/")
        full = {1: [package, "msg", *steps], 2: [steps[0], "msg", steps[-1]]}.get(len(steps), steps)
        found_type = _TYPE.fullmatch("/".join(full))
        if found_type is None:
            raise UnknownTypeError(f"its definition refers to {base[:80]!r}, which is not a type")
        yield TypeName(*found_type.groups())
