"""Many recordings: which they are, one task for each on one of several engines, and the rows that come out."""
