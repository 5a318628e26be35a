"""Threads, bounded queues, shutdown: the only room that starts a thread."""
