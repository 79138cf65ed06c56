"""Starts the child under the Python of the ROS environment; run by its path.

That Python need not know hybridlog, nor have what hybridlog needs: the packages are
named here without loading what their `__init__` loads.
"""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType


def main() -> None:
    """Runs the child; the argument is the number of its socket."""
    here = Path(__file__).resolve().parent
    # The folder of this file, which Python puts first, has names that others may mean.
    sys.path = [entry for entry in sys.path if Path(entry or ".").resolve() != here]
    for name, path in (("hybridlog", here.parent), ("hybridlog.live_sources", here)):
        package = ModuleType(name)
        package.__path__ = [str(path)]
        sys.modules[name] = package
    from hybridlog.live_sources.ros2_child import run

    sys.exit(run(int(sys.argv[1])))


if __name__ == "__main__":
    main()
