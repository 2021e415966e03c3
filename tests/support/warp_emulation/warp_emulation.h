// The 32 lanes of a warp as coroutines on a CPU, so that the kernel can be tested where there is no GPU.
//
// A lane runs until it meets an operation of the whole warp (shuffle, vote, barrier), leaves its value there and lets
// the next lane run. Lanes that meet different operations are an error, which on a GPU would be undefined.
#pragma once
#include <setjmp.h>
#include <ucontext.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <cstring>

#define DEV static inline
#define DEV_CALL static
#define __device__ static
#define __align__(n) alignas(n)
struct alignas(16) float4 { float x, y, z, w; };

enum Meeting { SHUFFLE = 1, EXCHANGE, BALLOT, BARRIER };

static struct {
  ucontext_t start[32], caller;
  jmp_buf lane[32], scheduler;
  char stack[32][262144];
  uint32_t value[2][32];  // of two meetings in turn: a fast lane may be at the next while a slow one still reads
  int turn[32], meeting[32], now;
  bool started[32], done[32];
  void (*run)(int lane);
} warp;

static int meet(uint32_t value, Meeting meeting) {
  const int lane = warp.now, turn = warp.turn[lane] ^= 1;
  warp.value[turn][lane] = value;
  warp.meeting[lane] = meeting;
  if (!_setjmp(warp.lane[lane])) _longjmp(warp.scheduler, 1);
  return turn;
}

template <class T> static uint32_t to_bits(T value) {
  static_assert(sizeof(T) == 4, "a lane gives 32 bits");
  uint32_t bits;
  memcpy(&bits, &value, 4);
  return bits;
}
template <class T> static T from_bits(uint32_t bits) {
  T value;
  memcpy(&value, &bits, 4);
  return value;
}

template <class T> static T __shfl_sync(unsigned, T value, int from) {
  const int turn = meet(to_bits(value), SHUFFLE);
  return from_bits<T>(warp.value[turn][from & 31]);
}
template <class T> static T __shfl_xor_sync(unsigned, T value, int other) {
  const int turn = meet(to_bits(value), EXCHANGE);
  return from_bits<T>(warp.value[turn][(warp.now ^ other) & 31]);
}
static unsigned __ballot_sync(unsigned, bool value) {
  const int turn = meet(value, BALLOT);
  unsigned votes = 0;
  for (int lane = 0; lane < 32; lane++) votes |= warp.value[turn][lane] << lane;
  return votes;
}
static unsigned __match_any_sync(unsigned, int value) {
  const int turn = meet(to_bits(value), SHUFFLE);
  unsigned same = 0;
  for (int lane = 0; lane < 32; lane++) same |= (warp.value[turn][lane] == to_bits(value)) << lane;
  return same;
}
static int __reduce_max_sync(unsigned, int value) {
  const int turn = meet(to_bits(value), SHUFFLE);
  for (int lane = 0; lane < 32; lane++) value = std::max(value, from_bits<int>(warp.value[turn][lane]));
  return value;
}
static void __syncwarp() { meet(0, BARRIER); }
static void __syncthreads() { meet(0, BARRIER); }
static int __popc(unsigned value) { return __builtin_popcount(value); }
static int __clz(unsigned value) { return __builtin_clz(value); }
static int __ffs(int value) { return __builtin_ffs(value); }
static float rsqrtf(float value) { return 1 / sqrtf(value); }
#define __powf(base, power) powf(base, power)  // the C library has a hidden function of that name

static void enter_lane() {
  const int lane = warp.now;
  warp.run(lane);
  warp.done[lane] = true;
  _longjmp(warp.scheduler, 1);
}

static void resume(int lane) {
  warp.now = lane;
  if (_setjmp(warp.scheduler)) return;
  if (warp.started[lane]) _longjmp(warp.lane[lane], 1);
  warp.started[lane] = true;
  setcontext(&warp.start[lane]);
}

// Runs `run(lane)` on all lanes to the end.
static void run_warp(void (*run)(int lane)) {
  warp.run = run;
  for (int lane = 0; lane < 32; lane++) {
    warp.started[lane] = warp.done[lane] = false;
    warp.turn[lane] = 0;
    getcontext(&warp.start[lane]);
    warp.start[lane].uc_stack.ss_sp = warp.stack[lane];
    warp.start[lane].uc_stack.ss_size = sizeof warp.stack[lane];
    warp.start[lane].uc_link = nullptr;
    makecontext(&warp.start[lane], enter_lane, 0);
  }
  for (;;) {
    int done = 0;
    for (int lane = 0; lane < 32; lane++) {
      resume(lane);
      done += warp.done[lane];
    }
    if (done == 32) return;
    for (int lane = 0; lane < 32; lane++)
      if (done || warp.meeting[lane] != warp.meeting[0]) {
        fprintf(stderr, "lane %d and lane 0 met different operations of the warp\n", lane);
        abort();
      }
  }
}
