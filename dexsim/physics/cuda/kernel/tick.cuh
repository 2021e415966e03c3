// A control tick of one world by one warp, top to bottom.
//
// Before it come, generated for the scene: `struct Args`, constants and tables of contacts (scene.py),
// and `motor_law` (law.py).
#pragma once
#include "shared.cuh"
#include "kinematics.cuh"
#include "dynamics.cuh"
#include "rows.cuh"
#include "newton.cuh"
#include "integrate.cuh"
#include "contacts/find.cuh"

// All but contact forces along the lane's degree of freedom: bias, motor, damping and spring of a hinge, push on the
// object. `armature` is what its rotor and its implicit motor add to its inertia.
DEV float smooth_force(const Args &args, int world, int substep, const State &state, const Pose &pose,
                       const Motion &unit, const Inertia &inertia, Vec3 centre, float &armature, const Lane &lane) {
  float force = -bias_force(state, pose, unit, inertia, lane);
  armature = lane.hinge ? ARMATURE[lane.index] : 0;
  if (lane.hinge) {
    const int l = lane.index, joint = DRIVE[l];
    if (joint >= 0) {
      const Motor motor = motor_law(args, world, joint, substep, state.angle, state.speed);
      force += motor.torque, armature += motor.inertia;
    }
    force -= DAMPING[l] * state.speed + STIFFNESS[l] * (state.angle - SPRING_ANGLE[l]);
  } else {
    const Vec3 push = load3(args.push + 3 * world);
    force += dot(unit, Force{cross(centre, push), push});
  }
  return force;
}

DEV State load_state(const Args &args, int world, const Lane &lane) {
  const float *qpos = args.qpos + world * (DOFS + 1), *qvel = args.qvel + world * DOFS, *free = qpos + HINGES;
  State state;
  state.angle = lane.hinge ? qpos[lane.index] : 0;
  state.speed = lane.hinge ? qvel[lane.index] : 0;
  state.place = load3(free);
  // MuJoCo works with the normalised quaternion.
  const float scale = rsqrtf(free[3] * free[3] + free[4] * free[4] + free[5] * free[5] + free[6] * free[6]);
  state.w = scale * free[3], state.x = scale * free[4], state.y = scale * free[5], state.z = scale * free[6];
  state.velocity = load3(qvel + HINGES);
  state.spin = load3(qvel + HINGES + 3);
  state.acceleration = lane.dof ? args.warmstart[world * DOFS + lane.index] : 0;
  return state;
}

DEV void store_state(const Args &args, int world, const State &state, const Lane &lane) {
  float *qpos = args.qpos_out + world * (DOFS + 1), *qvel = args.qvel_out + world * DOFS;
  if (lane.dof) args.warmstart_out[world * DOFS + lane.index] = state.acceleration;
  if (lane.hinge) {
    qpos[lane.index] = state.angle;
    qvel[lane.index] = state.speed;
  }
  if (lane.index == 0) {
    float *free = qpos + HINGES, *moving = qvel + HINGES;
    free[0] = state.place.x, free[1] = state.place.y, free[2] = state.place.z;
    free[3] = state.w, free[4] = state.x, free[5] = state.y, free[6] = state.z;
    moving[0] = state.velocity.x, moving[1] = state.velocity.y, moving[2] = state.velocity.z;
    moving[3] = state.spin.x, moving[4] = state.spin.y, moving[5] = state.spin.z;
  }
}

// The object's net force on each fingertip, NaN in a world that has diverged or lost contacts. Added up contact by
// contact in a fixed order, so that results repeat to the bit.
DEV void store_forces(const Args &args, int world, const ContactRows &rows, int contacts, bool lost, Shared &shared,
                      const Lane &lane) {
  const Vec3 along = cone_force(rows, cone_at(rows, rows.miss), rows.miss);
  const Mat3 frame = contact_frame(rows.normal);
  // On the second link, the object, acts the force along the rows; the finger gets the opposite.
  const Vec3 force = -transposed_times(frame, along);
  if (rows.here) shared.factor[lane.index] = {force.x, force.y, force.z, (float)rows.finger};
  __syncwarp();
  const int finger = lane.index / 3, axis = lane.index % 3;
  float sum = 0;
#pragma unroll 1
  for (int contact = 0; contact < contacts; contact++) {
    const float4 given = shared.factor[contact];
    if (given.w == (float)finger) sum += pick({given.x, given.y, given.z}, axis);
  }
  if (finger < FINGERS) args.finger_force[world * 3 * FINGERS + lane.index] = lost ? nanf("") : sum;
  __syncwarp();
}

DEV bool diverged(const State &state) {
  const float limit = 1e10f;  // MuJoCo's
  const Vec3 sum = absolute(state.place) + absolute(state.velocity) + absolute(state.spin);
  const float all = fabsf(state.angle) + fabsf(state.speed) + fabsf(state.acceleration) + sum.x + sum.y + sum.z;
  return !(all < limit && fabsf(state.w) <= 1);  // not a number is neither
}

DEV void tick(const Args &args, int world, Shared &shared, int index) {
  const Lane lane = lane_of(index);
  State state = load_state(args, world, lane);
  int iterations = 0, evaluations = 0, most = 0;

#pragma unroll 1
  for (int substep = 0; substep < args.substeps; substep++) {
    // Worlds of a block share the instruction cache: they go through the code together.
    __syncthreads();
    const Mat3 object = rotation_of(state.w, state.x, state.y, state.z);
    place_links(state, shared, lane);
    const int found = find_contacts(args, world, shared, object, state.place, index);
    most = found > most ? found : most;
    const int contacts = found < MAX_CONTACTS ? found : MAX_CONTACTS;

    Problem problem;
    {
      const Pose pose = pose_of(state, object, shared, lane);
      const Motion unit = unit_motion(pose, shared, lane);
      Vec3 centre;
      const Inertia inertia = link_inertia(args, world, pose, centre, lane);
      __syncwarp();
      float armature;
      problem.force = smooth_force(args, world, substep, state, pose, unit, inertia, centre, armature, lane);
      mass_matrix(inertia, armature, unit, shared, problem.object_mass, lane);
      add_couplings(state, shared, problem.force, lane);
      load_mass(problem, shared, lane);
    }
    if (lane.hinge) shared.vector[index] = state.speed;
    if (index == 0) {
      float *moving = shared.vector + HINGES;
      moving[0] = state.velocity.x, moving[1] = state.velocity.y, moving[2] = state.velocity.z;
      moving[3] = state.spin.x, moving[4] = state.spin.y, moving[5] = state.spin.z;
    }
    __syncwarp();
    problem.rows = contact_rows(args, world, shared, object, state.place, contacts, shared.vector, lane);
    problem.limit = limit_row(state, lane);
    problem.whose = whose_contacts(problem.rows, contacts, lane);
    __syncwarp();
    state.acceleration = solve(args, problem, state.acceleration, shared, iterations, evaluations, lane);
    integrate(state, shared, lane);
    if (substep == args.substeps - 1) {
      const bool lost = most > MAX_CONTACTS || lanes_where(diverged(state)) != 0;
      store_forces(args, world, problem.rows, contacts, lost, shared, lane);
    }
  }
  store_state(args, world, state, lane);
  const int stats = index == 0 ? iterations : index == 1 ? evaluations : index == 2 ? most : most > MAX_CONTACTS;
  if (index < 4) args.stats[4 * world + index] = stats;
}
