"""What a hand did, as others read it: the LeRobot format and rerun recordings."""
