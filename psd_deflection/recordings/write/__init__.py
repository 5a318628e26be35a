"""Writes bags, MCAP, CSV and Rerun."""
