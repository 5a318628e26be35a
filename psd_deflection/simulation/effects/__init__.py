"""One physical effect a file; each declares one ``EFFECT``."""
