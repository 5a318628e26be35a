"""The methods as the thesis prints them, for comparison only: a live run never publishes them as its answer."""
