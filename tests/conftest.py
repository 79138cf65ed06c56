"""Shared set-up: a mongod of our own ends soon after its last user."""

from __future__ import annotations

import os

os.environ["HYBRIDLOG_MONGOD_LINGER_S"] = "0.2"
for name in ("HYBRIDLOG_STORE", "HYBRIDLOG_MONGO_URI"):
    os.environ.pop(name, None)
