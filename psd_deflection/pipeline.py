"""From chunks of samples to records; owns no clock, thread or I/O. The same object live and in replay."""
