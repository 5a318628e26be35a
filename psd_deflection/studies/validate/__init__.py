"""Estimates against an independent reference: the offset between the clocks, and what the two differ by."""
