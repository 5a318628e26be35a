"""Bytes to frames and back: pure, no I/O."""
