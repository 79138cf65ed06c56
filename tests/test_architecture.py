"""The rules on who may import whom, kept by reading every import of the project."""

from __future__ import annotations

import functools
import re
import subprocess
import sys
import tomllib
from graphlib import TopologicalSorter

import pytest

from tests.imports import ROOT, Import, imports_of, modules

MODULES = modules()


@functools.cache
def all_imports() -> dict[str, list[Import]]:
    """What each module imports."""
    return {name: imports_of(path, name) for name, path in MODULES.items()}


HEAVY = "mcap numpy pandas pyarrow pymongo rosbags zstandard"
"""What no command may load before it needs it."""

# Where each third-party package may be imported: a module, or a package and all below it.
ALLOWED = {
    "PIL": ("hybridlog.arrays.message_arrays", "hybridlog.drawing.images"),
    "av": ("hybridlog.arrays.video",),
    "blake3": ("hybridlog_storage.disk.append_file", "hybridlog_storage.manifest"),
    "bson": (
        "hybridlog.columns.rows",
        "hybridlog.query.predicate",
        "hybridlog.schema",
        "hybridlog_storage.mongo",
    ),
    "click": ("hybridlog.cli",),
    "duckdb": ("hybridlog.sql.views",),
    "google": ("hybridlog.schema.protobuf_codec",),
    "isal": ("hybridlog.drawing.images", "hybridlog_storage.checksum"),
    "lz4": ("hybridlog.formats.rosbag1.reader", "hybridlog_storage.mcap.mcap_content"),
    "matplotlib": ("hybridlog.drawing.figure",),
    "mcap": ("hybridlog.formats", "hybridlog_storage.mcap", "hybridlog_storage.segments"),
    "mcap_protobuf": ("hybridlog.schema.protobuf_codec",),
    "msgspec": ("hybridlog", "hybridlog_storage"),
    "obstore": ("hybridlog_storage.remote.bucket",),
    "pandas": ("hybridlog.frames",),
    "picows": ("hybridlog.live.sources.foxglove.connection",),
    "polars": ("hybridlog.frames.frame",),
    "pyarrow": (
        *("hybridlog.across", "hybridlog.cli", "hybridlog.columns", "hybridlog.drawing"),
        *("hybridlog.formats", "hybridlog.frames", "hybridlog.query", "hybridlog.schema"),
        *("hybridlog.sql", "hybridlog.tf", "hybridlog.training"),
    ),
    "pymongo": ("hybridlog_storage.mongo.database",),
    "re2": ("hybridlog.query.predicate.parser",),
    "rclpy": ("hybridlog.live.sources.ros2.child.middleware",),
    "rosbags": (
        "hybridlog.formats.rosbag1.writer",
        "hybridlog.formats.rosbag2.writer",
        "hybridlog.schema",
    ),
    "sqlite3": (
        "hybridlog.formats.rosbag2.sqlite",
        "hybridlog.formats.rosbag2.writer",
        "hybridlog_storage.cells",
    ),
    "mcp": ("hybridlog.view.tool_server",),
    "pydantic": ("hybridlog.view.tool_server",),
    "starlette": ("hybridlog.view",),
    "uvicorn": ("hybridlog.view.server",),
    "websockets": ("hybridlog.view.playback",),
    "yaml": (
        "hybridlog.formats.rosbag2.writer",
        "hybridlog.formats.yaml_values",
        "hybridlog.training.episodes",
    ),
    "zstandard": (
        "hybridlog.formats.log_set",
        "hybridlog.formats.reading",
        "hybridlog_storage.mcap.mcap_content",
    ),
}

# Distributions that are called otherwise than what one imports.
DISTRIBUTIONS = {
    "PIL": "pillow",
    "bson": "pymongo",
    "google": "mcap-protobuf-support",
    "mcap_protobuf": "mcap-protobuf-support",
    "re2": "google-re2",
    "yaml": "pyyaml",
}

# Modules of ours that only some may import when the program runs.
WIRED_BY = {
    "hybridlog_storage.mongo.mongod": ("hybridlog.index.access",),
    "hybridlog.store": ("hybridlog", "hybridlog.cli", "hybridlog.store"),
}


