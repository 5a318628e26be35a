# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""The services ``~/zero`` and ``~/record`` of a node that has one rig or several."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future as DiskFuture
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.task import Future
from std_srvs.srv import SetBool, Trigger

from psd_deflection.base.errors import PsdDeflectionError
from psd_deflection.ros.names import RECORD, ZERO

R = TypeVar('R')
NOT_CONFIGURED = 'the node is not configured'


class Zeroed(NamedTuple):
    """Whether a zero was taken, and the zero or why not."""

    taken: bool
    text: str


def add_rig_services(
    node: Node,
    present: Callable[[], R | None],
    zero: Callable[[R], Zeroed],
    record: Callable[[R, bool], Sequence[DiskFuture[Path | None]]],
) -> None:
    """Serve ``~/zero`` and ``~/record``.

    ``present``: what runs, or None while the node is not configured; then both are rejected.
    ``zero`` takes a zero; ``record`` begins (True) or ends recordings, whose answers come from the
    disk. If they raise an error of the package or TimeoutError, the caller gets its text.
    """

    def answer_zero(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = False, f'not zeroed: {NOT_CONFIGURED}'
        if (running := present()) is not None:
            try:
                response.success, response.message = zero(running)
            except (PsdDeflectionError, TimeoutError) as error:
                response.message = f'not zeroed: {error}'
        return response

    async def answer_record(request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = False, NOT_CONFIGURED
        if (running := present()) is not None:
            try:
                folders = [await _result(asked) for asked in record(running, request.data)]
            except (PsdDeflectionError, TimeoutError) as error:
                response.message = str(error)
                return response
            verb = 'recording to' if request.data else 'recording ended:'
            message = ', '.join(str(folder) for folder in folders if folder is not None)
            response.success = True
            response.message = f'{verb} {message}' if message else 'no recording runs'
        return response

    node.create_service(Trigger, ZERO, answer_zero)
    # In a separate group: while one request waits for the disk, the node serves everything else.
    node.create_service(SetBool, RECORD, answer_record, callback_group=ReentrantCallbackGroup())


async def _result(asked: DiskFuture[Path | None]) -> Path | None:
    """The result of ``asked``, without a thread that waits."""
    answered: Any = Future()
    asked.add_done_callback(lambda _: answered.set_result(None))
    await answered
    return asked.result()
