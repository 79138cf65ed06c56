"""A profile for Fast DDS that loses less of what is large, unless the user has one.

Fast DDS hands messages to processes of the same computer through shared memory that the
publisher owns: half a megabyte for all its topics. A message that is larger than that, or
a burst, overwrites itself before it can be read. A subscriber that names UDP addresses
only gets them through a socket instead, whose buffer is ours to size. Shared memory is
still there for what discovery has to say.

Other middlewares do not look at it.

Runs under Python 3.10 as well, with nothing but the standard library.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from pathlib import Path

VARIABLES = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
"""Where Fast DDS looks for the name of a file; releases before 3 know the second."""

_OTHERS = ("FASTDDS_BUILTIN_TRANSPORTS", "ROS2_EASY_MODE")
_FILES = ("DEFAULT_FASTDDS_PROFILES.xml", "DEFAULT_FASTRTPS_PROFILES.xml")

_MAX_ALLOWED = Path("/proc/sys/net/core/rmem_max")

BUFFER = 32 << 20
"""Bytes that a socket is asked to hold, where the kernel allows so many."""

_LEAST = 1 << 17
"""Fast DDS refuses sockets that hold less than one datagram."""

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

    Args:
        allowed: What the kernel says it lets a socket hold, bytes; when that is no number,
            sockets are not asked for much.
    """
    most = int(allowed) if allowed.strip().isdigit() else _LEAST
    return _PROFILE.format(size=max(_LEAST, min(BUFFER, most)))


def is_set_up(environment: MutableMapping[str, str], folder: Path) -> bool:
    """Whether the user has a profile, or has chosen how Fast DDS transports messages.

    Args:
        environment: Variables.
        folder: Where the child runs: Fast DDS reads profiles there without being told.
    """
    named = any(environment.get(name) for name in (*VARIABLES, *_OTHERS))
    return named or any((folder / name).exists() for name in _FILES)


@contextmanager
def default_profile(environment: MutableMapping[str, str] = os.environ) -> Iterator[bool]:
    """Lets Fast DDS find the profile while it comes up; whether it does.

    Args:
        environment: Where the variables are set, and taken away at the end.
    """
    if is_set_up(environment, Path.cwd()):
        yield False
        return
    try:
        allowed = _MAX_ALLOWED.read_text(encoding="ascii")
    except OSError:
        allowed = ""
    try:
        number, name = tempfile.mkstemp(prefix="hybridlog-", suffix=".xml")
    except OSError:
        # No folder can be written to. Fast DDS does without, and may lose more.
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
