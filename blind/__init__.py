"""The blind suite: truth from a second generator that shares no code with the simulation."""
