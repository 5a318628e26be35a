"""Tip deflection and twist of a flexible link from two position sensing detectors.

The rooms of the house, and which way the imports point, are in ``docs/architecture.md``.
"""

__version__ = '0.1.0'
