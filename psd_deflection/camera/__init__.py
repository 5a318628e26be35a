"""Camera frames -> reference poses of the tip: targets, sub-pixel fits, poses with covariance. ``footage`` alone opens
files and devices."""
