"""The physics of a control tick in one CUDA kernel, a warp a world: for NVIDIA GPUs."""
