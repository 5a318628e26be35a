"""Reads bags, MCAP, CSV and tables."""
