"""Robot trajectories into LeRobot datasets, and those into policies that work on the robot."""
