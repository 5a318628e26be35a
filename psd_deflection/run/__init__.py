# Copyright 2026 psd_deflection maintainers
# SPDX-License-Identifier: Apache-2.0
"""What happens while it runs? Threads, bounded queues and shutdown; many recordings; the live page."""
