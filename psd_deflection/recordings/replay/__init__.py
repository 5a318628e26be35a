"""A recording through the pipeline: computed again, compared, simulated, watched."""
