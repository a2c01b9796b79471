"""Who may talk to a server of this machine: its own page, asked for by its own address.

A server on the loopback interface is out of reach of other machines, but not of other sites in the same
browser: they can send forms and open sockets (refused by `Origin`), or point a name of their own at
127.0.0.1 and read answers (DNS rebinding, refused by `Host`). Standard library only.
"""

from collections.abc import Sequence

HOST = "127.0.0.1"
"""What local servers listen on."""


def is_own(port: int, hosts: Sequence[str], origins: Sequence[str]) -> bool:
    """Return whether a request is one of a server's own page, or of a program on this machine.

    `hosts` and `origins` are all values of the headers `Host` and `Origin`; a program sends no `Origin`.
    """
    own = {f"{name}:{port}" for name in (HOST, "localhost")}
    from_own_page = not origins or (len(origins) == 1 and origins[0] in {f"http://{name}" for name in own})
    return len(hosts) == 1 and hosts[0] in own and from_own_page
