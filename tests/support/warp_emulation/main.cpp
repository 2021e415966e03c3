// The kernel of one scene as a shared library: `scene_text.h` is what program.py would hand to NVRTC.
#include "warp_emulation.h"

#include "scene_text.h"
#include "tick.cuh"

static const Args *arguments;
static Shared memory;
static int world;

extern "C" void run(const Args *args) {
  arguments = args;
  for (world = 0; world < args->n; world++) {
    memset((void *)&memory, 0xff, sizeof memory);  // NaN: what was not written must not be read
    run_warp([](int lane) { tick(*arguments, world, memory, lane); });
  }
}
