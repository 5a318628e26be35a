"""The tip's motion from the samples: pose and velocity by a Kalman filter on the link's modes."""
