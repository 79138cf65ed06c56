"""A default profile for Fast DDS that loses fewer large messages.

On one computer Fast DDS transports messages through shared memory of the publisher: half a
megabyte for all its topics. A larger message or a burst is overwritten before it is read. A
subscriber with UDP addresses only gets messages through a socket, whose buffer it can
enlarge. Discovery still uses shared memory.

A profile of the user takes precedence. Other middlewares ignore it.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from pathlib import Path

VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
"""Variables with the file name of a profile; releases before 3 know the second."""

_OTHERS = ("FASTDDS_BUILTIN_TRANSPORTS", "ROS2_EASY_MODE")
_FILES = ("DEFAULT_FASTDDS_PROFILES.xml", "DEFAULT_FASTRTPS_PROFILES.xml")

_KERNEL_LIMIT = Path("/proc/sys/net/core/rmem_max")

BUFFER = 32 << 20
"""Socket buffer in bytes, if the kernel allows it."""

_MIN_BUFFER = 1 << 17
"""Fast DDS refuses socket buffers smaller than one datagram."""

_PROFILE = """\
<?xml version="1.0" encoding="UTF-8"?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles"><profiles>
  <transport_descriptors>
    <transport_descriptor>
      <transport_id>hybridlog_udp</transport_id>
      <type>UDPv4</type>
      <receiveBufferSize>{size}</receiveBufferSize>
    </transport_descriptor>
    <transport_descriptor>
      <transport_id>hybridlog_shm</transport_id>
      <type>SHM</type>
    </transport_descriptor>
  </transport_descriptors>
  <participant profile_name="hybridlog" is_default_profile="true"><rtps>
    <defaultUnicastLocatorList><locator><udpv4/></locator></defaultUnicastLocatorList>
    <userTransports>
      <transport_id>hybridlog_udp</transport_id>
      <transport_id>hybridlog_shm</transport_id>
    </userTransports>
    <useBuiltinTransports>false</useBuiltinTransports>
  </rtps></participant>
</profiles></dds>
"""


def profile(allowed: str) -> str:
    """The profile, as XML.

    `allowed` is the kernel's limit for socket buffers, bytes; if it is not a number, the buffer has
    the minimum size.
    """
    limit = int(allowed) if allowed.strip().isdigit() else _MIN_BUFFER
    return _PROFILE.format(size=max(_MIN_BUFFER, min(BUFFER, limit)))


def is_set_up(environment: MutableMapping[str, str], folder: Path) -> bool:
    """Tells whether the user has chosen a profile or a transport of Fast DDS.

    It looks for profiles in `folder`, too, the working directory of the child.
    """
    named = any(environment.get(name) for name in (*VARIABLES, *_OTHERS))
    return named or any((folder / name).exists() for name in _FILES)


@contextmanager
def default_profile(environment: MutableMapping[str, str] = os.environ) -> Iterator[bool]:
    """Provides the profile while Fast DDS starts; yields False if it does not apply."""
    if is_set_up(environment, Path.cwd()):
        yield False
        return
    try:
        allowed = _KERNEL_LIMIT.read_text(encoding="ascii")
    except OSError:
        allowed = ""
    try:
        number, name = tempfile.mkstemp(prefix="hybridlog-", suffix=".xml")
    except OSError:
        # No folder is writable. Fast DDS starts without the profile, and may lose more.
        yield False
        return
    try:
        with os.fdopen(number, "w", encoding="utf-8") as file:
            file.write(profile(allowed))
        environment.update(dict.fromkeys(VARIABLES, name))
        yield True
    finally:
        for variable in VARIABLES:
            environment.pop(variable, None)
        Path(name).unlink(missing_ok=True)
