"""From the truth to what a host reads: taxels, the IMU in the object, noise and latency."""
