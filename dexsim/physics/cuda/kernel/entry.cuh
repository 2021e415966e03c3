// What the host launches, with WORLDS_PER_BLOCK from program.py. The warps of the last block that have no world of their
// own repeat the last one, and write the same bits again.
#pragma once
#include "tick.cuh"

extern "C" __device__ unsigned shared_bytes = sizeof(Shared);

extern "C" __global__ void __launch_bounds__(WORLDS_PER_BLOCK * 32, 2) tick_kernel(const __grid_constant__ Args args) {
  extern __shared__ __align__(16) char memory[];
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  const int world = min(blockIdx.x * WORLDS_PER_BLOCK + warp, args.n - 1);
  tick(args, world, ((Shared *)memory)[warp], lane);
}
