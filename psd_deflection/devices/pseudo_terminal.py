# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""A pseudo-terminal: a port that pyserial can open, with one of our programs at the other end."""

import contextlib
import os
import select
import time
from collections.abc import Iterator
from pathlib import Path

from psd_deflection.base.errors import ConfigError

ABSENT_S = 0.05
"""A line that nobody has open is always "ready": how long to wait instead."""

PORT_LINE = 'port: '
"""Start of the line in which a program that serves a simulated device prints its port."""


class PseudoTerminal:
    """The device's side of a port that pyserial can open: ``name`` is the host's side.

    ``link``: a symbolic link to it, which replaces an older link and nothing else; ConfigError if it cannot be made.
    """

    def __init__(self, link: str | Path | None = None) -> None:
        # Windows has none; what needs no pseudo-terminal runs there.
        import tty

        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.name = os.ttyname(slave)
        # The kernel reports that no one has it open only after it was opened and closed once.
        os.close(slave)
        os.set_blocking(self.master, False)
        self._poll = select.poll()
        self._poll.register(self.master, select.POLLIN)
        self._link = Path(link) if link is not None else None
        if self._link is not None:
            try:
                if self._link.is_symlink():
                    self._link.unlink()
                self._link.symlink_to(self.name)
            except OSError as error:
                os.close(self.master)
                raise ConfigError(f'{self._link}: no link can be made there ({error.strerror})') from None

    def listen(self, seconds: float) -> bytes | None:
        """What the host has sent, after at most ``seconds``; None if nobody has the port open.

        Raises OSError if it was closed just now.
        """
        events = self._poll.poll(seconds * 1e3)
        mask = events[0][1] if events else 0
        if mask & select.POLLHUP:
            time.sleep(ABSENT_S)
            return None
        try:
            return os.read(self.master, 4096) if mask & select.POLLIN else b''
        except BlockingIOError:
            return b''

    def send(self, stream: bytes) -> int:
        """Send as much as there is room for; return how many bytes. Raises OSError if nobody has it open."""
        try:
            return os.write(self.master, stream)
        except BlockingIOError:
            return 0

    def close(self) -> None:
        """Remove the port, as if the cable were unplugged."""
        os.close(self.master)
        # The link may already belong to another process: delete only our own.
        if self._link is not None and self._link.is_symlink() and str(self._link.readlink()) == self.name:
            self._link.unlink()


def link_names(link: str | None, count: int) -> list[str | None]:
    """The links of ``count`` ports: ``link`` itself for one, ``link_1``, ``link_2`` for several."""
    if link is None or count == 1:
        return [link] * count
    return [f'{link}_{i}' for i in range(1, count + 1)]


@contextlib.contextmanager
def open_terminals(links: list[str | None]) -> Iterator[list[PseudoTerminal]]:
    """One port per link (None: no link), closed at the end. Raises ConfigError like :class:`PseudoTerminal`."""
    with contextlib.ExitStack() as stack:
        ports: list[PseudoTerminal] = []
        for link in links:
            ports.append(PseudoTerminal(link))
            stack.callback(ports[-1].close)
        yield ports
