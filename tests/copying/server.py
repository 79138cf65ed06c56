"""A server that `ssh` and `sftp` reach, in a process of its own, behind a proxy that cuts."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from tests.servers.proxy import Proxy

_SERVES = """
import asyncio
import contextlib
import sys

import asyncssh


async def pass_on(reader, writer):
    with contextlib.suppress(OSError, asyncssh.Error):
        while data := await reader.read(1 << 16):
            writer.write(data)
            await writer.drain()


async def run(process):
    shell = await asyncio.create_subprocess_shell(
        process.command,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )

    async def feed():
        await pass_on(process.stdin, shell.stdin)
        shell.stdin.close()

    feeding = asyncio.create_task(feed())
    await asyncio.gather(
        pass_on(shell.stdout, process.stdout), pass_on(shell.stderr, process.stderr)
    )
    process.exit(await shell.wait())
    feeding.cancel()


async def main():
    server = await asyncssh.listen(
        "127.0.0.1",
        0,
        server_host_keys=[asyncssh.generate_private_key("ssh-ed25519")],
        authorized_client_keys=sys.argv[1],
        process_factory=run,
        encoding=None,
    )
    print(server.sockets[0].getsockname()[1], flush=True)
    await asyncio.Event().wait()


asyncio.run(main())
"""


class Sshd(Proxy):
    """A server on this machine, whose key lies in a folder; `ssh` reaches it, with options."""

    def __init__(self, folder: Path) -> None:
        key = folder / "key"
        make = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)]
        subprocess.run(make, check=True)
        self._process = subprocess.Popen(
            [sys.executable, "-c", _SERVES, f"{key}.pub"],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert self._process.stdout is not None
        super().__init__(int(self._process.stdout.readline()))
        self.ssh = (
            f"ssh -F /dev/null -i {key} -o StrictHostKeyChecking=no -o LogLevel=ERROR "
            "-o UserKnownHostsFile=/dev/null"
        )

    def url(self, path: Path) -> str:
        return f"ssh://127.0.0.1:{self.port}{path}"

    def reset(self) -> None:
        self.left = None

    def close(self) -> None:
        super().close()
        with self._process:
            self._process.kill()
