"""How long a test waits for what will come."""

from __future__ import annotations

from tools.program import WAIT_S as WAIT_S
