"""How the methods of the thesis compare with the corrected ones, its figures and its scaling study."""
