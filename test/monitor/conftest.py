from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from .serving import Serving


@pytest.fixture
def serve() -> Iterator[Callable[..., Serving]]:
    started: list[Serving] = []

    def begin(**overrides: object) -> Serving:
        serving = Serving(overrides)
        started.append(serving)
        return serving

    yield begin
    for serving in started:
        serving.server.close()
