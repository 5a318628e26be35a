"""One physical effect a file; each declares one ``EFFECT`` (contract section 7)."""
