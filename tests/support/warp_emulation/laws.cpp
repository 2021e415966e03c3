// A motor law as a shared library, for positions and velocities [N, joints].
#include "warp_emulation.h"

#include "scene_text.h"

extern "C" void run(const Args *args, int joints, int substep, const float *position, const float *velocity,
                    Motor *motors) {
  for (int i = 0; i < args->n * joints; i++)
    motors[i] = motor_law(*args, i / joints, i % joints, substep, position[i], velocity[i]);
}
