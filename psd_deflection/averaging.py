"""Blocks of N by sequence number: mean, covariance, present, lost."""
