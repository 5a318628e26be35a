"""Recordings: bags, MCAP and CSV, read, written, recovered, compared and replayed."""
