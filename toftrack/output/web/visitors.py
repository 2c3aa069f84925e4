"""Who may talk to a server on this machine, and what is said where it cannot be opened."""

from __future__ import annotations

import errno
import ipaddress
from urllib.parse import urlsplit

from toftrack.errors import ToftrackError


def called_by_a_known_name(host_header: str, host: str) -> bool:
    """Whether a request calls this machine by an address, as localhost, or as `host`.

    Else another web site could reach the server under a name of its own.
    """
    name = urlsplit(f"//{host_header}").hostname or ""
    return name in ("localhost", host.lower()) or _is_address(name)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def refused(group: str, host: str, port: int, error: OSError) -> ToftrackError:
    """What is said when a port cannot be listened at; `group` has the settings host and port."""
    if error.errno == errno.EADDRINUSE:
        return ToftrackError(
            f"port {port} of {host} is taken, perhaps by another tracker; end that one, or choose "
            f"another with {group}.port=PORT (0 = any free one)"
        )
    if error.errno == errno.EACCES:
        return ToftrackError(
            f"port {port} of {host} may not be used; choose one above 1023 with {group}.port=PORT "
            "(0 = any free one)"
        )
    return ToftrackError(
        f"the page cannot be served at {group}.host={host} ({error.strerror or error}); give an "
        "address of this machine, or leave it at 127.0.0.1"
    )