def _is(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")


def _places(name: str, imports: list[Import]) -> str:
    path = MODULES[name].relative_to(ROOT)
    return ", ".join(f"{path}:{found.line}" for found in imports)


def test_modules_are_found() -> None:
    assert {"hybridlog", "hybridlog.store", "hybridlog_storage.mongo.database"} <= set(MODULES)
    assert any(i.module == "numpy" for i in all_imports()["hybridlog_storage.messages"])
    typed = [i for i in all_imports()["hybridlog_storage.messages"] if i.module == "numpy.typing"]
    assert typed
    assert all(i.typing for i in typed)


def test_storage_never_imports_hybridlog() -> None:
    for name in MODULES:
        if _is(name, "hybridlog_storage"):
            wrong = [i for i in all_imports()[name] if _is(i.module, "hybridlog")]
            assert not wrong, f"mechanism must not know policy: {_places(name, wrong)}"


ROOMS = {n: p for n, p in MODULES.items() if p.name == "__init__.py" and n.count(".") == 1}


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_a_room_imports_what_its_first_lines_say(room: str) -> None:
    """Of the other folders of its package; modules that lie loose beside them are for all."""
    said = re.search(r"Imports: ([^.]+)\.", ROOMS[room].read_text("utf-8"))
    assert said, f"{room} does not say what it imports"
    package, allowed = room.partition(".")[0], said[1].split(",")
    others = [n for n in ROOMS if n != room and _is(n, package) and allowed != ["any"]]
    wrong = {
        f"{other}: {_places(name, [i])}"
        for name, imports in all_imports().items()
        for i in imports
        for other in others
        if _is(name, room) and _is(i.module, other) and not i.typing
        if other.rpartition(".")[2] not in map(str.strip, allowed)
    }
    assert not wrong, f"{ROOMS[room]} does not say that it imports {sorted(wrong)}"


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_third_party_packages_stay_where_they_belong(package: str) -> None:
    for name, imports in all_imports().items():
        wrong = [i for i in imports if _is(i.module, package) and not i.typing]
        allowed = any(_is(name, place) for place in ALLOWED[package])
        assert allowed or not wrong, (
            f"{package} may be imported in {', '.join(ALLOWED[package])} only, "
            f"not in {_places(name, wrong)}"
        )


@pytest.mark.parametrize("package", sorted(ALLOWED))
def test_no_permission_outlives_its_need(package: str) -> None:
    if package == "mcap_protobuf":
        pytest.skip("mcap_protobuf is allowed where protobuf is read, and need not be used")
    for place in ALLOWED[package]:
        users = [
            name
            for name, imports in all_imports().items()
            if _is(name, place) and any(_is(i.module, package) for i in imports)
        ]
        assert users, f"{place} does not import {package} any more: take it off the list"


def test_only_known_packages_are_imported() -> None:
    known = {*ALLOWED, "numpy", "hybridlog", "hybridlog_storage", *sys.stdlib_module_names}
    for name, imports in all_imports().items():
        wrong = [i for i in imports if i.module.partition(".")[0] not in known]
        assert not wrong, f"say in ALLOWED where these belong: {_places(name, wrong)}"


def test_nothing_needs_pandas_by_the_way() -> None:
    """Commands load no pandas, which `to_pandas_dtype` imports in pyarrow before 26."""
    for path in sorted((ROOT / "hybridlog").rglob("*.py")):
        assert ".to_pandas_dtype" not in path.read_text("utf-8"), path


# rclpy belongs to the robot's own environment: the process that imports it runs there.
@pytest.mark.parametrize(
    "package", sorted({*ALLOWED, "numpy"} - {*sys.stdlib_module_names, "rclpy"})
)
def test_what_is_imported_is_declared(package: str) -> None:
    """A package that only comes along with another one goes when that changes its mind."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    optional = project["optional-dependencies"].values()
    declared = {
        re.split(r"[^A-Za-z0-9._-]", line, maxsplit=1)[0].lower()
        for line in [*project["dependencies"], *(line for group in optional for line in group)]
    }
    assert DISTRIBUTIONS.get(package, package) in declared


@pytest.mark.parametrize("target", sorted(WIRED_BY))
def test_one_module_wires_the_parts(target: str) -> None:
    for name, imports in all_imports().items():
        wrong = [i for i in imports if _is(i.module, target) and not i.typing]
        allowed = any(_is(name, p) if p != "hybridlog" else name == p for p in WIRED_BY[target])
        assert allowed or not wrong, f"{target} is not for {_places(name, wrong)}"


def test_no_cycle_of_imports() -> None:
    """No two modules import each other, not lazily and not for types either."""
    graph = {
        name: {
            i.module
            for i in imports
            # A package is loaded before its modules, whoever imports them.
            if i.module in MODULES and not _is(name, i.module)
        }
        for name, imports in all_imports().items()
    }
    TopologicalSorter(graph).prepare()  # names a cycle


@pytest.mark.parametrize(
    ("code", "heavy"),
    [
        ("from hybridlog.cli import main; main()", HEAVY),
        ("import hybridlog", HEAVY),
        ("import hybridlog_storage", HEAVY),
        ("import hybridlog.cli.commands.demo", "numpy rosbags pandas pyarrow"),
        (
            "import hybridlog.formats.log_set",
            "rosbags yaml sqlite3 lz4 pandas pyarrow pymongo",
        ),
        (
            "import hybridlog.formats, hybridlog.query.times, hybridlog.query.topics, "
            "hybridlog.query.predicate.parser, hybridlog.query.predicate.mongo_filter",
            "pyarrow pandas rosbags mcap pymongo numpy re2",
        ),
        ("import hybridlog_storage.mongo.mongod, hybridlog_storage.mongo.database", "pymongo bson"),
        ("import benchmarks.backends.registry", "psycopg pymongo mcap rosbags"),
    ],
)
def test_what_loads_no_library(code: str, heavy: str) -> None:
    script = (
        "import atexit, os, sys\n"
        "os._exit = sys.exit\n"  # a command leaves without the interpreter's own end
        "sys.argv = ['hybridlog', '--help']\n"
        f"found = lambda: print({{*{heavy.split()}}} & {{*sys.modules}}, file=sys.stderr)\n"
        f"atexit.register(found)\n{code}\n"
    )
    command = [sys.executable, "-c", script]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (0, "set()"), done.stderr
