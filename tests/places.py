"""Where the files of a store's recordings lie."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

from hybridlog_storage.disk.directory import StoreDirectory
from hybridlog_storage.manifest import File, Manifest, decode, encode
from hybridlog_storage.manifests import MANIFEST_OLD, Manifests, manifests_at


def root(store: Path) -> Path:
    """The directory that has the directories of all recordings."""
    return store / "recordings"


def folder(store: Path, name: str) -> Path:
    """The directory of the recording of a name; one of this name if there is none."""
    if (root(store) / name).exists() or not root(store).is_dir():
        return root(store) / name
    found = [path for path in folders(store) if name_of(path) == name and path.name[0] != "."]
    return found[0] if found else root(store) / name


def id_of(store: Path, name: str) -> str:
    """The id of the recording of a name."""
    return folder(store, name).name


def segment(store: Path, name: str, number: int = 0) -> Path:
    """A sealed segment of the recording of a name."""
    return folder(store, name) / f"{number:06d}.mcap"


def begin(manifests: Manifests, one: Manifest) -> None:
    """Create the manifest of a new recording."""
    with manifests.creating() as create:
        create(one)


def segments(store: Path, recording: str) -> list[tuple[int, Path]]:
    """Number and path of each sealed segment of a recording, by its id."""
    sealed = StoreDirectory(store).listing(recording).sealed.items()
    return [(number, store / "recordings" / recording / name) for number, name in sealed]


def manifest_of(folder: Path) -> Path:
    """The file of the manifest of the recording in a directory."""
    return folder.parent.parent / "manifests" / f"{folder.name}.json"


def lose(store: Path, name: str) -> None:
    """Take away the recording of a name, as somebody may do by hand."""
    gone = folder(store, name)
    manifest_of(gone).unlink()
    shutil.rmtree(gone)


def spoil_manifest(folder: Path, harm: str) -> None:
    """Harm the manifest of the recording in a directory: `gone`, `cut`, `flipped` or `empty`."""
    path = manifest_of(folder)
    data = path.read_bytes()
    if harm == "gone":
        path.unlink()
    else:
        flipped = data[:20] + bytes([data[20] ^ 1]) + data[21:]
        path.write_bytes({"cut": data[:-2], "flipped": flipped, "empty": b""}[harm])


def read_in(folder: Path) -> Manifest | None:
    """The manifest of the recording in a directory; None without one."""
    return manifests_at(folder).find(folder.name)


def old_in(folder: Path) -> Manifest:
    """The manifest before its last change."""
    return decode((folder / MANIFEST_OLD).read_bytes())


def change_in(folder: Path, how: Callable[[Manifest], Manifest]) -> Manifest:
    """Change the manifest of the recording in a directory."""
    return manifests_at(folder).change(folder.name, how)


def write_in(folder: Path, new: Manifest) -> None:
    """Write a manifest, whatever it says."""
    path = manifest_of(folder)
    path.parent.mkdir(exist_ok=True)
    manifests_at(folder)._write(path, encode(new))


def manifest(store: Path, name: str) -> Manifest:
    """The manifest of the recording of a name."""
    found = read_in(folder(store, name))
    assert found is not None
    return found


def logs_of(store: Path, name: str, topic: str) -> list[tuple[Path, File]]:
    """The listed segments of a recording that have messages of a topic."""
    found = manifest(store, name)
    numbers = {number for number, one in found.channels.items() if one.topic == topic}
    files = [file for file in found.logs.values() if numbers & file.parts.keys()]
    return [(folder(store, name) / file.name, file) for file in files]


def new_folder(store: Path, name: str) -> Path:
    """Where a test puts the directory of a recording that the store does not have yet."""
    return root(store) / name


def folders(store: Path) -> list[Path]:
    """All that lies in the directory of recordings, hidden or not."""
    return sorted(root(store).iterdir())


def names(store: Path) -> list[str]:
    """The names of the recordings whose directories are there; hidden ones as they are."""
    return sorted(map(name_of, folders(store)))


def files(store: Path, pattern: str = "*.mcap") -> list[Path]:
    """Files of all recordings, by a pattern inside their directories."""
    return sorted(root(store).glob(f"*/{pattern}"))


def name_of(path: Path) -> str:
    """The name of the recording in a directory: by its manifest, else by the word of its id."""
    if path.name.startswith("."):
        return path.name
    try:
        found = json.loads(manifest_of(path).read_bytes().split(b"\n")[0])["name"]
    except (OSError, ValueError, KeyError, TypeError):
        found = ""
    known = re.fullmatch(r"[0-9]{8}-(.+)-[0-9a-f]{16}", path.name)
    return str(found) or (known[1] if known else path.name)
