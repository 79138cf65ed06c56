"""Starts the child under the Python of the ROS environment; run by its path.

That Python need not have hybridlog or its dependencies. So the packages are registered
here without running their `__init__` modules.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType

_PACKAGE = "hybridlog.live.sources.ros2.child"


def main() -> None:
    """Runs the child; the argument is the file descriptor of its socket."""
    here = Path(__file__).resolve().parent
    # Python puts this folder first, where `profile` would hide the standard module.
    sys.path = [entry for entry in sys.path if Path(entry or ".").resolve() != here]
    name, folder = _PACKAGE, here
    while name:
        package = ModuleType(name)
        package.__path__ = [str(folder)]
        sys.modules[name] = package
        name, folder = name.rpartition(".")[0], folder.parent
    from hybridlog.live.sources.ros2.child.child import run

    sys.exit(run(int(sys.argv[1])))


if __name__ == "__main__":
    main()
