"""What does a block become? Samples to records, the same live and in replay."""
