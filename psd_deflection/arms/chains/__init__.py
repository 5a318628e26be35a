"""Links in series, each with its own rig: from their deflections to that of the end effector, with covariance."""
