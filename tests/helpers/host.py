"""The first process of a host that a test makes (see `hosts`): it has a network of one cable and a
`/dev/shm` of its own, hands the other end of the cable over, and lives until its standard input is
closed.

    unshare --net --mount --pid --fork --mount-proc python host.py 10.77.0.1 SOCKET
"""

import fcntl
import os
import socket
import struct
import subprocess
import sys

TUNSETIFF, IFF_TAP, IFF_NO_PI = 0x400454CA, 0x0002, 0x1000  # linux/if_tun.h
CABLE = 'cable'
MTU = 65_000
"""A datagram of the middleware is one frame: a lost frame loses it, and no more."""


def main() -> None:
    """Make the host, and wait."""
    address, descriptor = sys.argv[1], int(sys.argv[2])
    cable = os.open('/dev/net/tun', os.O_RDWR)
    fcntl.ioctl(cable, TUNSETIFF, struct.pack('16sH', CABLE.encode(), IFF_TAP | IFF_NO_PI))
    for command in (
        'mount -t tmpfs none /dev/shm',
        'ip link set lo up',
        f'ip addr add {address}/24 dev {CABLE}',
        f'ip link set {CABLE} mtu {MTU} up',
        f'ip route add 224.0.0.0/4 dev {CABLE}',
    ):
        subprocess.run(command.split(), check=True)
    with socket.socket(fileno=descriptor) as other:
        socket.send_fds(other, [b'cable'], [cable])
    sys.stdin.read()


if __name__ == '__main__':
    main()
