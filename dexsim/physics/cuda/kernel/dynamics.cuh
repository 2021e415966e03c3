// The hand and the object without contacts: inertia, bias force, mass matrix (Featherstone, Rigid Body Dynamics
// Algorithms, chapters 5 and 6), all spatial vectors at the world's origin.
#pragma once
#include "kinematics.cuh"

// Inertia of the lane's link about the world's origin; `centre` is its centre of mass in the world.
DEV Inertia link_inertia(const Args &args, int world, const Pose &pose, Vec3 &centre, const Lane &lane) {
  float mass, xx, xy, xz, yy, yz, zz;
  if (lane.hinge) {
    const int l = lane.index;
    mass = LINK_MASS[l];
    centre = lane_vector(LINK_CENTRE, l);
    xx = LINK_INERTIA[0][l], xy = LINK_INERTIA[1][l], xz = LINK_INERTIA[2][l];
    yy = LINK_INERTIA[3][l], yz = LINK_INERTIA[4][l], zz = LINK_INERTIA[5][l];
  } else {
    mass = args.body_mass[world];
    centre = load3(args.body_ipos + 3 * world);
    const Vec3 principal = load3(args.body_inertia + 3 * world);
    xx = principal.x, yy = principal.y, zz = principal.z, xy = xz = yz = 0;
  }
  centre = pose.place + pose.rotation * centre;
  const Mat3 &r = pose.rotation;
  const Mat3 local = {{xx, xy, xz}, {xy, yy, yz}, {xz, yz, zz}};
  const Vec3 a = local * r.x, b = local * r.y, c = local * r.z;  // columns of local times transposed rotation
  const Vec3 m = mass * centre;
  const float square = dot(m, centre);
  return {mass,
          m,
          dot(r.x, a) + square - m.x * centre.x,
          dot(r.x, b) - m.x * centre.y,
          dot(r.x, c) - m.x * centre.z,
          dot(r.y, b) + square - m.y * centre.y,
          dot(r.y, c) - m.y * centre.z,
          dot(r.z, c) + square - m.z * centre.z};
}

// Force along the lane's degree of freedom that gravity and velocities take up (recursive Newton-Euler without
// acceleration): MuJoCo's qfrc_bias.
DEV float bias_force(const State &state, const Pose &pose, const Motion &unit, const Inertia &inertia,
                     const Lane &lane) {
  Motion own = state.speed * unit;
  if (!lane.hinge) {
    own.turn = pose.rotation * state.spin;
    own.shift = state.velocity + cross(pose.place, own.turn);
  }
  Motion velocity = own;
  add_parents(velocity, lane);
  // How `own` changes as its link carries it along. The object's velocity in the world's axes does not: what is left
  // of its rate is that of the rotation about a place that moves.
  Motion rate = {cross(velocity.turn, own.turn), cross(velocity.turn, own.shift) + cross(velocity.shift, own.turn)};
  if (!lane.hinge) rate = {{0, 0, 0}, cross(state.velocity, own.turn)};
  add_parents(rate, lane);
  rate.shift -= Vec3{GRAVITY_X, GRAVITY_Y, GRAVITY_Z};
  const Force momentum = inertia * velocity;
  Force force = inertia * rate;
  force.moment += cross(velocity.turn, momentum.moment) + cross(velocity.shift, momentum.force);
  force.force += cross(velocity.turn, momentum.force);
  add_children(force, lane);
  return dot(unit, force);
}

// The mass matrix: rows of the hand to `mass_rows`, the object's row [6] on the lanes of its first group.
DEV void mass_matrix(Inertia inertia, float armature, const Motion &unit, Shared &shared, float (&object)[6], const Lane &lane) {
  add_children(inertia, lane);
  const Force force = inertia * unit;  // of a unit acceleration of the hinge on all that it carries
  float *rows = mass_rows(shared);
  if (!BLOCK && lane.hinge) {  // a finger of one chain fills all that is read of it
    for (int other = 0; other < HINGES; other++) rows[lane.index * MASS_STRIDE + other] = 0;
  }
  __syncwarp();
  if (lane.hinge) {
    rows[lane.index * MASS_STRIDE + lane.index] = dot(unit, force) + armature;
#pragma unroll 1
    for (int above = PARENT[lane.index]; above >= 0; above = PARENT[above]) {
      const float value = dot(motion_of(shared, above), force);
      rows[lane.index * MASS_STRIDE + above] = rows[above * MASS_STRIDE + lane.index] = value;
    }
  }
#pragma unroll
  for (int axis = 0; axis < 6; axis++) {
    const float value = dot(motion_of(shared, HINGES + axis), force);
    object[axis] = !lane.hinge && lane.dof ? value : 0;
  }
  __syncwarp();
}
