"""One physical effect per file; each file declares one ``EFFECT``."""
