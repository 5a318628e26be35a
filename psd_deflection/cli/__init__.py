"""The command line: ``psd-deflection COMMAND``; one file a command.

``run``: commands of a running rig. ``recordings``: of recordings. ``studies``: of a study.
"""
