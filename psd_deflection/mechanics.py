"""The link as a beam: load to deflection and back (contract section 2, appendix A)."""
