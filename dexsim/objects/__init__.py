"""What is grasped or turned: configuration, random draws, meshes."""
