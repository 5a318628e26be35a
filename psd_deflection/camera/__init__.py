"""Camera frames -> reference poses of the tip: targets, sub-pixel fits, poses with covariance. No files, no devices."""
