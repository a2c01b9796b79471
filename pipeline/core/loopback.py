"""Access control of local servers: only their own page, requested by its own address.

A server on the loopback interface is unreachable from other machines, but not from other sites in the same
browser: they can send forms and open sockets (refused by `Origin`), or point a name of their own at
127.0.0.1 and read answers (DNS rebinding, refused by `Host`). Standard library only.
"""

from collections.abc import Sequence

HOST = "127.0.0.1"
"""Address that local servers listen on."""


def is_own(port: int, hosts: Sequence[str], origins: Sequence[str]) -> bool:
    """Return whether a request comes from the server's own page, or from a program on this machine.

    `hosts` and `origins` are all values of the headers `Host` and `Origin`; a program sends no `Origin`.
    """
    own = {f"{name}:{port}" for name in (HOST, "localhost")}
    from_own_page = not origins or (len(origins) == 1 and origins[0] in {f"http://{name}" for name in own})
    return len(hosts) == 1 and hosts[0] in own and from_own_page
