"""How a Ray, or its job server, is addressed: what can be told of an address before Ray itself is imported."""

from __future__ import annotations

import socket
from typing import Final

from space_dist.errors import ConfigError, nearest

_JOB_SERVER: Final = ("http://", "https://")
_NAMES: Final = ("local", "auto")  # of a Ray, beside HOST:PORT
_ALLOWED: Final = "local, auto or HOST:PORT"
_SCHEMES: Final = {
    "http": "a job server has http://HOST:PORT, which `grid submit --address` takes",
    "https": "a job server has https://HOST:PORT, which `grid submit --address` takes",
    "ray": "ray:// is a Ray client's; a run is started on a machine of the cluster, or by `grid submit`",
}
"""Of addresses that Ray knows and no run can join, what they are."""


def split(address: str) -> tuple[str, int] | None:
    """Host and port of HOST:PORT; None of anything else."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65536:
        return None
    return host.strip("[]"), int(port)


def fault(address: str) -> str | None:
    """What an address of a Ray must be, if this is none."""
    scheme, has_scheme, _ = address.partition("://")
    if has_scheme:
        hint = _SCHEMES.get(scheme.lower(), "")
    elif address in _NAMES or split(address) is not None:
        return None
    else:
        hint = nearest(address, _NAMES).strip("; ").removesuffix(".") if ":" not in address else ""
    return f"must be {_ALLOWED}" + (f" ({hint})" if hint else "")


def of_a_ray(address: str) -> str:
    """What `--address` was given. Raises ConfigError if no Ray has such an address."""
    if must := fault(address):
        raise ConfigError(f"--address {must}, not {address[:100]!r}")
    return address


def of_a_job_server(address: str | None) -> str | None:
    """The same for a job server's. Ray would try another as that of the cluster itself, for a minute."""
    if address is not None and not address.startswith(_JOB_SERVER):
        raise ConfigError(f"--address {address[:100]!r} is no job server: http://HOST:PORT, like http://127.0.0.1:8265")
    return address


def unresolved(host: str) -> str | None:
    """That a host's name is not known here, if so: a clause of a sentence about its address."""
    try:
        socket.getaddrinfo(host, None)
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or "it is no host's name"
        return f"the name {host!r} cannot be resolved ({why}); is it spelt right, and known to this machine?"
    return None
