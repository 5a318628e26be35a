"""Commands that read, write and compute recordings."""
