"""The command line: ``psd-deflection COMMAND``; one file a command."""
