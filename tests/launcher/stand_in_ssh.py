"""What ssh and sshd do together, on one machine: `stand_in_ssh.py HOST WORD...` gives the words, joined by
blanks, to a shell that greets first, and whose input and output are the two ways of one socket."""

from __future__ import annotations

import ctypes
import os
import select
import socket
import subprocess
import sys


def main() -> int:
    ctypes.CDLL(None).prctl(15, b"stand-in-ssh", 0, 0, 0)
    near, far = socket.socketpair()
    command = "echo welcome; " + " ".join(sys.argv[2:])
    shell = subprocess.Popen(["sh", "-c", command], stdin=far.fileno(), stdout=far.fileno())
    far.close()
    sources = [0, near.fileno()]
    while True:
        readable, _, _ = select.select(sources, [], [])
        if 0 in readable:
            if data := os.read(0, 65_536):
                near.sendall(data)
            else:
                sources.remove(0)
                near.shutdown(socket.SHUT_WR)
        if near.fileno() in readable:
            if data := near.recv(65_536):
                os.write(1, data)
            else:
                return shell.wait()


if __name__ == "__main__":
    sys.exit(main())
