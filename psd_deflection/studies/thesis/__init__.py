"""The methods of the thesis as printed, how they compare with the corrected ones, and its scaling study."""
