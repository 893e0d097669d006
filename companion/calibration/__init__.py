"""What a drive tells of the sensors: range biases, lever arms, clock offsets."""
