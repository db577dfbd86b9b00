"""Gates for a registered pair: surfaces, free space, the noise of the run, the prior of odometry."""
