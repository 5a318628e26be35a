"""Counts to volts to metres; the sensor types."""
