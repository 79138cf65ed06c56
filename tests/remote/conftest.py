"""A bucket for each test, and the proxy before it."""

from __future__ import annotations

import secrets
from collections.abc import Iterator

import pytest

from tests.remote.server import Moto, Proxy, make_bucket


@pytest.fixture(scope="session")
def moto(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Moto]:
    server = Moto(tmp_path_factory.mktemp("moto") / "log")
    yield server
    server.close()


@pytest.fixture(scope="session")
def running_proxy(moto: Moto) -> Iterator[Proxy]:
    found = Proxy(moto.port)
    yield found
    found.close()


@pytest.fixture
def proxy(running_proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> Proxy:
    running_proxy.reset()
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "tester")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "tester")
    monkeypatch.setenv("AWS_REGION", "us-east-1")
    monkeypatch.setenv("AWS_ALLOW_HTTP", "true")
    monkeypatch.setenv("AWS_ENDPOINT_URL", running_proxy.url)
    return running_proxy


@pytest.fixture
def address(proxy: Proxy) -> str:
    """The address of an empty place in a bucket."""
    name = f"lab-{secrets.token_hex(4)}"
    make_bucket(proxy.url, name)
    proxy.reset()
    return f"s3://{name}/store"
