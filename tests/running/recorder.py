"""Records the sequence until it is killed. Run as a script: STORE KIND."""

from __future__ import annotations

import sys
from pathlib import Path

from tests.running.running import begun


def main() -> None:
    with begun(Path(sys.argv[1]), sys.argv[2], 60, "none") as running:
        print("begun", flush=True)
        running.write(100_000, 0.003)


if __name__ == "__main__":
    main()
