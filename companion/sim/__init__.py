"""A simulated room, robot and sensors that speak the real protocols."""
