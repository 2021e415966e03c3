"""The hand: kinematics, files, taxel lattices."""
