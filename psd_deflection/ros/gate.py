"""What other nodes send comes in through one gate: what cannot be used is refused, counted, and said once.

A check gives the reason why a message is refused, or ''. A message that makes a node's own code fail is refused, too:
no message ends a node.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile

from psd_deflection.base.errors import PsdDeflectionError, Warned, printable
from psd_deflection.run.repeats import Repeats

LONGEST = 200
"""Characters of a reason, in which a stranger's words may be."""
NEWS = 3
"""Refusals of a topic that are said one by one, before they are counted and said together."""
FAILURES = (PsdDeflectionError, ArithmeticError, ValueError, LookupError, TypeError, AttributeError)
"""What a message of a strange content can cause; scipy's and numpy's errors of linear algebra are ValueErrors."""


class InputGate:
    """Subscriptions of ``node``. ``say`` gets the refusals.

    ``refused``: messages by topic; ``why``: the last reason of each.
    """

    def __init__(self, node: Node, say: Callable[[str], None]) -> None:
        self._node = node
        self._repeats = Repeats(say)
        self.refused: Counter[str] = Counter()
        self.why: dict[str, str] = {}

    def listen(
        self,
        kind: Any,
        topic: str,
        check: Callable[[Any], str],
        take: Callable[[Any], None],
        delivery: QoSProfile | int = 5,
    ) -> None:
        """Subscribe to ``topic``: ``take`` gets each message that ``check`` finds nothing wrong with."""

        def heard(message: Any) -> None:
            try:
                why = check(message)
                if not why:
                    take(message)
            except FAILURES as error:
                why = f'{type(error).__name__}: {error}'
            if why:
                self._refuse(topic, why)

        self._node.create_subscription(kind, topic, heard, delivery)

    def _refuse(self, topic: str, why: str) -> None:
        self.refused[topic] += 1
        self.why[topic] = printable(why, LONGEST)
        line = Warned(f'{topic}: refused: {self.why[topic]}')
        self._repeats.tell(topic, line, time.monotonic(), NEWS)

    def settle(self) -> None:
        """Say what was counted and is due; to be called now and then."""
        self._repeats.settle(time.monotonic())

    def values(self) -> list[tuple[str, str]]:
        """For the node's diagnostics."""
        return [(f'messages refused: {topic}', str(count)) for topic, count in sorted(self.refused.items())]
