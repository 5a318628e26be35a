"""The reader thread: samples from the device, its clock, what it says of itself."""
