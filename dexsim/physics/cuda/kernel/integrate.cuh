// Semi-implicit Euler, as MuJoCo's: velocities from accelerations, then positions from the new velocities.
#pragma once
#include "shared.cuh"

DEV void integrate(State &state, Shared &shared, const Lane &lane) {
  if (lane.dof) shared.vector[lane.index] = state.acceleration;
  __syncwarp();
  if (lane.hinge) {
    state.speed += TIMESTEP * state.acceleration;
    state.angle += TIMESTEP * state.speed;
  }
  state.velocity += TIMESTEP * load3(shared.vector + HINGES);
  state.spin += TIMESTEP * load3(shared.vector + HINGES + 3);
  state.place += TIMESTEP * state.velocity;
  // The quaternion times that of a turn about the object's own axes.
  const float square = dot(state.spin, state.spin) + 1e-20f, inverse = rsqrtf(square);
  float s, c;
  sincosf(0.5f * TIMESTEP * square * inverse, &s, &c);
  const Vec3 v = s * inverse * state.spin;
  const float w = c * state.w - v.x * state.x - v.y * state.y - v.z * state.z;
  const float x = c * state.x + v.x * state.w + v.z * state.y - v.y * state.z;
  const float y = c * state.y + v.y * state.w + v.x * state.z - v.z * state.x;
  const float z = c * state.z + v.z * state.w + v.y * state.x - v.x * state.y;
  const float scale = rsqrtf(w * w + x * x + y * y + z * z);
  state.w = scale * w, state.x = scale * x, state.y = scale * y, state.z = scale * z;
  __syncwarp();
}
