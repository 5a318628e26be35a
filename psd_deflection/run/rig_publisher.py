"""Tells a wire what the rig is: ``/link_tip/rig``."""

from __future__ import annotations

import time
from collections.abc import Mapping

from msg_adapters import to_messages
from psd_deflection import __version__
from psd_deflection.recordings import cdr
from psd_deflection.recordings.provenance import provenance
from psd_deflection.records import ENVIRONMENT, KNOWN_LOAD, ParameterChange, RigState
from psd_deflection.run.fanout import Wire
from psd_deflection.run.session import Session


class RigPublisher:
    """Publishes rig, zero and hello of ``session``: on activation, at each change, and if the hello changes.

    Changes come in the pipeline thread, between two blocks. Our own recordings hold the same without it.
    """

    def __init__(self, wire: Wire, session: Session) -> None:
        self._wire = wire
        self._session = session
        self._told: Mapping[str, object] | None = None
        self._last = ParameterChange(0, 0, ())
        self._environment: dict[str, object] = {}

    def put_change(self, change: ParameterChange) -> None:
        """Publish the rig after ``change``."""
        if all(name == KNOWN_LOAD for name, _ in change.values):
            # A reader has the load from its own topic.
            return
        self._last = change
        self._environment |= {name: value for name, value in change.values if name in ENVIRONMENT}
        self._publish(dict(change.values))

    def tell(self, again: bool = True) -> None:
        """Publish the present rig; with ``again`` False only if the hello is another than the one that was told."""
        if again or self._hello() != self._told:
            self._publish(self._environment)

    def _hello(self) -> Mapping[str, object] | None:
        hello = self._session.acquisition.hello
        return None if hello is None else hello.info

    def _publish(self, changed: Mapping[str, object]) -> None:
        self._told = self._hello()
        rig = self._session.rig.flat()
        state = RigState(self._last.t_ns, self._last.block, rig, self._told, changed, __version__, provenance())
        for message in to_messages(state):
            self._wire.put(message.topic, message.type, cdr.encode(message.type, message.fields), time.time_ns())
