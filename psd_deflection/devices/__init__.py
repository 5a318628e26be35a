"""Devices: where samples come from, and their simulated twins."""
