"""Threads, bounded queues and shutdown of a run."""
