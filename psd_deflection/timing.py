"""Device clock to host time, by regression on counters; never arrival time."""
